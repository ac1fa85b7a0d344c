"""What solves for several states at once: sums of sparse terms, matrices together, bases in blocks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from fe.full.affine import AffineSum, affine_sum
from fe.full.subspace import FunctionalBasis, Norm, conjugate_gradients

SIZE = 60


def _terms() -> tuple[sparse.csr_array, ...]:
    """Positive semi-definite terms of different patterns, one of them with entries that stand twice."""
    rng = np.random.default_rng(3)
    springs = [
        sparse.csr_array(rng.normal(size=(20, SIZE)) * (rng.random((20, SIZE)) < 0.2)) for _ in range(2)
    ]
    doubled = sparse.coo_array(
        (np.full(2 * SIZE, 0.5), (np.tile(np.arange(SIZE), 2), np.tile(np.arange(SIZE), 2))), (SIZE, SIZE)
    )
    rows = sparse.csr_array(
        (doubled.data, np.repeat(np.arange(SIZE), 2), np.arange(0, 2 * SIZE + 1, 2)), shape=(SIZE, SIZE)
    )
    return (*(sparse.csr_array(part.T @ part) for part in springs), rows)


def test_a_sum_is_the_sum() -> None:
    terms = _terms()
    sums = AffineSum(terms)
    for coefficients in ((1.0, 2.0, 3.0), (0.0, -1.0, 0.5)):
        wanted = sum(c * term.toarray() for c, term in zip(coefficients, terms, strict=True))
        np.testing.assert_allclose(sums.matrix(coefficients).toarray(), wanted, rtol=0.0, atol=1e-13)
        np.testing.assert_allclose(affine_sum(coefficients, terms).toarray(), wanted, rtol=0.0, atol=1e-13)


def test_several_matrices_are_solved_with_at_once() -> None:
    terms, rng = _terms(), np.random.default_rng(4)
    matrices = [affine_sum(theta, terms) for theta in ((1.0, 1.0, 1.0), (0.3, 2.0, 1.0))]
    right = rng.normal(size=(SIZE, 4))
    found = conjugate_gradients(matrices, Norm(matrices[0]), right, np.zeros_like(right), tolerance=1e-12)
    for number, matrix in enumerate(matrices):
        columns = slice(2 * number, 2 * number + 2)
        np.testing.assert_allclose(
            found[:, columns], np.linalg.solve(matrix.toarray(), right[:, columns]), rtol=1e-9
        )


def test_a_basis_of_functionals_holds_what_it_was_given_and_says_what_it_dropped() -> None:
    """Blocks with copies, zeros and directions of all sizes: orthonormal, and the rest is below the bound."""
    matrix, rng = affine_sum((1.0, 1.0, 1.0), _terms()), np.random.default_rng(5)
    norm = Norm(matrix)
    basis = FunctionalBasis(SIZE, norm, drop=1e-8)
    independent = rng.normal(size=(SIZE, 12))
    blocks = [
        independent[:, :4],
        np.column_stack((independent[:, :4] @ rng.normal(size=(4, 3)), independent[:, 4:8], np.zeros(SIZE))),
        independent[:, :8] @ rng.normal(size=(8, 5))
        + 10.0 ** -np.arange(1.0, 14.0, 2.6) * independent[:, 7:12],
    ]
    coordinates = [basis.extend(block) for block in blocks]
    np.testing.assert_allclose(basis.vectors.T @ basis.vectors, np.eye(basis.vectors.shape[1]), atol=1e-7)
    given = np.concatenate(blocks, axis=1)
    lengths = np.linalg.norm(norm.whitened(given), axis=0)
    np.testing.assert_allclose(lengths**2, np.einsum("ik,ik->k", given, norm.riesz(given)), rtol=1e-11)
    left = [
        norm.whitened(block) - basis.vectors[:, : len(found)] @ found
        for block, found in zip(blocks, coordinates, strict=True)
    ]
    missing = np.linalg.norm(np.concatenate(left, axis=1), axis=0)
    assert 8 < basis.vectors.shape[1] < 12
    assert 0.0 < missing.max() <= np.sqrt(basis.dropped_square) * (1.0 + 1e-6) + 1e-12
    assert np.sqrt(basis.dropped_square) < 1e-6


def test_a_basis_takes_nothing_of_nothing() -> None:
    basis = FunctionalBasis(SIZE, Norm(affine_sum((1.0, 1.0, 1.0), _terms())), drop=1e-8)
    assert basis.extend(np.zeros((SIZE, 3))).shape == (0, 3)
    assert basis.vectors.shape == (SIZE, 0)
    assert basis.dropped_square == pytest.approx(0.0)
