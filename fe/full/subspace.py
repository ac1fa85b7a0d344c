"""Bases that are orthonormal in the energy norm of a stiffness X = L L', and nearby solutions.

All vectors are in whitened coordinates, in which X is the identity: a displacement u as L' u, a
load f as L^-1 f. Both are equal if u = X^-1 f. The energy norm of a displacement, and the dual norm
of a load, is then the Euclidean length. Orthogonality in these coordinates suffers from the square
root of the condition number of X, about 1e5, and not from the condition number itself.
"""

from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np
from scipy import sparse
from scipy.linalg import qr
from scipy.sparse.linalg import LinearOperator, cg

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import SolutionError

from .factorisation import Factorisation

MOST_ITERATIONS = 100
"""Largest number of iterations of conjugate gradients."""
LEAST_SINGULAR_VALUE = 1e-7
"""Singular directions below this fraction of the largest singular value are not used."""


def affine_product(
    terms: Sequence[sparse.csr_array], coefficients: FloatArray, vectors: FloatArray
) -> FloatArray:
    """Return the product (n, k) of an affine sum of sparse terms with vectors (n, k).

    `coefficients` are (T,), one for each term, or (T, k), one for each term and vector.
    """
    total: FloatArray = np.zeros_like(vectors)
    for term, coefficient in zip(terms, coefficients, strict=True):
        product = coefficient * (term @ vectors)
        total = total + product
    return total


def project_terms(terms: FloatArray, directions: FloatArray) -> FloatArray:
    """Return symmetric terms (T, n, n) projected on directions (n, k): terms (T, k, k)."""
    projected = directions.T @ terms @ directions
    # Rounding leaves the products slightly unsymmetric.
    return np.asarray(0.5 * (projected + projected.swapaxes(1, 2)))


def fewest_directions(
    snapshots: FloatArray, least: int, is_accurate: Callable[[FloatArray], bool]
) -> FloatArray:
    """Return as few leading singular directions of snapshots as are accurate.

    The number is found by bisection, which assumes that accuracy improves with it.

    Parameters
    ----------
    snapshots : (N, S) array
        The snapshots, which are scaled to unit length.
    least : int
        The least number of directions.
    is_accurate : callable
        Returns whether directions (N, K) are accurate.

    Returns
    -------
    (N, K) array
        The directions; all of them if fewer are not accurate.
    """
    unit_snapshots = snapshots / np.linalg.norm(snapshots, axis=0)
    directions, singular_values, _ = np.linalg.svd(unit_snapshots, full_matrices=False)
    most_directions = int(np.sum(singular_values > LEAST_SINGULAR_VALUE * singular_values[0]))
    direction_count = bisect_left(
        range(most_directions),
        True,
        min(least, most_directions),
        key=lambda count: is_accurate(directions[:, :count]),
    )
    return np.asarray(directions[:, :direction_count])


def solve_near(
    factors: Factorisation,
    terms: Sequence[sparse.csr_array],
    coefficients: FloatArray,
    right_hand_sides: FloatArray,
    start: FloatArray,
    tolerance: float,
) -> FloatArray:
    """Solve affine systems near a factorised one by preconditioned conjugate gradients.

    All vectors are in whitened coordinates. The systems are solved as one large system, so that
    their products are computed together.

    Parameters
    ----------
    factors : Factorisation
        The preconditioner: a matrix to which all systems are spectrally equivalent.
    terms : sequence of csr (n, n)
        The T terms of the systems.
    coefficients : (T, k) array
        The coefficients of the terms, a column for each system.
    right_hand_sides : (n, k) array
        A column for each system.
    start : (n, k) array
        The starting values.
    tolerance : float
        The largest residual, relative to the right-hand sides.

    Raises
    ------
    SolutionError
        If the tolerance is not reached in `MOST_ITERATIONS` iterations.
    """
    shape = right_hand_sides.shape

    def preconditioned_product(flat: FloatArray) -> FloatArray:
        vectors = factors.unwhitened(flat.reshape(shape))
        return factors.whitened(affine_product(terms, coefficients, vectors)).ravel()

    # right-hand sides of length one, so that the tolerance is relative
    length = np.linalg.norm(right_hand_sides, axis=0)
    length = np.where(length > 0.0, length, 1.0)
    unknowns = right_hand_sides.size
    solution, failed = cg(
        LinearOperator((unknowns, unknowns), matvec=preconditioned_product, dtype=np.float64),
        (right_hand_sides / length).ravel(),
        (start / length).ravel(),
        rtol=0.0,
        atol=tolerance,
        maxiter=MOST_ITERATIONS,
    )
    if failed:
        raise SolutionError(
            f"Conjugate gradients did not reach a residual of {tolerance:g} in {MOST_ITERATIONS} "
            "iterations; the stiffness terms must be positive semi-definite."
        )
    return np.asarray(solution.reshape(shape) * length)


