"""The wing by finite elements: design, mesh, operators, responses and the reduced model."""
