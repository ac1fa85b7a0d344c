"""Learning of what does not change in time, as an axis of the belief or by regression."""
