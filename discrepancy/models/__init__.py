"""Models that a campaign can be compared with, behind one interface."""
