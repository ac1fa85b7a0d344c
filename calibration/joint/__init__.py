"""The joint posterior of a wing: load test, weighed masses and ring-down together."""
