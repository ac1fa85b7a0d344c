"""Reading an SSP file: nested systems flattened, parameters and mappings applied, FMUs taken out.

What SSP 1.0 allows and is not read is refused in a sentence: signal dictionaries, components that are systems
of their own files, mappings of Booleans, integers and enumerations, texts and binary values.
Of SSP 2.0 the same is read; see `package.in_words_of_1`.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from fmu_asset.coupling.structure import (
    Component,
    Connector,
    ConnectorKind,
    Endpoint,
    SystemStructure,
)
from reporting.files import atomic_write_bytes

from .package import FMU_TYPE, INTERFACES, NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage, tag
from .parameters import VALUE_TYPES, flag, read_bindings, read_transformation, read_units
from .tree import INWARD, DeclaredConnector, Edge, ElementPath, Node, Tree, flat_connections, flat_settings


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
    tree = Tree(package)
    system = root.find("ssd:System", NAMESPACES)
    _system(tree, system, ())
    names = _names(tree)
    fmus = _extract(tree, Path(folder))
    connections = tuple(flat_connections(tree, names))
    settings = flat_settings(tree)
    components = tuple(
        Component(
            names[place],
            fmus[source],
            {node.connector: value for node, value in settings.items() if node.path == place},
            substeps,
            interface,
        )
        for place, (source, substeps, interface) in tree.components.items()
    )
    connectors = tuple(
        Connector(node.connector, _kind(tree, node, declared), declared.unit)
        for node, declared in tree.connectors.items()
        if node.path == ()
    )
    units = read_units(root, "ssd")
    structure = SystemStructure(str(root.get("name")), components, connectors, connections, units)
    inner = {
        Endpoint(names[node.path], node.connector): declared
        for node, declared in tree.connectors.items()
        if node.path in names
    }
    return SspSystem(structure, inner, _span(root), tuple(package.unused))


def _span(root: Any) -> tuple[float | None, float | None]:
    found = root.find("ssd:DefaultExperiment", NAMESPACES)
    if found is None:
        return None, None
    start, stop = (found.get(name) for name in ("startTime", "stopTime"))
    return None if start is None else float(start), None if stop is None else float(stop)


def _kind(tree: Tree, node: Node, declared: DeclaredConnector) -> ConnectorKind:
    if declared.kind not in get_args(ConnectorKind):
        raise tree.error(
            f"the connector {str(node)!r} of the system is of the kind {declared.kind}, not supported."
        )
    return cast("ConnectorKind", declared.kind)


# ---------------------------------------------------------------------- the tree


def _system(tree: Tree, element: Any, path: ElementPath) -> None:
    name = str(element.get("name"))
    if element.find("ssd:SignalDictionaries", NAMESPACES) is not None:
        raise tree.error(
            f"the system {name!r} has signal dictionaries, which are not supported; connect directly."
        )
    _connectors(tree, element, path)
    children: set[str] = set()
    for child in element.iterfind("ssd:Elements/*", NAMESPACES):
        own = str(child.get("name"))
        if own in children:
            raise tree.error(
                f"the system {name!r} has two elements named {own!r}; each needs a name of its own."
            )
        children.add(own)
        if child.tag == tag("ssd:System"):
            _system(tree, child, (*path, own))
        elif child.tag == tag("ssd:Component"):
            _component(tree, child, (*path, own))
        else:
            raise tree.error(
                f"the system {name!r} refers to the signal dictionary {own!r}, which is not supported; "
                "connect directly."
            )
    for connection in element.findall("ssd:Connections/ssd:Connection", NAMESPACES):
        _connection(tree, connection, path, children)
    _bind(tree, element, path)  # after the elements in it: bindings of a system go before theirs


def _component(tree: Tree, element: Any, path: ElementPath) -> None:
    where = f"the component {'.'.join(path)!r}"
    if element.get("type", FMU_TYPE) != FMU_TYPE:
        raise tree.error(f"{where} is of the type {element.get('type')!r}; only FMUs are supported.")
    implementation = element.get("implementation", "any")
    if implementation not in INTERFACES:
        raise tree.error(f"{where} asks for {implementation!r}, which is not supported.")
    source = tree.package.resolve(str(element.get("source")), where)
    substeps = _annotation(element).get("substeps", "1")
    if not (substeps.isascii() and substeps.isdigit() and int(substeps) > 0):
        raise tree.error(
            f"{where} has the number of steps {substeps!r}, which must be a positive whole number."
        )
    tree.components[path] = (source, int(substeps), INTERFACES[implementation])
    _connectors(tree, element, path)
    _bind(tree, element, path)


def _connectors(tree: Tree, element: Any, path: ElementPath) -> None:
    for connector in element.findall("ssd:Connectors/ssd:Connector", NAMESPACES):
        node = Node(path, str(connector.get("name")))
        if node in tree.connectors:
            raise tree.error(f"the connector {str(node)!r} is there twice.")
        kind, unit = None, None
        for name in VALUE_TYPES:
            item = connector.find(f"ssc:{name}", NAMESPACES)
            if item is not None:
                kind, unit = name, item.get("unit") or None
        if kind == "Binary":
            raise tree.error(f"the connector {str(node)!r} is binary, which is not supported.")
        tree.connectors[node] = DeclaredConnector(str(connector.get("kind")), kind, unit)


def _annotation(element: Any) -> Any:
    found = element.find(f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling", NAMESPACES)
    return {} if found is None else found.attrib


def _connection(tree: Tree, element: Any, path: ElementPath, children: set[str]) -> None:
    ends: list[Node] = []
    gives: list[bool] = []
    for side in ("start", "end"):
        owner = element.get(f"{side}Element")
        connector = str(element.get(f"{side}Connector"))
        if owner and owner not in children:
            raise tree.error(f"a connection names the element {owner!r}, which its system does not have.")
        node = Node((*path, owner) if owner else path, connector)
        declared = tree.connectors.get(node)
        if declared is None:
            raise tree.error(f"a connection names the connector {str(node)!r}, which is not declared.")
        ends.append(node)
        # Seen from inside, an input of the system is where values come from.
        gives.append((declared.kind in INWARD) == (not owner))
    if gives[0] == gives[1]:
        raise tree.error(
            f"a connection joins {str(ends[0])!r} and {str(ends[1])!r}, which both "
            f"{'give' if gives[0] else 'take'} a value; connect what gives one to what takes one."
        )
    # The kinds of the connectors say which way a value goes; "start" and "end" do not (SSP 1.0, section 5.3).
    source, target = ends if gives[0] else reversed(ends)
    if target in tree.edges:
        raise tree.error(
            f"{str(target)!r} has two sources, {str(tree.edges[target].source)!r} and {str(source)!r}; keep "
            "one of the two connections."
        )
    factor, offset = read_transformation(element, f"the connection from {source} to {target}")
    convert = not flag(element, "suppressUnitConversion")
    delayed = _annotation(element).get("delayed") == "true"
    tree.edges[target] = Edge(source, factor, offset, convert, delayed)


def _bind(tree: Tree, element: Any, path: ElementPath) -> None:
    """Take the parameter bindings of an element; they go before those of the elements inside it."""
    where = f"the element {'.'.join(path) or str(element.get('name'))!r}"
    for name, setting in read_bindings(element, tree.package, where).items():
        nodes = _nodes_of(tree, name, path)
        tree.settings |= dict.fromkeys(nodes, setting)
        tree.package.unused += [] if nodes else [str(Node(path, name))]


def _nodes_of(tree: Tree, name: str, path: ElementPath) -> list[Node]:
    """Return the connectors of systems, and the variables that components may have, of a parameter's name."""
    found = []
    for place in dict.fromkeys((*tree.components, *(node.path for node in tree.connectors))):
        before = "".join(f"{step}." for step in place[len(path) :])
        node = Node(place, name.removeprefix(before))
        known = place in tree.components or node in tree.connectors
        if known and place[: len(path)] == path and name.startswith(before):
            found.append(node)
    return found


def _names(tree: Tree) -> dict[ElementPath, str]:
    names = {path: ".".join(path) for path in tree.components}
    for path, name in names.items():
        if list(names.values()).count(name) > 1:
            raise tree.error(f"two components are named {name!r} ({path}); rename one of them.")
    return names


def _extract(tree: Tree, folder: Path) -> dict[str, Path]:
    """Write each FMU once, under its name in the archive; return the files by these names."""
    files = {source: folder / source for source, *_ in tree.components.values()}
    for source, target in files.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        atomic_write_bytes(target, tree.package.read(source))
    return files
