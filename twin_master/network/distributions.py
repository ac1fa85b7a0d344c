"""Probability distributions and stochastic matrices, checked once where they come in."""

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from twin_master.errors import InvalidDistributionError

ROW_SUM_TOLERANCE = 1e-12
"""Largest departure of the sum of a probability distribution from one."""


def stochastic_matrix(rows: ArrayLike, *, name: str) -> Float:
    """Return `rows` as a checked, read-only array of probability distributions along the last axis.

    Parameters
    ----------
    rows : (..., n) dimensionless
        Finite, non-negative, each row summing to one within `ROW_SUM_TOLERANCE`.
    name : str
        What the matrix is, for the error message.

    Raises
    ------
    InvalidDistributionError
        With the index of the first row that is no distribution.
    """
    matrix = np.array(rows, dtype=np.float64, order="C")
    if matrix.ndim == 0 or matrix.size == 0:
        raise InvalidDistributionError(
            f"{name}: expected rows of probabilities, got an array of shape {matrix.shape}"
        )
    for bad, reason in (
        (~np.isfinite(matrix).all(axis=-1), "holds a value that is not finite"),
        ((matrix < 0.0).any(axis=-1), "holds a negative probability"),
        (np.abs(matrix.sum(axis=-1) - 1.0) > ROW_SUM_TOLERANCE, "does not sum to one"),
    ):
        if np.any(bad):
            where = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0]) if matrix.ndim > 1 else ()
            row = matrix[where]
            label = f"row {where[0] if len(where) == 1 else where}" if where else "the distribution"
            raise InvalidDistributionError(
                f"{name}: {label} {reason} (sum {row.sum():.15g}, smallest {row.min():.6g}); "
                "every row must be non-negative and sum to one within 1e-12"
            )
    matrix.setflags(write=False)
    return matrix


def distribution(probabilities: ArrayLike, *, size: int, name: str) -> Float:
    """Return one checked, read-only probability distribution of length `size`.

    Raises
    ------
    InvalidDistributionError
        If it has another shape, or does not pass `stochastic_matrix`.
    """
    vector = stochastic_matrix(probabilities, name=name)
    if vector.shape != (size,):
        raise InvalidDistributionError(f"{name}: expected shape ({size},), got {vector.shape}")
    return vector
