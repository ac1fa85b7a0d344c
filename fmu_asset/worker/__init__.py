"""A process of its own for every FMU, so that it cannot crash, block or deceive the twin."""
