"""Checks a system against its FMUs: every end of a connection exists, fits and has one source."""

import math
from dataclasses import replace
from typing import NamedTuple

from fmu_asset.archive.declared import READABLE, FmuDescription, UnitInfo, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.client.units import IDENTITY, Conversion, between
from fmu_asset.errors import CouplingError, FmuError
from reporting.words import comma_list

from .schedule import Schedule, schedule
from .structure import (
    Component,
    ComponentSetting,
    Connection,
    Endpoint,
    SystemStructure,
    two_sources_sentence,
)

_TARGET_TYPES = {
    "Real": {"Real"},
    "Integer": {"Integer", "Real", "Enumeration"},
    "Boolean": {"Boolean"},
    "Enumeration": {"Enumeration", "Integer"},
}
"""For each type of a source, the types of targets that can take it."""


class ConnectedVariable(NamedTuple):
    """A component's variable at one end of a connection, with the conversion of its value.

    Attributes
    ----------
    conversion : Conversion
        variable = factor * connector + offset for inputs and parameters, connector = factor *
        variable + offset for outputs, and target = factor * variable + offset if it feeds another
        component.
    delayed : bool
        Whether the target gets the value from the beginning of the step.
    """

    end: Endpoint
    conversion: Conversion
    delayed: bool


def read_component(component: Component) -> FmuDescription:
    """Return the model description of a component's FMU; messages use the component's name for it.

    Raises
    ------
    FmuFileError, FmuUnsupportedError
        If the FMU cannot be used.
    """
    try:
        description = read_fmu(component.fmu, component.interface)
    except FmuError as error:
        if not component.shown_as:
            raise
        sentence = error.sentence.replace(str(component.fmu), component.shown_as)
        raise type(error)(sentence, error.messages, error.time) from error
    return replace(description, shown_as=component.shown_as)


