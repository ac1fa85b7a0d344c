"""What solves for stiffness: factorisation, modes and bases, against general and dense solvers."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import spsolve
from threadpoolctl import threadpool_limits

from fe.full import fronts
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.full.subspace import OrthonormalBasis
from fe.runtime.errors import SolutionError


def laplacian_of_grid(*counts: int) -> sparse.csr_array:
    """Return the Laplacian of a grid, one added on the diagonal."""
    total = sparse.csr_array((1, 1))
    for count in counts:
        path = sparse.csr_array(2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
        total = sparse.kronsum(path, total, format="csr")
    return sparse.csr_array(total + sparse.eye_array(total.shape[0]))


# ---------------------------------------------------------------- solutions


def random_matrix(size: int, density: float, copies: int, seed: int) -> sparse.csr_array:
    """Return the matrix of a random graph, perhaps disconnected, dominant on its diagonal.

    Each vertex has `copies` unknowns.
    """
    random = np.random.default_rng(seed)
    half = sparse.random_array((size, size), density=density, rng=random)
    block = random.standard_normal((copies, copies))
    whole = sparse.kron(
        half + half.T + sparse.eye_array(size), block + block.T + 10.0 * np.eye(copies)
    )
    row_sums = np.asarray(abs(whole).sum(axis=1))
    return sparse.csr_array(whole + sparse.diags_array(row_sums + 1e-3))


@settings(max_examples=50, deadline=None)
@given(
    leaf=st.sampled_from((12, 120)),
    seed=st.integers(0, 999),
    size=st.integers(1, 400),
    density=st.floats(0.0, 0.03),
    copies=st.integers(1, 3),
    columns=st.integers(0, 4),
)
def test_solutions_are_those_of_a_general_solver(leaf, seed, size, density, copies, columns):
    """With leaves of the elimination tree of different sizes; the loads are not changed."""
    matrix = random_matrix(size, density, copies, seed)
    shape = (matrix.shape[0], columns) if columns else (matrix.shape[0],)
    loads = np.random.default_rng(seed).standard_normal(shape)
    loads_before = loads.copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fronts, "LEAF_UNKNOWNS", leaf)
        solution = Factorisation(matrix).riesz(loads)

    expected = spsolve(matrix.tocsc(), loads).reshape(shape)
    tolerance = 1e-9 * np.abs(expected).max()
    assert np.array_equal(loads, loads_before)
    assert solution.shape == shape
    assert solution == pytest.approx(expected, rel=1e-9, abs=tolerance)


@dataclass(frozen=True)
class WingSystem:
    """Stiffness, load and factors of a damaged wing."""

    stiffness: sparse.csr_array
    load: NDArray[np.float64]
    factors: Factorisation


@pytest.fixture(scope="module")
def wing_system(coarse_operators) -> WingSystem:
    stiffness = coarse_operators.stiffness(None, (0.3, 0.7))
    load = coarse_operators.turn(3.0, 5.0)
    return WingSystem(stiffness, load, Factorisation(stiffness))


def test_the_wing_is_solved_as_by_a_general_solver(wing_system):
    """The condition number is about 1e10."""
    solution = wing_system.factors.solve(wing_system.load)

    expected = spsolve(wing_system.stiffness.tocsc(), wing_system.load)
    assert np.abs(solution - expected).max() < 1e-5 * np.abs(expected).max()


def test_the_solution_of_the_wing_has_a_small_backward_error(wing_system):
    solution = wing_system.factors.riesz(wing_system.load)

    assert wing_system.factors.backward_error(solution, wing_system.load) < 2e-15


def test_the_wing_is_solved_to_the_same_bytes_with_any_number_of_threads(wing_system):
    load = wing_system.load
    unit_loads = np.eye(len(load), 3)

    solutions = set()
    for threads in (1, 2, 2):
        with threadpool_limits(threads):
            factors = Factorisation(wing_system.stiffness)
            solutions.add((factors.riesz(load).tobytes(), factors.riesz(unit_loads).tobytes()))

    assert len(solutions) == 1


# ---------------------------------------------------------------- refusals

BODY = laplacian_of_grid(20, 5)
LOOSE_GRID = laplacian_of_grid(12, 4)
LOOSE = LOOSE_GRID - sparse.diags_array(np.asarray(LOOSE_GRID.sum(axis=1)))
"""A body that is not held: a constant displacement calls forth no force."""
DENSE = np.random.default_rng(2).standard_normal((30, 30))
FEW_COLUMNS, _ = np.split(DENSE, [10], axis=1)


def with_diagonal_changed(change: float) -> sparse.csr_array:
    """Return the matrix of the body with a number added to one diagonal entry."""
    return BODY + sparse.csr_array(([change], ([33], [33])), (100, 100))


NOT_POSITIVE_DEFINITE = {
    "zero diagonal": (
        with_diagonal_changed(-BODY[33, 33]),
        "diagonal entry that is not positive",
    ),
    "negative diagonal": (
        with_diagonal_changed(-BODY[33, 33] - 1.0),
        "diagonal entry that is not positive",
    ),
    "no number": (with_diagonal_changed(np.nan), "diagonal entry that is not positive"),
    "indefinite": (
        BODY - 1.5 * sparse.eye_array(100),
        r"unknown \d+ is left without a positive pivot",
    ),
    "zero row": (np.diag([1.0, 0.0, 2.0]), "cannot be factorised"),
    "nearly singular": (
        FEW_COLUMNS @ FEW_COLUMNS.T + 1e-14 * np.eye(30),
        "nearly singular|not positive definite",
    ),
    "not held": (LOOSE, "nearly singular|not held"),
}


@pytest.mark.parametrize("name", NOT_POSITIVE_DEFINITE)
def test_a_matrix_that_is_not_positive_definite_is_refused(name):
    matrix, sentence = NOT_POSITIVE_DEFINITE[name]
    load = np.arange(float(matrix.shape[0]))

    with pytest.raises(SolutionError, match=sentence):
        Factorisation(sparse.csr_array(matrix)).solve(load)


def test_a_structure_without_free_unknowns_is_refused_in_one_sentence():
    with pytest.raises(SolutionError, match="all its nodes are held"):
        Factorisation(sparse.csr_array((0, 0)))


# ---------------------------------------------------------------- patterns that are kept

LOAD = np.arange(189.0)


def assert_solved(matrix: sparse.csr_array) -> None:
    assert matrix @ Factorisation(matrix).riesz(LOAD) == pytest.approx(LOAD, abs=1e-10)


def scaled_copy(matrix: sparse.csr_array) -> sparse.csr_array:
    """Return a matrix of the same pattern with a stronger diagonal."""
    scaled = matrix.copy()
    scaled.data = scaled.data * np.where(scaled.data < 0.0, 0.5, 2.0)
    return scaled


def test_a_pattern_met_before_comes_with_other_values():
    first = laplacian_of_grid(9, 7, 3)
    other_pattern = laplacian_of_grid(7, 9, 3)

    for matrix in (first, scaled_copy(first), other_pattern, first):
        assert_solved(matrix)


def test_a_pattern_that_is_kept_does_not_follow_a_matrix_that_is_changed_in_place():
    changed = scaled_copy(laplacian_of_grid(9, 7, 3))
    other_pattern = laplacian_of_grid(7, 9, 3)
    assert_solved(changed)

    changed.indices[:] = other_pattern.indices
    changed.indptr[:] = other_pattern.indptr
    changed.data[:] = other_pattern.data

    assert_solved(changed)


# ---------------------------------------------------------------- modes and bases


def test_eigenpairs_equal_the_dense_ones():
    stiffness = DENSE @ DENSE.T + np.eye(30)
    mass = np.diag(np.linspace(1.0, 2.0, 30))

    values, shapes = lowest_eigenpairs(sparse.csr_array(stiffness), sparse.csr_array(mass), 4)

    dense_values = eigh(stiffness, mass, eigvals_only=True)
    assert values == pytest.approx(dense_values[:4], rel=1e-9)
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(stiffness @ shapes, mass @ shapes * values, atol=1e-9)


def test_a_structure_that_is_not_held_has_no_eigenpairs():
    loose = sparse.csr_array(np.diag([0.0, *np.arange(1.0, 20.0)]))

    with pytest.raises(SolutionError, match="not held"):
        lowest_eigenpairs(loose, sparse.eye_array(20).tocsr(), 3)


def test_a_basis_bounds_what_it_drops():
    """Of vectors that it knows but for a little: the rest is below its bound."""
    random = np.random.default_rng(5)
    basis = OrthonormalBasis(60, drop=1e-8)
    known = random.normal(size=(60, 4))
    differences = 10.0 ** -np.arange(6.0, 12.0, 1.5) * random.normal(size=(60, 4))
    copies = known + differences

    basis.extend(known)
    coordinates = basis.extend(copies)

    dropped = np.linalg.norm(copies - basis.vectors @ coordinates, axis=0)
    np.testing.assert_allclose(basis.vectors.T @ basis.vectors, np.eye(6), atol=1e-13)
    assert 0.0 < dropped.max() <= np.sqrt(basis.dropped_square) < 1e-6
