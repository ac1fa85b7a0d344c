"""The report of a run: a page with figures and tables, made from the run folder."""
