"""Reading an SSP file: nested systems flattened, parameters and mappings applied, FMUs taken out.

SSP 1.0 allows more than is read here. The following is refused with a sentence: signal
dictionaries, components that are systems of their own files, mappings of Booleans, integers and
enumerations, texts that are not parameters, and binary values. The same is read of SSP 2.0; see
`package`.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from functools import reduce
from math import isfinite
from pathlib import Path
from typing import NamedTuple

from lxml import etree
from lxml.etree import _Element as XmlElement

from fmu_asset.archive.declared import UnitInfo
from fmu_asset.coupling.structure import (
    CONNECTOR_KINDS,
    Component,
    ComponentSetting,
    Connection,
    Connector,
    Endpoint,
    SettingValue,
    SystemStructure,
)
from fmu_asset.coupling.wiring import two_sources_sentence
from fmu_asset.door.units import IDENTITY, Conversion
from fmu_asset.errors import SspError
from reporting.files import atomic_write_bytes
from reporting.units import BASE_UNITS

from .package import INTERFACES, NAMESPACES, OWN_NAMESPACE, SSD_NAME, SspPackage

_INWARD_KINDS = ("input", "parameter")
"""Kinds of connectors through which values come in; inside a system, values start from them."""


class _RequiredAttribute(NamedTuple):
    """An attribute of which one value is supported, and what a message says of the others."""

    name: str
    value: str
    reason: str


_NO_SOURCE_BASE = _RequiredAttribute(
    "sourceBase", "SSD", "it lies inside a component, which is not supported; move it out"
)
_REQUIRED_ATTRIBUTES = {
    "Component": [
        _RequiredAttribute("type", "application/x-fmu-sharedlibrary", "only FMUs are supported")
    ],
    "ParameterBinding": [
        _RequiredAttribute(
            "type", "application/x-ssp-parameter-set", "only parameter sets are read"
        ),
        _NO_SOURCE_BASE,
    ],
    "ParameterMapping": [
        _RequiredAttribute(
            "type", "application/x-ssp-parameter-mapping", "only parameter mappings are read"
        ),
        _NO_SOURCE_BASE,
    ],
}
"""The required attributes by element."""


def read_ssp(path: str | os.PathLike[str], folder: str | os.PathLike[str]) -> SystemStructure:
    """Read an SSP file, and write the FMUs in it to a folder.

    Parameters
    ----------
    path : path-like
        The file.
    folder : path-like
        The folder for its FMUs; made if it is missing.

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
        units=_unit_definitions(root, "ssd"),
        declared=component_connectors,
        span=(_time(experiment, "startTime"), _time(experiment, "stopTime")),
        base_step=_base_step(root, str(package.path)),
        unused=tuple(reader.unused),
    )


