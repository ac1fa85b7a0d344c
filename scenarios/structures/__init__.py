"""Structures from meshes that are shipped: structure files, meshes, and the script that makes these."""
