"""Packs a script for pythonfmu as an FMU.

pythonfmu's own builder takes the same scripts, but it leaves out units and ranges, and adds the
time and a random GUID, so that no two builds are equal. Here equal scripts give equal bytes. A
script may declare more in two optional class attributes:

- `unit_table`: for each unit its exponents of the base units `kg, m, s, A, K, mol, cd, rad`, the
  `factor` and `offset` of the conversion to them (1 and 0 by default), and `displays`, the factors
  of display units;
- `variable_table`: for each variable a tuple of its causality, unit, minimum, maximum and start
  value (each may be None), and meaning.

The script is run once in this process, since only an instance of its model knows the variables.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from runpy import run_path
from typing import TYPE_CHECKING, Any, TypeAlias
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmu_asset.description import PLACEHOLDER, rendered
from fmu_asset.errors import FmuBuildError
from reporting.text_file import read_bytes
from reporting.units import BASE_UNITS
from reporting.words import comma_list

from .contents import (
    BASE_CLASS_FILES,
    FmuInfo,
    SealedFmu,
    checked_target,
    pythonfmu_members,
    pythonfmu_version,
    seal_fmu,
    write_fmu,
)

if TYPE_CHECKING:
    from pythonfmu import Fmi2Slave

UnitTable: TypeAlias = Mapping[str, Mapping[str, Any]]
"""The `unit_table` of a script: exponents, factor, offset and displays of each unit, unchecked."""
_Limit: TypeAlias = str | float | None
_VariableEntry: TypeAlias = tuple[object, str | None, _Limit, _Limit, object, object]
"""An entry of a `variable_table`; its unit and its range stand after the first value."""


def build_script_fmu(
    script: str | os.PathLike[str], path: str | os.PathLike[str], *, replace: bool = False
) -> FmuInfo:
    """Pack a script as an FMI 2.0 co-simulation FMU; equal scripts give equal bytes.

    Parameters
    ----------
    script : path-like
        A Python file with one subclass of pythonfmu's `Fmi2Slave`. It may use the standard library
        and the packages that are installed on the machine that runs the FMU.
    path : path-like
        The file to write, with the suffix .fmu.

    Raises
    ------
    FmuBuildError
        If the file exists, the suffix is wrong, or the script cannot be packed.
    """
    target = checked_target(path, replace=replace)
    return write_fmu(target, script_fmu(script))


def script_fmu(script: str | os.PathLike[str]) -> SealedFmu:
    """Pack a script as an FMU, and return the bytes and the GUID; see `build_script_fmu`."""
    file = Path(script)
    if not file.stem.isidentifier() or file.suffix != ".py":
        raise FmuBuildError(
            "A model script must be a Python file whose name is an identifier, such as "
            f"gear_pump.py, and {file} was given."
        )
    source = read_bytes(file, FmuBuildError, what="model script")
    pythonfmu_version()  # refuses another version
    model_class = _model_class(file)
    module = f"{file.stem}_{PLACEHOLDER}"
    runtime = f"resources/{module}_runtime"
    members = {
        "modelDescription.xml": _script_description(file, model_class, module),
        f"resources/{module}.py": rendered(
            "script.py", module=module, name=model_class.__name__, tag=PLACEHOLDER
        ),
        f"{runtime}/__init__.py": rendered("script_runtime.py"),
        f"{runtime}/model.py": source,
    }
    names = ("__init__.py", "builder.py", "osutil.py", *BASE_CLASS_FILES)
    members |= pythonfmu_members(module, "resources/pythonfmu", names)
    return seal_fmu(members)


def _model_class(file: Path) -> "type[Fmi2Slave]":
    """Run a script and return the only slave class that it defines."""
    from pythonfmu import Fmi2Slave

    module_name = f"_uav_twin_script_{file.stem}"
    try:
        # run_path writes no byte code beside the user's script
        script_globals = run_path(str(file), run_name=module_name)
    except Exception as error:  # the script is the user's
        raise FmuBuildError(f"The model script {file} cannot be run: {error!r}.") from error
    slaves: list[type[Fmi2Slave]] = []
    for value in script_globals.values():
        is_slave = isinstance(value, type) and issubclass(value, Fmi2Slave)
        if is_slave and value.__module__ == module_name:
            slaves.append(value)
    if len(slaves) != 1:
        names = comma_list(slave.__name__ for slave in slaves)
        raise FmuBuildError(
            f"The model script {file} must define one subclass of pythonfmu's Fmi2Slave, and it "
            f"defines {names}."
        )
    return slaves[0]


def _script_description(file: Path, model_class: "type[Fmi2Slave]", identifier: str) -> bytes:
    """Return the model description of a script's FMU as XML.

    pythonfmu writes it. Units, ranges and initial unknowns are added, and the time of the build is
    removed, so that equal scripts give equal bytes. `identifier` is the model identifier.
    """
    try:
        model = model_class(instance_name="description", resources=str(file.parent))
        root: Element = model.to_xml()
    except Exception as error:  # the script is the user's
        raise FmuBuildError(
            f"{model_class.__name__} of {file} cannot be instantiated: {error!r}."
        ) from error
    tool = f"uav-twin with {root.get('generationTool')}"
    root.attrib.update(modelName=file.stem, guid=PLACEHOLDER, generationTool=tool)
    root.attrib.pop("generationDateAndTime", None)
    # units, which the standard requires after the interface
    interface = _required_child(root, "CoSimulation")
    interface.set("modelIdentifier", identifier)
    units: UnitTable = getattr(model_class, "unit_table", {})
    if units:
        after_interface = list(root).index(interface) + 1
        root.insert(after_interface, _unit_definitions(file, units))
    # ranges of the variables, and the outputs as initial unknowns
    variables = _required_child(root, "ModelVariables")
    variable_table = getattr(model_class, "variable_table", {})
    _set_units_and_ranges(file, variables, variable_table, units)
    unknowns = SubElement(_required_child(root, "ModelStructure"), "InitialUnknowns")
    for index, variable in enumerate(variables, start=1):
        if variable.get("causality") == "output":
            SubElement(unknowns, "Unknown", index=str(index))
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def _required_child(root: Element, name: str) -> Element:
    """Return a child element that every model description by pythonfmu contains."""
    child = root.find(name)
    assert child is not None
    return child


def _unit_definitions(file: Path, units: UnitTable) -> Element:
    """Return the XML element `UnitDefinitions` with the units of a script's `unit_table`."""
    known_keys = {*BASE_UNITS, "factor", "offset", "displays"}
    definitions = Element("UnitDefinitions")
    for name, entry in units.items():
        unknown_keys = sorted(set(entry) - known_keys)
        if unknown_keys:
            raise FmuBuildError(
                f"The unit {name} of {file} has the entry {unknown_keys[0]}: give exponents of "
                f"{comma_list(BASE_UNITS)}, and factor, offset or displays."
            )
        unit = SubElement(definitions, "Unit", name=name)
        base = {symbol: str(int(entry[symbol])) for symbol in BASE_UNITS if symbol in entry}
        for key in ("factor", "offset"):
            if key in entry:
                base[key] = repr(float(entry[key]))
        SubElement(unit, "BaseUnit", base)
        for display, factor in entry.get("displays", {}).items():
            SubElement(unit, "DisplayUnit", name=display, factor=repr(float(factor)))
    return definitions


def _set_units_and_ranges(
    file: Path,
    variables: Element,
    table: Mapping[str, _VariableEntry],
    units: UnitTable,
) -> None:
    """Add units and ranges from a script's tables to its `ModelVariables` element, in place."""
    # The first child of a variable's element is that of its type, such as `Real`.
    type_elements = {str(variable.get("name")): variable[0] for variable in variables}
    for name, (_, unit, low, high, _, _) in table.items():
        if name not in type_elements:
            raise FmuBuildError(
                f"The variable_table of {file} has {name}, which the model does not register."
            )
        if unit is not None and unit not in units:
            raise FmuBuildError(
                f"{file} gives {name} in {unit}, which its unit_table does not have."
            )
        element = type_elements[name]
        if unit is not None:
            element.set("unit", unit)
        if low is not None:
            element.set("min", _attribute_text(low))
        if high is not None:
            element.set("max", _attribute_text(high))


def _attribute_text(value: str | float) -> str:
    """Return a limit of a variable as an XML attribute, a float with all its digits."""
    return value if isinstance(value, str) else repr(float(value))