class OrthonormalBasis:
    """A growing orthonormal basis of vectors of length `size`.

    Parameters
    ----------
    drop : float
        A direction is dropped if it is shorter than this fraction of every vector of its block.

    Attributes
    ----------
    vectors : (n, k) array
        The basis.
    dropped_square : float
        A bound of the sum of squared lengths of all dropped components.
    """

    def __init__(self, size: int, *, drop: float) -> None:
        self.vectors: FloatArray = np.empty((size, 0))
        self.dropped_square = 0.0
        self._drop = drop

    def extend(self, block: FloatArray) -> FloatArray:
        """Add vectors (n, m) to the orthonormal basis, and return their coordinates (k, m) in it.

        Directions whose length outside the basis is negligible, relative to the vectors, are not
        added; `dropped_square` sums up what is lost by this.
        """
        length = np.linalg.norm(block, axis=0)
        divisor = np.where(length > 0.0, length, 1.0)
        outside = block / divisor
        # classical Gram-Schmidt, twice: the second pass removes what rounding left
        basis_size = self.vectors.shape[1]
        coordinates_inside = np.zeros((basis_size, len(length)))
        for _ in range(2):
            projection = self.vectors.T @ outside
            outside -= self.vectors @ projection
            coordinates_inside += projection
        # rank-revealing factorisation of the component outside the basis
        directions, triangle, order = qr(
            outside,
            mode="economic",
            pivoting=True,
            overwrite_a=True,
        )
        is_new = np.linalg.norm(triangle, axis=1) > self._drop
        coordinates_outside = np.empty_like(triangle)
        coordinates_outside[:, order] = triangle * length[order]
        dropped = coordinates_outside[~is_new]
        self.dropped_square += float(np.sum(dropped**2))
        new_directions = directions[:, is_new]
        self.vectors = np.concatenate((self.vectors, new_directions), axis=1)
        return np.concatenate((coordinates_inside * length, coordinates_outside[is_new]))


class ProjectedBasis(OrthonormalBasis):
    """A growing basis of displacements, orthonormal in the energy norm, with projected terms.

    Parameters
    ----------
    factors : Factorisation
        The factors of the matrix X of the energy norm.
    stiffness_terms : sequence of csr (n, n)
        The T stiffness terms.
    mass_terms : sequence of csr (n, n)
        The Q mass terms; none by default.
    drop : float
        As in `OrthonormalBasis`.

    Attributes
    ----------
    displacements : (n, k) array
        The basis vectors as displacements; `vectors` has them in whitened coordinates.
    stiffness : (T, k, k) array
        The stiffness terms, projected on the basis.
    mass : (Q, k, k) array
        The mass terms, projected on the basis.
    """

    def __init__(
        self,
        factors: Factorisation,
        stiffness_terms: Sequence[sparse.csr_array],
        mass_terms: Sequence[sparse.csr_array] = (),
        *,
        drop: float,
    ) -> None:
        super().__init__(factors.stiffness.shape[0], drop=drop)
        self.factors = factors
        self.displacements: FloatArray = self.vectors
        self.stiffness: FloatArray = np.empty((len(stiffness_terms), 0, 0))
        self.mass: FloatArray = np.empty((len(mass_terms), 0, 0))
        self._stiffness_terms = stiffness_terms
        self._mass_terms = mass_terms

    def add(self, block: FloatArray) -> FloatArray:
        """Add whitened vectors (n, m) to the basis, and project the terms on the new ones.

        Returns
        -------
        (T, n, new) array
            The stiffness terms times the new basis vectors.
        """
        previous_count = self.vectors.shape[1]
        self.extend(block)
        new_displacements = self.factors.unwhitened(self.vectors[:, previous_count:])
        self.displacements = np.concatenate((self.displacements, new_displacements), axis=1)
        images = np.stack([term @ new_displacements for term in self._stiffness_terms])
        self.stiffness = self._extended_projection(self.stiffness, images)
        if self._mass_terms:
            mass_images = np.stack([term @ new_displacements for term in self._mass_terms])
            self.mass = self._extended_projection(self.mass, mass_images)
        return images

    def _extended_projection(self, projected: FloatArray, images: FloatArray) -> FloatArray:
        """Extend projected terms by the new basis vectors, given their images."""
        previous_count = projected.shape[1]
        new_columns = self.displacements.T @ images
        coupling = new_columns[:, :previous_count]
        new_block = new_columns[:, previous_count:]
        return np.block([[projected, coupling], [coupling.swapaxes(1, 2), new_block]])
