"""Names of a binding found in an FMU: where their values stand in a block, and which of them are refused."""

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, groupby, product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

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
        What is exchanged; a variable that is there twice stands once in the block.
    begin : int
        Position of the first value.
    linear : bool
        Whether continuous inputs move in straight lines; these come first.
    """

    def __init__(
        self,
        description: FmuDescription,
        variables: Sequence[VariableInfo],
        begin: int,
        *,
        linear: bool = False,
    ) -> None:
        def kind(variable: VariableInfo) -> tuple[bool, int, str]:
            """Return whether a variable is held, and its base type after the place of that in the order."""
            name = description.exchange_kind(variable)
            held = not (linear and variable.continuous and variable.causality == "input")
            return held, (*_KIND_ORDER, name).index(name), name

        unique = {variable.name: variable for variable in variables if variable.size}
        self.variables = tuple(sorted(unique.values(), key=kind))
        sizes = [variable.size for variable in self.variables]
        begins = accumulate(sizes[:-1], initial=begin)
        self._positions = dict(zip([v.name for v in self.variables], begins, strict=False))
        groups = [(key, list(members)) for key, members in groupby(self.variables, kind)]
        self.groups = tuple(
            Group(name, tuple(v.reference for v in members), sum(v.size for v in members), not held)
            for (held, _, name), members in groups
        )

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

    Parameters
    ----------
    description : FmuDescription
        The FMU, for the error.
    variable : VariableInfo
        The variable, with the shape that it has now.
    given : bool
        Whether all of its values are given: then zeros only keep their place.

    Raises
    ------
    FmuFileError
        If they are no numbers, or not as many as the array has elements.
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

    def numbers(self, given: Any, *, history: bool = False) -> npt.NDArray[np.float64]:
        """Return values in the FMU's unit, all of them checked.

        Parameters
        ----------
        given : float or array_like
            As many values as the slot takes; of a history either these for all steps, or for each.
        history : bool
            Whether it is a history.

        Returns
        -------
        (n,) or (N, n) ndarray
            The latter for a history that has values for each of N steps.

        Raises
        ------
        FmuInputError
            If there are others than n values, or one is no number, not finite, not whole or out of range.
        """
        count = len(self.positions)
        try:
            array = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError) as error:
            wanted = "numbers" if history else "a number"
            raise FmuInputError(f"{self.label} must be {wanted}, but is {given!r}.") from error
        cell = () if count == 1 else (count,)
        per_step = history and array.shape != cell
        if per_step and array.shape[1:] not in (cell, (count,)):
            wanted = "a number, or one" if count == 1 else f"{count} values, or as many"
            raise FmuInputError(
                f"{self.label} must be {wanted} for each step, but has the shape {array.shape}."
            )
        if not history and array.size != count:
            wrong = f"takes {count} values, but {array.size} came"
            raise FmuInputError(
                f"{self.label} {f'must be a number, but is {given!r}' if count == 1 else wrong}."
            )
        rows = array.reshape(-1, count)
        with np.errstate(all="ignore"):
            # The arithmetic of `Conversion.to_fmu`: the bits are those of a step.
            scale = self.conversion
            values = rows if scale == IDENTITY else scale.factor * rows + scale.offset
            # A conversion of units may round a value at the edge of the range to just outside of it.
            inside = np.clip(values, self.low, self.high)
            near = np.abs(inside - values) <= 1e-12 * np.maximum(np.abs(inside), 1.0)
            whole = np.floor(values) == values if self.whole else True
            wrong_ones = np.argwhere(~(np.isfinite(values) & near & whole))
        if len(wrong_ones):
            step, element = wrong_ones[0].tolist()
            where = f" It is the value of step {step} of the {len(rows)}." if per_step else ""
            shown = given if isinstance(given, int | float) else rows[step, element].item()
            raise FmuInputError(self._refusal(shown, values[step, element]) + where)
        inside = np.where((self.low <= values) & (values <= self.high), values, inside)
        return inside if per_step else inside[0]

    def _refusal(self, given: float, number: float) -> str:
        if not math.isfinite(number):
            return f"{self.label} must be finite, but is {given!r}; nothing was sent to the FMU."
        if self.whole and not float(number).is_integer():
            return f"{self.label} must be a whole number, but is {given!r}; nothing was sent to the FMU."
        return (
            f"{self.label} = {given!r} lies outside the range of {self.variable.name!r}, {self.low:g} to "
            f"{self.high:g}{in_unit(self.variable)}; nothing was sent to the FMU."
        )


def value_range(variable: VariableInfo) -> tuple[float, float]:
    """Return the declared range, within that of the type: C would wrap what does not fit."""
    low, high = (0.0, 1.0) if variable.kind == "Boolean" else (-math.inf, math.inf)
    if variable.base_type in ("Integer", "Enumeration"):
        sized = variable.kind not in ("Integer", "Enumeration")
        limits = np.iinfo(variable.kind.lower() if sized else "int32")
        low, high = float(limits.min), float(limits.max)
    return (
        low if variable.minimum is None else max(low, variable.minimum),
        high if variable.maximum is None else min(high, variable.maximum),
    )


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
        numbers = Slot(label, (0,), *value_range(variable), IDENTITY, variable).numbers(value).tolist()
        found.append((variable.kind, variable.reference, numbers))
        lengths[name] = int(numbers[0])
    if not lengths:
        return description, found
    if description.interface == "model-exchange":
        raise BindingError(
            f"{description.path} is run by model exchange; structural parameters are set in co-simulation "
            "only."
        )
    return replace(description, variables=tuple(v.resized(lengths) for v in description.variables)), found
