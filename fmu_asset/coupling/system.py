"""A system of FMUs described as one FMU, and the components that the system steps.

A binding names variables of a system as it names variables of an FMU. For that,
`system_description` lists the connectors of the system and all variables of its components.
`stepped_components` then turns a binding of the system into one binding for each component.
"""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, cast

from fmu_asset.archive.declared import FmuDescription, UnitInfo, VariableInfo
from fmu_asset.client.binding import Binding, BindingHeader
from fmu_asset.client.blocks import Blocks
from fmu_asset.client.bound_variables import InputBinding, ParameterBinding, VectorBinding
from fmu_asset.client.units import IDENTITY
from fmu_asset.errors import BindingError, CouplingError
from fmu_asset.instances.plan import InitialValues

from .structure import Component, Connector, Endpoint
from .wiring import ConnectedVariable, Wiring

_START_OF_FREE_INPUT = "nan"
"""Start value of a system's inputs: one that nobody gives keeps the start value of its FMU."""


@dataclass(frozen=True)
class SystemDescription(FmuDescription):
    """The description of a system of FMUs as one FMU.

    Attributes
    ----------
    ends : dict of str to tuple of ConnectedVariable
        For each variable of the system, the components' variables that it sets or reads.
    definitions : dict of str to tuple of UnitInfo
        For each variable, the unit definitions that hold for it: FMUs may differ in them.
    """

    ends: dict[str, tuple[ConnectedVariable, ...]] = field(default_factory=dict)
    definitions: dict[str, tuple[UnitInfo, ...]] = field(default_factory=dict)

    def units_of(self, variable: VariableInfo) -> tuple[UnitInfo, ...]:
        """Return the definitions of units that hold for a variable."""
        return self.definitions[variable.name]

    def settings_of_components(self, settings: InitialValues) -> dict[str, dict[str, float]]:
        """Return the values to set in each component, by component and variable name.

        Parameters
        ----------
        settings : InitialValues
            Values of the system's variables, by value reference.
        """
        by_component: dict[str, dict[str, float]] = {}
        for _, reference, (value,) in settings:
            number = float(value)
            for port in self.ends[self.variables[reference].name]:
                values = by_component.setdefault(port.end.component, {})
                values[port.end.variable] = port.conversion.to_fmu(number)
        return by_component


class _SystemVariable(NamedTuple):
    """A variable of a system: its declaration, and its entries in `SystemDescription`."""

    info: VariableInfo
    ends: tuple[ConnectedVariable, ...]
    definitions: tuple[UnitInfo, ...]


def system_description(wiring: Wiring, sha256: str = "") -> SystemDescription:
    """Return a system as the description of one FMU, all of whose variables are real numbers.

    The variables are the connectors of the system, then the variables of its components. Texts,
    arrays and clocked variables of components are left out. A component's output to which an output
    of the system is connected becomes local. Ranges and types of inputs are left out, since the
    components check them.

    Parameters
    ----------
    wiring : Wiring
        The checked system: `structure` lists its connectors, `ends` the components' variables
        behind each connector, and `declared` the description of each component's FMU.
    sha256 : str
        A hash of everything that the meaning of a saved state depends on, see `wiring_hash`.
    """
    structure = wiring.structure
    system_variables = [
        _connector_variable(wiring, connector) for connector in structure.connectors
    ]
    exposed_outputs: set[Endpoint] = set()
    for connector in structure.connectors:
        if connector.kind == "output":
            exposed_outputs.update(port.end for port in wiring.ends[connector.name])
    for component, description in wiring.declared.items():
        for info in description.variables:
            if not info.single:  # a text, an array or a clocked variable
                continue
            end = Endpoint(component, info.name)
            is_exposed = end in exposed_outputs
            variable = _component_variable(wiring, end, info, is_exposed=is_exposed)
            system_variables.append(variable)
    variables = []
    ends: dict[str, tuple[ConnectedVariable, ...]] = {}
    definitions: dict[str, tuple[UnitInfo, ...]] = {}
    for reference, variable in enumerate(system_variables):
        variables.append(replace(variable.info, reference=reference))
        ends[variable.info.name] = variable.ends
        definitions[variable.info.name] = variable.definitions
    start_time, stop_time = structure.span
    return SystemDescription(
        path=Path(f"the system {structure.name}"),
        sha256=sha256,
        model_name=structure.name,
        can_get_and_set_state=True,
        can_serialise_state=True,
        variables=tuple(variables),
        start_time=start_time,
        stop_time=stop_time,
        step_size=structure.base_step or _smallest_step(wiring),
        ends=ends,
        definitions=definitions,
    )


