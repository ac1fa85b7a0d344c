"""Variables that a binding names, selection in an FMU, and the order of their values in a block."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, groupby
from typing import NamedTuple

import numpy as np

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuFileError
from fmu_asset.instances.plan import InitialValue, VariableGroup

from .binding import Binding
from .slots import InputSlot
from .units import IDENTITY

_CAUSALITIES: Mapping[str, tuple[str, ...]] = {
    "input": ("input",),
    "parameter": ("parameter",),
    "structuralParameter": ("structuralParameter",),
    "output": ("output", "local", "calculatedParameter", "none"),
}
"""Causalities of variables that a binding may use in a role."""
_ELEMENT = re.compile(r"(?P<array>.+)\[(?P<index>\d+(?:,\s*\d+)*)\]", re.DOTALL)
_KIND_ORDER = ("Real", "Float64", "Integer", "Boolean")
"""Base types in the order of a block: reals first, together, since they need no conversion."""


class VariableElements(NamedTuple):
    """A variable, and those of its elements that a binding names: one or all."""

    variable: VariableInfo
    elements: range


def find_variable(
    description: FmuDescription, name: str, label: str, causality: str
) -> VariableElements:
    """Return the variable of an FMU, or the element of an array, that a binding names.

    Parameters
    ----------
    description : FmuDescription
        The variables and abilities that the FMU declares.
    name : str
        A variable, or an element of an array such as `p[3]`.
    label : str
        Place in the binding, for messages.
    causality : {"input", "parameter", "structuralParameter", "output"}
        Role of the variable. Everything that is neither input nor parameter can be read as an
        output; a tunable parameter can be sent at every step like an input (co-simulation); and a
        start value can be set like a parameter.

    Raises
    ------
    BindingError
        If there is no such variable, or it is of another causality or type.
    """
    variable = description.variable(name)
    if variable is None:
        selection = _find_element(description, name, label)
        if selection is None:
            raise BindingError(
                f"{label} names {name!r}, which is not a variable of {description.label}"
                f"{description.hint(name)}"
            )
    else:
        selection = VariableElements(variable, range(variable.size))
    _check_use(description, selection.variable, causality, name, label)
    return selection


def _find_element(description: FmuDescription, name: str, label: str) -> VariableElements | None:
    """Return the element of an array that a name like `p[3]` means.

    Returns
    -------
    VariableElements or None
        None if the name has another form, or the FMU has no such array.
    """
    match = _ELEMENT.fullmatch(name)
    if match is None:
        return None
    variable = description.variable(match["array"])
    if variable is None or not variable.shape:
        return None
    index = [int(number) - 1 for number in match["index"].split(",")]
    try:
        element = int(np.ravel_multi_index(index, variable.shape))
    except (TypeError, ValueError):
        shape = " x ".join(map(str, variable.shape))
        raise BindingError(
            f"{label} names {name!r}, but {variable.name!r} has {shape} elements, counted from 1."
        ) from None
    return VariableElements(variable, range(element, element + 1))


def _check_use(
    description: FmuDescription, variable: VariableInfo, causality: str, name: str, label: str
) -> None:
    """Refuse a variable that cannot be used in the role of a causality; see `find_variable`."""
    is_tunable_input = (
        causality == "input"
        and variable.causality == "parameter"
        and variable.variability == "tunable"
        and description.interface == "co-simulation"
    )
    is_start_value = causality == "parameter" and variable.startable
    fits = variable.causality in _CAUSALITIES[causality]
    if not (fits or is_tunable_input or is_start_value):
        remedy = ""
        if causality == "input" and (variable.causality == "parameter" or variable.startable):
            remedy = (
                ", which is set before the start only: name it in [parameter], or in [health] if "
                "it is damage; or declare it in the FMU as an input, or as a tunable parameter of "
                "a co-simulation"
            )
        raise BindingError(
            f"{label} must be of causality {causality}, but {name!r} is declared as "
            f"{variable.causality} in {description.label}{remedy}."
        )
    if not variable.numeric:
        raise BindingError(
            f"{label} names {name!r}, which is of type {variable.kind}; only numbers can be bound."
        )
    if variable.clocked:
        raise BindingError(
            f"{label} names {name!r}, which changes with a clock; clocks are not supported."
        )


class _GroupKey(NamedTuple):
    """The properties that the variables of a group in a block share; groups are sorted by it.

    Attributes
    ----------
    is_held : bool
        Whether the values are constant over a step. Linear inputs come first.
    kind_number : int
        Position of the base type in `_KIND_ORDER`.
    kind : str
        FMI base type.
    """

    is_held: bool
    kind_number: int
    kind: str


class BlockLayout:
    """The order of variables in a block of values: by base type, then as in the binding.

    An array is in the block with all its elements, since FMI 3 sets and reads arrays as a whole.

    Parameters
    ----------
    description : FmuDescription
        The variables and abilities that the FMU declares.
    variables : sequence of VariableInfo
        Variables that are exchanged. A variable that is named twice is in the block once.
    begin : int
        Position of the first value.
    linear : bool
        Whether continuous inputs change linearly over a step. These come first in the block.

    Attributes
    ----------
    variables : tuple of VariableInfo
        The variables in the order of the block.
    groups : tuple of VariableGroup
        The groups that are set or read in one call.
    """

    def __init__(
        self,
        description: FmuDescription,
        variables: Sequence[VariableInfo],
        begin: int,
        *,
        linear: bool = False,
    ) -> None:
        def group_key(variable: VariableInfo) -> _GroupKey:
            kind = description.exchange_kind(variable)
            is_known = kind in _KIND_ORDER
            number = _KIND_ORDER.index(kind) if is_known else len(_KIND_ORDER)
            moves = linear and variable.continuous and variable.causality == "input"
            return _GroupKey(not moves, number, kind)

        variable_of_name = {variable.name: variable for variable in variables if variable.size}
        self.variables = tuple(sorted(variable_of_name.values(), key=group_key))
        begins = accumulate((variable.size for variable in self.variables), initial=begin)
        names = (variable.name for variable in self.variables)
        self._begins = dict(zip(names, begins, strict=False))
        groups = []
        for key, group in groupby(self.variables, group_key):
            members = list(group)
            references = tuple(variable.reference for variable in members)
            count = sum(variable.size for variable in members)
            groups.append(VariableGroup(key.kind, references, count, linear=not key.is_held))
        self.groups = tuple(groups)

    def positions(self, selection: VariableElements) -> list[int]:
        """Return the positions of elements of a variable in the block."""
        # an array without elements has no place in the block
        if not selection.elements:
            return []
        begin = self._begins[selection.variable.name]
        return [begin + element for element in selection.elements]

    def names(self) -> list[str]:
        """Return the names of all values in the order of the block."""
        return [name for variable in self.variables for name in variable.elements]


def start_values(
    description: FmuDescription, variable: VariableInfo, *, placeholders: bool = False
) -> list[float]:
    """Return the start values that an FMU declares for all elements of a variable.

    A single start value of an array applies to all of its elements.

    Parameters
    ----------
    description : FmuDescription
        The FMU, for messages.
    variable : VariableInfo
        The variable, with its present shape.
    placeholders : bool
        Whether to return zeros, because the caller sets all values. The start values of a resized
        array may not fit.

    Raises
    ------
    FmuFileError
        If they are not numbers, or not as many as the array has elements.
    """
    text = "0" if placeholders else variable.start or "0"
    value_texts = text.lower().split() or ["0"]
    try:
        values = [
            float({"true": "1", "false": "0"}.get(value_text, value_text))
            for value_text in value_texts
        ]
    except ValueError as error:
        raise FmuFileError(
            f"{variable.name!r} of {description.label} has a start value that is not a number "
            f"({error})."
        ) from error
    if len(values) == 1:
        values *= variable.size
    if len(values) != variable.size:
        raise FmuFileError(
            f"{variable.name!r} of {description.label} has {variable.size} elements but "
            f"{len(values)} start values; give all of its values."
        )
    return values


def with_structural_parameters(
    description: FmuDescription, binding: Binding
) -> tuple[FmuDescription, list[InitialValue]]:
    """Return an FMU with the array sizes that a binding chooses, and the values that set them.

    Parameters
    ----------
    description : FmuDescription
        The FMU as its file declares it.
    binding : Binding
        The binding; its structural parameters are sizes of arrays (FMI 3).

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter, or is run by model exchange.
    FmuInputError
        If a value is not a whole number or out of range, or makes an array too large.
    """
    settings = []
    lengths: dict[str | None, int] = {}
    for name, value in binding.binding.structural_parameters.items():
        label = f"structural_parameters.{name}"
        location = f"{label} of the binding {binding.title}"
        variable = find_variable(description, name, location, "structuralParameter").variable
        low, high = variable.bounds
        slot = InputSlot(label, (0,), low, high, IDENTITY, variable)
        numbers = slot.numbers(value).tolist()
        settings.append(InitialValue(variable.kind, variable.reference, numbers))
        lengths[name] = int(numbers[0])
    if not lengths:
        return description, settings
    if description.interface == "model-exchange":
        raise BindingError(
            f"{description.label} is run by model exchange; structural parameters are set in "
            "co-simulation only."
        )
    resized = tuple(variable.resized(lengths) for variable in description.variables)
    return replace(description, variables=resized), settings
