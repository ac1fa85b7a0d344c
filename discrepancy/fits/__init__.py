"""A candidate explanation against a campaign: residuals, screen, maximum, evidence, draws, gates."""
