"""What is evaluated online, with NumPy alone: this folder goes into a Python FMU as a whole."""
