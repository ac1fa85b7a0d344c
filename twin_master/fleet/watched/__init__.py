"""Fleets of real assets, watched together."""
