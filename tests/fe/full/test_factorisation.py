"""What solves for stiffness: factorisation, iteration, modes and bases, against general and dense solvers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import spsolve
from threadpoolctl import threadpool_limits

from fe.full import fronts
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.full.subspace import OrthonormalBasis
from fe.runtime.errors import SolutionError


def grid(*counts: int) -> sparse.csr_array:
    """Laplacian of a grid, one added on the diagonal."""
    total = sparse.csr_array((1, 1))
    for count in counts:
        path = sparse.csr_array(2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
        total = sparse.kronsum(path, total, format="csr")
    return sparse.csr_array(total + sparse.eye_array(total.shape[0]))


@settings(max_examples=50, deadline=None)
@given(
    leaf=st.sampled_from((12, 120)),
    seed=st.integers(0, 999),
    size=st.integers(1, 400),
    share=st.floats(0.0, 0.03),
    copies=st.integers(1, 3),
    columns=st.integers(0, 4),
)
def test_solutions_are_those_of_a_general_solver(leaf, seed, size, share, copies, columns):
    """Of a random, perhaps disconnected graph, dominant on its diagonal, each vertex `copies` unknowns."""
    random = np.random.default_rng(seed)
    half = sparse.random_array((size, size), density=share, rng=random)
    block = random.standard_normal((copies, copies))
    whole = sparse.kron(
        half + half.T + sparse.eye_array(size), block + block.T + 10.0 * np.eye(copies)
    )
    matrix = sparse.csr_array(whole + sparse.diags_array(np.asarray(abs(whole).sum(axis=1)) + 1e-3))
    shape = (matrix.shape[0], columns) if columns else (matrix.shape[0],)
    right = np.random.default_rng(seed).standard_normal(shape)
    given_side = right.copy()
    with pytest.MonkeyPatch.context() as other:
        other.setattr(fronts, "LEAF_UNKNOWNS", leaf)
        found = Factorisation(matrix).riesz(right)
    assert np.array_equal(right, given_side)
    assert found.shape == shape
    expected = spsolve(matrix.tocsc(), right).reshape(shape)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max())


def test_the_wing_is_solved_as_by_a_general_solver(coarse_operators):
    """And to the same bytes whatever the number of threads."""
    stiffness, load = coarse_operators.stiffness(None, (0.3, 0.7)), coarse_operators.turn(3.0, 5.0)
    expected, found = spsolve(stiffness.tocsc(), load), []
    for threads in (1, 2, 2):
        with threadpool_limits(threads):
            factors = Factorisation(stiffness)
            found.append(
                (factors.riesz(load).tobytes(), factors.riesz(np.eye(len(load), 3)).tobytes())
            )
    assert found[0] == found[1] == found[2]
    assert factors.backward_error(factors.riesz(load), load) < 2e-15
    # The condition number is about 1e10.
    assert np.abs(factors.solve(load) - expected).max() < 1e-5 * np.abs(expected).max()


BODY = grid(20, 5)
LOOSE = grid(12, 4) - sparse.diags_array(np.asarray(grid(12, 4).sum(axis=1)))
DENSE = np.random.default_rng(2).standard_normal((30, 30))


@pytest.mark.parametrize(
    ("matrix", "sentence"),
    [
        # another number on the diagonal
        *((BODY + sparse.csr_array(([x], ([33], [33])), (100, 100)), "diagonal entry that is not positive")
          for x in (-BODY[33, 33], -BODY[33, 33] - 1.0, np.nan)),
        (BODY - 1.5 * sparse.eye_array(100), r"unknown \d+ is left without a positive pivot"),
        (np.diag([1.0, 0.0, 2.0]), "cannot be factorised"),
        (DENSE[:, :10] @ DENSE[:, :10].T + 1e-14 * np.eye(30), "nearly singular|not positive definite"),
        (LOOSE, "nearly singular|not held"),  # a constant calls forth no force
    ],
)  # fmt: skip
def test_what_is_not_positive_definite_is_refused(matrix, sentence):
    with pytest.raises(SolutionError, match=sentence):
        Factorisation(sparse.csr_array(matrix)).solve(np.arange(float(matrix.shape[0])))


def test_a_pattern_met_before_comes_with_other_values_and_may_change_in_place():
    """What is kept of a pattern does not follow a matrix that is changed."""
    first, third, right = grid(9, 7, 3), grid(7, 9, 3), np.arange(189.0)
    second = first.copy()
    second.data = second.data * np.where(second.data < 0.0, 0.5, 2.0)
    for matrix in (first, second, third, first):
        assert matrix @ Factorisation(matrix).riesz(right) == pytest.approx(right, abs=1e-10)
    second.indices[:], second.indptr[:], second.data[:] = third.indices, third.indptr, third.data
    assert second @ Factorisation(second).riesz(right) == pytest.approx(right, abs=1e-10)


def test_eigenpairs_equal_the_dense_ones_and_a_structure_that_is_not_held_has_none():
    stiffness, mass = DENSE @ DENSE.T + np.eye(30), np.diag(np.linspace(1.0, 2.0, 30))
    values, shapes = lowest_eigenpairs(sparse.csr_array(stiffness), sparse.csr_array(mass), 4)
    assert values == pytest.approx(eigh(stiffness, mass, eigvals_only=True)[:4], rel=1e-9)
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(stiffness @ shapes, mass @ shapes * values, atol=1e-9)
    loose = sparse.csr_array(np.diag([0.0, *np.arange(1.0, 20.0)]))
    with pytest.raises(SolutionError, match="not held"):
        lowest_eigenpairs(loose, sparse.eye_array(20).tocsr(), 3)


def test_a_basis_bounds_what_it_drops():
    """Of vectors that it knows but for a little: it is orthonormal, and the rest is below its bound."""
    random, basis = np.random.default_rng(5), OrthonormalBasis(60, drop=1e-8)
    known = random.normal(size=(60, 4))
    copies = known + 10.0 ** -np.arange(6.0, 12.0, 1.5) * random.normal(size=(60, 4))
    for block in (known, copies):
        coordinates = basis.extend(block)
        left = np.linalg.norm(block - basis.vectors @ coordinates, axis=0)
    np.testing.assert_allclose(basis.vectors.T @ basis.vectors, np.eye(6), atol=1e-13)
    assert 0.0 < left.max() <= np.sqrt(basis.dropped_square) < 1e-6


def test_a_structure_without_free_unknowns_is_refused_in_one_sentence():
    with pytest.raises(SolutionError, match="all its nodes are held"):
        Factorisation(sparse.csr_array((0, 0)))
