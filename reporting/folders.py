"""Folders that one process holds, and that take the place of another in steps that a kill cannot spoil."""

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from reporting.errors import FileNotWrittenError
from reporting.files import write_error, written

_OLD, _REPLACED = "old", "replaced"


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


def fresh_folder(folder: Path) -> Path:
    """Return an empty folder beside the one to be, with the permissions of the user's umask.

    Raises
    ------
    OSError
        The place is not writable.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=_prefix(folder, "new"), dir=folder.parent))
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
def whole_folder(folder: Path, take: Callable[[Path], int] = _taken) -> Iterator[Path]:
    """Give an empty folder to be filled, and put it in the place of `folder` when the block ends.

    An exception in the block leaves `folder` as it was. `take` holds a folder that is to be replaced for this
    process, as `lock_folder` does, or says why not.

    Raises
    ------
    FileNotWrittenError
        The disk is full, the place is not writable, or another process holds the folder.
    """
    with written(folder):
        fresh = fresh_folder(folder)
        try:
            yield fresh
            if not folder.is_dir():
                fresh.rename(folder)
                return
            held = take(folder)
            try:
                replace_folder(fresh, folder)
            finally:
                os.close(held)
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def replace_folder(fresh: Path, folder: Path) -> None:
    """Put a folder in the place of another, which is removed; this process holds both.

    A kill on the way leaves one of the two in the place, or the old one where `restore_folder` finds it.

    Raises
    ------
    OSError
        The place is not writable; the old folder is there as it was.
    """
    old = Path(tempfile.mkdtemp(prefix=_prefix(folder, _OLD), dir=folder.parent))
    aside = old / folder.name
    try:
        folder.rename(aside)
        fresh.rename(folder)
    except OSError:
        if aside.is_dir():
            aside.rename(folder)
        old.rmdir()
        raise
    replaced = old.with_name(old.name.replace(f".{_OLD}-", f".{_REPLACED}-"))
    old.rename(replaced)
    shutil.rmtree(replaced, ignore_errors=True)


def restore_folder(folder: Path) -> bool:
    """Put back a folder that a killed process had moved aside; return whether there was one.

    What a killed process had replaced already, and was about to remove, is removed.

    Raises
    ------
    FileNotWrittenError
        The place is not writable.
    """
    restored = False
    for old in _asides(folder, _OLD):
        aside = old / folder.name
        # A folder that is held is being replaced at this moment; one whose place is taken is left alone.
        if folder.exists() or not aside.is_dir() or (descriptor := lock_folder(aside)) is None:
            continue
        try:
            aside.rename(folder)
            restored = True
        except OSError as error:
            raise write_error(error, folder) from error
        finally:
            os.close(descriptor)
        with suppress(OSError):
            old.rmdir()
    for replaced in _asides(folder, _REPLACED):
        shutil.rmtree(replaced, ignore_errors=True)
    return restored


def _prefix(folder: Path, what: str) -> str:
    return f".{folder.name}.{what}-"


def _asides(folder: Path, what: str) -> list[Path]:
    return sorted(folder.parent.glob(glob.escape(_prefix(folder, what)) + "*"))
