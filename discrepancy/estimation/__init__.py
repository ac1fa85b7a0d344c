"""Trajectory, missing force and parameters of a hypothesis, estimated together."""
