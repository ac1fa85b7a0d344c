"""Packing a model that is one Python script for pythonfmu as an FMU that other tools can check.

pythonfmu's own builder takes the same scripts, but leaves out units and ranges, and stamps a time and a
random GUID, so that no two builds are alike. Here equal scripts give equal bytes. A script may say more in
two class attributes, both optional:

- `unit_table`: for each unit its exponents of `kg, m, s, A, K, mol, cd, rad`, a `factor` and an `offset` to
  them (1 and 0 by default), and `displays`, the factors of display units;
- `variable_table`: for each variable causality, unit, least, largest and start value (or None), and meaning.

The script runs once in this process, to be asked for its variables.
"""

import importlib.util
import os
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.archive.declared import BASE_UNITS
from fmu_asset.description import PLACEHOLDER, rendered
from fmu_asset.errors import FmuBuildError

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
    target = checked_target(path, replace=replace)
    content, content_hash = script_fmu(script)
    return write_fmu(target, content, content_hash, Path(script).stem)


def script_fmu(script: str | os.PathLike[str]) -> tuple[bytes, str]:
    """Return the archive of a script and its content hash; see `build_script_fmu`."""
    file = Path(script)
    if not file.stem.isidentifier() or file.suffix != ".py":
        raise FmuBuildError(
            f"A model script must be a Python file whose name is an identifier, such as gear_pump.py, and "
            f"{file} was given."
        )
    try:
        source = file.read_bytes()
    except OSError as error:
        raise FmuBuildError(f"The model script {file} cannot be read ({error.strerror or error}).") from error
    pythonfmu_version()
    template = _members(file, source)
    return sealed(template)


def _members(file: Path, source: bytes) -> dict[str, bytes]:
    model = _model_class(file)
    module, name = f"{file.stem}_{PLACEHOLDER}", model.__name__
    runtime = f"resources/{module}_runtime"
    members = {
        "modelDescription.xml": _description(file, model, module),
        f"resources/{module}.py": rendered("script.py", module=module, name=name, tag=PLACEHOLDER),
        f"{runtime}/__init__.py": rendered("script_runtime.py"),
        f"{runtime}/model.py": source,
    }
    return members | pythonfmu_members(
        module, "resources/pythonfmu", ("__init__.py", "builder.py", "osutil.py", *BASE_CLASS_FILES)
    )


def _model_class(file: Path) -> type[Any]:
    """Run the script and return the one slave that it defines."""
    from pythonfmu import Fmi2Slave

    name = f"_uav_twin_script_{file.stem}"
    specification = importlib.util.spec_from_file_location(name, file)
    assert specification is not None
    assert specification.loader is not None
    module: ModuleType = importlib.util.module_from_spec(specification)
    kept = sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # nothing is left beside the user's script
    try:
        specification.loader.exec_module(module)
    except Exception as error:
        raise FmuBuildError(f"The model script {file} cannot be run: {error!r}.") from error
    finally:
        sys.dont_write_bytecode = kept
    found = [
        item
        for item in vars(module).values()
        if isinstance(item, type) and issubclass(item, Fmi2Slave) and item.__module__ == name
    ]
    if len(found) != 1:
        raise FmuBuildError(
            f"The model script {file} must define one subclass of pythonfmu's Fmi2Slave, and it defines "
            f"{', '.join(item.__name__ for item in found) or 'none'}."
        )
    return found[0]


def _description(file: Path, model: type[Any], identifier: str) -> bytes:
    """Return pythonfmu's model description with units, ranges and initial unknowns, and without the time."""
    try:
        instance = model(instance_name="description", resources=str(file.parent))
        root: Element = instance.to_xml()
    except Exception as error:
        raise FmuBuildError(f"{model.__name__} of {file} cannot be instantiated: {error!r}.") from error
    root.set("modelName", file.stem)
    root.set("guid", PLACEHOLDER)
    root.set("generationTool", f"uav-twin with {root.get('generationTool')}")
    root.attrib.pop("generationDateAndTime", None)
    interface = root.find("CoSimulation")
    assert interface is not None
    interface.set("modelIdentifier", identifier)
    units: Mapping[str, Mapping[str, Any]] = getattr(model, "unit_table", {})
    table: Mapping[str, tuple[Any, ...]] = getattr(model, "variable_table", {})
    if units:
        root.insert(list(root).index(interface) + 1, _unit_definitions(file, units))
    variables = root.find("ModelVariables")
    assert variables is not None
    _add_ranges(file, variables, table, units)
    structure = root.find("ModelStructure")
    assert structure is not None
    unknowns = SubElement(structure, "InitialUnknowns")
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
            raise FmuBuildError(
                f"The unit {name} of {file} has the entry {unknown[0]}: give exponents of "
                f"{', '.join(BASE_UNITS)}, and factor, offset or displays."
            )
        unit = SubElement(definitions, "Unit", name=name)
        base = {symbol: str(int(entry[symbol])) for symbol in BASE_UNITS if symbol in entry}
        base |= {key: repr(float(entry[key])) for key in ("factor", "offset") if key in entry}
        SubElement(unit, "BaseUnit", base)
        for display, factor in entry.get("displays", {}).items():
            SubElement(unit, "DisplayUnit", name=display, factor=repr(float(factor)))
    return definitions


def _add_ranges(
    file: Path, variables: Iterable[Element], table: Mapping[str, tuple[Any, ...]], units: Mapping[str, Any]
) -> None:
    remaining = dict(table)
    for variable in variables:
        name = str(variable.get("name"))
        row = remaining.pop(name, None)
        if row is None:
            continue
        _, unit, low, high, _, _ = row
        if unit is not None and unit not in units:
            raise FmuBuildError(f"{file} gives {name} in {unit}, which its unit_table does not have.")
        inner = variable[0]
        for key, value in (("unit", unit), ("min", low), ("max", high)):
            if value is not None:
                inner.set(key, value if isinstance(value, str) else repr(float(value)))
    if remaining:
        raise FmuBuildError(
            f"The variable_table of {file} has {', '.join(remaining)}, which the model does not register."
        )
