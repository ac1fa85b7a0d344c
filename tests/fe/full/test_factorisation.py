"""What solves for stiffness: factorisation, iteration, modes and bases, against general and dense solvers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import spsolve
from threadpoolctl import threadpool_limits

from fe.full import factorisation, subspace
from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.full.subspace import OrthonormalBasis, ProjectedBasis, solved_near
from fe.runtime.errors import SolutionError
from fe.structure.affine import affine_sum


def grid(*counts: int) -> sparse.csr_array:
    """Laplacian of a grid, one added on the diagonal."""
    total = sparse.csr_array((1, 1))
    for count in counts:
        path = sparse.csr_array(2.0 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1))
        total = sparse.kronsum(path, total, format="csr")
    return sparse.csr_array(total + sparse.eye_array(total.shape[0]))


def random_matrix(seed: int, size: int, share: float, copies: int = 1) -> sparse.csr_array:
    """Diagonally dominant matrix of a random, perhaps disconnected graph, each vertex `copies` unknowns."""
    random = np.random.default_rng(seed)
    half = sparse.random_array((size, size), density=share, rng=random)
    block = random.standard_normal((copies, copies))
    matrix = sparse.kron(half + half.T + sparse.eye_array(size), block + block.T + 10.0 * np.eye(copies))
    return sparse.csr_array(matrix + sparse.diags_array(np.asarray(abs(matrix).sum(axis=1)) + 1e-3))


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
    matrix = random_matrix(seed, size, share, copies)
    shape = (matrix.shape[0], columns) if columns else (matrix.shape[0],)
    right = np.random.default_rng(seed).standard_normal(shape)
    given_side = right.copy()
    with pytest.MonkeyPatch.context() as other:
        other.setattr(factorisation, "LEAF_UNKNOWNS", leaf)
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
            found.append((factors.riesz(load).tobytes(), factors.riesz(np.eye(len(load), 3)).tobytes()))
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


# ---------------------------------------------------------------- several at once

SIZE = 60


def _terms() -> tuple[sparse.csr_array, ...]:
    """Positive semi-definite terms of different patterns, one of them with entries that stand twice."""
    rng, places = np.random.default_rng(3), np.repeat(np.arange(SIZE), 2)
    springs = [
        sparse.csr_array(rng.normal(size=(20, SIZE)) * (rng.random((20, SIZE)) < 0.2)) for _ in range(2)
    ]
    starts = np.arange(0, 2 * SIZE + 1, 2)
    doubled = sparse.csr_array((np.full(2 * SIZE, 0.5), places, starts), shape=(SIZE, SIZE))
    return (*(sparse.csr_array(part.T @ part) for part in springs), doubled)


TERMS = _terms()
WHOLE = affine_sum((1.0, 1.0, 1.0), TERMS)


def test_several_systems_are_solved_at_once_near_a_factorised_one_or_given_up(monkeypatch):
    factors, coefficients = (
        Factorisation(WHOLE),
        np.array([(1.0, 1.0, 0.3), (1.0, 1.0, 2.0), (1.0, 1.0, 1.0)]),
    )
    right = np.random.default_rng(4).normal(size=(SIZE, 3)) * [1.0, 0.0, 1e3]
    given = (factors, TERMS, coefficients, factors.whitened(right), np.zeros_like(right))
    found = factors.unwhitened(solved_near(*given, tolerance=1e-12))
    for column, own, wanted in zip(found.T, coefficients.T, right.T, strict=True):
        np.testing.assert_allclose(affine_sum(own, TERMS) @ column, wanted, rtol=1e-9, atol=1e-9)
    monkeypatch.setattr(subspace, "MOST_ITERATIONS", 2)
    with pytest.raises(SolutionError, match="Conjugate gradients did not reach"):
        solved_near(*given, tolerance=1e-12)


def test_eigenpairs_equal_the_dense_ones_and_a_structure_that_is_not_held_has_none():
    stiffness, mass = DENSE @ DENSE.T + np.eye(30), np.diag(np.linspace(1.0, 2.0, 30))
    values, shapes = lowest_eigenpairs(sparse.csr_array(stiffness), sparse.csr_array(mass), 4)
    assert values == pytest.approx(eigh(stiffness, mass, eigvals_only=True)[:4], rel=1e-9)
    np.testing.assert_allclose(shapes.T @ mass @ shapes, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(stiffness @ shapes, mass @ shapes * values, atol=1e-9)
    loose = sparse.csr_array(np.diag([0.0, *np.arange(1.0, 20.0)]))
    with pytest.raises(SolutionError, match="not held"):
        lowest_eigenpairs(loose, sparse.eye_array(20).tocsr(), 3)


def test_a_basis_holds_what_it_was_given_and_says_what_it_dropped():
    """Blocks with copies, zeros and directions of all sizes: orthonormal in energy, with its terms projected.

    The rest is below the bound; a load and its answer are whitened alike.
    """
    random, factors = np.random.default_rng(5), Factorisation(WHOLE)
    plain, basis = OrthonormalBasis(SIZE, drop=1e-8), ProjectedBasis(factors, TERMS, (WHOLE,), drop=1e-8)
    assert plain.extend(np.zeros((SIZE, 3))).shape == (0, 3)
    assert (plain.vectors.shape, plain.dropped_square) == ((SIZE, 0), 0.0)
    own = random.normal(size=(SIZE, 12))
    whitened = factors.whitened(WHOLE @ own)
    np.testing.assert_allclose(factors.unwhitened(whitened), own, rtol=1e-9, atol=1e-9)
    blocks = [
        own[:, :4],
        np.column_stack((own[:, :4] @ random.normal(size=(4, 3)), own[:, 4:8], np.zeros(SIZE))),
        own[:, :8] @ random.normal(size=(8, 5)) + 10.0 ** -np.arange(1.0, 14.0, 2.6) * own[:, 7:12],
    ]
    left = []
    for block in blocks:
        known = basis.vectors.shape[1]
        images, _ = basis.add(block)
        np.testing.assert_array_equal(images[0], TERMS[0] @ basis.displacements[:, known:])
        coordinates = plain.extend(block)
        left.append(block - plain.vectors @ coordinates)
    np.testing.assert_array_equal(basis.vectors, plain.vectors)
    missing = np.linalg.norm(np.concatenate(left, axis=1), axis=0)
    assert 8 < basis.vectors.shape[1] < 12
    assert 0.0 < missing.max() <= np.sqrt(basis.dropped_square) * (1.0 + 1e-6) + 1e-12
    assert np.sqrt(basis.dropped_square) < 1e-6
    vectors, (inner, whole) = basis.displacements, basis.inner
    for found in (vectors.T @ WHOLE @ vectors, whole[0], basis.vectors.T @ basis.vectors):
        np.testing.assert_allclose(found, np.eye(len(found)), atol=1e-7)
    for term, projected in zip(TERMS, inner, strict=True):
        np.testing.assert_allclose(projected, vectors.T @ term @ vectors, atol=1e-9)
