"""A process of its own for every FMU: what it crashes, blocks or prints is not the twin's."""
