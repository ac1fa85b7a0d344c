"""Names of a binding found in an FMU: where their values stand in a block, and which of them are refused."""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from fmu_asset.archive.declared import FLOAT_KINDS, FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuFileError, FmuInputError
from fmu_asset.instances.plan import Group, Settings

from .binding import Binding
from .units import IDENTITY, Conversion

_CAUSALITY: Mapping[str, tuple[str, ...]] = {
    "input": ("input",),
    "parameter": ("parameter",),
    "structuralParameter": ("structuralParameter",),
    "output": ("output", "local", "calculatedParameter", "none"),
}
_ELEMENT = re.compile(r"(.+)\[(\d+(?:,\s*\d+)*)\]", re.DOTALL)
# Reals come first, so that they stand together in the block and need no conversion.
_KIND_ORDER = ("Real", "Float64", "Integer", "Boolean")


class Place(NamedTuple):
    """A variable, and which of its values is meant: one, or all (None)."""

    variable: VariableInfo
    element: int | None

    @property
    def size(self) -> int:
        """Number of values."""
        return self.variable.size if self.element is None else 1


def element_names(variable: VariableInfo) -> tuple[str, ...]:
    """Return the names of the elements of an array, row by row and from 1; the name itself for a scalar."""
    if not variable.shape:
        return (variable.name,)
    ranges = [range(1, length + 1) for length in variable.shape]
    return tuple(f"{variable.name}[{','.join(map(str, index))}]" for index in product(*ranges))


def find(description: FmuDescription, name: str, label: str, causality: str) -> Place:
    """Return what a name of a binding means in an FMU.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    name : str
        A variable, or an element of an array such as `p[3]`.
    label : str
        Place in the binding, for the error.
    causality : {"input", "parameter", "structuralParameter", "output"}
        What it must be; everything that is neither input nor parameter can be read, a tunable parameter can
        be sent at every step like an input (co-simulation), and a start value be set like a parameter.

    Raises
    ------
    BindingError
        If there is none, or one of another causality or type.
    """
    variable, element = description.variable(name), None
    if variable is None:
        variable, element = _element(description, name, label)
    if variable is None:
        near = difflib.get_close_matches(name, [v.name for v in description.variables], 1, 0.6)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        raise BindingError(f"{label} names {name!r}, which is not a variable of {description.path}{hint}")
    sent = (
        causality == "input"
        and (variable.causality, variable.variability) == ("parameter", "tunable")
        and description.interface == "co-simulation"
    )
    started = causality == "parameter" and variable.startable
    if variable.causality not in _CAUSALITY[causality] and not sent and not started:
        raise BindingError(
            f"{label} must be of causality {causality}, but {name!r} is declared as {variable.causality} in "
            f"{description.path}."
        )
    if not variable.numeric:
        raise BindingError(
            f"{label} names {name!r}, which is of type {variable.kind}; only numbers can be bound."
        )
    if variable.clocked:
        raise BindingError(f"{label} names {name!r}, which changes with a clock; clocks are not supported.")
    return Place(variable, element)


def _element(description: FmuDescription, name: str, label: str) -> tuple[VariableInfo | None, int | None]:
    found = _ELEMENT.fullmatch(name)
    variable = description.variable(found.group(1)) if found else None
    if found is None or variable is None or not variable.shape:
        return None, None
    index = [int(number) for number in found.group(2).split(",")]
    fits = len(index) == len(variable.shape) and all(
        1 <= i <= length for i, length in zip(index, variable.shape, strict=True)
    )
    if not fits:
        raise BindingError(
            f"{label} names {name!r}, but {variable.name!r} has {' x '.join(map(str, variable.shape))} "
            "elements, counted from 1."
        )
    return variable, int(np.ravel_multi_index([i - 1 for i in index], variable.shape))


class BlockLayout:
    """Where variables stand in a block: by base type, and within one in the order of the binding.

    An array stands there with all its elements, since FMI 3 sets and reads arrays as a whole.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    variables : sequence of VariableInfo
        What is exchanged; one that is named twice stands there once.
    begin : int
        Position of the first value.
    linear : bool
        Whether continuous ones, which then come first, move in straight lines.

    Attributes
    ----------
    variables : tuple of VariableInfo
        In the order of the block.
    groups : tuple of Group
        The same by base type.
    """

    def __init__(
        self,
        description: FmuDescription,
        variables: Sequence[VariableInfo],
        begin: int,
        *,
        linear: bool = False,
    ) -> None:
        unique = list({variable.name: variable for variable in variables}.values())
        kinds = [
            (
                linear and variable.continuous and variable.causality == "input",
                description.exchange_kind(variable),
            )
            for variable in unique
        ]
        present = sorted({*kinds}, key=lambda kind: (not kind[0], (*_KIND_ORDER, kind[1]).index(kind[1])))
        self._begin = begin
        self._positions: dict[str, int] = {}
        groups, ordered, position = [], [], begin
        for kind in present:
            members = [
                variable for variable, own in zip(unique, kinds, strict=True) if own == kind and variable.size
            ]
            first = position
            for variable in members:
                self._positions[variable.name] = position
                position += variable.size
            ordered += members
            moves, name = kind
            groups.append(Group(name, tuple(m.reference for m in members), position - first, moves))
        self.variables, self.groups = tuple(ordered), tuple(groups)

    def positions(self, place: Place) -> range:
        """Return where the values of a place stand."""
        if not place.size:
            return range(0)
        first = self._positions[place.variable.name] + (place.element or 0)
        return range(first, first + place.size)

    def names(self) -> list[str]:
        """Return the names of all values in the order of the block."""
        return [name for variable in self.variables for name in element_names(variable)]


def start_values(description: FmuDescription, variable: VariableInfo, *, given: bool = False) -> list[float]:
    """Return the declared start values; one value stands for all elements of an array.

    Where others are `given` for all elements, their number is all that counts, and they are zero.

    Raises
    ------
    FmuFileError
        If one is no number, or their number does not fit.
    """
    words = ("" if given else variable.start or "0").lower().split() or ["0"]
    try:
        values = [float({"true": "1", "false": "0"}.get(word, word)) for word in words]
    except ValueError as error:
        raise FmuFileError(
            f"{variable.name!r} of {description.path} has a start value that is no number ({error})."
        ) from error
    if len(values) == 1:
        values *= variable.size
    if len(values) != variable.size:
        raise FmuFileError(
            f"{variable.name!r} of {description.path} has {variable.size} elements but {len(values)} "
            "start values; give all of its values."
        )
    return values


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
