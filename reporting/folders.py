"""Folders that one process holds, and that take the place of another in steps that a kill cannot spoil."""

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from reporting.errors import FileNotWrittenError
from reporting.files import written

_NEW, _OLD, _REPLACED = "new", "old", "replaced"


def lock_folder(folder: Path) -> int | None:
    """Take a folder for this process; return a file descriptor to close at the end, None if it is taken.

    The lock stays with the folder when it is renamed, and goes with the process that holds it.
    """
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


@contextmanager
def held(lock: int) -> Iterator[None]:
    """Let go of a folder at the end."""
    try:
        yield
    finally:
        os.close(lock)


def fresh_folder(folder: Path) -> Path:
    """Return an empty folder beside the one to be, with the permissions of the user's umask.

    Raises
    ------
    OSError
        The place is not writable.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=_prefix(folder, _NEW), dir=folder.parent))
    mask = os.umask(0)
    os.umask(mask)
    fresh.chmod(0o777 & ~mask)
    return fresh


def _taken(folder: Path) -> int:
    descriptor = lock_folder(folder)
    if descriptor is None:
        raise FileNotWrittenError(f"another process is replacing {folder}: look at what it leaves.")
    return descriptor


@contextmanager
def whole_folder(
    folder: Path, take: Callable[[Path], int] = _taken, holding: ExitStack | None = None
) -> Iterator[Path]:
    """Give an empty folder to be filled, and put it in the place of `folder` when the block ends.

    An exception in the block leaves `folder` as it was. `take` holds a folder for this process, as
    `lock_folder` does, or says why not: one that is to be replaced, and the new one, to the end of `holding`.

    Raises
    ------
    FileNotWrittenError
        The disk is full, the place is not writable, or another process holds the folder.
    """
    with written(folder), ExitStack() as ended:
        fresh = fresh_folder(folder)
        ended.callback(shutil.rmtree, fresh, ignore_errors=True)
        (holding or ended).enter_context(held(take(fresh)))
        yield fresh
        if not folder.is_dir():
            fresh.rename(folder)
            return
        with held(take(folder)):
            replace_folder(fresh, folder)


def replace_folder(fresh: Path, folder: Path) -> None:
    """Put a folder in the place of another, which is removed; this process holds both.

    A kill on the way leaves one of the two in the place, or the old one where `restore_folder` finds it.

    Raises
    ------
    OSError
        The place is not writable; the old folder is there as it was.
    """
    old = Path(tempfile.mkdtemp(prefix=_prefix(folder, _replaced_by(fresh)), dir=folder.parent))
    aside = old / folder.name
    try:
        folder.rename(aside)
        fresh.rename(folder)
    except OSError:
        if aside.is_dir():
            aside.rename(folder)
        old.rmdir()
        raise
    replaced = Path(tempfile.mkdtemp(prefix=_prefix(folder, _REPLACED), dir=folder.parent))
    old.rename(replaced)
    shutil.rmtree(replaced, ignore_errors=True)


def restore_folder(folder: Path) -> bool:
    """Put back a folder that a killed process had moved aside; return whether there was one.

    What a killed process had replaced already, and was about to remove, is removed, and what it had begun.

    Raises
    ------
    FileNotWrittenError
        The place is not writable.
    """
    restored = False
    for old in _asides(folder, _OLD):
        aside = old / folder.name
        # A folder that is held is being replaced at this moment; one whose place is taken is left alone, but
        # where what took it is known.
        if not aside.is_dir() or (descriptor := lock_folder(aside)) is None:
            continue
        with held(descriptor), written(folder):
            if not folder.exists():
                aside.rename(folder)
                restored = True
            elif old.name.startswith(_prefix(folder, _replaced_by(folder))):
                shutil.rmtree(old, ignore_errors=True)
        with suppress(OSError):
            old.rmdir()
    for left in (*_asides(folder, _NEW), *_asides(folder, _REPLACED)):
        if (descriptor := lock_folder(left)) is not None:
            with held(descriptor):
                shutil.rmtree(left, ignore_errors=True)
    return restored


def _replaced_by(fresh: Path) -> str:
    return f"{_OLD}-{fresh.stat().st_ino}"


def _prefix(folder: Path, what: str) -> str:
    return f".{folder.name}.{what}-"


def _asides(folder: Path, what: str) -> list[Path]:
    return sorted(folder.parent.glob(glob.escape(_prefix(folder, what)) + "*"))
