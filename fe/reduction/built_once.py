"""Build a result once and keep it in a file; other processes wait for the one that builds it."""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from fe.runtime.errors import ReducedModelFileError
from reporting.errors import FileNotWrittenError
from reporting.system.log import module_logger
from reporting.system.operating_system import lock_descriptor, open_descriptor, read_at

_logger = module_logger(__name__)

Result = TypeVar("Result")


def cache_folder() -> Path:
    """Return the cache folder: `$XDG_CACHE_HOME/uav-twin`, or `~/.cache/uav-twin`."""
    cache_home = os.environ.get("XDG_CACHE_HOME", "")
    parent = Path(cache_home) if cache_home else Path.home() / ".cache"
    return parent / "uav-twin"


def built_once(
    path: Path,
    load: Callable[[], Result],
    build: Callable[[], Result],
    keep: Callable[[Result], object],
) -> Result:
    """Return a result from its file, or build it and write the file.

    If several processes need the same result, one builds it and the others wait.

    Parameters
    ----------
    path : Path
        The file of the result; the lock file lies next to it.
    load : callable
        Reads the file. It raises `OSError` or `ReducedModelFileError` if the file is missing or
        not usable.
    keep : callable
        Writes the result to the file. If it raises `FileNotWrittenError`, a warning is logged and
        the result is returned all the same.
    """
    with suppress(OSError):  # the file is missing or cannot be read
        try:
            return load()
        except ReducedModelFileError as error:
            _logger.warning("The stored result is not usable and is built again: %s", error)
    with _locked(path.with_suffix(".lock"), path):
        with suppress(OSError, ReducedModelFileError):
            return load()  # another process may have built it meanwhile
        result = build()
        try:
            keep(result)
        except FileNotWrittenError as error:
            _logger.warning(
                "The result could not be stored in %s and will be built again: %s",
                path.parent,
                error,
            )
    return result


@contextmanager
def _locked(lock_file: Path, result_file: Path) -> Iterator[None]:
    """Hold a lock while a result is built; if the folder is not writable, do not lock."""
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        descriptor = open_descriptor(lock_file, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError:
        yield
        return
    try:
        _acquire_lock(descriptor, result_file)
        yield
    finally:
        os.close(descriptor)


def _acquire_lock(descriptor: int, result_file: Path) -> None:
    """Acquire a lock that ends with this process; log a warning if another process holds it."""
    try:
        lock_descriptor(descriptor, wait=False)
    except BlockingIOError:
        process_id = read_at(descriptor, 20, 0).decode()
        holder = f"another process (number {process_id})" if process_id else "another process"
        _logger.warning("Waiting for %s that makes %s.", holder, result_file)
        lock_descriptor(descriptor, wait=True)
    with suppress(OSError):  # a full disk, say: the number only informs those who wait
        os.truncate(descriptor, 0)
        os.lseek(descriptor, 0, os.SEEK_SET)
        os.write(descriptor, str(os.getpid()).encode())
