"""A binding resolved against an FMU: what is sent and read, where it stands in the blocks, in which units."""

import operator
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuInputError, said
from fmu_asset.instances.plan import SOLVER_TOLERANCE, Plan, Settings

from .binding import INPUT_ROLES, Binding, InputBinding, VectorBinding
from .layout import (
    BlockLayout,
    InputSlot,
    OutputTable,
    VariableElements,
    find_variable,
    start_values,
    with_structural_parameters,
)
from .units import IDENTITY, conversion
from .values import Histories, Values

_LARGEST = sys.float_info.max
_NOWHERE = (0, 1.0, 0.0)


class Exchange:
    """What an asset exchanges with its FMU.

    Attributes
    ----------
    description : FmuDescription
        The FMU, with the structural parameters of the binding.
    binding : Binding
        The binding, with arrays that are observed or recorded as their elements.
    plan : Plan
        For the instance; its folder is still empty.
    outputs : OutputTable
        What is read of the reply block.
    recorded_units : dict of str to str
        Units of what is read beside the observations, by name.
    output_names : list of str
        Names of all values of the reply block.
    sent, read : tuple of VariableInfo
        What stands in the request and in the reply block, in order.
    health_slots : dict of str to InputSlot
        Health that is a parameter or start value of the FMU, which is set before the initialisation only.

    Raises
    ------
    BindingError
        If a variable is missing, of the wrong causality or type, or in another unit, or the FMU is of another
        version.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        wanted = binding.binding.fmi_version
        if wanted is not None and wanted[0] != description.fmi_version[0]:
            raise BindingError(
                said("binding.fmi_version", binding=binding, wanted=wanted, fmu=description)
            )
        description, configuration = with_structural_parameters(description, binding)
        self.description = description
        self.binding = binding.with_arrays(self._elements)
        self._whose = f"of the binding {binding.name}"
        self._ports = self._port_vectors()
        self._make_outputs()
        self._make_inputs()
        self.sent, self.read = self._inputs.variables, self._outputs.variables
        self.plan = Plan(
            folder="",
            fmu=description.identity,
            instance_name=binding.name,
            inputs=self._inputs.groups,
            outputs=self._outputs.groups,
            substeps=binding.binding.decimation,
            tolerance=binding.binding.tolerance or description.tolerance,
            solver_tolerance=binding.binding.tolerance
            or min(description.tolerance or 1.0, SOLVER_TOLERANCE),
            stop_time=binding.binding.stop_time,
            configuration=configuration,
        )

    # ------------------------------------------------------------------ resolving

    def _elements(self, name: str) -> tuple[str, ...]:
        variable = self.description.variable(name)
        return (name,) if variable is None else variable.elements

    def _find(self, name: str, label: str, causality: str) -> VariableElements:
        return find_variable(self.description, name, f"{label} {self._whose}", causality)

    def _port_vectors(self) -> list[tuple[str, VectorBinding, bool]]:
        """Return what ports have: name, vector, and whether it is read, which is so of force or of motion."""
        found = []
        for name, port in self.binding.port.items():
            reads: dict[str, bool] = {}
            for quantity, vector in port.quantities.items():
                label = f"port.{name}.{quantity}"
                if len(vector.variables) != len(port.force.variables):
                    what, came = (
                        f"{label} {self._whose}",
                        (len(vector.variables), len(port.force.variables)),
                    )
                    raise BindingError(said("binding.port_values", what=what, came=came))
                read = {not self._is_input(variable) for variable in vector.variables}
                if len(read) > 1:
                    raise BindingError(
                        f"{label} {self._whose} mixes inputs and outputs of the FMU."
                    )
                reads[quantity] = read.pop()
                found.append((f"{name}.{quantity}", vector, reads[quantity]))
            force = reads.pop("force")
            if force in reads.values():
                what, both = f"port.{name} {self._whose}", "outputs" if force else "inputs"
                raise BindingError(said("binding.port_sides", what=what, both=both))
        return found

    def _is_input(self, name: str) -> bool:
        variable = self.description.variable(name) or self.description.variable(
            name.rpartition("[")[0]
        )
        return variable is not None and variable.causality == "input"

    def _make_inputs(self) -> None:
        """Lay out the request block: time, step size, all inputs."""
        health_at_start = {
            name: item
            for name, item in self.binding.health.items()
            if self._is_set_at_start(item.variable)
        }
        wanted: list[tuple[str, str, InputBinding, tuple[str, ...]]] = [
            (role, name, item, (item.variable,))
            for role in INPUT_ROLES
            for name, item in self.binding.inputs(role).items()
            if not (role == "health" and name in health_at_start)
        ]
        wanted += [
            (
                "port",
                name,
                InputBinding(variable=vector.variables[0], unit=vector.units[0]),
                vector.variables,
            )
            for name, vector, read in self._ports
            if not read
        ]
        places = [
            [self._find(variable, f"{role}.{name}", "input") for variable in variables]
            for role, name, _, variables in wanted
        ]
        sent = [place.variable for found in places for place in found]
        linear = self.binding.binding.interpolation == "linear"
        self._inputs = BlockLayout(self.description, sent, begin=2, linear=linear)
        self._check_lines()
        self._slots: dict[str, dict[str, InputSlot]] = {role: {} for role in (*INPUT_ROLES, "port")}
        taken: dict[int, str] = {}
        for (role, name, item, _), found in zip(wanted, places, strict=True):
            label = f"{role}.{name}"
            if len({(place.variable.unit, place.variable.kind) for place in found}) > 1:
                raise BindingError(said("binding.port_units", label=label, whose=self._whose))
            positions = [position for place in found for position in self._inputs.positions(place)]
            for position in positions:
                if position in taken:
                    both, variable = f"{label} and {taken[position]}", found[0].variable
                    raise BindingError(
                        said("binding.same_value", self=self, both=both, variable=variable)
                    )
                taken[position] = label
            self._slots[role][name] = self._slot(label, item, found[0].variable, positions)
        # What is sent as it is: real numbers within these limits, which NaN and infinities are not.
        self._plain = {
            role: {
                name: (slot.positions[0], max(slot.low, -_LARGEST), min(slot.high, _LARGEST))
                for name, slot in slots.items()
                if slot.conversion == IDENTITY and not slot.whole and len(slot.positions) == 1
            }
            for role, slots in self._slots.items()
        }
        self.health_slots = {
            name: self._start_slot(f"health.{name}", item) for name, item in health_at_start.items()
        }
        self._text_parameters: dict[str, VariableInfo] = {}
        self._parameter_slots: dict[str, InputSlot] = {}
        for name, item in self.binding.parameter.items():
            text = self.description.variable(item.variable)
            if text is not None and text.is_text_parameter:
                self._text_parameters[name] = text
            else:
                self._parameter_slots[name] = self._start_slot(f"parameter.{name}", item)

    def _is_set_at_start(self, name: str) -> bool:
        """Return whether a variable can be set before the initialisation only."""
        variable = self.description.variable(name) or self.description.variable(
            name.rpartition("[")[0]
        )
        if variable is None:
            return False
        tunable = (
            variable.variability == "tunable" and self.description.interface == "co-simulation"
        )
        return variable.startable or (variable.causality == "parameter" and not tunable)

    def _start_slot(self, label: str, item: InputBinding) -> InputSlot:
        """Return where a value goes before initialisation; positions count from the variable's own values."""
        place = self._find(item.variable, label, "parameter")
        return self._slot(label, item, place.variable, place.elements)

    def _check_lines(self) -> None:
        """Refuse straight lines of inputs where the FMU or none of its inputs can follow them."""
        if self.binding.binding.interpolation == "zero-order":
            return
        asked = f"The binding {self.binding.name} asks for linear interpolation of inputs, but"
        path = self.description.label
        if not self.description.can_interpolate_inputs:
            why = (
                "FMI 3.0 has no derivatives of inputs in co-simulation"
                if self.description.major_version == 3
                else "it does not declare `canInterpolateInputs`"
            )
            raise BindingError(said("binding.no_derivatives", asked=asked, path=path, why=why))
        if not any(group.linear for group in self._inputs.groups):
            raise BindingError(
                f"{asked} none of them is a continuous real number in {path}; leave it out."
            )

    def _own_slot(self, name: str) -> InputSlot:
        """Return the slot of a parameter by its name in the FMU, which the binding does not name."""
        variable = self.description.variable(name)
        bound = {slot.variable.name for slot in self._parameter_slots.values()}
        if variable is None or variable.causality != "parameter" or name in bound:
            known = self.binding.parameter
            raise BindingError(said("binding.no_parameter", self=self, name=name, known=known))
        return self._start_slot(
            f"parameter.{name}", InputBinding(variable=name, unit=variable.unit or "1")
        )

    def _text_parameter(self, name: str) -> VariableInfo | None:
        """Return the text that a name of the binding, or else of the FMU, means; None if it means none."""
        if name in self._text_parameters or name in self._parameter_slots:
            return self._text_parameters.get(name)
        variable = self.description.variable(name)
        bound = {variable.name for variable in self._text_parameters.values()}
        is_own = variable is not None and variable.is_text_parameter and name not in bound
        return variable if is_own else None

    def _slot(
        self, label: str, item: InputBinding, variable: VariableInfo, positions: Sequence[int]
    ) -> InputSlot:
        scale = conversion(item.unit, variable, self.description.units_of(variable), where=label)
        low, high = variable.bounds
        least, most = sorted(scale.to_fmu(end) for end in item.ends)
        if least > high or most < low:
            ends, what = (low, high), f"{label} {self._whose}"
            raise BindingError(said("binding.range", what=what, variable=variable, ends=ends))
        return InputSlot(label, positions, max(low, least), min(high, most), scale, variable)

    def _make_outputs(self) -> None:
        """Lay out the reply block: observations, monitors, records, outputs of ports."""
        binding = self.binding
        wanted = [
            (name, name, unit, f"observation.{key}")
            for key, vector in binding.observation.items()
            for name, unit in zip(vector.variables, vector.units, strict=True)
        ]
        count = len(wanted)
        wanted += [
            (name, one.variable, one.unit, f"monitor.{name}")
            for name, one in binding.monitor.items()
        ]
        wanted += [(name, name, "", "record.variables") for name in binding.record.variables]
        for label, vector, read in self._ports:
            several = len(vector.variables) > 1
            wanted += [
                (f"{label}[{number}]" if several else label, name, vector.units[0], f"port.{label}")
                for number, name in enumerate(vector.variables if read else (), 1)
            ]
        places = [self._find(name, where, "output") for _, name, _, where in wanted]
        self._outputs = BlockLayout(self.description, [place.variable for place in places], begin=0)
        self.output_names = self._outputs.names()
        units, scales = [], []
        for (_, _, unit, where), (variable, _) in zip(wanted, places, strict=True):
            units.append(unit or variable.unit or "1")
            known = self.description.units_of(variable)
            scales.append(conversion(units[-1], variable, known, where=where))
        # A name that stands there twice is that of its last value.
        extra = {name: which for which, (name, *_) in enumerate(wanted[count:], count)}
        chosen = [*range(count), *extra.values()]
        positions = [self._outputs.positions(places[which])[0] for which in chosen]
        self.outputs = OutputTable(count, [*extra], positions, [scales[which] for which in chosen])
        self.recorded_units = {name: units[which] for name, which in extra.items()}

    # ------------------------------------------------------------------ sending

    def start_values(self, given: Mapping[str, Any]) -> list[float]:
        """Return a request block with the FMU's own start values of the inputs.

        Parameters
        ----------
        given : mapping of str to mapping or None
            What is going to be put in their place, by role: whole arrays of it are left at zero.

        Raises
        ------
        FmuFileError
            If a start value is no number.
        """
        values = [0.0, 0.0]
        slots = [self.slot(role, name) for role, part in given.items() for name in part or ()]
        whole = {slot.variable.name for slot in slots if len(slot.positions) == slot.variable.size}
        for variable in self._inputs.variables:
            values += start_values(self.description, variable, given=variable.name in whole)
        return values + values[2 : 2 + self.plan.linear_count]

    def settings(self, parameters: Values, health: Values | None = None) -> Settings:
        """Return what is set before initialisation: the values of the binding, then the caller's.

        Parameters
        ----------
        parameters : mapping of str to float or sequence of float
            By the binding's names and in its units; a parameter that the binding does not name goes by its
            name in the FMU, in the FMU's unit.
        health : mapping of str to float, optional
            Health that can be set at a start only, by the binding's names and in its units.

        Returns
        -------
        Settings
            Base type, value reference, values in the FMU's unit.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        fixed = {
            n: entry.value for n, entry in self.binding.parameter.items() if entry.value is not None
        }
        set_values: dict[str, tuple[str, int, list[float]]] = {}
        texts: Settings = []
        slots: list[tuple[InputSlot, Any]] = []
        for name, value in {**fixed, **parameters}.items():
            text_parameter = self._text_parameter(name)
            if text_parameter is None:
                slots.append((self._parameter_slots.get(name) or self._own_slot(name), value))
            elif isinstance(value, str):
                texts.append(("String", text_parameter.reference, [value]))
            else:
                raise FmuInputError(f"parameter.{name} must be a text, but is {value!r}.")
        slots += [(self.health_slots[name], value) for name, value in (health or {}).items()]
        for slot, value in slots:
            variable = slot.variable
            if variable.name not in set_values:
                kind = self.description.exchange_kind(variable)
                whole = len(slot.positions) == variable.size
                start = start_values(self.description, variable, given=whole)
                set_values[variable.name] = (kind, variable.reference, start)
            for position, number in zip(slot.positions, slot.numbers(value).tolist(), strict=True):
                set_values[variable.name][2][position] = number
        return [*set_values.values(), *texts]

    def without_start_health(
        self, inputs: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return inputs by role without the health that is set at a start only, and that health."""
        health = inputs.get("health") or {}
        at_start = {name: value for name, value in health.items() if name in self.health_slots}
        sent = {name: value for name, value in health.items() if name not in self.health_slots}
        return {**inputs, "health": sent}, at_start

    def place(self, target: Any, inputs: Mapping[str, Any]) -> bool:
        """Put inputs where they belong; return whether there were any.

        Parameters
        ----------
        target : list of float or ctypes array
            A request block; changed in place.
        inputs : mapping of str to mapping or None
            By role, and by the binding's names and in its units.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        there = False
        for role, values in inputs.items():
            if not values:
                continue
            there, plain = True, self._plain.get(role, {})
            for name, value in values.items():
                position, low, high = plain.get(name, _NOWHERE)
                if isinstance(value, float) and low <= value <= high:
                    target[position] = value
                    continue
                slot = self.slot(role, name)
                for position, number in zip(
                    slot.positions, slot.numbers(value).tolist(), strict=True
                ):
                    target[position] = number
        return there

    def rows(
        self,
        held: npt.NDArray[np.float64],
        roles: Mapping[str, Histories | None],
        steps: int | None,
    ) -> npt.NDArray[np.float64]:
        """Return the request blocks of many steps, without their times; histories are checked as a whole.

        Parameters
        ----------
        held : (2 + n_inputs,) ndarray
            The last request: what is not given keeps its value.
        roles : mapping of str to mapping
            Inputs by role, then by name.
        steps : int, optional
            Number of steps N; that of the histories if absent.

        Returns
        -------
        (N, 2 + n_inputs) ndarray
            In the FMU's units.

        Raises
        ------
        BindingError
            If a name is not in the binding.
        FmuInputError
            If a value is no number, not finite or out of range, or the histories have different lengths.
        """
        given = [
            (self.slot(role, name), v)
            for role, part in roles.items()
            for name, v in (part or {}).items()
        ]
        arrays = [(slot, slot.numbers(values, history=True)) for slot, values in given]
        rows = np.tile(held, (self.step_count(arrays, steps), 1))
        for slot, array in arrays:
            rows[:, list(slot.positions)] = array
        return rows

    @staticmethod
    def step_count(
        histories: Sequence[tuple[InputSlot, npt.NDArray[np.float64]]], steps: int | None
    ) -> int:
        """Return the number of steps that histories, and who asks for them, agree on.

        Raises
        ------
        FmuInputError
            If they do not agree, or nothing says a number.
        """
        count, source = steps, "`steps`"
        if count is not None:
            count = operator.index(count)
            if count < 1:
                raise FmuInputError(f"steps must be at least 1, but is {count}.")
        for slot, array in histories:
            if array.ndim != 2:
                continue
            if count is None:
                count, source = len(array), slot.label
            elif len(array) != count:
                came = len(array)
                raise FmuInputError(
                    said("inputs.steps", slot=slot, came=came, source=source, of=count)
                )
        if not count:
            raise FmuInputError(said("inputs.no_steps"))
        return count

    def slot(self, role: str, name: str) -> InputSlot:
        """Return where an input goes.

        Raises
        ------
        BindingError
            If the binding has no such input.
        """
        slot = self._slots.get(role, {}).get(name)
        if slot is None and role == "health":
            slot = self.health_slots.get(name)
        if slot is None:
            known = ", ".join(self._slots.get(role, {})) or "none"
            raise BindingError(
                f"The binding {self.binding.name} has no {role} {name!r}; it has {known}."
            )
        return slot
