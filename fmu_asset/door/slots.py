"""One input of a binding: where its values go, and which of them are refused."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from fmu_asset.archive.declared import VariableInfo
from fmu_asset.errors import FmuInputError

from .units import Conversion


class Slot(NamedTuple):
    """Where an input goes: positions in the request block, range in the FMU's unit, conversion."""

    position: int
    positions: Sequence[int]
    low: float
    high: float
    conversion: Conversion
    label: str
    whole: bool
    direct: bool
    variable: VariableInfo


def checked(slot: Slot, value: float) -> float:
    """Return the value in the FMU's unit, refused if it is not finite, not whole or out of range."""
    try:
        number = slot.conversion.to_fmu(float(value))
    except (TypeError, ValueError) as error:
        raise FmuInputError(f"{slot.label} must be a number, but is {value!r}.") from error
    if slot.low <= number <= slot.high and not slot.whole and number - number == 0.0:
        return number
    if not math.isfinite(number):
        raise FmuInputError(f"{slot.label} must be finite, but is {value!r}; nothing was sent to the FMU.")
    if slot.whole and not number.is_integer():
        raise FmuInputError(
            f"{slot.label} must be a whole number, but is {value!r}; nothing was sent to the FMU."
        )
    # A conversion of units may round a value at the edge of the range to just outside of it.
    inside = min(max(number, slot.low), slot.high)
    if abs(inside - number) > 1e-12 * max(abs(inside), 1.0):
        raise FmuInputError(
            f"{slot.label} = {value!r} lies outside the range of {slot.variable.name!r}, {slot.low:g} to "
            f"{slot.high:g}{in_unit(slot.variable)}; nothing was sent to the FMU."
        )
    return inside


def put(target: Any, slot: Slot, given: float | Sequence[float]) -> None:
    """Put one value, or as many as the slot takes, where they belong."""
    if len(slot.positions) == 1:
        if not isinstance(given, float | int | str) and np.size(given) == 1:
            given = float(np.ravel(given)[0])
        target[slot.position] = checked(slot, given)  # type: ignore[arg-type]
        return
    if np.ndim(given) == 0 or len(np.ravel(given)) != len(slot.positions):
        count = 1 if np.ndim(given) == 0 else len(np.ravel(given))
        raise FmuInputError(f"{slot.label} takes {len(slot.positions)} values, but {count} came.")
    values = [checked(slot, value) for value in np.ravel(given).tolist()]
    for position, value in zip(slot.positions, values, strict=True):
        target[position] = value


def value_range(variable: VariableInfo) -> tuple[float, float]:
    """Return the declared range, within that of the type: C would wrap what does not fit."""
    low, high = -math.inf, math.inf
    if variable.kind == "Boolean":
        low, high = 0.0, 1.0
    elif variable.kind in ("Integer", "Enumeration"):
        low, high = -(2.0**31), 2.0**31 - 1.0
    elif variable.kind.startswith("Int"):
        low, high = -(2.0 ** (int(variable.kind[3:]) - 1)), 2.0 ** (int(variable.kind[3:]) - 1) - 1.0
    elif variable.kind.startswith("UInt"):
        low, high = 0.0, 2.0 ** int(variable.kind[4:]) - 1.0
    if variable.minimum is not None:
        low = max(low, variable.minimum)
    if variable.maximum is not None:
        high = min(high, variable.maximum)
    return low, high


def in_unit(variable: VariableInfo) -> str:
    """Return the unit of a variable with a blank before it, for a sentence; nothing if it has none."""
    return "" if variable.unit in (None, "1") else f" {variable.unit}"
