"""Named arrays as bytes, to the last bit and without pickles."""

import io
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.errors import InvalidModelError


def packed_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays as bytes, the same for the same arrays."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, value in arrays.items():
            with archive.open(zipfile.ZipInfo(name), "w") as member:
                np.lib.format.write_array(member, np.asarray(value), allow_pickle=False)
    return content.getvalue()


def unpacked_arrays(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of `packed_arrays`.

    Raises
    ------
    InvalidModelError
        The bytes are no packed arrays.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {
                name: np.lib.format.read_array(io.BytesIO(archive.read(name)), allow_pickle=False)
                for name in archive.namelist()
            }
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InvalidModelError(f"these bytes hold no arrays: {error}") from error
