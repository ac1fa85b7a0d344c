"""Sparse Cholesky factors by the multifrontal method with dense LAPACK kernels; solutions and modes by them.

The unknowns are eliminated front by front: a front is a small dense matrix of the unknowns that a leaf or
separator of a nested dissection holds (its pivots) and of those that they are coupled to later (its
boundary). What the pivots leave on the boundary, the Schur complement, is added to a later front.

References
----------
I. S. Duff and J. K. Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", ACM
Transactions on Mathematical Software 9 (1983).
"""

from collections.abc import Iterator
from functools import cache, lru_cache
from typing import NamedTuple, NoReturn

import numpy as np
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, norm
from threadpoolctl import ThreadpoolController

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import SolutionError
from fe.sentences import said

from .dissection import elimination_blocks

MODE_RESIDUAL_LIMIT = 1e-12
"""Largest max|K phi - omega^2 M phi| / (|K| max|phi|), in maximum norms, of an accepted mode."""
LEAF_UNKNOWNS = 120
"""Parts of the mesh with up to so many unknowns are eliminated as one dense front."""
BACKWARD_ERROR_LIMIT = 1e-12
"""Largest backward error max|b - K u| / (|K| max|u| + max|b|) of an accepted solution, in maximum norms."""
CORRECTION_LIMIT = 1e-4
"""Largest change |du| / |u| that one step of iterative refinement may still make.

Thin cells make the condition number about 1e10, so that about 1e-6 is what double precision reaches.
"""


class Front(NamedTuple):
    """Unknowns that are eliminated together, by their places in the order of elimination.

    Attributes
    ----------
    start, end : int
        The pivots are the places start to end - 1.
    boundary : (b,)
        Later places that the pivots are coupled to, rising.
    parent : int
        Number of the front that takes the Schur complement, -1 where the boundary is empty.
    """

    start: int
    end: int
    boundary: IntArray
    parent: int


def analyse(matrix: sparse.csr_array) -> tuple[IntArray, tuple[Front, ...]]:
    """Find an order of elimination by nested dissection, and the fronts that follow from it.

    Parameters
    ----------
    matrix : csr (n, n)
        Symmetric pattern with a full diagonal; the values do not count.

    Returns
    -------
    order : (n,)
        Unknown at each place of the order.
    fronts : tuple of Front
        In the order of elimination.
    """
    first, group = _twins(matrix)
    graph = matrix[first][:, first]
    size = np.bincount(group)
    block = elimination_blocks(graph, size.astype(np.float64), LEAF_UNKNOWNS)
    order, starts = np.argsort(block, kind="stable"), np.unique(block)
    place = np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(len(order))
    size = size[order]
    offset = np.concatenate(([0], np.cumsum(size)))
    fronts = tuple(
        Front(int(offset[start]), int(offset[end]), _expanded(boundary, size, offset), parent)
        for start, end, boundary, parent in _boundaries(graph[order], place, starts)
    )
    return np.argsort(place[group], kind="stable"), fronts


