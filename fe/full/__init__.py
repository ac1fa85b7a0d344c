"""Full operators and their solvers."""
