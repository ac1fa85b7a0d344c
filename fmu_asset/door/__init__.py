"""The one door to any FMU: bindings, what is sent and read."""
