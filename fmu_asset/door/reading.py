"""Values picked from blocks of outputs, in the units of a binding."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

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

    values: npt.NDArray[np.float64]
    time: float
    extra: dict[str, float]


class Selection:
    """Some values of a block of outputs.

    Parameters
    ----------
    positions : sequence of int
        Where they stand in the block.
    conversions : sequence of Conversion
        From the binding's units to the FMU's, one for each.
    """

    def __init__(self, positions: Sequence[int], conversions: Sequence[Conversion]) -> None:
        index = np.array(positions, dtype=np.intp)
        together = len(index) > 0 and np.array_equal(index, np.arange(index[0], index[0] + len(index)))
        self._index = slice(int(index[0]), int(index[0]) + len(index)) if together else index
        self._scale = (
            None
            if all(item == IDENTITY for item in conversions)
            else (np.array([item.factor for item in conversions]), np.array([i.offset for i in conversions]))
        )

    def of(self, blocks: Floats) -> Floats:
        """Return the values in the binding's units; never a view.

        Parameters
        ----------
        blocks : (..., n_outputs) ndarray
            One block, or one in each row.

        Returns
        -------
        (..., n) ndarray
            The values of each block.
        """
        values: Floats = blocks[..., self._index]
        if self._scale is None:
            return values.copy() if isinstance(self._index, slice) else values
        factor, offset = self._scale
        converted: Floats = (values - offset) / factor
        return converted

    def reader(self, block: Floats) -> Callable[[], Floats]:
        """Return a function that returns what `of` returns for the block as it is then."""
        if self._scale is None and isinstance(self._index, slice):
            return block[self._index].copy
        return lambda: self.of(block)

    def list_reader(self, block: Floats) -> Callable[[], list[float]]:
        """Return a function like that of `reader`, which returns a list."""
        if self._scale is None and isinstance(self._index, slice):
            return cast("Callable[[], list[float]]", block.data[self._index].tolist)
        return lambda: self.of(block).tolist()


class OutputTable(NamedTuple):
    """What is read of a block of outputs.

    Attributes
    ----------
    observed : Selection
        The observations in the order of the binding.
    extra_names : tuple of str
        Names of monitors, records and outputs of ports.
    extra : Selection
        Their values.
    """

    observed: Selection
    extra_names: tuple[str, ...]
    extra: Selection


class Reader:
    """Observations out of one block of outputs, which every step fills anew.

    Parameters
    ----------
    table : OutputTable
        What is read.
    block : (n_outputs,) ndarray
        The block.
    """

    def __init__(self, table: OutputTable, block: Floats) -> None:
        self._names = table.extra_names
        self._values, self._extra = table.observed.reader(block), table.extra.list_reader(block)
        self._dot, self._block = block.dot, block

    def suspicious(self) -> bool:
        """Return whether the block may hold a value that is not finite; a large one can raise it as well."""
        return not math.isfinite(self._dot(self._block))

    def read(self, time: float) -> Observation:
        """Return the observation of this moment."""
        # Both are of one table; to compare their lengths would take as long as the rest of the line.
        extra = dict(zip(self._names, self._extra()))  # noqa: B905
        return Observation(self._values(), time, extra)
