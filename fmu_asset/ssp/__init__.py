"""Systems of FMUs as SSP 1.0 files (System Structure and Parameterization): in and out."""
