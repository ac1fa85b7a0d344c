"""Packing a model that is one Python script for pythonfmu as an FMU that other tools can check.

pythonfmu's own builder takes the same scripts, but leaves out units and ranges, and stamps a time and a
random GUID, so that no two builds are alike. Here equal scripts give equal bytes. A script may say more in
two class attributes, both optional:

- `unit_table`: for each unit its exponents of `kg, m, s, A, K, mol, cd, rad`, a `factor` and an `offset` to
  them (1 and 0 by default), and `displays`, the factors of display units;
- `variable_table`: for each variable causality, unit, least, largest and start value (or None), and meaning.

The script runs once in this process, to be asked for its variables.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from runpy import run_path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.archive.declared import BASE_UNITS
from fmu_asset.description import PLACEHOLDER, rendered
from fmu_asset.errors import FmuBuildError
from fmu_asset.sentences import said

from .contents import (
    BASE_CLASS_FILES,
    FmuInfo,
    checked_target,
    pythonfmu_members,
    pythonfmu_version,
    sealed,
    write_fmu,
)


def build_script_fmu(
    script: str | os.PathLike[str], path: str | os.PathLike[str], *, replace: bool = False
) -> FmuInfo:
    """Pack a script as an FMI 2.0 co-simulation FMU; equal scripts give equal bytes.

    Parameters
    ----------
    script : path-like
        A Python file with one subclass of pythonfmu's `Fmi2Slave`. It may use the standard library and what
        is installed where the FMU runs.
    path : path-like
        Where to write, with the suffix .fmu.
    replace : bool
        Whether an existing file may be replaced.

    Raises
    ------
    FmuBuildError
        The file exists, the suffix is wrong, or the script cannot be packed; the sentence says why.
    """
    return write_fmu(checked_target(path, replace=replace), script_fmu(script))


def script_fmu(script: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Return the archive of a script and its GUID; see `build_script_fmu`."""
    file = Path(script)
    if not file.stem.isidentifier() or file.suffix != ".py":
        raise FmuBuildError(said("script.name", file=file))
    try:
        source = file.read_bytes()
    except OSError as error:
        raise FmuBuildError(f"The model script {file} cannot be read ({error.strerror or error}).") from error
    pythonfmu_version()
    model = _model_class(file)
    module, name = f"{file.stem}_{PLACEHOLDER}", model.__name__
    runtime = f"resources/{module}_runtime"
    members = {
        "modelDescription.xml": _description(file, model, module),
        f"resources/{module}.py": rendered("script.py", module=module, name=name, tag=PLACEHOLDER),
        f"{runtime}/__init__.py": rendered("script_runtime.py"),
        f"{runtime}/model.py": source,
    }
    names = ("__init__.py", "builder.py", "osutil.py", *BASE_CLASS_FILES)
    return sealed(members | pythonfmu_members(module, "resources/pythonfmu", names))


def _model_class(file: Path) -> type[Any]:
    """Run the script and return the one slave that it defines."""
    from pythonfmu import Fmi2Slave

    name = f"_uav_twin_script_{file.stem}"
    try:
        content = run_path(str(file), run_name=name)  # which leaves nothing beside the user's script
    except Exception as error:
        raise FmuBuildError(f"The model script {file} cannot be run: {error!r}.") from error
    found = [
        item
        for item in content.values()
        if isinstance(item, type) and issubclass(item, Fmi2Slave) and item.__module__ == name
    ]
    if len(found) != 1:
        names = [item.__name__ for item in found]
        raise FmuBuildError(said("script.slave", file=file, names=names))
    return found[0]


def _description(file: Path, model: type[Any], identifier: str) -> bytes:
    """Return pythonfmu's model description with units, ranges and initial unknowns, and without the time."""
    try:
        root: Any = model(instance_name="description", resources=str(file.parent)).to_xml()
    except Exception as error:
        raise FmuBuildError(f"{model.__name__} of {file} cannot be instantiated: {error!r}.") from error
    tool = f"uav-twin with {root.get('generationTool')}"
    root.attrib.update(modelName=file.stem, guid=PLACEHOLDER, generationTool=tool)
    root.attrib.pop("generationDateAndTime", None)
    interface, variables = root.find("CoSimulation"), root.find("ModelVariables")
    interface.set("modelIdentifier", identifier)
    units: Mapping[str, Mapping[str, Any]] = getattr(model, "unit_table", {})
    if units:
        root.insert(list(root).index(interface) + 1, _unit_definitions(file, units))
    _add_ranges(file, variables, getattr(model, "variable_table", {}), units)
    unknowns = SubElement(root.find("ModelStructure"), "InitialUnknowns")
    for index, variable in enumerate(variables, 1):
        if variable.get("causality") == "output":
            SubElement(unknowns, "Unknown", index=str(index))
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _unit_definitions(file: Path, units: Mapping[str, Mapping[str, Any]]) -> Element:
    definitions = Element("UnitDefinitions")
    for name, entry in units.items():
        unknown = sorted({*entry} - {*BASE_UNITS, "factor", "offset", "displays"})
        if unknown:
            raise FmuBuildError(said("script.unit", name=name, file=file, entry=unknown[0], known=BASE_UNITS))
        unit = SubElement(definitions, "Unit", name=name)
        base = {symbol: str(int(entry[symbol])) for symbol in BASE_UNITS if symbol in entry}
        base |= {key: repr(float(entry[key])) for key in ("factor", "offset") if key in entry}
        SubElement(unit, "BaseUnit", base)
        for display, factor in entry.get("displays", {}).items():
            SubElement(unit, "DisplayUnit", name=display, factor=repr(float(factor)))
    return definitions


def _add_ranges(
    file: Path, variables: Any, table: Mapping[str, tuple[Any, ...]], units: Mapping[str, Any]
) -> None:
    inner = {str(variable.get("name")): variable[0] for variable in variables}
    for name, (_, unit, low, high, _, _) in table.items():
        if name not in inner:
            raise FmuBuildError(said("script.variable_table", file=file, name=name))
        if unit is not None and unit not in units:
            raise FmuBuildError(f"{file} gives {name} in {unit}, which its unit_table does not have.")
        for key, value in (("unit", unit), ("min", low), ("max", high)):
            if value is not None:
                inner[name].set(key, value if isinstance(value, str) else repr(float(value)))