def _connector_variable(wiring: Wiring, connector: Connector) -> _SystemVariable:
    """Return a connector of the system as a variable, with units and items of its ends."""
    ports = wiring.ends[connector.name]
    infos = [wiring.variable(port.end) for port in ports]
    if connector.kind == "output" and ports:
        causality = "output"
    elif ports:
        causality = " and ".join(sorted({info.causality for info in infos}))
    else:
        causality = "connected to nothing"
    # It is an enumeration if all its ends are the same one.
    items: dict[str, int] = {}
    if infos and all(info.items == infos[0].items for info in infos):
        items = infos[0].items
    definitions = list(wiring.structure.units)
    for port in ports:
        definitions += wiring.declared[port.end.component].units
    info = VariableInfo(
        name=connector.name,
        reference=0,  # given later
        causality=causality,
        unit=wiring.units[connector.name],
        start=_START_OF_FREE_INPUT if causality == "input" else None,
        items=items,
    )
    return _SystemVariable(info, ports, tuple(definitions))


def _component_variable(
    wiring: Wiring, end: Endpoint, info: VariableInfo, *, is_exposed: bool
) -> _SystemVariable:
    """Return a variable of a component as a variable of the system.

    It is local if an output of the system exposes it, and no input any more if a connection feeds
    it.
    """
    causality = info.causality
    if end in wiring.feeds:
        causality = "an input that is fed by a connection already"
    elif is_exposed:
        causality = "local"
    system_info = VariableInfo(
        name=str(end),
        reference=0,  # given later
        causality=causality,
        variability=info.variability,
        description=info.description,
        unit=info.unit,
        start=_START_OF_FREE_INPUT if causality == "input" else None,
        items=info.items,
    )
    port = ConnectedVariable(end, IDENTITY, delayed=False)
    return _SystemVariable(system_info, (port,), wiring.declared[end.component].units)


def _smallest_step(wiring: Wiring) -> float | None:
    """Return the smallest step size that a component declares [s]; None if none does."""
    step_sizes = []
    for description in wiring.declared.values():
        step_size = description.fixed_step or description.step_size
        if step_size is not None:
            step_sizes.append(step_size)
    return min(step_sizes, default=None)


def wiring_hash(wiring: Wiring, binding: Binding, *algorithm: str | float) -> str:
    """Return a SHA-256 of everything on which the meaning of a saved state depends.

    The paths of the FMU files do not count.

    Parameters
    ----------
    binding : Binding
        A binding of the system.
    *algorithm : str or float
        The algorithm, its iterations and its tolerance.
    """
    components = []
    for component in wiring.structure.components:
        # Sorted, because files sort settings, too.
        settings = sorted(wiring.settings[component.name].items())
        sha256 = wiring.declared[component.name].sha256
        components.append(
            (component.name, sha256, settings, component.substeps, component.interface)
        )
    bound_variables = binding.model_dump(mode="json", exclude={"limits"})
    record = (components, wiring.feeds, wiring.ends, bound_variables, algorithm)
    return hashlib.sha256(repr(record).encode()).hexdigest()


