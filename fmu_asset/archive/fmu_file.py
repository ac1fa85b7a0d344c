"""Checks FMU files from outside, reads what they declare, and extracts them.

An FMU is a ZIP archive with foreign code. Before any of it is written to disk or run, its
structure, names, sizes and checksums are checked, and its model description is read without
expanding entities.
"""

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

from fmu_asset.errors import FmuFileError, FmuUnsupportedError
from fmu_asset.folders import plain_folder, remove_folder
from fmu_asset.instances.plan import Interface
from reporting.files import hash_file
from reporting.words import one_line

from .declared import FmuDescription
from .model_description import FmuFileFacts, read_declared

LARGEST_EXTRACTED_BYTES = 4 * 1024**3
"""Largest size of the extracted files of an FMU [bytes]. FMUs of hundreds of megabytes exist."""

# An archive made to fill the disk ("zip bomb") has a far larger ratio than any real file.
_LARGEST_COMPRESSION_RATIO = 200
_ANY_RATIO_UP_TO_BYTES = 256 * 1024**2
_MOST_ENTRIES = 100_000
_MOST_FOLDER_LEVELS = 100

DESIGN_RECORD = "design.json"
"""The file in the folder `resources` of our FMUs that says which design they were made of."""

_LARGEST_DESIGN_RECORD_BYTES = 10_000
_LARGEST_DESCRIPTION_BYTES = 256 * 1024**2
_PACK_WITHOUT_DOT = (
    "FMI has the names of entries without './' in front. Pack it again, such as by `zip -r "
    "model.fmu *` in its folder."
)
_ARCHIVE_ERRORS = (OSError, zipfile.BadZipFile, zlib.error, lzma.LZMAError)

# C has no hyphen in its names, but some tools put one there, and it does no harm to the binary's
# folder.
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_-]*")


def read_fmu(path: str | os.PathLike[str], interface: Interface | None = None) -> FmuDescription:
    """Check an FMU file and return its declarations, without extracting it.

    Parameters
    ----------
    interface : {"co-simulation", "model-exchange"}, optional
        The interface to be used; by default co-simulation if the FMU offers it.

    Raises
    ------
    FmuFileError
        If the file is missing, no archive, damaged or unsafe, or its model description cannot be
        read.
    FmuUnsupportedError
        If the FMU is not of FMI 1, 2 or 3, does not offer the interface, or has no binary for this
        platform.
    """
    description, obstacle = inspect_fmu(path, interface)
    if obstacle:
        raise FmuUnsupportedError(obstacle)
    return description


def inspect_fmu(
    path: str | os.PathLike[str], interface: Interface | None = None
) -> tuple[FmuDescription, str]:
    """Check an FMU file and return its declarations, even if it has no binary for this platform.

    Parameters
    ----------
    interface : {"co-simulation", "model-exchange"}, optional
        The interface to be used; by default co-simulation if the FMU offers it.

    Returns
    -------
    obstacle : str
        Why it cannot run on this platform; empty if it can.

    Raises
    ------
    FmuFileError
        If the file is missing, no archive, damaged or unsafe, or its model description cannot be
        read.
    FmuUnsupportedError
        If the FMU is not of FMI 1, 2 or 3, or does not offer the interface.
    """
    file = Path(path)
    # the archive
    size, sha256 = _size_and_hash(file)
    entry_names = check_archive(file, size)
    if "modelDescription.xml" not in entry_names:
        raise FmuFileError(_missing_description_sentence(file, entry_names))
    # the model description: first safely by this module, then by fmpy
    root = _parsed_model_description(file)
    version = root.get("fmiVersion") or ""
    if version not in ("1.0", "2.0") and not version.startswith("3."):
        raise FmuUnsupportedError(
            f"{file} is an FMU of FMI {version or '(not said)'}; FMI 1.0, 2.0 or 3.0 is needed: "
            "export it as such."
        )
    platforms = _platforms(entry_names)
    try:
        declared = read_model_description(str(file), validate=False)
        facts = FmuFileFacts(path=file, sha256=sha256, file_size=size, platforms=platforms)
        description = read_declared(declared, root, facts, interface)
    except FmuUnsupportedError:
        raise
    except Exception as error:  # fmpy raises errors of many kinds
        raise FmuFileError(
            f"The model description of {file} cannot be read ({one_line(error)})."
        ) from error
    if not _IDENTIFIER.fullmatch(description.model_identifier):
        raise FmuFileError(
            f"The model identifier of {file}, {description.model_identifier!r}, is not a name of a "
            "C function; the FMU is damaged or unsafe."
        )
    # the binary for this platform; FMI 3 has other names of platforms than FMI 1 and 2
    platform_folder = platform_tuple if description.major_version == 3 else fmi_platform
    file_name = f"{description.model_identifier}{sharedLibraryExtension}"
    binary = f"binaries/{platform_folder}/{file_name}"
    if binary in entry_names:
        return description, ""
    return description, _missing_binary_sentence(file, entry_names, binary, platforms)


