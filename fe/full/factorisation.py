"""Sparse Cholesky factors by the multifrontal method, and solutions and modes from them.

The unknowns are eliminated front by front, see `fe.full.fronts`. A front is a small dense matrix,
which LAPACK factorises. The Schur complement of its pivots, on its boundary, is added to a
later front.

The library CHOLMOD, by its package `sksparse_minimal` 0.3 (14 MB), takes 5.2 s of processor time
for the factors of the full wing (33,513 unknowns) where this file takes 1.7 s, since it brings a
slow BLAS along; SuperLU of SciPy takes 5.3 s. Both need less memory: 82 and 200 MiB at their peak,
where this file takes 385 MiB, of which 132 MiB are the factors.

References
----------
I. S. Duff and J. K. Reid, "The multifrontal solution of indefinite sparse symmetric linear
equations", ACM Transactions on Mathematical Software 9 (1983).
"""

from functools import cache, lru_cache
from typing import NamedTuple, NoReturn

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, norm
from threadpoolctl import ThreadpoolController

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import SolutionError

from .fronts import Front, analyse

MODE_RESIDUAL_LIMIT = 1e-12
"""Largest residual of an accepted mode, max|K phi - omega^2 M phi| / (|K| max|phi|)."""
BACKWARD_ERROR_LIMIT = 1e-12
"""Largest backward error of an accepted solution, max|b - K u| / (|K| max|u| + max|b|)."""
CORRECTION_LIMIT = 1e-4
"""Largest change |du| / |u| that one step of iterative refinement may still make.

Thin cells make the condition number about 1e10, so that double precision reaches about 1e-6.
"""


@lru_cache(maxsize=2)
def _analysed_pattern(
    size: int, row_starts: bytes, columns: bytes
) -> tuple[IntArray, tuple[Front, ...]]:
    """Analyse the pattern of a matrix; cached, since damage changes only the values.

    The pattern is given by the bytes of `indptr` and `indices` of a csr array, of int32.
    """
    indptr = np.frombuffer(row_starts, dtype=np.int32)
    indices = np.frombuffer(columns, dtype=np.int32)
    ones = np.ones(len(indices), dtype=np.int8)
    return analyse(sparse.csr_array((ones, indices, indptr), shape=(size, size)))


_threads = cache(ThreadpoolController)


class _FrontFactor(NamedTuple):
    """The columns of the Cholesky factor L of one front.

    Attributes
    ----------
    diagonal : (p, p) array
        The lower triangle of the pivots.
    below : (b, p) array
        The rows of the boundary.
    """

    diagonal: FloatArray
    below: FloatArray


class _SchurComplement(NamedTuple):
    """The Schur complement of a front's pivots, to be added to a later front.

    Attributes
    ----------
    boundary : (b,) array of int
        Positions of the boundary.
    values : (b, b) array
        The complement, right of its diagonal.
    """

    boundary: IntArray
    values: FloatArray


