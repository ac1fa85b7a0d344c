"""What runs of the tests share in the user's cache folder: compiled loops, reduced models and packed FMUs.

Everything lies under a hash of what it is made from, so that another clone finds it and a changed source never
meets it.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
import time
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import distributions
from pathlib import Path
from typing import Any, TypeVar

from fe.reduction.built_once import built_once, cache_folder
from fe.runtime.archive import write_bytes_atomically

ROOT = Path(__file__).parents[1]
FOLDER = cache_folder() / "tests"  # now, for tests change where the cache is

# The product has numba keep loops in folders named by the content of their sources; the path of a clone would
# part them again. Before numba is imported: processes that tests start keep theirs there too.
os.environ.setdefault("NUMBA_CACHE_DIR", str(FOLDER / "compiled"))
from numba.core.caching import UserProvidedCacheLocator

UserProvidedCacheLocator.get_suitable_cache_subpath = classmethod(lambda cls, py_file: "")

DAYS = 14
"""What was not used for so long is removed."""

_Made = TypeVar("_Made")


def content_hash(*places: Path, inputs: object = None) -> str:
    """Return a hash of files, of those in folders, of inputs, and of the interpreter with its packages."""
    digest = hashlib.sha256(platform.platform().encode() + platform.python_version().encode())
    digest.update(repr(sorted((item.name, item.version) for item in distributions())).encode())
    digest.update(repr(inputs).encode())
    for place in places:
        for file in sorted(place.rglob("*")) if place.is_dir() else [place]:
            if file.is_file() and "__pycache__" not in file.parts:
                content = file.read_bytes()
                digest.update(f"{file.relative_to(ROOT).as_posix()} {len(content)}\n".encode())
                digest.update(content)
    return digest.hexdigest()[:32]


def kept(name: str, build: Callable[[], _Made], *places: Path, inputs: object = None) -> _Made:
    """Return what `build` makes of files and inputs; of all processes and runs one makes it.

    Parameters
    ----------
    name : str
        Begins the name of its file.
    build : callable
        Makes what can be pickled, from nothing but `places` and `inputs`.
    places : Path
        Files and folders of the project that it is made from.
    inputs : object
        What else it is made from; its `repr` says all.
    """
    path = FOLDER / f"{name}-{content_hash(*places, inputs=inputs)}.pickle"

    def load() -> _Made:
        with path.open("rb") as file:
            made: _Made = pickle.load(file)
            return made

    return built_once(
        path, load, build, lambda made: write_bytes_atomically(path, pickle.dumps(made))
    )


def remove_old() -> None:
    """Remove what nobody read for two weeks."""
    for file in FOLDER.rglob("*"):
        with suppress(OSError):  # another run removes it, too
            if file.is_file() and file.stat().st_atime < time.time() - DAYS * 86400.0:
                file.unlink()
