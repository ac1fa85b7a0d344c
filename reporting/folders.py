"""Locks on folders, and the replacement of a folder in steps that a kill cannot spoil.

While `folder` is replaced, three kinds of folders lie beside it: `.folder.new-*` is being filled,
`.folder.old-INODE-*` holds the old content until the new folder with this inode stands in its
place, and `.folder.replaced-*` is about to be removed.
"""

import glob
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from reporting.errors import FileNotWrittenError
from reporting.files import explained_write_errors

_NEW = "new"
_OLD = "old"
_REPLACED = "replaced"


def lock_folder(folder: Path) -> int | None:
    """Lock a folder for this process.

    The lock stays with the folder when it is renamed, and ends with the process.

    Returns
    -------
    int or None
        The file descriptor that holds the lock until it is closed; None if another process has
        locked the folder.
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
def closing_lock(lock: int) -> Iterator[None]:
    """Return a context that ends the lock of a folder when the block ends."""
    try:
        yield
    finally:
        os.close(lock)


def fresh_folder(folder: Path) -> Path:
    """Return a new empty folder beside `folder`, with the permissions of the user's umask.

    Raises
    ------
    OSError
        If the location is not writable.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = _make_folder_beside(folder, _NEW)
    # The umask can only be read by setting it.
    mask = os.umask(0)
    os.umask(mask)
    fresh.chmod(0o777 & ~mask)
    return fresh


def _lock_or_refuse(folder: Path) -> int:
    lock = lock_folder(folder)
    if lock is None:
        raise FileNotWrittenError(f"another process is replacing {folder}: look at what it leaves.")
    return lock


@contextmanager
def whole_folder(
    folder: Path, lock: Callable[[Path], int] = _lock_or_refuse, lock_owner: ExitStack | None = None
) -> Iterator[Path]:
    """Return a context with an empty folder, which replaces `folder` at the end of the block.

    If the block raises, `folder` stays as it was.

    Parameters
    ----------
    folder : Path
        The folder to write.
    lock : callable
        Locks a folder for this process and returns the file descriptor, or raises the reason.
    lock_owner : ExitStack, optional
        Holds the lock of the new folder until it is closed; by default the lock ends with the
        block.

    Yields
    ------
    Path
        The new folder, to be filled.

    Raises
    ------
    FileNotWrittenError
        If the disk is full, the location is not writable, or another process has locked the folder.
    """
    with explained_write_errors(folder), ExitStack() as block:
        fresh = fresh_folder(folder)
        block.callback(shutil.rmtree, fresh, ignore_errors=True)
        (lock_owner or block).enter_context(closing_lock(lock(fresh)))
        yield fresh
        if not folder.is_dir():
            fresh.rename(folder)
            return
        with closing_lock(lock(folder)):
            replace_folder(fresh, folder)


def replace_folder(fresh: Path, folder: Path) -> None:
    """Put a folder in the place of another, which is removed; this process has locked both.

    After a kill either the new or the old folder is in place, or `restore_folder` finds the old
    one.

    Raises
    ------
    OSError
        If the location is not writable; the old folder is unchanged.
    """
    parking = _make_folder_beside(folder, _old_label(fresh))
    parked = parking / folder.name
    try:
        folder.rename(parked)
        fresh.rename(folder)
    except OSError:
        if parked.is_dir():
            parked.rename(folder)
        parking.rmdir()
        raise
    # The new name tells a later process that the content is no longer needed.
    replaced = _make_folder_beside(folder, _REPLACED)
    parking.rename(replaced)
    shutil.rmtree(replaced, ignore_errors=True)


def restore_folder(folder: Path) -> bool:
    """Put back the old content that a killed process had moved aside.

    What the process had already replaced, or had begun to write, is removed.

    Returns
    -------
    bool
        Whether old content was put back.

    Raises
    ------
    FileNotWrittenError
        If the location is not writable.
    """
    was_restored = False
    for parking in _folders_beside(folder, _OLD):
        if _restore_from(parking, folder):
            was_restored = True
    for abandoned in (*_folders_beside(folder, _NEW), *_folders_beside(folder, _REPLACED)):
        lock = lock_folder(abandoned)
        if lock is not None:
            with closing_lock(lock):
                shutil.rmtree(abandoned, ignore_errors=True)
    return was_restored


def _restore_from(parking: Path, folder: Path) -> bool:
    """Move the old content back if its place is empty, and return whether that was done."""
    parked = parking / folder.name
    if not parked.is_dir():
        return False
    lock = lock_folder(parked)
    if lock is None:  # another process is replacing the folder at this moment
        return False
    was_restored = False
    with closing_lock(lock), explained_write_errors(folder):
        if not folder.exists():
            parked.rename(folder)
            was_restored = True
        elif parking.name.startswith(_prefix(folder, _old_label(folder))):
            # The folder in place is the one that replaced this content. Otherwise somebody else
            # made it, and the old content stays.
            shutil.rmtree(parking, ignore_errors=True)
    with suppress(OSError):
        parking.rmdir()
    return was_restored


def _old_label(fresh: Path) -> str:
    """Return the label of old content that is replaced by `fresh`, which its inode identifies."""
    return f"{_OLD}-{fresh.stat().st_ino}"


def _prefix(folder: Path, label: str) -> str:
    return f".{folder.name}.{label}-"


def _make_folder_beside(folder: Path, label: str) -> Path:
    return Path(tempfile.mkdtemp(prefix=_prefix(folder, label), dir=folder.parent))


def _folders_beside(folder: Path, label: str) -> list[Path]:
    return sorted(folder.parent.glob(glob.escape(_prefix(folder, label)) + "*"))