class Factorisation:
    """Cholesky factors of a sparse symmetric positive definite matrix X = L L'.

    The factors are computed and applied in one thread: sums over several threads depend on the
    number of threads, and the fronts are too small to gain from them.

    Parameters
    ----------
    stiffness : sparse (n, n)
        The matrix X. Only one half is factorised; the whole is kept for residuals.

    Raises
    ------
    SolutionError
        If the matrix is not positive definite.
    """

    def __init__(self, stiffness: sparse.sparray) -> None:
        matrix = stiffness.tocsr()
        self.stiffness = matrix
        size = matrix.shape[0]
        if size == 0:
            raise SolutionError(
                "The structure has no free unknown: all its nodes are held. Hold fewer of them."
            )
        if not np.all(matrix.diagonal() > 0.0):
            self._refuse("it has a diagonal entry that is not positive")
        row_starts = matrix.indptr.astype(np.int32)
        columns = matrix.indices.astype(np.int32)
        self._order, self._fronts = _analysed_pattern(
            size,
            row_starts.tobytes(),
            columns.tobytes(),
        )
        self._factors: list[_FrontFactor] = []
        with _threads().limit(limits=1):
            self._eliminate()

    def _refuse(self, reason: str) -> NoReturn:
        raise SolutionError(
            "The matrix cannot be factorised; some part of the structure is not held or has no "
            f"stiffness: of {self.stiffness.shape[0]} unknowns, {reason}."
        )

    def _eliminate(self) -> None:
        """Factorise front by front (multifrontal method), adding Schur complements to parents."""
        size = self.stiffness.shape[0]
        position = np.empty(size, dtype=np.int64)
        position[self._order] = np.arange(size)
        rows = self.stiffness[self._order]
        columns = position[rows.indices]
        row_in_front = np.empty(size, dtype=np.int64)  # from positions to rows of the present front
        waiting: list[list[_SchurComplement]] = [[] for _ in self._fronts]
        for front, contributions in zip(self._fronts, waiting, strict=True):
            pivot_count = front.end - front.start
            boundary_count = len(front.boundary)
            row_in_front[front.start : front.end] = np.arange(pivot_count)
            row_in_front[front.boundary] = pivot_count + np.arange(boundary_count)
            # assemble the front, right of its diagonal: transposed, that is LAPACK's lower half
            pivot_rows = _assembled_pivot_rows(front, rows, columns, row_in_front)
            remaining = np.zeros((boundary_count, boundary_count))
            while contributions:
                contribution = contributions.pop()  # popped, so that it is freed after its addition
                _extend_add(pivot_rows, remaining, contribution, row_in_front)
            # factorise the pivots
            diagonal = np.ascontiguousarray(pivot_rows[:, :pivot_count])
            coupling = np.ascontiguousarray(pivot_rows[:, pivot_count:])
            lower = self._factorise_pivots(front, diagonal)
            if boundary_count:
                below = _below_pivots(lower, coupling)
                complement = _schur_complement(remaining, below)
                waiting[front.parent].append(_SchurComplement(front.boundary, complement))
            else:
                below = coupling.T
            self._factors.append(_FrontFactor(lower, below))

    def _factorise_pivots(self, front: Front, pivot_block: FloatArray) -> FloatArray:
        """Return the Cholesky factor (p, p) of a front's pivots; their block is overwritten."""
        lower, failed = lapack.dpotrf(
            pivot_block.T,
            lower=1,
            overwrite_a=1,
            clean=0,
        )
        if failed:
            # LAPACK counts the failed pivot from one
            failed_unknown = self._order[front.start + failed - 1]
            self._refuse(f"unknown {failed_unknown} is left without a positive pivot")
        return np.asarray(lower)

    def riesz(self, right_hand_side: FloatArray) -> FloatArray:
        """Return X^-1 f for f (n,) or (n, k), without checking the residual."""
        return self.unwhitened(self.whitened(right_hand_side))

    def whitened(self, right_hand_side: FloatArray) -> FloatArray:
        """Return L^-1 f for loads f (n,) or (n, k), in the order of elimination.

        The matrix is L L'. In these coordinates the length of a load is its dual norm.
        """
        ordered_loads = right_hand_side[self._order]
        solution = np.array(ordered_loads, dtype=np.float64, order="C")
        values = solution.reshape(len(solution), -1)
        with _threads().limit(limits=1):
            for front, factor in zip(self._fronts, self._factors, strict=True):
                pivots = values[front.start : front.end]
                _substitute(factor.diagonal, pivots, transposed=False)
                if len(front.boundary):
                    values[front.boundary] -= factor.below @ pivots
        return solution

    def unwhitened(self, whitened: FloatArray) -> FloatArray:
        """Return the displacements L'^-1 y for whitened coordinates y (n,) or (n, k)."""
        ordered_values = np.array(whitened, dtype=np.float64, order="C")
        values = ordered_values.reshape(len(ordered_values), -1)
        last_fronts_first = self._fronts[::-1]
        last_factors_first = self._factors[::-1]
        with _threads().limit(limits=1):
            for front, factor in zip(last_fronts_first, last_factors_first, strict=True):
                pivots = values[front.start : front.end]
                if len(front.boundary):
                    pivots -= factor.below.T @ values[front.boundary]
                _substitute(factor.diagonal, pivots, transposed=True)
        solution = np.empty_like(ordered_values)
        solution[self._order] = ordered_values
        return solution

    def solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solve X u = f with one step of iterative refinement, and check the accuracy.

        Parameters
        ----------
        right_hand_side : (n,) or (n, k) array
            The loads f.

        Raises
        ------
        SolutionError
            If the backward error exceeds `BACKWARD_ERROR_LIMIT`, or refinement still changes the
            solution by more than `CORRECTION_LIMIT`.
        """
        first_solution = self.riesz(right_hand_side)
        residual = right_hand_side - self.stiffness @ first_solution
        correction = self.riesz(residual)
        solution = first_solution + correction
        error = self.backward_error(solution, right_hand_side)
        # under a zero load the solution has no length to scale with
        length = max(float(np.linalg.norm(solution)), 1e-300)
        change = float(np.linalg.norm(correction)) / length
        is_accurate = error <= BACKWARD_ERROR_LIMIT and change <= CORRECTION_LIMIT
        if not is_accurate:
            raise SolutionError(
                f"The static solution has a backward error of {error:.2g} (at most "
                f"{BACKWARD_ERROR_LIMIT:g}) and is accurate to {change:.2g} (at most "
                f"{CORRECTION_LIMIT:g}); the stiffness matrix is nearly singular, some part of the "
                "structure is hardly held."
            )
        return solution

    def backward_error(self, solution: FloatArray, right_hand_side: FloatArray) -> float:
        """Return max|b - K u| / (|K| max|u| + max|b|), or max|b - K u| if the divisor is zero."""
        largest_row = float(norm(self.stiffness, np.inf))
        largest_load = float(np.abs(right_hand_side).max())
        largest_displacement = float(np.abs(solution).max())
        scale = largest_row * largest_displacement + largest_load
        residual = right_hand_side - self.stiffness @ solution
        largest_residual = float(np.abs(residual).max())
        if scale > 0.0:
            return largest_residual / scale
        return largest_residual


def _assembled_pivot_rows(
    front: Front, rows: sparse.csr_array, columns: IntArray, row_in_front: IntArray
) -> FloatArray:
    """Assemble the rows (p, p + b) of a front's p pivots, from the diagonal to the right.

    The front has b further rows, its boundary. `rows` is the matrix (n, n) with its rows in the
    order of elimination. `columns` (nnz,) has the position of each entry's column in this order,
    and `row_in_front` (n,) the row of the front at each position.
    """
    pivots = front.end - front.start
    pivot_rows = np.zeros((pivots, pivots + len(front.boundary)))
    row_starts = rows.indptr[front.start : front.end + 1]
    entries = slice(row_starts[0], row_starts[-1])
    row_of_entry = np.repeat(np.arange(pivots), np.diff(row_starts))
    column = columns[entries]
    is_later = column >= front.start
    pivot_row = row_of_entry[is_later]
    pivot_column = row_in_front[column[is_later]]
    pivot_rows[pivot_row, pivot_column] = rows.data[entries][is_later]
    return pivot_rows


def _below_pivots(lower: FloatArray, coupling: FloatArray) -> FloatArray:
    """Return the rows B (b, p) below the pivots in a Cholesky factor, with B L' = A.

    `lower` is L, `coupling` is A' (p, b), which is overwritten.
    """
    below = blas.dtrsm(
        1.0,
        lower,
        coupling.T,
        side=1,
        lower=1,
        trans_a=1,
        overwrite_b=1,
    )
    return np.asarray(below)


def _schur_complement(remaining: FloatArray, below: FloatArray) -> FloatArray:
    """Return the Schur complement S - B B' on a front's boundary, right of its diagonal.

    `remaining` is the block S (b, b) before the elimination, which is overwritten; `below` is B (b,
    p).
    """
    complement = blas.dsyrk(
        -1.0,
        below,
        beta=1.0,
        c=remaining.T,
        lower=1,
        overwrite_c=1,
    )
    return np.asarray(complement.T)


def _substitute(lower: FloatArray, values: FloatArray, *, transposed: bool) -> None:
    """Solve L x = v, or L' x = v, in place for contiguous values (m, k)."""
    row_count, column_count = values.shape
    if column_count == 1:
        column = values.reshape(row_count)
        column[:] = blas.dtrsv(lower, column, lower=1, trans=int(transposed))
    else:
        # BLAS takes the transpose of C-ordered values without a copy: x' L' = v'.
        solution = blas.dtrsm(
            1.0,
            lower,
            values.T,
            side=1,
            lower=1,
            trans_a=int(not transposed),
        )
        values[:] = solution.T


