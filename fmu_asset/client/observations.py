"""Outputs of an asset: one observation after a step, and their history over many steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from reporting.arrays import Float

from .units import IDENTITY, Conversion


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


class OutputTable:
    """The outputs that are read from a reply block: first the observations, then the extras.

    Parameters
    ----------
    observation_count : int
        Number of observations.
    extra_names : sequence of str
        Names of the extras.
    positions : sequence of int
        Position of each output in the block.
    conversions : sequence of Conversion
        Conversion of each output from the binding's unit to the FMU's.
    """

    def __init__(
        self,
        observation_count: int,
        extra_names: Sequence[str],
        positions: Sequence[int],
        conversions: Sequence[Conversion],
    ) -> None:
        self._observation_count = observation_count
        self._extra_names = tuple(extra_names)
        self._index = _slice_or_index(positions)
        self._needs_conversion = any(entry != IDENTITY for entry in conversions)
        self._factors = np.array([entry.factor for entry in conversions], dtype=np.float64)
        self._offsets = np.array([entry.offset for entry in conversions], dtype=np.float64)

    def _converted(self, values: Float) -> Float:
        """Return values in the binding's units; always a copy."""
        if not self._needs_conversion:
            return values.copy()
        converted: Float = (values - self._offsets) / self._factors
        return converted

    def observation(self, block: Float, time: float) -> Observation:
        """Return the observation in a reply block (n_outputs,) at a time [s]."""
        values = self._converted(block[self._index])
        extra_values = values[self._observation_count :].tolist()
        # The lengths are equal by construction; checking them would double the time of this line.
        extra_outputs = dict(zip(self._extra_names, extra_values))  # noqa: B905
        return Observation(values[: self._observation_count], time, extra_outputs)

    def history(self, time: Float, blocks: Float, ended: str = "") -> ObservationHistory:
        """Return the history in reply blocks.

        Parameters
        ----------
        time : (N,) ndarray
            Time of each block [s].
        blocks : (N, n_outputs) ndarray
            The blocks.
        ended : str
            How the FMU ended the simulation by itself, if it did.
        """
        values = self._converted(blocks[:, self._index])
        observed_values = np.ascontiguousarray(values[:, : self._observation_count])
        extra_values = np.ascontiguousarray(values[:, self._observation_count :].T)
        extra_histories = dict(zip(self._extra_names, extra_values, strict=True))
        return ObservationHistory(time, observed_values, extra_histories, ended)


def _slice_or_index(
    positions: Sequence[int],
) -> "slice | np.ndarray[tuple[int], np.dtype[np.intp]]":
    """Return positions as a slice if they follow one another, which is faster, else as an array."""
    index = np.array(positions, dtype=np.intp)
    first = int(index[0]) if len(index) else 0
    end = first + len(index)
    if np.array_equal(index, np.arange(first, end)):
        return slice(first, end)
    return index
