"""A system of FMUs as data: components, connectors of the system, connections; no file is opened here."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.client.bound_variables import expand
from fmu_asset.client.units import IDENTITY, Conversion
from fmu_asset.errors import CouplingError, said
from fmu_asset.instances.plan import Interface

CONNECTOR_KINDS = ("input", "output", "parameter")
"""What a connector of a system can be."""
SettingValue = float | bool | str | bytes


class Endpoint(NamedTuple):
    """An end of a connection: a variable of a component, or (`component` empty) a connector of the system."""

    component: str
    variable: str

    def __str__(self) -> str:
        return f"{self.component}.{self.variable}" if self.component else self.variable


@dataclass(frozen=True)
class Setting:
    """The value of a parameter, or the start value of an input.

    Attributes
    ----------
    value : float, bool, str or bytes
        The value. A text is that of a parameter that is one, or names an item of an enumeration; nothing
        takes bytes, which are refused where a variable would.
    unit : str or None
        Its unit; that of the variable if None.
    scale : Conversion
        What the value, converted to the variable's unit, is scaled by.
    units : tuple of UnitInfo
        Definitions that go before those of the system: a parameter set brings its own.
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
        Unique in the system.
    fmu : Path
        The file.
    settings : mapping of str to Setting
        Parameters and start values by variable name.
    substeps : int
        Number of steps that the FMU makes in one step of the system, its inputs held.
    interface : {"co-simulation", "model-exchange"}, optional
        How it is run; co-simulation where it offers that.
    shown_as : str
        What sentences call the FMU, where that is not its path.
    """

    name: str
    fmu: Path
    settings: Mapping[str, Setting] = field(default_factory=dict)
    substeps: int = 1
    interface: Interface | None = None
    shown_as: str = field(default="", compare=False)


@dataclass(frozen=True)
class Connector:
    """A connector of a system, or what its file says of one of a component.

    Attributes
    ----------
    name, kind : str
        That of a system is of one of `CONNECTOR_KINDS`.
    unit : str or None
        If None, that of what it is connected to.
    type : str or None
        In the words of SSP 1.0, where a file says it.
    """

    name: str
    kind: str
    unit: str | None = None
    type: str | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Connection:
    """What flows from one end to another: target = factor * source + offset.

    Attributes
    ----------
    source, target : Endpoint
        An output of a component or an input of the system; an input of a component or an output of the
        system.
    factor, offset : float
        The linear transformation, of the source converted to the unit of the target (SSP 1.0, section 4.4).
    convert_units : bool
        Whether the value is converted where the units of the ends differ.
    delayed : bool
        Whether the value is that of the beginning of the step, whatever the order of the components.
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
        For people.
    components : tuple of Component
        At least one.
    connectors : tuple of Connector
        What the system shows to the outside.
    connections : tuple of Connection
        Between components, and between them and the connectors.
    units : tuple of UnitInfo
        Definitions of the units of connectors and settings; common units need none.
    declared : mapping of Endpoint to Connector
        Connectors of the components, as a file declares them.
    span : (float or None, float or None)
        Start and end of the default experiment [s], where a file says them.
    base_step : float or None
        Step of the system that a file declares [s].
    unused : tuple of str
        Names of parameters that a file sets, but that are of no element of the system.
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
        """Return the component of that name.

        Raises
        ------
        CouplingError
            If there is none.
        """
        for component in self.components:
            if component.name == name:
                return component
        known = [component.name for component in self.components]
        raise CouplingError(said("coupling.no_component", self=self, name=name, known=known))

    def delayed(self, targets: Iterable[str]) -> "SystemStructure":
        """Return the system with the connections to these ends delayed.

        Raises
        ------
        CouplingError
            If no connection ends there.
        """
        wanted = set(targets)
        ends = [str(connection.target) for connection in self.connections]
        if missing := wanted - {*ends}:
            raise CouplingError(said("coupling.no_delay", self=self, names=sorted(missing), known=ends))
        delayed = [replace(c, delayed=c.delayed or str(c.target) in wanted) for c in self.connections]
        return replace(self, connections=tuple(delayed))


def parse_endpoint(text: str, components: Sequence[str]) -> Endpoint:
    """Return the end that a scenario file names: `component.variable`; without a dot, a system connector.

    Raises
    ------
    CouplingError
        If what stands before the dot is no component.
    """
    owners = [name for name in components if text.startswith(f"{name}.")]
    if owners:
        owner = max(owners, key=len)
        return Endpoint(owner, text[len(owner) + 1 :])
    if "." in text:
        raise CouplingError(said("coupling.no_dot", text=text, components=components))
    return Endpoint("", text)


def expand_connection(
    source: str, target: str, components: Sequence[str], **options: Any
) -> tuple[Connection, ...]:
    """Return the connections that two patterns stand for, such as `wing.strain[{1..24}]`, pair by pair.

    Parameters
    ----------
    source, target : str
        The patterns.
    components : sequence of str
        Names of the components.
    **options
        What `Connection` has beside its ends.

    Raises
    ------
    CouplingError
        If the patterns are of unequal length, or an end begins with no component.
    """
    before = f"A connection from {source!r} to {target!r} cannot be read: "
    with CouplingError.instead_of(ValueError, before=before, after="."):
        sources, targets = expand(source), expand(target)
    if len(sources) != len(targets):
        counts = len(sources), len(targets)
        raise CouplingError(said("coupling.patterns", source=source, target=target, counts=counts))
    return tuple(
        Connection(parse_endpoint(a, components), parse_endpoint(b, components), **options)
        for a, b in zip(sources, targets, strict=True)
    )
