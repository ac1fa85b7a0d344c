"""Where simulation and data disagree: reserved for a workflow that is not in this version."""
