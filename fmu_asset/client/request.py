"""The request block: time, step size and all inputs of a step, as the FMU gets them."""

import operator
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fmu_asset.errors import BindingError, FmuInputError
from reporting.arrays import Float

from .binding import INPUT_ROLES
from .bound_variables import InputBinding
from .layout import BlockLayout, VariableElements, start_values
from .resolver import BindingResolver, PortQuantity
from .slots import InputSlot
from .units import IDENTITY
from .values import InputsByRole

_LARGEST = sys.float_info.max


class NumberBlock(Protocol):
    """A block of numbers that can be set by position: a list, or a view of a C array."""

    def __setitem__(self, position: int, number: float, /) -> None:
        """Set a number."""


class _BoundInput(NamedTuple):
    """An input of the binding and its variables in the FMU.

    Attributes
    ----------
    role, name : str
        Role and name in the binding.
    input_binding : InputBinding
        Unit and range.
    selections : list of VariableElements
        Its variables: one, or as many as the vector of a port has.
    """

    role: str
    name: str
    input_binding: InputBinding
    selections: list[VariableElements]

    @property
    def label(self) -> str:
        return f"{self.role}.{self.name}"


class _PlainInput(NamedTuple):
    """An input that needs no conversion: one real number, in the FMU's own unit.

    A value is sent without further checks if it is a float within the limits.
    """

    position: int
    low: float
    high: float


_NOT_PLAIN = _PlainInput(position=0, low=1.0, high=0.0)
"""An empty range: no value is sent as it is."""


