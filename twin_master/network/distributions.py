"""Probability distributions, stochastic matrices and the shapes of arrays, checked where they come in."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index
from twin_master.errors import InvalidModelError, TwinMasterError, said

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
    InvalidModelError
        With the index of the first row that is no distribution.
    """
    matrix = np.array(rows, dtype=np.float64, order="C")
    if matrix.ndim == 0 or matrix.size == 0:
        raise InvalidModelError(said("network.no_rows", name=name, shape=matrix.shape))
    for bad, reason in (
        (~np.isfinite(matrix).all(axis=-1), "holds a value that is not finite"),
        ((matrix < 0.0).any(axis=-1), "holds a negative probability"),
        (np.abs(matrix.sum(axis=-1) - 1.0) > ROW_SUM_TOLERANCE, "does not sum to one"),
    ):
        if np.any(bad):
            where = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0]) if matrix.ndim > 1 else ()
            row = matrix[where]
            label = f"row {where[0] if len(where) == 1 else where}" if where else "the distribution"
            sizes, what = (row.sum(), row.min()), f"{name}: {label} {reason}"
            raise InvalidModelError(said("network.no_distribution", what=what, sizes=sizes))
    matrix.setflags(write=False)
    return matrix


def distribution(probabilities: ArrayLike, *, size: int, name: str) -> Float:
    """Return one checked, read-only probability distribution of length `size`.

    Raises
    ------
    InvalidModelError
        If it has another shape, or does not pass `stochastic_matrix`.
    """
    vector = stochastic_matrix(probabilities, name=name)
    expect_shape(name, vector.shape, size)
    return vector


def expect_shape(
    what: str, shape: Sequence[int], *wanted: int | str, error: type[TwinMasterError] = InvalidModelError
) -> None:
    """Refuse an array of another shape.

    Parameters
    ----------
    what : str
        What it is, for the sentence.
    shape : tuple of int
        That it has.
    *wanted : int or str
        Lengths of its axes; a word stands for any length.
    error : type
        What is raised.
    """
    pairs = zip(wanted, shape, strict=False)
    if len(shape) != len(wanted) or any(isinstance(length, int) and length != has for length, has in pairs):
        told = ", ".join(map(str, wanted)) + "," * (len(wanted) == 1)
        raise error(f"expected {what} of shape ({told}), got {tuple(shape)}")


def expect_controls(index: int | Index, count: int) -> None:
    """Refuse indices of controls, an array of any shape, that are none of `count`."""
    low, high = np.min(index, initial=0), np.max(index, initial=0)
    if low < 0 or high >= count:
        raise InvalidModelError(f"expected control indices between 0 and {count - 1}, got {low} to {high}")
