"""An FMU file from outside: sound, safe to extract, of a kind that can be flown, and what it declares."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from fmpy import platform as fmi_platform
from fmpy import read_model_description, sharedLibraryExtension

from .errors import FmuFileError, FmuUnsupportedError

# A model FMU of hundreds of megabytes exists; one that unpacks to more than this is a mistake or an attack.
LARGEST_EXTRACTED_BYTES = 4 * 1024**3

_PLAIN_PATH = re.compile(r"[A-Za-z0-9/_.\-]+")


@dataclass(frozen=True)
class VariableInfo:
    """A variable as the FMU declares it.

    Attributes
    ----------
    name, description : str
        As declared.
    reference : int
        Value reference.
    kind : str
        FMI 2.0 base type: Real, Integer, Enumeration, Boolean or String.
    causality, variability : str
        As declared.
    unit, display_unit : str or None
        As declared, or by the declared type.
    minimum, maximum : float or None
        Declared range in `unit`.
    start : str or None
        Declared start value.
    """

    name: str
    reference: int
    kind: str
    causality: str
    variability: str
    description: str
    unit: str | None
    display_unit: str | None
    minimum: float | None
    maximum: float | None
    start: str | None


@dataclass(frozen=True)
class UnitInfo:
    """A unit as the FMU defines it: SI exponents (or None), factor and offset to SI, display units."""

    name: str
    exponents: tuple[int, ...] | None
    factor: float
    offset: float
    displays: tuple[tuple[str, float, float], ...]


@dataclass(frozen=True)
class FmuDescription:
    """What an FMU file is and declares; plain values only, so that it can be listed or sent.

    Attributes
    ----------
    path : Path
        The file.
    sha256 : str
        Hash of the file.
    file_size : int
        Bytes.
    fmi_version, model_name, model_identifier, guid, description, generation_tool : str
        As declared.
    platforms : tuple of str
        Folders of binaries, such as linux64.
    can_get_and_set_state, can_serialise_state, can_vary_step : bool
        Declared capabilities.
    variables : tuple of VariableInfo
        In the order of the model description.
    units : tuple of UnitInfo
        The unit definitions.
    """

    path: Path
    sha256: str
    file_size: int
    fmi_version: str
    model_name: str
    model_identifier: str
    guid: str
    description: str
    generation_tool: str
    platforms: tuple[str, ...]
    can_get_and_set_state: bool
    can_serialise_state: bool
    can_vary_step: bool
    variables: tuple[VariableInfo, ...]
    units: tuple[UnitInfo, ...]

    def variable(self, name: str) -> VariableInfo | None:
        """Return the variable of that name, or None."""
        return next((variable for variable in self.variables if variable.name == name), None)


def read_fmu(path: str | os.PathLike[str]) -> FmuDescription:
    """Check an FMU file and return what it declares, without extracting it.

    Parameters
    ----------
    path : path-like
        The FMU.

    Returns
    -------
    FmuDescription
        What it declares.

    Raises
    ------
    FmuFileError
        If the file is missing, no archive, damaged, unsafe, or its model description cannot be read.
    FmuUnsupportedError
        If it is not FMI 2.0 co-simulation or has no binary for this platform.
    """
    file = Path(path)
    content = _read(file)
    names = _check_archive(file)
    if "modelDescription.xml" not in names:
        raise FmuFileError(f"{file} is an archive without modelDescription.xml, so it is not an FMU.")
    version = _version(file)
    if not version.startswith("2."):
        raise FmuUnsupportedError(
            f"{file} is an FMU of FMI {version}; FMI 2.0 co-simulation is needed: export it as such."
        )
    try:
        declared = read_model_description(str(file), validate=False)
        variables = tuple(_variable(variable) for variable in declared.modelVariables)
        units = tuple(_unit(unit) for unit in declared.unitDefinitions)
    except Exception as error:
        raise FmuFileError(f"The model description of {file} cannot be read ({error}).") from error
    if declared.coSimulation is None:
        raise FmuUnsupportedError(
            f"{file} is a model-exchange FMU without co-simulation interface; export it for co-simulation."
        )
    identifier = str(declared.coSimulation.modelIdentifier)
    platforms = tuple(
        sorted({PurePosixPath(name).parts[1] for name in names if re.match(r"binaries/[^/]+/.+", name)})
    )
    binary = f"binaries/{fmi_platform}/{identifier}{sharedLibraryExtension}"
    if binary not in names:
        there = ", ".join(platforms) or "none"
        raise FmuUnsupportedError(
            f"{file} has no binary for this platform ({binary} is not in it; binaries there: {there}); "
            f"export it for {fmi_platform}."
        )
    return FmuDescription(
        path=file,
        sha256=hashlib.sha256(content).hexdigest(),
        file_size=len(content),
        fmi_version=version,
        model_name=str(declared.modelName),
        model_identifier=identifier,
        guid=str(declared.guid),
        description=str(declared.description or ""),
        generation_tool=str(declared.generationTool or ""),
        platforms=platforms,
        can_get_and_set_state=bool(declared.coSimulation.canGetAndSetFMUstate),
        can_serialise_state=bool(declared.coSimulation.canSerializeFMUstate),
        can_vary_step=bool(declared.coSimulation.canHandleVariableCommunicationStepSize),
        variables=variables,
        units=units,
    )


def extract_fmu(description: FmuDescription) -> Path:
    """Extract an FMU that `read_fmu` has checked into a new folder with a plain ASCII path.

    Parameters
    ----------
    description : FmuDescription
        The FMU; the file must not have changed since it was read.

    Returns
    -------
    Path
        The folder; the caller removes it.

    Raises
    ------
    FmuFileError
        If the file has changed, cannot be extracted, or no folder with a plain path can be made.
    """
    if hashlib.sha256(_read(description.path)).hexdigest() != description.sha256:
        raise FmuFileError(f"{description.path} has changed since it was checked; start again.")
    folder = plain_folder()
    try:
        with zipfile.ZipFile(description.path) as archive:
            archive.extractall(folder)
    except (OSError, zipfile.BadZipFile, zlib.error) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise FmuFileError(f"{description.path} could not be extracted to {folder} ({error}).") from error
    return folder


def plain_folder() -> Path:
    """Return a new private folder whose path has ASCII letters, digits and `/_.-` only.

    Other characters in the path crash some FMUs (pythonfmu's decode nothing but `%20`).

    Raises
    ------
    FmuFileError
        If no such folder can be made.
    """
    candidates = [tempfile.gettempdir(), "/tmp", "/var/tmp", "/dev/shm"]
    for parent in candidates:
        path = Path(parent)
        if _PLAIN_PATH.fullmatch(str(path.absolute())) and path.is_dir() and os.access(path, os.W_OK):
            return Path(tempfile.mkdtemp(prefix="uav-twin-fmu-", dir=path)).absolute()
    raise FmuFileError(
        f"FMUs need a writable folder for temporary files with a plain ASCII path, but none of "
        f"{', '.join(candidates)} is one; set TMPDIR."
    )


def _read(file: Path) -> bytes:
    if not file.exists():
        raise FmuFileError(f"There is no FMU {file}; check the path, or build it with `uav-twin fmu build`.")
    if not file.is_file():
        raise FmuFileError(f"{file} is a folder, not an FMU file.")
    try:
        return file.read_bytes()
    except OSError as error:
        raise FmuFileError(f"{file} cannot be read ({error.strerror}).") from error


def _check_archive(file: Path) -> set[str]:
    """Check structure, checksums, names and sizes of the archive; return the names of its files."""
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            for entry in entries:
                _check_entry(file, entry)
            if sum(entry.file_size for entry in entries) > LARGEST_EXTRACTED_BYTES:
                raise FmuFileError(
                    f"{file} would extract to more than {LARGEST_EXTRACTED_BYTES // 1024**3} GiB."
                )
            broken = archive.testzip()
            if broken is not None:
                raise FmuFileError(f"{file} is damaged: the checksum of {broken} is wrong; fetch it again.")
            return {entry.filename for entry in entries if not entry.is_dir()}
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, OSError) as error:
        raise FmuFileError(
            f"{file} is not a sound FMU archive ({error}); fetch or build it again."
        ) from error


def _check_entry(file: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename
    parts = PurePosixPath(name).parts
    mode = entry.external_attr >> 16
    if (
        not name
        or "\\" in name
        or ":" in name
        or "\0" in name
        or name.startswith("/")
        or ".." in parts
        or stat.S_ISLNK(mode)
    ):
        raise FmuFileError(
            f"{file} holds the entry {name!r}, which would be extracted outside its folder; it was refused."
        )


def _version(file: Path) -> str:
    with zipfile.ZipFile(file) as archive:
        text = archive.read("modelDescription.xml")
    found = re.search(rb"<fmiModelDescription\b[^>]*?\bfmiVersion\s*=\s*[\"']([^\"']*)[\"']", text, re.DOTALL)
    if found is None:
        raise FmuFileError(f"The model description of {file} does not say its FMI version; it is damaged.")
    return found.group(1).decode("utf-8", "replace")


def _variable(declared: Any) -> VariableInfo:
    declared_type = declared.declaredType

    def of(attribute: str) -> Any:
        value = getattr(declared, attribute)
        return (
            getattr(declared_type, attribute, None) if value is None and declared_type is not None else value
        )

    return VariableInfo(
        name=str(declared.name),
        reference=int(declared.valueReference),
        kind=str(declared.type),
        causality=str(declared.causality or "local"),
        variability=str(declared.variability or "continuous"),
        description=str(declared.description or ""),
        unit=of("unit"),
        display_unit=of("displayUnit"),
        minimum=None if of("min") is None else float(of("min")),
        maximum=None if of("max") is None else float(of("max")),
        start=None if declared.start is None else str(declared.start),
    )


def _unit(declared: Any) -> UnitInfo:
    base = declared.baseUnit
    exponents = (
        None
        if base is None
        else tuple(int(getattr(base, symbol)) for symbol in ("kg", "m", "s", "A", "K", "mol", "cd", "rad"))
    )
    return UnitInfo(
        name=str(declared.name),
        exponents=exponents,
        factor=1.0 if base is None else float(base.factor),
        offset=0.0 if base is None else float(base.offset),
        displays=tuple((str(d.name), float(d.factor), float(d.offset)) for d in declared.displayUnits),
    )


def describe_fmu(description: FmuDescription, roles: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return an FMU's description as plain records, with the role of each variable if known.

    Parameters
    ----------
    description : FmuDescription
        As `read_fmu` returns it.
    roles : mapping of str to str, optional
        Role by variable name.

    Returns
    -------
    dict
        Plain values, JSON-serialisable.
    """
    record = asdict(description)
    record["path"] = str(description.path)
    record["platforms"] = list(description.platforms)
    record["units"] = [asdict(unit) for unit in description.units]
    record["variables"] = [
        asdict(variable) | {"role": (roles or {}).get(variable.name, "")}
        for variable in description.variables
    ]
    return record
