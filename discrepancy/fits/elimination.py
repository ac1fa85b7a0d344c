"""Normal equations of a fit; the trials' own unknowns are eliminated trial by trial (Schur complement).

A factor of a curvature that is singular or not finite is a `FitError`, whatever made it so.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.sampling import IntArray
from discrepancy.errors import FitError

from .candidate import Candidate, State
from .problem import Problem


def finite(values: FloatArray) -> FloatArray:
    """Return values as they are.

    Raises
    ------
    FitError
        If one of them is not finite.
    """
    if not np.all(np.isfinite(values)):
        raise FitError("The model gives values or derivatives that are not finite where a fit has come to.")
    return values


@dataclass(frozen=True, eq=False)
class Cholesky:
    """A positive definite matrix by its factor, U^T U.

    Attributes
    ----------
    upper : (n, n) ndarray
        U; what stands below its diagonal means nothing.
    """

    upper: FloatArray

    @classmethod
    def of(cls, matrix: FloatArray) -> "Cholesky":
        """Factorise a symmetric matrix (n, n).

        Raises
        ------
        FitError
            If it is not finite or not positive definite.
        """
        try:
            return cls(cho_factor(finite(matrix), check_finite=False)[0])
        except np.linalg.LinAlgError as cause:
            raise FitError(
                "The normal equations of a fit are singular; a parameter has no influence."
            ) from cause

    def solve(self, right: FloatArray) -> FloatArray:
        """Return (U^T U)^-1 b for columns b (n, ...)."""
        return np.asarray(cho_solve((self.upper, False), right, check_finite=False))

    def half(self, right: FloatArray) -> FloatArray:
        """Return U^-T b for columns b (n, ...), whose inner products are those by the matrix's inverse."""
        return np.asarray(solve_triangular(self.upper, right, trans="T", check_finite=False))

    @property
    def log_determinant(self) -> float:
        """Of the matrix, ln det."""
        return 2.0 * float(np.log(np.diag(self.upper)).sum())


@dataclass(frozen=True)
class TrialBlock:
    """Normal equations of one trial."""

    local: FloatArray  # (L, L) with prior
    cross: FloatArray  # (L, K)
    shared: FloatArray  # (K, K)
    local_gradient: FloatArray  # (L,)
    shared_gradient: FloatArray  # (K,)
    index: IntArray  # (K,) which shared unknowns the trial knows
    rows: FloatArray  # (L + K, N C) derivatives of the readings over their noise
    root: FloatArray  # (C,) of the precision of each channel

    @cached_property
    def factor(self) -> Cholesky:
        """Of the trial's own unknowns."""
        return Cholesky.of(self.local)

    @cached_property
    def half(self) -> FloatArray:
        """U^-T (L, L) of that factor, by which single vectors are multiplied faster than solved for."""
        return self.factor.half(np.eye(len(self.local)))

    @cached_property
    def followed(self) -> FloatArray:
        """What the trial's own unknowns (L, K) do less of where the shared ones do more."""
        return self.factor.solve(self.cross)

    @property
    def matrix(self) -> FloatArray:
        """What is left of the shared ones' (K, K) when the trial's own unknowns follow."""
        return self.shared - self.cross.T @ self.followed

    @property
    def gradient(self) -> FloatArray:
        """The same of the gradient (K,)."""
        return self.shared_gradient - self.followed.T @ self.local_gradient


def trial_block(
    problem: Problem,
    number: int,
    found: State,
    candidate: Candidate,
    precision: FloatArray,
    damping: float = 0.0,
) -> TrialBlock:
    """Return the normal equations of a trial, by precisions of all channels, its own unknowns damped."""
    data, point = problem.trials[number], found.point
    columns, index = problem.columns(number, point, found.linearisations[number], candidate)
    root = np.sqrt(precision[data.groups])
    rows = (data.standardised(columns) * root).reshape(len(columns), -1)
    normal, gradient = rows @ rows.T, rows @ (found.residuals[number] * root).ravel()
    u, prior, count = point.local[number], data.unknowns.precision, data.unknowns.size
    local = normal[:count, :count] + np.diag(prior + 1e-12)
    return TrialBlock(
        local=local + damping * np.diag(np.diag(local)),
        cross=normal[:count, count:],
        shared=normal[count:, count:],
        local_gradient=gradient[:count] - prior * u,
        shared_gradient=gradient[count:],
        index=index,
        rows=rows,
        root=root,
    )


class Eliminated(NamedTuple):
    """Normal equations of shared unknowns and effect parameters, the trials' own unknowns eliminated.

    Attributes
    ----------
    blocks : list of TrialBlock
        Of each trial.
    matrix, gradient : (Q + E, Q + E), (Q + E,) ndarray
        With prior.
    prior : (Q + E,) ndarray
        Its precision.
    """

    blocks: list[TrialBlock]
    matrix: FloatArray
    gradient: FloatArray
    prior: FloatArray


def eliminated(
    problem: Problem,
    found: State,
    candidate: Candidate,
    precision: FloatArray,
    *,
    effect_precision: FloatArray | None = None,
    damping: float = 0.0,
) -> Eliminated:
    """Return the normal equations of a problem.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    found : State
        Where they are taken.
    candidate : Candidate
        Its effect parameters are unknowns.
    precision : (channels,) ndarray
        Of the noise of each channel.
    effect_precision : (E,) ndarray, optional
        Of the prior of the effect parameters; one if left out.
    damping : float
        Of the trials' own unknowns.
    """
    effect_prior = np.ones(candidate.size) if effect_precision is None else effect_precision
    prior = np.concatenate((problem.shared.precision, effect_prior))
    matrix = np.diag(prior + 1e-12)
    gradient = -prior * np.concatenate((found.point.shared, found.point.effect))[: len(prior)]
    numbers = range(len(problem.trials))
    blocks = [trial_block(problem, number, found, candidate, precision, damping) for number in numbers]
    for block in blocks:
        matrix[np.ix_(block.index, block.index)] += block.matrix
        np.add.at(gradient, block.index, block.gradient)
    return Eliminated(blocks, matrix, gradient, prior)
