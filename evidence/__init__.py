"""Where numbers come from that are shipped: what repeats how they were found, and is not shipped itself."""
