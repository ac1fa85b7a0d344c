"""What comes out of steps: values picked from blocks of outputs, in the units of a binding."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .units import IDENTITY, Conversion

Floats = npt.NDArray[np.float64]


class Observation(NamedTuple):
    """What came out of one communication step.

    Attributes
    ----------
    values : (n_obs,) ndarray
        The observations of the binding in their order and units.
    time : float
        Time at the end of the step [s]: start + i * interval.
    extra : dict of str to float
        Monitors, recorded variables and outputs of ports.
    """

    values: Floats
    time: float
    extra: dict[str, float]


@dataclass(frozen=True)
class ObservationHistory:
    """What came out of N steps.

    Attributes
    ----------
    time : (N,) ndarray
        Time at the end of each step [s].
    values : (N, n_obs) ndarray
        The observations of the binding in their order and units.
    extra : dict of str to (N,) ndarray
        Monitors, recorded variables and outputs of ports.
    ended : str
        What the FMU did if it ended the simulation by itself: fewer steps were made then than were asked
        for, and the last time is where it ended, within a step perhaps.
    """

    time: Floats
    values: Floats
    extra: dict[str, Floats]
    ended: str = ""


class OutputTable:
    """What is read of a block of outputs: first what is observed, then the extras.

    Parameters
    ----------
    observed : int
        How many are observed.
    extra : sequence of str
        Names of the extras.
    positions : sequence of int
        Where all of them stand in the block.
    conversions : sequence of Conversion
        From the binding's units to the FMU's, one for each.
    """

    def __init__(
        self, observed: int, extra: Sequence[str], positions: Sequence[int], conversions: Sequence[Conversion]
    ) -> None:
        self._observed, self._extra = observed, tuple(extra)
        index = np.array(positions, dtype=np.intp)
        first = int(index[0]) if len(index) else 0
        together = np.array_equal(index, np.arange(first, first + len(index)))
        self._index = slice(first, first + len(index)) if together else index
        scales = np.array(conversions).reshape(-1, 2).T
        self._scale = None if all(item == IDENTITY for item in conversions) else scales

    def _converted(self, values: Floats) -> Floats:
        """Return values in the binding's units; never a view."""
        if self._scale is None:
            return values.copy()
        factor, offset = self._scale
        converted: Floats = (values - offset) / factor
        return converted

    def observation(self, block: Floats, time: float) -> Observation:
        """Return what a block (n_outputs,) of a moment [s] holds."""
        values = self._converted(block[self._index])
        # Both are of one table; to compare their lengths would take as long as the rest of the line.
        extra = dict(zip(self._extra, values[self._observed :].tolist()))  # noqa: B905
        return Observation(values[: self._observed], time, extra)

    def history(self, time: Floats, blocks: Floats, ended: str = "") -> ObservationHistory:
        """Return what the blocks (N, n_outputs) of moments (N,) [s] hold; `ended` as in the history."""
        values = self._converted(blocks[:, self._index])
        extra = np.ascontiguousarray(values[:, self._observed :].T)
        observed = np.ascontiguousarray(values[:, : self._observed])
        return ObservationHistory(time, observed, dict(zip(self._extra, extra, strict=True)), ended)
