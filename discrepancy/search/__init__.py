"""Which candidates, in which order."""
