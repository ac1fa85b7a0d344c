"""Checks of an FMU: its file, and its behaviour when it runs."""
