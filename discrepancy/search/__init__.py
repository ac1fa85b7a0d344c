"""The search: which sets of effects are fitted, and in which order."""
