"""Learning of what does not change in time, and the watch over gauges and model."""
