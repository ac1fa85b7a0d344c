"""Writing a system of FMUs as an SSP 1.0 file; equal systems give equal bytes."""

import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from fe.runtime.arrays import archive_bytes
from fmu_asset.archive.declared import VariableInfo
from fmu_asset.coupling.structure import Endpoint
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.description import rendered
from fmu_asset.errors import SspError
from fmu_asset.packing.contents import checked_target
from reporting.files import atomic_write_bytes
from reporting.units import BASE_UNITS

from .package import (
    INTERFACES,
    NAMESPACES,
    OSP_NAMESPACE,
    OWN_NAMESPACE,
    SSD_NAME,
    parse_xml,
    validate,
)

_DOCUMENTS = {
    SSD_NAME: "ssd",
    "resources/parameters.ssv": "ssv",
    "resources/parameters.ssm": "ssm",
}
"""The XML files of an archive that is written, with their kinds."""


_CONNECTOR_KINDS = ("input", "output", "parameter", "calculatedParameter")


def write_ssp(
    wiring: Wiring,
    path: str | os.PathLike[str],
    *,
    parameter_names: Mapping[Endpoint, str] | None = None,
    stop_time: float | None = None,
    step_size: float | None = None,
    replace: bool = False,
) -> Path:
    """Write a system as an SSP 1.0 file; its XML is checked by the published schemas.

    Parameters
    ----------
    path : path-like
        The file to write, with the suffix .ssp.
    parameter_names : mapping of Endpoint to str, optional
        The names of parameters in the parameter set; by default `component.variable`.
    stop_time : float, optional
        End of the default experiment [s].
    step_size : float, optional
        Communication step size [s], in the annotation of the Open Simulation Platform.

    Raises
    ------
    SspError
        If a name cannot be written or is there twice, the path has another suffix, or the file
        exists and `replace` is False.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    target = checked_target(
        path, replace=replace, file_kind="An SSP file", suffix=".ssp", error=SspError
    )
    structure = wiring.structure
    units = _writable_units(wiring)
    values = {
        "structure": structure,
        "wiring": wiring,
        "used": _connected_variables(wiring),
        "parameters": _written_parameters(wiring, parameter_names or {}, units),
        "units": units,
        "stop_time": None if stop_time is None else float(stop_time),
        "step_size": None if step_size is None else float(step_size),
        "osp_namespace": OSP_NAMESPACE,
        "implementations": {interface: name for name, interface in INTERFACES.items()},
        "resource": _name_in_archive,
        "namespaces": NAMESPACES,
        "own_namespace": OWN_NAMESPACE,
        "tool": f"uav-twin {version('uav-twin')}",
    }
    members = {}
    for name, kind in _DOCUMENTS.items():
        content = rendered(Path(name).name, **values)
        validate(parse_xml(content, name), kind, name)
        members[name] = content
    for component in structure.components:
        members[_name_in_archive(component.name)] = component.fmu.read_bytes()
    return atomic_write_bytes(target, archive_bytes(members, SSD_NAME))


def _connected_variables(wiring: Wiring) -> dict[Endpoint, VariableInfo]:
    """Return the connected variables of components, which need connectors in the file.

    An `SspError` is raised for a causality that SSP 1.0 has no connector for.
    """
    variables = {}
    for connection in wiring.structure.connections:
        for end in (connection.source, connection.target):
            if end.component:
                variables[end] = wiring.variable(end)
    for variable in variables.values():
        if variable.causality not in _CONNECTOR_KINDS:
            raise SspError(
                f"The variable {variable.name!r} is declared as {variable.causality}, which SSP "
                "1.0 has no connector for."
            )
    return variables


def _name_in_archive(component: str) -> str:
    """Return the name of a component's FMU in the archive."""
    stem = component.replace(".", "_")
    without_signs = stem.replace("_", "").replace("-", "")
    if not without_signs.isalnum() or not stem.isascii():
        raise SspError(
            f"The component {component!r} needs a name of ASCII letters, digits, `_` and `-`."
        )
    return f"resources/{stem}.fmu"


def _writable_units(wiring: Wiring) -> dict[str, dict[str, float]]:
    """Return the units that can be written: with exponents, and defined alike in all FMUs.

    For each unit there are the exponents of base units, the factor and the offset, as far as they
    differ from 0, 1 and 0.
    """
    units = list(wiring.structure.units)
    for description in wiring.declared.values():
        units += description.units
    definitions: dict[str, list[dict[str, float]]] = {}
    for unit in units:
        if unit.exponents is None:
            continue
        definition: dict[str, float] = {}
        for symbol, exponent in zip(BASE_UNITS, unit.exponents, strict=True):
            if exponent:
                definition[symbol] = exponent
        if (unit.factor, unit.offset) != (1.0, 0.0):
            definition |= {"factor": unit.factor, "offset": unit.offset}
        definitions_of_unit = definitions.setdefault(unit.name, [])
        if definition not in definitions_of_unit:
            definitions_of_unit.append(definition)
    writable = {}
    for name, definitions_of_unit in sorted(definitions.items()):
        if len(definitions_of_unit) == 1:
            writable[name] = definitions_of_unit[0]
    return writable


class _WrittenParameter(NamedTuple):
    """A parameter of a parameter set.

    Attributes
    ----------
    name : str
        The name in the parameter set.
    end : Endpoint
        The component and variable that it sets.
    type : str
        The type as SSP 1.0 calls it.
    value : str
        The value as text.
    unit : str or None
        None if it has no unit that can be written.
    """

    name: str
    end: Endpoint
    type: str
    value: str
    unit: str | None


def _written_parameters(
    wiring: Wiring, names: Mapping[Endpoint, str], units: Mapping[str, object]
) -> list[_WrittenParameter]:
    """Return the parameters to write, in the FMUs' own units, so that reading converts nothing.

    An `SspError` is raised if two parameters have one name, or a value is not an item of its
    enumeration.
    """
    parameters: dict[str, _WrittenParameter] = {}
    for component, settings in wiring.settings.items():
        for variable_name, value in sorted(settings.items()):
            end = Endpoint(component, variable_name)
            variable = wiring.variable(end)
            name = names.get(end, str(end))
            if name in parameters:
                raise SspError(
                    f"Two parameters would be named {name!r} in the parameter set; rename one of "
                    "them."
                )
            has_writable_unit = variable.base_type == "Real" and variable.unit in units
            parameters[name] = _WrittenParameter(
                name=name,
                end=end,
                type=variable.base_type,
                value=value if isinstance(value, str) else _number_text(end, variable, value),
                unit=variable.unit if has_writable_unit else None,
            )
    return list(parameters.values())


def _number_text(end: Endpoint, variable: VariableInfo, value: float) -> str:
    """Return a number as text for a parameter set, or the name of its item in an enumeration."""
    if variable.base_type == "Real":
        return repr(value)
    if variable.base_type == "Boolean":
        return "true" if value else "false"
    if variable.base_type == "Integer":
        return str(int(value))
    for name, item in variable.items.items():
        if item == value:
            return name
    raise SspError(f"{end} = {value:g} is not an item of its enumeration.")