@dataclass(frozen=True)
class SteppedComponent:
    """A component of a system with everything that is needed to step it.

    Attributes
    ----------
    name : str
        The component.
    ends : tuple of Endpoint
        The outputs that are read, in the order of its binding. There is at least one, to see that
        the FMU works.
    fed : dict of str to ConnectedVariable
        The output that feeds each input, by the input's name.
    moving : frozenset of str
        The fed inputs with a continuous real number at both ends.
    linear : bool
        Whether its inputs are interpolated linearly over a step.
    substeps : int
        The number of calls that step its FMU in a step of the system. With linear inputs one call
        makes all communication steps.
    settings : dict of str to float or str
        Parameters, by variable name.
    constants : dict of str to float
        Inputs with a constant value, unless the system sets them.
    binding : Binding
        A binding of the FMU by its own names and units.
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


def stepped_components(
    wiring: Wiring, blocks: Blocks, *, linear: bool = False
) -> dict[str, SteppedComponent]:
    """Return the components of a system, ready to be stepped, by name.

    Parameters
    ----------
    blocks : Blocks
        The request and the reply of the system as one FMU.
    linear : bool
        Whether inputs are interpolated linearly where this is possible.

    Raises
    ------
    CouplingError
        If a component has no output.
    BindingError
        If linear inputs are asked for, and no component can follow them.
    """
    components = {}
    for component in wiring.structure.components:
        components[component.name] = _stepped_component(wiring, blocks, component, linear=linear)
    if linear and not any(component.linear for component in components.values()):
        raise BindingError(
            f"The binding {blocks.binding.name} asks for linear interpolation of inputs, but no "
            f"component of the system {wiring.structure.name} has a continuous input of which it "
            "accepts the derivative (`canInterpolateInputs`, or model blocks): leave "
            "`interpolation` out."
        )
    return components


def _stepped_component(
    wiring: Wiring, blocks: Blocks, component: Component, *, linear: bool
) -> SteppedComponent:
    """Return a component ready to be stepped; see `stepped_components`."""
    name = component.name
    infos = {info.name: info for info in wiring.declared[name].variables}
    fed = {}
    for target, port in wiring.feeds.items():
        if target.component == name:
            fed[target.variable] = port
    output_ends = _read_outputs(wiring, blocks, name)
    # variables of the system that the binding sets, at this component
    sent_names = [variable.name for variable in blocks.request.layout.variables]
    sent_inputs = [end.variable for end in _ends_at(blocks, name, sent_names)]
    parameter_names = [parameter.variable for parameter in blocks.binding.parameter.values()]
    tuned_parameters = [end.variable for end in _ends_at(blocks, name, parameter_names)]
    # inputs that move in straight lines
    moving = []
    for variable, port in fed.items():
        if wiring.variable(port.end).continuous and infos[variable].continuous:
            moving.append(variable)
    has_moving_inputs = bool(moving) or any(infos[variable].continuous for variable in sent_inputs)
    can_interpolate = wiring.declared[name].can_interpolate_inputs
    is_linear = linear and can_interpolate and has_moving_inputs
    # start values of inputs, and parameters
    constants: dict[str, float] = {}
    settings: dict[str, float | str] = {}
    for variable, value in wiring.settings[name].items():
        if infos[variable].causality == "input" and not isinstance(value, str):
            constants[variable] = value
        else:
            settings[variable] = value
    units = {info.name: info.unit or "1" for info in infos.values()}
    binding = Binding(
        binding=_component_header(blocks.binding, component, is_linear=is_linear),
        limits=blocks.binding.limits,
        load={
            variable: InputBinding(variable=variable, unit=units[variable])
            for variable in (*fed, *sent_inputs, *constants)
        },
        parameter={
            variable: ParameterBinding(variable=variable, unit=units[variable])
            for variable in (*settings, *tuned_parameters)
        },
        observation={
            end.variable: VectorBinding(variables=(end.variable,), unit=units[end.variable])
            for end in output_ends
        },
    )
    return SteppedComponent(
        name=name,
        ends=output_ends,
        fed=fed,
        moving=frozenset(moving),
        linear=is_linear,
        substeps=1 if is_linear else component.substeps,
        settings=settings,
        constants=constants,
        binding=binding,
    )


def _component_header(binding: Binding, component: Component, *, is_linear: bool) -> BindingHeader:
    """Return the table `[binding]` of a component, derived from the binding of the system."""
    return BindingHeader(
        name=component.name,
        step_size=binding.step_size / component.substeps,
        decimation=component.substeps if is_linear else 1,
        interpolation="linear" if is_linear else "zero-order",
        start_time=binding.binding.start_time,
        stop_time=binding.binding.stop_time,
        interface=component.interface,
        tolerance=binding.binding.tolerance,
    )


def _ends_at(blocks: Blocks, component: str, variables: Iterable[str]) -> list[Endpoint]:
    """Return the variables of a component that belong to variables of the system, in order."""
    description = cast("SystemDescription", blocks.description)
    ends = []
    for variable in variables:
        for port in description.ends[variable]:
            if port.end.component == component:
                ends.append(port.end)
    return ends


def _read_outputs(wiring: Wiring, blocks: Blocks, component: str) -> tuple[Endpoint, ...]:
    """Return the outputs of a component that others or the binding read; at least one.

    If nobody reads any, the first output is taken; a component without an output is refused.
    """
    ends = [port.end for port in wiring.feeds.values() if port.end.component == component]
    read_names = [variable.name for variable in blocks.reply.layout.variables]
    ends += _ends_at(blocks, component, read_names)
    if ends:
        return tuple(dict.fromkeys(ends))
    for info in wiring.declared[component].variables:
        if info.causality == "output" and info.single:
            return (Endpoint(component, info.name),)
    raise CouplingError(
        f"The component {component!r} has no output of a single number, so it takes no part; leave "
        "it out."
    )
