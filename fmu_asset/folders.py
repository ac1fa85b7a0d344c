"""Private folders for extracted FMUs and their workers.

Nobody else can write to such a folder: it has a parent of its own that only its user may enter.
"""

import os
import re
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import FmuFileError

_CANDIDATES = ("/tmp", "/var/tmp", "/dev/shm")
"""Folders for temporary files if the usual one cannot be used."""
_PLAIN_PATH = re.compile(r"[A-Za-z0-9/_.\-]+|[A-Za-z]:[A-Za-z0-9/_.\-~]+")
"""A path without characters that have to be quoted; on Windows with a drive, and short names."""
_SEARCH_ROUNDS = 100
"""Largest number of searches for processes that keep starting others."""
_HAS_OPENED_PATHS = hasattr(os, "O_PATH")
"""Whether a folder can be opened without the right to read it, as on Linux."""
_cleaned_parents: set[Path] = set()


def plain_folder() -> Path:
    """Return a new private folder whose path has only ASCII letters, digits and `/_.-`.

    Other characters in the path crash some FMUs (those of pythonfmu decode only `%20`). Folders of
    ended processes that were killed together with their workers are removed meanwhile.

    Raises
    ------
    FmuFileError
        If no such folder can be made.
    """
    candidates = [tempfile.gettempdir(), *_CANDIDATES]
    for name in candidates:
        path = Path(name)
        is_plain = _PLAIN_PATH.fullmatch(path.absolute().as_posix())
        if is_plain and path.is_dir() and os.access(path, os.W_OK):
            _remove_leftovers(path)
            parent = tempfile.mkdtemp(prefix=f"{_prefix()}{os.getpid()}-", dir=path)
            folder = Path(parent, "own").absolute()
            folder.mkdir(0o700)
            return folder
    raise FmuFileError(
        "FMUs need a writable folder for temporary files with a plain ASCII path, but none of "
        f"{', '.join(candidates)} is one; set TMPDIR."
    )


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Provide a folder as `plain_folder` makes it, which is removed when the context ends."""
    folder = plain_folder()
    try:
        yield folder
    finally:
        remove_folder(folder)


def _remove_leftovers(parent: Path) -> None:
    """Remove the folders of ended processes from a parent folder, once for each parent.

    Without /proc nothing is done, because one cannot tell whether a process still runs.
    """
    can_tell = Path("/proc/self").exists() and hasattr(os, "getuid")
    if parent in _cleaned_parents or not can_tell:
        return
    _cleaned_parents.add(parent)
    for folder in parent.glob(f"{_prefix()}*"):
        process, _, _ = folder.name.removeprefix(_prefix()).partition("-")
        if not process.isdigit():
            continue
        with suppress(OSError):
            is_of_user = folder.lstat().st_uid == os.getuid()
            if is_of_user and not Path("/proc", process).exists():
                end_processes(folder)
                remove_folder(folder)


def _prefix() -> str:
    """Return the common beginning of our folders' names, which has the process namespace.

    Containers may share a folder for temporary files, but not their process numbers.
    """
    try:
        namespace = Path("/proc/self/ns/pid").stat().st_ino
    except OSError:
        namespace = 0
    return f"uav-twin-fmu-{namespace}-"


def end_processes(folder: str | os.PathLike[str]) -> None:
    """Kill the processes that were started with this folder as TMPDIR.

    A process inherits this environment variable from its parent, whatever its group or session, and
    even if the parent has ended.

    Parameters
    ----------
    folder : path-like
        The folder, or the beginning of its path.
    """
    environment_entry = f"\0TMPDIR={os.fspath(folder)}".encode()
    empty_searches = 0
    for _ in range(_SEARCH_ROUNDS):
        found_process = False
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                environment = b"\0" + (process / "environ").read_bytes()
                if environment_entry in environment:
                    os.kill(int(process.name), signal.SIGKILL)
                    found_process = True
        empty_searches = 0 if found_process else empty_searches + 1
        # two empty searches, since one can miss the child of a process that ends meanwhile
        if empty_searches == 2:
            return
        time.sleep(0.01)


@contextmanager
def _path_of_opened(folder: str) -> Iterator[str]:
    """Provide a path that leads to this folder even if it is moved or replaced meanwhile."""
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def remove_folder(folder: str | os.PathLike[str]) -> None:
    """Remove a folder and its content, however deeply nested, as far as possible.

    Inner folders are first moved to the top. `shutil.rmtree` would call itself for each level, and
    a deep path is longer than the system allows; it is used on systems other than Linux. Links are
    not followed, not even those with which a process of the FMU replaces a folder meanwhile.
    """
    if not _HAS_OPENED_PATHS:
        shutil.rmtree(folder, ignore_errors=True)
        with suppress(OSError):
            Path(folder).parent.rmdir()
        return
    # strings instead of `Path` objects take half the time
    top = os.fspath(folder)
    waiting = [top]
    moved_count = 0
    while waiting:
        current = waiting.pop()
        with suppress(OSError), _path_of_opened(current) as opened:
            os.chmod(opened, 0o700)  # noqa: PTH101
            for entry in list(os.scandir(opened)):
                with suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        moved_count += 1
                        moved = f"{top}/.removed-{os.getpid()}-{moved_count}"
                        os.rename(entry.path, moved)  # noqa: PTH104
                        waiting.append(moved)
                    else:
                        os.unlink(entry.path)  # noqa: PTH108
        if current != top:
            with suppress(OSError):
                os.rmdir(current)  # noqa: PTH106
    parent = os.path.dirname(top)  # noqa: PTH120
    with suppress(OSError):
        os.rmdir(top)  # noqa: PTH106
        if os.path.basename(parent).startswith(_prefix()):  # noqa: PTH119
            os.rmdir(parent)  # noqa: PTH106
