"""Where simulation and measured data disagree: locate, name, add, prove."""
