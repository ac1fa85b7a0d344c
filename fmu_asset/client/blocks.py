"""What an asset exchanges with its FMU: the request with the inputs, the reply with the outputs.

Both are blocks of doubles. The request holds time, step size and all inputs of a step; the reply
holds all outputs.
"""

import operator
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.instances.plan import SOLVER_TOLERANCE, InitialValue, InitialValues, Plan
from reporting.arrays import Float

from .binding import INPUT_ROLES, Binding
from .bound_fmu import (
    BindingFaults,
    BlockLayout,
    BoundFmu,
    PortQuantity,
    VariableElements,
    start_values,
    with_structural_parameters,
)
from .bound_input import BoundInput
from .bound_variables import InputBinding
from .initial_values import InitialValueTable
from .observations import Observation, ObservationHistory
from .units import IDENTITY, Conversion
from .values import InputsByRole

REQUEST_HEAD = 2
"""Values of a request before its inputs: time and step size."""
HEAD_BYTES = 8 * REQUEST_HEAD
"""Bytes of time and step size at the beginning of a request."""
_LARGEST = sys.float_info.max


class NumberBlock(Protocol):
    """Numbers that can be set by position: a list, or a view of a C array."""

    def __setitem__(self, position: int, number: float, /) -> None:
        """Set a number."""


class _SelectedInput(NamedTuple):
    """An input of the binding before it has positions in the request.

    Attributes
    ----------
    role, name : str
        Role and name in the binding.
    selections : list of VariableElements
        The FMU's variables that it sets: one, or as many as the vector of a port has.
    bound_input : BoundInput
        Its unit and range.
    """

    role: str
    name: str
    selections: list[VariableElements]
    bound_input: BoundInput


def _selected_inputs(
    fmu: BoundFmu, ports: Sequence[PortQuantity], faults: BindingFaults
) -> list[_SelectedInput]:
    """Return the inputs that are sent at every step: those of the binding, then those of ports.

    Inputs of `health` that the FMU accepts only at its start are left out. Errors are collected in
    `faults`.
    """
    inputs = []
    for role in INPUT_ROLES:
        for name, entry in fmu.binding.inputs(role).items():
            if role == "health" and fmu.is_set_at_start(entry.variable):
                continue
            label = f"{role}.{name}"
            with faults.collect(label):
                selection = fmu.find(entry.variable, label, "input")
                bound_input = fmu.bound_input(label, entry, selection.variable, selection.elements)
                inputs.append(_SelectedInput(role, name, [selection], bound_input))
    for quantity in ports:
        if not quantity.is_read:
            with faults.collect(quantity.label):
                inputs.append(_selected_port_input(fmu, quantity))
    return inputs


def _selected_port_input(fmu: BoundFmu, quantity: PortQuantity) -> _SelectedInput:
    """Return the input for a port's quantity; raise an error if its variables are unlike."""
    names = quantity.vector.variables
    selections = [fmu.find(name, quantity.label, "input") for name in names]
    variables = [selection.variable for selection in selections]
    if len({(variable.unit, variable.kind) for variable in variables}) > 1:
        raise BindingError(
            f"The variables of {fmu.location_in_binding(quantity.label)} have different units or "
            "types in the FMU; make one port of each."
        )
    entry = InputBinding(variable=names[0], unit=quantity.vector.units[0])
    bound_input = fmu.bound_input(quantity.label, entry, variables[0])
    return _SelectedInput("port", quantity.name, selections, bound_input)


class _PlainInput(NamedTuple):
    """An input of one real number in the FMU's own unit, which needs no conversion.

    A float within the limits is sent as it is.
    """

    position: int
    low: float
    high: float


_NOT_PLAIN = _PlainInput(position=0, low=1.0, high=0.0)
"""An empty range: no value is sent as it is."""


