"""An FMU file from outside: sound, safe to extract, of a kind that can be flown, and what it declares."""

import json
import lzma
import os
import re
import shutil
import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from xml.etree.ElementTree import Element, ParseError, TreeBuilder, XMLParser

from fmpy import platform as fmi_platform
from fmpy import platform_tuple, read_model_description, sharedLibraryExtension

from fmu_asset.errors import FmuFileError, FmuUnsupportedError, said
from fmu_asset.folders import plain_folder, remove_folder
from fmu_asset.instances.plan import Interface
from reporting.files import hash_file
from reporting.words import one_line

from .declared import FmuDescription, read_declared

# A model FMU of hundreds of megabytes exists; one that unpacks to more than this is a mistake or an attack.
LARGEST_EXTRACTED_BYTES = 4 * 1024**3
_LARGEST_RATIO = 200
_SMALL_ENOUGH = 256 * 1024**2
_MOST_ENTRIES = 100_000
_DEEPEST = 100
DESIGN_RECORD = "design.json"
"""Name of the file in the folder `resources` that says of which design an FMU of ours was made."""
_LONGEST_RECORD = 10_000
_LARGEST_DESCRIPTION = 256 * 1024**2
_DOTTED = (
    "FMI has the names of entries without './' in front. Pack it again, such as by `zip -r model.fmu *` in "
    "its folder."
)
_UNREADABLE = (OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError)

# A hyphen is none of C, but tools put one there, and the folder of the binary has no harm of it.
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")


def read_fmu(path: str | os.PathLike[str], interface: Interface | None = None) -> FmuDescription:
    """Check an FMU file and return what it declares, without extracting it.

    Parameters and errors are those of `inspect_fmu`.

    Raises
    ------
    FmuUnsupportedError
        Also if it has no binary for this platform.
    """
    description, obstacle = inspect_fmu(path, interface)
    if obstacle:
        raise FmuUnsupportedError(obstacle)
    return description


def inspect_fmu(
    path: str | os.PathLike[str], interface: Interface | None = None
) -> tuple[FmuDescription, str]:
    """Check an FMU file of any platform; return what it declares, and why it cannot be flown here.

    Parameters
    ----------
    path : path-like
        The FMU.
    interface : {"co-simulation", "model-exchange"}, optional
        How it is to be run; co-simulation where it offers that.

    Returns
    -------
    tuple of FmuDescription and str
        The sentence is empty where there is a binary for this platform.

    Raises
    ------
    FmuFileError
        If the file is missing, no archive, damaged, unsafe, or its model description cannot be read.
    FmuUnsupportedError
        If it is not of FMI 1, 2 or 3, or offers neither co-simulation nor model exchange (or not the one that
        is asked for).
    """
    file = Path(path)
    size, sha256 = _size_and_hash(file)
    names = check_archive(file, size)
    if "modelDescription.xml" not in names:
        raise FmuFileError(_without_description(file, names))
    root = _model_description(file)
    version = root.get("fmiVersion") or ""
    if version not in ("1.0", "2.0") and not version.startswith("3."):
        raise FmuUnsupportedError(said("archive.fmi_version", file=file, version=version or "(not said)"))
    try:
        declared = read_model_description(str(file), validate=False)
        platforms = tuple(
            sorted({PurePosixPath(name).parts[1] for name in names if re.match(r"binaries/[^/]+/.+", name)})
        )
        archive = {"path": file, "sha256": sha256, "file_size": size, "platforms": platforms}
        description = read_declared(declared, root, archive, interface)
    except FmuUnsupportedError:
        raise
    except Exception as error:
        raise FmuFileError(f"The model description of {file} cannot be read ({one_line(error)}).") from error
    if not _IDENTIFIER.fullmatch(description.model_identifier):
        raise FmuFileError(said("archive.identifier", file=file, description=description))
    here = platform_tuple if description.major_version == 3 else fmi_platform
    binary = f"binaries/{here}/{description.model_identifier}{sharedLibraryExtension}"
    if binary in names:
        return description, ""
    return description, _without_binary(file, names, binary, platforms)


def _without_description(file: Path, names: set[str]) -> str:
    """Return the sentence on an archive in which modelDescription.xml is not where FMI has it."""
    lacking = f"{file} is an archive without modelDescription.xml"
    if "./modelDescription.xml" in names:
        return f"{lacking}, but with './modelDescription.xml': {_DOTTED}"
    nested = sorted(name for name in names if name.endswith("/modelDescription.xml"))
    if nested:
        return f"{lacking} at its top: it has {nested[0]!r}. Pack the content of that folder, not the folder."
    return f"{lacking}, so it is not an FMU."


