"""Faults of data that are found without a model, and by comparison with one."""
