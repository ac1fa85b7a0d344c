"""Writing a system of FMUs as an SSP file: SSD, SSV, SSM and the FMUs; equal systems give equal bytes."""

import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fmu_asset.coupling.structure import Endpoint
from fmu_asset.coupling.wiring import Wiring
from fmu_asset.description import rendered
from fmu_asset.errors import SspError, said
from fmu_asset.packing.contents import archive_bytes, checked_target
from reporting.files import atomic_write_bytes
from reporting.units import BASE_UNITS

from .package import INTERFACES, NAMESPACES, OWN_NAMESPACE, SSD_NAME, parse_xml, validate

_DOCUMENTS = (SSD_NAME, "resources/parameters.ssv", "resources/parameters.ssm")
_CONNECTOR_KINDS = ("input", "output", "parameter", "calculatedParameter")


def write_ssp(
    wiring: Wiring,
    path: str | os.PathLike[str],
    *,
    parameter_names: Mapping[Endpoint, str] | None = None,
    stop_time: float | None = None,
    replace: bool = False,
) -> Path:
    """Write a system as an SSP 1.0 file, its XML checked by the published schemas.

    Parameters
    ----------
    wiring : Wiring
        The system.
    path : path-like
        Where to write, with the suffix .ssp.
    parameter_names : mapping of Endpoint to str, optional
        What parameters are called in the parameter set; by default `component.variable`.
    stop_time : float, optional
        End of the default experiment [s].
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    SspError
        If a name cannot be written or is there twice, the path has another suffix, or something is there and
        `replace` is False.
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    target = checked_target(path, replace=replace, what="An SSP file", suffix=".ssp", error=SspError)
    structure, units = wiring.structure, _known_units(wiring)
    ends = (end for link in structure.connections for end in (link.source, link.target))
    used = {end: wiring.variable(end) for end in ends if end.component}
    for variable in used.values():
        if variable.causality not in _CONNECTOR_KINDS:
            raise SspError(said("ssp.causality", variable=variable))
    values = {
        "structure": structure,
        "wiring": wiring,
        "used": used,
        "parameters": _parameters(wiring, parameter_names or {}, units),
        "units": units,
        "stop_time": None if stop_time is None else float(stop_time),
        "implementations": {interface: name for name, interface in INTERFACES.items()},
        "resource": _resource,
        "namespaces": NAMESPACES,
        "own_namespace": OWN_NAMESPACE,
        "tool": f"uav-twin {version('uav-twin')}",
    }
    members = {name: rendered(Path(name).name, **values) for name in _DOCUMENTS}
    for name, content in members.items():
        validate(parse_xml(content, name), name[-3:], name)
    members |= {_resource(component.name): component.fmu.read_bytes() for component in structure.components}
    return atomic_write_bytes(target, archive_bytes(members, SSD_NAME))


def _resource(component: str) -> str:
    plain = component.replace(".", "_")
    if not plain.replace("_", "").replace("-", "").isalnum() or not plain.isascii():
        raise SspError(f"The component {component!r} needs a name of ASCII letters, digits, `_` and `-`.")
    return f"resources/{plain}.fmu"


def _known_units(wiring: Wiring) -> dict[str, dict[str, float]]:
    """Return the units that can be written: with exponents, and meaning the same in all FMUs."""
    found: dict[str, list[dict[str, float]]] = {}
    of_fmus = (unit for fmu in wiring.declared.values() for unit in fmu.units)
    for unit in (*wiring.structure.units, *of_fmus):
        if unit.exponents is None:
            continue
        base: dict[str, float] = {s: n for s, n in zip(BASE_UNITS, unit.exponents, strict=True) if n}
        if (unit.factor, unit.offset) != (1.0, 0.0):
            base |= {"factor": unit.factor, "offset": unit.offset}
        if base not in found.setdefault(unit.name, []):
            found[unit.name].append(base)
    return {name: bases[0] for name, bases in sorted(found.items()) if len(bases) == 1}


def _parameters(
    wiring: Wiring, names: Mapping[Endpoint, str], units: Mapping[str, object]
) -> list[dict[str, Any]]:
    """Return the parameters, in the FMUs' own units: no conversion stands between file and value."""
    found: dict[str, dict[str, Any]] = {}
    for component, values in wiring.settings.items():
        for variable_name, value in sorted(values.items()):
            end = Endpoint(component, variable_name)
            variable = wiring.variable(end)
            name, kind = names.get(end, str(end)), variable.base_type
            if name in found:
                raise SspError(said("ssp.parameter", name=name))
            text = {
                "Real": repr(value),
                "Boolean": "true" if value else "false",
                "Integer": str(int(value)),
                "Enumeration": next((key for key, item in variable.items.items() if item == value), None),
            }[kind]
            if text is None:
                raise SspError(f"{end} = {value:g} is no item of its enumeration.")
            unit = variable.unit if kind == "Real" and variable.unit in units else None
            found[name] = {"name": name, "end": end, "type": kind, "value": text, "unit": unit}
    return list(found.values())
