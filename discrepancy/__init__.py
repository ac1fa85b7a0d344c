"""Where simulation and data disagree: reserved for the discrepancy workflow, which this version does not contain."""
