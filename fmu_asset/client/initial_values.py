"""Values that are set before the initialisation: parameters, and health that needs a new start."""

from collections.abc import Mapping

import numpy.typing as npt

from fmu_asset.archive.declared import VariableInfo
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.instances.plan import InitialValue, InitialValues
from reporting.words import comma_list

from .bound_variables import InputBinding
from .layout import start_values
from .resolver import BindingResolver
from .slots import InputSlot
from .values import InputsByRole


class InitialValueTable:
    """Parameters and start values of an FMU that a binding names.

    Parameters
    ----------
    resolver : BindingResolver
        The binding and the FMU.

    Attributes
    ----------
    health_slots : dict of str to InputSlot
        Health that is a parameter or start value of the FMU, by the binding's names.

    Raises
    ------
    BindingError
        If a parameter does not fit the FMU.
    """

    def __init__(self, resolver: BindingResolver) -> None:
        self._resolver = resolver
        self.health_slots: dict[str, InputSlot] = {}
        for name, input_binding in resolver.binding.health.items():
            if resolver.is_set_at_start(input_binding.variable):
                self.health_slots[name] = resolver.start_slot(f"health.{name}", input_binding)
        self._text_parameters: dict[str, VariableInfo] = {}
        self._parameter_slots: dict[str, InputSlot] = {}
        for name, input_binding in resolver.binding.parameter.items():
            variable = resolver.description.variable(input_binding.variable)
            if variable is not None and variable.is_text_parameter:
                self._text_parameters[name] = variable
            else:
                self._parameter_slots[name] = resolver.start_slot(
                    f"parameter.{name}", input_binding
                )

    def split_inputs(
        self, inputs: InputsByRole
    ) -> tuple[InputsByRole, Mapping[str, npt.ArrayLike]]:
        """Return the inputs that are sent at every step, and the health that is set at a start.

        Parameters
        ----------
        inputs : mapping of str to mapping or None
            Inputs by role and name.

        Returns
        -------
        sent_health : dict of str to mapping or None
            The same without health that is set at a start.
        health : mapping of str to float
            That health.
        """
        health = inputs.get("health") or {}
        at_start = {name: value for name, value in health.items() if name in self.health_slots}
        sent_health = {
            name: value for name, value in health.items() if name not in self.health_slots
        }
        return {**inputs, "health": sent_health}, at_start

    def initial_values(
        self,
        parameters: Mapping[str, npt.ArrayLike],
        health: Mapping[str, npt.ArrayLike] | None = None,
    ) -> InitialValues:
        """Return the values to set before the initialisation: the binding's, then the caller's.

        Parameters
        ----------
        parameters : mapping of str to float or sequence of float
            Parameters by the binding's names and in its units; one that the binding does not name
            goes by its name in the FMU, in the FMU's unit.
        health : mapping of str to float, optional
            Health that is set at a start only, by the binding's names and in its units.

        Raises
        ------
        BindingError
            If a name is unknown.
        FmuInputError
            If a value is not finite or outside its range.
        """
        texts: InitialValues = []
        slots_and_values: list[tuple[InputSlot, npt.ArrayLike]] = []
        for name, value in {**self._values_of_binding(), **parameters}.items():
            text_parameter = self._text_parameter(name)
            if text_parameter is None:
                slots_and_values.append((self._parameter_slot(name), value))
            elif isinstance(value, str):
                texts.append(InitialValue("String", text_parameter.reference, [value]))
            else:
                raise FmuInputError(f"parameter.{name} must be a text, but is {value!r}.")
        for name, value in (health or {}).items():
            slots_and_values.append((self.health_slots[name], value))
        return [*self._numbers(slots_and_values), *texts]

    def _values_of_binding(self) -> dict[str, float | str]:
        """Return the parameters that have a value in the binding."""
        entries = self._resolver.binding.parameter.items()
        return {name: entry.value for name, entry in entries if entry.value is not None}

    def _numbers(
        self, slots_and_values: list[tuple[InputSlot, npt.ArrayLike]]
    ) -> list[InitialValue]:
        """Return the values of numeric variables; several slots may be elements of one array."""
        numbers_by_variable: dict[str, list[float]] = {}
        variables: dict[str, VariableInfo] = {}
        description = self._resolver.description
        for slot, value in slots_and_values:
            variable = slot.variable
            if variable.name not in variables:
                variables[variable.name] = variable
                sets_all = len(slot.positions) == variable.size
                start = start_values(description, variable, placeholders=sets_all)
                numbers_by_variable[variable.name] = start
            numbers = numbers_by_variable[variable.name]
            for position, number in zip(slot.positions, slot.numbers(value).tolist(), strict=True):
                numbers[position] = number
        initial_values = []
        for name, variable in variables.items():
            kind = description.exchange_kind(variable)
            numbers = numbers_by_variable[name]
            initial_values.append(InitialValue(kind, variable.reference, numbers))
        return initial_values

    # ------------------------------------------------------------------ names

    def _parameter_slot(self, name: str) -> InputSlot:
        """Return the slot of a numeric parameter, named as in the binding or as in the FMU."""
        if name in self._parameter_slots:
            return self._parameter_slots[name]
        resolver = self._resolver
        variable = resolver.description.variable(name)
        bound_variables = {slot.variable.name for slot in self._parameter_slots.values()}
        if variable is None or variable.causality != "parameter" or name in bound_variables:
            raise BindingError(
                f"The binding {resolver.binding.name} has no parameter {name!r}; it has "
                f"{comma_list(resolver.binding.parameter)}."
            )
        input_binding = InputBinding(variable=name, unit=variable.unit or "1")
        return resolver.start_slot(f"parameter.{name}", input_binding)

    def _text_parameter(self, name: str) -> VariableInfo | None:
        """Return the text parameter that the binding or the FMU has by a name; None without one."""
        if name in self._text_parameters or name in self._parameter_slots:
            return self._text_parameters.get(name)
        variable = self._resolver.description.variable(name)
        if variable is None or not variable.is_text_parameter:
            return None
        bound_variables = {parameter.name for parameter in self._text_parameters.values()}
        return None if name in bound_variables else variable
