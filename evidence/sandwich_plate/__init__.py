"""A second idealisation of the wing, a shear-flexible sandwich plate, beside the box."""
