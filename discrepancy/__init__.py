"""Where simulation and measured data disagree: locate, name, add, prove (Kapteyn et al. 2021, extended)."""
