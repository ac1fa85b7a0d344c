"""The report of an investigation: one page for a review board, its figures and its sentences."""
