"""Provenance of a result: versions of the software, hashes of sources and inputs, and the seed.

It does not name a user, a machine or an absolute path, and does not depend on the time of day:
equal runs have equal provenance.
"""

import platform
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import metadata, util
from pathlib import Path
from typing import Any

from reporting.files import hash_tree

STACK = (
    "uav-twin",
    "numpy",
    "scipy",
    "scikit-fem",
    "numba",
    "fmpy",
    "pythonfmu",
    "xarray",
    "h5netcdf",
    "h5py",
    "pydantic",
    "matplotlib",
)
"""Distributions whose version can change a figure of a result."""

SOURCE_PACKAGES = (
    "calibration",
    "discrepancy",
    "fe",
    "fmu_asset",
    "reporting",
    "scenarios",
    "twin_master",
    "uav_twin",
)
"""Packages of this project."""

_PLUG_IN_GROUPS = "uav_twin."
"""The beginning of all groups of entry points by which packages add something to this project."""
_KEY_OF_TITLE = {
    "software": "versions",
    "plug-ins": "plug_ins",
    "sources": "source_hashes",
    "inputs": "input_hashes",
}
"""The key of a stored provenance for each item of a page."""
_HASH_DIGITS = 12
_SOURCE_SUFFIXES = frozenset({".py", ".toml", ".css"})


@dataclass(frozen=True)
class Provenance:
    """The data that are needed to repeat a result."""

    seed: int | None
    """The seed of the run's ``SeedSequence``; None if the run draws no random numbers."""
    versions: Mapping[str, str]
    """The version of each distribution and of ``python``; ``not installed`` if it is missing."""
    source_hashes: Mapping[str, str]
    """The SHA-256 of the sources of each package of this project."""
    input_hashes: Mapping[str, str] = field(default_factory=dict)
    """The SHA-256 of each input, such as design, scenario or FMU."""
    plug_ins: Mapping[str, str] = field(default_factory=dict)
    """The distribution and the version of each plug-in of another package, such as ``my-laws 1.2``,
    by the group and the name of its entry point, ``uav_twin.laws: my_law``."""

    def as_dict(self) -> dict[str, object]:
        """Return plain dictionaries, ready for JSON."""
        return asdict(self)


def collect_provenance(
    seed: int | None = None,
    *,
    input_hashes: Mapping[str, str] | None = None,
    packages: Iterable[str] = SOURCE_PACKAGES,
    distributions: Iterable[str] = STACK,
) -> Provenance:
    """Return the provenance of a result of the running software.

    Parameters
    ----------
    seed : int, optional
        The seed of the run.
    input_hashes : mapping of str to str, optional
        The SHA-256 of each input.
    packages : iterable of str
        The packages whose sources are hashed.
    distributions : iterable of str
        The distributions whose versions are stated.
    """
    versions = {name: _version(name) for name in distributions}
    return Provenance(
        seed=seed,
        versions={"python": platform.python_version(), **versions},
        source_hashes={package: source_hash(package) for package in packages},
        input_hashes=dict(sorted((input_hashes or {}).items())),
        plug_ins=plug_in_versions(),
    )


def plug_in_versions() -> dict[str, str]:
    """Return the distribution and the version of each installed plug-in, without loading any.

    Returns
    -------
    dict of str to str
        The distributions, such as ``my-laws 1.2``, by the group and the name of the entry point,
        such as ``uav_twin.laws: my_law``, in sorted order.
    """
    return dict(_plug_in_versions_on(tuple(sys.path)))


@cache
def _plug_in_versions_on(_search_path: tuple[str, ...]) -> dict[str, str]:
    """Return `plug_in_versions` for a search path; to read all distributions takes 30 ms."""
    versions = {}
    groups = [name for name in metadata.entry_points().groups if name.startswith(_PLUG_IN_GROUPS)]
    for group in groups:
        for point in metadata.entry_points(group=group):
            distribution = point.dist
            version = "unknown"
            if distribution is not None:
                version = f"{distribution.name} {distribution.version}"
            versions[f"{group}: {point.name}"] = version
    return dict(sorted(versions.items()))


@cache
def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


@cache
def source_hash(package: str) -> str:
    """Return a SHA-256 of all names and contents of a package's source files.

    Raises
    ------
    ValueError
        If no package of this name can be imported.
    """
    specification = util.find_spec(package)
    if specification is None or not specification.submodule_search_locations:
        raise ValueError(f"There is no package {package!r} whose sources could be hashed.")
    root = Path(next(iter(specification.submodule_search_locations)))
    return hash_tree(root, suffixes=_SOURCE_SUFFIXES)


def provenance_items(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the items of a stored provenance for a page: each kind with its sorted entries.

    A hash is shortened to its first 12 digits.
    """
    items = []
    for title, key in _KEY_OF_TITLE.items():
        entries = provenance.get(key, {})
        texts = []
        for name, value in sorted(entries.items()):
            texts.append(f"{name} {value[:_HASH_DIGITS] if key.endswith('hashes') else value}")
        items.append((title, ", ".join(texts)))
    return items
