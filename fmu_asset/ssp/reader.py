"""Reading an SSP file: nested systems flattened, parameters and mappings applied, FMUs taken out.

What SSP 1.0 allows and is not read is refused in a sentence: signal dictionaries, components that are systems
of their own files, model exchange, mappings of Booleans, integers and enumerations, texts and binary values.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from reporting.files import atomic_write_bytes

from ..archive import UnitInfo
from ..coupling.structure import (
    Component,
    Connection,
    Connector,
    ConnectorKind,
    Endpoint,
    Setting,
    SystemStructure,
)
from ..errors import SspError
from .package import NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage, tag
from .parameters import flag, read_bindings, read_transformation, read_units

_FMU_TYPE = "application/x-fmu-sharedlibrary"
_INWARD = ("input", "parameter")
Path_ = tuple[str, ...]


class Node(NamedTuple):
    """A connector of an element: the names that lead to the element, and the connector's."""

    path: Path_
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
class _Read:
    """What was gathered on the way through the systems."""

    package: SspPackage
    components: dict[Path_, tuple[str, int]] = field(default_factory=dict)
    connectors: dict[Node, DeclaredConnector] = field(default_factory=dict)
    edges: dict[Node, Edge] = field(default_factory=dict)
    settings: dict[Node, Setting] = field(default_factory=dict)
    units: dict[str, UnitInfo] = field(default_factory=dict)

    def error(self, sentence: str) -> SspError:
        return SspError(f"{SSD_NAME} in {self.package.path}: {sentence}")


@dataclass(frozen=True)
class SspSystem:
    """What an SSP file holds.

    Attributes
    ----------
    structure : SystemStructure
        The system, flat; a component of a nested system is named `system.component`.
    declared : dict of Endpoint to DeclaredConnector
        The connectors of the components, as the file declares them.
    """

    structure: SystemStructure
    declared: dict[Endpoint, DeclaredConnector]


