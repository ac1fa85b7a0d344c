"""Platforms of FMUs: their names in FMI 2 and 3, and the folders of their binaries."""

from collections.abc import Mapping, Sequence
from typing import Literal, get_args

from fmu_asset.errors import FmuBuildError
from reporting.choices import require_one_of
from reporting.words import comma_list

FmiVersion = Literal[2, 3]
"""Versions of FMI that a compiled FMU can be of."""

Target = Literal[
    "x86_64-linux", "x86_64-windows", "x86_64-darwin", "aarch64-darwin", "aarch64-linux"
]
"""Processors and systems that a library can be compiled for, by their names in FMI 3."""

Platform = Literal["linux64", "win64", "darwin64", Target, "all"]
"""Names of platforms that a user can request: those of FMI 2 and 3, and "all"."""

HOST_TARGET: Target = "x86_64-linux"
"""The only target that the C compiler of the host is used for."""

_TARGETS_OF_FMI_2_NAMES: Mapping[str, tuple[Target, ...]] = {
    "linux64": ("x86_64-linux",),
    "win64": ("x86_64-windows",),
    "darwin64": ("x86_64-darwin", "aarch64-darwin"),
}

_FMI_2_FOLDERS: Mapping[Target, str] = {
    target: name for name, targets in _TARGETS_OF_FMI_2_NAMES.items() for target in targets
}

_SUFFIXES = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}


def targets_by_folder(
    platforms: Sequence[Platform], fmi: FmiVersion
) -> dict[str, tuple[Target, ...]]:
    """Return the targets of each folder of binaries.

    A folder has one library. The folder `darwin64` of FMI 2 has two targets, whose libraries are
    joined to one.

    Parameters
    ----------
    platforms : sequence of str
        Names of platforms, see `Platform`. In either version of FMI, a name of FMI 2 stands for the
        targets that it covers. "all" stands for all targets for which the version has a folder.

    Raises
    ------
    InvalidChoiceError
        If a platform or the version is none of these.
    FmuBuildError
        If there is no platform, or FMI 2 has no folder for one of them.
    """
    require_one_of(fmi, get_args(FmiVersion), "fmi")
    for platform in platforms:
        require_one_of(platform, get_args(Platform), "platforms")
    if not platforms:
        raise FmuBuildError(
            "A platform is expected, but none was given: name one of "
            f"{comma_list(get_args(Platform))}."
        )
    folders: dict[str, tuple[Target, ...]] = {}
    for target in get_args(Target):
        names = {target, _FMI_2_FOLDERS.get(target), "all"}
        if names.isdisjoint(platforms):
            continue
        folder = target if fmi == 3 else _FMI_2_FOLDERS.get(target)
        if folder is not None:
            folders[folder] = (*folders.get(folder, ()), target)
        elif target in platforms:
            raise FmuBuildError(
                f"FMI 2.0 has no folder for binaries of {target}: build with FMI 3, or for "
                f"platforms among {comma_list(_TARGETS_OF_FMI_2_NAMES)}."
            )
    return folders


def binary_name(folder: str, target: Target, identifier: str) -> str:
    """Return the name in the archive of the library for a target.

    Parameters
    ----------
    folder : str
        The folder of the platform, such as "linux64".
    target : str
        A target such as "x86_64-linux".
    identifier : str
        The model identifier.
    """
    return f"binaries/{folder}/{identifier}{suffix_of(target)}"


def suffix_of(target: Target) -> str:
    """Return the suffix of the shared libraries of a target, such as ".so"."""
    return _SUFFIXES[target.partition("-")[2]]


def host_binary_name(identifier: str, fmi: FmiVersion) -> str:
    """Return the name in the archive of the library for this host."""
    folder = HOST_TARGET if fmi == 3 else _FMI_2_FOLDERS[HOST_TARGET]
    return binary_name(folder, HOST_TARGET, identifier)
