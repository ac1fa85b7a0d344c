"""Many twins: ensembles of one scenario, fleets of assets, and what is learnt across them."""
