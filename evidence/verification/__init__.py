"""The finite elements against known answers, and a ring-down against CalculiX."""