def _without_binary(file: Path, names: set[str], binary: str, platforms: tuple[str, ...]) -> str:
    """Return the sentence on an FMU whose binary for this platform is not where FMI has it."""
    if f"./{binary}" in names:
        return f"{file} has no binary {binary}, but one named './{binary}': {_DOTTED}"
    folder, _, _ = binary.rpartition("/")
    suffix = PurePosixPath(binary).suffix
    others = sorted(n for n in names if n.rpartition("/")[0] == folder and n.endswith(suffix))
    if others:
        return (
            f"{file} has the binary {', '.join(others[:3])}, but its model description asks for {binary}: "
            "the name must be its `modelIdentifier`. Rename the binary, or export the FMU again."
        )
    here = PurePosixPath(folder).name
    return (
        f"{file} has no binary for this platform ({binary} is not in it; binaries there: "
        f"{', '.join(platforms) or 'none'}); export it for {here}."
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
    if _size_and_hash(description.path)[1] != description.sha256:
        raise FmuFileError(f"{description.label} has changed since it was checked; start again.")
    folder = plain_folder()
    try:
        with zipfile.ZipFile(description.path) as archive:
            needed = sum(entry.file_size for entry in archive.infolist())
            free = shutil.disk_usage(folder).free
            if needed > free:
                raise OSError(f"it needs {needed // 1024**2} MiB, and {free // 1024**2} MiB are free")
            archive.extractall(folder)
    except _UNREADABLE as error:
        remove_folder(folder)
        raise FmuFileError(f"{description.label} could not be extracted to {folder} ({error}).") from error
    return folder


def _size_and_hash(file: Path) -> tuple[int, str]:
    if not file.exists():
        raise FmuFileError(said("archive.absent", file=file))
    if not file.is_file():
        raise FmuFileError(f"{file} is a folder, not an FMU file.")
    try:
        return file.stat().st_size, hash_file(file)
    except OSError as error:
        raise FmuFileError(f"{file} cannot be read ({error.strerror}).") from error


def check_archive(file: Path, size: int, what: str = "FMU", again: str = "build") -> set[str]:
    """Check structure, checksums, names and sizes of an archive; return the names of its files.

    Raises
    ------
    FmuFileError
        If it is damaged or unsafe; the sentence says `what` it should be and how to get it `again`.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            for entry in entries:
                _check_entry(file, entry)
            names = [entry.filename for entry in entries if not entry.is_dir()]
            if len(entries) > _MOST_ENTRIES:
                raise FmuFileError(said("archive.entries", file=file, count=len(entries), most=_MOST_ENTRIES))
            extracted = sum(entry.file_size for entry in entries)
            if extracted > min(LARGEST_EXTRACTED_BYTES, max(_SMALL_ENOUGH, _LARGEST_RATIO * size)):
                mebibytes = size / 1024**2, extracted / 1024**2
                raise FmuFileError(said("archive.too_large", file=file, mebibytes=mebibytes))
            broken = archive.testzip()
            if broken is not None:
                raise FmuFileError(f"{file} is damaged: the checksum of {broken} is wrong; fetch it again.")
            _refuse_unequal_twins(file, archive)
            return {*names}
    except (*_UNREADABLE, EOFError, NotImplementedError, RuntimeError) as error:
        raise FmuFileError(said("archive.unsound", file=file, what=what, error=error, again=again)) from error


def _refuse_unequal_twins(file: Path, archive: zipfile.ZipFile) -> None:
    """Refuse two entries of one name unless they are equal: readers differ in which one they take."""
    first: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        twin = first.setdefault(entry.filename, entry)
        if twin is entry:
            continue
        equal = (twin.CRC, twin.file_size) == (entry.CRC, entry.file_size)
        if not equal or archive.read(twin) != archive.read(entry):
            raise FmuFileError(said("archive.twice", file=file, entry=entry))


def _check_entry(file: Path, entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename
    slashed = name.replace("\\", "/")
    parts = PurePosixPath(slashed).parts
    outside = not name or slashed.startswith("/") or ".." in parts or not {*name}.isdisjoint(":\0")
    if outside or stat.S_ISLNK(entry.external_attr >> 16):
        raise FmuFileError(said("archive.outside", file=file, name=name))
    if "\\" in name:
        raise FmuFileError(
            f"{file} holds the entry {name!r}, whose folders are separated by backslashes; ZIP files "
            "separate them by '/' on every system (some packers on Windows do not). Pack it again with "
            "another tool."
        )
    if len(parts) > _DEEPEST:
        raise FmuFileError(said("archive.deep", file=file, deep=len(parts), most=_DEEPEST))


class _WithoutDocumentType(TreeBuilder):
    """Elements of a file in any encoding, up to a document type, before its entities are defined."""

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise FmuFileError(said("archive.document_type"))


def _model_description(file: Path) -> Element:
    """Return the XML of the model description, which must not define entities that grow or read files."""
    try:
        with zipfile.ZipFile(file) as archive:
            if archive.getinfo("modelDescription.xml").file_size > _LARGEST_DESCRIPTION:
                raise FmuFileError(f"is larger than {_LARGEST_DESCRIPTION // 1024**2} MiB; it was refused")
            parser = XMLParser(target=_WithoutDocumentType())
            parser.feed(archive.read("modelDescription.xml"))
        root: Element = parser.close()
        if root.tag != "fmiModelDescription":
            raise FmuFileError(f"begins with <{root.tag}>; it is damaged")
    except (ParseError, ValueError, LookupError, zipfile.BadZipFile, OSError) as error:
        why = error.sentence if isinstance(error, FmuFileError) else f"cannot be read ({error})"
        raise FmuFileError(f"The model description of {file} {why}.") from error
    return root


def design_record(design_hash: str) -> bytes:
    """Return the content of the file."""
    return (json.dumps({"design_hash": design_hash}) + "\n").encode()


def packed_design_hash(path: str | os.PathLike[str]) -> str:
    """Return the hash of the design that an FMU was made of; empty where it does not tell."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"resources/{DESIGN_RECORD}") as file:
            found = json.loads(file.read(_LONGEST_RECORD))["design_hash"]
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, zipfile.BadZipFile):
        return ""
    return found if isinstance(found, str) else ""
