"""Types of what a caller gives an asset: values and histories by the binding's names."""

from collections.abc import Mapping, Sequence
from typing import TypedDict, cast

import numpy as np
import numpy.typing as npt

Value = float | str | Sequence[float] | Sequence[str]
"""A number, or as many as the bound array or port has.

The value of an enumeration may be the name of its item, and that of a text parameter is a text.
"""

Values = Mapping[str, Value]
"""Values by the binding's names."""

Histories = Mapping[str, npt.ArrayLike]
"""Inputs by the binding's names: a number for all N steps, or (N,); for arrays (n,) or (N, n)."""

InputsByRole = Mapping[str, Mapping[str, npt.ArrayLike] | None]
"""Values, or histories, of inputs by role and name."""


class Inputs(TypedDict, total=False):
    """Inputs by role; those of a port are called `<port>.<quantity>`."""

    control: Values | None
    health: Values | None
    load: Values | None
    port: Values | None


def inputs_by_role(inputs: Inputs) -> InputsByRole:
    """Return keyword arguments as inputs by role; a misspelt role raises an error.

    Raises
    ------
    TypeError
        If a role is unknown.
    """
    roles = Inputs.__annotations__
    for role in inputs:
        if role not in roles:
            raise TypeError(f"The inputs are {', '.join(roles)}, but {role!r} was given.")
    return cast("InputsByRole", inputs)


PlainValue = float | str | list[float] | list[str]
"""A value as JSON holds it."""


def plain_values(values: Mapping[str, npt.ArrayLike]) -> dict[str, PlainValue]:
    """Return values sorted by name, as floats, texts and lists of these, to be kept as JSON."""
    return {name: _plain_value(value) for name, value in sorted(values.items())}


def _plain_value(value: npt.ArrayLike) -> PlainValue:
    array = np.asarray(value)
    if array.dtype.kind != "U":
        array = np.asarray(value, dtype=np.float64)
    plain_value: PlainValue = array.item() if array.ndim == 0 else array.ravel().tolist()
    return plain_value
