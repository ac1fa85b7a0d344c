"""One input of a binding: where its values go, and which of them are refused."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.instances.plan import Settings

from .binding import Binding
from .layout import find
from .units import IDENTITY, Conversion


class Slot(NamedTuple):
    """Where an input goes: positions in the request block, range in the FMU's unit, conversion."""

    label: str
    positions: Sequence[int]
    low: float
    high: float
    conversion: Conversion
    variable: VariableInfo

    @property
    def whole(self) -> bool:
        """Whether it takes whole numbers only."""
        return self.variable.kind not in FLOAT_KINDS


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
        target[slot.positions[0]] = checked(slot, given)  # type: ignore[arg-type]
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


def configured(description: FmuDescription, binding: Binding) -> tuple[FmuDescription, Settings]:
    """Return what an FMU declares with the structural parameters of a binding, and what is set for them.

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter, or is run by model exchange.
    FmuInputError
        If a value is no whole number or out of range, or makes an array too large.
    """
    found: Settings = []
    lengths: dict[str | None, int] = {}
    for name, value in binding.binding.structural_parameters.items():
        label = f"structural_parameters.{name}"
        where = f"{label} of the binding {binding.name}"
        variable = find(description, name, where, "structuralParameter").variable
        number = [0.0]
        put(number, Slot(label, (0,), *value_range(variable), IDENTITY, variable), value)
        found.append((variable.kind, variable.reference, number))
        lengths[name] = int(number[0])
    if not lengths:
        return description, found
    if description.interface == "model-exchange":
        raise BindingError(
            f"{description.path} is run by model exchange; structural parameters are set in co-simulation "
            "only."
        )
    return replace(description, variables=tuple(v.resized(lengths) for v in description.variables)), found
