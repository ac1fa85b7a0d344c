"""Campaigns from elsewhere: examples, simulations, runs, the published wing."""
