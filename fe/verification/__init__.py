"""Balances and convergence of a wing; models against CalculiX."""
