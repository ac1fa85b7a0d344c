"""Known answers, CalculiX, and the sandwich plate."""
