"""Writing a system of FMUs as an SSP file: SSD, SSV, SSM and the FMUs; equal systems give equal bytes."""

import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, register_namespace

from fmu_asset.archive.declared import BASE_UNITS, UnitInfo, VariableInfo
from fmu_asset.coupling.structure import Component, Connection, Endpoint, Setting
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.description import number, xml_bytes
from fmu_asset.errors import SspError
from fmu_asset.packing.contents import archive_bytes
from reporting.files import atomic_write_bytes

from .package import NAMESPACES, OWN_ANNOTATION, OWN_NAMESPACE, SSD_NAME, parse_xml, tag, validate

SSV_NAME = "resources/parameters.ssv"
SSM_NAME = "resources/parameters.ssm"


_IMPLEMENTATIONS = {"co-simulation": "CoSimulation", "model-exchange": "ModelExchange"}


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
    target = Path(path)
    if target.suffix != ".ssp":
        raise SspError(f"An SSP file must have the suffix .ssp, but {target} was given.")
    if target.exists() and not replace:
        raise SspError(f"{target} exists: choose another name, or give --replace.")
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
    names = dict(parameter_names or {})
    units = _units(wiring)
    members = {
        SSD_NAME: xml_bytes(_description(wiring, units, stop_time)),
        SSV_NAME: xml_bytes(_parameter_set(wiring, names, units)),
        SSM_NAME: xml_bytes(_mapping(wiring, names)),
    }
    for name, kind in ((SSD_NAME, "ssd"), (SSV_NAME, "ssv"), (SSM_NAME, "ssm")):
        validate(parse_xml(members[name], name), kind, name)
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


def _units(wiring: Wiring) -> dict[str, UnitInfo]:
    """Return the units that can be written: with exponents, and meaning the same in all FMUs."""
    found: dict[str, UnitInfo] = {}
    ambiguous = set()
    sources = [*wiring.structure.units, *(u for d in wiring.declared.values() for u in d.units)]
    for unit in sources:
        if unit.exponents is None:
            continue
        plain = UnitInfo(unit.name, unit.exponents, unit.factor, unit.offset, ())
        if found.setdefault(unit.name, plain) != plain:
            ambiguous.add(unit.name)
    return {name: unit for name, unit in sorted(found.items()) if name not in ambiguous}


def _write_units(parent: Element, kind: str, units: Mapping[str, UnitInfo]) -> None:
    if not units:
        return
    holder = SubElement(parent, tag(kind, "Units"))
    for unit in units.values():
        element = SubElement(holder, tag("ssc", "Unit"), name=unit.name)
        base = {s: str(power) for s, power in zip(BASE_UNITS, unit.exponents or (), strict=True) if power}
        if (unit.factor, unit.offset) != (1.0, 0.0):
            base |= {"factor": number(unit.factor), "offset": number(unit.offset)}
        SubElement(element, tag("ssc", "BaseUnit"), base)


def _attributes(name: str) -> dict[str, str]:
    return {"version": "1.0", "name": name, "generationTool": f"uav-twin {version('uav-twin')}"}


# ---------------------------------------------------------------------- SSD


def _description(wiring: Wiring, units: Mapping[str, UnitInfo], stop_time: float | None) -> Element:
    structure = wiring.structure
    root = Element(tag("ssd", "SystemStructureDescription"), _attributes(structure.name))
    system = SubElement(root, tag("ssd", "System"), name="system")
    enumerations: dict[str, Mapping[str, int]] = {}
    if structure.connectors:
        holder = SubElement(system, tag("ssd", "Connectors"))
        for connector in structure.connectors:
            behind = _behind(wiring, connector.name)
            element = SubElement(holder, tag("ssd", "Connector"), name=connector.name, kind=connector.kind)
            if behind is not None:
                own = wiring.units[connector.name]
                _type(element, wiring, behind, own if own in units else None, enumerations)
    bindings = SubElement(system, tag("ssd", "ParameterBindings"))
    binding = SubElement(
        bindings, tag("ssd", "ParameterBinding"), type="application/x-ssp-parameter-set", source=SSV_NAME
    )
    SubElement(
        binding, tag("ssd", "ParameterMapping"), type="application/x-ssp-parameter-mapping", source=SSM_NAME
    )
    elements = SubElement(system, tag("ssd", "Elements"))
    for component in structure.components:
        _component(elements, wiring, component, units, enumerations)
    if structure.connections:
        holder = SubElement(system, tag("ssd", "Connections"))
        for connection in structure.connections:
            _connection(holder, connection)
    if enumerations:
        holder = SubElement(root, tag("ssd", "Enumerations"))
        for name, items in enumerations.items():
            element = SubElement(holder, tag("ssc", "Enumeration"), name=name)
            for item, value in items.items():
                SubElement(element, tag("ssc", "Item"), name=item, value=str(value))
    _write_units(root, "ssd", units)
    if stop_time is not None:
        SubElement(root, tag("ssd", "DefaultExperiment"), startTime="0.0", stopTime=number(stop_time))
    return root


def _behind(wiring: Wiring, name: str) -> Endpoint | None:
    """Return a variable that a connector of the system stands for."""
    if name in wiring.outward:
        return wiring.outward[name].end
    ports = wiring.inward.get(name, ())
    return ports[0].end if ports else None


