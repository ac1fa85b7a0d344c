"""A system of FMUs as the description of one, and as its components see it."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.client.binding import Binding, BindingHeader
from fmu_asset.client.bound_variables import InputBinding, ParameterBinding, VectorBinding
from fmu_asset.client.exchange import Exchange
from fmu_asset.client.units import IDENTITY
from fmu_asset.errors import BindingError, CouplingError, said
from fmu_asset.instances.plan import InitialValues

from .structure import Component, Endpoint
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

    def of_components(self, settings: InitialValues) -> dict[str, dict[str, float]]:
        """Return what is set in the system by component and variable, in the FMUs' units."""
        found: dict[str, dict[str, float]] = {}
        for _, reference, (value,) in settings:
            number = float(value)
            for port in self.ends[self.variables[reference].name]:
                own = found.setdefault(port.end.component, {})
                own[port.end.variable] = port.conversion.to_fmu(number)
        return found


def system_description(wiring: Wiring, sha256: str = "") -> SystemDescription:
    """Return a system as the description of one FMU, all of whose variables are real numbers.

    Outputs of components that a connector shows are local variables; the ranges and types of inputs are
    those of the components, which see to them.

    Parameters
    ----------
    wiring : Wiring
        The system.
    sha256 : str
        Stands for all that the meaning of a state depends on.
    """
    structure = wiring.structure
    variables = list[VariableInfo]()
    ends: dict[str, tuple[ConnectedVariable, ...]] = {}
    definitions: dict[str, tuple[UnitInfo, ...]] = {}

    def offer(name: str, causality: str, unit: str | None, **said: Any) -> None:
        # An input that nobody gives keeps the start value of its FMU.
        start = "nan" if causality == "input" else None
        variable = VariableInfo(name, len(variables), causality=causality, unit=unit, start=start, **said)
        variables.append(variable)

    for connector in structure.connectors:
        name, own = connector.name, wiring.ends[connector.name]
        causalities = {wiring.variable(port.end).causality for port in own} or {"connected to nothing"}
        causality = "output" if own and connector.kind == "output" else " and ".join(sorted(causalities))
        # An enumeration, where all ends of the connector are the same one.
        enumerations = [wiring.variable(port.end).items for port in own] or [{}]
        alike = enumerations.count(enumerations[0]) == len(enumerations)
        offer(name, causality, wiring.units[name], items=enumerations[0] if alike else {})
        units = (unit for port in own for unit in wiring.declared[port.end.component].units)
        ends[name], definitions[name] = own, (*structure.units, *units)
    shown = {port.end for item in structure.connectors if item.kind == "output" for port in ends[item.name]}
    for component, declared in wiring.declared.items():
        for variable in filter(lambda variable: variable.single, declared.variables):
            end, causality = Endpoint(component, variable.name), variable.causality
            if end in wiring.feeds:
                causality = "an input that is fed by a connection already"
            elif end in shown:
                causality = "local"
            offer(
                str(end),
                causality,
                variable.unit,
                variability=variable.variability,
                description=variable.description,
                items=variable.items,
            )
            ends[str(end)] = (ConnectedVariable(end, IDENTITY, False),)
            definitions[str(end)] = declared.units
    steps = [declared.fixed_step or declared.step_size for declared in wiring.declared.values()]
    return SystemDescription(
        path=Path(f"the system {structure.name}"),
        sha256=sha256,
        model_name=structure.name,
        can_get_and_set_state=True,
        can_serialise_state=True,
        variables=tuple(variables),
        start_time=structure.span[0],
        stop_time=structure.span[1],
        step_size=structure.base_step or min((size for size in steps if size is not None), default=None),
        ends=ends,
        definitions=definitions,
    )


def wiring_hash(wiring: Wiring, binding: Binding, *algorithm: str | float) -> str:
    """Return the SHA-256 of all that the meaning of a state depends on; places of files do not count."""
    components = [
        (
            c.name,
            wiring.declared[c.name].sha256,
            sorted(wiring.settings[c.name].items()),  # files sort them
            c.substeps,
            c.interface,
        )
        for c in wiring.structure.components
    ]
    bound = binding.model_dump(mode="json", exclude={"limits"})
    record = (components, wiring.feeds, wiring.ends, bound, algorithm)
    return hashlib.sha256(repr(record).encode()).hexdigest()


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
    settings, constants : dict of str to float or str, dict of str to float
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
    settings: dict[str, float | str]
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
        raise BindingError(said("coupling.interpolation", exchange=exchange, wiring=wiring))
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
    variables = {v.name: v for v in wiring.declared[name].variables}
    # Of a component of which nothing is asked, any output is looked at.
    outputs = (v.name for v in variables.values() if v.causality == "output" and v.single)
    ends = ends or tuple(Endpoint(name, output) for output in outputs)[:1]
    if not ends:
        raise CouplingError(said("coupling.no_output", name=name))
    given = [end.variable for end in bound(variable.name for variable in exchange.sent)]
    tuned = [end.variable for end in bound(item.variable for item in binding.parameter.values())]
    moving = frozenset(
        key for key, port in fed.items() if wiring.variable(port.end).continuous and variables[key].continuous
    )
    linear = (
        linear
        and wiring.declared[name].can_interpolate_inputs
        and (bool(moving) or any(variables[key].continuous for key in given))
    )
    constants, settings = dict[str, float](), dict[str, float | str]()
    for key, value in wiring.settings[name].items():
        if variables[key].causality == "input" and not isinstance(value, str):
            constants[key] = value
        else:
            settings[key] = value

    def units(*groups: Iterable[str]) -> dict[str, str]:
        """Return the units of variables, each once."""
        return {key: variables[key].unit or "1" for group in groups for key in group}

    own = Binding(
        binding=BindingHeader(
            name=name,
            step_size=binding.step_size / component.substeps,
            decimation=component.substeps if linear else 1,
            interpolation="linear" if linear else "zero-order",
            start_time=binding.binding.start_time,
            stop_time=binding.binding.stop_time,
            interface=component.interface,
            tolerance=binding.binding.tolerance,
        ),
        limits=binding.limits,
        load={
            key: InputBinding(variable=key, unit=unit) for key, unit in units(fed, given, constants).items()
        },
        parameter={
            key: ParameterBinding(variable=key, unit=unit) for key, unit in units(settings, tuned).items()
        },
        observation={
            key: VectorBinding(variables=(key,), unit=unit)
            for key, unit in units(end.variable for end in ends).items()
        },
    )
    substeps = 1 if linear else component.substeps
    return Part(name, ends, fed, moving, linear, substeps, settings, constants, own)
