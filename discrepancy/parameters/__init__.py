"""The posterior of a model's parameters given a campaign, if the model lacks nothing."""
