"""A structure from a deck of CalculiX, whose matrices CalculiX itself writes."""
