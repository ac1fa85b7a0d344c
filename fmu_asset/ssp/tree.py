"""A system structure as it is written: elements in systems, connectors, connections, values."""

from dataclasses import dataclass, field
from typing import NamedTuple

from fmu_asset.coupling.structure import Setting
from fmu_asset.errors import SspError
from fmu_asset.instances.plan import Interface

from .package import SSD_NAME, SspPackage

INWARD = ("input", "parameter")
"""Kinds of connectors through which values come in; inside a system, they are where values come from."""
ElementPath = tuple[str, ...]
"""The names that lead to an element from the outermost system, whose own path is empty."""


class Node(NamedTuple):
    """A connector of an element: the names that lead to the element, and the connector's."""

    path: ElementPath
    connector: str

    def __str__(self) -> str:
        return ".".join((*self.path, self.connector))


class Edge(NamedTuple):
    """A connection as it is written, from one node to another."""

    source: Node
    factor: float
    offset: float
    convert_units: bool
    delayed: bool


@dataclass(frozen=True)
class DeclaredConnector:
    """A connector as the system structure declares it: kind, type and unit; None where it says nothing."""

    kind: str
    type: str | None
    unit: str | None


@dataclass
class Tree:
    """What was gathered on the way through the systems.

    Attributes
    ----------
    package : SspPackage
        The file.
    components : dict of ElementPath to (str, int, str or None)
        FMU in the archive, number of steps in a step, and interface, by component.
    connectors : dict of Node to DeclaredConnector
        All connectors, those of systems too.
    edges : dict of Node to Edge
        Where each target of a connection gets its value from.
    settings : dict of Node to Setting
        Values of parameter bindings; those of outer systems have taken the place of inner ones.
    """

    package: SspPackage
    components: dict[ElementPath, tuple[str, int, Interface | None]] = field(default_factory=dict)
    connectors: dict[Node, DeclaredConnector] = field(default_factory=dict)
    edges: dict[Node, Edge] = field(default_factory=dict)
    settings: dict[Node, Setting] = field(default_factory=dict)

    def error(self, sentence: str) -> SspError:
        """Return the error that says what is wrong with the system structure."""
        return SspError(f"{SSD_NAME} in {self.package.path}: {sentence}")
