"""What flies, and what the twin believes of it."""
