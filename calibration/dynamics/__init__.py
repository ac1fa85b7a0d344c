"""Calibration step 3: ring-downs, masses and damping."""
