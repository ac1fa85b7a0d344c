"""An FMU with its binding: the variables that the binding names, and their order in a block."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import accumulate, groupby
from typing import NamedTuple

import numpy as np

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuFileError
from fmu_asset.instances.plan import InitialValue, VariableGroup

from .binding import Binding
from .bound_input import BoundInput
from .bound_variables import InputBinding, PortBinding, VectorBinding
from .units import IDENTITY, Conversion, conversion

_CAUSALITIES: Mapping[str, tuple[str, ...]] = {
    "input": ("input",),
    "parameter": ("parameter",),
    "structuralParameter": ("structuralParameter",),
    "output": ("output", "local", "calculatedParameter", "none"),
}
"""Causalities of variables that a binding may use in a role."""
_KIND_ORDER = ("Real", "Float64", "Integer", "Boolean")
"""Base types in the order of a block: reals first, together, since they need no conversion."""
_ELEMENT = re.compile(r"(?P<array>.+)\[(?P<index>\d+(?:,\s*\d+)*)\]", re.DOTALL)


class VariableElements(NamedTuple):
    """A variable, and those of its elements that a binding names: one or all."""

    variable: VariableInfo
    elements: range


def find_variable(
    description: FmuDescription, name: str, label: str, causality: str
) -> VariableElements:
    """Find the variable of the FMU, or the element of an array, that a binding names.

    Parameters
    ----------
    name : str
        A variable, or an element of an array such as `p[3]`.
    label : str
        Where the name stands in the binding, for messages.
    causality : {"input", "parameter", "structuralParameter", "output"}
        How the variable is used. Everything that is neither input nor parameter can be read as an
        output; in co-simulation a tunable parameter can be sent at every step like an input; and a
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
    """Return the array element that a name such as `p[3]` stands for.

    The result is None if the name has another form, or if the FMU has no such array.
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
    """Raise an error if a binding cannot use a variable in this way; see `find_variable`.

    `causality` is the intended use; `name` is the variable's name in the binding, and `label` says
    where the binding has it.
    """
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


class BlockLayout:
    """The order of variables in a block of values: by base type, then as in the binding.

    An array is in the block with all its elements, since FMI 3 sets and reads arrays as a whole.

    Parameters
    ----------
    begin : int
        Position of the first value.
    linear : bool
        Whether continuous inputs change linearly over a step. These come first in the block.

    Attributes
    ----------
    groups : tuple of VariableGroup
        Variables of one type, which are set or read in one call.
    """

    def __init__(
        self,
        description: FmuDescription,
        variables: Sequence[VariableInfo],
        begin: int,
        *,
        linear: bool = False,
    ) -> None:
        def group_key(variable: VariableInfo) -> tuple[bool, int, str]:
            """Return whether the value is held over a step, the rank of its type, and its type."""
            kind = description.exchange_kind(variable)
            rank = _KIND_ORDER.index(kind) if kind in _KIND_ORDER else len(_KIND_ORDER)
            moves = linear and variable.continuous and variable.causality == "input"
            return not moves, rank, kind

        variable_of_name = {variable.name: variable for variable in variables if variable.size}
        self.variables = tuple(sorted(variable_of_name.values(), key=group_key))
        begins = accumulate((variable.size for variable in self.variables), initial=begin)
        names = (variable.name for variable in self.variables)
        self._begins = dict(zip(names, begins, strict=False))
        groups = []
        for (is_held, _, kind), group in groupby(self.variables, group_key):
            members = list(group)
            references = tuple(variable.reference for variable in members)
            count = sum(variable.size for variable in members)
            groups.append(VariableGroup(kind, references, count, linear=not is_held))
        self.groups = tuple(groups)

    def positions(self, selections: Sequence[VariableElements]) -> list[int]:
        """Return the positions of elements of variables in the block."""
        positions = []
        for selection in selections:
            # an array without elements has no place in the block
            if selection.elements:
                begin = self._begins[selection.variable.name]
                positions += [begin + element for element in selection.elements]
        return positions


class BindingFaults:
    """Collects the entries of a binding that do not fit an FMU, for one message.

    Parameters
    ----------
    title : str
        Name and file of the binding.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._messages: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._messages)

    @contextmanager
    def collect(self, label: str) -> Iterator[None]:
        """Record the first `BindingError` at an entry of the binding instead of raising it."""
        try:
            yield
        except BindingError as error:
            self._messages.setdefault(label, str(error))

    def raise_if_any(self) -> None:
        """Raise a `BindingError` that names all recorded entries, if there are any."""
        messages = [*self._messages.values()]
        if not messages:
            return
        if len(messages) == 1:
            raise BindingError(messages[0])
        title = f"{len(messages)} entries of the binding {self._title} do not fit the FMU."
        # The title names the binding and its file, so that each message need not.
        short = [text.replace(f" of the binding {self._title}", "") for text in messages]
        raise BindingError(" ".join([title, *short]))


