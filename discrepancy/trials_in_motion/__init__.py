"""Trials in motion as linear systems with ports, and the laws of a hypothesis along them."""
