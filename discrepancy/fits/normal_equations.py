"""Normal equations of a fit: derivatives and residuals of all trials, over their noise."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray, IntArray
from discrepancy.errors import FitError
from discrepancy.fits.candidate import (
    Candidate,
    FitState,
)
from discrepancy.fits.problem import Problem

LEAST_PRECISION = 1e-12
"""Precision of an unknown about which neither its prior nor the readings say anything."""


def check_finite(values: FloatArray) -> FloatArray:
    """Return the values as they are, if all of them are finite.

    Raises
    ------
    FitError
        If one of the values is not finite.
    """
    if not np.all(np.isfinite(values)):
        raise FitError(
            "The model gives values or derivatives that are not finite where a fit has come to."
        )
    return values


def cholesky_factor(matrix: FloatArray) -> FloatArray:
    """Return the upper Cholesky factor U (n, n) of a symmetric matrix U^T U.

    The entries below the diagonal of the returned array are arbitrary.

    Raises
    ------
    FitError
        If the matrix is not finite or not positive definite.
    """
    try:
        return np.asarray(cho_factor(check_finite(matrix), check_finite=False)[0])
    except np.linalg.LinAlgError as cause:
        raise FitError(
            "The normal equations of a fit are singular; a parameter has no influence."
        ) from cause


def solve_factored(factor: FloatArray, right: FloatArray) -> FloatArray:
    """Return (U^T U)^-1 b, given the factor U (n, n) and right-hand sides b (n, ...)."""
    return np.asarray(cho_solve((factor, False), right, check_finite=False))


# ---------------------------------------------------------------- normal equations


@dataclass(frozen=True, eq=False)
class TrialRows:
    """The derivatives and residuals of one trial, over the deviation of the noise.

    Attributes
    ----------
    rows : (L + K, N C) array
        The derivatives of the readings with respect to the L unknowns of the trial, then to the K
        shared unknowns and effect parameters that act on it.
    index : (K,) array of int
        The indices of these K among all shared unknowns and effect parameters.
    root : (C,) array
        The square root of the relative noise precision of each channel.
    residual : (N C,) array
        The residuals.
    value : (L,) array
        The values of the unknowns of the trial.
    prior : (L,) array
        The prior precisions of the unknowns of the trial.
    """

    rows: FloatArray
    index: IntArray
    root: FloatArray
    residual: FloatArray
    value: FloatArray
    prior: FloatArray

    def eliminate_local(self) -> tuple[FloatArray, FloatArray]:
        """Return what eliminates the unknowns of the trial from its normal equations.

        With A the block of the trial's unknowns and B that between them and the shared ones, it is
        the Cholesky factor (L, L) of A, and A^-1 B (L, K): by how much the trial's unknowns fall
        as the shared ones rise.
        """
        local_rows, shared_rows = np.split(self.rows, [len(self.prior)])
        block = local_rows @ local_rows.T + np.diag(self.prior + LEAST_PRECISION)
        factor = cholesky_factor(block)
        return factor, solve_factored(factor, local_rows @ shared_rows.T)


def trial_rows(
    problem: Problem, number: int, state: FitState, candidate: Candidate, precision: FloatArray
) -> TrialRows:
    """Return the derivatives and residuals of a trial at a state, over the deviation of the noise.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    number : int
        The index of the trial.
    state : FitState
        The point, its residuals and derivatives.
    candidate : Candidate
        The effects whose parameters are unknowns.
    precision : (channels,) array
        The noise precision of each channel, relative to the recorded one.
    """
    data = problem.trials[number]
    columns, index = problem.prediction_derivatives(
        number, state.point, state.linearisations[number], candidate
    )
    root = np.sqrt(precision[data.groups])
    residual = (state.residuals[number] * root).ravel()
    rows = (data.standardised(columns) * root).reshape(len(columns), residual.size)
    return TrialRows(
        rows=rows,
        index=index,
        root=root,
        residual=residual,
        value=state.point.local[number],
        prior=data.unknowns.precision,
    )


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The normal equations of a fit.

    Their unknowns are the shared ones, the effect parameters, and those of each trial, in this
    order.

    Attributes
    ----------
    trials : list of (TrialRows, (M,) array of int)
        The derivatives of each trial, and the indices of their rows among all unknowns.
    matrix : (n, n) array
        The approximate Hessian of the negative log posterior.
    gradient : (n,) array
        The negative gradient of the negative log posterior: downhill.
    """

    trials: list[tuple[TrialRows, IntArray]]
    matrix: FloatArray
    gradient: FloatArray


def normal_equations(
    problem: Problem,
    state: FitState,
    candidate: Candidate,
    precision: FloatArray,
    effect_precision: FloatArray | None = None,
) -> NormalEquations:
    """Return the normal equations of a fit at a state.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    state : FitState
        The point, its residuals and derivatives.
    candidate : Candidate
        The effects whose parameters are unknowns.
    precision : (channels,) array
        The noise precision of each channel, relative to the recorded one.
    effect_precision : (E,) array, optional
        The prior precisions of the effect parameters; 1 if left out.
    """
    numbers = range(len(problem.trials))
    trials = [trial_rows(problem, number, state, candidate, precision) for number in numbers]
    # prior
    if effect_precision is None:
        effect_precision = np.ones(candidate.size)
    local_priors = [rows.prior for rows in trials]
    prior = np.concatenate((problem.shared.precision, effect_precision, *local_priors))
    effect = state.point.effect[: candidate.size]
    local_values = [rows.value for rows in trials]
    values = np.concatenate((state.point.shared, effect, *local_values))
    matrix = np.diag(prior + LEAST_PRECISION)
    gradient = -prior * values
    # readings
    first_local = problem.shared.size + candidate.size
    indexed_trials = []
    for rows in trials:
        local_index = first_local + np.arange(len(rows.prior))
        index = np.concatenate((local_index, rows.index))
        first_local += len(rows.prior)
        matrix[np.ix_(index, index)] += rows.rows @ rows.rows.T
        gradient[index] += rows.rows @ rows.residual
        indexed_trials.append((rows, index))
    return NormalEquations(indexed_trials, matrix, gradient)
