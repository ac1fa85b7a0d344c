"""Everything that is evaluated online, with NumPy alone: this folder goes into the FMU as a whole."""
