"""Arrays with a row for each twin: their layout, address, writing and reading."""
