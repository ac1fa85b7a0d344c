"""Rigs that others measured and published in repositories, beside those that the package converts."""
