"""Values that are set before the initialisation: parameters, and health that is one."""

from collections.abc import Mapping

import numpy.typing as npt

from fmu_asset.archive.declared import VariableInfo
from fmu_asset.errors import BindingError, FmuInputError
from fmu_asset.instances.plan import InitialValue, InitialValues
from reporting.words import comma_list

from .bound_fmu import BindingFaults, BoundFmu, start_values
from .bound_input import BoundInput
from .bound_variables import InputBinding
from .values import InputsByRole


class InitialValueTable:
    """The parameters and start values that a binding names, checked and converted.

    Parameters
    ----------
    faults : BindingFaults
        Collects the entries that do not fit.

    Attributes
    ----------
    health : dict of str to BoundInput
        Health that is a parameter or start value of the FMU, by the binding's names.
    """

    def __init__(self, fmu: BoundFmu, faults: BindingFaults) -> None:
        self._fmu = fmu
        self.health: dict[str, BoundInput] = {}
        for name, entry in fmu.binding.health.items():
            if fmu.is_set_at_start(entry.variable):
                label = f"health.{name}"
                with faults.collect(label):
                    self.health[name] = fmu.start_input(label, entry)
        self._text_parameters: dict[str, VariableInfo] = {}
        self._parameters: dict[str, BoundInput] = {}
        for name, parameter in fmu.binding.parameter.items():
            variable = fmu.description.variable(parameter.variable)
            if variable is not None and variable.is_text_parameter:
                self._text_parameters[name] = variable
                continue
            label = f"parameter.{name}"
            with faults.collect(label):
                self._parameters[name] = fmu.start_input(label, parameter)

    def split_inputs(
        self, inputs: InputsByRole
    ) -> tuple[InputsByRole, Mapping[str, npt.ArrayLike]]:
        """Split inputs by role into those sent at every step, and health set at a start."""
        health = inputs.get("health") or {}
        at_start = {name: value for name, value in health.items() if name in self.health}
        sent_health = {name: value for name, value in health.items() if name not in self.health}
        return {**inputs, "health": sent_health}, at_start

    def initial_values(
        self,
        parameters: Mapping[str, npt.ArrayLike],
        health: Mapping[str, npt.ArrayLike] | None = None,
    ) -> InitialValues:
        """Return the values to set before the initialisation: the binding's and the caller's.

        If both have a value for one parameter, the caller's holds.

        Parameters
        ----------
        parameters : mapping of str to float or sequence of float
            Parameters by the binding's names and in its units. One that the binding does not name
            has its name and unit in the FMU.
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
        inputs_and_values: list[tuple[BoundInput, npt.ArrayLike]] = []
        values: dict[str, npt.ArrayLike] = {
            name: entry.value
            for name, entry in self._fmu.binding.parameter.items()
            if entry.value is not None
        }
        values |= parameters
        for name, value in values.items():
            text_parameter = self._text_parameter(name)
            if text_parameter is None:
                inputs_and_values.append((self._parameter(name), value))
            elif isinstance(value, str):
                texts.append(InitialValue("String", text_parameter.reference, [value]))
            else:
                raise FmuInputError(f"parameter.{name} must be a text, but is {value!r}.")
        for name, value in (health or {}).items():
            inputs_and_values.append((self.health[name], value))
        return [*self._numbers(inputs_and_values), *texts]

    def _numbers(
        self, inputs_and_values: list[tuple[BoundInput, npt.ArrayLike]]
    ) -> list[InitialValue]:
        """Return one value for each numeric variable, with the elements of an array put together.

        Elements of an array that no input sets have their start values.
        """
        numbers_by_variable: dict[str, list[float]] = {}
        variables: dict[str, VariableInfo] = {}
        description = self._fmu.description
        for bound_input, value in inputs_and_values:
            variable = bound_input.variable
            if variable.name not in variables:
                variables[variable.name] = variable
                sets_all = len(bound_input.positions) == variable.size
                start = start_values(description, variable, placeholders=sets_all)
                numbers_by_variable[variable.name] = start
            numbers = numbers_by_variable[variable.name]
            for position, number in zip(
                bound_input.positions, bound_input.numbers(value).tolist(), strict=True
            ):
                numbers[position] = number
        initial_values = []
        for name, variable in variables.items():
            kind = description.exchange_kind(variable)
            numbers = numbers_by_variable[name]
            initial_values.append(InitialValue(kind, variable.reference, numbers))
        return initial_values

    # ------------------------------------------------------------------ names

    def _parameter(self, name: str) -> BoundInput:
        """Return a numeric parameter by its name in the binding, or else in the FMU."""
        if name in self._parameters:
            return self._parameters[name]
        fmu = self._fmu
        variable = fmu.description.variable(name)
        bound_variables = {bound_input.variable.name for bound_input in self._parameters.values()}
        if variable is None or variable.causality != "parameter" or name in bound_variables:
            raise BindingError(
                f"The binding {fmu.binding.name} has no parameter {name!r}; it has "
                f"{comma_list(fmu.binding.parameter)}."
            )
        input_binding = InputBinding(variable=name, unit=variable.unit or "1")
        return fmu.start_input(f"parameter.{name}", input_binding)

    def _text_parameter(self, name: str) -> VariableInfo | None:
        """Return a text parameter by its name in the binding or the FMU; None without one."""
        if name in self._text_parameters or name in self._parameters:
            return self._text_parameters.get(name)
        variable = self._fmu.description.variable(name)
        if variable is None or not variable.is_text_parameter:
            return None
        bound_variables = {parameter.name for parameter in self._text_parameters.values()}
        return None if name in bound_variables else variable
