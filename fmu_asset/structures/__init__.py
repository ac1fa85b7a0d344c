"""A structure as an FMU: its table of variables, its behaviour, its packing and its binding."""
