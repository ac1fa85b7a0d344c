"""What every calibration leaves: samples of named figures, their file, their page and their folder."""
