"""The joint estimate of motion, missing force and unknowns, and the effects that explain most."""
