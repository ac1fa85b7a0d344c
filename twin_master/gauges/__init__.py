"""The watch over the gauges of a twin: faults as hypotheses, useless readings, notices."""
