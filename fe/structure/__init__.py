"""A structure of any shape: one TOML file beside a mesh, checked, as affine operators with names."""
