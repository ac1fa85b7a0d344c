"""The observations of a group in the store of a fleet, read by blocks of twins."""

from collections.abc import Iterator
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from reporting.arrays import Float, Index
from twin_master.fleet.store_layout import BLOCK_TWINS, observation_rows, stored_values
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr


class ObservedTwins(NamedTuple):
    """The observations of some twins of one scenario in T steps.

    Attributes
    ----------
    observed : (B, T, G + I) array
        The readings of sensors and inspections in SI units; NaN where there is none.
    control : (B, T) array
        The control in force in each step.
    """

    observed: Float
    control: Index


class StoredObservations:
    """The observations of a group in the store, read by blocks of twins.

    A fleet may have more observations than fit in memory. The last block is kept, because the twins
    of a block may have scenarios of their own.
    """

    def __init__(self, group: "xr.DataTree", scenario: Scenario) -> None:
        self._group = group
        self._scenario = scenario
        self._block = lru_cache(maxsize=1)(self._read_block)

    def blocks(self, rows: Index) -> Iterator[ObservedTwins]:
        """Yield the observations of the twins in the rows of the store (B,), in ascending order."""
        for number in np.unique(rows // BLOCK_TWINS).tolist():
            rows_of_block = rows[rows // BLOCK_TWINS == number] - number * BLOCK_TWINS
            observed, control = self._block(number)
            yield ObservedTwins(observed[rows_of_block], control[rows_of_block])

    def _read_block(self, number: int) -> ObservedTwins:
        """Return the observations of all twins of a block."""
        rows = slice(number * BLOCK_TWINS, (number + 1) * BLOCK_TWINS)
        control = stored_values(self._group, "observed/control_index", rows).astype(np.int64)
        # Steps that were not flown have the control -1. They have no observations, so that the
        # evidence does not depend on their control: the first control takes its place.
        return ObservedTwins(
            observation_rows(self._group, self._scenario, rows), np.maximum(control, 0)
        )
