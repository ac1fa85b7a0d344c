"""Rigs that others measured and published in repositories."""
