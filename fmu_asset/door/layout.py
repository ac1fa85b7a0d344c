"""Names of a binding found in an FMU, and where their values stand in a block."""

import difflib
import re
from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuFileError
from fmu_asset.instances.plan import Group

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
