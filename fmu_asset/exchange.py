"""A binding resolved against an FMU: what is sent and read, where it stands in the blocks, in which units."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .archive import FmuDescription, VariableInfo
from .binding import INPUT_ROLES, Binding, Scalar
from .errors import BindingError, FmuFileError, FmuInputError
from .instance import Plan, Settings
from .units import IDENTITY, Conversion, conversion

_KINDS = {"Real": "Real", "Integer": "Integer", "Enumeration": "Integer", "Boolean": "Boolean"}
_CAUSALITY = {
    "input": ("input",),
    "parameter": ("parameter",),
    "output": ("output", "local", "calculatedParameter"),
}


class _Slot(NamedTuple):
    """Where an input goes: position in the request block, range in the FMU's unit, conversion."""

    position: int
    low: float
    high: float
    conversion: Conversion
    label: str
    whole: bool
    direct: bool
    variable: VariableInfo


class Exchange:
    """What an asset exchanges with its FMU.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    binding : Binding
        The binding.

    Attributes
    ----------
    plan : Plan
        For the instance; its folder is still empty.

    Raises
    ------
    BindingError
        If a variable is missing, of the wrong causality or type, or in another unit.
    """

    def __init__(self, description: FmuDescription, binding: Binding) -> None:
        self._description, self._binding = description, binding
        self._slots: dict[str, dict[str, _Slot]] = {}
        self.plan = self._make_plan()
        self._parameter_slots = self._make_slots("parameter")

    def _make_plan(self) -> Plan:
        """Resolve all names of the binding and lay out the two blocks."""
        binding, inputs = self._binding, {}
        for role in INPUT_ROLES:
            self._slots[role] = self._make_slots(role)
            inputs.update({slot.label: slot for slot in self._slots[role].values()})
        order = {"Real": 0, "Integer": 1, "Boolean": 2}
        # Stable: within a base type the order is that of the binding.
        labels = sorted(inputs, key=lambda label: order[_KINDS[inputs[label].variable.kind]])
        self._ordered = [inputs[label].variable for label in labels]
        for role, slots in self._slots.items():
            self._slots[role] = {
                name: slot._replace(position=2 + labels.index(slot.label)) for name, slot in slots.items()
            }
        observed = [
            (name, self._resolve(name, f"observation.{key}", "output"), unit, f"observation.{key}")
            for key, vector in binding.observation.items()
            for name, unit in zip(vector.variables, vector.units, strict=True)
        ]
        monitored = [
            (
                name,
                self._resolve(scalar.variable, f"monitor.{name}", "output"),
                scalar.unit,
                f"monitor.{name}",
            )
            for name, scalar in binding.monitor.items()
        ]
        everything = [*observed, *monitored]
        outputs = sorted(range(len(everything)), key=lambda i: order[_KINDS[everything[i][1].kind]])
        place = {which: position for position, which in enumerate(outputs)}
        self._output_names = [everything[which][1].name for which in outputs]
        conversions = [
            conversion(unit, variable, self._description.units, where=where)
            for _, variable, unit, where in everything
        ]
        self._observation_count = len(observed)
        index = np.array([place[which] for which in range(len(observed))])
        self._observation_index = None if np.array_equal(index, np.arange(len(observed))) else index
        own = conversions[: len(observed)]
        self._observation_scale = (
            None
            if all(item == IDENTITY for item in own)
            else (np.array([item.factor for item in own]), np.array([item.offset for item in own]))
        )
        self._monitors = [
            (name, place[which], None if conversions[which] == IDENTITY else conversions[which])
            for which, (name, *_) in enumerate(monitored, len(observed))
        ]

        def references(kind: str, variables: Sequence[VariableInfo]) -> list[int]:
            return [variable.reference for variable in variables if _KINDS[variable.kind] == kind]

        read = [everything[which][1] for which in outputs]
        return Plan(
            folder="",
            guid=self._description.guid,
            model_identifier=self._description.model_identifier,
            instance_name=binding.name,
            real_inputs=references("Real", self._ordered),
            integer_inputs=references("Integer", self._ordered),
            boolean_inputs=references("Boolean", self._ordered),
            real_outputs=references("Real", read),
            integer_outputs=references("Integer", read),
            boolean_outputs=references("Boolean", read),
        )

    def _make_slots(self, role: str) -> dict[str, _Slot]:
        slots = {}
        table: Mapping[str, Scalar] = getattr(self._binding, role)
        for name, scalar in table.items():
            label = f"{role}.{name}"
            causality = "parameter" if role == "parameter" else "input"
            variable = self._resolve(scalar.variable, label, causality)
            scale = conversion(scalar.unit, variable, self._description.units, where=label)
            whole = variable.kind != "Real"
            slots[name] = _Slot(
                position=0,
                low=-math.inf if variable.minimum is None else variable.minimum,
                high=math.inf if variable.maximum is None else variable.maximum,
                conversion=scale,
                label=label,
                whole=whole,
                direct=scale == IDENTITY and not whole,
                variable=variable,
            )
        return slots

    def _resolve(self, name: str, label: str, causality: str) -> VariableInfo:
        variable = self._description.variable(name)
        if variable is None:
            near = difflib.get_close_matches(name, [v.name for v in self._description.variables], 1, 0.6)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise BindingError(
                f"{label} of the binding {self._binding.name} names {name!r}, which is not a variable of "
                f"{self._description.path}{hint}"
            )
        if variable.causality not in _CAUSALITY[causality]:
            raise BindingError(
                f"{label} of the binding {self._binding.name} must be of causality {causality}, but {name!r} "
                f"is declared as {variable.causality} in {self._description.path}."
            )
        if variable.kind not in _KINDS:
            raise BindingError(
                f"{label} of the binding {self._binding.name} names {name!r}, which is of type "
                f"{variable.kind}; only numbers can be bound."
            )
        return variable

    def start_values(self) -> list[float]:
        """Return a request block with the FMU's own start values of the inputs.

        Raises
        ------
        FmuFileError
            If a start value is no number.
        """
        try:
            return [0.0, 0.0, *(_start_value(variable) for variable in self._ordered)]
        except ValueError as error:
            raise FmuFileError(
                f"An input of {self._description.path} has a start value that is no number ({error})."
            ) from error

    def settings(self, parameters: Mapping[str, float]) -> Settings:
        """Return what is set before initialisation: the values of the binding, then the caller's.

        Parameters
        ----------
        parameters : mapping of str to float
            By the binding's names and in its units.

        Returns
        -------
        Settings
            Base type, value reference, value in the FMU's unit.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        slots = self._parameter_slots
        for name in parameters:
            if name not in slots:
                raise BindingError(
                    f"The binding {self._binding.name} has no parameter {name!r}; "
                    f"it has {', '.join(slots) or 'none'}."
                )
        fixed = {
            name: parameter.value
            for name, parameter in self._binding.parameter.items()
            if parameter.value is not None
        }
        return [
            (_KINDS[slots[name].variable.kind], slots[name].variable.reference, _checked(slots[name], value))
            for name, value in {**fixed, **parameters}.items()
        ]

    def place(
        self,
        target: Any,
        control: Mapping[str, float] | None,
        health: Mapping[str, float] | None,
        load: Mapping[str, float] | None,
    ) -> bool:
        """Put inputs where they belong; return whether there were any.

        Parameters
        ----------
        target : list of float or ctypes array
            A request block; changed in place.
        control, health, load : mapping of str to float or None
            By the binding's names and in its units.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        given = False
        for role, values in (("control", control), ("health", health), ("load", load)):
            if not values:
                continue
            given = True
            slots = self._slots[role]
            for name, value in values.items():
                slot = slots.get(name)
                if slot is None:
                    raise BindingError(
                        f"The binding {self._binding.name} has no {role} {name!r}; "
                        f"it has {', '.join(slots) or 'none'}."
                    )
                # NaN fails the comparisons; the last one is for an infinity in a range without limit.
                if (
                    slot.direct
                    and isinstance(value, float)
                    and slot.low <= value <= slot.high
                    and value - value == 0.0
                ):
                    target[slot.position] = value
                else:
                    target[slot.position] = _checked(slot, value)
        return given

    def read(self, block: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.float64], dict[str, float]]:
        """Return observations and monitors in the binding's units.

        Parameters
        ----------
        block : (n_outputs,) ndarray
            The reply block.

        Returns
        -------
        values : (n_obs,) ndarray
            The observations in the order of the binding.
        extra : dict of str to float
            The monitors.
        """
        if self._observation_index is None:
            values = block[: self._observation_count].copy()
        else:
            values = block[self._observation_index]
        if self._observation_scale is not None:
            factor, offset = self._observation_scale
            values = (values - offset) / factor
        extra = {
            name: block.item(index) if scale is None else scale.from_fmu(block.item(index))
            for name, index, scale in self._monitors
        }
        return values, extra

    def not_finite(self, block: npt.NDArray[np.float64]) -> list[str]:
        """Return the names of outputs that are NaN or infinite."""
        count = len(self._output_names)
        return [self._output_names[index] for index in np.flatnonzero(~np.isfinite(block[:count]))]


def _checked(slot: _Slot, value: float) -> float:
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
        unit = slot.variable.unit
        raise FmuInputError(
            f"{slot.label} = {value!r} lies outside the range of {slot.variable.name!r}, {slot.low:g} to "
            f"{slot.high:g}{'' if unit in (None, '1') else f' {unit}'}; nothing was sent to the FMU."
        )
    return inside


def _start_value(variable: VariableInfo) -> float:
    text = (variable.start or "0").lower()
    return float({"true": "1", "false": "0"}.get(text, text))
