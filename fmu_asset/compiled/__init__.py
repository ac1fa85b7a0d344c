"""A wing or structure as a compiled FMU: its C sources, and the files made of its model."""
