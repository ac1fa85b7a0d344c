"""Lowest eigenmodes of sparse matrices, tracked by their shapes."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, norm

from fe.runtime.errors import SolutionError

from .statics import Factorisation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MODE_RESIDUAL_LIMIT = 1e-12
"""Largest max|K phi - omega^2 M phi| / (|K| max|phi|), in maximum norms, of an accepted mode."""


def modal_assurance(first: FloatArray, second: FloatArray, mass: sparse.sparray) -> FloatArray:
    """Mass-weighted modal assurance criterion (m1, m2) of shapes (n, m1) and (n, m2); 1 for equal shapes."""
    weighted = mass @ second
    cross = (first.T @ weighted) ** 2
    own_first = np.einsum("im,im->m", first, mass @ first)
    own_second = np.einsum("im,im->m", second, weighted)
    return np.asarray(cross / np.outer(own_first, own_second))


def track(reference: FloatArray, shapes: FloatArray, mass: sparse.sparray) -> IntArray:
    """Index (m1,) of the mode in `shapes` (n, m2) that continues each of `reference` (n, m1), m1 <= m2.

    The assignment has the greatest sum of modal assurance criteria, so that crossing modes keep their names.
    """
    assurance = modal_assurance(reference, shapes, mass)
    rows, columns = linear_sum_assignment(assurance, maximize=True)
    result = np.empty(reference.shape[1], dtype=np.int64)
    result[rows] = columns
    return result


def lowest_eigenpairs(
    stiffness: sparse.sparray, mass: sparse.sparray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Lowest eigenvalues (count,) [rad^2/s^2] and vectors (n, count) by shift-inverted Lanczos.

    Raises
    ------
    SolutionError
        If the iteration did not converge to `MODE_RESIDUAL_LIMIT`.
    """
    factors = Factorisation(stiffness)
    size = stiffness.shape[0]
    inverse = LinearOperator((size, size), matvec=factors.raw_solve, dtype=float)
    start = np.random.default_rng(16).standard_normal(size)  # fixed: the same model gives the same bytes
    try:
        values, shapes = eigsh(stiffness, k=count, M=mass, sigma=0.0, OPinv=inverse, v0=start)
    except ArpackNoConvergence as error:
        raise SolutionError(f"Only {len(error.eigenvalues)} of {count} eigenmodes converged.") from None
    order = np.argsort(values)
    values, shapes = values[order], shapes[:, order]
    scale = float(norm(stiffness, np.inf)) * np.abs(shapes).max(axis=0)
    residual = np.abs(stiffness @ shapes - (mass @ shapes) * values).max(axis=0) / scale
    if not residual.max() <= MODE_RESIDUAL_LIMIT:
        raise SolutionError(
            f"Eigenmode {int(residual.argmax())} has a residual of {residual.max():.2g}, more than "
            f"{MODE_RESIDUAL_LIMIT:g}; the stiffness matrix is nearly singular."
        )
    return values, shapes
