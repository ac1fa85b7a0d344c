"""A blind test with laws that the catalogue of effects lacks; see `__main__`."""
