"""What runs inside our FMUs."""
