"""Lab experiments to the posterior of the digital state."""
