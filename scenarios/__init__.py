"""What to run: scenario and binding files, shipped as package data."""
