"""Lowest eigenmodes of sparse matrices, and those that a load moves most."""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, norm

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import SolutionError

from .statics import Factorisation

MODE_RESIDUAL_LIMIT = 1e-12
"""Largest max|K phi - omega^2 M phi| / (|K| max|phi|), in maximum norms, of an accepted mode."""


def most_moved(load: FloatArray, values: FloatArray, shapes: FloatArray) -> IntArray:
    """Find the two modes (2,), ascending, that contribute most to the compliance under a load.

    Parameters
    ----------
    load : (n,)
        The load, on what the shapes are of.
    values, shapes : (m,), (n, m)
        Squared angular frequencies and mass-normalised shapes.
    """
    return np.asarray(np.sort(np.argsort((load @ shapes) ** 2 / values)[-2:]))


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
    inverse = LinearOperator((size, size), matvec=factors.riesz, dtype=float)
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