class Request:
    """The layout of the inputs in the request, which also checks, converts and writes them.

    Attributes
    ----------
    layout : BlockLayout
        Order of the inputs.

    Raises
    ------
    BindingError
        If two inputs set the same value, or linear interpolation is not possible.
    """

    def __init__(self, fmu: BoundFmu, inputs: Sequence[_SelectedInput]) -> None:
        self._fmu = fmu
        self._by_role: dict[str, dict[str, BoundInput]] = {
            role: {} for role in (*INPUT_ROLES, "port")
        }
        variables = []
        for selected in inputs:
            variables += [selection.variable for selection in selected.selections]
        is_linear = fmu.binding.binding.interpolation == "linear"
        self.layout = BlockLayout(fmu.description, variables, begin=REQUEST_HEAD, linear=is_linear)
        if is_linear:
            self._check_linear_interpolation()
        label_of_position: dict[int, str] = {}
        for role, name, selections, bound_input in inputs:
            positions = self.layout.positions(selections)
            self._refuse_shared_positions(bound_input, positions, label_of_position)
            self._by_role[role][name] = bound_input._replace(positions=positions)
        self._plain_inputs = {role: _plain_inputs(table) for role, table in self._by_role.items()}

    # ------------------------------------------------------------------ layout

    def _refuse_shared_positions(
        self,
        bound_input: BoundInput,
        positions: Sequence[int],
        label_of_position: dict[int, str],
    ) -> None:
        """Raise an error if another input sets the same value; record the positions."""
        for position in positions:
            if position in label_of_position:
                raise BindingError(
                    f"In the binding {self._fmu.binding.title}, {bound_input.label} and "
                    f"{label_of_position[position]} set the same value of "
                    f"{bound_input.variable.name!r}; keep one."
                )
            label_of_position[position] = bound_input.label

    def _check_linear_interpolation(self) -> None:
        """Raise an error if the FMU, or all of its inputs, do not support linear interpolation."""
        description = self._fmu.description
        wish = f"The binding {self._fmu.binding.title} asks for linear interpolation of inputs, but"
        if not description.can_interpolate_inputs:
            reason = "it does not declare `canInterpolateInputs`"
            if description.major_version == 3:
                reason = "FMI 3.0 has no derivatives of inputs in co-simulation"
            raise BindingError(
                f"{wish} {description.label} takes no derivatives of inputs: {reason}. Leave "
                "`interpolation` out and take smaller steps, or run it by model exchange if it has "
                "that."
            )
        if not any(group.linear for group in self.layout.groups):
            raise BindingError(
                f"{wish} none of them is a continuous real number in {description.label}; leave "
                "it out."
            )

    # ------------------------------------------------------------------ sending

    def bound_input(self, role: str, name: str) -> BoundInput:
        """Return an input of the binding; raise `BindingError` if the binding does not have it."""
        inputs_of_role = self._by_role.get(role, {})
        if name not in inputs_of_role:
            known_names = ", ".join(inputs_of_role) or "none"
            raise BindingError(
                f"The binding {self._fmu.binding.name} has no {role} {name!r}; it has "
                f"{known_names}."
            )
        return inputs_of_role[name]

    def start_values(self, inputs: InputsByRole) -> list[float]:
        """Return a request with the start values that the FMU declares for its inputs.

        Parameters
        ----------
        inputs : mapping of str to mapping or None
            Inputs by role that will be written over these. An array that they set as a whole is
            zero here, because the start values of a resized array may not fit.

        Raises
        ------
        FmuFileError
            If a start value is not a number.
        """
        whole_arrays = set()
        for role, values in inputs.items():
            for name in values or ():
                bound_input = self.bound_input(role, name)
                if len(bound_input.positions) == bound_input.variable.size:
                    whole_arrays.add(bound_input.variable.name)
        block = [0.0, 0.0]
        linear_count = sum(group.count for group in self.layout.groups if group.linear)
        for variable in self.layout.variables:
            is_whole = variable.name in whole_arrays
            block += start_values(self._fmu.description, variable, placeholders=is_whole)
        # Linear inputs also begin the step at the start values, which the end of the block holds.
        return block + block[REQUEST_HEAD : REQUEST_HEAD + linear_count]

    def write(self, block: NumberBlock, inputs: InputsByRole) -> bool:
        """Write inputs, in the binding's units, to a request; return whether there were any.

        Parameters
        ----------
        block : list of float or memoryview
            The request, which is changed in place.

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
                    block[position] = value
                    continue
                bound_input = self.bound_input(role, name)
                numbers = bound_input.numbers(value).tolist()
                for position, number in zip(bound_input.positions, numbers, strict=True):
                    block[position] = number
        return has_inputs

    def of_steps(self, previous: Float, histories: InputsByRole, steps: int | None) -> Float:
        """Return the requests of many steps; time and step size are not filled in.

        Parameters
        ----------
        previous : (2 + n_inputs,) ndarray
            The last request, from which an input without a history keeps its value.
        histories : mapping of str to mapping
            Inputs by role and name, in the binding's units.

        Returns
        -------
        (N, 2 + n_inputs) ndarray
            Values in the FMU's units, for the N steps of the histories or of `steps`.

        Raises
        ------
        BindingError
            If a name is not in the binding.
        FmuInputError
            If a value is not a number, not finite or out of range, or the histories have different
            lengths.
        """
        bound_histories = []
        for role, by_name in histories.items():
            for name, values in (by_name or {}).items():
                bound_histories.append((self.bound_input(role, name), values))
        checked_histories = [
            (bound_input, bound_input.numbers(values, history=True))
            for bound_input, values in bound_histories
        ]
        requests = np.tile(previous, (step_count(checked_histories, steps), 1))
        for bound_input, numbers in checked_histories:
            requests[:, list(bound_input.positions)] = numbers
        return requests


def _plain_inputs(bound_inputs: Mapping[str, BoundInput]) -> dict[str, _PlainInput]:
    """Return the inputs that need no conversion, by name."""
    plain_inputs = {}
    for name, bound_input in bound_inputs.items():
        is_plain = bound_input.conversion == IDENTITY and not bound_input.takes_whole_numbers
        if is_plain and len(bound_input.positions) == 1:
            low = max(bound_input.low, -_LARGEST)
            high = min(bound_input.high, _LARGEST)
            plain_inputs[name] = _PlainInput(bound_input.positions[0], low, high)
    return plain_inputs


def step_count(histories: Sequence[tuple[BoundInput, Float]], steps: int | None) -> int:
    """Return the number of steps, on which all histories and `steps` must agree.

    Parameters
    ----------
    histories : sequence of (BoundInput, (n,) or (N, n) ndarray)
        Each input with its values; an (n,) array holds for all steps.

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
    for bound_input, numbers in histories:
        if numbers.ndim != 2:
            continue
        if count is None:
            count = len(numbers)
            source = bound_input.label
        elif len(numbers) != count:
            raise FmuInputError(
                f"{bound_input.label} has {len(numbers)} steps, but {source} has {count}; give the "
                "same number for both."
            )
    if not count:
        raise FmuInputError(
            "Nothing says how many steps to make: give `steps`, or a history of an input."
        )
    return count


