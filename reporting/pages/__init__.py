"""Pages, figures and tables as people see them."""
