"""Reading an SSP file: nested systems flattened, parameters and mappings applied, FMUs taken out.

What SSP 1.0 allows and is not read is refused in a sentence: signal dictionaries, components that are systems
of their own files, mappings of Booleans, integers and enumerations, texts that are no
parameters, binary values.
Of SSP 2.0 the same is read; see `package`.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from math import isfinite
from pathlib import Path
from typing import Any

from lxml import etree

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.client.units import IDENTITY, Conversion
from fmu_asset.coupling.structure import (
    CONNECTOR_KINDS,
    Component,
    Connection,
    Connector,
    Endpoint,
    Setting,
    SystemStructure,
)
from fmu_asset.errors import SspError, said
from reporting.files import atomic_write_bytes
from reporting.units import BASE_UNITS

from .package import INTERFACES, NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage

_INWARD = ("input", "parameter")
"""Kinds of connectors through which values come in; inside a system, they are where values come from."""
_OUTSIDE = ("sourceBase", "SSD", "it lies inside a component, which is not supported; move it out")
_ONLY = {
    "Component": [("type", "application/x-fmu-sharedlibrary", "only FMUs are supported")],
    "ParameterBinding": [
        ("type", "application/x-ssp-parameter-set", "only parameter sets are read"), _OUTSIDE
    ],
    "ParameterMapping": [
        ("type", "application/x-ssp-parameter-mapping", "only parameter mappings are read"), _OUTSIDE
    ],
}  # fmt: skip
"""By element its attributes of which one value is read, and what is said of others."""


def read_ssp(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> SystemStructure:
    """Read an SSP file, and write the FMUs in it to a folder.

    Parameters
    ----------
    path : path-like
        The file.
    folder : path-like
        Where its FMUs are put; made if it is missing.

    Returns
    -------
    SystemStructure
        The system, flat; a component of a nested system is named `system.component`. Whether it fits its FMUs
        is checked where it is joined; see `check.join_ssp`.

    Raises
    ------
    SspError
        If the file is missing, damaged, unsafe or not valid by the schema, or uses what is not supported.
    """
    package = SspPackage(path)
    root = package.parse("ssd", SSD_NAME)
    tree = _Tree(package, root.find("ssd:System", NAMESPACES))
    connections = tuple(tree.flat_connections())
    components = []
    for name, component in tree.components.items():
        # Under its name in the archive, once for all components that are of it.
        file = Path(folder) / component.fmu
        atomic_write_bytes(file, package.read(str(component.fmu)))
        own = {node.variable: value for node, value in tree.settings.items() if node.component == name}
        shown_as = f"{component.fmu} in {package.path}"
        components.append(replace(component, fmu=file, settings=own, shown_as=shown_as))
    experiment = root.find("ssd:DefaultExperiment", NAMESPACES)
    told = {} if experiment is None else experiment.attrib
    start, stop = (float(told[name]) if name in told else None for name in ("startTime", "stopTime"))
    return SystemStructure(
        str(root.get("name")),
        tuple(components),
        tuple(connector for node, connector in tree.connectors.items() if not node.component),
        connections,
        _units(root, "ssd"),
        declared={node: own for node, own in tree.connectors.items() if node.component in tree.components},
        span=(start, stop),
        base_step=_base_step(root, str(package.path)),
        unused=tuple(tree.unused),
    )


_STEP_ATTRIBUTES = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}
"""Annotations by which others declare the step of a system [s]: Open Simulation Platform, OMSimulator."""


def _base_step(root: Any, where: str) -> float | None:
    """Return the step that annotations of the outermost system or the experiment declare [s], if any does.

    Raises
    ------
    SspError
        If it is no positive number.
    """
    experiment, system = (root.find(f"ssd:{name}", NAMESPACES) for name in ("DefaultExperiment", "System"))
    for owner in (experiment, system, root):
        annotations = None if owner is None else owner.find("ssd:Annotations", NAMESPACES)
        for element in () if annotations is None else annotations.iter(etree.Element):
            attribute = _STEP_ATTRIBUTES.get(etree.QName(element).localname)
            if attribute is not None and attribute in element.attrib:
                return _positive_step(str(element.get(attribute)), attribute, where)
    return None


def _positive_step(text: str, attribute: str, where: str) -> float:
    try:
        step = float(text)
    except ValueError:
        step = 0.0
    if not (isfinite(step) and step > 0.0):
        raise SspError(
            f"{SSD_NAME} in {where}: {attribute} must be a positive number of seconds, and {text!r} came."
        )
    return step


class _Tree:
    """A system structure as it is written, and made flat: connections traced, values of connectors passed on.

    Elements go by the names that lead to them, with dots between, from the outermost system, whose own is
    empty; a connector is an end of one.
    """

    def __init__(self, package: SspPackage, system: Any) -> None:
        self.package = package
        self.components: dict[str, Component] = {}
        self.connectors: dict[Endpoint, Connector] = {}
        self.settings: dict[Endpoint, Setting] = {}
        self.unused: list[str] = []
        self._elements = {""}
        self._edges: dict[Endpoint, Connection] = {}
        self._read_system(system, "")

    def _error(self, sentence: str) -> SspError:
        """Return the error that says what is wrong with the system structure."""
        return SspError(f"{SSD_NAME} in {self.package.path}: {sentence}")

    def _refuse_other(self, element: Any, where: str) -> None:
        """Refuse attributes that have other values than those that are read."""
        for attribute, usual, instead in _ONLY[etree.QName(element).localname]:
            if (given := element.get(attribute, usual)) != usual:
                raise self._error(f"{where} has the {attribute} {given!r}: {instead}.")

    # ------------------------------------------------------------------ as it is written

    def _read_system(self, element: Any, path: str) -> None:
        self._read_connectors(element, path)
        for child in element.iterfind("ssd:Elements/*", NAMESPACES):
            own = _path(path, str(child.get("name")))
            if own in self._elements:
                raise self._error(f"there are two elements named {own!r}; each needs a name of its own.")
            self._elements.add(own)
            if etree.QName(child).localname == "System":
                self._read_system(child, own)
            else:
                self._read_component(child, own)
        for connection in element.iterfind("ssd:Connections/ssd:Connection", NAMESPACES):
            self._read_connection(connection, path)
        self._bind(element, path)  # after the elements in it: bindings of a system go before theirs

    def _read_component(self, element: Any, path: str) -> None:
        where = f"the component {path!r}"
        self._refuse_other(element, where)
        source = self.package.resolve(str(element.get("source")), where)
        substeps = _annotation(element).get("substeps", "1")
        if not (substeps.isascii() and substeps.isdigit() and int(substeps) > 0):
            raise self._error(said("ssp.steps", where=where, substeps=substeps))
        interface = INTERFACES[element.get("implementation", "any")]
        self.components[path] = Component(path, Path(source), substeps=int(substeps), interface=interface)
        self._read_connectors(element, path)
        self._bind(element, path)

    def _read_connectors(self, element: Any, path: str) -> None:
        for connector in element.iterfind("ssd:Connectors/ssd:Connector", NAMESPACES):
            node = Endpoint(path, str(connector.get("name")))
            if node in self.connectors:
                raise self._error(f"the connector {str(node)!r} is there twice.")
            kind, item = connector.get("kind"), connector.find("ssc:*", NAMESPACES)
            if not path and kind not in CONNECTOR_KINDS:
                raise self._error(said("ssp.connector", node=node, kind=kind))
            of_type = (
                (None, None) if item is None else (item.get("unit") or None, etree.QName(item).localname)
            )
            self.connectors[node] = Connector(node.variable, kind, *of_type)

    def _read_connection(self, element: Any, path: str) -> None:
        ends: list[Endpoint] = []
        gives: list[bool] = []
        for side in ("start", "end"):
            owner = element.get(f"{side}Element") or ""
            node = Endpoint(_path(path, owner), str(element.get(f"{side}Connector")))
            if node.component not in self._elements:
                raise self._error(said("ssp.element", owner=owner))
            declared = self.connectors.get(node)
            if declared is None:
                raise self._error(f"a connection names the connector {str(node)!r}, which is not declared.")
            ends.append(node)
            # Seen from inside, an input of the system is where values come from.
            gives.append((declared.kind in _INWARD) == (not owner))
        if gives[0] == gives[1]:
            both = [str(end) for end in ends]
            raise self._error(said("ssp.ends", both=both, do="give" if gives[0] else "take"))
        # The kinds of the connectors say which way a value goes; "start" and "end" do not (SSP 1.0, 5.3).
        source, target = ends if gives[0] else reversed(ends)
        if target in self._edges:
            to, *given = (repr(str(end)) for end in (target, self._edges[target].source, source))
            raise self._error(said("coupling.two_sources", target=to, given=given))
        scale = self._transformation(element, f"the connection from {source} to {target}")
        convert = not _flag(element, "suppressUnitConversion")
        delayed = _flag(_annotation(element), "delayed")
        self._edges[target] = Connection(source, target, *scale, convert, delayed)

    def _transformation(self, element: Any, where: str) -> Conversion:
        """Return the linear transformation of a connection or mapping entry."""
        linear = element.find("ssc:LinearTransformation", NAMESPACES)
        told = {"factor": "1", "offset": "0"} | dict({} if linear is None else linear.attrib)
        return Conversion(*(self._finite(told[name], f"the {name} of {where}") for name in told))

    def _finite(self, text: str, what: str) -> float:
        value = float(text)  # a number by its schema, in which NaN and INF are numbers
        if not isfinite(value):
            raise self._error(f"{what} must be a finite number, and {text} came.")
        return value

    # ------------------------------------------------------------------ parameters

    def _bind(self, element: Any, path: str) -> None:
        """Take the parameter bindings of an element; they go before those of the elements inside it."""
        where = f"a parameter binding of the element {path or str(element.get('name'))!r}"
        found: dict[str, Setting] = {}
        missed: list[str] = []
        for binding in element.iterfind("ssd:ParameterBindings/ssd:ParameterBinding", NAMESPACES):
            values = self._values(binding, where)
            mapping = binding.find("ssd:ParameterMapping", NAMESPACES)
            if mapping is not None and (mapping.get("source") or len(mapping)):  # an empty one maps nothing
                values = self._mapped(values, mapping, where, missed)
            found |= values
        self.unused += [name for name in missed if name not in found]
        for name, setting in found.items():
            # What stands before one of the dots may be the element.
            cuts = [-1, *(place for place, letter in enumerate(name) if letter == ".")]
            ends = [Endpoint(_path(path, name[: max(cut, 0)]), name[cut + 1 :]) for cut in cuts]
            nodes = [node for node in ends if node.component in self.components or node in self.connectors]
            for node in nodes:
                if node.component not in self.components and self.connectors[node].kind not in _INWARD:
                    kind = self.connectors[node].kind
                    raise self._error(f"{str(node)!r} is set, but it is of the kind {kind}.")
            self.settings |= dict.fromkeys(nodes, setting)
            self.unused += [] if nodes else [str(Endpoint(path, name))]

    def _content(self, element: Any, inline: str, kind: str, where: str) -> Any:
        """Return the set or mapping that an element refers to or holds."""
        self._refuse_other(element, where)
        if source := element.get("source"):
            return self.package.parse(kind, self.package.resolve(source, where))
        root = element.find(inline, NAMESPACES)
        if root is None:
            raise self._error(f"{where} has neither a source nor content.")
        return self.package.parse(kind, where, etree.tostring(root))

    def _values(self, element: Any, where: str) -> dict[str, Setting]:
        """Return the values of a parameter set under the names that it gives them."""
        root = self._content(element, "ssd:ParameterValues/ssv:ParameterSet", "ssv", where)
        units, found = _units(root, "ssv"), dict[str, Setting]()
        for parameter in root.iterfind("ssv:Parameters/ssv:Parameter", NAMESPACES):
            name = element.get("prefix", "") + parameter.get("name")
            if name in found:
                raise self._error(f"{where} gives {name!r} twice; keep one of the two.")
            item = parameter.find("*")  # by the schema, its type comes first
            kind, value = etree.QName(item).localname, item.get("value")
            if kind == "Real":
                value = self._finite(value, f"the value of {name!r} of {where}")
            elif kind in ("Integer", "Boolean"):
                value = int(value) if kind == "Integer" else _flag(item, "value")
            elif kind == "Binary":
                value = bytes.fromhex(value)
            found[name] = Setting(value, item.get("unit"), units=units)
        return found

    def _mapped(
        self, values: dict[str, Setting], element: Any, where: str, missed: list[str]
    ) -> dict[str, Setting]:
        """Return the values under the names that a mapping gives them; what it does not name is not used."""
        where = f"the mapping of {where}"
        root = self._content(element, "ssm:ParameterMapping", "ssm", where)
        found: dict[str, Setting] = {}
        for entry in root.iterfind("ssm:MappingEntry", NAMESPACES):
            source, target = entry.get("source"), entry.get("target")
            scale = self._transformation(entry, f"{source!r} in {where}")
            if source not in values:  # one mapping may serve several sets
                missed.append(target)
                continue
            if target in found:
                raise self._error(f"{where} maps two parameters to {target!r}; keep one of the two.")
            setting = values[source]
            if scale != IDENTITY:
                if isinstance(setting.value, bool | str | bytes):
                    raise self._error(f"{where} scales {source!r}, which is no number.")
                setting = replace(setting, scale=scale)
            suppressed = _flag(entry, "suppressUnitConversion")
            found[target] = replace(setting, unit=None if suppressed else setting.unit)
        return found

    # ------------------------------------------------------------------ flat

    def _is_end(self, node: Endpoint) -> bool:
        return node.component in self.components or node.component == ""

    def flat_connections(self) -> Iterator[Connection]:
        """Yield the connections between components, and between them and the outermost connectors.

        The value of a connector on the way becomes that of its target.

        Raises
        ------
        SspError
            If they go round in a circle of systems, or are transformed where units or values forbid it.
        """
        for target in filter(self._is_end, self._edges):
            edges = [self._edges[target]]
            while not self._is_end(edges[0].source) and edges[0].source in self._edges:
                edges.insert(0, self._edges[edges[0].source])
                if len(edges) > len(self._edges) + 1:
                    raise self._error(f"the connections to {str(target)!r} go round in a circle of systems.")
            # Of systems inside each other the outermost value counts.
            nodes = [edge.source for edge in edges if edge.source.component not in self.components]
            for node in (node for node in nodes if node in self.settings):
                rest = edges[[edge.source for edge in edges].index(node) :]
                if any((edge.scale, edge.convert_units) != (IDENTITY, True) for edge in rest):
                    raise self._error(said("ssp.on_the_way", node=str(node), target=str(target)))
                self.settings[target] = self.settings[node]
                break
            if self._is_end(edges[0].source):  # else nothing comes to a connector of a nested system
                yield self._joined(edges)

    def _joined(self, edges: list[Connection]) -> Connection:
        """Return one connection for those that follow one another through nested systems."""
        source, target = edges[0].source, edges[-1].target
        scale = reduce(Conversion.then, (edge.scale for edge in edges))
        with_units = any(self.connectors[edge.source].unit for edge in edges[1:])
        converted = {edge.convert_units for edge in edges}
        if len(converted) > 1 or (scale != IDENTITY and with_units):
            raise self._error(said("ssp.nested", target=str(target)))
        return Connection(source, target, *scale, converted == {True}, any(edge.delayed for edge in edges))


def _units(root: Any, kind: str) -> tuple[UnitInfo, ...]:
    """Return the unit definitions of a document of a kind: "ssd" or "ssv"."""
    found = []
    for unit in root.iterfind(f"{kind}:Units/ssc:Unit", NAMESPACES):
        base = unit.find("ssc:BaseUnit", NAMESPACES)
        exponents = tuple(int(base.get(symbol, "0")) for symbol in BASE_UNITS)
        factor, offset = float(base.get("factor", "1")), float(base.get("offset", "0"))
        found.append(UnitInfo(unit.get("name"), exponents, factor, offset))
    return tuple(found)


def _path(*names: str) -> str:
    """Return the names that lead to an element as one."""
    return ".".join(filter(None, names))


def _flag(element: Any, name: str) -> bool:
    """Return a Boolean attribute; false where it is absent."""
    return str(element.get(name, "false")).strip() in ("true", "1")


def _annotation(element: Any) -> Any:
    found = element.find(f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling", NAMESPACES)
    return {} if found is None else found.attrib