class _BoundOutput(NamedTuple):
    """An output that the binding names, with the name and unit that the caller uses."""

    name: str
    selection: VariableElements
    unit: str
    conversion: Conversion


class Reply:
    """The layout of the outputs in the reply, and their conversion to the binding's units.

    Attributes
    ----------
    layout : BlockLayout
        Order of the outputs.
    extra_units : dict of str to str
        Units of the monitors, recorded variables and port outputs, by name.
    names : list of str
        Names of all values in the FMU, in the order of the reply.
    """

    def __init__(
        self, fmu: BoundFmu, observed: list[_BoundOutput], extras: list[_BoundOutput]
    ) -> None:
        variables = [output.selection.variable for output in (*observed, *extras)]
        self.layout = BlockLayout(fmu.description, variables, begin=0)
        self.names = [name for variable in self.layout.variables for name in variable.elements]
        # of several extra outputs with the same name, the last one is kept
        extra_of_name = {output.name: output for output in extras}
        outputs = [*observed, *extra_of_name.values()]
        self.extra_units = {name: output.unit for name, output in extra_of_name.items()}
        self._extra_names = tuple(extra_of_name)
        self._observation_count = len(observed)
        # an output is one value, even if the binding names a whole array by its first element
        first_positions = [self.layout.positions([output.selection])[0] for output in outputs]
        self._index = _slice_or_index(first_positions)
        conversions = [output.conversion for output in outputs]
        self._needs_conversion = any(conversion != IDENTITY for conversion in conversions)
        self._factors = np.array([entry.factor for entry in conversions], dtype=np.float64)
        self._offsets = np.array([entry.offset for entry in conversions], dtype=np.float64)

    def _converted(self, values: Float) -> Float:
        """Return values in the binding's units; always a copy."""
        if not self._needs_conversion:
            return values.copy()
        converted: Float = (values - self._offsets) / self._factors
        return converted

    def observation(self, block: Float, time: float) -> Observation:
        """Return the observation in a reply (n_outputs,) that was read at a time [s]."""
        values = self._converted(block[self._index])
        extra_values = values[self._observation_count :].tolist()
        # The lengths are equal by construction; checking them would double the time of this line.
        extra_outputs = dict(zip(self._extra_names, extra_values))  # noqa: B905
        return Observation(values[: self._observation_count], time, extra_outputs)

    def history(self, time: Float, blocks: Float, ended: str = "") -> ObservationHistory:
        """Return the history in the replies (N, n_outputs) at N times [s].

        `ended` says how the FMU ended the simulation by itself, if it did.
        """
        values = self._converted(blocks[:, self._index])
        observed_values = np.ascontiguousarray(values[:, : self._observation_count])
        extra_values = np.ascontiguousarray(values[:, self._observation_count :].T)
        extra_histories = dict(zip(self._extra_names, extra_values, strict=True))
        return ObservationHistory(time, observed_values, extra_histories, ended)


