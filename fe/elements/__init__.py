"""Kinds of finite elements, and the matrices that are assembled on cells of one kind."""