def read_ssp(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> SspSystem:
    """Read an SSP file, and write the FMUs in it to a folder.

    Parameters
    ----------
    path : path-like
        The file.
    folder : path-like
        Where its FMUs are put; made if it is missing.

    Returns
    -------
    SspSystem
        The system. Whether it fits its FMUs is checked where it is joined; see `coupling.wiring`.

    Raises
    ------
    SspError
        If the file is missing, damaged, unsafe or not valid by the schema, or uses what is not supported.
    """
    package = SspPackage(path)
    root = package.parse(SSD_NAME, "ssd")
    read = _Read(package)
    units = root.find(tag("ssd", "Units"))
    for unit in () if units is None else read_units(units):
        read.units[unit.name] = unit
    system = root.find(tag("ssd", "System"))
    _system(read, system, ())
    names = _names(read)
    fmus = _extract(read, Path(folder))
    connections = tuple(_flattened(read, names))
    settings = _resolved_settings(read)
    components = tuple(
        Component(
            names[place],
            fmus[source],
            {node.connector: value for node, value in settings.items() if node.path == place},
            substeps,
        )
        for place, (source, substeps) in read.components.items()
    )
    connectors = tuple(
        Connector(node.connector, _kind(read, node, declared), declared.unit)
        for node, declared in read.connectors.items()
        if node.path == ()
    )
    structure = SystemStructure(
        str(root.get("name")), components, connectors, connections, tuple(read.units.values())
    )
    inner = {
        Endpoint(names[node.path], node.connector): declared
        for node, declared in read.connectors.items()
        if node.path in names
    }
    return SspSystem(structure, inner)


def _kind(read: _Read, node: Node, declared: DeclaredConnector) -> ConnectorKind:
    if declared.kind == "input":
        return "input"
    if declared.kind == "output":
        return "output"
    if declared.kind == "parameter":
        return "parameter"
    raise read.error(
        f"the connector {str(node)!r} of the system is of the kind {declared.kind}, which is not supported."
    )


# ---------------------------------------------------------------------- the tree


def _system(read: _Read, element: Any, path: Path_) -> None:
    name = str(element.get("name"))
    if element.find(tag("ssd", "SignalDictionaries")) is not None:
        raise read.error(
            f"the system {name!r} has signal dictionaries, which are not supported; connect directly."
        )
    _connectors(read, element, path)
    children: set[str] = set()
    elements = element.find(tag("ssd", "Elements"))
    for child in () if elements is None else elements:
        if not isinstance(child.tag, str):
            continue  # a comment
        own = str(child.get("name"))
        if own in children:
            raise read.error(
                f"the system {name!r} has two elements named {own!r}; each needs a name of its own."
            )
        children.add(own)
        if child.tag == tag("ssd", "System"):
            _system(read, child, (*path, own))
        elif child.tag == tag("ssd", "Component"):
            _component(read, child, (*path, own))
        else:
            raise read.error(
                f"the system {name!r} refers to the signal dictionary {own!r}, which is not supported; "
                "connect "
                "directly."
            )
    for connection in element.findall("ssd:Connections/ssd:Connection", NAMESPACES):
        _connection(read, connection, path, children)
    _bind(read, element, path)  # after the elements in it: bindings of a system go before theirs


def _component(read: _Read, element: Any, path: Path_) -> None:
    where = f"the component {'.'.join(path)!r}"
    if element.get("type", _FMU_TYPE) != _FMU_TYPE:
        raise read.error(f"{where} is of the type {element.get('type')!r}; only FMUs are supported.")
    if element.get("implementation", "any") == "ModelExchange":
        raise read.error(f"{where} asks for model exchange; only co-simulation is supported.")
    source = read.package.resolve(str(element.get("source")), where)
    substeps = _annotation(element).get("substeps", "1")
    if not (substeps.isascii() and substeps.isdigit() and int(substeps) > 0):
        raise read.error(
            f"{where} has the number of steps {substeps!r}, which must be a positive whole number."
        )
    read.components[path] = (source, int(substeps))
    _connectors(read, element, path)
    _bind(read, element, path)


def _connectors(read: _Read, element: Any, path: Path_) -> None:
    for connector in element.findall("ssd:Connectors/ssd:Connector", NAMESPACES):
        node = Node(path, str(connector.get("name")))
        if node in read.connectors:
            raise read.error(f"the connector {str(node)!r} is there twice.")
        kind, unit = None, None
        for name in ("Real", "Integer", "Boolean", "Enumeration", "String", "Binary"):
            item = connector.find(tag("ssc", name))
            if item is not None:
                kind, unit = name, item.get("unit")
        if kind == "Binary":
            raise read.error(f"the connector {str(node)!r} is binary, which is not supported.")
        read.connectors[node] = DeclaredConnector(str(connector.get("kind")), kind, unit)


def _annotation(element: Any) -> Any:
    found = element.find(f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling", NAMESPACES)
    return {} if found is None else found.attrib


def _connection(read: _Read, element: Any, path: Path_, children: set[str]) -> None:
    ends = []
    for side in ("start", "end"):
        owner = element.get(f"{side}Element")
        connector = str(element.get(f"{side}Connector"))
        if owner and owner not in children:
            raise read.error(f"a connection names the element {owner!r}, which its system does not have.")
        node = Node((*path, owner) if owner else path, connector)
        declared = read.connectors.get(node)
        if declared is None:
            raise read.error(f"a connection names the connector {str(node)!r}, which is not declared.")
        # Seen from inside, an input of the system is where values come from.
        gives = (declared.kind in _INWARD) == (not owner)
        if gives != (side == "start"):
            raise read.error(
                f"a connection {'begins' if side == 'start' else 'ends'} at {str(node)!r}, which is of the "
                "kind "
                f"{declared.kind}; connections go from outputs to inputs."
            )
        ends.append(node)
    source, target = ends
    if target in read.edges:
        raise read.error(
            f"{str(target)!r} has two sources, {str(read.edges[target].source)!r} and {str(source)!r}; keep "
            "one of "
            "the two connections."
        )
    factor, offset = read_transformation(element, f"the connection from {source} to {target}")
    convert = not flag(element, "suppressUnitConversion")
    delayed = _annotation(element).get("delayed") == "true"
    read.edges[target] = Edge(source, factor, offset, convert, delayed)


def _bind(read: _Read, element: Any, path: Path_) -> None:
    """Take the parameter bindings of an element; they go before those of the elements inside it."""
    where = f"the element {'.'.join(path) or str(element.get('name'))!r}"
    own: dict[Node, Setting] = {}
    for values, units in read_bindings(element, read.package, where):
        for unit in units:
            known = read.units.setdefault(unit.name, unit)
            if known != unit:
                raise read.error(f"the unit {unit.name!r} is defined in two ways.")
        for name, setting in values.items():
            for node in _nodes_of(read, name, path, where):
                if node in own:
                    raise read.error(f"{where} sets {str(node)!r} twice; keep one of the two.")
                own[node] = setting
    read.settings |= own


def _nodes_of(read: _Read, name: str, path: Path_, where: str) -> list[Node]:
    """Return the variables of components, or connectors of systems, that a parameter name stands for."""
    if path in read.components:
        return [Node(path, name)]
    if Node(path, name) in read.connectors:
        return [Node(path, name)]
    owners = [
        place
        for place in (*read.components, *{node.path for node in read.connectors})
        if len(place) > len(path)
        and place[: len(path)] == path
        and name.startswith(".".join(place[len(path) :]) + ".")
    ]
    if not owners:
        raise read.error(f"{where} sets {name!r}, which begins with no element and is no connector of it.")
    owner = max(owners, key=lambda place: len(".".join(place)))
    node = Node(owner, name[len(".".join(owner[len(path) :])) + 1 :])
    if owner not in read.components and node not in read.connectors:
        raise read.error(
            f"{where} sets {name!r}, but {'.'.join(owner)!r} has no connector {node.connector!r}."
        )
    return [node]


# ---------------------------------------------------------------------- flat


def _names(read: _Read) -> dict[Path_, str]:
    names = {path: ".".join(path) for path in read.components}
    for path, name in names.items():
        if list(names.values()).count(name) > 1:
            raise read.error(f"two components are named {name!r} ({path}); rename one of them.")
    return names


def _extract(read: _Read, folder: Path) -> dict[str, Path]:
    """Write each FMU once, under a plain name; return the files by their names in the archive."""
    files: dict[str, Path] = {}
    for source, _ in read.components.values():
        if source not in files:
            stem = re.sub(r"[^A-Za-z0-9_\-]", "_", Path(source).stem)
            target = folder / f"{len(files) + 1}-{stem}.fmu"
            atomic_write_bytes(target, read.package.read(source))
            files[source] = target
    return files


def _flattened(read: _Read, names: dict[Path_, str]) -> Iterator[Connection]:
    """Yield the connections between components, and between them and the outermost connectors."""
    for target in read.edges:
        if target.path in read.components or target.path == ():
            yield from _trace(read, target, names)


def _trace(read: _Read, target: Node, names: dict[Path_, str]) -> Iterator[Connection]:
    edge = read.edges[target]
    edges = [edge]
    passed = []
    while edge.source.path not in read.components and edge.source.path != ():
        passed.append(edge.source)
        inner = read.edges.get(edge.source)
        if inner is None:
            return  # a connector of a nested system that nothing comes to
        edge = inner
        edges.append(edge)
        if len(edges) > len(read.edges) + 1:
            raise read.error(f"the connections to {str(target)!r} go round in a circle of systems.")
    edges.reverse()
    factor, offset = 1.0, 0.0
    for item in edges:
        factor, offset = item.factor * factor, item.factor * offset + item.offset
    scaled = (factor, offset) != (1.0, 0.0)
    suppressed = {not item.convert_units for item in edges}
    if len(edges) > 1 and ((scaled and any(read.connectors[n].unit for n in passed)) or len(suppressed) > 1):
        raise read.error(
            f"the connection to {str(target)!r} through a nested system is transformed between connectors "
            "with units "
            "of their own, which is not supported; leave out the units of the nested system's connectors."
        )
    if edges[0].source.path == () and target.path == ():
        raise read.error(
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


def _resolved_settings(read: _Read) -> dict[Node, Setting]:
    """Return settings by variables of components; those of connectors of systems follow the connections."""
    found: dict[Node, Setting] = {n: s for n, s in read.settings.items() if n.path in read.components}
    outer = sorted((n for n in read.settings if n.path not in read.components), key=lambda n: -len(n.path))
    for node in outer:
        for target in _behind(read, node):
            found[target] = read.settings[node]
    return found


def _behind(read: _Read, node: Node) -> Iterator[Node]:
    """Yield the variables of components that a connector of a system goes to."""
    reached = [target for target, edge in read.edges.items() if edge.source == node]
    if read.connectors[node].kind not in _INWARD:
        raise read.error(f"{str(node)!r} is set, but it is of the kind {read.connectors[node].kind}.")
    for target in reached:
        edge = read.edges[target]
        if (edge.factor, edge.offset, edge.convert_units) != (1.0, 0.0, True):
            raise read.error(
                f"{str(node)!r} is set and transformed on its way to {str(target)!r}; set that instead."
            )
        if target.path in read.components:
            yield target
        else:
            yield from _behind(read, target)
