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
from reporting.files import explained_write_errors, refuse_address
from reporting.system.operating_system import lock_folder

_NEW = "new"
_OLD = "old"
_REPLACED = "replaced"


@contextmanager
def closing_lock(lock: int) -> Iterator[None]:
    """Return a context that releases the lock of a folder when it ends."""
    try:
        yield
    finally:
        os.close(lock)


def fresh_folder(folder: Path) -> Path:
    """Make an empty temporary folder next to `folder`, and return it.

    Missing parents of `folder` are made. The new folder has the permissions of the user's umask,
    and the caller removes it or moves it into place.

    Raises
    ------
    OSError
        If the location is not writable.
    FileNotWrittenError
        If the path is an address.
    """
    refuse_address(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = _make_folder_beside(folder, _NEW)
    # The umask can only be read by setting it.
    umask = os.umask(0)
    os.umask(umask)
    fresh.chmod(0o777 & ~umask)
    return fresh


def _lock_or_refuse(folder: Path) -> int:
    """Lock a folder and return the file descriptor; refuse if another process has locked it."""
    lock = lock_folder(folder)
    if lock is None:
        raise FileNotWrittenError(f"another process is replacing {folder}: look at what it leaves.")
    return lock


@contextmanager
def whole_folder(
    folder: Path, lock: Callable[[Path], int] = _lock_or_refuse, lock_owner: ExitStack | None = None
) -> Iterator[Path]:
    """Return a context with an empty folder, which replaces `folder` at the end of the context.

    If the block raises an exception, `folder` is unchanged.

    Parameters
    ----------
    folder : Path
        The folder to write.
    lock : callable
        Locks a folder for this process and returns the file descriptor, or raises an exception.
    lock_owner : ExitStack, optional
        Holds the lock of the new folder until it is closed. By default the lock ends with the
        context.

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
    """Replace a folder by a new one, and remove the old one; the caller has locked both.

    If the process is killed meanwhile, either the new or the old folder is in place, or
    `restore_folder` can put the old one back.

    Raises
    ------
    OSError
        If the location is not writable; the old folder is unchanged.
    """
    parking_folder = _make_folder_beside(folder, _old_label(fresh))
    old_content = parking_folder / folder.name
    try:
        folder.rename(old_content)
        fresh.rename(folder)
    except OSError:
        if old_content.is_dir():
            old_content.rename(folder)
        parking_folder.rmdir()
        raise
    # The label of this name tells a later process that it may remove the old content.
    discarded = _make_folder_beside(folder, _REPLACED)
    parking_folder.rename(discarded)
    shutil.rmtree(discarded, ignore_errors=True)


def restore_folder(folder: Path) -> bool:
    """Put back the old content of a folder if a killed process had moved it away.

    The process was killed in `replace_folder`. Content that it had already replaced or had only
    begun to write is removed.

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
    for parking_folder in _folders_beside(folder, _OLD):
        if _restore_from(parking_folder, folder):
            was_restored = True
    for abandoned in (*_folders_beside(folder, _NEW), *_folders_beside(folder, _REPLACED)):
        lock = lock_folder(abandoned)
        if lock is not None:
            with closing_lock(lock):
                shutil.rmtree(abandoned, ignore_errors=True)
    return was_restored


def _restore_from(parking: Path, folder: Path) -> bool:
    """Deal with old content that `replace_folder` has moved away; return whether it was put back.

    The old content is

    - left alone as long as another process has it locked;
    - put back if `folder` does not exist;
    - removed if `folder` is the one that replaced it;
    - kept if `folder` is any other, which somebody else has made.
    """
    old_content = parking / folder.name
    if not old_content.is_dir():
        return False
    # A process that replaces a folder holds the lock of the old content until it has finished. If
    # the lock can be had, that process has ended.
    lock = lock_folder(old_content)
    if lock is None:
        return False
    was_restored = False
    with closing_lock(lock), explained_write_errors(folder):
        if not folder.exists():
            old_content.rename(folder)
            was_restored = True
        elif _was_replaced_by(parking, folder):
            shutil.rmtree(parking, ignore_errors=True)
    with suppress(OSError):  # a parking folder that is not empty stays
        parking.rmdir()
    return was_restored


def _was_replaced_by(parking: Path, folder: Path) -> bool:
    """Return whether parked content was replaced by the folder that is there now.

    The name of the parking folder contains the inode of the folder that was to replace the content.
    """
    return parking.name.startswith(_prefix(folder, _old_label(folder)))


def _old_label(fresh: Path) -> str:
    """Return the label of old content; it contains the inode of the folder that replaces it."""
    return f"{_OLD}-{fresh.stat().st_ino}"


def _prefix(folder: Path, label: str) -> str:
    """Return how the names of temporary folders of one kind next to `folder` begin."""
    return f".{folder.name}.{label}-"


def _make_folder_beside(folder: Path, label: str) -> Path:
    """Make a temporary folder next to `folder`, with a label that says its kind."""
    return Path(tempfile.mkdtemp(prefix=_prefix(folder, label), dir=folder.parent))


def _folders_beside(folder: Path, label: str) -> list[Path]:
    """Return the temporary folders of a kind that lie next to `folder`."""
    return sorted(folder.parent.glob(glob.escape(_prefix(folder, label)) + "*"))
