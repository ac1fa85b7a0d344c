"""Models of a campaign as linear systems with laws at ports, behind one interface, and their sensors."""