class PortQuantity(NamedTuple):
    """A quantity of a mechanical port, with its variables in the FMU.

    Attributes
    ----------
    name : str
        Port and quantity, such as `tip.force`.
    vector : VectorBinding
        Its variables.
    is_read : bool
        Whether it is an output of the FMU: either the force is, or the motion.
    """

    name: str
    vector: VectorBinding
    is_read: bool

    @property
    def label(self) -> str:
        """Place in the binding, for messages."""
        return f"port.{self.name}"


class BoundFmu:
    """An FMU and its binding; it finds the variables that the binding names.

    Parameters
    ----------
    description : FmuDescription
        The FMU, with the array sizes of the binding.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        self.description = description
        self.binding = binding

    def location_in_binding(self, label: str) -> str:
        """Return a text for messages: a place in the binding, its name and its file."""
        return f"{label} of the binding {self.binding.title}"

    def find(self, name: str, label: str, causality: str) -> VariableElements:
        """Return the variable, or element of an array, that the binding names; see `find_variable`.

        Raises
        ------
        BindingError
            If there is no such variable, or it is of another causality or type.
        """
        return find_variable(self.description, name, self.location_in_binding(label), causality)

    def variable_or_array(self, name: str) -> VariableInfo | None:
        """Return the variable of a name such as `p`, or the array `p` for `p[3]`."""
        array_name = name.rpartition("[")[0]
        return self.description.variable(name) or self.description.variable(array_name)

    def is_set_at_start(self, name: str) -> bool:
        """Return whether a variable can be set only before the initialisation."""
        variable = self.variable_or_array(name)
        if variable is None:
            return False
        is_tunable = (
            variable.variability == "tunable" and self.description.interface == "co-simulation"
        )
        return variable.startable or (variable.causality == "parameter" and not is_tunable)

    def bound_input(
        self,
        label: str,
        input_binding: InputBinding,
        variable: VariableInfo,
        positions: Sequence[int] = (),
    ) -> BoundInput:
        """Combine an input of the binding with the FMU's variable: their ranges and their units.

        Parameters
        ----------
        label : str
            Where the input stands in the binding, for messages.
        positions : sequence of int
            Positions of its values in the request; empty as long as the request has no layout.

        Raises
        ------
        BindingError
            If the unit cannot be converted, or the range lies outside that of the FMU.
        """
        unit_conversion = self.unit_conversion(variable, input_binding.unit, label)
        low, high = variable.bounds
        # A negative factor of the conversion exchanges the limits, so they are sorted.
        stated_low, stated_high = sorted(
            unit_conversion.to_fmu(limit) for limit in input_binding.limits
        )
        if stated_low > high or stated_high < low:
            raise BindingError(
                f"The range of {self.location_in_binding(label)} lies outside that of "
                f"{variable.name!r}, {low:g} to {high:g}{variable.in_unit}; correct minimum or "
                "maximum."
            )
        return BoundInput(
            label=label,
            positions=positions,
            low=max(low, stated_low),
            high=min(high, stated_high),
            conversion=unit_conversion,
            variable=variable,
        )

    def start_input(self, label: str, input_binding: InputBinding) -> BoundInput:
        """Return an input whose value is set before the initialisation.

        The positions of its values count from the first element of the variable.

        Raises
        ------
        BindingError
            If the binding does not fit the FMU.
        """
        selection = self.find(input_binding.variable, label, "parameter")
        return self.bound_input(label, input_binding, selection.variable, selection.elements)

    def unit_conversion(self, variable: VariableInfo, unit: str, label: str) -> Conversion:
        """Return the conversion from the caller's unit to the unit of a variable.

        Raises
        ------
        BindingError
            If there is none.
        """
        definitions = self.description.units_of(variable)
        return conversion(unit, variable, definitions, where=self.location_in_binding(label))

    # ------------------------------------------------------------------ ports

    def port_quantities(self, faults: BindingFaults) -> list[PortQuantity]:
        """Return the quantities of all ports of the binding; collect what does not fit in `faults`.

        A port does not fit if a variable is not in the FMU, if a quantity mixes inputs and outputs,
        or if force and motion are both inputs or both outputs. The quantities of a port are
        compared with each other only if each of them fits.
        """
        quantities = []
        for port_name, port in self.binding.port.items():
            previous_fault_count = len(faults)
            for quantity, vector in port.quantities.items():
                label = f"port.{port_name}.{quantity}"
                with faults.collect(label):
                    self._check_port_variables(label, vector)
            if len(faults) == previous_fault_count:
                with faults.collect(f"port.{port_name}"):
                    quantities += self._quantities_of_port(port_name, port)
        return quantities

    def _check_port_variables(self, label: str, vector: VectorBinding) -> None:
        """Raise an error if the FMU lacks a variable of a port, or has it in another dimension."""
        for name, unit in zip(vector.variables, vector.units, strict=True):
            causality = "input" if self._is_input(name) else "output"
            variable = self.find(name, label, causality).variable
            self.unit_conversion(variable, unit, label)

    def _quantities_of_port(self, port_name: str, port: PortBinding) -> list[PortQuantity]:
        """Return the quantities of a port.

        Raises `BindingError` unless the force is an input and the motion an output, or vice versa.
        """
        quantities = []
        force_count = len(port.force.variables)
        is_output_of_quantity: dict[str, bool] = {}
        for quantity, vector in port.quantities.items():
            name = f"{port_name}.{quantity}"
            is_output_of_quantity[quantity] = self._is_output_vector(
                f"port.{name}", vector, force_count
            )
            quantities.append(PortQuantity(name, vector, is_output_of_quantity[quantity]))
        force_is_output = is_output_of_quantity.pop("force")
        if force_is_output in is_output_of_quantity.values():
            side = "outputs" if force_is_output else "inputs"
            raise BindingError(
                f"In {self.location_in_binding(f'port.{port_name}')}, force and motion are both "
                f"{side} of the FMU; at a port one is given for the other."
            )
        return quantities

    def _is_output_vector(self, label: str, vector: VectorBinding, force_count: int) -> bool:
        """Return whether the variables of a port's quantity are outputs of the FMU.

        Raise an error if their number differs from that of the force, or if they are mixed.
        """
        location = self.location_in_binding(label)
        count = len(vector.variables)
        if count != force_count:
            raise BindingError(
                f"{location} has {count} values, but the force has {force_count}; give the same "
                "number for both."
            )
        are_inputs = {self._is_input(variable) for variable in vector.variables}
        if len(are_inputs) > 1:
            raise BindingError(f"{location} mixes inputs and outputs of the FMU.")
        return not are_inputs.pop()

    def _is_input(self, name: str) -> bool:
        """Return whether a name is that of an input, or of an element of an array input."""
        variable = self.variable_or_array(name)
        return variable is not None and variable.causality == "input"


def start_values(
    description: FmuDescription, variable: VariableInfo, *, placeholders: bool = False
) -> list[float]:
    """Return the start values that an FMU declares for all elements of a variable.

    A single start value of an array applies to all of its elements.

    Parameters
    ----------
    placeholders : bool
        Whether to return zeros, because the caller sets all values: the start values of a resized
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
    """Give the FMU's arrays the sizes that the structural parameters of a binding choose.

    Returns the description with arrays of these sizes, and the values to set at the start.

    Raises
    ------
    BindingError
        If the FMU has no such structural parameter (FMI 3), or is run by model exchange.
    FmuInputError
        If a value is not a whole number or out of range, or makes an array too large.
    """
    settings = []
    value_of_parameter: dict[str, int] = {}
    for name, value in binding.binding.structural_parameters.items():
        label = f"structural_parameters.{name}"
        location = f"{label} of the binding {binding.title}"
        variable = find_variable(description, name, location, "structuralParameter").variable
        low, high = variable.bounds
        size = BoundInput(label, (0,), low, high, IDENTITY, variable)
        numbers = size.numbers(value).tolist()
        settings.append(InitialValue(variable.kind, variable.reference, numbers))
        value_of_parameter[name] = int(numbers[0])
    if not value_of_parameter:
        return description, settings
    if description.interface == "model-exchange":
        raise BindingError(
            f"{description.label} is run by model exchange; structural parameters are set in "
            "co-simulation only."
        )
    variables = tuple(
        variable.with_lengths(value_of_parameter) for variable in description.variables
    )
    return replace(description, variables=variables), settings
