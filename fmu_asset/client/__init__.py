"""The client of any FMU: `FmiAsset`, bindings, units, runs and states."""
