"""Calibration step 2: stiffness from load tests."""
