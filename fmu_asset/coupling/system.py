"""A system of FMUs as the description of one, and as its components see it."""

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.door.binding import Binding, Header, Input, Parameter, Vector
from fmu_asset.door.exchange import Exchange
from fmu_asset.door.units import IDENTITY
from fmu_asset.errors import BindingError, CouplingError
from fmu_asset.instances.plan import Settings

from .structure import Component, Connector, Endpoint
from .wiring import ConnectedVariable, Wiring


@dataclass(frozen=True)
class SystemDescription(FmuDescription):
    """What a system offers.

    Attributes
    ----------
    ends : dict of str to tuple of ConnectedVariable
        For each variable where it goes, or where it comes from.
    definitions : dict of str to tuple of UnitInfo
        For each variable the definitions that its unit is one of: FMUs may differ in them.
    """

    ends: dict[str, tuple[ConnectedVariable, ...]] = field(default_factory=dict)
    definitions: dict[str, tuple[UnitInfo, ...]] = field(default_factory=dict)

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the definitions of units that hold for a variable."""
        return self.definitions[variable.name]

    def of_components(self, settings: Settings) -> dict[str, dict[str, float]]:
        """Return what is set in the system by component and variable, in the FMUs' units."""
        found: dict[str, dict[str, float]] = {}
        for _, reference, (value,) in settings:
            for port in self.ends[self.variables[reference].name]:
                own = found.setdefault(port.end.component, {})
                own[port.end.variable] = port.conversion.to_fmu(value)
        return found


def system_description(
    wiring: Wiring, sha256: str = "", span: tuple[float | None, float | None] = (None, None)
) -> SystemDescription:
    """Return a system as the description of one FMU, all of whose variables are real numbers.

    Outputs of components that a connector shows are local variables; the ranges and types of inputs are
    those of the components, which see to them.

    Parameters
    ----------
    wiring : Wiring
        The system.
    sha256 : str
        Stands for all that the meaning of a state depends on.
    span : (float or None, float or None)
        Start and end of the default experiment [s].
    """
    shown = {port.end for port in wiring.outward.values()}
    found = [_of_connector(wiring, connector) for connector in wiring.structure.connectors]
    for component, declared in wiring.declared.items():
        for variable in declared.variables:
            end = Endpoint(component, variable.name)
            causality = variable.causality
            if end in wiring.feeds:
                causality = "an input that is fed by a connection already"
            elif end in shown:
                causality = "local"
            if variable.single:
                own = replace(variable, name=str(end), causality=causality)
                found.append((own, (ConnectedVariable(end, IDENTITY, False),), declared.units))
    steps = [declared.fixed_step or declared.step_size for declared in wiring.declared.values()]
    return SystemDescription(
        path=Path(f"the system {wiring.structure.name}"),
        sha256=sha256,
        model_name=wiring.structure.name,
        can_get_and_set_state=True,
        can_serialise_state=True,
        # An input that nobody gives keeps the start value of its FMU.
        variables=tuple(
            replace(
                variable,
                reference=number,
                kind="Real",
                minimum=None,
                maximum=None,
                start="nan" if variable.causality == "input" else None,
            )
            for number, (variable, _, _) in enumerate(found)
        ),
        start_time=span[0],
        stop_time=span[1],
        step_size=min((size for size in steps if size is not None), default=None),
        ends={variable.name: ends for variable, ends, _ in found},
        definitions={variable.name: units for variable, _, units in found},
    )


def _of_connector(
    wiring: Wiring, connector: Connector
) -> tuple[VariableInfo, tuple[ConnectedVariable, ...], tuple[UnitInfo, ...]]:
    there = wiring.outward.get(connector.name)
    ends = wiring.inward.get(connector.name, ()) if there is None else (there,)
    causality = "output"
    if there is None:
        causalities = {wiring.variable(port.end).causality for port in ends} or {"connected to nothing"}
        causality = " and ".join(sorted(causalities))
    units = tuple(unit for port in ends for unit in wiring.declared[port.end.component].units)
    variable = VariableInfo(connector.name, 0, causality=causality, unit=wiring.units[connector.name])
    return variable, ends, (*wiring.structure.units, *units)


