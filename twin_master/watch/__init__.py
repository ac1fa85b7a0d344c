"""Watching a real asset: observations from files, standard input or a broker, one loop with missions."""
