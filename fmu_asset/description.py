"""The model description (modelDescription.xml) and the documentation page, from the table of variables."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.slaves.variables import ENUMERATIONS, UNITS, EnumerationType, FmuVariable, Unit

LOG_CATEGORIES = {
    "logStatusWarning": "Log messages with fmi2Warning status.",
    "logStatusDiscard": "Log messages with fmi2Discard status.",
    "logStatusError": "Log messages with fmi2Error status.",
    "logStatusFatal": "Log messages with fmi2Fatal status.",
    "logAll": "Log all messages.",
}


def number(value: float) -> str:
    """Return a float as the shortest text that reads back to the same bits."""
    return repr(float(value))


def model_description(
    *,
    identifier: str,
    guid: str,
    table: Sequence[FmuVariable],
    description: str,
    version: str,
    generation_tool: str,
    source_files: Sequence[str] = (),
    model_name: str = "uav_wing",
    units: Sequence[Unit] = UNITS,
    enumerations: Sequence[EnumerationType] = ENUMERATIONS,
    dependencies: Mapping[str, Sequence[str]] | None = None,
) -> bytes:
    """Return modelDescription.xml of an FMI 2.0 FMU: for co-simulation, or with states for model exchange.

    Parameters
    ----------
    identifier : str
        Model identifier: the stem of the binary.
    guid : str
        Globally unique identifier, here a hash of the content.
    table : sequence of FmuVariable
        The variables, in order of their value reference. Local ones are states, and then as many derivatives.
    description, version, generation_tool : str
        Attributes of the root element. There is no generation date: equal content gives equal bytes.
    source_files : sequence of str
        C sources in the folder `sources`; an FMU with none needs Python to run.
    model_name : str
        Attribute of the root element.
    units, enumerations
        Units and enumerations that the table uses.
    dependencies : mapping of str to sequence of str, optional
        For each output, the inputs that it depends on directly; an output that is missing depends on all.

    Returns
    -------
    bytes
        UTF-8 XML.
    """
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=model_name,
        guid=guid,
        description=description,
        version=version,
        generationTool=generation_tool,
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    local = [row for row in table if row.causality == "local"]
    derivatives = local[len(local) // 2 :]
    _add_interface(root, identifier, source_files, exchange=bool(local))
    add_units(root, units)
    _add_types(root, enumerations)
    categories = SubElement(root, "LogCategories")
    for name, text in LOG_CATEGORIES.items():
        SubElement(categories, "Category", name=name, description=text)
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="50.0", stepSize="1.0")
    variables = SubElement(root, "ModelVariables")
    for row in table:
        element = _scalar_variable(row)
        if row in derivatives:
            element[0].set("derivative", str(row.reference + 1 - len(derivatives)))
        variables.append(element)
    _add_structure(root, table, dependencies, derivatives)
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _add_interface(root: Element, identifier: str, source_files: Sequence[str], *, exchange: bool) -> None:
    own = {"completedIntegratorStepNotNeeded": "true"}
    if not exchange:
        lines = "true" if source_files else "false"
        own = {"canHandleVariableCommunicationStepSize": "true", "canInterpolateInputs": lines}
    interface = SubElement(
        root,
        "ModelExchange" if exchange else "CoSimulation",
        modelIdentifier=identifier,
        needsExecutionTool="false" if source_files else "true",
        canBeInstantiatedOnlyOncePerProcess="false",
        canNotUseMemoryManagementFunctions="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    for attribute, value in own.items():
        interface.set(attribute, value)
    if source_files:
        interface.set("providesDirectionalDerivative", "true")
        listed = SubElement(interface, "SourceFiles")
        for name in source_files:
            SubElement(listed, "File", name=name)


def add_units(root: Element, units: Sequence[Unit]) -> None:
    """Add the unit definitions to a model description of FMI 2 or 3."""
    defined = SubElement(root, "UnitDefinitions")
    for unit in units:
        element = SubElement(defined, "Unit", name=unit.name)
        SubElement(element, "BaseUnit", {symbol: str(power) for symbol, power in unit.exponents})
        for name, factor in unit.displays:
            SubElement(element, "DisplayUnit", name=name, factor=number(factor))


def _add_types(root: Element, enumerations: Sequence[EnumerationType]) -> None:
    types = SubElement(root, "TypeDefinitions")
    for enumeration in enumerations:
        simple = SubElement(types, "SimpleType", name=enumeration.name, description=enumeration.description)
        items = SubElement(simple, "Enumeration")
        for name, value, text in enumeration.items:
            SubElement(items, "Item", name=name, value=str(value), description=text)


def _add_structure(
    root: Element,
    table: Sequence[FmuVariable],
    dependencies: Mapping[str, Sequence[str]] | None,
    derivatives: Sequence[FmuVariable],
) -> None:
    structure = SubElement(root, "ModelStructure")
    index = {row.name: row.reference + 1 for row in table}
    outputs = [row for row in table if row.causality == "output"]
    unknown_rows = {
        "Outputs": outputs,
        "Derivatives": derivatives,
        "InitialUnknowns": [row for row in table if row.causality in ("output", "local")],
    }
    for name, rows in unknown_rows.items():
        if not rows:
            continue
        unknowns = SubElement(structure, name)
        for row in rows:
            unknown = SubElement(unknowns, "Unknown", index=str(index[row.name]))
            if name == "Outputs" and dependencies is not None and row.name in dependencies:
                inputs = sorted(index[source] for source in dependencies[row.name])
                unknown.set("dependencies", " ".join(map(str, inputs)))


_WRITERS: Mapping[str, Callable[[float], str]] = {
    "Real": number,
    "Integer": lambda value: str(int(value)),
    "Enumeration": lambda value: str(int(value)),
    "Boolean": lambda value: "true" if value else "false",
}


def _scalar_variable(row: FmuVariable) -> Element:
    attributes = {
        "name": row.name,
        "valueReference": str(row.reference),
        "description": row.description,
        "causality": row.causality,
        "variability": row.variability,
    }
    if row.causality != "input":
        attributes["initial"] = "exact" if row.causality == "parameter" else "calculated"
    element = Element("ScalarVariable", attributes)
    write = _WRITERS[row.kind]
    inner: dict[str, str] = {}
    if row.enumeration is not None:
        inner["declaredType"] = row.enumeration
    if row.unit is not None:
        inner["unit"] = row.unit
    if row.display_unit is not None:
        inner["displayUnit"] = row.display_unit
    # An enumeration's range is its items.
    if row.kind in ("Real", "Integer"):
        for name, value in (("min", row.minimum), ("max", row.maximum)):
            if value is not None:
                inner[name] = write(value)
    if row.start is not None:
        inner["start"] = write(row.start)
    SubElement(element, row.kind, inner)
    return element


def documentation_page(
    table: Sequence[FmuVariable],
    description: str,
    *,
    model_name: str = "uav_wing",
    enumerations: Sequence[EnumerationType] = ENUMERATIONS,
    host: str = "It runs in a Python host that has NumPy.",
    fmi: int = 2,
    interface: str = "co-simulation",
) -> bytes:
    """Return documentation/index.html: what the FMU is and its variables, as UTF-8 without any request."""
    rows = []
    for row in table:
        limits = "".join(
            f"{sign} {value:g} "
            for sign, value in (("≥", row.minimum), ("≤", row.maximum))
            if value is not None
        )
        cells = (row.name, row.causality, row.unit or "", limits, row.start, row.description)
        rows.append("<tr>" + "".join(f"<td>{escape(_text(cell))}</td>" for cell in cells) + "</tr>")
    statuses = "".join(
        f"<li>{enumeration.name} {value} ({name}): {escape(text)}</li>"
        for enumeration in enumerations
        for name, value, text in enumeration.items
    )
    body = "\n".join(rows)
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{model_name}</title>
<style>body{{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}}
td,th{{text-align:left;padding:.2em .8em .2em 0;border-bottom:1px solid #ddd}}</style></head><body>
<h1>{model_name}</h1><p>{escape(description)}</p>
<p>FMI {fmi}.0 {interface}. {escape(host)} A call that is refused logs why, sets
<code>status</code> and leaves state and outputs as they were; a refused step returns fmi{fmi}Discard.</p>
<table><tr><th>variable</th><th>causality</th><th>unit</th><th>range</th><th>start</th><th>meaning</th></tr>
{body}
</table><h2>Enumerations</h2><ul>{statuses}</ul></body></html>
"""
    return page.encode("utf-8")


def _text(cell: object) -> str:
    if cell is None:
        return ""
    return f"{cell:g}" if isinstance(cell, float) else str(cell)
