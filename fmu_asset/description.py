"""The model description (modelDescription.xml) of FMI 2 or 3 and the documentation page, from the table."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib.metadata import version
from itertools import groupby
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.slaves.variables import ENUMERATIONS, EnumerationType, FmuVariable, Unit

_ELEMENT = re.compile(r"(?P<stem>.+)(?:\[(?P<index>[0-9]+)\]|\.(?P<label>[^.]+))")
LOG_CATEGORIES = {
    "logStatusWarning": "Log messages with fmi2Warning status.",
    "logStatusDiscard": "Log messages with fmi2Discard status.",
    "logStatusError": "Log messages with fmi2Error status.",
    "logStatusFatal": "Log messages with fmi2Fatal status.",
    "logAll": "Log all messages.",
}


PLACEHOLDER = "0_content_0_"
"""Stands for the tag, the first characters of the content hash, until that is known."""


@dataclass(frozen=True)
class Declaration:
    """What an FMU declares, whatever it is made of.

    Attributes
    ----------
    name : str
        Model name, with which the model identifier begins.
    description : str
        One sentence for people.
    table : tuple of FmuVariable
        The variables, in order of their value reference. Local ones are states, and then as many derivatives.
    units : tuple of Unit
        Units of the table.
    enumerations : tuple of EnumerationType
        Enumerations of the table.
    dependencies : mapping of str to sequence of str
        For each output, the inputs that it depends on directly; an output that is missing depends on all.
    """

    name: str
    description: str
    table: tuple[FmuVariable, ...]
    units: tuple[Unit, ...]
    enumerations: tuple[EnumerationType, ...] = ENUMERATIONS
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def identifier(self) -> str:
        """Model identifier, the stem of the binary, before the content hash is known."""
        return f"{self.name}_{PLACEHOLDER}"


def number(value: float) -> str:
    """Return a float as the shortest text that reads back to the same bits."""
    return repr(float(value))


def xml_bytes(root: Element) -> bytes:
    """Return an XML file, indented."""
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


@dataclass(frozen=True)
class ArrayVariable:
    """Rows that follow one another, as one array; its value reference is that of the first row.

    Attributes
    ----------
    name : str
        What the names of the rows have in common: `strain` of `strain[1]`, ...; `health` of `health.z1`, ...
    rows : tuple of FmuVariable
        The elements in order, alike but for name, description and start value.
    """

    name: str
    rows: tuple[FmuVariable, ...]

    @property
    def description(self) -> str:
        """Return that of the first element with i in the place of its index or name, and all names."""
        labels = [_label(row.name) for row in self.rows]
        text = re.sub(rf"\b{re.escape(labels[0])}\b|\b1\b", "i", self.rows[0].description, count=1)
        return text if labels[0] == "1" else f"{text}; i is one of {', '.join(labels)}"


def arrays_of(table: Sequence[FmuVariable]) -> tuple[ArrayVariable, ...]:
    """Return the arrays of a table: numbered variables, and inputs and outputs such as `health.z1`.

    Rows of one stem that differ in unit or range stay scalars.
    """
    found = []
    for stem, group in groupby(table, _stem):
        rows = tuple(group)
        plain = {replace(row, name="", reference=0, description="", start=None) for row in rows}
        if stem is not None and len(plain) == 1:
            found.append(ArrayVariable(stem, rows))
    return tuple(found)


def _stem(row: FmuVariable) -> str | None:
    match = _ELEMENT.fullmatch(row.name)
    return None if match is None or row.causality == "parameter" or row.kind != "Real" else match["stem"]


def _label(name: str) -> str:
    match = _ELEMENT.fullmatch(name)
    assert match is not None
    return match["index"] or match["label"]


def model_description(
    declared: Declaration,
    *,
    generation_tool: str,
    source_files: Sequence[str] = (),
    fmi: int = 2,
    arrays: Sequence[ArrayVariable] = (),
) -> bytes:
    """Return modelDescription.xml of an FMU: for co-simulation, or with states for model exchange.

    The placeholder stands for what the content hash will give. There is no generation date: equal content
    gives equal bytes.

    Parameters
    ----------
    declared : Declaration
        The model.
    generation_tool : str
        Attribute of the root element.
    source_files : sequence of str
        C sources in the folder `sources`; an FMU with none needs Python to run.
    fmi : {2, 3}
        Version of FMI.
    arrays : sequence of ArrayVariable
        Which variables are elements of arrays, in FMI 3.

    Returns
    -------
    bytes
        UTF-8 XML.
    """
    inner = {row.reference for array in arrays for row in array.rows[1:]}
    rows = [row for row in declared.table if row.reference not in inner]
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{fmi}.0",
            "modelName": declared.name,
            "guid" if fmi == 2 else "instantiationToken": PLACEHOLDER,
            "description": declared.description,
            "version": version("uav-twin"),
            "generationTool": generation_tool,
            "variableNamingConvention": "structured",
        },
    )
    if fmi == 2:
        root.set("numberOfEventIndicators", "0")
    exchange = any(row.causality == "local" for row in rows)
    _add_interface(root, declared.identifier, source_files, fmi, exchange=exchange)
    _add_units(root, declared.units)
    types = SubElement(root, "TypeDefinitions")
    for enumeration in declared.enumerations:
        said = {"name": enumeration.name, "description": enumeration.description}
        if fmi == 2:
            items = SubElement(SubElement(types, "SimpleType", said), "Enumeration")
        else:
            items = SubElement(types, "EnumerationType", said)
        for name, value, text in enumeration.items:
            SubElement(items, "Item", name=name, value=str(value), description=text)
    categories = SubElement(root, "LogCategories")
    for name, text in LOG_CATEGORIES.items():
        SubElement(categories, "Category", name=name, description=text.replace("fmi2", f"fmi{fmi}"))
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="50.0", stepSize="1.0")
    _add_variables(root, rows, {array.rows[0].reference: array for array in arrays}, fmi)
    _add_structure(root, rows, declared.dependencies, fmi)
    return xml_bytes(root)


_ABILITIES_2 = ("canNotUseMemoryManagementFunctions", "canGetAndSetFMUstate", "canSerializeFMUstate")
_ABILITIES_3 = (
    "canGetAndSetFMUState",
    "canSerializeFMUState",
    "providesDirectionalDerivatives",
    "providesAdjointDerivatives",
)
_NO_NOTICE = {"completedIntegratorStepNotNeeded": "true"}


def _add_interface(
    root: Element, identifier: str, source_files: Sequence[str], fmi: int, *, exchange: bool
) -> None:
    source, steps = "true" if source_files else "false", {"canHandleVariableCommunicationStepSize": "true"}
    said = {
        "modelIdentifier": identifier,
        "needsExecutionTool": "false" if source_files else "true",
        "canBeInstantiatedOnlyOncePerProcess": "false",
    }
    if fmi == 2:
        said |= dict.fromkeys(_ABILITIES_2, "true")
        said |= _NO_NOTICE if exchange else {**steps, "canInterpolateInputs": source}
        if source_files:
            said["providesDirectionalDerivative"] = "true"
    else:
        said |= dict.fromkeys(_ABILITIES_3, "true") | ({} if exchange else steps)
    interface = SubElement(root, "ModelExchange" if exchange else "CoSimulation", said)
    if fmi == 2 and source_files:
        listed = SubElement(interface, "SourceFiles")
        for name in source_files:
            SubElement(listed, "File", name=name)


def _add_units(root: Element, units: Sequence[Unit]) -> None:
    defined = SubElement(root, "UnitDefinitions")
    for unit in units:
        element = SubElement(defined, "Unit", name=unit.name)
        SubElement(element, "BaseUnit", {symbol: str(power) for symbol, power in unit.exponents})
        for name, factor in unit.displays:
            SubElement(element, "DisplayUnit", name=name, factor=number(factor))


def _rates(rows: Sequence[FmuVariable]) -> dict[int, FmuVariable]:
    """Return the derivatives among rows, by the value reference of their states."""
    local = [row for row in rows if row.causality == "local"]
    count = len(local) // 2
    return {state.reference: rate for state, rate in zip(local[:count], local[count:], strict=True)}


def _add_variables(
    root: Element, rows: Sequence[FmuVariable], heads: Mapping[int, ArrayVariable], fmi: int
) -> None:
    states = {rate.reference: state for state, rate in _rates(rows).items()}
    variables = SubElement(root, "ModelVariables")
    for row in rows:
        array = heads.get(row.reference)
        outer = {
            "name": row.name if array is None else array.name,
            "valueReference": str(row.reference),
            "description": row.description if array is None else array.description,
            "causality": row.causality,
            "variability": row.variability,
        }
        if row.causality in ("parameter", "output", "local"):
            outer["initial"] = "exact" if row.causality == "parameter" else "calculated"
        inner = _of_type(row, array)
        if row.reference in states:
            # FMI 2 counts variables from 1, and ours stand at their value references.
            inner["derivative"] = str(states[row.reference] + (fmi == 2))
        if fmi == 2:
            SubElement(SubElement(variables, "ScalarVariable", outer), row.kind, inner)
        else:
            element = SubElement(variables, "Float64" if row.kind == "Real" else row.kind, outer | inner)
            if array is not None:
                SubElement(element, "Dimension", start=str(len(array.rows)))


def _of_type(row: FmuVariable, array: ArrayVariable | None) -> dict[str, str]:
    """Return the attributes of a variable that its type has: unit, range, start value."""
    write = _WRITERS[row.kind]
    found = {"declaredType": row.enumeration, "unit": row.unit, "displayUnit": row.display_unit}
    # An enumeration's range is its items.
    if row.kind in ("Real", "Integer"):
        for name, value in (("min", row.minimum), ("max", row.maximum)):
            found[name] = None if value is None else write(value)
    if row.start is not None:
        rows = (row,) if array is None else array.rows
        found["start"] = " ".join(write(each.start or 0.0) for each in rows)
    return {name: value for name, value in found.items() if value is not None}


def _add_structure(
    root: Element, rows: Sequence[FmuVariable], dependencies: Mapping[str, Sequence[str]], fmi: int
) -> None:
    structure = SubElement(root, "ModelStructure")
    reference = {row.name: row.reference for row in rows}
    outputs = [row for row in rows if row.causality == "output"]
    for group, kind, unknown in (
        ("Outputs", "Output", outputs),
        ("Derivatives", "ContinuousStateDerivative", list(_rates(rows).values())),
        ("InitialUnknowns", "InitialUnknown", [row for row in rows if row.causality in ("output", "local")]),
    ):
        if fmi == 3:
            for row in unknown:
                SubElement(structure, kind, valueReference=str(row.reference))
        elif unknown:
            holder = SubElement(structure, group)
            for row in unknown:
                element = SubElement(holder, "Unknown", index=str(row.reference + 1))
                if group == "Outputs" and row.name in dependencies:
                    inputs = sorted(reference[source] + 1 for source in dependencies[row.name])
                    element.set("dependencies", " ".join(map(str, inputs)))


_WRITERS: Mapping[str, Callable[[float], str]] = {
    "Real": number,
    "Integer": lambda value: str(int(value)),
    "Enumeration": lambda value: str(int(value)),
    "Boolean": lambda value: "true" if value else "false",
}


def documentation_page(
    declared: Declaration, host: str, *, fmi: int = 2, interface: str = "co-simulation"
) -> bytes:
    """Return documentation/index.html: what the FMU is and its variables, as UTF-8 without any request."""
    rows = []
    for row in declared.table:
        start = "" if row.start is None else f"{row.start:g}"
        limits = "".join(
            f"{sign} {value:g} "
            for sign, value in (("≥", row.minimum), ("≤", row.maximum))
            if value is not None
        )
        cells = (row.name, row.causality, row.unit or "", limits, start, row.description)
        rows.append("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>")
    statuses = "".join(
        f"<li>{enumeration.name} {value} ({name}): {escape(text)}</li>"
        for enumeration in declared.enumerations
        for name, value, text in enumeration.items
    )
    body = "\n".join(rows)
    page = f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{declared.name}</title>
<style>body{{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}}
td,th{{text-align:left;padding:.2em .8em .2em 0;border-bottom:1px solid #ddd}}</style></head><body>
<h1>{declared.name}</h1><p>{escape(declared.description)}</p>
<p>FMI {fmi}.0 {interface}. {escape(host)} A call that is refused logs why, sets
<code>status</code> and leaves state and outputs as they were; a refused step returns fmi{fmi}Discard.</p>
<table><tr><th>variable</th><th>causality</th><th>unit</th><th>range</th><th>start</th><th>meaning</th></tr>
{body}
</table><h2>Enumerations</h2><ul>{statuses}</ul></body></html>
"""
    return page.encode("utf-8")
