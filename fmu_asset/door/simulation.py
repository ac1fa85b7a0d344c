"""Many steps under histories that are checked as a whole."""

import operator
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from fmu_asset.errors import FmuInputError

from .exchange import Exchange

Histories = Mapping[str, npt.ArrayLike]
"""Inputs by the binding's names: a number for all steps, or one for each; (n,) or (N, n) for an array."""


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