def _extracted_component(
    name: str, component: Component, reader: "_SystemReader", folder: Path
) -> Component:
    """Return a component with its FMU, which is written to a folder, and its settings.

    Components of one FMU share the file, which has the name that it has in the archive.
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


def _time(experiment: XmlElement | None, attribute: str) -> float | None:
    """Return a time of the default experiment [s]; None if it is not declared."""
    if experiment is None or attribute not in experiment.attrib:
        return None
    return float(experiment.attrib[attribute])


_STEP_ATTRIBUTES = {"FixedStepAlgorithm": "baseStepSize", "FixedStepMaster": "stepSize"}
"""Annotations by which other tools declare the step of a system [s]: OSP and OMSimulator."""


def _base_step(root: XmlElement, path: str) -> float | None:
    """Return the step that annotations declare for the outermost system [s]; None if none does.

    Parameters
    ----------
    root : XmlElement
        The system structure.
    path : str
        The SSP file, for the message.

    Raises
    ------
    SspError
        If the step is not a positive number.
    """
    experiment = root.find("ssd:DefaultExperiment", NAMESPACES)
    system = root.find("ssd:System", NAMESPACES)
    for owner in (experiment, system, root):
        annotations = None if owner is None else owner.find("ssd:Annotations", NAMESPACES)
        if annotations is None:
            continue
        for element in annotations.iter(etree.Element):
            attribute = _STEP_ATTRIBUTES.get(etree.QName(element).localname)
            if attribute is not None and attribute in element.attrib:
                return _positive_step(str(element.get(attribute)), attribute, path)
    return None


def _positive_step(text: str, attribute: str, path: str) -> float:
    """Return a step size [s] that an attribute declares."""
    try:
        step = float(text)
    except ValueError:
        step = 0.0
    if not (isfinite(step) and step > 0.0):
        raise SspError(
            f"{SSD_NAME} in {path}: {attribute} must be a positive number of seconds, and {text!r} "
            "came."
        )
    return step


class _SystemReader:
    """Reads the nested systems of a system structure, and makes them one flat system.

    An element is known by its path: the names that lead to it from the outermost system, with dots
    between. The path of the outermost system is empty. A connector is an `Endpoint` of its element.

    Parameters
    ----------
    package : SspPackage
        The SSP file.
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
        The names of parameters that nothing takes.
    """

    def __init__(self, package: SspPackage, system: XmlElement) -> None:
        self.package = package
        self.components: dict[str, Component] = {}
        self.connectors: dict[Endpoint, Connector] = {}
        self.settings: dict[Endpoint, ComponentSetting] = {}
        self.unused: list[str] = []
        self._element_paths = {""}
        self._connection_to: dict[Endpoint, Connection] = {}
        self._read_system(system, "")

    def _error(self, sentence: str) -> SspError:
        """Return the error for a fault of the system structure."""
        return SspError(f"{SSD_NAME} in {self.package.path}: {sentence}")

    def _check_required_attributes(self, element: XmlElement, label: str) -> None:
        """Refuse an element with attributes that have values which are not supported."""
        for attribute in _REQUIRED_ATTRIBUTES[etree.QName(element).localname]:
            value = element.get(attribute.name, attribute.value)
            if value != attribute.value:
                raise self._error(
                    f"{label} has the {attribute.name} {value!r}: {attribute.reason}."
                )

    # ------------------------------------------------------------------ elements and connections

    def _read_system(self, system: XmlElement, path: str) -> None:
        """Read a system and everything in it."""
        self._read_connectors(system, path)
        for element in system.iterfind("ssd:Elements/*", NAMESPACES):
            element_path = _joined_path(path, str(element.get("name")))
            if element_path in self._element_paths:
                raise self._error(
                    f"there are two elements named {element_path!r}; each needs a name of its own."
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
        self._check_required_attributes(element, label)
        source = self.package.resolve(str(element.get("source")), label)
        substeps = _coupling_attributes(element).get("substeps", "1")
        is_whole_number = substeps.isascii() and substeps.isdigit()
        if not is_whole_number or int(substeps) == 0:
            raise self._error(
                f"{label} has the number of steps {substeps!r}, which must be a positive whole "
                "number."
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
                raise self._error(f"the connector {str(end)!r} is there twice.")
            kind = connector.get("kind")
            if not path and kind not in CONNECTOR_KINDS:
                raise self._error(
                    f"the connector {end.variable!r} of the system is of the kind {kind}, not "
                    "supported."
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

        The kinds of the connectors say which way a value goes; "start" and "end" do not (SSP 1.0,
        5.3).
        """
        start = self._connection_end(element, "start", path)
        end = self._connection_end(element, "end", path)
        start_gives = self._gives_values(start, path)
        if start_gives == self._gives_values(end, path):
            verb = "give" if start_gives else "take"
            raise self._error(
                f"a connection joins {str(start)!r} and {str(end)!r}, which both {verb} a value; "
                "connect what gives one to what takes one."
            )
        source, target = (start, end) if start_gives else (end, start)
        if target in self._connection_to:
            first_source = self._connection_to[target].source
            raise self._error(
                two_sources_sentence(repr(str(target)), repr(str(first_source)), repr(str(source)))
            )
        scale = self._transformation(element, f"the connection from {source} to {target}")
        self._connection_to[target] = Connection(
            source=source,
            target=target,
            factor=scale.factor,
            offset=scale.offset,
            convert_units=not _flag(element, "suppressUnitConversion"),
            delayed=_flag(_coupling_attributes(element), "delayed"),
        )

    def _connection_end(self, element: XmlElement, side: str, path: str) -> Endpoint:
        """Return an end of a connection, which must be a connector that is declared.

        Parameters
        ----------
        element : XmlElement
            The connection.
        side : {"start", "end"}
            The side of the connection.
        path : str
            The path of the system that the connection is in.
        """
        owner = element.get(f"{side}Element") or ""
        end = Endpoint(_joined_path(path, owner), str(element.get(f"{side}Connector")))
        if end.component not in self._element_paths:
            raise self._error(
                f"a connection names the element {owner!r}, which its system does not have."
            )
        if end not in self.connectors:
            raise self._error(
                f"a connection names the connector {str(end)!r}, which is not declared."
            )
        return end

    def _gives_values(self, end: Endpoint, path: str) -> bool:
        """Return whether a connector is a source of values in the system with this path.

        A connector of the system itself is seen from inside, where its inputs give values.
        """
        is_of_system = end.component == path
        is_inward = self.connectors[end].kind in _INWARD_KINDS
        return is_inward if is_of_system else not is_inward

    def _transformation(self, element: XmlElement, label: str) -> Conversion:
        """Return the linear transformation of a connection or mapping entry."""
        linear = element.find("ssc:LinearTransformation", NAMESPACES)
        if linear is None:
            return IDENTITY
        factor = self._finite(linear.get("factor", "1"), f"the factor of {label}")
        offset = self._finite(linear.get("offset", "0"), f"the offset of {label}")
        return Conversion(factor, offset)

    def _finite(self, text: str, label: str) -> float:
        """Return a number; the schemas allow NaN and INF, which are refused."""
        value = float(text)
        if not isfinite(value):
            raise self._error(f"{label} must be a finite number, and {text} came.")
        return value

    # ------------------------------------------------------------------ parameters

    def _read_parameter_bindings(self, element: XmlElement, path: str) -> None:
        """Read the parameter bindings of an element; they replace those of its elements."""
        label = f"a parameter binding of the element {path or str(element.get('name'))!r}"
        values: dict[str, ComponentSetting] = {}
        unmapped_names: list[str] = []
        for binding in element.iterfind("ssd:ParameterBindings/ssd:ParameterBinding", NAMESPACES):
            values_of_set = self._parameter_set(binding, label)
            mapping = binding.find("ssd:ParameterMapping", NAMESPACES)
            # An empty mapping maps nothing and changes nothing.
            if mapping is not None and (mapping.get("source") or len(mapping)):
                values_of_set = self._mapped_values(values_of_set, mapping, label, unmapped_names)
            values |= values_of_set
        self.unused += [name for name in unmapped_names if name not in values]
        for name, setting in values.items():
            self._set(name, setting, path)

    def _set(self, name: str, setting: ComponentSetting, path: str) -> None:
        """Give a value to everything that the name of a parameter can mean.

        Parameters
        ----------
        name : str
            The name, in which an element may stand before one of the dots.
        setting : ComponentSetting
            The value.
        path : str
            The path of the element whose binding gives it.
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
                    raise self._error(f"{str(end)!r} is set, but it is of the kind {kind}.")
                ends.append(end)
        for end in ends:
            self.settings[end] = setting
        if not ends:
            self.unused.append(str(Endpoint(path, name)))

    def _parameter_document(
        self, element: XmlElement, inline: str, kind: str, label: str
    ) -> XmlElement:
        """Return the parameter set or mapping that an element refers to or contains.

        Parameters
        ----------
        element : XmlElement
            The parameter binding or mapping.
        inline : str
            The path of the document inside the element, where it is not in a file of its own.
        kind : {"ssv", "ssm"}
            The kind of document.
        label : str
            The name of the element in messages.
        """
        self._check_required_attributes(element, label)
        source = element.get("source")
        if source:
            return self.package.parse(kind, self.package.resolve(source, label))
        root = element.find(inline, NAMESPACES)
        if root is None:
            raise self._error(f"{label} has neither a source nor content.")
        return self.package.parse(kind, label, etree.tostring(root))

    def _parameter_set(self, binding: XmlElement, label: str) -> dict[str, ComponentSetting]:
        """Return the values of a parameter set by name, with the prefix of its binding."""
        root = self._parameter_document(
            binding, "ssd:ParameterValues/ssv:ParameterSet", "ssv", label
        )
        units = _unit_definitions(root, "ssv")
        prefix = binding.get("prefix", "")
        values: dict[str, ComponentSetting] = {}
        for parameter in root.iterfind("ssv:Parameters/ssv:Parameter", NAMESPACES):
            name = prefix + parameter.get("name")
            if name in values:
                raise self._error(f"{label} gives {name!r} twice; keep one of the two.")
            type_element = parameter.find("*")  # the schema puts it first
            value = self._parameter_value(type_element, f"the value of {name!r} of {label}")
            values[name] = ComponentSetting(value, type_element.get("unit"), units=units)
        return values

    def _parameter_value(self, type_element: XmlElement, label: str) -> SettingValue:
        """Return the value of a parameter in a parameter set, by its type."""
        kind = etree.QName(type_element).localname
        text: str = type_element.get("value")
        if kind == "Real":
            return self._finite(text, label)
        if kind == "Integer":
            return int(text)
        if kind == "Boolean":
            return _flag(type_element, "value")
        if kind == "Binary":
            return bytes.fromhex(text)
        return text

    def _mapped_values(
        self,
        values: dict[str, ComponentSetting],
        mapping: XmlElement,
        binding_label: str,
        unmapped_names: list[str],
    ) -> dict[str, ComponentSetting]:
        """Return the values of a parameter set by the names that a mapping gives them.

        Values that the mapping does not name are not used.

        Parameters
        ----------
        values : dict of str to ComponentSetting
            The values of the parameter set.
        mapping : XmlElement
            The parameter mapping.
        binding_label : str
            The name of the parameter binding in messages.
        unmapped_names : list of str
            The names that the mapping gives to values which the set does not have are added to it:
            one mapping may serve several sets.
        """
        label = f"the mapping of {binding_label}"
        root = self._parameter_document(mapping, "ssm:ParameterMapping", "ssm", label)
        mapped: dict[str, ComponentSetting] = {}
        for entry in root.iterfind("ssm:MappingEntry", NAMESPACES):
            source, target = entry.get("source"), entry.get("target")
            scale = self._transformation(entry, f"{source!r} in {label}")
            if source not in values:
                unmapped_names.append(target)
                continue
            if target in mapped:
                raise self._error(
                    f"{label} maps two parameters to {target!r}; keep one of the two."
                )
            setting = values[source]
            if scale != IDENTITY:
                if isinstance(setting.value, bool | str | bytes):
                    raise self._error(f"{label} scales {source!r}, which is no number.")
                setting = replace(setting, scale=scale)
            if _flag(entry, "suppressUnitConversion"):
                setting = replace(setting, unit=None)
            mapped[target] = setting
        return mapped

    # ------------------------------------------------------------------ flat connections

    def _is_flat_end(self, end: Endpoint) -> bool:
        """Return whether an end belongs to a component or to the outermost system."""
        return end.component in self.components or end.component == ""

    def flat_connections(self) -> Iterator[Connection]:
        """Yield the connections between components, and between them and the outermost connectors.

        A value that is set at a connector on the way becomes the value of the target.

        Raises
        ------
        SspError
            If connections go round in a circle of systems, or are transformed where units or values
            forbid it.
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
        """Return the connections that lead to an end through nested systems, in their order."""
        chain = [self._connection_to[target]]
        while not self._is_flat_end(chain[0].source) and chain[0].source in self._connection_to:
            chain.insert(0, self._connection_to[chain[0].source])
            if len(chain) > len(self._connection_to) + 1:
                raise self._error(
                    f"the connections to {str(target)!r} go round in a circle of systems."
                )
        return chain

    def _set_from_chain(self, target: Endpoint, chain: list[Connection]) -> None:
        """Give an end the value that is set at a connector on the way to it.

        Of several such connectors the outermost one counts.
        """
        for index, connection in enumerate(chain):
            connector = connection.source
            if connector.component in self.components or connector not in self.settings:
                continue
            for later in chain[index:]:
                if later.scale != IDENTITY or not later.convert_units:
                    raise self._error(
                        f"{str(connector)!r} is set and transformed on its way to {str(target)!r}; "
                        "set that instead."
                    )
            self.settings[target] = self.settings[connector]
            return

    def _joined(self, chain: list[Connection]) -> Connection:
        """Return one connection for those that follow one another through nested systems."""
        source, target = chain[0].source, chain[-1].target
        scale = reduce(Conversion.then, (connection.scale for connection in chain))
        has_units_on_the_way = any(self.connectors[later.source].unit for later in chain[1:])
        all_convert = all(connection.convert_units for connection in chain)
        some_convert = any(connection.convert_units for connection in chain)
        if all_convert != some_convert or (scale != IDENTITY and has_units_on_the_way):
            raise self._error(
                f"the connection to {str(target)!r} through a nested system is transformed between "
                "connectors with units of their own, which is not supported; leave out the units "
                "of the nested system's connectors."
            )
        return Connection(
            source=source,
            target=target,
            factor=scale.factor,
            offset=scale.offset,
            convert_units=all_convert,
            delayed=any(connection.delayed for connection in chain),
        )