class RequestBlock:
    """The layout of the request block, and how inputs are written to it.

    Parameters
    ----------
    resolver : BindingResolver
        The binding and the FMU.
    ports : sequence of PortQuantity
        Quantities of the ports.

    Attributes
    ----------
    layout : BlockLayout
        Order of the inputs.

    Raises
    ------
    BindingError
        If an input does not fit the FMU, or two inputs set the same value.
    """

    def __init__(self, resolver: BindingResolver, ports: Sequence[PortQuantity]) -> None:
        self._resolver = resolver
        bound_inputs = self._role_inputs() + self._port_inputs(ports)
        variables = [
            selection.variable
            for bound_input in bound_inputs
            for selection in bound_input.selections
        ]
        is_linear = resolver.binding.binding.interpolation == "linear"
        self.layout = BlockLayout(resolver.description, variables, begin=2, linear=is_linear)
        if is_linear:
            self._check_linear_interpolation()
        self._slots: dict[str, dict[str, InputSlot]] = {role: {} for role in (*INPUT_ROLES, "port")}
        user_of_position: dict[int, str] = {}
        for bound_input in bound_inputs:
            slot = self._slot(bound_input, user_of_position)
            self._slots[bound_input.role][bound_input.name] = slot
        self._plain_inputs = {role: _plain_inputs(slots) for role, slots in self._slots.items()}

    # ------------------------------------------------------------------ resolving

    def _role_inputs(self) -> list[_BoundInput]:
        """Return the bound inputs of all roles, without health that is set only at the start."""
        resolver = self._resolver
        bound_inputs = []
        for role in INPUT_ROLES:
            for name, input_binding in resolver.binding.inputs(role).items():
                if role == "health" and resolver.is_set_at_start(input_binding.variable):
                    continue
                selection = resolver.find(input_binding.variable, f"{role}.{name}", "input")
                bound_inputs.append(_BoundInput(role, name, input_binding, [selection]))
        return bound_inputs

    def _port_inputs(self, ports: Sequence[PortQuantity]) -> list[_BoundInput]:
        """Return the bound inputs of ports; a port quantity that is an output is left out."""
        bound_inputs = []
        for quantity in ports:
            if quantity.is_read:
                continue
            names = quantity.vector.variables
            input_binding = InputBinding(variable=names[0], unit=quantity.vector.units[0])
            selections = [self._resolver.find(name, quantity.label, "input") for name in names]
            bound_inputs.append(_BoundInput("port", quantity.name, input_binding, selections))
        return bound_inputs

    def _slot(self, bound_input: _BoundInput, user_of_position: dict[int, str]) -> InputSlot:
        """Return the slot of an input, and enter its positions in the list of users.

        Parameters
        ----------
        bound_input : _BoundInput
            The input.
        user_of_position : dict of int to str
            The label of the input that sets each position; extended in place.

        Raises
        ------
        BindingError
            If its variables differ in unit or type, or another input sets one of its positions.
        """
        resolver = self._resolver
        if (
            len(
                {
                    (selection.variable.unit, selection.variable.kind)
                    for selection in bound_input.selections
                }
            )
            > 1
        ):
            raise BindingError(
                f"The variables of {resolver.place_in_binding(bound_input.label)} have different "
                "units or types in the FMU; make one port of each."
            )
        variable = bound_input.selections[0].variable
        positions: list[int] = []
        for selection in bound_input.selections:
            positions += self.layout.positions(selection)
        for position in positions:
            if position in user_of_position:
                raise BindingError(
                    f"In the binding {resolver.binding.title}, {bound_input.label} and "
                    f"{user_of_position[position]} set the same value of {variable.name!r}; keep "
                    "one."
                )
            user_of_position[position] = bound_input.label
        return resolver.slot(bound_input.label, bound_input.input_binding, variable, positions)

    def _check_linear_interpolation(self) -> None:
        """Refuse linear interpolation if the FMU, or all of its inputs, cannot follow it."""
        description = self._resolver.description
        request = (
            f"The binding {self._resolver.binding.title} asks for linear interpolation of inputs, "
            "but"
        )
        if not description.can_interpolate_inputs:
            reason = "it does not declare `canInterpolateInputs`"
            if description.major_version == 3:
                reason = "FMI 3.0 has no derivatives of inputs in co-simulation"
            raise BindingError(
                f"{request} {description.label} takes no derivatives of inputs: {reason}. Leave "
                "`interpolation` out and take smaller steps, or run it by model exchange if it has "
                "that."
            )
        if not any(group.linear for group in self.layout.groups):
            raise BindingError(
                f"{request} none of them is a continuous real number in {description.label}; leave "
                "it out."
            )

    # ------------------------------------------------------------------ sending

    def slot(self, role: str, name: str) -> InputSlot | None:
        """Return the slot of an input; None if the binding has no such input at every step."""
        return self._slots.get(role, {}).get(name)

    def names(self, role: str) -> list[str]:
        """Return the names of the inputs of a role."""
        return [*self._slots.get(role, {})]

    def _known_slot(self, role: str, name: str) -> InputSlot:
        """Return the slot of an input; refuse a name that the binding does not have."""
        slot = self.slot(role, name)
        if slot is None:
            raise unknown_input(self._resolver.binding.name, role, name, self.names(role))
        return slot

    def start_values(self, inputs: InputsByRole) -> list[float]:
        """Return a request block that holds the FMU's own start values of the inputs.

        Parameters
        ----------
        inputs : mapping of str to mapping or None
            Inputs by role that will be written over these. If they set a whole array, it is zero
            here: the start values of a resized array may not fit.

        Raises
        ------
        FmuFileError
            If a start value is not a number.
        """
        given_arrays = set()
        for role, values in inputs.items():
            for name in values or ():
                slot = self._known_slot(role, name)
                if len(slot.positions) == slot.variable.size:
                    given_arrays.add(slot.variable.name)
        block = [0.0, 0.0]
        linear_count = sum(group.count for group in self.layout.groups if group.linear)
        for variable in self.layout.variables:
            block += start_values(
                self._resolver.description, variable, placeholders=variable.name in given_arrays
            )
        # linear inputs begin at the start values, too; their begins are the last part of the block
        return block + block[2 : 2 + linear_count]

    def place(self, target: NumberBlock, inputs: InputsByRole) -> bool:
        """Write inputs to a request block; return whether there were any.

        Parameters
        ----------
        target : list of float, C array or memoryview
            The request block; changed in place.
        inputs : mapping of str to mapping or None
            Inputs by role and by the binding's names, in its units.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        has_inputs = False
        for role, values in inputs.items():
            if not values:
                continue
            has_inputs = True
            plain_inputs = self._plain_inputs.get(role, {})
            for name, value in values.items():
                position, low, high = plain_inputs.get(name, _NOT_PLAIN)
                # a fast path for plain inputs; NaN and infinities lie in no range
                if isinstance(value, float) and low <= value <= high:
                    target[position] = value
                else:
                    self._place_checked(target, self._known_slot(role, name), value)
        return has_inputs

    @staticmethod
    def _place_checked(target: NumberBlock, slot: InputSlot, value: npt.ArrayLike) -> None:
        """Check and convert the values of an input, and write them to a request block."""
        numbers = slot.numbers(value).tolist()
        for position, number in zip(slot.positions, numbers, strict=True):
            target[position] = number

    def rows(self, last: Float, histories: InputsByRole, steps: int | None) -> Float:
        """Return the request blocks of many steps, from checked histories of inputs.

        Time and step size are not set.

        Parameters
        ----------
        last : (2 + n_inputs,) ndarray
            The last request block. An input without a history keeps its value.
        histories : mapping of str to mapping
            Inputs by role and name.
        steps : int, optional
            The number of steps N; by default that of the histories.

        Returns
        -------
        (N, 2 + n_inputs) ndarray
            Values in the FMU's units.

        Raises
        ------
        BindingError
            If a name is not in the binding.
        FmuInputError
            If a value is not a number, not finite or out of range, or the histories have different
            lengths.
        """
        slots_and_values = []
        for role, by_name in histories.items():
            for name, values in (by_name or {}).items():
                slots_and_values.append((self._known_slot(role, name), values))
        checked_histories = [
            (slot, slot.numbers(values, history=True)) for slot, values in slots_and_values
        ]
        blocks = np.tile(last, (step_count(checked_histories, steps), 1))
        for slot, numbers in checked_histories:
            blocks[:, list(slot.positions)] = numbers
        return blocks


def _plain_inputs(slots: Mapping[str, InputSlot]) -> dict[str, _PlainInput]:
    """Return the inputs that need no conversion, by name."""
    plain_inputs = {}
    for name, slot in slots.items():
        is_plain = slot.conversion == IDENTITY and not slot.takes_whole_numbers
        if is_plain and len(slot.positions) == 1:
            low = max(slot.low, -_LARGEST)
            high = min(slot.high, _LARGEST)
            plain_inputs[name] = _PlainInput(slot.positions[0], low, high)
    return plain_inputs


def unknown_input(binding: str, role: str, name: str, known_names: Sequence[str]) -> BindingError:
    """Return the error for an input that a binding does not have.

    Parameters
    ----------
    binding : str
        Name of the binding.
    role, name : str
        Role and name of the input.
    known_names : sequence of str
        Names that the binding has in this role.
    """
    names = ", ".join(known_names) or "none"
    return BindingError(f"The binding {binding} has no {role} {name!r}; it has {names}.")


def step_count(histories: Sequence[tuple[InputSlot, Float]], steps: int | None) -> int:
    """Return the number of steps that histories and the caller ask for.

    Parameters
    ----------
    histories : sequence of (InputSlot, (n,) or (N, n) ndarray)
        Each input with its values; an (n,) array is for all steps.
    steps : int, optional
        The number that the caller asks for.

    Raises
    ------
    FmuInputError
        If the numbers differ, or none is given.
    """
    count = steps
    source = "`steps`"
    if count is not None:
        count = operator.index(count)
        if count < 1:
            raise FmuInputError(f"steps must be at least 1, but is {count}.")
    for slot, numbers in histories:
        if numbers.ndim != 2:
            continue
        if count is None:
            count = len(numbers)
            source = slot.label
        elif len(numbers) != count:
            raise FmuInputError(
                f"{slot.label} has {len(numbers)} steps, but {source} has {count}; give the same "
                "number for both."
            )
    if not count:
        raise FmuInputError(
            "Nothing says how many steps to make: give `steps`, or a history of an input."
        )
    return count
