"""What is stepped: one FMU or several, and many steps under histories that are checked as a whole."""

import operator
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Literal, Self, Unpack

import numpy as np
import numpy.typing as npt

from fmu_asset.errors import FmuInputError
from fmu_asset.instances.series import Series
from reporting.progress import Progress

from .binding import Binding
from .exchange import Exchange, Inputs, Values
from .reading import Observation, ObservationHistory

Histories = Mapping[str, npt.ArrayLike]
"""Inputs by the binding's names: a number for all steps, or one for each; (n,) or (N, n) for an array."""

_BLOCK_BYTES = 2**20


def request_rows(
    exchange: Exchange,
    held: npt.NDArray[np.float64],
    roles: Mapping[str, Histories | None],
    steps: int | None,
) -> npt.NDArray[np.float64]:
    """Return the request blocks of all steps, without their times.

    Parameters
    ----------
    exchange : Exchange
        Of the asset.
    held : (2 + n_inputs,) ndarray
        The last request: what is not given keeps its value.
    roles : mapping of str to mapping
        Inputs by role, then by name.
    steps : int, optional
        Number of steps N; that of the histories if absent.

    Returns
    -------
    (N, 2 + n_inputs) ndarray
        In the FMU's units.

    Raises
    ------
    BindingError
        If a name is not in the binding.
    FmuInputError
        If a value is no number, not finite or out of range, or the histories have different lengths.
    """
    given = [
        (exchange.slot(role, name), values)
        for role, histories in roles.items()
        for name, values in (histories or {}).items()
    ]
    arrays = [(slot, slot.numbers(values, history=True)) for slot, values in given]
    count, source = steps, "`steps`"
    if count is not None and (count := operator.index(count)) < 1:
        raise FmuInputError(f"steps must be at least 1, but is {count}.")
    for slot, array in arrays:
        if array.ndim == 2:
            if count is None:
                count, source = len(array), slot.label
            elif len(array) != count:
                raise FmuInputError(
                    f"{slot.label} has {len(array)} steps, but {source} says {count}; give as many of each."
                )
    if not count:
        raise FmuInputError("Nothing says how many steps to make: give `steps`, or a history of an input.")
    rows = np.tile(held, (count, 1))
    for slot, array in arrays:
        rows[:, list(slot.positions)] = array
    return rows


def blocks(requests: npt.NDArray[np.float64], replies: npt.NDArray[np.float64]) -> Sequence[Series]:
    """Return the steps in blocks of a size that is sent in one message."""
    length = max(1, _BLOCK_BYTES // max(requests[0].nbytes, replies[0].nbytes))
    return [
        Series(requests[begin : begin + length], replies[begin : begin + length])
        for begin in range(0, len(requests), length)
    ]


class SteppedAsset(ABC):
    """An asset that is stepped through a binding, and opened by `with` or `reset`."""

    def __init__(self, binding: Binding) -> None:
        self._binding = binding
        self._start_time, self._interval = binding.binding.start_time, binding.interval
        self._phase: Literal["new", "ready", "broken", "closed"] = "new"
        self._index = 0

    @property
    def binding(self) -> Binding:
        """The binding; of one FMU, with arrays that are observed or recorded as their elements."""
        return self._binding

    @property
    def time(self) -> float:
        """Time of the asset [s]: start + i * interval, never accumulated."""
        return self._start_time + self._index * self._interval

    @property
    def step_index(self) -> int:
        """Number of steps since the last reset."""
        return self._index

    @property
    @abstractmethod
    def recorded_units(self) -> dict[str, str]:
        """Units of `Observation.extra` by name."""

    @abstractmethod
    def reset(self, parameters: Values | None = None, **inputs: Unpack[Inputs]) -> None:
        """Go back to the start."""

    @abstractmethod
    def observe(self) -> Observation:
        """Return the observation of this moment without a step."""

    @abstractmethod
    def simulate(self, *, steps: int | None = None, progress: Progress | None = None) -> ObservationHistory:
        """Make many steps from where the asset is, its inputs held."""

    @abstractmethod
    def close(self) -> None:
        """End what runs; the asset can be opened again by `reset`."""

    def __enter__(self) -> Self:
        if self._phase != "ready":
            self.reset()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
