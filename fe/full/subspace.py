"""Tools of the offline reduction: one factorised stiffness, its norm, and bases orthonormal in it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import qr

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import SolutionError

from .factorisation import Factorisation

Norm = Factorisation
"""The energy norm of a stiffness is what its factorisation gives."""
MOST_ITERATIONS = 100
"""Limit of conjugate gradients."""
NEARLY_DEPENDENT = 0.1
"""Where less than this fraction of a vector is new, the pair is made to fit together again."""


def conjugate_gradients(
    matrices: Sequence[Any], preconditioner: Norm, right: FloatArray, start: FloatArray, tolerance: float
) -> FloatArray:
    """Return solutions of several systems by preconditioned conjugate gradients.

    Applying the factors of the preconditioner to twelve columns takes hardly longer than to three.

    Parameters
    ----------
    matrices : sequence of sparse (n, n)
        Each for as many of the columns, spectrally equivalent to the preconditioner.
    preconditioner : Norm
        The norm of a matrix nearby.
    right : (n, k) ndarray
        Right-hand sides.
    start : (n, k) ndarray
        Starting values.
    tolerance : float
        Residual wanted, relative to the right-hand side, both in the norm dual to the preconditioner.

    Returns
    -------
    (n, k) ndarray
        The solutions.

    Raises
    ------
    SolutionError
        If the tolerance is not reached.
    """

    def product(vectors: FloatArray) -> FloatArray:
        parts = zip(matrices, np.split(vectors, len(matrices), axis=1), strict=True)
        return np.concatenate([np.asarray(matrix @ part) for matrix, part in parts], axis=1)

    solution = np.array(start)
    wanted = tolerance**2 * np.einsum("ik,ik->k", right, preconditioner.riesz(right))
    residual = right - product(solution)
    direction = correction = preconditioner.riesz(residual)
    size = np.einsum("ik,ik->k", residual, correction)
    for _ in range(MOST_ITERATIONS + 1):
        if np.all(size <= wanted):
            return solution
        image = product(direction)
        curvature = np.einsum("ik,ik->k", direction, image)
        step = np.divide(size, curvature, out=np.zeros_like(size), where=curvature > 0.0)
        solution += step * direction
        residual = residual - step * image
        correction = preconditioner.riesz(residual)
        before, size = size, np.einsum("ik,ik->k", residual, correction)
        direction = (
            correction + np.divide(size, before, out=np.zeros_like(size), where=before > 0.0) * direction
        )
    missed = size > wanted
    reached = tolerance * float(np.sqrt(np.max(size[missed] / wanted[missed])))
    raise SolutionError(
        f"Conjugate gradients reached {reached:.2g} in {MOST_ITERATIONS} iterations, but {tolerance:g} "
        "is needed; the stiffness terms must be positive semi-definite."
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


class ProjectedBasis:
    """A growing basis, orthonormal in a norm, with sparse terms projected on it.

    Gram-Schmidt in blocks, repeated, on pairs of vectors v and their products p = X v. With a condition
    number of 1e10 either follows from the other to about 1e-6 only, so that what is left of both after a
    projection no longer fits together. Therefore the products are taken anew from the vectors.

    Parameters
    ----------
    norm : Norm
        The norm of X.
    sums : sequence of tuples of csr (n, n)
        The terms of each sum.
    drop : float
        A new vector is dropped if less than this fraction of it is new.

    Attributes
    ----------
    vectors : (n, k) ndarray
        The basis.
    inner : list of (T, k, k) ndarray
        The terms of each sum in the basis.
    """

    def __init__(self, norm: Norm, sums: Sequence[tuple[Any, ...]], *, drop: float) -> None:
        self.norm, self._sums, self._drop = norm, sums, drop
        self.vectors = self._products = np.empty((sums[0][0].shape[0], 0))
        self.inner = [np.empty((len(terms), 0, 0)) for terms in sums]

    def extend(self, vectors: FloatArray) -> list[list[FloatArray]]:
        """Add what is new in vectors (n, m); return the terms of each sum times what was added."""
        before = self.vectors.shape[1]
        if kept := self._new(vectors):
            self.vectors = np.column_stack((self.vectors, *(vector for vector, _ in kept)))
            self._products = np.column_stack((self._products, *(product for _, product in kept)))
        new = self.vectors[:, before:]
        images = [[np.asarray(term @ new) for term in terms] for terms in self._sums]
        for number, (old, parts) in enumerate(zip(self.inner, images, strict=True)):
            added = np.stack([self.vectors.T @ image for image in parts])
            beside = added[:, :before]
            self.inner[number] = np.block([[old, beside], [beside.swapaxes(1, 2), added[:, before:]]])
        return images

    def _new(self, vectors: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return what is new enough in vectors (n, m), orthonormal, with its products."""
        products = self.norm.product(vectors)
        length = np.sqrt(np.maximum(np.einsum("ik,ik->k", vectors, products), 0.0))
        used = np.flatnonzero(length > 0.0)
        vectors, products = vectors[:, used] / length[used], products[:, used] / length[used]
        for number in range(2):
            vectors, products = self._outside(vectors, products)
            if number == 0 and self.vectors.size:
                products = self.norm.product(vectors)
        kept: list[tuple[FloatArray, FloatArray]] = []
        for vector, product in zip(vectors.T, products.T, strict=True):
            vector, product = _without(kept, *_without(kept, vector, product))
            size = float(vector @ product)
            if size < NEARLY_DEPENDENT**2:
                vector, product = self._outside(vector, self.norm.product(vector))
                vector, product = _without(kept, vector, product)
                size = float(vector @ product)
            if size > self._drop**2:
                kept.append((vector / np.sqrt(size), product / np.sqrt(size)))
        return kept

    def _outside(self, vectors: FloatArray, products: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return vectors (n,) or (n, m) and their products without what lies in the basis."""
        share = self._products.T @ vectors
        return vectors - self.vectors @ share, products - self._products @ share


def _without(
    others: list[tuple[FloatArray, FloatArray]], vector: FloatArray, product: FloatArray
) -> tuple[FloatArray, FloatArray]:
    for other, other_product in others:
        part = other_product @ vector
        vector, product = vector - part * other, product - part * other_product
    return vector, product
