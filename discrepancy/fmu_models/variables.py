"""The variables of an FMU that a model needs, and the binding to them in SI units."""

from collections.abc import Mapping
from math import pi
from pathlib import Path
from typing import NamedTuple

from discrepancy.campaign.records import Quantity
from discrepancy.campaign.units import UNITS
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import (
    FmuInputSection,
    FmuModelDescription,
    FmuOutputSection,
)
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.binding import Binding, BindingHeader, load_binding
from fmu_asset.client.bound_variables import InputBinding, ParameterBinding, VectorBinding, expand
from reporting.words import counted

REVOLUTIONS = ("1/min", "rpm", "r/min", "rev/min")
"""Units of FMUs in which an angular velocity is revolutions per minute."""
RPM_PER_RADIAN_PER_SECOND = 30.0 / pi


class ObservedVariable(NamedTuple):
    """An output of the model: its name, the variable that it shows, and its SI unit."""

    name: str
    variable: str
    unit: str


class FmuVariables:
    """The variables of an FMU that a model needs.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    folder : Path
        Its folder, where relative names begin.

    Attributes
    ----------
    path : Path
        The FMU.
    binding : Binding
        All inputs as loads, by the FMU's names, and all outputs.
    columns : dict of str to int
        Column of each output of the description, of `port.NAME.displacement` and `.velocity`, and
        of `release`.
    quantities : dict of str to Quantity
        What each output of the description is.
    input_factors : dict of str to float
        Factor of each `[[input]]` of the description, by the FMU's name: revolutions per minute
        stand for an angular velocity and have no unit that converts to rad/s.

    Raises
    ------
    FmuError
        If the FMU or the binding is missing, or a variable is missing or of another causality or
        unit.
    ModelError
        If an output names another number of variables than of names.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        self.path = folder / description.fmu
        self._description = description
        self._fmu = read_fmu(self.path)
        # the binding of the user, if there is one
        step = description.motion.step or description.static.step
        file = description.binding_file(folder)
        if file is None:
            base = Binding(binding=BindingHeader(name=description.name, step_size=step))
        else:
            base = load_binding(file)
        self._variables = _variables_by_name(base)
        self._parameter_keys = {variable.variable: key for key, variable in base.parameter.items()}
        self._parameter_keys |= {key: key for key in base.parameter}
        # what the model needs
        self.input_factors = self._factors_of_inputs()
        self.quantities: dict[str, Quantity] = {}
        loads = self._bound_inputs()
        parameters = self._bound_parameters(base.parameter)
        observed = self._observed_variables()
        self.columns = {variable.name: column for column, variable in enumerate(observed)}
        outputs = VectorBinding(
            variables=tuple(variable.variable for variable in observed),
            unit=tuple(variable.unit for variable in observed),
        )
        header = base.with_header(name=description.name, step_size=step, decimation=1)
        self.binding = Binding(
            binding=header.binding,
            limits=base.limits,
            load=loads,
            parameter=base.parameter | parameters,
            observation={"outputs": outputs},
        )

    def variable(self, name: str) -> str:
        """Return the FMU's name of an input or output that the description names."""
        return self._variables.get(name, name)

    def parameter(self, name: str) -> str:
        """Return the key under which a parameter is set: the binding's key, or the FMU's name."""
        return self._parameter_keys.get(name, name)

    def _bound_inputs(self) -> dict[str, InputBinding]:
        """Return the inputs that trials set, each with its unit, by the FMU's names."""
        description = self._description
        inputs = description.inputs
        units: dict[str | None, str] = dict.fromkeys(inputs.force.values(), "N")
        units[inputs.load_factor] = "1"
        for region_input in inputs.regions.values():
            units[region_input] = "1"
        units[inputs.temperature] = "K" if inputs.temperature_reference is None else "degC"
        units[inputs.bending_moment] = "N.m"
        units[inputs.torque] = "N.m"
        if description.release is not None:
            units[description.release.hold] = "N"
        for port in description.port:
            units[port.force] = "N.m" if port.rotation else "N"
        for section in description.input:
            if self._is_in_revolutions(section):  # `input_factors` converts instead of the binding
                units[section.variable] = self._unit_of_variable(section.variable)
            else:
                units[section.variable] = self._unit_of_quantity(section.quantity, section.variable)
        bound: dict[str, InputBinding] = {}
        for name, unit in units.items():
            if name is not None:  # an optional input that the description does not name
                variable = self.variable(name)
                bound[variable] = InputBinding(variable=variable, unit=unit)
        return bound

    def _factors_of_inputs(self) -> dict[str, float]:
        """Return the factor from the SI value of each `[[input]]` to the value that the FMU takes.

        It is one, as the binding converts units, but for an angular velocity in revolutions.
        """
        factors = {}
        for section in self._description.input:
            factor = RPM_PER_RADIAN_PER_SECOND if self._is_in_revolutions(section) else 1.0
            factors[self.variable(section.variable)] = factor
        return factors

    def _is_in_revolutions(self, section: FmuInputSection) -> bool:
        """Return whether an input is an angular velocity in revolutions per minute."""
        unit = self._unit_of_variable(section.variable)
        return section.quantity is Quantity.ANGULAR_VELOCITY and unit in REVOLUTIONS

    def _bound_parameters(
        self, known_bindings: Mapping[str, ParameterBinding]
    ) -> dict[str, ParameterBinding]:
        """Return the parameters of the model that the binding lacks, or has in another unit.

        Each of them is bound in the unit of the model; a value and a range that the binding states
        are dropped.
        """
        description = self._description
        units: dict[str | None, str] = {
            section.variable: section.unit for section in description.parameter
        }
        if description.release is not None:
            units[description.release.displacement] = "m"
            units[description.release.velocity] = "m/s"
        bound: dict[str, ParameterBinding] = {}
        for name, unit in units.items():
            if name is None:
                continue
            key = self.parameter(name)
            if key not in known_bindings or unit != known_bindings[key].unit:
                variable = known_bindings[key].variable if key in known_bindings else key
                bound[key] = ParameterBinding(variable=variable, unit=unit)
        return bound

    def _observed_variables(self) -> list[ObservedVariable]:
        """Return the outputs of the description, then those of ports and of the release."""
        description = self._description
        observed: list[ObservedVariable] = []
        for section in description.output:
            observed += self._expanded_outputs(section)
        for port in description.port:
            unit = "rad" if port.rotation else "m"
            name = f"port.{port.name}"
            displacement = self.variable(port.displacement)
            observed.append(ObservedVariable(f"{name}.displacement", displacement, unit))
            if port.velocity is not None:
                velocity = self.variable(port.velocity)
                observed.append(ObservedVariable(f"{name}.velocity", velocity, f"{unit}/s"))
        if description.release is not None and description.release.output is not None:
            output = self.variable(description.release.output)
            observed.append(ObservedVariable("release", output, "m"))
        return observed

    def _expanded_outputs(self, section: FmuOutputSection) -> list[ObservedVariable]:
        """Return the observed variables of an output section, and add them to `quantities`.

        A section may stand for several outputs by a pattern `{a..b}` in its name and its variable.
        Raises `ModelError` if the two stand for different numbers of outputs.
        """
        names = expand(section.name)
        variables = expand(section.variable)
        if len(names) != len(variables):
            raise ModelError(
                f"The FMU model {self._description.name!r}: the output {section.name!r} stands for "
                f"{counted(len(names), 'name')}, but its variable stands for {len(variables)}; "
                "give the same number for both."
            )
        outputs = []
        for name, variable in zip(names, variables, strict=True):
            self.quantities[name] = section.quantity
            unit = self._unit_of_quantity(section.quantity, variable)
            outputs.append(ObservedVariable(name, self.variable(variable), unit))
        return outputs

    def _unit_of_quantity(self, quantity: Quantity, variable: str) -> str:
        """Return the SI unit of a quantity in FMU notation; a signal has its variable's unit."""
        if quantity is Quantity.SIGNAL:
            return self._unit_of_variable(variable)
        return UNITS[quantity].si.replace(" ", ".")

    def _unit_of_variable(self, name: str) -> str:
        """Return the unit that the FMU declares for a variable, "1" if it declares none."""
        variable = self._fmu.variable(self.variable(name))
        if variable is None:
            return "1"
        return variable.unit or "1"


def _variables_by_name(binding: Binding) -> dict[str, str]:
    """Return the variables of the FMU by the names of a binding: as `tip` and as `monitor.tip`.

    If several roles have one name, the name alone is that of the last of them.
    """
    variables: dict[str, str] = {}
    for role in ("monitor", "load", "health", "control"):
        for key, variable in getattr(binding, role).items():
            variables[key] = variable.variable
            variables[f"{role}.{key}"] = variable.variable
    return variables