def _unit_definitions(root: XmlElement, kind: str) -> tuple[UnitInfo, ...]:
    """Return the unit definitions of a document of a kind: "ssd" or "ssv"."""
    units = []
    for element in root.iterfind(f"{kind}:Units/ssc:Unit", NAMESPACES):
        base = element.find("ssc:BaseUnit", NAMESPACES)
        unit = UnitInfo(
            name=element.get("name"),
            exponents=tuple(int(base.get(symbol, "0")) for symbol in BASE_UNITS),
            factor=float(base.get("factor", "1")),
            offset=float(base.get("offset", "0")),
        )
        units.append(unit)
    return tuple(units)


def _joined_path(*names: str) -> str:
    """Return the path of an element from the names that lead to it; empty names are left out."""
    return ".".join(name for name in names if name)


def _flag(attributes: XmlElement | dict[str, str], name: str) -> bool:
    """Return a Boolean attribute; false if it is absent."""
    return str(attributes.get(name, "false")).strip() in ("true", "1")


def _coupling_attributes(element: XmlElement) -> dict[str, str]:
    """Return the attributes of our annotation of a component or connection, if any."""
    path = f"ssd:Annotations/ssc:Annotation/{{{OWN_NAMESPACE}}}Coupling"
    annotation = element.find(path, NAMESPACES)
    return {} if annotation is None else dict(annotation.attrib)