def wiring_hash(wiring: Wiring, binding: Binding, *algorithm: str | float) -> str:
    """Return the SHA-256 of all that the meaning of a state depends on; places of files do not count."""

    def told(ports: tuple[ConnectedVariable, ...]) -> Iterator[list[str | float | bool]]:
        return ([str(port.end), *port.conversion, port.delayed] for port in ports)

    record = {
        "components": [
            [c.name, wiring.declared[c.name].sha256, wiring.settings[c.name], c.substeps, c.interface]
            for c in wiring.structure.components
        ],
        "feeds": [[str(target), *told((port,))] for target, port in wiring.feeds.items()],
        "inward": {name: [*told(ports)] for name, ports in wiring.inward.items()},
        "outward": {name: [*told((port,))] for name, port in wiring.outward.items()},
        "binding": binding.model_dump(mode="json", exclude={"limits"}),
        "algorithm": algorithm,
    }
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Part:
    """A component as it is stepped.

    Attributes
    ----------
    name : str
        The component.
    ends : tuple of Endpoint
        Its outputs that are read, in the order of its binding; at least one, to see that it is alive.
    fed : dict of str to ConnectedVariable
        What feeds its inputs, by their names.
    moving : frozenset of str
        Those of them with a continuous real number at both ends.
    linear : bool
        Whether its inputs move in straight lines over a step.
    substeps : int
        Its steps in a step of the system, as calls of its asset: of several with lines, the door makes these.
    settings, constants : dict of str to float
        Parameters, and inputs that have a value from the start.
    binding : Binding
        Its own names and units.
    """

    name: str
    ends: tuple[Endpoint, ...]
    fed: dict[str, ConnectedVariable]
    moving: frozenset[str]
    linear: bool
    substeps: int
    settings: dict[str, float]
    constants: dict[str, float]
    binding: Binding


def parts_of(wiring: Wiring, exchange: Exchange, *, linear: bool = False) -> dict[str, Part]:
    """Return the components of a system as they are stepped, by name.

    Parameters
    ----------
    wiring : Wiring
        The system.
    exchange : Exchange
        A binding of its description.
    linear : bool
        Whether inputs move in straight lines where they can.

    Raises
    ------
    CouplingError
        If a component has no output.
    BindingError
        If lines are wanted, and no input can follow them.
    """
    parts = {c.name: _part(wiring, exchange, c, linear=linear) for c in wiring.structure.components}
    if linear and not any(part.linear for part in parts.values()):
        raise BindingError(
            f"The binding {exchange.binding.name} asks for linear interpolation of inputs, but no component "
            f"of the system {wiring.structure.name} has a continuous input and takes its derivatives "
            "(`canInterpolateInputs`, or model exchange); leave it out."
        )
    return parts


def _part(wiring: Wiring, exchange: Exchange, component: Component, *, linear: bool) -> Part:
    name, binding = component.name, exchange.binding

    def bound(variables: Iterable[str]) -> list[Endpoint]:
        """Return the ends at this component of variables of the system."""
        ports = [port for variable in variables for port in exchange.description.ends[variable]]  # type: ignore[attr-defined]
        return [port.end for port in ports if port.end.component == name]

    fed = {target.variable: port for target, port in wiring.feeds.items() if target.component == name}
    sources = [port.end for port in wiring.feeds.values() if port.end.component == name]
    ends = tuple(dict.fromkeys([*sources, *bound(variable.name for variable in exchange.read)]))
    ends = ends or (_any_output(wiring, name),)
    given = bound(variable.name for variable in exchange.sent)
    moving = frozenset(
        variable
        for variable, port in fed.items()
        if wiring.variable(port.end).continuous and wiring.variable(Endpoint(name, variable)).continuous
    )
    linear = (
        linear
        and wiring.declared[name].can_interpolate_inputs
        and (bool(moving) or any(wiring.variable(end).continuous for end in given))
    )
    starts: dict[str, dict[str, float]] = {"input": {}, "parameter": {}}
    for variable, number in wiring.settings[name].items():
        is_input = wiring.variable(Endpoint(name, variable)).causality == "input"
        starts["input" if is_input else "parameter"][variable] = number
    tuned = bound(item.variable for item in binding.parameter.values())

    def unit(variable: str) -> str:
        return wiring.variable(Endpoint(name, variable)).unit or "1"

    inputs = dict.fromkeys([*fed, *(end.variable for end in given), *starts["input"]])
    parameters = dict.fromkeys([*starts["parameter"], *(end.variable for end in tuned)])
    own = Binding(
        binding=Header(
            name=name,
            step_size=binding.step_size / component.substeps,
            decimation=component.substeps if linear else 1,
            interpolation="linear" if linear else "zero-order",
            start_time=binding.binding.start_time,
            interface=component.interface,
            tolerance=binding.binding.tolerance,
        ),
        limits=binding.limits,
        load={key: Input(variable=key, unit=unit(key)) for key in inputs},
        parameter={key: Parameter(variable=key, unit=unit(key)) for key in parameters},
        observation={key: Vector(variables=(key,), unit=unit(key)) for _, key in ends},
    )
    substeps = 1 if linear else component.substeps
    return Part(name, ends, fed, moving, linear, substeps, starts["parameter"], starts["input"], own)


def _any_output(wiring: Wiring, name: str) -> Endpoint:
    """Return an output to look at for a component of which nothing is asked."""
    for variable in wiring.declared[name].variables:
        if variable.causality == "output" and variable.single:
            return Endpoint(name, variable.name)
    raise CouplingError(
        f"The component {name!r} has no output of a single number, so it takes no part; leave it out."
    )
