"""FMUs that fly beside the wing: the damage that grows, and the gauges that read its strains."""

COMPANION_NAMES = ("damage_growth", "strain_gauges")
"""What can be packed; see `fmu_asset.companions.build`."""