def _extend_add(
    pivot_rows: FloatArray,
    remaining: FloatArray,
    contribution: _SchurComplement,
    row_in_front: IntArray,
) -> None:
    """Add the Schur complement of a child front to the arrays of its parent ("extend-add").

    These are the pivot rows (p, p + b) and the remaining block (b, b), changed in place.
    `row_in_front` (n,) has the row of the parent front at each position of the elimination order.
    """
    pivots = len(pivot_rows)
    index = row_in_front[contribution.boundary]
    split = int(np.searchsorted(index, pivots))
    pivot_index = index[:split]
    remaining_index = index[split:] - pivots
    pivot_rows[pivot_index[:, np.newaxis], index] += contribution.values[:split]
    remaining_block = contribution.values[split:, split:]
    remaining[remaining_index[:, np.newaxis], remaining_index] += remaining_block


def most_compliant_modes(load: FloatArray, squares: FloatArray, shapes: FloatArray) -> IntArray:
    """Return the indices of the two modes that add most to the compliance under a load.

    Parameters
    ----------
    load : (n,) array
        The load [N].
    squares : (m,) array
        Squared angular frequencies [rad^2/s^2].
    shapes : (n, m) array
        Mass-normalised shapes.
    """
    modal_force = load @ shapes
    compliance = modal_force**2 / squares
    ascending = np.argsort(compliance)
    most_compliant = ascending[-2:]
    return np.asarray(np.sort(most_compliant))


