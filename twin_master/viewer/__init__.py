"""The page that shows a flight while it goes on, and replays it."""
