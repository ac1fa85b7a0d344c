"""Shipped structures from meshes: structure files, meshes, and the script that makes them."""
