"""The data file of a compiled FMU: arrays of a reduced model, laid out as `sources/structure_data.h` says."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced_arrays import ReducedArrays

FloatArray = npt.NDArray[np.float64]

MAGIC = b"UAVTWIN\0"
VERSION = 2
NAME_BYTES = 32
_COUNT = struct.Struct("<II")


_UNUSED = ("nominal", "damping", "validity_box", "followed_shapes")
"""What the sources take from the variables, or do not need."""


def data_file_bytes(model: ReducedArrays) -> bytes:
    """Return the content of the data file of a model; equal models give equal bytes.

    Parameters
    ----------
    model : ReducedArrays
        The reduced structure. Its arrays are written under their names, scalars as arrays without dimension,
        and how many of each kind can be chosen in the place of names; arrays without values are left out.

    Returns
    -------
    bytes
        Magic, version, arrays, CRC-32.
    """
    values: dict[str, Any] = {item.name: getattr(model, item.name) for item in fields(ReducedArrays)}
    values["chosen_counts"] = tuple(
        len(names) for names in (model.parameters, model.regions, model.masses, model.controls)
    )
    values["gauge_count"] = len(model.gauges)
    arrays = {
        name: np.asarray(value, dtype=np.float64)
        for name, value in values.items()
        if name not in _UNUSED and not isinstance(value, str) and np.size(value)
    }
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
