"""The wing as a compiled FMU: the reduced model evaluated in C, with its sources inside the FMU."""
