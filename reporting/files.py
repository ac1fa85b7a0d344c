"""Atomic writes of files, and hashes of their contents.

A file is written under a temporary name in the folder of its destination, flushed to the disk and
moved into place in one step. After a kill, a full disk or a refused permission the previous file is
as it was.
"""

import errno
import hashlib
import itertools
import json
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from reporting.errors import DiskFullError, FileNotWrittenError
from reporting.system.operating_system import can_flush, flag_for_flushing, open_descriptor

TEMPORARY_SUFFIX = ".partial"
"""Ending of temporary names, which marks the leftovers of a killed process."""

NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Codes of the operating system for a full disk, a used quota and a too large file."""
_NO_PERMISSION = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
_SERVICE = re.compile(r"[a-z][a-z0-9+.-]+:")
"""The beginning of an address; the drives of Windows have one letter."""
_TOO_MANY_FILES = frozenset({errno.EMFILE, errno.ENFILE})
_temporary_file_numbers = itertools.count()


def write_error(error: OSError, path: Path) -> FileNotWrittenError:
    """Return the exception that says why the operating system could not write a file.

    Parameters
    ----------
    error : OSError
        The error of the operating system.
    path : Path
        The file that was being written.
    """
    if error.errno in NO_SPACE:
        return DiskFullError(
            f"No space is left on the disk to write {path}: free some space and repeat; "
            "what was there before is unchanged."
        )
    if error.errno in _NO_PERMISSION:
        return FileNotWrittenError(
            f"Writing {path} is not permitted: "
            "choose another place or change the permissions of its folder."
        )
    if error.errno in (errno.ENOENT, errno.ENOTDIR) and not path.parent.is_dir():
        return FileNotWrittenError(
            f"{path} cannot be written because its folder {path.parent} does not exist."
        )
    if error.errno in _TOO_MANY_FILES:
        return FileNotWrittenError(
            f"{path} could not be written because too many files are open: allow more by "
            "`ulimit -n`."
        )
    return FileNotWrittenError(f"{path} could not be written: {error.strerror or error}.")


@contextmanager
def explained_write_errors(path: Path) -> Iterator[None]:
    """Return a context that raises errors of the operating system as `write_error` of a path.

    Raises
    ------
    DiskFullError, FileNotWrittenError
        If the operating system refuses to write.
    """
    try:
        yield
    except OSError as error:
        raise write_error(error, path) from error


def _destination(path: Path) -> Path:
    """Return the file that a path leads to, following symbolic links.

    A folder, a device or an address is refused.
    """
    refuse_address(path)
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        kind = "a folder" if target.is_dir() else "not an ordinary file"
        raise FileNotWrittenError(
            f"{path} cannot be written because it is {kind}: choose another name."
        )
    return target


def refuse_address(path: Path) -> None:
    """Refuse a path that is the address of a service, such as s3://BUCKET/NAME.

    An address is recognised by its first part, such as "s3:", since `Path` joins its two slashes.

    Raises
    ------
    FileNotWrittenError
        If the path begins like an address, and no folder of this machine has that name.
    """
    first_part = path.parts[0] if path.parts else ""
    if _SERVICE.fullmatch(first_part) and not Path(first_part).exists():
        raise FileNotWrittenError(
            f"{path} is an address, but a file or folder of this machine is expected: choose "
            "another name."
        )


def synchronise(path: Path) -> None:
    """Flush a file or a folder to the disk, so that it survives a power failure.

    A folder is left alone on a system that cannot flush it.
    """
    if not can_flush(path):
        return
    descriptor = os.open(path, flag_for_flushing())
    try:
        os.fsync(descriptor)
    except OSError as error:
        # Some file systems cannot flush a folder; moving a file is still atomic there.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EBADF):
            raise
    finally:
        os.close(descriptor)


def write_at(path: Path, data: bytes, position: int) -> None:
    """Write bytes at a position of an existing file; the file is opened and closed for them.

    The bytes are not flushed to the disk: they survive a kill of the process, but no power failure.

    Parameters
    ----------
    data : bytes
        The bytes.
    position : int
        The position of the first byte in the file [bytes].

    Raises
    ------
    OSError
        If there is no such file, or if the system could not write all of the bytes.
    """
    descriptor = open_descriptor(path, os.O_WRONLY)
    try:
        os.lseek(descriptor, position, os.SEEK_SET)
        written_bytes = 0
        # The operating system may write less than it is given
        while written_bytes < len(data):
            written_bytes += os.write(descriptor, data[written_bytes:])
    finally:
        os.close(descriptor)


def refuse_existing(path: Path | None, *, replace: bool, option: str = "--out") -> None:
    """Refuse to replace an existing file, before its content is computed.

    Parameters
    ----------
    path : Path, optional
        The file to write.
    option : str
        The option that gives the path, for the message.

    Raises
    ------
    FileNotWrittenError
        If the file exists and may not be replaced.
    """
    if path is not None and path.exists() and not replace:
        raise FileNotWrittenError(f"{path} exists: choose another {option} or give --replace.")


def refuse_filled(folder: Path | None, option: str = "--out") -> None:
    """Refuse to write into a folder that is not empty, or that is a file.

    Parameters
    ----------
    folder : Path, optional
        The folder to write.
    option : str
        The option that gives the folder, for the message.

    Raises
    ------
    FileNotWrittenError
        If the path exists and is not an empty folder.
    """
    if folder is None or not folder.exists():
        return
    is_empty_folder = folder.is_dir() and not any(folder.iterdir())
    if not is_empty_folder:
        raise FileNotWrittenError(
            f"{folder} exists and is not an empty folder: choose another {option}."
        )


@contextmanager
def atomic_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Return a context with a temporary file, which replaces `path` at the end of the block.

    For writers that need a file name (NetCDF, zip, VTU). The temporary file lies in the same folder
    and has the same ending as `path`. If the block raises, the temporary file is removed and `path`
    is unchanged.

    Parameters
    ----------
    path : str or path-like
        The file to write. A symbolic link is followed, and a missing folder is made.

    Yields
    ------
    Path
        The temporary file.

    Raises
    ------
    DiskFullError
        If no space is left.
    FileNotWrittenError
        If the folder cannot be made or is read-only, or `path` is a folder or a device.
    """
    requested = Path(path)
    target = _destination(requested)
    label = f"{os.getpid()}-{next(_temporary_file_numbers)}"
    temporary = target.with_name(f".{target.stem}.{label}{TEMPORARY_SUFFIX}{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        # The user's umask gives the permissions; `tempfile` would make a private file.
        os.close(open_descriptor(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC))
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
    """Write bytes to a file in one step, and return its path; raises as `atomic_file`."""
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)
    return Path(path)


