"""Plain arrays in one `.npz` file: reproducible bytes, written whole or not at all, never pickled.

NumPy and relative imports only: this file is copied into the FMU.
"""

import io
import os
import tempfile
import zipfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import ReducedModelFileError

_TIMESTAMP = (1980, 1, 1, 0, 0, 0)  # the earliest that a zip archive can hold


def arrays_to_bytes(arrays: Mapping[str, npt.NDArray[Any]]) -> bytes:
    """Return the bytes of an `.npz` archive; equal arrays give equal bytes on every machine and day.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        The arrays by name; object arrays are refused (they would need pickle).

    Returns
    -------
    bytes
        The archive: not compressed, since the result of a compression depends on the library's version.

    Raises
    ------
    ValueError
        If an array holds Python objects.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=_TIMESTAMP)
            entry.external_attr = 0o644 << 16
            entry.create_system = 3
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(arrays[name], order="C"), allow_pickle=False)
            archive.writestr(entry, content.getvalue())
    return buffer.getvalue()


def arrays_from_bytes(
    content: bytes, where: str, wanted: Collection[str] = ()
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an `.npz` archive, checksums verified.

    Parameters
    ----------
    content : bytes
        The archive.
    where : str
        What is being read, for the error message.
    wanted : collection of str
        Names that must be there.

    Returns
    -------
    dict of str to ndarray
        The arrays by name.

    Raises
    ------
    ReducedModelFileError
        If the archive is damaged, cut short, lacks an array or holds anything but plain arrays.
    """
    arrays: dict[str, npt.NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for entry in archive.namelist():
                member = io.BytesIO(archive.read(entry))
                arrays[entry.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                if member.read(1):
                    raise ValueError("bytes follow an array")
    except Exception as cause:  # zipfile and NumPy answer damage with nearly every exception that there is
        reason = " ".join(str(cause).split()) or type(cause).__name__
        raise ReducedModelFileError(
            f"{where} is not a sound archive of plain arrays ({reason}); delete it and build it anew."
        ) from cause
    require_arrays(arrays, where, wanted)
    return arrays


def require_arrays(arrays: Mapping[str, npt.NDArray[Any]], where: str, wanted: Iterable[str]) -> None:
    """Raise `ReducedModelFileError` if one of the `wanted` names is not among the arrays of `where`."""
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise ReducedModelFileError(f"{where} lacks {', '.join(missing)}; build it anew.")


def write_bytes_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all: a reader never sees half of it, whatever happens meanwhile.

    Parameters
    ----------
    path : Path
        The file; its folder must exist.
    content : bytes
        What it is to hold.

    Raises
    ------
    OSError
        If the file cannot be written; an older file of that name is then untouched.
    """
    handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
