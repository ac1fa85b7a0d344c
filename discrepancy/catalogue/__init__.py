"""Named physical effects and the patches of primitives that they stand for."""
