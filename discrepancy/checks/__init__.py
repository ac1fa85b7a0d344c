"""Faults of data, alone and beside a model."""
