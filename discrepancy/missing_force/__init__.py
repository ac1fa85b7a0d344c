"""The force that a model lacks: its values in time, its port, and the laws that explain it."""
