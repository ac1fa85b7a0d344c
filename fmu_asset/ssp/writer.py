"""Writing a system of FMUs as an SSP file: SSD, SSV, SSM and the FMUs; equal systems give equal bytes."""

import dataclasses
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, register_namespace

from fmu_asset.archive.declared import BASE_UNITS, UnitInfo
from fmu_asset.coupling.structure import Component, Connection, Endpoint
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.description import number, xml_bytes
from fmu_asset.errors import SspError
from fmu_asset.packing.contents import archive_bytes, checked_target
from reporting.files import atomic_write_bytes

from .package import (
    FMU_TYPE,
    INTERFACES,
    MAPPING_TYPE,
    NAMESPACES,
    OWN_ANNOTATION,
    OWN_NAMESPACE,
    SET_TYPE,
    SSD_NAME,
    parse_xml,
    tag,
    validate,
)

SSV_NAME = "resources/parameters.ssv"
SSM_NAME = "resources/parameters.ssm"


_IMPLEMENTATIONS = {interface: name for name, interface in INTERFACES.items()}
_CONNECTOR_KINDS = ("input", "output", "parameter", "calculatedParameter")


def write_ssp(
    wiring: Wiring,
    path: str | os.PathLike[str],
    *,
    parameter_names: Mapping[Endpoint, str] | None = None,
    stop_time: float | None = None,
    replace: bool = False,
) -> Path:
    """Write a system as an SSP 1.0 file; see `ssp_bytes`.

    Raises
    ------
    SspError
        If the file exists, the suffix is wrong, or the system cannot be written.
    """
    target = checked_target(path, replace=replace, what="An SSP file", suffix=".ssp", error=SspError)
    content = ssp_bytes(wiring, parameter_names=parameter_names, stop_time=stop_time)
    return atomic_write_bytes(target, content)


def ssp_bytes(
    wiring: Wiring, *, parameter_names: Mapping[Endpoint, str] | None = None, stop_time: float | None = None
) -> bytes:
    """Return the archive, its XML checked by the published schemas.

    All parameters stand in one set (SSV), which a mapping (SSM) carries to the variables of the components.

    Parameters
    ----------
    wiring : Wiring
        The system.
    parameter_names : mapping of Endpoint to str, optional
        Names in the parameter set; `component.variable` where there is none.
    stop_time : float, optional
        End of the default experiment [s].
    """
    for kind, uri in NAMESPACES.items():
        register_namespace(kind, uri)
    register_namespace("uav", OWN_NAMESPACE)
    writer = _Writer(wiring, dict(parameter_names or {}))
    members = {}
    for name, root in (
        (SSD_NAME, writer.description(stop_time)),
        (SSV_NAME, writer.parameter_set()),
        (SSM_NAME, writer.mapping()),
    ):
        members[name] = xml_bytes(root)
        validate(parse_xml(members[name], name), name[-3:], name)
    for component in wiring.structure.components:
        members[_resource(component)] = component.fmu.read_bytes()
    return archive_bytes(members, SSD_NAME)


def _resource(component: Component) -> str:
    plain = component.name.replace(".", "_")
    if not plain.replace("_", "").replace("-", "").isalnum() or not plain.isascii():
        raise SspError(
            f"The component {component.name!r} needs a name of ASCII letters, digits, `_` and `-`."
        )
    return f"resources/{plain}.fmu"


def _root(name: str, /, **attributes: str) -> Element:
    return Element(
        tag(name), {"version": "1.0", **attributes, "generationTool": f"uav-twin {version('uav-twin')}"}
    )


def _add(parent: Element, name: str, /, **attributes: str | None) -> Element:
    """Add an element with those of its attributes that have a value."""
    given = {key: value for key, value in attributes.items() if value is not None}
    return SubElement(parent, tag(name), given)


def _annotate(element: Element, **attributes: str) -> None:
    annotation = _add(_add(element, "ssd:Annotations"), "ssc:Annotation", type=OWN_ANNOTATION)
    SubElement(annotation, f"{{{OWN_NAMESPACE}}}Coupling", attributes)


