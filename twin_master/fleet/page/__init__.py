"""The page of a fleet, and its server."""
