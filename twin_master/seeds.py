"""The one policy for random numbers: a `SeedSequence` per run, spawned by purpose.

A purpose keeps its stream whatever the others use, so that the same damage meets other noise, or the other
way round, and so that an interrupted run draws nothing twice.
"""

from __future__ import annotations

import numpy as np

from twin_master.errors import MissionInputError

LARGEST_SEED = 2**63 - 1
"""What the store can hold; more randomness than this no mission needs."""
PURPOSES = ("damage", "noise", "calibration", "asset")
"""Purposes in the order of their spawn keys; new ones are appended."""


def check_seed(seed: int) -> None:
    """Refuse a seed that could not be stored with the results.

    Raises
    ------
    MissionInputError
        It is negative or too large.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise MissionInputError(
            f"a seed is a whole number from 0 to 2^63 - 1, not {seed:.4g}: choose another one."
        )


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
