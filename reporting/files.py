"""Files that are either whole or not there: atomic writes; and hashes of contents.

Everything is written under a temporary name in the folder of its destination, flushed to the disk and moved
into place in one step. A kill, a full disk or a refused permission leaves the previous file as it was.
"""

import errno
import hashlib
import itertools
import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from reporting.errors import DiskFullError, FileNotWrittenError

TEMPORARY_SUFFIX = ".partial"
"""Ending of the temporary names, so that a leftover of a killed process is recognisable."""

_NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
_REFUSED = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
_temporary_count = itertools.count()


def write_error(error: OSError, path: Path) -> FileNotWrittenError:
    """Return the exception with one clear sentence for an operating-system error met while writing `path`."""
    if error.errno in _NO_SPACE:
        return DiskFullError(
            f"No space is left on the disk to write {path}: free some space and repeat; "
            "what was there before is unchanged."
        )
    if error.errno in _REFUSED:
        return FileNotWrittenError(
            f"Writing {path} is not permitted: choose another place or change the permissions of its folder."
        )
    if error.errno in (errno.ENOENT, errno.ENOTDIR) and not path.parent.is_dir():
        return FileNotWrittenError(
            f"{path} cannot be written because its folder {path.parent} does not exist."
        )
    return FileNotWrittenError(f"{path} could not be written: {error.strerror or error}.")


@contextmanager
def written(path: Path) -> Iterator[None]:
    """Turn what the operating system refuses while writing `path` into one clear sentence."""
    try:
        yield
    except OSError as error:
        raise write_error(error, path) from error


def _destination(path: Path) -> Path:
    """Return the file behind `path` (links followed); refuse a folder and a device."""
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "not an ordinary file"
        raise FileNotWrittenError(f"{path} cannot be written because it is {kind}: choose another name.")
    return target


def synchronise(path: Path) -> None:
    """Flush a file or a folder to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot flush a folder; the move itself is atomic there all the same.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)


def refuse_existing(path: Path | None, *, replace: bool, option: str = "--out") -> None:
    """Refuse a file that is there and may not be replaced, before anything is computed for it.

    Raises
    ------
    FileNotWrittenError
        `path` exists, and `replace` is not set.
    """
    if path is not None and path.exists() and not replace:
        raise FileNotWrittenError(f"{path} exists: choose another {option} or give --replace.")


def refuse_filled(folder: Path | None, option: str = "--out") -> None:
    """Refuse a folder to write that holds something, or that is a file.

    Raises
    ------
    FileNotWrittenError
        `folder` exists and is not an empty folder.
    """
    if folder is not None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileNotWrittenError(f"{folder} exists and is not an empty folder: choose another {option}.")


@contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to, and move it to `path` when the block ends without an exception.

    For writers that want a file name (NetCDF, zip, VTU). The temporary file lies in the same folder and has
    the same ending as `path`. If the block raises, the temporary file is removed and `path` is unchanged.

    Parameters
    ----------
    path
        Destination; replaced if it exists, and its folder made if it is missing. A symbolic link is followed.

    Raises
    ------
    DiskFullError
        No space is left.
    FileNotWrittenError
        The folder cannot be made or is read-only, or `path` is a folder or a device.
    """
    requested = Path(path)
    target = _destination(requested)
    label = f"{os.getpid()}-{next(_temporary_count)}"
    temporary = target.with_name(f".{target.stem}.{label}{TEMPORARY_SUFFIX}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # Created here, with the permissions of the user's umask and not those of a private temporary file.
        os.close(os.open(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o666))
        yield temporary
        synchronise(temporary)
        temporary.replace(target)
        synchronise(target.parent)
    except OSError as error:
        raise write_error(error, requested) from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def atomic_write_bytes(path: str | os.PathLike[str], data: bytes) -> Path:
    """Write bytes to `path` in one step; return the path.

    Raises
    ------
    DiskFullError, FileNotWrittenError
        As `atomic_file`.
    """
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def atomic_write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write text to `path` in UTF-8 with the line ends as given, in one step; return the path.

    Raises
    ------
    DiskFullError, FileNotWrittenError
        As `atomic_file`.
    """
    return atomic_write_bytes(path, text.encode("utf-8"))


def members_of(folder: Path, suffixes: Collection[str] = ()) -> dict[str, bytes]:
    """Return the files below a folder, or those with one of the suffixes, by their places in it, in order."""
    found = (
        path for path in folder.rglob("*") if path.is_file() and (not suffixes or path.suffix in suffixes)
    )
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(found)}


def write_members(folder: Path, members: Mapping[str, bytes]) -> None:
    """Write files to their places in a folder, those that are not there yet; raises as `atomic_file`."""
    for name, content in members.items():
        if not (folder / name).exists():
            atomic_write_bytes(folder / name, content)


def remove_leftovers(folder: str | os.PathLike[str]) -> int:
    """Remove the temporary files that killed processes left in `folder`; return how many there were.

    Only for a folder that no other process writes to at this moment.
    """
    leftovers = [path for path in Path(folder).glob(f".*{TEMPORARY_SUFFIX}*") if path.is_file()]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return len(leftovers)


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
