"""What was measured: records, files, units, noise, and what is held out."""
