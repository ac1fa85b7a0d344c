"""The data file of the compiled FMU: arrays of a reduced model, in the layout of `sources/wing_data.h`."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced_arrays import ReducedArrays

FloatArray = npt.NDArray[np.float64]

MAGIC = b"UAVWING\0"
VERSION = 1
NAME_BYTES = 32
_COUNT = struct.Struct("<II")


def data_file_bytes(model: ReducedArrays) -> bytes:
    """Return the content of the data file of a model; equal models give equal bytes.

    Parameters
    ----------
    model : ReducedArrays
        The reduced wing. All its numeric fields are written under their names, scalars as arrays without
        dimension; arrays without values are left out.

    Returns
    -------
    bytes
        Magic, version, arrays, CRC-32.
    """
    arrays = {}
    for item in fields(ReducedArrays):
        value = getattr(model, item.name)
        if not isinstance(value, str) and np.size(value):
            arrays[item.name] = np.asarray(value, dtype=np.float64)
    return pack_arrays(arrays)


def pack_arrays(arrays: Mapping[str, FloatArray]) -> bytes:
    """Return arrays as the bytes of a data file.

    Parameters
    ----------
    arrays : mapping of str to ndarray
        The arrays by name, at most 31 ASCII letters; float64.

    Returns
    -------
    bytes
        The file.
    """
    parts = [MAGIC, _COUNT.pack(VERSION, len(arrays))]
    for name in sorted(arrays):
        array = arrays[name]
        parts.append(name.encode("ascii")[: NAME_BYTES - 1].ljust(NAME_BYTES, b"\0"))
        parts.append(_COUNT.pack(array.ndim, 0))
        parts.append(struct.pack(f"<{array.ndim}Q", *array.shape))
        parts.append(np.ascontiguousarray(array, dtype="<f8").tobytes())
    content = b"".join(parts)
    return content + struct.pack("<I", zlib.crc32(content))
