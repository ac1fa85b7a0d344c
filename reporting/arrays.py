"""Types of arrays, by the names that signatures use, and numbers of users as arrays."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]
Single = NDArray[np.float32]
Index = NDArray[np.int64]
Unsigned = NDArray[np.uint64]
AnyArray = NDArray[Any]

LEAST_DIVISOR = 1e-300
"""Stands for a divisor of zero, so that a quotient is large and not infinite or undefined."""


def nan_where_masked(values: ArrayLike) -> Float:
    """Return numbers as an array of floats, with NaN where a masked array of NumPy masks them.

    Without a mask the result may share memory with the argument.
    """
    return np.asarray(np.ma.filled(np.ma.asarray(values, dtype=np.float64), np.nan))
