"""FMUs that fly beside the wing: the damage that grows, and the gauges that read its strains."""
