"""`modelDescription.xml` and `buildDescription.xml` of FMI 3.0, from the table of variables."""

from collections.abc import Iterable, Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.description import LOG_CATEGORIES, add_units, number
from fmu_asset.slaves.variables import ENUMERATIONS, FmuVariable, Unit

from .arrays import ArrayVariable


def model_description3(
    *,
    identifier: str,
    guid: str,
    table: Sequence[FmuVariable],
    arrays: Sequence[ArrayVariable],
    description: str,
    version: str,
    model_name: str,
    units: Sequence[Unit],
) -> bytes:
    """Return modelDescription.xml of an FMI 3.0 FMU in C: for model exchange if local variables are in it.

    Parameters
    ----------
    identifier, guid, description, version, model_name : str
        As in `fmu_asset.description.model_description`; the GUID is the instantiation token.
    table : sequence of FmuVariable
        The variables in order of their value reference, the time among them.
    arrays : sequence of ArrayVariable
        Which of them are elements of arrays.
    units : sequence of Unit
        Units of the table.

    Returns
    -------
    bytes
        UTF-8 XML.
    """
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=model_name,
        instantiationToken=guid,
        description=description,
        version=version,
        generationTool="uav-twin",
        variableNamingConvention="structured",
    )
    heads = {array.rows[0].reference: array for array in arrays}
    inner = {row.reference for array in arrays for row in array.rows[1:]}
    rows = [row for row in table if row.reference not in inner]
    exchange = any(row.causality == "local" for row in rows)
    interface = SubElement(
        root,
        "ModelExchange" if exchange else "CoSimulation",
        modelIdentifier=identifier,
        needsExecutionTool="false",
        canBeInstantiatedOnlyOncePerProcess="false",
        canGetAndSetFMUState="true",
        canSerializeFMUState="true",
        providesDirectionalDerivatives="true",
        providesAdjointDerivatives="true",
    )
    if not exchange:
        interface.set("canHandleVariableCommunicationStepSize", "true")
    add_units(root, units)
    types = SubElement(root, "TypeDefinitions")
    for enumeration in ENUMERATIONS:
        own = SubElement(types, "EnumerationType", name=enumeration.name, description=enumeration.description)
        for name, value, text in enumeration.items:
            SubElement(own, "Item", name=name, value=str(value), description=text)
    categories = SubElement(root, "LogCategories")
    for name, text in LOG_CATEGORIES.items():
        SubElement(categories, "Category", name=name, description=text.replace("fmi2", "fmi3"))
    SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="50.0", stepSize="1.0")
    _add_variables(root, rows, heads)
    return _text(root)


def _add_variables(root: Element, rows: Sequence[FmuVariable], heads: Mapping[int, ArrayVariable]) -> None:
    """Add the variables, of which the local ones are states and then their derivatives, and the structure."""
    local = [row for row in rows if row.causality == "local"]
    states, rates = local[: len(local) // 2], local[len(local) // 2 :]
    derived = {rate.reference: state.reference for state, rate in zip(states, rates, strict=True)}
    variables = SubElement(root, "ModelVariables")
    for row in rows:
        element = _variable(row, heads.get(row.reference))
        if row.reference in derived:
            element.set("derivative", str(derived[row.reference]))
        variables.append(element)
    structure = SubElement(root, "ModelStructure")
    outputs = [row for row in rows if row.causality == "output"]
    for kind, unknown in (
        ("Output", outputs),
        ("ContinuousStateDerivative", rates),
        ("InitialUnknown", [*outputs, *local]),
    ):
        for row in unknown:
            SubElement(structure, kind, valueReference=str(row.reference))


def _variable(row: FmuVariable, array: ArrayVariable | None) -> Element:
    """Return one variable, scalar or array."""
    attributes = {
        "name": row.name if array is None else array.name,
        "valueReference": str(row.reference),
        "description": row.description if array is None else array.description,
        "causality": row.causality,
        "variability": row.variability,
    }
    if row.causality in ("parameter", "output", "local"):
        attributes["initial"] = "exact" if row.causality == "parameter" else "calculated"
    if row.enumeration is not None:
        attributes["declaredType"] = row.enumeration
    else:
        for name, text in (("unit", row.unit), ("displayUnit", row.display_unit)):
            if text is not None:
                attributes[name] = text
        for name, value in (("min", row.minimum), ("max", row.maximum)):
            if value is not None:
                attributes[name] = number(value)
    rows = (row,) if array is None else array.rows
    if row.start is not None:
        starts = (each.start or 0.0 for each in rows)
        attributes["start"] = (
            str(int(row.start)) if row.enumeration is not None else " ".join(map(number, starts))
        )
    element = Element("Enumeration" if row.enumeration is not None else "Float64", attributes)
    if array is not None:
        SubElement(element, "Dimension", start=str(len(rows)))
    return element


def build_description(identifier: str, source_files: Iterable[str]) -> bytes:
    """Return sources/buildDescription.xml: which sources the binary of that identifier is made of."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = SubElement(root, "BuildConfiguration", modelIdentifier=identifier)
    listed = SubElement(configuration, "SourceFileSet", language="C11")
    for name in source_files:
        SubElement(listed, "SourceFile", name=name)
    return _text(root)


def _text(root: Element) -> bytes:
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"
