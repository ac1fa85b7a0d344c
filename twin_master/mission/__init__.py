"""The loop: plant, truth, twin, checkpoint."""