class Wiring:
    """A system of FMUs with checked connections, units and parameters.

    Parameters
    ----------
    leave_out_unknown : bool
        Whether settings of variables that the FMU does not have are skipped instead of refused.

    Attributes
    ----------
    left_out : list of str
        The names of the skipped settings.
    declared : dict of str to FmuDescription
        The descriptions of the FMUs by component.
    feeds : dict of Endpoint to ConnectedVariable
        The source of each connection between components, by its target.
    ends : dict of str to tuple of ConnectedVariable
        For each input and parameter of the system the variables that it sets, for each output the
        one that it reads.
    units : dict of str to (str or None)
        The unit of each connector: its own, or that of what it is connected to.
    settings : dict of str to (dict of str to float or str)
        Parameters and start values of each component, in the FMU's units.
    schedule : Schedule
        The order of the components, and the algebraic loops.

    Raises
    ------
    CouplingError
        If something does not exist, does not fit, or has two sources.
    FmuFileError, FmuUnsupportedError
        If an FMU cannot be used.
    """

    def __init__(self, structure: SystemStructure, *, leave_out_unknown: bool = False) -> None:
        names = [component.name for component in structure.components]
        if not names:
            raise CouplingError(
                f"The system {structure.name} has no component; name at least one FMU."
            )
        for name in names:
            if names.count(name) > 1:
                raise CouplingError(
                    f"The system {structure.name} has two components named {name!r}; each needs a "
                    "name of its own."
                )
        self.structure = structure
        # components
        self.declared: dict[str, FmuDescription] = {}
        for component in structure.components:
            self.declared[component.name] = read_component(component)
        self.left_out: list[str] = []
        self.settings: dict[str, dict[str, float | str]] = {}
        for component in structure.components:
            self.settings[component.name] = self._settings(component, leave_out_unknown)
        # connections
        self._connector_kinds = {
            connector.name: connector.kind for connector in structure.connectors
        }
        self.units: dict[str, str | None] = {
            connector.name: connector.unit for connector in structure.connectors
        }
        self.feeds: dict[Endpoint, ConnectedVariable] = {}
        self.ends: dict[str, tuple[ConnectedVariable, ...]] = dict.fromkeys(
            self._connector_kinds, ()
        )
        source_of_target: dict[Endpoint, Endpoint] = {}
        for connection in structure.connections:
            self._connect(connection, source_of_target)
        # order
        immediate = []
        for target, source in self.feeds.items():
            if not source.delayed:
                immediate.append(Connection(source.end, target))
        self.schedule: Schedule = schedule(names, immediate, self._used_feedthrough())

    def _used_feedthrough(self) -> dict[str, dict[str, frozenset[str]]]:
        """Return the inputs that act at once on each output, or on another connected variable."""
        sources = {connection.source for connection in self.structure.connections}
        used_inputs: dict[str, dict[str, frozenset[str]]] = {}
        for component, description in self.declared.items():
            used_inputs[component] = {}
            for variable, inputs in description.feedthrough.items():
                end = Endpoint(component, variable)
                if end in sources or self.variable(end).causality == "output":
                    used_inputs[component][variable] = inputs
        return used_inputs

    # ------------------------------------------------------------------ ends

    def variable(self, end: Endpoint) -> VariableInfo:
        """Return the FMU variable at an end.

        Raises
        ------
        CouplingError
            If there is no such component or variable.
        """
        self.structure.component(end.component)  # refuses an unknown one
        description = self.declared[end.component]
        variable = description.variable(end.variable)
        if variable is None:
            file = description.shown_as or description.path.name
            raise CouplingError(
                f"The component {end.component!r} ({file}) has no variable "
                f"{end.variable!r}{description.hint(end.variable)}"
            )
        return variable

    def _connector(self, end: Endpoint, kinds: tuple[str, ...], role: str) -> VariableInfo:
        """Return the connector of the system at one end of a connection.

        A `CouplingError` is raised if there is none, or it is not of one of the `kinds` that may
        stand there. `role` is the name of this end in the message, such as "the target".
        """
        kind = self._connector_kinds.get(end.variable)
        if kind is None:
            raise CouplingError(
                f"The system {self.structure.name} has no connector {end.variable!r}; it has "
                f"{comma_list(self._connector_kinds)}."
            )
        if kind not in kinds:
            raise CouplingError(
                f"The connector {end.variable!r} of the system is of the kind {kind} and cannot be "
                f"{role} of a connection."
            )
        unit = self.units[end.variable]
        return VariableInfo(end.variable, 0, kind="", causality=kind, unit=unit)

    def _connect(self, connection: Connection, source_of_target: dict[Endpoint, Endpoint]) -> None:
        """Check a connection, and record it.

        One between components is added to `feeds`, one to or from a connector of the system to the
        `ends` of this connector. In both cases its source is recorded in `source_of_target`.
        """
        source, target = connection.source, connection.target
        if target in source_of_target:
            raise CouplingError(two_sources_sentence(target, source_of_target[target], source))
        source_of_target[target] = source
        if not (math.isfinite(connection.factor) and math.isfinite(connection.offset)):
            raise CouplingError(
                f"The factor and the offset from {source} to {target} must be finite, but are "
                f"{connection.factor} and {connection.offset}."
            )
        if not source.component and not target.component:
            raise CouplingError(
                f"The connection from {source} to {target} joins two connectors of the system; one "
                "end must be a component."
            )
        source_info = self._source(connection)
        target_info = self._target(connection, source_info)
        conversion = self._conversion(connection, source_info, target_info)
        if source.component and target.component:
            self.feeds[target] = ConnectedVariable(source, conversion, connection.delayed)
            return
        if source.component:
            connector, component_end = target.variable, source
        else:
            connector, component_end = source.variable, target
        port = ConnectedVariable(component_end, conversion, connection.delayed)
        self.ends[connector] += (port,)
        if self.units[connector] is None:
            unit = target_info.unit if source_info.unit is None else source_info.unit
            self.units[connector] = unit

    def _source(self, connection: Connection) -> VariableInfo:
        """Return the variable or connector at the source of a connection, if it can be one."""
        source = connection.source
        if source.component:
            requirement = "an output of a single number is needed"
            return self._single(source, READABLE, "the source of a connection", requirement)
        connector = self._connector(source, ("input", "parameter"), "the source")
        if connection.delayed:
            raise CouplingError(f"The connection from the input {source} cannot be delayed.")
        return connector

    def _target(self, connection: Connection, source_info: VariableInfo) -> VariableInfo:
        """Return the variable or connector at the target of a connection, if it can be one.

        A parameter of the system may go to parameters and inputs, everything else to inputs.
        """
        target = connection.target
        if not target.component:
            return self._connector(target, ("output",), "the target")
        causalities: tuple[str, ...] = ("input",)
        if not connection.source.component and source_info.causality != "input":
            causalities = (source_info.causality, "input")
        requirement = f"a single number is needed as {' or '.join(causalities)}"
        if self.variable(target).causality == "parameter":
            requirement += ": give it a value at its component, or make it an input of the FMU"
        return self._single(target, causalities, "the target of this connection", requirement)

    def _single(
        self, end: Endpoint, causalities: tuple[str, ...], role: str, requirement: str
    ) -> VariableInfo:
        """Return the variable at an end, which must be a single number of an allowed causality.

        `role` and `requirement` say in the message what the end is and must be.
        """
        variable = self.variable(end)
        if variable.causality not in causalities or not variable.single:
            raise CouplingError(
                f"{end} cannot be {role}: it is declared as {variable.causality} of the type "
                f"{variable.kind}, and {requirement}."
            )
        return variable

    def _conversion(
        self, connection: Connection, source_info: VariableInfo, target_info: VariableInfo
    ) -> Conversion:
        """Return the conversion of a value between the ends of a connection.

        A `CouplingError` is raised if their types or units do not fit.
        """
        source, target, scale = connection.source, connection.target, connection.scale
        both_have_types = source_info.kind != "" and target_info.kind != ""  # connectors have none
        if both_have_types:
            if target_info.base_type not in _TARGET_TYPES[source_info.base_type]:
                raise CouplingError(
                    f"{source} is of the type {source_info.kind} and cannot feed {target}, which "
                    f"is of the type {target_info.kind}."
                )
            if scale != IDENTITY and target_info.base_type != "Real":
                raise CouplingError(
                    f"The connection from {source} to {target} has a linear transformation, but "
                    f"{target} is of the type {target_info.kind}; only real numbers can be scaled."
                )
        if not connection.convert_units:
            return scale
        unit_conversion = between(
            source_info.unit,
            self._unit_definitions(source),
            target_info.unit,
            self._unit_definitions(target),
        )
        if unit_conversion is None:
            raise CouplingError(
                f"{source} is in {source_info.unit!r} and {target} in {target_info.unit!r}, and "
                "there is no conversion between the two; correct the connection, or suppress the "
                "conversion of units."
            )
        return unit_conversion.then(scale)

    def _unit_definitions(self, end: Endpoint) -> tuple[UnitInfo, ...]:
        return self.declared[end.component].units if end.component else self.structure.units

    # ------------------------------------------------------------------ parameters

    def _settings(self, component: Component, leave_out_unknown: bool) -> dict[str, float | str]:
        """Return the checked parameters and start values of a component, in the FMU's units."""
        if component.substeps < 1:
            raise CouplingError(
                f"The component {component.name!r} needs at least one step in a step of the system."
            )
        settings: dict[str, float | str] = {}
        for name, setting in component.settings.items():
            if leave_out_unknown and self.declared[component.name].variable(name) is None:
                self.left_out.append(f"{component.name}.{name}")
            else:
                settings[name] = self.start_value(Endpoint(component.name, name), setting)
        return settings

    def start_value(self, end: Endpoint, setting: ComponentSetting) -> float | str:
        """Return a checked parameter or start value: a text, or a number in the FMU's unit.

        Raises
        ------
        CouplingError
            If there is no such parameter or input, or the value is of another type or unit.
        """
        variable = self.variable(end)
        if not variable.is_text_parameter:
            return self._start_number(end, variable, setting)
        if not isinstance(setting.value, str):
            raise CouplingError(
                f"{end} cannot be set to {setting.value!r}: it is of the type {variable.kind}, and "
                "takes a text."
            )
        return setting.value

    def _start_number(
        self, end: Endpoint, variable: VariableInfo, setting: ComponentSetting
    ) -> float:
        """Return a parameter or start value as a number in the FMU's unit; see `start_value`."""
        _check_settable_number(end, variable)
        value = setting.value
        if isinstance(value, str) and value in variable.items:
            return float(variable.items[value])
        if isinstance(value, str | bytes):
            accepted_values = comma_list(variable.items) if variable.items else "a number"
            raise CouplingError(
                f"{end} cannot be set to {value!r}: it is of the type {variable.kind}, and takes "
                f"{accepted_values}."
            )
        fmu_units = self.declared[end.component].units
        known_units = (*setting.units, *self.structure.units, *fmu_units)
        conversion = between(setting.unit, known_units, variable.unit, fmu_units)
        if conversion is None:
            raise CouplingError(
                f"{end} is given in {setting.unit!r}, but it is in {variable.unit!r}, and there is "
                "no conversion between the two."
            )
        number = conversion.then(setting.scale).to_fmu(float(value))
        if not _fits_type(variable, value, number):
            raise CouplingError(
                f"{end} cannot be set to {value!r}: it is of the type {variable.kind}."
            )
        if variable.items and number not in variable.items.values():
            raise CouplingError(
                f"{end} cannot be set to {value!r}: it is an enumeration of {variable.item_list}."
            )
        return number


def _check_settable_number(end: Endpoint, variable: VariableInfo) -> None:
    """Raise an error if a variable is no single number that can be set before the start."""
    if variable.causality not in ("parameter", "input") and not variable.startable:
        raise CouplingError(f"{end} cannot be set: it is declared as {variable.causality}.")
    if variable.single:
        return
    if variable.shape:
        obstacle = "is an array"
    elif variable.clocked:
        obstacle = "changes with a clock"
    else:
        obstacle = f"is of the type {variable.kind}"
    raise CouplingError(
        f"{end} cannot be set: it {obstacle}; only single numbers are set in a system."
    )


def _fits_type(variable: VariableInfo, value: float | bool, number: float) -> bool:
    """Return whether a user's value, converted to the number, is of the type of a variable."""
    if variable.kind == "Boolean":
        return value in (0, 1)
    if isinstance(value, bool) or not math.isfinite(number):
        return False
    return variable.base_type == "Real" or number.is_integer()