class _Writer:
    """The documents of one system."""

    def __init__(self, wiring: Wiring, names: Mapping[Endpoint, str]) -> None:
        self._wiring = wiring
        self._enumerations: dict[str, Mapping[str, int]] = {}
        ends = {
            Endpoint(component.name, name): setting
            for component in wiring.structure.components
            for name, setting in sorted(component.settings.items())
        }
        self._values = {end: wiring.number(end, setting) for end, setting in ends.items()}
        self._names = {end: names.get(end, str(end)) for end in ends}
        self._units = self._known_units()

    def _known_units(self) -> dict[str, UnitInfo]:
        """Return the units that can be written: with exponents, and meaning the same in all FMUs."""
        found: dict[str, set[UnitInfo]] = {}
        of_fmus = (unit for fmu in self._wiring.declared.values() for unit in fmu.units)
        for unit in (*self._wiring.structure.units, *of_fmus):
            if unit.exponents is not None:
                found.setdefault(unit.name, set()).add(dataclasses.replace(unit, displays=()))
        return {name: units.pop() for name, units in sorted(found.items()) if len(units) == 1}

    def _add_units(self, parent: Element, kind: str) -> None:
        holder = _add(parent, f"{kind}:Units") if self._units else parent
        for unit in self._units.values():
            base = {s: str(n) for s, n in zip(BASE_UNITS, unit.exponents or (), strict=True) if n}
            if (unit.factor, unit.offset) != (1.0, 0.0):
                base |= {"factor": number(unit.factor), "offset": number(unit.offset)}
            _add(_add(holder, "ssc:Unit", name=unit.name), "ssc:BaseUnit", **base)

    # ------------------------------------------------------------------ SSD

    def description(self, stop_time: float | None) -> Element:
        """Return the system structure."""
        structure = self._wiring.structure
        root = _root("ssd:SystemStructureDescription", name=structure.name)
        system = _add(root, "ssd:System", name="system")
        holder = _add(system, "ssd:Connectors") if structure.connectors else system
        for connector in structure.connectors:
            element = _add(holder, "ssd:Connector", name=connector.name, kind=connector.kind)
            there = self._wiring.outward.get(connector.name)
            behind = [there] if there else self._wiring.inward.get(connector.name)
            if behind:
                self._add_type(element, behind[0].end, self._wiring.units[connector.name])
        bindings = _add(system, "ssd:ParameterBindings")
        binding = _add(bindings, "ssd:ParameterBinding", type=SET_TYPE, source=SSV_NAME)
        _add(binding, "ssd:ParameterMapping", type=MAPPING_TYPE, source=SSM_NAME)
        elements = _add(system, "ssd:Elements")
        for component in structure.components:
            self._add_component(elements, component)
        holder = _add(system, "ssd:Connections") if structure.connections else system
        for connection in structure.connections:
            _add_connection(holder, connection)
        holder = _add(root, "ssd:Enumerations") if self._enumerations else root
        for name, items in self._enumerations.items():
            element = _add(holder, "ssc:Enumeration", name=name)
            for item, value in items.items():
                _add(element, "ssc:Item", name=item, value=str(value))
        self._add_units(root, "ssd")
        if stop_time is not None:
            _add(root, "ssd:DefaultExperiment", startTime="0.0", stopTime=number(stop_time))
        return root

    def _add_type(self, element: Element, end: Endpoint, unit: str | None) -> None:
        variable = self._wiring.variable(end)
        if variable.base_type == "Real":
            _add(element, "ssc:Real", unit=unit if unit in self._units else None)
        elif variable.base_type == "Enumeration":
            self._enumerations[str(end)] = variable.items
            _add(element, "ssc:Enumeration", name=str(end))
        else:
            _add(element, f"ssc:{variable.base_type}")

    def _add_component(self, elements: Element, component: Component) -> None:
        element = _add(
            elements,
            "ssd:Component",
            name=component.name,
            type=FMU_TYPE,
            source=_resource(component),
            implementation=_IMPLEMENTATIONS[self._wiring.declared[component.name].interface],
        )
        ends = (end for c in self._wiring.structure.connections for end in (c.source, c.target))
        used = dict.fromkeys(end for end in ends if end.component == component.name)
        holder = _add(element, "ssd:Connectors") if used else element
        for end in used:
            variable = self._wiring.variable(end)
            if variable.causality not in _CONNECTOR_KINDS:
                raise SspError(
                    f"The variable {variable.name!r} is declared as {variable.causality}, which SSP 1.0 has "
                    "no connector for."
                )
            connector = _add(holder, "ssd:Connector", name=end.variable, kind=variable.causality)
            self._add_type(connector, end, variable.unit)
        if component.substeps != 1:
            _annotate(element, substeps=str(component.substeps))

    # ------------------------------------------------------------------ SSV and SSM

    def parameter_set(self) -> Element:
        """Return the parameters, in the FMUs' own units: no conversion stands between file and value."""
        root = _root("ssv:ParameterSet", name="parameters")
        holder = _add(root, "ssv:Parameters")
        seen: set[str] = set()
        for end, value in self._values.items():
            name = self._names[end]
            if name in seen:
                raise SspError(
                    f"Two parameters would be named {name!r} in the parameter set; rename one of them."
                )
            seen.add(name)
            variable = self._wiring.variable(end)
            texts = {
                "Real": number(value),
                "Boolean": "true" if value else "false",
                "Integer": str(int(value)),
                "Enumeration": next((key for key, item in variable.items.items() if item == value), None),
            }
            text = texts[variable.base_type]
            if text is None:
                raise SspError(f"{end} = {value:g} is no item of its enumeration.")
            known = variable.base_type == "Real" and variable.unit in self._units
            parameter = _add(holder, "ssv:Parameter", name=name)
            _add(parameter, f"ssv:{variable.base_type}", value=text, unit=variable.unit if known else None)
        self._add_units(root, "ssv")
        return root

    def mapping(self) -> Element:
        """Return which parameter goes where."""
        root = _root("ssm:ParameterMapping")
        for end, name in self._names.items():
            _add(root, "ssm:MappingEntry", source=name, target=str(end))
        return root


def _add_connection(holder: Element, connection: Connection) -> None:
    source, target = connection.source, connection.target
    element = _add(
        holder,
        "ssd:Connection",
        startElement=source.component or None,
        startConnector=source.variable,
        endElement=target.component or None,
        endConnector=target.variable,
        suppressUnitConversion=None if connection.convert_units else "true",
    )
    if (connection.factor, connection.offset) != (1.0, 0.0):
        factor, offset = number(connection.factor), number(connection.offset)
        _add(element, "ssc:LinearTransformation", factor=factor, offset=offset)
    if connection.delayed:
        _annotate(element, delayed="true")
