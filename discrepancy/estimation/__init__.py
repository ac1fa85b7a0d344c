"""The joint estimate of trajectory, missing force and unknowns of a hypothesis."""
