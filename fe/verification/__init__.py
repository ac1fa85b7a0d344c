"""Known answers, and CalculiX."""