def _type(
    element: Element,
    wiring: Wiring,
    end: Endpoint,
    unit: str | None,
    enumerations: dict[str, Mapping[str, int]],
) -> None:
    variable = wiring.variable(end)
    if variable.base_type == "Real":
        SubElement(element, tag("ssc", "Real"), {} if unit is None else {"unit": unit})
    elif variable.base_type == "Enumeration":
        name = f"{end.component}.{variable.name}"
        enumerations[name] = variable.items
        SubElement(element, tag("ssc", "Enumeration"), name=name)
    else:
        SubElement(element, tag("ssc", variable.base_type))


def _component(
    elements: Element,
    wiring: Wiring,
    component: Component,
    units: Mapping[str, UnitInfo],
    enumerations: dict[str, Mapping[str, int]],
) -> None:
    element = SubElement(
        elements,
        tag("ssd", "Component"),
        name=component.name,
        type="application/x-fmu-sharedlibrary",
        source=_resource(component),
        implementation=_IMPLEMENTATIONS[wiring.declared[component.name].interface],
    )
    used = dict.fromkeys(
        end.variable
        for connection in wiring.structure.connections
        for end in (connection.source, connection.target)
        if end.component == component.name
    )
    holder = SubElement(element, tag("ssd", "Connectors")) if used else element
    for name in used:
        variable = wiring.variable(Endpoint(component.name, name))
        connector = SubElement(holder, tag("ssd", "Connector"), name=name, kind=_kind(variable))
        unit = variable.unit if variable.unit in units else None
        _type(connector, wiring, Endpoint(component.name, name), unit, enumerations)
    if component.substeps != 1:
        _annotate(element, substeps=str(component.substeps))


def _kind(variable: VariableInfo) -> str:
    if variable.causality not in ("input", "output", "parameter", "calculatedParameter"):
        raise SspError(
            f"The variable {variable.name!r} is declared as {variable.causality}, which SSP 1.0 has no "
            "connector for."
        )
    return variable.causality


def _connection(holder: Element, connection: Connection) -> None:
    attributes = {}
    for side, end in (("start", connection.source), ("end", connection.target)):
        if end.component:
            attributes[f"{side}Element"] = end.component
        attributes[f"{side}Connector"] = end.variable
    if not connection.convert_units:
        attributes["suppressUnitConversion"] = "true"
    element = SubElement(holder, tag("ssd", "Connection"), attributes)
    if (connection.factor, connection.offset) != (1.0, 0.0):
        SubElement(
            element,
            tag("ssc", "LinearTransformation"),
            factor=number(connection.factor),
            offset=number(connection.offset),
        )
    if connection.delayed:
        _annotate(element, delayed="true")


def _annotate(element: Element, **attributes: str) -> None:
    holder = SubElement(element, tag("ssd", "Annotations"))
    annotation = SubElement(holder, tag("ssc", "Annotation"), type=OWN_ANNOTATION)
    SubElement(annotation, f"{{{OWN_NAMESPACE}}}Coupling", attributes)


# ---------------------------------------------------------------------- SSV and SSM


def _ends(wiring: Wiring) -> list[tuple[Endpoint, Setting]]:
    return [
        (Endpoint(component.name, name), setting)
        for component in wiring.structure.components
        for name, setting in sorted(component.settings.items())
    ]


def _parameter_set(wiring: Wiring, names: Mapping[Endpoint, str], units: Mapping[str, UnitInfo]) -> Element:
    root = Element(tag("ssv", "ParameterSet"), _attributes("parameters"))
    holder = SubElement(root, tag("ssv", "Parameters"))
    seen: set[str] = set()
    for end, setting in _ends(wiring):
        name = names.get(end, str(end))
        if name in seen:
            raise SspError(
                f"Two parameters would be named {name!r} in the parameter set; rename one of them."
            )
        seen.add(name)
        variable = wiring.variable(end)
        parameter = SubElement(holder, tag("ssv", "Parameter"), name=name)
        value = wiring.number(end, setting)
        if variable.base_type == "Real":
            # In the FMU's own unit, so that no conversion stands between the file and the value.
            own = {"unit": variable.unit} if variable.unit in units and variable.unit is not None else {}
            SubElement(parameter, tag("ssv", "Real"), {"value": number(value), **own})
        elif variable.base_type == "Boolean":
            SubElement(parameter, tag("ssv", "Boolean"), value="true" if value else "false")
        elif variable.base_type == "Enumeration":
            item = next((key for key, number_ in variable.items.items() if number_ == int(value)), None)
            if item is None:
                raise SspError(f"{end} = {value:g} is no item of its enumeration.")
            SubElement(parameter, tag("ssv", "Enumeration"), value=item)
        else:
            SubElement(parameter, tag("ssv", "Integer"), value=str(int(value)))
    _write_units(root, "ssv", units)
    return root


def _mapping(wiring: Wiring, names: Mapping[Endpoint, str]) -> Element:
    attributes = {key: value for key, value in _attributes("").items() if key != "name"}
    root = Element(tag("ssm", "ParameterMapping"), attributes)
    for end, _ in _ends(wiring):
        SubElement(root, tag("ssm", "MappingEntry"), source=names.get(end, str(end)), target=str(end))
    return root
