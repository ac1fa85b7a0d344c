"""Assets that are shipped as scripts: models in Python that `uav-twin` packs as FMUs."""