def lowest_eigenpairs(
    stiffness: sparse.sparray | Factorisation, mass: sparse.sparray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return the lowest eigenvalues and vectors by shift-inverted Lanczos iteration.

    Parameters
    ----------
    stiffness : sparse (n, n) or Factorisation
        The stiffness, or its factors.
    mass : sparse (n, n)
        The mass.

    Returns
    -------
    squares : (count,) array
        Squared angular frequencies [rad^2/s^2], ascending.
    shapes : (n, count) array
        The vectors.

    Raises
    ------
    SolutionError
        If the iteration does not converge to `MODE_RESIDUAL_LIMIT`.
    """
    factors = stiffness if isinstance(stiffness, Factorisation) else Factorisation(stiffness)
    matrix = factors.stiffness
    size = matrix.shape[0]
    inverse = LinearOperator((size, size), matvec=factors.riesz, dtype=float)
    # a fixed start vector: the same model gives the same bytes
    start = np.random.default_rng(16).standard_normal(size)
    try:
        squares, shapes = eigsh(matrix, k=count, M=mass, sigma=0.0, OPinv=inverse, v0=start)
    except ArpackNoConvergence as error:
        raise SolutionError(
            f"Only {len(error.eigenvalues)} of {count} eigenmodes converged."
        ) from None
    order = np.argsort(squares)
    squares = squares[order]
    shapes = shapes[:, order]
    _check_modes(matrix, mass, squares, shapes)
    return squares, shapes


def _check_modes(
    stiffness: sparse.csr_array, mass: sparse.sparray, squares: FloatArray, shapes: FloatArray
) -> None:
    """Raise `SolutionError` if the residual of a mode exceeds `MODE_RESIDUAL_LIMIT`."""
    largest_row = float(norm(stiffness, np.inf))
    scale = largest_row * np.abs(shapes).max(axis=0)
    elastic_force = stiffness @ shapes
    inertia_force = (mass @ shapes) * squares
    imbalance = elastic_force - inertia_force
    residual = np.abs(imbalance).max(axis=0) / scale
    is_accurate = residual.max() <= MODE_RESIDUAL_LIMIT
    if not is_accurate:
        raise SolutionError(
            f"Eigenmode {int(residual.argmax())} has a residual of {residual.max():.2g}, more than "
            f"{MODE_RESIDUAL_LIMIT:g}; the stiffness matrix is nearly singular, or too few places "
            "have mass."
        )
