"""A candidate explanation against a campaign.

Residuals, screen, maximum, evidence, draws, gates.
"""
