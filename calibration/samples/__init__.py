"""What every calibration leaves: samples of named figures, their file and their moments."""