def _slice_or_index(
    positions: Sequence[int],
) -> "slice | np.ndarray[tuple[int], np.dtype[np.intp]]":
    """Return positions as a slice if they follow one another, which is faster, else as an array."""
    index = np.array(positions, dtype=np.intp)
    begin = int(index[0]) if len(index) else 0
    end = begin + len(index)
    if np.array_equal(index, np.arange(begin, end)):
        return slice(begin, end)
    return index


def _bound_output(fmu: BoundFmu, name: str, variable: str, unit: str, label: str) -> _BoundOutput:
    """Return an output in the given unit; without one, in the FMU's own unit."""
    selection = fmu.find(variable, label, "output")
    unit = unit or selection.variable.unit or "1"
    return _BoundOutput(name, selection, unit, fmu.unit_conversion(selection.variable, unit, label))


def _observed_outputs(fmu: BoundFmu, faults: BindingFaults) -> list[_BoundOutput]:
    """Return the outputs of all observations, in the order of the binding."""
    outputs = []
    for key, vector in fmu.binding.observation.items():
        label = f"observation.{key}"
        for variable, unit in zip(vector.variables, vector.units, strict=True):
            with faults.collect(label):
                outputs.append(_bound_output(fmu, variable, variable, unit, label))
    return outputs


def _extra_outputs(
    fmu: BoundFmu, ports: Sequence[PortQuantity], faults: BindingFaults
) -> list[_BoundOutput]:
    """Return the outputs other than observations: monitors, recorded variables, outputs of ports.

    Errors are collected in `faults`.
    """
    outputs = []
    for name, scalar in fmu.binding.monitor.items():
        label = f"monitor.{name}"
        with faults.collect(label):
            outputs.append(_bound_output(fmu, name, scalar.variable, scalar.unit, label))
    for variable in fmu.binding.record.variables:
        with faults.collect("record.variables"):
            outputs.append(_bound_output(fmu, variable, variable, "", "record.variables"))
    for quantity in ports:
        if not quantity.is_read:
            continue
        variables = quantity.vector.variables
        unit = quantity.vector.units[0]
        for number, variable in enumerate(variables, 1):
            name = f"{quantity.name}[{number}]" if len(variables) > 1 else quantity.name
            with faults.collect(quantity.label):
                outputs.append(_bound_output(fmu, name, variable, unit, quantity.label))
    return outputs


