"""Tools of the offline reduction: one factorised stiffness, its norm, and bases orthonormal in it."""

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import qr

from fe.runtime.errors import SolutionError

from .statics import Factorisation

FloatArray = npt.NDArray[np.float64]

NEARLY_DEPENDENT = 0.1
"""Where less than this fraction of a vector is new, the pair is made to fit together again."""


class Norm:
    """The energy norm of one stiffness X, and the norm dual to it.

    Parameters
    ----------
    stiffness : sparse (n, n)
        X, symmetric positive definite; it is factorised here.

    Raises
    ------
    SolutionError
        If it is singular.
    """

    def __init__(self, stiffness: Any) -> None:
        self.stiffness = stiffness
        self._factorisation = Factorisation(stiffness)

    def product(self, vectors: FloatArray) -> FloatArray:
        """Return X times vectors (n, k)."""
        return np.asarray(self.stiffness @ vectors)

    def riesz(self, functionals: FloatArray) -> FloatArray:
        """Return the representatives X^-1 functionals, (n, k) or (n,)."""
        return self._factorisation.raw_solve(functionals)

    def whitened(self, functionals: FloatArray) -> FloatArray:
        """Return L^-1 functionals, (n, k) or (n,), with X = L L': their lengths are the dual norms."""
        return self._factorisation.whitened(functionals)


def conjugate_gradients(
    matrix: Any,
    preconditioner: Norm,
    right: FloatArray,
    start: FloatArray,
    *,
    tolerance: float,
    most_iterations: int = 100,
) -> FloatArray:
    """Return solutions of several systems with one matrix by preconditioned conjugate gradients.

    Parameters
    ----------
    matrix : sparse (n, n)
        The matrix, spectrally equivalent to the preconditioner.
    preconditioner : Norm
        The norm of a matrix nearby.
    right : (n, k) ndarray
        Right-hand sides.
    start : (n, k) ndarray
        Starting values.
    tolerance : float
        Residual wanted, relative to the right-hand side, both in the norm dual to the preconditioner.
    most_iterations : int
        Limit.

    Returns
    -------
    (n, k) ndarray
        The solutions.

    Raises
    ------
    SolutionError
        If the tolerance is not reached.
    """
    solution = np.array(start)
    wanted = tolerance**2 * np.einsum("ik,ik->k", right, preconditioner.riesz(right))
    residual = right - matrix @ solution
    direction = correction = preconditioner.riesz(residual)
    size = np.einsum("ik,ik->k", residual, correction)
    for _ in range(most_iterations):
        if np.all(size <= wanted):
            return solution
        image = matrix @ direction
        curvature = np.einsum("ik,ik->k", direction, image)
        step = np.divide(size, curvature, out=np.zeros_like(size), where=curvature > 0.0)
        solution += step * direction
        residual = residual - step * image
        correction = preconditioner.riesz(residual)
        before, size = size, np.einsum("ik,ik->k", residual, correction)
        direction = (
            correction + np.divide(size, before, out=np.zeros_like(size), where=before > 0.0) * direction
        )
    if np.all(size <= wanted):
        return solution
    missed = size > wanted
    reached = tolerance * float(np.sqrt(np.max(size[missed] / wanted[missed])))
    raise SolutionError(
        f"Conjugate gradients reached {reached:.2g} in {most_iterations} iterations, but {tolerance:g} "
        "is needed; the stiffness terms must be positive semi-definite."
    )


class BlockDiagonal:
    """Several matrices (n, n), each for as many columns of what it is multiplied with.

    With it, `conjugate_gradients` solves with all of them in the time of one: applying the factors to twelve
    columns takes hardly longer than to three.
    """

    def __init__(self, matrices: list[Any]) -> None:
        self.matrices = matrices

    def __matmul__(self, vectors: FloatArray) -> FloatArray:
        parts = np.split(vectors, len(self.matrices), axis=1)
        return np.concatenate(
            [np.asarray(matrix @ part) for matrix, part in zip(self.matrices, parts, strict=True)], axis=1
        )


