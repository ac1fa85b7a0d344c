"""An FMU file from outside, checked and unpacked."""
