"""The report of a run: its data, one file for each group of figures, and the page that holds them."""
