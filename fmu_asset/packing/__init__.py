"""Making our FMUs."""
