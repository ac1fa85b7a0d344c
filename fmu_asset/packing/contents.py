"""What all FMUs built by this package have in common.

The identifier, the GUID and the module names of an FMU contain a hash of its content. The files are
therefore first written with a placeholder, which the hash of these files then replaces.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution, version
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple
from uuid import UUID

from fe.runtime.arrays import archive_bytes
from fmu_asset.description import PLACEHOLDER, Declaration, description_members, rendered
from fmu_asset.errors import FmuBuildError, FmuError
from fmu_asset.slaves.variables import FmuVariable
from reporting.files import atomic_write_bytes, hash_members, read_members

PYTHONFMU_VERSION = "0.7.0"
"""The only version of pythonfmu with whose binaries these FMUs were tested; what these binaries
expect of a script is not a public interface."""

BASE_CLASS_FILES = (
    "_version.py",
    "default_experiment.py",
    "enums.py",
    "fmi2slave.py",
    "logmsg.py",
    "variables.py",
)
"""The files of pythonfmu that its base class for slaves needs."""

_TEXT_SUFFIXES = (".py", ".xml", ".txt", ".html", ".json", ".c", ".h")

_GUID_PATTERNS = {
    "modelDescription.xml": ('guid="{}"', 'instantiationToken="{}"'),
    "sources/structure_variables.h": ('STRUCTURE_GUID "{}"',),
}
"""For each file, the texts in which the placeholder stands for the GUID. Everywhere else it stands
for the tag."""


@dataclass(frozen=True)
class FmuInfo:
    """An FMU that was built.

    Attributes
    ----------
    guid : str
        The GUID, which is computed from the content.
    design_hash : str
        The hash of the design that the reduced model was made of; empty if there is none.
    size : int
        The size of the file [bytes].
    """

    path: Path
    guid: str
    design_hash: str
    size: int


class SealedFmu(NamedTuple):
    """The bytes of an FMU file, and the GUID computed from its content."""

    content: bytes
    guid: str


class ContentIdentity(NamedTuple):
    """The two texts that identify the content of an FMU.

    Attributes
    ----------
    tag : str
        The first characters of the content hash, which are added to identifiers in the FMU.
    """

    tag: str
    guid: str


UNKNOWN_IDENTITY = ContentIdentity(tag=PLACEHOLDER, guid=PLACEHOLDER)
"""The identity of files whose content hash is not known yet."""


def checked_target(
    path: str | os.PathLike[str],
    *,
    replace: bool,
    file_kind: str = "An FMU",
    suffix: str = ".fmu",
    error: type[FmuError] = FmuBuildError,
) -> Path:
    """Return a path after checking that a file may be written to it.

    Parameters
    ----------
    file_kind : str
        The kind of the file, with its article, for the message: "An FMU".
    suffix : str
        The suffix that the path must have.
    error : type of FmuError
        The class of the error to raise.

    Raises
    ------
    FmuError
        If the suffix is wrong, or the file exists and may not be replaced.
    """
    target = Path(path)
    if target.suffix != suffix:
        raise error(f"{file_kind} must have the suffix {suffix}, but {target} was given.")
    if target.exists() and not replace:
        raise error(
            f"{target} exists: choose another --out or give --replace, in Python another path or "
            "replace."
        )
    return target


def write_fmu(target: Path, fmu: SealedFmu, design_hash: str = "") -> FmuInfo:
    """Write an FMU to a file, completely or not at all."""
    atomic_write_bytes(target, fmu.content)
    return FmuInfo(path=target, guid=fmu.guid, design_hash=design_hash, size=len(fmu.content))


def check_start_values(table: Iterable[FmuVariable]) -> None:
    """Raise `FmuBuildError` if the start value of a variable lies outside its range."""
    for variable in table:
        low = -float("inf") if variable.minimum is None else variable.minimum
        high = float("inf") if variable.maximum is None else variable.maximum
        if variable.start is None or low <= variable.start <= high:
            continue
        # Tunable variables are those of effects; all others belong to the reduced model.
        if variable.variability == "tunable":
            range_and_remedy = "that number of an effect; correct the patch"
        else:
            range_and_remedy = (
                "the reduced model; give another state or build a model with a wider range"
            )
        raise FmuBuildError(
            f"The start value {variable.start:g} of {variable.name} lies outside {low:g} to "
            f"{high:g}, the range of {range_and_remedy}."
        )


# ---------------------------------------------------------------- pythonfmu


def pythonfmu_version() -> str:
    """Return the version of pythonfmu that is installed.

    Raises
    ------
    FmuBuildError
        If pythonfmu is not installed, or its version is not `PYTHONFMU_VERSION`.
    """
    try:
        installed_version = version("pythonfmu")
    except PackageNotFoundError:
        installed_version = "none"
    if installed_version != PYTHONFMU_VERSION:
        raise FmuBuildError(
            f"Building an FMU needs pythonfmu {PYTHONFMU_VERSION}, but {installed_version} is "
            "installed; install the project's requirements."
        )
    return installed_version


def pythonfmu_members(module: str, folder: str, names: Iterable[str]) -> dict[str, bytes]:
    """Return the binaries, Python files and licence of pythonfmu, by their names in the archive.

    Parameters
    ----------
    module : str
        The model identifier of the FMU, which is also the name of the binaries and of the script
        that they load.
    folder : str
        The folder in the archive for the Python files.
    names : iterable of str
        The Python files that are needed.

    Raises
    ------
    FmuBuildError
        If a file is missing from the installation.
    """
    # Take the installed package and not the imported one: an FMU that runs in this process may have
    # imported its own copy of pythonfmu.
    package_folder = Path(str(distribution("pythonfmu").locate_file("pythonfmu")))
    binaries = package_folder / "resources" / "binaries"
    linux_binary = (binaries / "linux64/libpythonfmu-export.so").read_bytes()
    windows_binary = (binaries / "win64/pythonfmu-export.dll").read_bytes()
    members = {
        f"binaries/linux64/{module}.so": linux_binary,
        f"binaries/win64/{module}.dll": windows_binary,
        "documentation/licenses/pythonfmu.txt": _license("pythonfmu"),
        "resources/slavemodule.txt": module.encode(),
    }
    for name in names:
        members[f"{folder}/{name}"] = (package_folder / name).read_bytes()
    return members


def package_members(package: str, folder: str) -> dict[str, bytes]:
    """Return all Python files of a package of this project, by their names in the archive.

    In the archive, the package `fe.runtime` is called `fe` and lies in the same folder as the other
    packages. Imports from `fe.runtime` are therefore changed to relative ones.

    Parameters
    ----------
    package : str
        A package that imports from this project only itself, `fe.runtime`, and packages that are
        packed into the same folder, by relative imports with `..`.
    folder : str
        The folder in the archive for the package.
    """
    content_of_member = {}
    for name, content in read_members(Path(str(files(package))), [".py"]).items():
        content_of_member[f"{folder}/{name}"] = content.replace(b"from fe.runtime", b"from ..fe")
    return content_of_member


def _license(package: str) -> bytes:
    """Return the text of an installed package's licence."""
    for file in distribution(package).files or ():
        if file.name == "LICENSE":
            return Path(str(file.locate())).read_bytes()
    raise FmuBuildError(
        f"The licence of {package} is missing from its installation; install it again."
    )


