"""Sums and modes of small dense matrices.

NumPy and relative imports only: this file is copied into the FMU.
"""

import numpy as np

from .arrays import FloatArray


def dense_sum(coefficients: FloatArray, terms: FloatArray) -> FloatArray:
    """Return the sum of dense matrices (T, n, m) times coefficients (T,)."""
    flat_terms = terms.reshape(len(terms), -1)
    return np.asarray((coefficients @ flat_terms).reshape(terms.shape[1:]))


def lowest_modes(
    stiffness: FloatArray, mass: FloatArray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Compute the lowest undamped modes of dense matrices.

    The problem is solved as M x = K x / omega^2. In a basis of modes the stiffness is well
    conditioned and the mass is not; the low modes then belong to the largest eigenvalues, which are
    accurate.

    Parameters
    ----------
    stiffness, mass : (n, n) array
        K and M.
    count : int
        Number of modes.

    Returns
    -------
    frequency : (count,) array
        Natural frequencies [Hz], ascending.
    shape : (n, count) array
        Mass-normalised shapes.
    """
    # the standard problem L^-1 M L^-T y = y / omega^2, where K = L L^T and x = L^-T y
    inverse_cholesky = np.linalg.inv(np.linalg.cholesky(stiffness))
    standard_matrix = inverse_cholesky @ mass @ inverse_cholesky.T
    inverse_squares, vectors = np.linalg.eigh(standard_matrix)
    # from ascending to descending eigenvalues, the lowest modes first
    descending_squares = inverse_squares[::-1]
    descending_vectors = vectors[:, ::-1]
    inverse_omega = np.sqrt(descending_squares[:count])
    frequency = 1.0 / (2.0 * np.pi * inverse_omega)
    shape = inverse_cholesky.T @ descending_vectors[:, :count] / inverse_omega
    return frequency, shape
