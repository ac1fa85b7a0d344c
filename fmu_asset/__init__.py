"""The FMUs: the slave, its build and check, and the one door to any FMU."""