class Blocks:
    """A binding resolved against an FMU: request, reply, and values set before the start.

    Attributes
    ----------
    description : FmuDescription
        The FMU, with the array sizes of the binding.
    request : Request
        Inputs of a step.
    reply : Reply
        Outputs after a step.
    initial_values : InitialValueTable
        Values that are set before the initialisation.
    health_at_start : dict of str to BoundInput
        Health that is set before the initialisation only, by the binding's names.
    plan : Plan
        What each call exchanges with the instance; its folder is filled in later.

    Raises
    ------
    BindingError
        If a variable is missing, of the wrong causality or type, or in another unit, or the FMU is
        of another version.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        _check_version(description, binding)
        description, configuration = with_structural_parameters(description, binding)

        def element_names_of(name: str) -> Sequence[str]:
            variable = description.variable(name)
            return (name,) if variable is None else variable.elements

        self.description = description
        self.binding = binding.with_arrays(element_names_of)
        fmu = BoundFmu(description, self.binding)
        faults = BindingFaults(binding.title)
        ports = fmu.port_quantities(faults)
        inputs = _selected_inputs(fmu, ports, faults)
        self.initial_values = InitialValueTable(fmu, faults)
        observed = _observed_outputs(fmu, faults)
        extras = _extra_outputs(fmu, ports, faults)
        faults.raise_if_any()
        self.health_at_start = self.initial_values.health
        self.request = Request(fmu, inputs)
        self.reply = Reply(fmu, observed, extras)
        self.plan = self._plan(configuration)

    def _plan(self, configuration: list[InitialValue]) -> Plan:
        """Return the plan by which a worker starts the instance; its folder is not known yet.

        If the binding states no tolerance, the FMU gets the tolerance that it declares; the solver
        for model exchange then uses the smaller of this and `SOLVER_TOLERANCE`.
        """
        description = self.description
        header = self.binding.binding
        declared_tolerance = min(description.tolerance or 1.0, SOLVER_TOLERANCE)
        return Plan(
            folder="",
            fmu=description.identity,
            instance_name=self.binding.name,
            inputs=self.request.layout.groups,
            outputs=self.reply.layout.groups,
            substeps=header.decimation,
            tolerance=header.tolerance or description.tolerance,
            solver_tolerance=header.tolerance or declared_tolerance,
            stop_time=header.stop_time,
            configuration=configuration,
        )

    def bound_input(self, role: str, name: str) -> BoundInput:
        """Return an input of the binding, including health that is set at the start only.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        if role == "health" and name in self.health_at_start:
            return self.health_at_start[name]
        return self.request.bound_input(role, name)

    def settings(
        self,
        parameters: Mapping[str, npt.ArrayLike],
        health: Mapping[str, npt.ArrayLike] | None = None,
    ) -> InitialValues:
        """Return the values that are set before the start; see `InitialValueTable`."""
        return self.initial_values.initial_values(parameters, health)


def _check_version(description: FmuDescription, binding: Binding) -> None:
    """Raise an error if the FMU does not have the version of FMI that the binding states."""
    version = binding.binding.fmi_version
    if version is not None and version[0] != description.fmi_version[0]:
        raise BindingError(
            f"The binding {binding.title} is for FMI {version}, but {description.label} is of FMI "
            f"{description.fmi_version}; correct `fmi_version`, or leave it out."
        )
