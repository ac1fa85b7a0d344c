"""Refuses files of the user that hide a package of this project because Python finds them first."""

from functools import cache
from importlib.util import find_spec
from pathlib import Path

PACKAGES = (
    "calibration",
    "discrepancy",
    "fe",
    "fmu_asset",
    "reporting",
    "scenarios",
    "twin_master",
)
"""The packages of this project from which `uav_twin` imports; their folders lie beside its own."""


class ShadowedPackageError(ImportError):
    """Another file or folder has the name of a package of this project, and is found first."""


@cache
def refuse_shadowing() -> None:
    """Check, once in a process, that Python imports this project's packages and no namesakes.

    Raises
    ------
    ShadowedPackageError
        If another file or folder would be imported, because it lies beside the user's script or was
        imported before.
    """
    project = Path(__file__).resolve().parent.parent
    for name in PACKAGES:
        location = _import_location(name)
        if location is not None and location.resolve() != project / name:
            raise ShadowedPackageError(
                f"{location} hides the package `{name}` of uav-twin, because Python finds it "
                "first: rename it, or move it out of the folder of the script.",
                name=name,
                path=str(location),
            )


def _import_location(name: str) -> Path | None:
    """Return the file or folder that Python would import for a name; None if there is none."""
    try:
        spec = find_spec(name)
    except ValueError:  # a module was imported that was not made from a file
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(spec.origin) if spec.origin else None
