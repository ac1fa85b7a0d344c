"""Offline: bases that are orthonormal in the energy norm of one stiffness X = L L', and solutions near it.

All is held in coordinates in which X is the identity: a displacement u as L' u, a load f as L^-1 f. They are
the same for u = X^-1 f. The energy norm of a displacement, and the dual norm of a load, is the length, and
what the condition number of X, about 1e10, would do to orthogonality is done to its root alone.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import qr
from scipy.sparse.linalg import LinearOperator, cg

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import SolutionError
from fe.sentences import said

from .factorisation import Factorisation

MOST_ITERATIONS = 100
"""Limit of conjugate gradients."""


def affine_product(terms: Sequence[Any], coefficients: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the sum of coefficients (T,) or (T, k) times sparse terms (n, n), times vectors (n, k)."""
    parts = (factor * (term @ vectors) for term, factor in zip(terms, coefficients, strict=True))
    return np.asarray(sum(parts))


def turned(terms: FloatArray, directions: FloatArray) -> FloatArray:
    """Return symmetric terms (T, n, n) in combinations (n, k) of the basis that they are in."""
    found = directions.T @ terms @ directions
    return np.asarray(0.5 * (found + found.swapaxes(1, 2)))  # what rounding made of the symmetry


def solved_near(
    factors: Factorisation, terms: Sequence[Any], coefficients: FloatArray, right: FloatArray,
    start: FloatArray, tolerance: float,
) -> FloatArray:  # fmt: skip
    """Solve systems near a factorised one by conjugate gradients, all in its coordinates.

    Parameters
    ----------
    factors : Factorisation
        Of a matrix to which all are spectrally equivalent.
    terms : sequence of sparse (n, n)
        What they are made of.
    coefficients : (T, k) ndarray
        Coefficients of the terms, a system each column.
    right, start : (n, k) ndarray
        Right-hand sides and starting values.
    tolerance : float
        Largest residual, relative to the right-hand side.

    Returns
    -------
    (n, k) ndarray
        The solutions.

    Raises
    ------
    SolutionError
        If the tolerance is not reached.
    """

    def product(flat: FloatArray) -> FloatArray:
        vectors = factors.unwhitened(flat.reshape(right.shape))
        return factors.whitened(affine_product(terms, coefficients, vectors)).ravel()

    size = np.linalg.norm(right, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    operator = LinearOperator((right.size, right.size), matvec=product, dtype=np.float64)
    given = ((right / size).ravel(), (start / size).ravel())
    found, missed = cg(operator, *given, rtol=0.0, atol=tolerance, maxiter=MOST_ITERATIONS)
    if missed:
        raise SolutionError(said("solution.iterations", tolerance=tolerance, most=MOST_ITERATIONS))
    return np.asarray(found.reshape(right.shape) * size)


class OrthonormalBasis:
    """A growing orthonormal basis.

    Parameters
    ----------
    size : int
        Length n of the vectors.
    drop : float
        A direction is dropped if it is less than this fraction of every vector of its block.

    Attributes
    ----------
    vectors : (n, k) ndarray
        The basis.
    dropped_square : float
        Bound of the sum of squared lengths of all that was dropped.
    """

    def __init__(self, size: int, *, drop: float) -> None:
        self.vectors = np.empty((size, 0))
        self.dropped_square, self._drop = 0.0, drop

    def extend(self, block: FloatArray) -> FloatArray:
        """Add vectors (n, m); return their coordinates (k, m) in the basis."""
        scale = np.linalg.norm(block, axis=0)
        rest = block / np.where(scale > 0.0, scale, 1.0)
        inside = np.zeros((self.vectors.shape[1], len(scale)))
        for _ in range(2):
            share = self.vectors.T @ rest
            rest -= self.vectors @ share
            inside += share
        directions, triangle, order = qr(rest, mode="economic", pivoting=True, overwrite_a=True)
        new = np.linalg.norm(triangle, axis=1) > self._drop
        outside = np.empty_like(triangle)
        outside[:, order] = triangle * scale[order]
        self.dropped_square += float(np.sum(outside[~new] ** 2))
        self.vectors = np.concatenate((self.vectors, directions[:, new]), axis=1)
        return np.concatenate((inside * scale, outside[new]))


class ProjectedBasis(OrthonormalBasis):
    """A growing basis of displacements, orthonormal in the energy norm, with sparse terms projected on it.

    Parameters
    ----------
    factors : Factorisation
        X.
    *sums : tuple of csr (n, n)
        The terms of each sum.
    drop : float
        As of `OrthonormalBasis`.

    Attributes
    ----------
    displacements : (n, k) ndarray
        The basis vectors themselves, L'^-1 `vectors`.
    inner : list of (T, k, k) ndarray
        The terms of each sum in the basis.
    """

    def __init__(self, factors: Factorisation, *sums: tuple[Any, ...], drop: float) -> None:
        super().__init__(factors.stiffness.shape[0], drop=drop)
        self.displacements, self.factors, self._sums = self.vectors, factors, sums
        self.inner = [np.empty((len(terms), 0, 0)) for terms in sums]

    def add(self, block: FloatArray) -> list[FloatArray]:
        """Add what is new in vectors (n, m); return the terms (T, n, new) of each sum times that."""
        before = self.vectors.shape[1]
        self.extend(block)
        new = self.factors.unwhitened(self.vectors[:, before:])
        self.displacements = np.concatenate((self.displacements, new), axis=1)
        images = [np.stack([term @ new for term in terms]) for terms in self._sums]
        for number, (old, parts) in enumerate(zip(self.inner, images, strict=True)):
            added = self.displacements.T @ parts
            beside = added[:, :before]
            self.inner[number] = np.block([[old, beside], [beside.swapaxes(1, 2), added[:, before:]]])
        return images
