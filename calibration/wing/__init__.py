"""The whole calibration of one wing: its record, file and report."""
