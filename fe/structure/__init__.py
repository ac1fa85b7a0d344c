"""A structure of any shape, from one TOML file beside a mesh or matrices, as affine operators."""
