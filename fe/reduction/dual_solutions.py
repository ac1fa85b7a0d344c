"""Offline: approximate dual solutions, on which the sharpness of the error bound rests.

Either the solution at the nearest of several anchors is taken, or those at a few states are combined for each
state, as a reduced basis of each output (Rozza, Huynh and Patera 2008).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from fe.full.subspace import Norm
from fe.runtime.arrays import FloatArray
from fe.runtime.errors import ReductionError

from .terms import ReductionTerms, solved_together

DUAL_TOLERANCE, COMBINED_TOLERANCE = 0.05, 0.01
"""Relative residual of approximate dual solutions at their own states, taken alone and combined."""
DEPENDENT = 1e-3
"""Combinations of the dual solutions of an output that are shorter, relative to the longest, are left out."""
MOST_COLUMNS = 48
"""Columns of approximate dual solutions that are iterated together."""


def dual_solutions(
    terms: ReductionTerms, norm: Norm, advance: Callable[[int, str], object]
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Solve K psi = l for each output l, roughly: the norms of what that leaves are computed, not assumed.

    Parameters
    ----------
    terms : ReductionTerms
        The full model.
    norm : Norm
        Energy norm X of one stiffness.
    advance : callable
        Told one more part, and of what.

    Returns
    -------
    products : (A or M, n, O) ndarray
        X times the functions, whitened.
    arrays : dict of str to ndarray
        `dual_residual`, `dual_stiffness` and `dual_output` of `ReducedArrays`.
    """
    states, combined = terms.dual_states()
    at_once = max(1, MOST_COLUMNS // terms.outputs.shape[1])
    start, found = norm.riesz(terms.outputs), []
    for first in range(0, len(states), at_once):
        chosen = states[first : first + at_once]
        tolerance = COMBINED_TOLERANCE if combined else DUAL_TOLERANCE
        found += solved_together(terms, norm, chosen, terms.outputs, [start] * len(chosen), tolerance)
        advance(len(chosen), "dual solutions")
    solutions = np.stack(found)
    del found  # as large as they are
    duals, arrays = (_combined if combined else _nearest)(terms, norm, solutions)
    return np.stack([norm.whitened(norm.product(dual)) for dual in duals]), arrays


def _nearest(
    terms: ReductionTerms, norm: Norm, duals: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Take the solutions (A, n, O) at anchors alone, with the norms of their residuals elsewhere."""
    factors = []
    for dual in duals:
        *varied, constant = (np.asarray(term @ dual) for term in terms.stiffness_terms)
        functionals = np.stack((terms.outputs - constant, *varied), axis=2)
        factors.append([_factor(norm, part) for part in functionals.swapaxes(0, 1)])
    count = terms.outputs.shape[1]
    none = np.empty((count, len(terms.stiffness_terms), 0, 0))
    arrays = {"dual_stiffness": none, "dual_output": np.empty((count, 0))}
    return duals, {"dual_residual": np.array(factors), **arrays}


def _combined(
    terms: ReductionTerms, norm: Norm, solutions: FloatArray
) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Make the solutions (M, n, O) at states orthonormal for each output, to be combined."""
    duals, kept = np.ascontiguousarray(solutions.transpose(2, 1, 0)), 0  # (O, n, M)
    for dual in duals:
        square, turn = np.linalg.eigh(dual.T @ norm.product(dual))
        used = np.flatnonzero(square > DEPENDENT**2 * square[-1])[::-1]
        basis = dual @ (turn[:, used] / np.sqrt(square[used]))
        dual[:, : len(used)], dual[:, len(used) :] = basis, 0.0
        kept = max(kept, len(used))
    duals = duals[:, :, :kept]
    stiffness = np.empty((len(duals), len(terms.stiffness_terms), kept, kept))
    factors = []
    for dual, output, inner in zip(duals, terms.outputs.T, stiffness, strict=True):
        images = [np.asarray(term @ dual) for term in terms.stiffness_terms]
        inner[:] = [dual.T @ image for image in images]
        factors.append(_factor(norm, np.column_stack((output, *images))))
    absent = np.asarray(~duals.any(axis=1))
    stiffness[:, -1] += absent[:, :, np.newaxis] * np.eye(kept)  # a function that is not there gets no part
    return duals.transpose(2, 1, 0), {
        "dual_residual": np.array([factors]),
        "dual_stiffness": stiffness,
        "dual_output": np.einsum("no,onm->om", terms.outputs, duals),
    }


def _factor(norm: Norm, functionals: FloatArray) -> Any:
    """Return R (k, k) with |functionals (n, k) @ c| = |R @ c| in the dual norm."""
    found = np.linalg.qr(norm.whitened(functionals), mode="r")
    if not np.isfinite(found).all():
        raise ReductionError("The dual residuals are not finite; the full model holds a value that is not.")
    return found
