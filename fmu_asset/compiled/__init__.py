"""A wing or structure as a compiled FMU: the reduced model evaluated in C, its sources inside the FMU."""