def _platforms(entry_names: set[str]) -> tuple[str, ...]:
    """Return the platforms for which an FMU has binaries, such as linux64."""
    platforms = set()
    for name in entry_names:
        if re.match(r"binaries/[^/]+/.+", name):
            platforms.add(PurePosixPath(name).parts[1])
    return tuple(sorted(platforms))


def _missing_description_sentence(file: Path, entry_names: set[str]) -> str:
    """Return the message about an archive without modelDescription.xml in its top folder."""
    lacking = f"{file} is an archive without modelDescription.xml"
    if "./modelDescription.xml" in entry_names:
        return f"{lacking}, but with './modelDescription.xml': {_PACK_WITHOUT_DOT}"
    nested = sorted(name for name in entry_names if name.endswith("/modelDescription.xml"))
    if nested:
        return (
            f"{lacking} at its top: it has {nested[0]!r}. Pack the content of that folder, not the "
            "folder."
        )
    return f"{lacking}, so it is not an FMU."


def _missing_binary_sentence(
    file: Path, entry_names: set[str], binary: str, platforms: tuple[str, ...]
) -> str:
    """Return the message about an FMU whose binary for this platform is missing or misnamed.

    `binary` is the expected name in the archive, `entry_names` are the names that it has, and
    `platforms` those for which it has a binary.
    """
    if f"./{binary}" in entry_names:
        return f"{file} has no binary {binary}, but one named './{binary}': {_PACK_WITHOUT_DOT}"
    path = PurePosixPath(binary)
    misnamed = []
    for name in sorted(entry_names):
        in_same_folder = name.rpartition("/")[0] == str(path.parent)
        if in_same_folder and name.endswith(path.suffix):
            misnamed.append(name)
    if misnamed:
        return (
            f"{file} has the binary {', '.join(misnamed[:3])}, but its model description asks for "
            f"{binary}: the name must be its `modelIdentifier`. Rename the binary, or export the "
            "FMU again."
        )
    return (
        f"{file} has no binary for this platform ({binary} is not in it; binaries there: "
        f"{', '.join(platforms) or 'none'}); export it for {path.parent.name}."
    )


def extract_fmu(description: FmuDescription) -> Path:
    """Extract an FMU that `read_fmu` has checked to a new folder with a plain ASCII path.

    Parameters
    ----------
    description : FmuDescription
        The result of `read_fmu`, since which the file must not have changed.

    Returns
    -------
    Path
        The folder, which the caller must remove.

    Raises
    ------
    FmuFileError
        If the file has changed, cannot be extracted, or no folder with a plain path can be made.
    """
    _, sha256 = _size_and_hash(description.path)
    if sha256 != description.sha256:
        raise FmuFileError(f"{description.label} has changed since it was checked; start again.")
    folder = plain_folder()
    try:
        with zipfile.ZipFile(description.path) as archive:
            needed_bytes = sum(entry.file_size for entry in archive.infolist())
            free_bytes = shutil.disk_usage(folder).free
            if needed_bytes > free_bytes:
                raise OSError(
                    f"it needs {needed_bytes // 1024**2} MiB, and {free_bytes // 1024**2} MiB are "
                    "free"
                )
            archive.extractall(folder)
    except _ARCHIVE_ERRORS as error:
        remove_folder(folder)
        raise FmuFileError(
            f"{description.label} could not be extracted to {folder} ({error})."
        ) from error
    return folder


def _size_and_hash(file: Path) -> tuple[int, str]:
    """Return the size in bytes and the SHA-256 of an FMU file."""
    if not file.exists():
        raise FmuFileError(
            f"There is no FMU {file}; check the path, or make it: `uav-twin fmu build` packs a "
            "wing or a script, `uav-twin structure fmu` a structure."
        )
    if not file.is_file():
        raise FmuFileError(f"{file} is a folder, not an FMU file.")
    try:
        return file.stat().st_size, hash_file(file)
    except OSError as error:
        raise FmuFileError(f"{file} cannot be read ({error.strerror}).") from error


