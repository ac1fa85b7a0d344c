"""Where a result comes from: versions of the stack, hashes of the sources and inputs, and the seed.

Nothing of it names a user, a machine or an absolute path, and nothing depends on the time of day, so that two
equal runs carry equal provenance.
"""

import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib import metadata, util
from pathlib import Path
from typing import Any

from reporting.files import hash_tree

STACK = (
    "uav-twin", "numpy", "scipy", "scikit-fem", "numba", "fmpy", "pythonfmu", "xarray", "h5netcdf",
    "h5py", "pydantic", "matplotlib",
)  # fmt: skip
"""Distributions whose version can change a figure of a result."""

SOURCE_PACKAGES = (
    "calibration", "discrepancy", "fe", "fmu_asset", "reporting", "scenarios", "twin_master", "uav_twin",
)  # fmt: skip
"""Packages of this project."""

_SOURCE_SUFFIXES = frozenset({".py", ".toml", ".css"})


@dataclass(frozen=True)
class Provenance:
    """What is needed to repeat a result.

    Attributes
    ----------
    seed
        Seed of the run's ``SeedSequence``; None if nothing random took part.
    versions
        Name of a distribution (and ``python``) -> version; ``not installed`` if it is missing.
    source_hashes
        Package of this project -> SHA-256 of its sources.
    input_hashes
        Name of an input (design, scenario, FMU, ...) -> SHA-256 of its content.
    """

    seed: int | None
    versions: Mapping[str, str]
    source_hashes: Mapping[str, str]
    input_hashes: Mapping[str, str] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return plain dictionaries, ready for JSON."""
        return asdict(self)


def collect_provenance(
    seed: int | None = None,
    *,
    input_hashes: Mapping[str, str] | None = None,
    packages: Iterable[str] = SOURCE_PACKAGES,
    distributions: Iterable[str] = STACK,
) -> Provenance:
    """Collect versions, source hashes and seed of what runs now."""
    return Provenance(
        seed=seed,
        versions={"python": platform.python_version(), **{name: _version(name) for name in distributions}},
        source_hashes={package: source_hash(package) for package in packages},
        input_hashes=dict(sorted((input_hashes or {}).items())),
    )


@cache
def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "not installed"


@cache
def source_hash(package: str) -> str:
    """Return the SHA-256 of the sources of an importable package: its files' names and contents.

    Raises
    ------
    ValueError
        No package of that name can be imported.
    """
    specification = util.find_spec(package)
    if specification is None or not specification.submodule_search_locations:
        raise ValueError(f"There is no package {package!r} whose sources could be hashed.")
    root = Path(next(iter(specification.submodule_search_locations)))
    return hash_tree(root, suffixes=_SOURCE_SUFFIXES)
