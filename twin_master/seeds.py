"""The random numbers of a run: one `SeedSequence`, from which each purpose spawns its own.

The numbers of a purpose do not depend on how many other purposes draw. So the same damage can be
combined with other noise, and a resumed run draws the same numbers.
"""

import numpy as np

PURPOSES = ("damage", "noise", "calibration", "asset", "population", "inspection", "planning")
"""The purposes, in the order of their spawn keys; a new one is appended."""


def seed_sequence(seed: int, purpose: str) -> np.random.SeedSequence:
    """Return the seed sequence of one of the `PURPOSES` of a run."""
    spawn_key = PURPOSES.index(purpose)
    return np.random.SeedSequence(seed, spawn_key=(spawn_key,))


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return a generator of random numbers for one of the `PURPOSES` of a run."""
    return np.random.default_rng(seed_sequence(seed, purpose))
