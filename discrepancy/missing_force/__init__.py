"""The force that a model lacks: its port, how much laws explain of it, and when it acts."""
