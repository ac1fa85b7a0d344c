"""Reads an SSP file: flattens nested systems, applies parameters and mappings, extracts FMUs.

SSP 1.0 allows more than is read here. The following is refused: signal dictionaries, components
that are systems in files of their own, mappings of Booleans, integers and enumerations, texts that
are not parameters, and binary values. The same is read of SSP 2.0; see `package`.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from pathlib import Path

from lxml import etree
from lxml.etree import _Element as XmlElement

from fmu_asset.client.units import IDENTITY, Conversion
from fmu_asset.coupling.structure import (
    CONNECTOR_KINDS,
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SystemStructure,
    two_sources_sentence,
)
from reporting.files import atomic_write_bytes

from .experiment import base_step_of, time_of
from .package import INTERFACES, NAMESPACES, SSD_NAME, SspPackage
from .parameters import ParameterReader, coupling_attributes, flag, package_error, unit_definitions

_INWARD_KINDS = ("input", "parameter")
"""Kinds of connectors through which values come in; inside a system, values start from them."""


def read_ssp(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> SystemStructure:
    """Read an SSP file, and extract its FMUs to a folder.

    Parameters
    ----------
    folder : path-like
        The folder for the FMUs; made if it is missing.

    Returns
    -------
    SystemStructure
        The system without nesting; a component of a nested system is named `system.component`.
        Whether it fits its FMUs is checked later, by `check.join_ssp`.

    Raises
    ------
    SspError
        If the file is missing, damaged, unsafe or not valid by the schema, or uses what is not
        supported.
    """
    package = SspPackage(path)
    root = package.parse("ssd", SSD_NAME)
    reader = _SystemReader(package, root.find("ssd:System", NAMESPACES))
    connections = tuple(reader.flat_connections())
    components = []
    for name, component in reader.components.items():
        components.append(_extracted_component(name, component, reader, Path(folder)))
    system_connectors = []
    component_connectors = {}
    for end, connector in reader.connectors.items():
        if not end.component:
            system_connectors.append(connector)
        elif end.component in reader.components:
            component_connectors[end] = connector
    experiment = root.find("ssd:DefaultExperiment", NAMESPACES)
    return SystemStructure(
        name=str(root.get("name")),
        components=tuple(components),
        connectors=tuple(system_connectors),
        connections=connections,
        units=unit_definitions(root, "ssd"),
        declared=component_connectors,
        span=(time_of(experiment, "startTime"), time_of(experiment, "stopTime")),
        base_step=base_step_of(root, str(package.path)),
        unused=tuple(reader.unused),
    )


def _extracted_component(
    name: str, component: Component, reader: "_SystemReader", folder: Path
) -> Component:
    """Return a component with its settings and its FMU, which is extracted to a folder.

    Components of one FMU share the file, which keeps its name from the archive.
    """
    package = reader.package
    file = folder / component.fmu
    atomic_write_bytes(file, package.read(str(component.fmu)))
    settings = {}
    for end, setting in reader.settings.items():
        if end.component == name:
            settings[end.variable] = setting
    shown_as = f"{component.fmu} in {package.path}"
    return replace(component, fmu=file, settings=settings, shown_as=shown_as)


class _SystemReader:
    """Reads the nested systems of an SSP file as one flat system.

    An element is known by its path: the names that lead to it from the outermost system, with dots
    between. The path of the outermost system is empty. A connector is an `Endpoint` of its element.

    Parameters
    ----------
    system : XmlElement
        The outermost system.

    Attributes
    ----------
    components : dict of str to Component
        The components by path; `fmu` is the name in the archive.
    connectors : dict of Endpoint to Connector
        The connectors of all elements.
    settings : dict of Endpoint to ComponentSetting
        The values that parameter bindings give to parameters and connectors.
    unused : list of str
        The names of parameters that no element has.
    """

    def __init__(self, package: SspPackage, system: XmlElement) -> None:
        self.package = package
        self.components: dict[str, Component] = {}
        self.connectors: dict[Endpoint, Connector] = {}
        self.settings: dict[Endpoint, ComponentSetting] = {}
        self.unused: list[str] = []
        self._element_paths = {""}
        self._connection_to: dict[Endpoint, Connection] = {}
        self._parameters = ParameterReader(package)
        self._read_system(system, "")

    # ------------------------------------------------------------------ elements and connections

    def _read_system(self, system: XmlElement, path: str) -> None:
        """Read a system of the file, and everything in it, from its element at a path of names."""
        self._read_connectors(system, path)
        for element in system.iterfind("ssd:Elements/*", NAMESPACES):
            element_path = _joined_path(path, str(element.get("name")))
            if element_path in self._element_paths:
                raise package_error(
                    self.package,
                    f"there are two elements named {element_path!r}; each needs a name of its own.",
                )
            self._element_paths.add(element_path)
            if etree.QName(element).localname == "System":
                self._read_system(element, element_path)
            else:
                self._read_component(element, element_path)
        for connection in system.iterfind("ssd:Connections/ssd:Connection", NAMESPACES):
            self._read_connection(connection, path)
        # After the elements in it: bindings of a system replace those of its elements.
        self._read_parameter_bindings(system, path)

    def _read_component(self, element: XmlElement, path: str) -> None:
        """Read a component: its FMU, its number of steps, connectors and parameters."""
        label = f"the component {path!r}"
        self._parameters.check_required_attributes(element, label)
        source = self.package.resolve(str(element.get("source")), label)
        substeps = coupling_attributes(element).get("substeps", "1")
        is_whole_number = substeps.isascii() and substeps.isdigit()
        if not is_whole_number or int(substeps) == 0:
            raise package_error(
                self.package,
                f"{label} has the number of steps {substeps!r}, which must be a positive whole "
                "number.",
            )
        self.components[path] = Component(
            name=path,
            fmu=Path(source),
            substeps=int(substeps),
            interface=INTERFACES[element.get("implementation", "any")],
        )
        self._read_connectors(element, path)
        self._read_parameter_bindings(element, path)

    def _read_connectors(self, element: XmlElement, path: str) -> None:
        """Read the connectors of a system or component."""
        for connector in element.iterfind("ssd:Connectors/ssd:Connector", NAMESPACES):
            end = Endpoint(path, str(connector.get("name")))
            if end in self.connectors:
                raise package_error(self.package, f"the connector {str(end)!r} is there twice.")
            kind = connector.get("kind")
            if not path and kind not in CONNECTOR_KINDS:
                raise package_error(
                    self.package,
                    f"the connector {end.variable!r} of the system is of the kind {kind}, "
                    "which is not supported.",
                )
            type_element = connector.find("ssc:*", NAMESPACES)
            if type_element is None:
                self.connectors[end] = Connector(end.variable, kind)
            else:
                unit = type_element.get("unit") or None
                type_name = etree.QName(type_element).localname
                self.connectors[end] = Connector(end.variable, kind, unit, type_name)

    def _read_connection(self, element: XmlElement, path: str) -> None:
        """Read a connection of a system.

        The direction follows from the kinds of the connectors, not from "start" and "end" (SSP 1.0,
        5.3).
        """
        start = self._connection_end(element, "start", path)
        end = self._connection_end(element, "end", path)
        start_gives = self._gives_values(start, path)
        if start_gives == self._gives_values(end, path):
            verb = "give" if start_gives else "take"
            raise package_error(
                self.package,
                f"a connection joins {str(start)!r} and {str(end)!r}, which both {verb} a value; "
                "connect what gives one to what takes one.",
            )
        source, target = (start, end) if start_gives else (end, start)
        if target in self._connection_to:
            first_source = self._connection_to[target].source
            raise package_error(
                self.package,
                two_sources_sentence(repr(str(target)), repr(str(first_source)), repr(str(source))),
            )
        scale = self._parameters.transformation(
            element, f"the connection from {source} to {target}"
        )
        self._connection_to[target] = Connection(
            source=source,
            target=target,
            factor=scale.factor,
            offset=scale.offset,
            convert_units=not flag(element, "suppressUnitConversion"),
            delayed=flag(coupling_attributes(element), "delayed"),
        )

    def _connection_end(self, element: XmlElement, side: str, path: str) -> Endpoint:
        """Return the "start" or "end" of a connection, which must be a declared connector."""
        owner = element.get(f"{side}Element") or ""
        end = Endpoint(_joined_path(path, owner), str(element.get(f"{side}Connector")))
        if end.component not in self._element_paths:
            raise package_error(
                self.package,
                f"a connection names the element {owner!r}, which its system does not have.",
            )
        if end not in self.connectors:
            raise package_error(
                self.package,
                f"a connection names the connector {str(end)!r}, which is not declared.",
            )
        return end

    def _gives_values(self, end: Endpoint, path: str) -> bool:
        """Return whether a connector is a source of values in the system with this path.

        A connector of the system itself is seen from inside, where its inputs are sources.
        """
        is_of_system = end.component == path
        is_inward = self.connectors[end].kind in _INWARD_KINDS
        return is_inward if is_of_system else not is_inward

    # ------------------------------------------------------------------ parameters

    def _read_parameter_bindings(self, element: XmlElement, path: str) -> None:
        """Read the parameter bindings of an element, which override those of elements inside it."""
        label = f"a parameter binding of the element {path or str(element.get('name'))!r}"
        values: dict[str, ComponentSetting] = {}
        unmapped_names: list[str] = []
        for binding in element.iterfind("ssd:ParameterBindings/ssd:ParameterBinding", NAMESPACES):
            values_of_set = self._parameters.parameter_set(binding, label)
            mapping = binding.find("ssd:ParameterMapping", NAMESPACES)
            # An empty mapping maps nothing and changes nothing.
            if mapping is not None and (mapping.get("source") or len(mapping)):
                values_of_set = self._parameters.mapped_values(
                    values_of_set, mapping, label, unmapped_names
                )
            values |= values_of_set
        self.unused += [name for name in unmapped_names if name not in values]
        for name, setting in values.items():
            self._set(name, setting, path)

    def _set(self, name: str, setting: ComponentSetting, path: str) -> None:
        """Set every parameter or connector that a name can mean in the element at a path.

        A dot in the name may end the path of an inner element: `a.b.c` may be `c` in `a.b`.
        """
        candidates = [Endpoint(path, name)]
        for position, letter in enumerate(name):
            if letter == ".":
                element_path = _joined_path(path, name[:position])
                candidates.append(Endpoint(element_path, name[position + 1 :]))
        ends = []
        for end in candidates:
            if end.component in self.components:
                ends.append(end)
            elif end in self.connectors:
                kind = self.connectors[end].kind
                if kind not in _INWARD_KINDS:
                    raise package_error(
                        self.package, f"{str(end)!r} is set, but it is of the kind {kind}."
                    )
                ends.append(end)
        for end in ends:
            self.settings[end] = setting
        if not ends:
            self.unused.append(str(Endpoint(path, name)))

    # ------------------------------------------------------------------ flat connections

    def _is_flat_end(self, end: Endpoint) -> bool:
        """Return whether an end belongs to a component or to the outermost system."""
        return end.component in self.components or end.component == ""

    def flat_connections(self) -> Iterator[Connection]:
        """Yield the connections between components, and those with the system's own connectors.

        A value that is set at a connector on the way becomes the value of the target.

        Raises
        ------
        SspError
            If connections form a cycle of systems, or are transformed where units or values forbid
            it.
        """
        for target in self._connection_to:
            if not self._is_flat_end(target):
                continue
            chain = self._chain_to(target)
            self._set_from_chain(target, chain)
            # Otherwise nothing leads to a connector of a nested system.
            if self._is_flat_end(chain[0].source):
                yield self._joined(chain)

    def _chain_to(self, target: Endpoint) -> list[Connection]:
        """Return the connections that lead to an end through nested systems, in order."""
        chain = [self._connection_to[target]]
        while not self._is_flat_end(chain[0].source) and chain[0].source in self._connection_to:
            chain.insert(0, self._connection_to[chain[0].source])
            if len(chain) > len(self._connection_to) + 1:
                raise package_error(
                    self.package,
                    f"the connections to {str(target)!r} form a cycle of systems.",
                )
        return chain

    def _set_from_chain(self, target: Endpoint, chain: list[Connection]) -> None:
        """Set the end of a chain to the value that is set at a connector on its way.

        If several connectors on the way are set, the outermost one counts.
        """
        for index, connection in enumerate(chain):
            connector = connection.source
            if connector.component in self.components or connector not in self.settings:
                continue
            for later_connection in chain[index:]:
                if later_connection.scale != IDENTITY or not later_connection.convert_units:
                    raise package_error(
                        self.package,
                        f"{str(connector)!r} is set and transformed on its way to {str(target)!r}; "
                        "set the latter instead.",
                    )
            self.settings[target] = self.settings[connector]
            return

    def _joined(self, chain: list[Connection]) -> Connection:
        """Return one connection that replaces a chain of connections through nested systems."""
        source, target = chain[0].source, chain[-1].target
        scale = reduce(Conversion.then, (connection.scale for connection in chain))
        has_units_on_the_way = any(
            self.connectors[later_connection.source].unit for later_connection in chain[1:]
        )
        all_convert = all(connection.convert_units for connection in chain)
        some_convert = any(connection.convert_units for connection in chain)
        if all_convert != some_convert or (scale != IDENTITY and has_units_on_the_way):
            raise package_error(
                self.package,
                f"the connection to {str(target)!r} through a nested system is transformed between "
                "connectors with units of their own, which is not supported; leave out the units "
                "of the nested system's connectors.",
            )
        return Connection(
            source=source,
            target=target,
            factor=scale.factor,
            offset=scale.offset,
            convert_units=all_convert,
            delayed=any(connection.delayed for connection in chain),
        )


def _joined_path(*names: str) -> str:
    """Return the path of an element from the names that lead to it; skip empty names."""
    return ".".join(name for name in names if name)
