"""The force that a model lacks: seen in time, found at a port, named by the laws it follows."""