def python_members(
    declaration: Declaration,
    class_name: str,
    *,
    imports: str,
    resources: Mapping[str, bytes],
    host: str = "It runs in a Python host that has NumPy.",
) -> dict[str, bytes]:
    """Return the files of a Python FMU, in which a placeholder stands for the content hash.

    Parameters
    ----------
    class_name : str
        The name of the slave class in the FMU's script; the tag is appended.
    imports : str
        Python lines that import or define the function `load_contents`, which reads the resources.
    resources : mapping of str to bytes
        The files that `load_contents` reads, by name.
    host : str
        A sentence on the host that the FMU needs, for its documentation page.
    """
    module = declaration.identifier
    runtime = f"resources/{module}_runtime"
    tool = f"uav-twin with PythonFMU {pythonfmu_version()}"
    members = description_members(declaration, generation_tool=tool, host=host)
    for file, content in resources.items():
        members[f"resources/{file}"] = content
    members[f"resources/{module}.py"] = rendered(
        "slave.py", module=module, class_name=f"{class_name}{PLACEHOLDER}", tag=PLACEHOLDER
    )
    members[f"{runtime}/__init__.py"] = b'"""An FMU of uav-twin."""\n'
    members[f"{runtime}/entry.py"] = rendered("entry.py", imports=imports)
    members[f"{runtime}/pythonfmu/__init__.py"] = b'"""The base class of pythonfmu."""\n'
    members |= package_members("fmu_asset.slaves", f"{runtime}/slaves")
    members |= pythonfmu_members(module, f"{runtime}/pythonfmu", BASE_CLASS_FILES)
    return members


# ---------------------------------------------------------------- content hash


def guid_of_hash(content_hash: str) -> str:
    """Return the GUID that the first 32 hexadecimal digits of a content hash form."""
    return f"{{{UUID(content_hash[:32])}}}"


def seal_fmu(
    template: Mapping[str, bytes],
    make_binaries: Callable[[dict[str, bytes], str], dict[str, bytes]] | None = None,
) -> SealedFmu:
    """Replace the placeholder in an FMU's files by their hash, and pack them.

    The hash is that of the names and contents of all files of the template, before the placeholder
    is replaced. Without further files, equal templates therefore give equal bytes.

    Parameters
    ----------
    template : mapping of str to bytes
        The files by name, in which the placeholder stands for tag and GUID.
    make_binaries : callable, optional
        Returns further files, which are not part of the hash. It is called with the files in which
        the placeholder was replaced, and with the tag: the first digits of the hash.
    """
    content_hash = hash_members(template)
    tag = content_hash[: len(PLACEHOLDER)]
    identity = ContentIdentity(tag=tag, guid=guid_of_hash(content_hash))
    identified_members = with_identity(template, UNKNOWN_IDENTITY, identity)
    if make_binaries is not None:
        identified_members |= make_binaries(identified_members, tag)
    archive = archive_bytes(identified_members, "modelDescription.xml")
    return SealedFmu(archive, identity.guid)


def with_identity(
    members: Mapping[str, bytes], old_identity: ContentIdentity, new_identity: ContentIdentity
) -> dict[str, bytes]:
    """Return the files of an FMU with another tag and GUID in their names and texts.

    Parameters
    ----------
    old_identity, new_identity : ContentIdentity
        Tag and GUID in the files, and those that replace them.
    """
    renamed_members = {}
    for name, content in members.items():
        new_content = content
        if name.endswith(_TEXT_SUFFIXES):
            # The GUID is first: in a template it is the same placeholder as the tag.
            for pattern in _GUID_PATTERNS.get(name, ()):
                old_guid = pattern.format(old_identity.guid)
                new_guid = pattern.format(new_identity.guid)
                new_content = new_content.replace(old_guid.encode(), new_guid.encode())
            new_content = new_content.replace(old_identity.tag.encode(), new_identity.tag.encode())
        renamed_members[name.replace(old_identity.tag, new_identity.tag)] = new_content
    return renamed_members


# ---------------------------------------------------------------- scripts
