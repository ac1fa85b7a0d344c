"""What a user writes: the scenario file."""
