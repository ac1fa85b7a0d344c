"""What a caller gives an asset: values and histories by the binding's names."""

from collections.abc import Mapping, Sequence
from typing import TypedDict

import numpy as np
import numpy.typing as npt

Values = Mapping[str, float | str | Sequence[float] | Sequence[str]]
"""Values by the binding's names: a number, or as many as the bound array or port has.

The value of an enumeration may be the name of its item; that of a parameter that is a text is the text.
"""

Histories = Mapping[str, npt.ArrayLike]
"""Inputs by the binding's names: a number for all steps, or one for each; (n,) or (N, n) for an array."""


class Inputs(TypedDict, total=False):
    """Inputs by role; those of a port are called `<port>.<quantity>`."""

    control: Values | None
    health: Values | None
    load: Values | None
    port: Values | None


def check_roles(inputs: Inputs) -> None:
    """Refuse a misspelt keyword, which would pass where it stands for nothing; raises `TypeError`."""
    for role in inputs:
        if role not in Inputs.__annotations__:
            raise TypeError(f"Inputs are {', '.join(Inputs.__annotations__)}, and {role!r} came.")


PlainValue = float | str | list[float] | list[str]


def plain_values(values: Values) -> dict[str, PlainValue]:
    """Return values as floats, texts and lists of them in the order of their names, to be kept as JSON."""
    return {name: _plain_value(value) for name, value in sorted(values.items())}


def _plain_value(value: float | str | Sequence[float] | Sequence[str]) -> PlainValue:
    array = np.asarray(value)
    if array.dtype.kind != "U":
        array = np.asarray(value, dtype=np.float64)
    plain: PlainValue = array.item() if array.ndim == 0 else array.ravel().tolist()
    return plain
