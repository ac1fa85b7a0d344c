"""Reading an SSP file: nested systems flattened, parameters and mappings applied, FMUs taken out.

What SSP 1.0 allows and is not read is refused in a sentence: signal dictionaries, components that are systems
of their own files, mappings of Booleans, integers and enumerations, texts and binary values.
Of SSP 2.0 the same is read; see `package.in_words_of_1`.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from fmu_asset.coupling.structure import (
    Component,
    Connection,
    Connector,
    ConnectorKind,
    Endpoint,
    Setting,
    SystemStructure,
)
from fmu_asset.errors import SspError
from reporting.files import atomic_write_bytes

from .package import FMU_TYPE, INTERFACES, NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage, tag
from .parameters import VALUE_TYPES, flag, read_bindings, read_transformation, read_units

_INWARD = ("input", "parameter")
"""Kinds of connectors through which values come in; inside a system, they are where values come from."""


@dataclass(frozen=True)
class DeclaredConnector:
    """A connector as the system structure declares it: kind, type and unit; None where it says nothing."""

    kind: str
    type: str | None
    unit: str | None


@dataclass(frozen=True)
class SspSystem:
    """What an SSP file holds.

    Attributes
    ----------
    structure : SystemStructure
        The system, flat; a component of a nested system is named `system.component`.
    declared : dict of Endpoint to DeclaredConnector
        The connectors of the components, as the file declares them.
    span : (float or None, float or None)
        Start and end of the default experiment [s], where the file says them.
    unused : tuple of str
        Names of parameters that are set, but are of no element of the system.
    """

    structure: SystemStructure
    declared: dict[Endpoint, DeclaredConnector]
    span: tuple[float | None, float | None] = (None, None)
    unused: tuple[str, ...] = ()


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
    tree = _Tree(package, root.find("ssd:System", NAMESPACES))
    connections = tuple(tree.flat_connections())
    settings = tree.flat_settings()
    components = []
    for name, (source, substeps, interface) in tree.components.items():
        # Under its name in the archive, once for all components that are of it.
        file = Path(folder) / source
        file.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(file, package.read(source))
        own = {node.variable: value for node, value in settings.items() if node.component == name}
        components.append(Component(name, file, own, substeps, interface))
    connectors = tuple(tree.outer_connectors())
    units = read_units(root, "ssd")
    structure = SystemStructure(str(root.get("name")), tuple(components), connectors, connections, units)
    inner = {node: it for node, it in tree.connectors.items() if node.component in tree.components}
    found = root.find("ssd:DefaultExperiment", NAMESPACES)
    told = {} if found is None else found.attrib
    start, stop = (float(told[name]) if name in told else None for name in ("startTime", "stopTime"))
    return SspSystem(structure, inner, (start, stop), tuple(package.unused))


class _Tree:
    """A system structure as it is written, and made flat: connections traced, values of connectors passed on.

    Elements go by the names that lead to them, with dots between, from the outermost system, whose own is
    empty; a connector is an end of one.
    """

    def __init__(self, package: SspPackage, system: Any) -> None:
        self.package = package
        self.components: dict[str, tuple[str, int, Any]] = {}
        self.connectors: dict[Endpoint, DeclaredConnector] = {}
        self._edges: dict[Endpoint, Connection] = {}
        self._settings: dict[Endpoint, Setting] = {}
        self._read_system(system, "")

    def _error(self, sentence: str) -> SspError:
        """Return the error that says what is wrong with the system structure."""
        return SspError(f"{SSD_NAME} in {self.package.path}: {sentence}")

    # ------------------------------------------------------------------ as it is written

    def _read_system(self, element: Any, path: str) -> None:
        name = str(element.get("name"))
        if element.find("ssd:SignalDictionaries", NAMESPACES) is not None:
            raise self._error(
                f"the system {name!r} has signal dictionaries, which are not supported; connect directly."
            )
        self._read_connectors(element, path)
        children: dict[str, str] = {}
        for child in element.iterfind("ssd:Elements/*", NAMESPACES):
            own = str(child.get("name"))
            if own in children:
                raise self._error(
                    f"the system {name!r} has two elements named {own!r}; each needs a name of its own."
                )
            children[own] = f"{path}.{own}".removeprefix(".")
            if child.tag == tag("ssd:System"):
                self._read_system(child, children[own])
            elif child.tag == tag("ssd:Component"):
                self._read_component(child, children[own])
            else:
                raise self._error(
                    f"the system {name!r} refers to the signal dictionary {own!r}, which is not supported; "
                    "connect directly."
                )
        for connection in element.findall("ssd:Connections/ssd:Connection", NAMESPACES):
            self._read_connection(connection, path, children)
        self._bind(element, path)  # after the elements in it: bindings of a system go before theirs

    def _read_component(self, element: Any, path: str) -> None:
        where = f"the component {path!r}"
        if path in self.components:
            raise self._error(f"two components are named {path!r}; rename one of them.")
        if element.get("type", FMU_TYPE) != FMU_TYPE:
            raise self._error(f"{where} is of the type {element.get('type')!r}; only FMUs are supported.")
        implementation = element.get("implementation", "any")
        if implementation not in INTERFACES:
            raise self._error(f"{where} asks for {implementation!r}, which is not supported.")
        source = self.package.resolve(str(element.get("source")), where)
        substeps = _annotation(element).get("substeps", "1")
        if not (substeps.isascii() and substeps.isdigit() and int(substeps) > 0):
            raise self._error(
                f"{where} has the number of steps {substeps!r}, which must be a positive whole number."
            )
        self.components[path] = (source, int(substeps), INTERFACES[implementation])
        self._read_connectors(element, path)
        self._bind(element, path)

    def _read_connectors(self, element: Any, path: str) -> None:
        for connector in element.findall("ssd:Connectors/ssd:Connector", NAMESPACES):
            node = Endpoint(path, str(connector.get("name")))
            if node in self.connectors:
                raise self._error(f"the connector {str(node)!r} is there twice.")
            items = {name: connector.find(f"ssc:{name}", NAMESPACES) for name in VALUE_TYPES}
            kind = next((name for name, item in items.items() if item is not None), None)
            if kind == "Binary":
                raise self._error(f"the connector {str(node)!r} is binary, which is not supported.")
            unit = items[kind].get("unit") or None if kind else None
            self.connectors[node] = DeclaredConnector(str(connector.get("kind")), kind, unit)

    def _read_connection(self, element: Any, path: str, children: dict[str, str]) -> None:
        ends: list[Endpoint] = []
        gives: list[bool] = []
        for side in ("start", "end"):
            owner = element.get(f"{side}Element")
            if owner and owner not in children:
                raise self._error(
                    f"a connection names the element {owner!r}, which its system does not have."
                )
            node = Endpoint(children[owner] if owner else path, str(element.get(f"{side}Connector")))
            declared = self.connectors.get(node)
            if declared is None:
                raise self._error(f"a connection names the connector {str(node)!r}, which is not declared.")
            ends.append(node)
            # Seen from inside, an input of the system is where values come from.
            gives.append((declared.kind in _INWARD) == (not owner))
        if gives[0] == gives[1]:
            raise self._error(
                f"a connection joins {str(ends[0])!r} and {str(ends[1])!r}, which both "
                f"{'give' if gives[0] else 'take'} a value; connect what gives one to what takes one."
            )
        # The kinds of the connectors say which way a value goes; "start" and "end" do not (SSP 1.0, 5.3).
        source, target = ends if gives[0] else reversed(ends)
        if target in self._edges:
            raise self._error(
                f"{str(target)!r} has two sources, {str(self._edges[target].source)!r} and {str(source)!r}; "
                "keep one of the two connections."
            )
        factor, offset = read_transformation(element, f"the connection from {source} to {target}")
        convert = not flag(element, "suppressUnitConversion")
        delayed = _annotation(element).get("delayed") == "true"
        self._edges[target] = Connection(source, target, factor, offset, convert, delayed)

    def _bind(self, element: Any, path: str) -> None:
        """Take the parameter bindings of an element; they go before those of the elements inside it."""
        where = f"the element {path or str(element.get('name'))!r}"
        for name, setting in read_bindings(element, self.package, where).items():
            nodes = self._nodes_of(name, path)
            self._settings |= dict.fromkeys(nodes, setting)
            self.package.unused += [] if nodes else [str(Endpoint(path, name))]

    def _nodes_of(self, name: str, path: str) -> list[Endpoint]:
        """Return connectors of systems, and variables that components may have, of a parameter's name."""
        found = []
        for place in dict.fromkeys((*self.components, *(node.component for node in self.connectors))):
            if path not in ("", place) and not place.startswith(f"{path}."):
                continue
            inside = place.removeprefix(path).removeprefix(".")
            before = f"{inside}." if inside else ""
            node = Endpoint(place, name.removeprefix(before))
            known = place in self.components or node in self.connectors
            if known and name.startswith(before):
                found.append(node)
        return found

    # ------------------------------------------------------------------ flat

    def outer_connectors(self) -> Iterator[Connector]:
        """Yield the connectors of the outermost system."""
        for node, declared in self.connectors.items():
            if node.component == "":
                if declared.kind not in get_args(ConnectorKind):
                    raise self._error(
                        f"the connector {str(node)!r} of the system is of the kind {declared.kind}, not "
                        "supported."
                    )
                yield Connector(node.variable, cast("ConnectorKind", declared.kind), declared.unit)

    def _is_end(self, node: Endpoint) -> bool:
        return node.component in self.components or node.component == ""

    def flat_connections(self) -> Iterator[Connection]:
        """Yield the connections between components, and between them and the outermost connectors.

        Raises
        ------
        SspError
            If they go round in a circle of systems, or are transformed in units that nobody resolves.
        """
        for target in filter(self._is_end, self._edges):
            edges = [self._edges[target]]
            while not self._is_end(edges[0].source) and edges[0].source in self._edges:
                edges.insert(0, self._edges[edges[0].source])
                if len(edges) > len(self._edges) + 1:
                    raise self._error(f"the connections to {str(target)!r} go round in a circle of systems.")
            if self._is_end(edges[0].source):  # else nothing comes to a connector of a nested system
                yield self._joined(edges)

    def _joined(self, edges: list[Connection]) -> Connection:
        """Return one connection for those that follow one another through nested systems."""
        source, target = edges[0].source, edges[-1].target
        factor, offset = 1.0, 0.0
        for edge in edges:
            factor, offset = edge.factor * factor, edge.factor * offset + edge.offset
        with_units = any(self.connectors[edge.source].unit for edge in edges[1:])
        converted = {edge.convert_units for edge in edges}
        if len(converted) > 1 or ((factor, offset) != (1.0, 0.0) and with_units):
            raise self._error(
                f"the connection to {str(target)!r} through a nested system is transformed between "
                "connectors with units of their own, which is not supported; leave out the units of the "
                "nested system's connectors."
            )
        if not (source.component or target.component):
            raise self._error(f"{str(source)!r} is connected to {str(target)!r} without a component between.")
        delayed = any(edge.delayed for edge in edges)
        return Connection(source, target, factor, offset, converted == {True}, delayed)

    def flat_settings(self) -> dict[Endpoint, Setting]:
        """Return values by variables of components; those of connectors of systems follow the connections.

        Raises
        ------
        SspError
            If a connector is set through which no value comes in, or whose value is transformed on its way.
        """
        found = {n: s for n, s in self._settings.items() if n.component in self.components}
        outer = [node for node in self._settings if node.component not in self.components]
        # Of a system inside another the outer one comes last, and counts.
        for node in sorted(outer, key=lambda node: -len(node.component)):
            found |= dict.fromkeys(self._behind(node), self._settings[node])
        return found

    def _behind(self, node: Endpoint) -> Iterator[Endpoint]:
        """Yield the variables of components that a connector of a system goes to."""
        if self.connectors[node].kind not in _INWARD:
            raise self._error(f"{str(node)!r} is set, but it is of the kind {self.connectors[node].kind}.")
        for target, edge in self._edges.items():
            if edge.source != node:
                continue
            if (edge.factor, edge.offset, edge.convert_units) != (1.0, 0.0, True):
                raise self._error(
                    f"{str(node)!r} is set and transformed on its way to {str(target)!r}; set that instead."
                )
            if target.component in self.components:
                yield target
            else:
                yield from self._behind(target)


def _annotation(element: Any) -> Any:
    found = element.find(f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling", NAMESPACES)
    return {} if found is None else found.attrib
