"""FMUs that fly beside the wing: the damage that grows, and the gauges that read its strains."""

COMPANION_NAMES = ("damage_growth", "strain_gauges")
"""The names of the companions; `fmu_asset.companions.build` packs them."""
