"""Watching a real asset: its observations come from files, standard input or a broker."""
