"""The data file of a compiled FMU: arrays of a reduced model, laid out as `sources/structure_data.h` says."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from fe.runtime.reduced_arrays import AffineArrays, ReducedArrays
from fe.runtime.structure_arrays import StructureArrays

FloatArray = npt.NDArray[np.float64]

MAGIC = b"UAVTWIN\0"
VERSION = 2
NAME_BYTES = 32
_COUNT = struct.Struct("<II")


def data_file_bytes(model: ReducedArrays | StructureArrays) -> bytes:
    """Return the content of the data file of a model; equal models give equal bytes.

    Parameters
    ----------
    model : ReducedArrays or StructureArrays
        The reduced wing or structure. The arrays of `AffineArrays` are written under their names, and what
        their terms are times as `StructureArrays` has it; scalars as arrays without dimension. Arrays without
        values are left out, and so is the validity box, whose ranges are those of the variables.

    Returns
    -------
    bytes
        Magic, version, arrays, CRC-32.
    """
    arrays = {}
    numbers = [item.name for item in fields(AffineArrays) if item.name != "validity_box"]
    for name, value in ({name: getattr(model, name) for name in numbers} | _composition(model)).items():
        if not isinstance(value, str) and np.size(value):
            arrays[name] = np.asarray(value, dtype=np.float64)
    return pack_arrays(arrays)


def _composition(model: ReducedArrays | StructureArrays) -> dict[str, Any]:
    """Return how many of each kind can be chosen, what the terms are times, and what the outputs are."""
    regions = len(model.regions)
    if isinstance(model, StructureArrays):
        counts = (len(model.parameters), regions, len(model.masses), len(model.controls))
        gauges, stiffness, load = len(model.gauges), model.stiffness_factors, model.load_factors
    else:  # e; servo and pitot mass; load factor and tip force
        counts, gauges = (1, regions, 2, 2), len(model.static_output) - 1
        stiffness = np.array([(1, 0), *((0, region) for region in range(1, regions + 1)), (0, 0)])
        load = np.array([(1, 0), (2, 0)])
    return {
        "chosen_counts": counts,
        "gauge_count": gauges,
        "mode_count": model.mode_count,
        "stiffness_factors": stiffness,
        "load_factors": load,
    }


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
