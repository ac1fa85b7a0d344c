"""Folders for extracted FMUs and their workers: where they are made, and how they are removed.

None lies in a folder that others can write into: each has a parent of its own, which only its user may enter.
"""

import os
import re
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from fmu_asset.errors import said

from .errors import FmuFileError

_tidied: set[Path] = set()
_ROUNDS = 100
_PLAIN_PATH = re.compile(r"[A-Za-z0-9/_.\-]+")


def plain_folder() -> Path:
    """Return a new private folder whose path has ASCII letters, digits and `/_.-` only.

    Other characters in the path crash some FMUs (pythonfmu's decode nothing but `%20`). What a process that
    is gone has left behind, since it and its worker were killed in the same moment, is removed on the way.

    Raises
    ------
    FmuFileError
        If no such folder can be made.
    """
    candidates = [tempfile.gettempdir(), "/tmp", "/var/tmp", "/dev/shm"]
    for name in candidates:
        path = Path(name)
        if _PLAIN_PATH.fullmatch(str(path.absolute())) and path.is_dir() and os.access(path, os.W_OK):
            _remove_leftovers(path)
            parent = tempfile.mkdtemp(prefix=f"{_prefix()}{os.getpid()}-", dir=path)
            folder = Path(parent, "own").absolute()
            folder.mkdir(0o700)
            return folder
    raise FmuFileError(said("running.no_folder", candidates=candidates))


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Give a folder as `plain_folder` makes it for a while."""
    folder = plain_folder()
    try:
        yield folder
    finally:
        remove_folder(folder)


def _remove_leftovers(parent: Path) -> None:
    """Remove folders of ours whose process is gone, once for each parent, where the system tells that."""
    if parent in _tidied or not Path("/proc/self").exists():
        return
    _tidied.add(parent)
    for folder in parent.glob(f"{_prefix()}*"):
        number = folder.name.removeprefix(_prefix()).partition("-")[0]
        with suppress(OSError):
            own = number.isdigit() and folder.lstat().st_uid == os.getuid()
            if own and not Path("/proc", number).exists():
                end_processes(folder)
                remove_folder(folder)


def _prefix() -> str:
    """Return the beginning of our folders' names; two containers may share a folder, not process numbers."""
    try:
        return f"uav-twin-fmu-{Path('/proc/self/ns/pid').stat().st_ino}-"
    except OSError:
        return "uav-twin-fmu-0-"


def end_processes(folder: str | os.PathLike[str]) -> None:
    """End the processes whose folder for temporary files was in this one when their program began.

    A process has that of its parent, in whatever group or session it hides and whoever has ended before it.
    """
    mark, clean = f"\0TMPDIR={os.fspath(folder)}".encode(), 0
    for _ in range(_ROUNDS):
        found = False
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if mark in b"\0" + (process / "environ").read_bytes():
                    os.kill(int(process.name), signal.SIGKILL)
                    found = True
        clean = 0 if found else clean + 1
        if clean == 2:  # one look misses the child of a process that ended meanwhile
            return
        time.sleep(0.01)


@contextmanager
def _held(folder: str) -> Iterator[str]:
    """Give a path of this very folder, wherever it is moved and whatever takes its place."""
    descriptor = os.open(folder, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def remove_folder(folder: str | os.PathLike[str]) -> None:
    """Remove a folder and all that can be removed in it, however deep an FMU has nested it.

    Folders inside are first moved to the top: `shutil.rmtree` calls itself for each level, and the path of a
    deep one is longer than the system allows. Links are not followed, not even those that a process of the
    FMU, which cannot reach what it links to, puts in the place of a folder meanwhile.
    """
    top = os.fspath(folder)
    waiting, number = [top], 0
    while waiting:
        here = waiting.pop()
        with suppress(OSError), _held(here) as held:
            os.chmod(held, 0o700)  # noqa: PTH101 - here and below, strings: half the time
            for entry in list(os.scandir(held)):
                with suppress(OSError):
                    if entry.is_dir(follow_symlinks=False):
                        number += 1
                        moved = f"{top}/.removed-{os.getpid()}-{number}"
                        os.rename(entry.path, moved)  # noqa: PTH104
                        waiting.append(moved)
                    else:
                        os.unlink(entry.path)  # noqa: PTH108
        if here != top:
            with suppress(OSError):
                os.rmdir(here)  # noqa: PTH106
    parent = os.path.dirname(top)  # noqa: PTH120
    with suppress(OSError):
        os.rmdir(top)  # noqa: PTH106
        if os.path.basename(parent).startswith(_prefix()):  # noqa: PTH119
            os.rmdir(parent)  # noqa: PTH106
