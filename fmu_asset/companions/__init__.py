"""FMUs that are coupled to a wing: damage that grows, and gauges that read strains."""

COMPANION_NAMES = ("damage_growth", "strain_gauges")
"""The names of the companions; `fmu_asset.companions.build` packs them."""
