"""A system of FMUs checked against the FMUs themselves: every end exists, fits, and has one source."""

import difflib
import math
from dataclasses import replace
from typing import NamedTuple

from fmu_asset.archive.declared import READABLE, FmuDescription, UnitInfo, VariableInfo
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.units import Conversion, between
from fmu_asset.errors import CouplingError

from .schedule import Link, Schedule, schedule
from .structure import Component, Connection, Connector, Endpoint, Setting, SystemStructure, listed

_FITS = {
    "Real": {"Real"},
    "Integer": {"Integer", "Real", "Enumeration"},
    "Boolean": {"Boolean"},
    "Enumeration": {"Enumeration", "Integer"},
}
"""For each type of a source, the types of targets that can take it."""


class ConnectedVariable(NamedTuple):
    """A variable of a component as it is seen elsewhere, its units resolved.

    variable = factor * connector + offset for inputs and parameters, and the other way round for outputs and
    what feeds other components.
    """

    end: Endpoint
    conversion: Conversion
    delayed: bool


class Wiring:
    """A system whose connections were checked.

    Parameters
    ----------
    structure : SystemStructure
        The system.
    leave_out_unknown : bool
        Whether settings of variables that the FMU does not have are left out instead of refused.

    Attributes
    ----------
    structure : SystemStructure
        As given, without what was left out.
    left_out : list of str
        The names of these settings.
    declared : dict of str to FmuDescription
        The FMUs by component.
    feeds : dict of Endpoint to ConnectedVariable
        Connections between components.
    inward : dict of str to tuple of ConnectedVariable
        For each input and parameter of the system, where it goes.
    outward : dict of str to ConnectedVariable
        For each output of the system, where it comes from.
    units : dict of str to (str or None)
        Unit of each connector: its own, or that of what it is connected to.
    settings : dict of str to (dict of str to float)
        Parameters and start values of each component, in the FMU's units.
    schedule : Schedule
        Order of the components, and algebraic loops.

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
            raise CouplingError(f"The system {structure.name} has no component; name at least one FMU.")
        for name in names:
            if names.count(name) > 1:
                raise CouplingError(
                    f"The system {structure.name} has two components named {name!r}; each needs a name of "
                    "its own."
                )
        self.declared: dict[str, FmuDescription] = {
            c.name: read_fmu(c.fmu, c.interface) for c in structure.components
        }
        self.left_out: list[str] = []
        if leave_out_unknown:
            structure = replace(structure, components=tuple(map(self._known, structure.components)))
        self.structure = structure
        self.settings = {c.name: self._settings(c) for c in structure.components}
        self._connectors = {connector.name: connector for connector in structure.connectors}
        self.units: dict[str, str | None] = {c.name: c.unit for c in structure.connectors}
        self.feeds: dict[Endpoint, ConnectedVariable] = {}
        self.inward: dict[str, tuple[ConnectedVariable, ...]] = {
            c.name: () for c in structure.connectors if c.kind != "output"
        }
        self.outward: dict[str, ConnectedVariable] = {}
        taken: dict[Endpoint, Endpoint] = {}
        for connection in structure.connections:
            self._connect(connection, taken)
        links = [Link(port.end, target) for target, port in self.feeds.items() if not port.delayed]
        self.schedule: Schedule = schedule(names, links, self._feedthrough())

    def _feedthrough(self) -> dict[str, dict[str, frozenset[str]]]:
        """Return the direct dependencies that count: those of outputs, and of other variables in use."""
        used = {connection.source for connection in self.structure.connections}
        return {
            name: {
                output: inputs
                for output, inputs in declared.feedthrough.items()
                if self.variable(end := Endpoint(name, output)).causality == "output" or end in used
            }
            for name, declared in self.declared.items()
        }

    # ------------------------------------------------------------------ ends

    def variable(self, end: Endpoint) -> VariableInfo:
        """Return the FMU variable at an end.

        Raises
        ------
        CouplingError
            If there is no such component or variable.
        """
        self.structure.component(end.component)
        declared = self.declared[end.component]
        variable = declared.variable(end.variable)
        if variable is None:
            near = difflib.get_close_matches(end.variable, [v.name for v in declared.variables], 1, 0.6)
            hint = f"; did you mean {near[0]!r}?" if near else "."
            raise CouplingError(
                f"The component {end.component!r} ({declared.path.name}) has no variable "
                f"{end.variable!r}{hint}"
            )
        return variable

    def _connector(self, end: Endpoint, kinds: tuple[str, ...], verb: str) -> Connector:
        connector = self._connectors.get(end.variable)
        if connector is None:
            raise CouplingError(
                f"The system {self.structure.name} has no connector {end.variable!r}; it has "
                f"{listed(self._connectors)}."
            )
        if connector.kind not in kinds:
            raise CouplingError(
                f"The connector {end.variable!r} of the system is of the kind {connector.kind} and cannot "
                f"be {verb} of a connection."
            )
        return connector

    def _connect(self, connection: Connection, taken: dict[Endpoint, Endpoint]) -> None:
        source, target = connection.source, connection.target
        if target in taken:
            raise CouplingError(
                f"{target} has two sources, {taken[target]} and {source}; keep one of the two connections."
            )
        taken[target] = source
        if not (math.isfinite(connection.factor) and math.isfinite(connection.offset)):
            raise CouplingError(f"The transformation from {source} to {target} must be finite.")
        if not (source.component or target.component):
            raise CouplingError(
                f"The connection from {source} to {target} joins two connectors of the system; one end must "
                "be a component."
            )
        outer = gives = takes = None
        if source.component:
            gives = self._single(
                source, READABLE, "the source of a connection", "an output of a single number is needed"
            )
        else:
            outer = self._connector(source, ("input", "parameter"), "the source")
            if connection.delayed:
                raise CouplingError(f"The connection from the input {source} cannot be delayed.")
        if target.component:
            causalities = ("input",) if outer is None or outer.kind == "input" else ("parameter", "input")
            needed = f"a single number is needed as {' or '.join(causalities)}"
            takes = self._single(target, causalities, "the target of this connection", needed)
        else:
            outer = self._connector(target, ("output",), "the target")
        if outer is None:
            assert gives is not None
            assert takes is not None
            self._fit(connection, gives, takes)
        elif self.units[outer.name] is None:
            self.units[outer.name] = (gives or takes).unit  # type: ignore[union-attr]
        own = None if outer is None else self.units[outer.name]
        conversion = self._converted(
            connection, own if gives is None else gives.unit, own if takes is None else takes.unit
        )
        joined = ConnectedVariable(source if gives else target, conversion, connection.delayed)
        if outer is None:
            self.feeds[target] = joined
        elif gives is None:
            self.inward[outer.name] += (joined,)
        else:
            self.outward[outer.name] = joined

    def _single(self, end: Endpoint, causalities: tuple[str, ...], what: str, needed: str) -> VariableInfo:
        """Return the variable at an end, which must be a single number of one of these causalities."""
        variable = self.variable(end)
        if variable.causality not in causalities or not variable.single:
            raise CouplingError(
                f"{end} cannot be {what}: it is declared as {variable.causality} of the type "
                f"{variable.kind}, and {needed}."
            )
        return variable

    def _fit(self, connection: Connection, source: VariableInfo, target: VariableInfo) -> None:
        if target.base_type not in _FITS[source.base_type]:
            raise CouplingError(
                f"{connection.source} is of the type {source.kind} and cannot feed {connection.target}, "
                f"which is of the type {target.kind}."
            )
        scaled = (connection.factor, connection.offset) != (1.0, 0.0)
        if scaled and target.base_type != "Real":
            raise CouplingError(
                f"The connection from {connection.source} to {connection.target} has a linear "
                "transformation, but "
                f"{connection.target} is of the type {target.kind}; only real numbers can be scaled."
            )

    def _converted(self, connection: Connection, source: str | None, target: str | None) -> Conversion:
        own = Conversion(connection.factor, connection.offset)
        if not connection.convert_units:
            return own
        unit = between(
            source, self._definitions(connection.source), target, self._definitions(connection.target)
        )
        if unit is None:
            raise CouplingError(
                f"{connection.source} is in {source!r} and {connection.target} in {target!r}, and there is "
                "no conversion between the two; correct the connection, or suppress the conversion of units."
            )
        return unit.then(own)

    def _definitions(self, end: Endpoint) -> tuple[UnitInfo, ...]:
        return self.declared[end.component].units if end.component else self.structure.units

    # ------------------------------------------------------------------ parameters

    def _known(self, component: Component) -> Component:
        known = self.declared[component.name].variable
        settings = {name: setting for name, setting in component.settings.items() if known(name)}
        self.left_out += [f"{component.name}.{name}" for name in component.settings if name not in settings]
        return replace(component, settings=settings)

    def _settings(self, component: Component) -> dict[str, float]:
        if component.substeps < 1:
            raise CouplingError(
                f"The component {component.name!r} needs at least one step in a step of the system."
            )
        return {
            name: self.number(Endpoint(component.name, name), setting)
            for name, setting in component.settings.items()
        }

    def number(self, end: Endpoint, setting: Setting) -> float:
        """Return a parameter or start value as a number in the FMU's unit.

        Raises
        ------
        CouplingError
            If there is no such parameter or input, or the value is of another type or unit.
        """
        variable = self.variable(end)
        if variable.causality not in ("parameter", "input") and not variable.startable:
            raise CouplingError(f"{end} cannot be set: it is declared as {variable.causality}.")
        if not variable.single:
            text = f"is of the type {variable.kind}"
            what = "is an array" if variable.shape else "changes with a clock" if variable.clocked else text
            raise CouplingError(f"{end} cannot be set: it {what}; only single numbers are set in a system.")
        value = setting.value
        if isinstance(value, str):
            items = variable.items
            if variable.kind == "Enumeration" and value in items:
                return float(items[value])
            raise CouplingError(
                f"{end} cannot be set to {value!r}: it is of the type {variable.kind}"
                + (f" with the items {listed(items)}." if items else ", and a number is needed.")
            )
        own = self.declared[end.component].units
        units = (*setting.units, *self.structure.units, *own)
        conversion = between(setting.unit, units, variable.unit, own)
        if conversion is None:
            raise CouplingError(
                f"{end} is given in {setting.unit!r}, but it is in {variable.unit!r}, and there is no "
                "conversion between the two."
            )
        number = conversion.then(Conversion(setting.factor, setting.offset)).to_fmu(float(value))
        wrong = (
            (isinstance(value, bool) and variable.kind != "Boolean")
            or (not isinstance(value, bool) and variable.kind == "Boolean" and value not in (0, 1))
            or (variable.base_type in ("Integer", "Enumeration") and not number.is_integer())
            or not math.isfinite(number)
        )
        if wrong:
            raise CouplingError(f"{end} cannot be set to {value!r}: it is of the type {variable.kind}.")
        return number