def atomic_write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write text to a file in one step, and return its path; raises as `atomic_file`.

    The text is encoded in UTF-8; its line ends stay as they are.
    """
    return atomic_write_bytes(path, text.encode("utf-8"))


def read_members(folder: Path, suffixes: Collection[str] = ()) -> dict[str, bytes]:
    """Read the files below a folder into memory, and return their contents by relative path.

    The entries are sorted by path.

    Parameters
    ----------
    suffixes : collection of str
        The suffixes of the files to read, such as ".py"; all files by default.
    """
    files = [path for path in folder.rglob("*") if path.is_file()]
    if suffixes:
        files = [path for path in files if path.suffix in suffixes]
    members = {}
    for path in sorted(files):
        relative_path = path.relative_to(folder).as_posix()
        members[relative_path] = path.read_bytes()
    return members


def write_members(folder: Path, members: Mapping[str, bytes]) -> None:
    """Write files below a folder; raises as `atomic_file`. A file that exists is left unchanged.

    Parameters
    ----------
    members : mapping of str to bytes
        The contents by relative path.
    """
    for name, content in members.items():
        if not (folder / name).exists():
            atomic_write_bytes(folder / name, content)


def remove_leftovers(folder: str | os.PathLike[str]) -> int:
    """Remove temporary files that killed processes have left in a folder.

    No other process may be writing to the folder meanwhile.

    Returns
    -------
    int
        The number of files removed.
    """
    leftovers = [path for path in Path(folder).glob(f".*{TEMPORARY_SUFFIX}*") if path.is_file()]
    for path in leftovers:
        path.unlink(missing_ok=True)
    return len(leftovers)


def hash_tree(root: Path, *, suffixes: Iterable[str]) -> str:
    """Return the SHA-256 over names and contents of the files below a folder with these suffixes.

    Line ends of Windows and of Unix give the same hash.
    """
    members = read_members(root, frozenset(suffixes))
    with_unix_ends = {name: content.replace(b"\r\n", b"\n") for name, content in members.items()}
    return hash_members(with_unix_ends)


def hash_members(members: Mapping[str, bytes]) -> str:
    """Return the SHA-256 over the names and contents of files; their order does not matter."""
    digest = hashlib.sha256()
    for name, content in sorted(members.items()):
        digest.update(f"{name}\0{len(content)}\0".encode())
        digest.update(content)
    return digest.hexdigest()


def hash_bytes(data: bytes) -> str:
    """Return the SHA-256 of bytes, as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def hash_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of the content of a file."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def hash_record(record: object) -> str:
    """Return the SHA-256 of plain data as JSON; the order of keys does not matter.

    Raises
    ------
    TypeError
        If the record holds something that JSON cannot express.
    ValueError
        If the record holds NaN or an infinity.
    """
    text = json.dumps(
        record, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return hash_bytes(text.encode("utf-8"))
