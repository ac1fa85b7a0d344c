"""FMUs: ours are built and checked here, and any FMU is run through one client."""
