"""Many steps under prescribed inputs: the histories checked as a whole, and what comes out of them."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fmu_asset.errors import FmuInputError
from fmu_asset.instances.series import Series

from .exchange import Exchange
from .reading import OutputTable
from .slots import Slot, checked
from .units import IDENTITY

Histories = Mapping[str, npt.ArrayLike]
"""Inputs by the binding's names: a number for all steps, or one for each; (n,) or (N, n) for an array."""

_BLOCK_BYTES = 2**20


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

    time: npt.NDArray[np.float64]
    values: npt.NDArray[np.float64]
    extra: dict[str, npt.NDArray[np.float64]]
    ended: str = ""

    @classmethod
    def of(
        cls,
        table: OutputTable,
        time: npt.NDArray[np.float64],
        replies: npt.NDArray[np.float64],
        ended: str = "",
    ) -> "ObservationHistory":
        """Return what the reply blocks of N steps hold.

        Parameters
        ----------
        table : OutputTable
            What is read of a reply block.
        time : (N,) ndarray
            Time at the end of each step [s].
        replies : (N, n_outputs) ndarray
            The reply blocks.
        ended : str
            What the FMU did if it ended the simulation by itself.
        """
        extra = np.ascontiguousarray(table.extra.of(replies).T)
        return cls(time, table.observed.of(replies), dict(zip(table.extra_names, extra, strict=True)), ended)


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
    arrays = [(slot, _numbers(slot, values)) for slot, values in given]
    count, source = steps, "`steps`"
    if count is not None and (count := operator.index(count)) < 1:
        raise FmuInputError(f"steps must be at least 1, but is {count}.")
    for slot, array in arrays:
        if array.ndim > (len(slot.positions) != 1):
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
        _fill(rows, slot, array)
    return rows


def _numbers(slot: Slot, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise FmuInputError(f"{slot.label} must be numbers ({error}).") from error
    count = len(slot.positions)
    if count == 1 and array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim > 1 + (count != 1) or (count != 1 and (array.ndim == 0 or array.shape[-1] != count)):
        wanted = (
            "a number, or one for each step" if count == 1 else f"{count} values, or as many for each step"
        )
        raise FmuInputError(f"{slot.label} must be {wanted}, but has the shape {array.shape}.")
    return array


def _fill(rows: npt.NDArray[np.float64], slot: Slot, array: npt.NDArray[np.float64]) -> None:
    """Put a history into its columns; what is not plainly in range is looked at one by one, as in a step."""
    per_step = array.ndim > (len(slot.positions) != 1)
    values = array if per_step else array[np.newaxis]
    values = values.reshape(len(values), len(slot.positions))
    with np.errstate(all="ignore"):
        # The arithmetic of `Conversion.to_fmu`: the bits are those of a step.
        scale = slot.conversion
        numbers = values.copy() if scale == IDENTITY else scale.factor * values + scale.offset
        plain = (slot.low <= numbers) & (numbers <= slot.high) & np.isfinite(numbers)
        if slot.whole:
            plain &= numbers == np.floor(numbers)
    for step, element in np.argwhere(~plain).tolist():
        try:
            numbers[step, element] = checked(slot, values.item(step, element))
        except FmuInputError as error:
            where = f" It is the value of step {step} of the {len(rows)}." if per_step else ""
            raise FmuInputError(f"{error.sentence}{where}") from error
    rows[:, list(slot.positions)] = numbers


def blocks(requests: npt.NDArray[np.float64], replies: npt.NDArray[np.float64]) -> Sequence[Series]:
    """Return the steps in blocks of a size that is sent in one message."""
    length = max(1, _BLOCK_BYTES // max(requests[0].nbytes, replies[0].nbytes))
    return [
        Series(requests[begin : begin + length], replies[begin : begin + length])
        for begin in range(0, len(requests), length)
    ]
