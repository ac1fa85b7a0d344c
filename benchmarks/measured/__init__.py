"""Rigs that others measured, as campaigns: their files are read as published and never copied."""
