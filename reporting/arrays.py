"""Types of arrays, numbers of users as arrays, and products of rows that are alike in all bits."""

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


def product_of_each(rows: Float, matrix: Float) -> Float:
    """Return the product (..., N) of each row (..., S) and a matrix (S, N), or its own (..., S, N).

    Each product is computed by itself: in a product of all rows at once, the last bits of a row
    depend on the number of rows.
    """
    return np.asarray(np.matmul(rows[..., None, :], matrix).squeeze(axis=-2))