def check_archive(
    file: Path, size: int, archive_kind: str = "FMU", remedy: str = "build"
) -> set[str]:
    """Check an archive's structure, checksums, names and sizes; return the names of its files.

    Parameters
    ----------
    archive_kind : str
        What the archive should be, for the message.
    remedy : str
        A verb for making the file again, for the message, such as "build".

    Returns
    -------
    set of str
        The names of the files in the archive, without its folders.

    Raises
    ------
    FmuFileError
        If the archive is damaged or unsafe.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entries = archive.infolist()
            for entry in entries:
                _check_entry_name(file, entry)
            _check_extracted_size(file, size, entries)
            broken_entry = archive.testzip()
            if broken_entry is not None:
                raise FmuFileError(
                    f"{file} is damaged: the checksum of {broken_entry} is wrong; fetch it again."
                )
            _check_duplicate_entries(file, archive)
    except (*_ARCHIVE_ERRORS, EOFError, NotImplementedError, RuntimeError) as error:
        raise FmuFileError(
            f"{file} is not a valid {archive_kind} archive ({error}); fetch or {remedy} it again."
        ) from error
    return {entry.filename for entry in entries if not entry.is_dir()}


def _check_extracted_size(file: Path, size: int, entries: list[zipfile.ZipInfo]) -> None:
    """Raise an error if an archive has too many files, or would fill the disk when extracted."""
    if len(entries) > _MOST_ENTRIES:
        raise FmuFileError(
            f"{file} holds {len(entries)} entries, more than {_MOST_ENTRIES}; no tool exports "
            "that, and it was refused."
        )
    extracted_bytes = sum(entry.file_size for entry in entries)
    most_bytes = max(_ANY_RATIO_UP_TO_BYTES, _LARGEST_COMPRESSION_RATIO * size)
    if extracted_bytes > min(LARGEST_EXTRACTED_BYTES, most_bytes):
        raise FmuFileError(
            f"{file} has {size / 1024**2:.3g} MiB and would extract to "
            f"{extracted_bytes / 1024**2:.0f} MiB, which looks like an archive made to fill the "
            "disk; it was refused."
        )


def _check_duplicate_entries(file: Path, archive: zipfile.ZipFile) -> None:
    """Raise an error if two entries of the same name have different content.

    Programs that read archives differ in which of the two they take.
    """
    first_entries: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        first_entry = first_entries.setdefault(entry.filename, entry)
        if first_entry is entry:
            continue
        same_checksum = first_entry.CRC == entry.CRC and first_entry.file_size == entry.file_size
        if not same_checksum or archive.read(first_entry) != archive.read(entry):
            raise FmuFileError(
                f"{file} holds the entry {entry.filename!r} twice with different content; nobody "
                "can say which is meant, and it was refused."
            )


def _check_entry_name(file: Path, entry: zipfile.ZipInfo) -> None:
    """Raise an error if an entry would leave the folder when extracted, or lies too deep."""
    name = entry.orig_filename
    with_slashes = name.replace("\\", "/")
    parts = PurePosixPath(with_slashes).parts
    has_forbidden_characters = ":" in name or "\0" in name
    leads_outside = not name or with_slashes.startswith("/") or ".." in parts
    is_symbolic_link = stat.S_ISLNK(entry.external_attr >> 16)
    if leads_outside or has_forbidden_characters or is_symbolic_link:
        raise FmuFileError(
            f"{file} holds the entry {name!r}, which would be extracted outside its folder; it was "
            "refused."
        )
    if "\\" in name:
        raise FmuFileError(
            f"{file} holds the entry {name!r}, whose folders are separated by backslashes; ZIP "
            "files separate them by '/' on every system (some packers on Windows do not). Pack it "
            "again with another tool."
        )
    if len(parts) > _MOST_FOLDER_LEVELS:
        raise FmuFileError(
            f"{file} holds an entry {len(parts)} folders deep; no tool exports that (at most "
            f"{_MOST_FOLDER_LEVELS} are taken), and it was refused."
        )


class _NoDocumentTypeBuilder(TreeBuilder):
    """Builds an XML tree, but raises an error at a document type, before entities are defined."""

    def doctype(self, name: str, public: str | None, system: str | None) -> None:
        raise FmuFileError(
            "defines a document type or entities, which FMI does not provide for and which can be "
            "made to fill the memory; it was refused"
        )


def _parsed_model_description(file: Path) -> Element:
    """Return the XML of the model description; raise an error if it defines entities.

    Entities can be nested until they fill the memory, or include files of this machine.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            entry = archive.getinfo("modelDescription.xml")
            if entry.file_size > _LARGEST_DESCRIPTION_BYTES:
                raise FmuFileError(
                    f"is larger than {_LARGEST_DESCRIPTION_BYTES // 1024**2} MiB; it was refused"
                )
            parser = XMLParser(target=_NoDocumentTypeBuilder())
            parser.feed(archive.read("modelDescription.xml"))
        root: Element = parser.close()
        if root.tag != "fmiModelDescription":
            raise FmuFileError(f"begins with <{root.tag}>; it is damaged")
    except (ParseError, ValueError, LookupError, zipfile.BadZipFile, OSError) as error:
        # An FmuFileError, which is a ValueError, was raised above with the end of this message.
        unread = f"cannot be read ({error})"
        reason = error.sentence if isinstance(error, FmuFileError) else unread
        raise FmuFileError(f"The model description of {file} {reason}.") from error
    return root


def design_record(design_hash: str) -> bytes:
    """Return the content of `DESIGN_RECORD`, the file with the design hash of an FMU."""
    return (json.dumps({"design_hash": design_hash}) + "\n").encode()


def packed_design_hash(path: str | os.PathLike[str]) -> str:
    """Return the hash of the design of which an FMU was built; empty if it has none."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"resources/{DESIGN_RECORD}") as file:
            design_hash = json.loads(file.read(_LARGEST_DESIGN_RECORD_BYTES))["design_hash"]
    except (OSError, KeyError, TypeError, ValueError, RuntimeError, zipfile.BadZipFile):
        return ""
    return design_hash if isinstance(design_hash, str) else ""