def _twins(matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Group unknowns that are coupled to the same ones: first of each group (g,), group of each (n,).

    Rows are told apart by the sum of random 64-bit keys of their columns; should two different rows ever
    have the same sum, the order of elimination is still one, only a poorer one.
    """
    keys = np.random.default_rng(1973).integers(2**63, size=matrix.shape[0], dtype=np.int64)
    sums = np.add.reduceat(keys[matrix.indices], matrix.indptr[:-1])
    _, first, group = np.unique(sums, return_index=True, return_inverse=True)
    return first.astype(np.int64), group.astype(np.int64)


def _boundaries(
    graph: sparse.csr_array, place: IntArray, starts: IntArray
) -> Iterator[tuple[int, int, IntArray, int]]:
    """Yield start, end, boundary and parent of each front, in places of the groups of unknowns."""
    ends = np.append(starts[1:], graph.shape[0])
    owner = np.repeat(np.arange(len(starts)), ends - starts)
    coupled = place[graph.indices]
    inherited: list[list[IntArray]] = [[] for _ in starts]
    for start, end, passed_on in zip(starts.tolist(), ends.tolist(), inherited, strict=True):
        near = coupled[graph.indptr[start] : graph.indptr[end]]
        later = np.unique(np.concatenate((near, *passed_on)))
        boundary = later[np.searchsorted(later, end) :]
        parent = int(owner[boundary[0]]) if len(boundary) else -1
        if parent >= 0:
            inherited[parent].append(boundary)
        yield start, end, boundary, parent


def _expanded(groups: IntArray, size: IntArray, offset: IntArray) -> IntArray:
    """Places of the unknowns of groups of unknowns (g,), given by their sizes and first places."""
    count = size[groups]
    before = np.cumsum(count) - count
    return np.asarray(np.repeat(offset[groups] - before, count) + np.arange(count.sum()))


@lru_cache(maxsize=2)
def _analysed(size: int, starts: bytes, columns: bytes) -> tuple[IntArray, tuple[Front, ...]]:
    """Analyse a pattern; a matrix of the same unknowns with other values, as after damage, asks again."""
    places = np.frombuffer(columns, dtype=np.int32), np.frombuffer(starts, dtype=np.int32)
    return analyse(sparse.csr_array((np.ones(len(places[0]), dtype=np.int8), *places), shape=(size, size)))


_threads = cache(ThreadpoolController)


class Factorisation:
    """Cholesky factors of a sparse symmetric positive definite matrix X, its energy norm, and the dual norm.

    They are computed, and applied, in one thread: sums over several threads depend on their number, and the
    fronts are too small to gain from them.

    Parameters
    ----------
    stiffness : sparse (n, n)
        X; only one half of it is factorised, the whole is kept for the residual.

    Attributes
    ----------
    stiffness : csr (n, n)
        X.

    Raises
    ------
    SolutionError
        If it is not positive definite.
    """

    def __init__(self, stiffness: sparse.sparray) -> None:
        self.stiffness = matrix = stiffness.tocsr()
        if matrix.shape[0] == 0:
            raise SolutionError(
                "The structure has no free unknown: all its nodes are held. Hold fewer of them."
            )
        if not np.all(matrix.diagonal() > 0.0):
            self._refuse(matrix, "it has a diagonal entry that is not positive")
        places = (part.astype(np.int32).tobytes() for part in (matrix.indptr, matrix.indices))
        self._order, self._fronts = _analysed(matrix.shape[0], *places)
        self._factors: list[tuple[FloatArray, FloatArray]] = []
        with _threads().limit(limits=1):
            self._eliminate(matrix)

    def _refuse(self, matrix: sparse.csr_array, why: str) -> NoReturn:
        raise SolutionError(said("solution.singular", unknowns=matrix.shape[0], why=why))

    def _eliminate(self, matrix: sparse.csr_array) -> None:
        size = matrix.shape[0]
        place = np.empty(size, dtype=np.int64)
        place[self._order] = np.arange(size)
        rows = matrix[self._order]
        columns = place[rows.indices]
        local = np.empty(size, dtype=np.int64)
        waiting: list[list[tuple[IntArray, FloatArray]]] = [[] for _ in self._fronts]
        for front, contributions in zip(self._fronts, waiting, strict=True):
            pivots, held = front.end - front.start, len(front.boundary)
            local[front.start : front.end] = np.arange(pivots)
            local[front.boundary] = pivots + np.arange(held)
            # Right of the diagonal only; transposed, that is the lower half of LAPACK.
            top, rest = np.zeros((pivots, pivots + held)), np.zeros((held, held))
            inside = slice(rows.indptr[front.start], rows.indptr[front.end])
            row = np.repeat(np.arange(pivots), np.diff(rows.indptr[front.start : front.end + 1]))
            later = columns[inside] >= front.start
            top[row[later], local[columns[inside][later]]] = rows.data[inside][later]
            while contributions:
                _extend_add(top, rest, *contributions.pop(), local)
            diagonal, side = np.ascontiguousarray(top[:, :pivots]), np.ascontiguousarray(top[:, pivots:])
            lower, failed = lapack.dpotrf(diagonal.T, lower=1, overwrite_a=1, clean=0)
            if failed:
                unknown = self._order[front.start + failed - 1]
                self._refuse(matrix, f"unknown {unknown} is left without a positive pivot")
            if held:
                below = blas.dtrsm(1.0, lower, side.T, side=1, lower=1, trans_a=1, overwrite_b=1)
                left = blas.dsyrk(-1.0, below, beta=1.0, c=rest.T, lower=1, overwrite_c=1)
                waiting[front.parent].append((front.boundary, left.T))
            else:
                below = side.T
            self._factors.append((lower, below))

    def riesz(self, right_hand_side: FloatArray) -> FloatArray:
        """X^-1 f (n,) or (n, k) without a check of the residual, for iterations that check their own."""
        return self.unwhitened(self.whitened(right_hand_side))

    def whitened(self, right_hand_side: FloatArray) -> FloatArray:
        """L^-1 f (n,) or (n, k), X = L L', in the order of elimination; its length is the dual norm of f."""
        found = np.array(right_hand_side[self._order], dtype=np.float64, order="C")
        values = found.reshape(len(found), -1)
        with _threads().limit(limits=1):
            for front, (lower, below) in zip(self._fronts, self._factors, strict=True):
                own = _substitute(lower, values[front.start : front.end], transposed=False)
                if len(front.boundary):
                    values[front.boundary] -= below @ own
        return found

    def unwhitened(self, whitened: FloatArray) -> FloatArray:
        """L'^-1 y (n,) or (n, k) of what is in the order of elimination."""
        found = np.array(whitened, dtype=np.float64, order="C")
        values = found.reshape(len(found), -1)
        with _threads().limit(limits=1):
            for front, (lower, below) in zip(self._fronts[::-1], self._factors[::-1], strict=True):
                own = values[front.start : front.end]
                if len(front.boundary):
                    own -= below.T @ values[front.boundary]
                _substitute(lower, own, transposed=True)
        solution = np.empty_like(found)
        solution[self._order] = found
        return solution

    def solve(self, right_hand_side: FloatArray) -> FloatArray:
        """Solution (n,) or (n, k), refined once, its backward error and its accuracy checked.

        Raises
        ------
        SolutionError
            If the backward error exceeds `BACKWARD_ERROR_LIMIT` or refinement still changes the solution by
            more than `CORRECTION_LIMIT`.
        """
        solution = self.riesz(right_hand_side)
        correction = self.riesz(right_hand_side - self.stiffness @ solution)
        solution = solution + correction
        error = self.backward_error(solution, right_hand_side)
        change = float(np.linalg.norm(correction)) / max(float(np.linalg.norm(solution)), 1e-300)
        if not (error <= BACKWARD_ERROR_LIMIT and change <= CORRECTION_LIMIT):
            limits = BACKWARD_ERROR_LIMIT, CORRECTION_LIMIT
            raise SolutionError(said("solution.inaccurate", error=error, change=change, limits=limits))
        return solution

    def backward_error(self, solution: FloatArray, right_hand_side: FloatArray) -> float:
        """Backward error max|b - K u| / (|K| max|u| + max|b|), in maximum norms (0 for a zero load)."""
        size = float(norm(self.stiffness, np.inf))
        scale = size * float(np.abs(solution).max()) + float(np.abs(right_hand_side).max())
        residual = float(np.abs(right_hand_side - self.stiffness @ solution).max())
        return residual / scale if scale > 0.0 else residual


def _substitute(lower: FloatArray, values: FloatArray, *, transposed: bool) -> FloatArray:
    """Solve L x = v or L' x = v in place, values (m, k) contiguous."""
    if values.shape[1] == 1:
        values[:, 0] = blas.dtrsv(lower, values[:, 0], lower=1, trans=int(transposed))
    else:
        # The transpose of C-ordered values is what BLAS takes without a copy: x' L' = v'.
        values[:] = blas.dtrsm(1.0, lower, values.T, side=1, lower=1, trans_a=int(not transposed)).T
    return values


def _extend_add(
    top: FloatArray, rest: FloatArray, boundary: IntArray, complement: FloatArray, local: IntArray
) -> None:
    """Add a Schur complement to the pivot rows and to the rest of a front."""
    index, pivots = local[boundary], len(top)
    mine = int(np.searchsorted(index, pivots))
    later = index[mine:] - pivots
    top[index[:mine, np.newaxis], index] += complement[:mine]
    rest[later[:, np.newaxis], later] += complement[mine:, mine:]


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
    stiffness: sparse.sparray | Factorisation, mass: sparse.sparray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Lowest eigenvalues (count,) [rad^2/s^2] and vectors (n, count) by shift-inverted Lanczos.

    The stiffness may be given factorised.

    Raises
    ------
    SolutionError
        If the iteration did not converge to `MODE_RESIDUAL_LIMIT`.
    """
    factors = stiffness if isinstance(stiffness, Factorisation) else Factorisation(stiffness)
    stiffness = factors.stiffness
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
        worst = int(residual.argmax()), residual.max(), MODE_RESIDUAL_LIMIT
        raise SolutionError(said("solution.eigenmode", worst=worst))
    return values, shapes
