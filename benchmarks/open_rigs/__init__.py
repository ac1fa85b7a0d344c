"""A blind test on rigs that are no structures on springs, with a remainder; see `__main__`."""
