"""What is built once and kept between runs in files: of several processes one builds, the others wait."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from fe.runtime.errors import ReducedModelFileError
from reporting.errors import FileNotWrittenError

_logger = logging.getLogger(__name__)

_Kept = TypeVar("_Kept")


def cache_folder() -> Path:
    """Return the folder of what is kept: `$XDG_CACHE_HOME/uav-twin`, or `~/.cache/uav-twin`."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if base else Path.home() / ".cache") / "uav-twin"


def built_once(
    path: Path, load: Callable[[], _Kept], build: Callable[[], _Kept], keep: Callable[[_Kept], object]
) -> _Kept:
    """Return what is kept, or build and keep it; of several builders one builds, and the others wait for it.

    Parameters
    ----------
    path : Path
        Its file; the lock lies beside it.
    load : callable
        Reads it; raises `OSError` or `ReducedModelFileError` where it is not there or not usable.
    build : callable
        Makes it.
    keep : callable
        Writes it; where that raises `FileNotWrittenError` it is used all the same, with a warning.
    """
    with suppress(OSError):  # not there, or not readable
        try:
            return load()
        except ReducedModelFileError as error:
            _logger.warning("What is kept is not usable and is built anew: %s", error)
    with _locked(path.with_suffix(".lock"), path):
        with suppress(OSError, ReducedModelFileError):
            return load()  # another process may have been faster
        built = build()
        try:
            keep(built)
        except FileNotWrittenError as error:
            _logger.warning(
                "What was built could not be kept in %s and will be built again: %s", path.parent, error
            )
    return built


@contextmanager
def _locked(path: Path, what: Path) -> Iterator[None]:
    """Hold a lock file while building; without a writable folder there is nothing to guard."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:
        yield
        return
    try:
        with suppress(ImportError):  # Windows: several builders then build the same
            _take(handle, what)
        yield
    finally:
        os.close(handle)


def _take(handle: int, what: Path) -> None:
    """Take a lock, which ends with the process that holds it; who waits for it says so."""
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        number = os.pread(handle, 20, 0).decode()
        holder = f"another process (number {number})" if number else "another process"
        _logger.warning("Waiting for %s that makes %s.", holder, what)
        fcntl.flock(handle, fcntl.LOCK_EX)
    with suppress(OSError):  # such as a full disk: the number only informs those who wait
        os.truncate(handle, 0)
        os.pwrite(handle, str(os.getpid()).encode(), 0)
