"""The result of every calibration: samples of named figures, file, page and folder."""