class FunctionalBasis:
    """A growing basis of functionals, orthonormal in the norm dual to X.

    Functionals are whitened first: with X = L L' the dual norm of f is the length of L^-1 f, and QR with
    pivots finds what is new in a block of them.

    Parameters
    ----------
    unknowns : int
        Length n of the functionals.
    norm : Norm
        The norm of X.
    drop : float
        A direction is dropped if it is less than this fraction of every functional.

    Attributes
    ----------
    vectors : (n, k) ndarray
        The whitened basis.
    dropped_square : float
        Bound of the sum of squared norms of all that was dropped.
    """

    def __init__(self, unknowns: int, norm: Norm, *, drop: float) -> None:
        self.vectors = np.empty((unknowns, 0))
        self.dropped_square = 0.0
        self._norm, self._drop = norm, drop

    def extend(self, functionals: FloatArray) -> FloatArray:
        """Add functionals (n, m); return their coordinates (k, m) in the basis."""
        rest = self._norm.whitened(functionals)
        scale = np.linalg.norm(rest, axis=0)
        rest /= np.where(scale > 0.0, scale, 1.0)
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


class OrthonormalBasis:
    """A growing basis, orthonormal in a norm, with its products kept.

    Gram-Schmidt in blocks, repeated, on pairs of vectors v and their products p = X v. With a condition
    number of 1e10 either follows from the other to about 1e-6 only, so that what is left of both after a
    projection no longer fits together. Therefore the products are taken anew from the vectors.

    Parameters
    ----------
    unknowns : int
        Length n of the vectors.
    norm : Norm
        The norm of X.
    drop : float
        A new vector is dropped if less than this fraction of it is new.

    Attributes
    ----------
    vectors, products : (n, k) ndarray
        The basis, and X times the basis.
    """

    def __init__(self, unknowns: int, norm: Norm, *, drop: float) -> None:
        self.vectors = np.empty((unknowns, 0))
        self.products = np.empty((unknowns, 0))
        self._norm, self._drop = norm, drop

    @property
    def size(self) -> int:
        """Number of vectors."""
        return int(self.vectors.shape[1])

    def extend(self, vectors: FloatArray, products: FloatArray) -> int:
        """Add vectors (n, k), given with their products; return how many were new enough to be kept."""
        length = np.sqrt(np.maximum(np.einsum("ik,ik->k", vectors, products), 0.0))
        used = np.flatnonzero(length > 0.0)
        vectors, products = vectors[:, used] / length[used], products[:, used] / length[used]
        for number in range(2):
            share = self.products.T @ vectors
            vectors, products = vectors - self.vectors @ share, products - self.products @ share
            if number == 0 and self.size:
                products = self._norm.product(vectors)
        kept: list[tuple[FloatArray, FloatArray]] = []
        for vector, product in zip(vectors.T, products.T, strict=True):
            vector, product = self._without(kept, *self._without(kept, vector, product))
            size = float(vector @ product)
            if size < NEARLY_DEPENDENT**2:
                product = self._norm.product(vector)
                share = self.products.T @ vector
                vector, product = vector - self.vectors @ share, product - self.products @ share
                vector, product = self._without(kept, vector, product)
                size = float(vector @ product)
            if size > self._drop**2:
                kept.append((vector / np.sqrt(size), product / np.sqrt(size)))
        if kept:
            self.vectors = np.column_stack((self.vectors, *(vector for vector, _ in kept)))
            self.products = np.column_stack((self.products, *(product for _, product in kept)))
        return len(kept)

    @staticmethod
    def _without(
        others: list[tuple[FloatArray, FloatArray]], vector: FloatArray, product: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        for other, other_product in others:
            part = other_product @ vector
            vector, product = vector - part * other, product - part * other_product
        return vector, product
