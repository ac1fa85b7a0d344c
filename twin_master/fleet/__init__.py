"""Many twins: ensembles of one scenario, fleets of assets, and learning across assets."""
