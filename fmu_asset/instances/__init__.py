"""One instance of an FMU in this process, for each FMI version and interface."""
