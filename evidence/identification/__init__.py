"""Identification of the free numbers of the wing design from the published model's outputs."""
