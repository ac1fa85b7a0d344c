"""What solves for several states at once: sums of sparse terms, matrices together, bases in blocks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from fe.full.subspace import FunctionalBasis, Norm, conjugate_gradients
from fe.structure.affine import AffineSum, affine_sum

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


@pytest.mark.parametrize("coefficients", [(1.0, 2.0, 3.0), (0.0, -1.0, 0.5)])
def test_a_sum_is_the_sum(coefficients) -> None:
    wanted = sum(c * term.toarray() for c, term in zip(coefficients, TERMS, strict=True))
    for found in (AffineSum(TERMS).matrix(coefficients), affine_sum(coefficients, TERMS)):
        np.testing.assert_allclose(found.toarray(), wanted, rtol=0.0, atol=1e-13)


def test_several_matrices_are_solved_with_at_once() -> None:
    matrices = [WHOLE, affine_sum((0.3, 2.0, 1.0), TERMS)]
    right = np.random.default_rng(4).normal(size=(SIZE, 4))
    found = conjugate_gradients(matrices, Norm(WHOLE), right, np.zeros_like(right), tolerance=1e-12)
    wanted = [np.linalg.solve(m.toarray(), right[:, 2 * k : 2 * k + 2]) for k, m in enumerate(matrices)]
    np.testing.assert_allclose(found, np.concatenate(wanted, axis=1), rtol=1e-9)


def test_a_basis_of_functionals_holds_what_it_was_given_and_says_what_it_dropped() -> None:
    """Blocks with copies, zeros and directions of all sizes: orthonormal, and the rest is below the bound."""
    rng, norm = np.random.default_rng(5), Norm(WHOLE)
    basis, own = FunctionalBasis(SIZE, norm, drop=1e-8), rng.normal(size=(SIZE, 12))
    blocks = [
        own[:, :4],
        np.column_stack((own[:, :4] @ rng.normal(size=(4, 3)), own[:, 4:8], np.zeros(SIZE))),
        own[:, :8] @ rng.normal(size=(8, 5)) + 10.0 ** -np.arange(1.0, 14.0, 2.6) * own[:, 7:12],
    ]
    coordinates = [basis.extend(block) for block in blocks]
    vectors, given = basis.vectors, np.concatenate(blocks, axis=1)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(vectors.shape[1]), atol=1e-7)
    lengths = np.linalg.norm(norm.whitened(given), axis=0)
    np.testing.assert_allclose(lengths**2, np.einsum("ik,ik->k", given, norm.riesz(given)), rtol=1e-11)
    left = [norm.whitened(b) - vectors[:, : len(c)] @ c for b, c in zip(blocks, coordinates, strict=True)]
    missing = np.linalg.norm(np.concatenate(left, axis=1), axis=0)
    assert 8 < vectors.shape[1] < 12
    assert 0.0 < missing.max() <= np.sqrt(basis.dropped_square) * (1.0 + 1e-6) + 1e-12
    assert np.sqrt(basis.dropped_square) < 1e-6


def test_a_basis_takes_nothing_of_nothing() -> None:
    basis = FunctionalBasis(SIZE, Norm(WHOLE), drop=1e-8)
    assert basis.extend(np.zeros((SIZE, 3))).shape == (0, 3)
    assert basis.vectors.shape == (SIZE, 0)
    assert basis.dropped_square == pytest.approx(0.0)
