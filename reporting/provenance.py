"""Where a result comes from: versions of the stack, hashes of the sources and inputs, the seed.

Nothing here names a user, a machine or an absolute path, and nothing depends on the time of day, so that two
equal runs carry equal provenance.
"""

import hashlib
import json
import os
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata, util
from pathlib import Path
from typing import Any

from reporting.files import members_of
from reporting.json_file import plain

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
        found: dict[str, Any] = plain(self)
        return found


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


def hash_tree(root: Path, *, suffixes: Iterable[str]) -> str:
    """Return the SHA-256 of the files below `root` with one of the suffixes; line ends do not count."""
    members = members_of(root, frozenset(suffixes))
    return hash_members({name: content.replace(b"\r\n", b"\n") for name, content in members.items()})


def hash_members(members: Mapping[str, bytes]) -> str:
    """Return the SHA-256 over the names and contents of files, in the order of their names."""
    digest = hashlib.sha256()
    for name, content in sorted(members.items()):
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def hash_bytes(data: bytes) -> str:
    """Return the SHA-256 of the bytes as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def hash_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file's content; its name and date do not count."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_record(record: Any) -> str:
    """Return the SHA-256 of a JSON-like record; the order of keys does not count.

    Raises
    ------
    TypeError
        The record holds something that JSON cannot.
    ValueError
        The record holds NaN or an infinity.
    """
    text = json.dumps(record, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hash_bytes(text.encode("utf-8"))
