"""The random numbers of a run: one `SeedSequence`, from which each purpose spawns its own.

The stream of a purpose does not depend on what other purposes draw. So the same damage can meet
other noise, and a resumed run meets the same random numbers.
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
