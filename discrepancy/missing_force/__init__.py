"""The force that a model lacks: its course in time, its port, and the laws that explain it."""
