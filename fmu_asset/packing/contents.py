"""What all FMUs that are built here have in common, and packing one of a Python script for pythonfmu.

The files of an FMU are first written with a placeholder wherever its content hash will stand (identifier,
GUID, module names). The hash is taken over them, and then fills the places.

pythonfmu's own builder takes the same scripts, but leaves out units and ranges, and stamps a time and a
random GUID, so that no two builds are alike. Here equal scripts give equal bytes. A script may say more in
two class attributes, both optional:

- `unit_table`: for each unit its exponents of `kg, m, s, A, K, mol, cd, rad`, a `factor` and an `offset` to
  them (1 and 0 by default), and `displays`, the factors of display units;
- `variable_table`: for each variable causality, unit, least, largest and start value (or None), and meaning.

The script runs once in this process, to be asked for its variables.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.resources import files
from pathlib import Path
from runpy import run_path
from typing import Any
from uuid import UUID
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fe.runtime.arrays import archive_bytes
from fmu_asset.description import PLACEHOLDER, Declaration, description_members, rendered
from fmu_asset.errors import FmuBuildError, FmuError, said
from fmu_asset.slaves.variables import FmuVariable
from reporting.files import atomic_write_bytes, hash_members, read_members
from reporting.text_file import read_bytes
from reporting.units import BASE_UNITS

PYTHONFMU_VERSION = "0.7.0"
"""The only version whose wrapper these FMUs were tried with; its conventions are not a public interface."""

BASE_CLASS_FILES = (
    "_version.py", "default_experiment.py", "enums.py", "fmi2slave.py", "logmsg.py", "variables.py",
)  # fmt: skip
"""Files of pythonfmu that its base class needs."""
_TEXT_SUFFIXES = (".py", ".xml", ".txt", ".html", ".json", ".c", ".h")
# Where the GUID itself stands, between these two; elsewhere the placeholder stands for the tag.
_GUID_PLACES = {
    "modelDescription.xml": ('guid="{}"', 'instantiationToken="{}"'),
    "sources/structure_variables.h": ('STRUCTURE_GUID "{}"',),
}


@dataclass(frozen=True)
class FmuInfo:
    """An FMU that was built.

    Attributes
    ----------
    path : Path
        The file.
    guid : str
        GUID, from the content hash.
    design_hash : str
        Hash of the design that made the reduced model; empty where there is none.
    size : int
        Bytes of the file.
    """

    path: Path
    guid: str
    design_hash: str
    size: int


def checked_target(
    path: str | os.PathLike[str],
    *,
    replace: bool,
    what: str = "An FMU",
    suffix: str = ".fmu",
    error: type[FmuError] = FmuBuildError,
) -> Path:
    """Return where an FMU, or something else with a suffix of its own, may be written.

    Raises
    ------
    error
        If the suffix is wrong, or the file exists and may not be replaced.
    """
    target = Path(path)
    if target.suffix != suffix:
        raise error(f"{what} must have the suffix {suffix}, but {target} was given.")
    if target.exists() and not replace:
        raise error(said("packing.exists", target=target))
    return target


def write_fmu(target: Path, packed: tuple[bytes, str], design_hash: str = "") -> FmuInfo:
    """Write what `sealed` returned, whole or not at all, and say what it is."""
    content, guid = packed
    atomic_write_bytes(target, content)
    return FmuInfo(target, guid, design_hash, len(content))


def check_start(table: Iterable[FmuVariable]) -> None:
    """Refuse start values outside their ranges; raises `FmuBuildError`."""
    for row in table:
        low = -float("inf") if row.minimum is None else row.minimum
        high = float("inf") if row.maximum is None else row.maximum
        if row.start is not None and not low <= row.start <= high:
            advice = "the reduced model; give another state or build a model with a wider range"
            if row.variability == "tunable":
                advice = "that number of an effect; correct the patch"
            raise FmuBuildError(said("packing.start", row=row, low=low, high=high, advice=advice))


# ---------------------------------------------------------------- pythonfmu


def pythonfmu_version() -> str:
    """Return the version of pythonfmu that is installed.

    Raises
    ------
    FmuBuildError
        If there is none, or another one than `PYTHONFMU_VERSION`.
    """
    try:
        installed = version("pythonfmu")
    except PackageNotFoundError:
        installed = "none"
    if installed != PYTHONFMU_VERSION:
        raise FmuBuildError(said("packing.pythonfmu", needed=PYTHONFMU_VERSION, installed=installed))
    return installed


def pythonfmu_members(module: str, folder: str, names: Iterable[str]) -> dict[str, bytes]:
    """Return the files that pythonfmu gives to an FMU, by their places in the archive.

    Parameters
    ----------
    module : str
        The FMU's identifier, also the name of its binaries and of the script that they load.
    folder : str
        Where the Python files go.
    names : iterable of str
        Python files that are needed.

    Raises
    ------
    FmuBuildError
        If a file is missing from the installation.
    """
    # As installed, not as imported: an FMU in this process may have brought a pythonfmu of its own.
    wrapper = Path(str(distribution("pythonfmu").locate_file("pythonfmu")))
    binaries = wrapper / "resources" / "binaries"
    return {
        f"binaries/linux64/{module}.so": (binaries / "linux64/libpythonfmu-export.so").read_bytes(),
        f"binaries/win64/{module}.dll": (binaries / "win64/pythonfmu-export.dll").read_bytes(),
        "documentation/licenses/pythonfmu.txt": _licence("pythonfmu"),
        "resources/slavemodule.txt": module.encode(),
        **{f"{folder}/{name}": (wrapper / name).read_bytes() for name in names},
    }


def room_members(room: str, folder: str) -> dict[str, bytes]:
    """Return all Python files of a room of the project, by their places in the archive.

    Parameters
    ----------
    room : str
        A package that imports nothing of the project but itself, rooms packed beside it by `..`, and
        `fe.runtime`, which is packed beside it as `fe`.
    folder : str
        Where it goes.
    """
    members = read_members(Path(str(files(room))), [".py"])
    return {
        f"{folder}/{name}": content.replace(b"from fe.runtime", b"from ..fe")
        for name, content in members.items()
    }


def _licence(package: str) -> bytes:
    found = [entry for entry in distribution(package).files or () if entry.name == "LICENSE"]
    if not found:
        raise FmuBuildError(f"The licence of {package} is missing from its installation; install it again.")
    return Path(str(found[0].locate())).read_bytes()


def python_members(
    declared: Declaration,
    class_name: str,
    *,
    imports: str,
    resources: Mapping[str, bytes],
    host: str = "It runs in a Python host that has NumPy.",
) -> dict[str, bytes]:
    """Return the files of the archive, with the placeholder wherever the content hash will stand.

    Parameters
    ----------
    declared : Declaration
        The model.
    class_name : str
        Of the class in the FMU's script, to which the tag is added.
    imports : str
        Lines that import `load_contents` into the runtime's package.
    resources : mapping of str to bytes
        What `load_contents` reads, by its names.
    host : str
        What the FMU runs in, for its documentation.
    """
    module = declared.identifier
    runtime = f"resources/{module}_runtime"
    names = {"module": module, "class_name": f"{class_name}{PLACEHOLDER}", "tag": PLACEHOLDER}
    tool = f"uav-twin with PythonFMU {pythonfmu_version()}"
    return {
        **description_members(declared, generation_tool=tool, host=host),
        **{f"resources/{file}": content for file, content in resources.items()},
        f"resources/{module}.py": rendered("slave.py", **names),
        f"{runtime}/__init__.py": b'"""An FMU of uav-twin."""\n',
        f"{runtime}/entry.py": rendered("entry.py", imports=imports),
        f"{runtime}/pythonfmu/__init__.py": b'"""The base class of pythonfmu."""\n',
        **room_members("fmu_asset.slaves", f"{runtime}/slaves"),
        **pythonfmu_members(module, f"{runtime}/pythonfmu", BASE_CLASS_FILES),
    }


# ---------------------------------------------------------------- content hash


def guid_of(content_hash: str) -> str:
    """Return the GUID that a content hash gives."""
    return f"{{{UUID(content_hash[:32])}}}"


def sealed(
    template: Mapping[str, bytes], binaries: Callable[[dict[str, bytes], str], dict[str, bytes]] | None = None
) -> tuple[bytes, str]:
    """Return the archive of the files, tag and GUID in the place of the placeholder, and the GUID.

    The hash is over names and contents, the placeholder standing for the hash itself.

    Parameters
    ----------
    template : mapping of str to bytes
        The files, by name.
    binaries : callable, optional
        Makes further files of these and of the tag; they are not part of the hash.
    """
    content_hash = hash_members(template)
    tag, guid = content_hash[: len(PLACEHOLDER)], guid_of(content_hash)
    members = exchanged(template, (PLACEHOLDER, PLACEHOLDER), (tag, guid))
    further = {} if binaries is None else binaries(members, tag)
    return archive_bytes(members | further, "modelDescription.xml"), guid


def exchanged(members: Mapping[str, bytes], old: tuple[str, str], new: tuple[str, str]) -> dict[str, bytes]:
    """Return files with the new tag and GUID in the place of the old ones, in names and texts."""

    def text(name: str, data: bytes) -> bytes:
        if not name.endswith(_TEXT_SUFFIXES):
            return data
        for place in _GUID_PLACES.get(name, ()):
            data = data.replace(place.format(old[1]).encode(), place.format(new[1]).encode())
        return data.replace(old[0].encode(), new[0].encode())

    return {name.replace(old[0], new[0]): text(name, data) for name, data in members.items()}


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
    source = read_bytes(file, FmuBuildError, what="model script")
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
