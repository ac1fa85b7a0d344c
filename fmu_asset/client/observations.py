"""Outputs of an asset: one observation after a step, and their history over many steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float


class Observation(NamedTuple):
    """Outputs after one communication step.

    Attributes
    ----------
    values : (n_obs,) ndarray
        The observations of the binding in their order and units.
    time : float
        Time at the end of the step [s]: start + i * interval.
    extra : dict of str to float
        Monitors, recorded variables and outputs of ports.
    """

    values: Float
    time: float
    extra: dict[str, float]


@dataclass(frozen=True)
class ObservationHistory:
    """Outputs after each of N steps.

    Attributes
    ----------
    time : (N,) ndarray
        Time at the end of each step [s].
    values : (N, n_obs) ndarray
        The observations of the binding in their order and units.
    extra : dict of str to (N,) ndarray
        Monitors, recorded variables and outputs of ports.
    ended : str
        How the FMU ended the simulation by itself; empty if it did not. Then fewer steps were made
        than were asked for, and the last time is the end, perhaps within a step.
    """

    time: Float
    values: Float
    extra: dict[str, Float]
    ended: str = ""


def joined_histories(parts: Sequence[ObservationHistory]) -> ObservationHistory:
    """Return one history from histories of consecutive steps."""
    extra_histories = {}
    for name in parts[0].extra:
        extra_histories[name] = np.concatenate([part.extra[name] for part in parts])
    return ObservationHistory(
        time=np.concatenate([part.time for part in parts]),
        values=np.vstack([part.values for part in parts]),
        extra=extra_histories,
        ended=parts[-1].ended,
    )
