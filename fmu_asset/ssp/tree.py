"""A system structure as it is written, and made flat: connections traced, values of connectors passed on."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from fmu_asset.coupling.structure import Connection, Endpoint, Setting
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


def flat_connections(tree: Tree, names: Mapping[ElementPath, str]) -> Iterator[Connection]:
    """Yield the connections between components, and between them and the outermost connectors.

    Raises
    ------
    SspError
        A connection is transformed on its way through nested systems in a way that is not supported.
    """
    for target in tree.edges:
        if target.path in tree.components or target.path == ():
            yield from _trace(tree, target, names)


def _trace(tree: Tree, target: Node, names: Mapping[ElementPath, str]) -> Iterator[Connection]:
    edge = tree.edges[target]
    edges = [edge]
    passed = []
    while edge.source.path not in tree.components and edge.source.path != ():
        passed.append(edge.source)
        inner = tree.edges.get(edge.source)
        if inner is None:
            return  # a connector of a nested system that nothing comes to
        edge = inner
        edges.append(edge)
        if len(edges) > len(tree.edges) + 1:
            raise tree.error(f"the connections to {str(target)!r} go round in a circle of systems.")
    edges.reverse()
    factor, offset = 1.0, 0.0
    for item in edges:
        factor, offset = item.factor * factor, item.factor * offset + item.offset
    scaled = (factor, offset) != (1.0, 0.0)
    suppressed = {not item.convert_units for item in edges}
    if len(edges) > 1 and ((scaled and any(tree.connectors[n].unit for n in passed)) or len(suppressed) > 1):
        raise tree.error(
            f"the connection to {str(target)!r} through a nested system is transformed between connectors "
            "with units "
            "of their own, which is not supported; leave out the units of the nested system's connectors."
        )
    if edges[0].source.path == () and target.path == ():
        raise tree.error(
            f"{str(edges[0].source)!r} is connected to {str(target)!r} without a component between."
        )

    def end(node: Node) -> Endpoint:
        return Endpoint(names.get(node.path, ""), node.connector)

    yield Connection(
        end(edges[0].source),
        end(target),
        factor,
        offset,
        suppressed == {False},
        any(e.delayed for e in edges),
    )


def flat_settings(tree: Tree) -> dict[Node, Setting]:
    """Return values by variables of components; those of connectors of systems follow the connections.

    Raises
    ------
    SspError
        A connector that is set gives nothing, or its value is transformed on its way.
    """
    found: dict[Node, Setting] = {n: s for n, s in tree.settings.items() if n.path in tree.components}
    outer = sorted((n for n in tree.settings if n.path not in tree.components), key=lambda n: -len(n.path))
    for node in outer:
        for target in _behind(tree, node):
            found[target] = tree.settings[node]
    return found


def _behind(tree: Tree, node: Node) -> Iterator[Node]:
    """Yield the variables of components that a connector of a system goes to."""
    reached = [target for target, edge in tree.edges.items() if edge.source == node]
    if tree.connectors[node].kind not in INWARD:
        raise tree.error(f"{str(node)!r} is set, but it is of the kind {tree.connectors[node].kind}.")
    for target in reached:
        edge = tree.edges[target]
        if (edge.factor, edge.offset, edge.convert_units) != (1.0, 0.0, True):
            raise tree.error(
                f"{str(node)!r} is set and transformed on its way to {str(target)!r}; set that instead."
            )
        if target.path in tree.components:
            yield target
        else:
            yield from _behind(tree, target)
