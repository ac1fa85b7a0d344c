"""Files of the user that hide a package of this project, because Python finds them first, are refused."""

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
"""The packages that `uav_twin` hands on from; they lie beside it."""


class ShadowedPackageError(ImportError):
    """Another file or folder has the name of a package of this project, and is found first."""


@cache
def refuse_shadowing() -> None:
    """Make sure, once, that each package of this project is the one that will be imported.

    Raises
    ------
    ShadowedPackageError
        One is not: a file of that name lies beside the user's script, or was imported before.
    """
    beside = Path(__file__).resolve().parent.parent
    for name in PACKAGES:
        place = _place(name)
        if place is not None and place.resolve() != beside / name:
            raise ShadowedPackageError(
                f"{place} hides the package `{name}` of uav-twin, because Python finds it first: "
                "rename it, or move it out of the folder of the script.",
                name=name,
                path=str(place),
            )


def _place(name: str) -> Path | None:
    """Return the file or folder that an import of a name would take, None where there is nothing."""
    try:
        spec = find_spec(name)
    except ValueError:  # a module that was put together without a file
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(spec.origin) if spec.origin else None
