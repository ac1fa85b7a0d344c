"""Sampling FMUs into observation libraries."""
