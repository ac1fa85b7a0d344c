"""Kinds of finite elements, and what is assembled on cells of one kind."""
