"""The one policy for random numbers: a `SeedSequence` per run, spawned by purpose.

A purpose keeps its stream whatever the others use, so that the same damage meets other noise, or the other
way round, and so that an interrupted run draws nothing twice.
"""

import numpy as np

PURPOSES = ("damage", "noise", "calibration", "asset", "population", "inspection", "planning")
"""Purposes in the order of their spawn keys; new ones are appended."""


def seed_sequence(seed: int, purpose: str) -> np.random.SeedSequence:
    """Return the seed sequence of a purpose of a run.

    Parameters
    ----------
    seed
        Seed of the run.
    purpose
        One of `PURPOSES`.
    """
    return np.random.SeedSequence(seed, spawn_key=(PURPOSES.index(purpose),))


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return a generator for a purpose of a run."""
    return np.random.default_rng(seed_sequence(seed, purpose))
