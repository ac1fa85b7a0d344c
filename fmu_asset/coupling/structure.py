"""The records of a system of FMUs: components, connectors of the system, and connections.

They hold what a scenario or an SSP file states, without opening any FMU. `wiring` checks them
against the FMUs.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.client.bound_variables import expand
from fmu_asset.client.units import IDENTITY, Conversion
from fmu_asset.errors import CouplingError
from fmu_asset.instances.plan import Interface
from reporting.words import comma_list

CONNECTOR_KINDS = ("input", "output", "parameter")
"""The kinds of connectors of a system."""

SettingValue = float | bool | str | bytes


class Endpoint(NamedTuple):
    """An end of a connection: `component.variable`, or a connector of the system.

    Attributes
    ----------
    component : str
        Empty for a connector of the system.
    variable : str
        The name of the variable, or of the connector.
    """

    component: str
    variable: str

    def __str__(self) -> str:
        return f"{self.component}.{self.variable}" if self.component else self.variable


@dataclass(frozen=True)
class ComponentSetting:
    """The value of a parameter, or the start value of an input, of an FMU in a system.

    Attributes
    ----------
    value : float, bool, str or bytes
        The value. A text is the value of a text parameter, or names an item of an enumeration.
        Bytes are binary values of SSP, which are refused where a variable would take them.
    unit : str or None
        The unit of the value; None for the unit of the variable.
    scale : Conversion
        The linear transformation of the value, after its conversion to the variable's unit.
    units : tuple of UnitInfo
        Definitions of units that go before those of the system: a parameter set brings its own.
    """

    value: SettingValue
    unit: str | None = None
    scale: Conversion = IDENTITY
    units: tuple[UnitInfo, ...] = field(default=(), compare=False)


@dataclass(frozen=True)
class Component:
    """An FMU in a system.

    Attributes
    ----------
    name : str
        A name that is unique in the system.
    settings : mapping of str to ComponentSetting
        Parameters and start values by variable name.
    substeps : int
        The number of steps that the FMU makes in one step of the system, with constant inputs.
    interface : {"co-simulation", "model-exchange"}, optional
        The interface to be used; by default co-simulation where the FMU offers it.
    shown_as : str
        The name of the FMU in messages, where that is not its path.
    """

    name: str
    fmu: Path
    settings: Mapping[str, ComponentSetting] = field(default_factory=dict)
    substeps: int = 1
    interface: Interface | None = None
    shown_as: str = field(default="", compare=False)


@dataclass(frozen=True)
class Connector:
    """A connector of a system, or one that a file declares for a component.

    Attributes
    ----------
    kind : str
        For a connector of the system one of `CONNECTOR_KINDS`.
    unit : str or None
        The unit; None for the unit of what the connector is connected to.
    type : str or None
        The type as SSP 1.0 calls it; None if no file states it.
    """

    name: str
    kind: str
    unit: str | None = None
    type: str | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Connection:
    """A connection from one end to another: target = factor * source + offset.

    Attributes
    ----------
    source, target : Endpoint
        The source is an output of a component or an input of the system; the target is an input of
        a component or an output of the system.
    factor, offset : float
        The linear transformation, after the conversion to the unit of the target (SSP 1.0, section
        4.4).
    convert_units : bool
        Whether the value is converted where the units of the ends differ.
    delayed : bool
        Whether the target gets the value at the beginning of the step, whatever the order of the
        components.
    """

    source: Endpoint
    target: Endpoint
    factor: float = 1.0
    offset: float = 0.0
    convert_units: bool = True
    delayed: bool = False

    @property
    def scale(self) -> Conversion:
        """The linear transformation."""
        return Conversion(self.factor, self.offset)


@dataclass(frozen=True)
class SystemStructure:
    """A system of FMUs.

    Attributes
    ----------
    name : str
        The name of the system, for people.
    components : tuple of Component
        The FMUs, at least one.
    connectors : tuple of Connector
        The inputs, outputs and parameters of the system as a whole.
    connections : tuple of Connection
        The connections between components, and between them and the connectors.
    units : tuple of UnitInfo
        The definitions of units of connectors and settings; common units need none.
    declared : mapping of Endpoint to Connector
        The connectors of components that a file declares.
    span : (float or None, float or None)
        Start and end of the default experiment [s]; None where a file does not say them.
    base_step : float or None
        The step of the system that a file declares [s].
    unused : tuple of str
        The names of parameters that a file sets, but no element of the system has.
    """

    name: str
    components: tuple[Component, ...]
    connectors: tuple[Connector, ...] = ()
    connections: tuple[Connection, ...] = ()
    units: tuple[UnitInfo, ...] = ()
    declared: Mapping[Endpoint, Connector] = field(default_factory=dict)
    span: tuple[float | None, float | None] = (None, None)
    base_step: float | None = None
    unused: tuple[str, ...] = ()

    def component(self, name: str) -> Component:
        """Return the component of a name.

        Raises
        ------
        CouplingError
            If there is none.
        """
        for component in self.components:
            if component.name == name:
                return component
        names = comma_list(component.name for component in self.components)
        raise CouplingError(f"The system {self.name} has no component {name!r}; it has {names}.")

    def delayed(self, targets: Iterable[str]) -> "SystemStructure":
        """Return the system with the connections to some targets delayed by a step.

        Parameters
        ----------
        targets : iterable of str
            The ends, as `component.variable`.

        Raises
        ------
        CouplingError
            If no connection goes to one of them.
        """
        delayed_targets = set(targets)
        all_targets = [str(connection.target) for connection in self.connections]
        unknown_targets = sorted(delayed_targets.difference(all_targets))
        if unknown_targets:
            raise CouplingError(
                f"No connection of the system {self.name} ends at {comma_list(unknown_targets)}, "
                f"so none can be delayed there; connections end at {comma_list(all_targets)}."
            )
        connections = []
        for connection in self.connections:
            is_delayed = connection.delayed or str(connection.target) in delayed_targets
            connections.append(replace(connection, delayed=is_delayed))
        return replace(self, connections=tuple(connections))


def parse_endpoint(text: str, components: Sequence[str]) -> Endpoint:
    """Return the end of a connection from its text in a scenario file.

    Parameters
    ----------
    text : str
        `component.variable`, or the name of a connector of the system, which has no dot.
    components : sequence of str
        The names of the components.

    Raises
    ------
    CouplingError
        If the text before the dot is not a component.
    """
    matches = [name for name in components if text.startswith(f"{name}.")]
    if matches:
        component = max(matches, key=len)
        return Endpoint(component, text[len(component) + 1 :])
    if "." in text:
        raise CouplingError(
            f"The connection end {text!r} begins with no component; the components are "
            f"{comma_list(components)}. A connector of the system itself is written without a dot."
        )
    return Endpoint("", text)


def expand_connection(
    source: str,
    target: str,
    components: Sequence[str],
    *,
    factor: float = 1.0,
    offset: float = 0.0,
    convert_units: bool = True,
    delayed: bool = False,
) -> tuple[Connection, ...]:
    """Return the connections between two patterns of ends, such as `wing.strain[{1..24}]`.

    Parameters
    ----------
    components : sequence of str
        The names of the components.
    factor, offset, convert_units, delayed
        As for `Connection`.

    Raises
    ------
    CouplingError
        If the patterns stand for unequal numbers of ends, or an end begins with no component.
    """
    unread = f"A connection from {source!r} to {target!r} cannot be read: "
    with CouplingError.instead_of(ValueError, before=unread, after="."):
        sources, targets = expand(source), expand(target)
    if len(sources) != len(targets):
        raise CouplingError(
            f"The connection from {source!r} to {target!r} joins {len(sources)} ends to "
            f"{len(targets)}; both patterns must stand for the same number of ends."
        )
    connections = []
    for source_name, target_name in zip(sources, targets, strict=True):
        connection = Connection(
            source=parse_endpoint(source_name, components),
            target=parse_endpoint(target_name, components),
            factor=factor,
            offset=offset,
            convert_units=convert_units,
            delayed=delayed,
        )
        connections.append(connection)
    return tuple(connections)


def two_sources_sentence(target: object, first_source: object, second_source: object) -> str:
    """Return the message about a target that two connections lead to."""
    return (
        f"{target} has two sources, {first_source} and {second_source}; keep one of the two "
        "connections."
    )
