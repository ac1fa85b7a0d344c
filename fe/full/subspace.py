"""Tools of the offline reduction: one factorised stiffness, its norm, and bases orthonormal in it."""

from typing import Any

import numpy as np
import numpy.typing as npt

from fe.runtime.errors import ReductionError, SolutionError

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
    """A growing basis of functionals, orthonormal in the norm dual to X, with their representatives.

    As `OrthonormalBasis` with `functionals`, but a block at a time, so that the factors of X are applied to
    many columns at once: the Gram matrix of a block gives its orthonormal combinations, and those that are
    small get representatives of their own before they are judged.

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
    vectors, products : (n, k) ndarray
        The representatives, and the functionals.
    dropped_square : float
        Bound of the sum of squared norms of all that was dropped.
    """

    def __init__(self, unknowns: int, norm: Norm, *, drop: float) -> None:
        self.vectors, self.products = np.empty((unknowns, 0)), np.empty((unknowns, 0))
        self.dropped_square = 0.0
        self._norm, self._drop = norm, drop

    def extend(self, functionals: FloatArray) -> None:
        """Add functionals (n, k)."""
        rest = np.array(functionals)
        inside = self._project(rest)
        representatives = self._norm.riesz(rest)
        outside = np.maximum(np.einsum("ik,ik->k", rest, representatives), 0.0)
        scale = np.sqrt(inside + outside)
        used = np.flatnonzero(scale > 0.0)
        rest, representatives = rest[:, used] / scale[used], representatives[:, used] / scale[used]
        mix = np.eye(len(used))  # the functionals, of unit length, in terms of what is left of them
        while rest.shape[1]:
            gram = representatives.T @ rest
            square, rotation = np.linalg.eigh(0.5 * (gram + gram.T))
            square = np.maximum(square, 0.0)
            mix = mix @ rotation
            part = np.sqrt(square) * np.abs(mix).max(axis=0, initial=0.0)
            new = part > self._drop
            strong = new & (square > NEARLY_DEPENDENT**2)
            self.dropped_square += float(np.sum((mix[:, ~new] * scale[used, None]) ** 2 @ square[~new]))
            length = np.sqrt(square)
            if strong.any():
                turned = rotation[:, strong] / length[strong]
                self.vectors = np.concatenate((self.vectors, representatives @ turned), axis=1)
                self.products = np.concatenate((self.products, rest @ turned), axis=1)
            weak = new & ~strong
            rest = rest @ (rotation[:, weak] / length[weak])
            mix = mix[:, weak] * length[weak]
            self._project(rest)
            representatives = self._norm.riesz(rest) if weak.any() else rest

    def _project(self, functionals: FloatArray) -> FloatArray:
        """Take what the basis holds out of functionals, in place; return the squared norms of that."""
        inside = np.zeros(functionals.shape[1])
        for _ in range(2):
            share = self.vectors.T @ functionals
            functionals -= self.products @ share
            inside += np.einsum("ik,ik->k", share, share)
        return inside


class OrthonormalBasis:
    """A growing basis, orthonormal in a norm, with its products kept.

    Gram-Schmidt in blocks, repeated, on pairs of vectors v and their products p = X v. With a condition
    number of 1e10 either follows from the other to about 1e-6 only, so that what is left of both after a
    projection no longer fits together. Therefore one of the two is what is meant, and the other is taken
    anew from it.

    Parameters
    ----------
    unknowns : int
        Length n of the vectors.
    norm : Norm
        The norm of X.
    drop : float
        A new vector is dropped if less than this fraction of it is new.
    functionals : bool
        Whether the products are what is meant (a basis of functionals), or the vectors.

    Attributes
    ----------
    vectors, products : (n, k) ndarray
        The basis, and X times the basis.
    dropped_square : float
        Bound of the sum of squared norms of all that was dropped.
    """

    def __init__(self, unknowns: int, norm: Norm, *, drop: float, functionals: bool = False) -> None:
        self.vectors = np.empty((unknowns, 0))
        self.products = np.empty((unknowns, 0))
        self.dropped_square = 0.0
        self._norm, self._drop, self._functionals = norm, drop, functionals

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
                vectors, products = self._refreshed(vectors, products)
        kept: list[tuple[FloatArray, FloatArray]] = []
        for vector, product, scale in zip(vectors.T, products.T, length[used], strict=True):
            vector, product = self._without(kept, *self._without(kept, vector, product))
            size = float(vector @ product)
            if size < NEARLY_DEPENDENT**2:
                vector, product = self._refreshed(vector, product)
                share = self.products.T @ vector
                vector, product = vector - self.vectors @ share, product - self.products @ share
                vector, product = self._without(kept, vector, product)
                size = float(vector @ product)
            if size > self._drop**2:
                kept.append((vector / np.sqrt(size), product / np.sqrt(size)))
            else:
                self.dropped_square += (self._drop * scale) ** 2
        if kept:
            self.vectors = np.column_stack((self.vectors, *(vector for vector, _ in kept)))
            self.products = np.column_stack((self.products, *(product for _, product in kept)))
        return len(kept)

    def _refreshed(self, vectors: FloatArray, products: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self._functionals:
            return self._norm.riesz(products), products
        return vectors, self._norm.product(vectors)

    @staticmethod
    def _without(
        others: list[tuple[FloatArray, FloatArray]], vector: FloatArray, product: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        for other, other_product in others:
            part = other_product @ vector
            vector, product = vector - part * other, product - part * other_product
        return vector, product


def triangular_factors(representatives: FloatArray, functionals: FloatArray) -> FloatArray:
    """Return small factors that give dual norms of linear combinations without cancellation.

    Parameters
    ----------
    representatives, functionals : (n, g, k) ndarray
        g families of k functionals, with their Riesz representatives.

    Returns
    -------
    (g, k, k) ndarray
        Upper triangular R with |functionals[:, i] @ c| = |R[i] @ c| in the dual norm.
    """
    vectors, products = np.array(representatives), np.array(functionals)
    _, families, count = vectors.shape
    factors = np.zeros((families, count, count))
    for j in range(count):
        for _ in range(2):
            for i in range(j):
                part = np.einsum("ng,ng->g", products[:, :, i], vectors[:, :, j])
                factors[:, i, j] += part
                vectors[:, :, j] -= part * vectors[:, :, i]
                products[:, :, j] -= part * products[:, :, i]
        size = np.einsum("ng,ng->g", vectors[:, :, j], products[:, :, j])
        length = np.sqrt(np.maximum(size, 0.0))
        factors[:, j, j] = length
        scale = np.divide(1.0, length, out=np.zeros_like(length), where=length > 0.0)
        vectors[:, :, j] *= scale
        products[:, :, j] *= scale
    if not np.isfinite(factors).all():
        raise ReductionError("The dual residuals are not finite; the full model holds a value that is not.")
    return factors
