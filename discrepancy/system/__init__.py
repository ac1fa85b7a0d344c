"""Models of a campaign: one interface, linear systems with laws at ports, and sensors."""
