"""The hypothesis that nothing is missing: the posterior of a model's parameters under a campaign."""
