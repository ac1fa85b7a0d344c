"""The wing: design, mesh, operators, responses, and the reduced model."""
