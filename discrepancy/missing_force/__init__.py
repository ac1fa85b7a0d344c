"""The force that a model lacks: its port, its size and share, and the events in which it acts."""
