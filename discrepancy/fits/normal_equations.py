"""Normal equations of a fit, of all its unknowns at once.

A factor of a curvature that is singular or not finite is a `FitError`, whatever made it so.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.sampling import IntArray
from discrepancy.errors import FitError

from .candidate import Candidate, State
from .problem import Problem

LEAST_PRECISION = 1e-12
"""Of an unknown of which neither prior nor readings tell anything."""


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


def upper_factor(matrix: FloatArray) -> FloatArray:
    """Return U (n, n) of a symmetric matrix U^T U; what stands below its diagonal means nothing.

    Raises
    ------
    FitError
        If it is not finite or not positive definite.
    """
    try:
        return np.asarray(cho_factor(finite(matrix), check_finite=False)[0])
    except np.linalg.LinAlgError as cause:
        raise FitError("The normal equations of a fit are singular; a parameter has no influence.") from cause


def solved(factor: FloatArray, right: FloatArray) -> FloatArray:
    """Return (U^T U)^-1 b for columns b (n, ...)."""
    return np.asarray(cho_solve((factor, False), right, check_finite=False))


@dataclass(frozen=True, eq=False)
class TrialRows:
    """What the unknowns that touch a trial do to its readings, over their noise.

    Attributes
    ----------
    rows : (L + K, N C) ndarray
        By the L unknowns of the trial, then by K of the shared ones and effect parameters.
    index : (K,) ndarray of int
        Which these are.
    root : (C,) ndarray
        Of the precision of each channel.
    residual : (N C,) ndarray
        Over the noise.
    value, prior : (L,) ndarray
        Of the trial's unknowns, and the precision of their prior.
    """

    rows: FloatArray
    index: IntArray
    root: FloatArray
    residual: FloatArray
    value: FloatArray
    prior: FloatArray

    def followed(self) -> tuple[FloatArray, FloatArray]:
        """Return the factor of the own unknowns, and what they (L, K) do less of as others do more."""
        own, others = np.split(self.rows, [len(self.prior)])
        factor = upper_factor(own @ own.T + np.diag(self.prior + LEAST_PRECISION))
        return factor, solved(factor, own @ others.T)

    def of_shared(self) -> tuple[FloatArray, FloatArray]:
        """Return matrix (K, K) and gradient (K,) of the others where the trial's own unknowns follow."""
        own, others = np.split(self.rows, [len(self.prior)])
        _, along = self.followed()
        gradient = others @ self.residual - along.T @ (own @ self.residual - self.prior * self.value)
        return others @ others.T - (others @ own.T) @ along, gradient


def trial_rows(
    problem: Problem, number: int, found: State, candidate: Candidate, precision: FloatArray
) -> TrialRows:
    """Return the derivatives of a trial at a state, by precisions (channels,) of all channels."""
    data, point = problem.trials[number], found.point
    columns, index = problem.columns(number, point, found.linearisations[number], candidate)
    root = np.sqrt(precision[data.groups])
    rows = (data.standardised(columns) * root).reshape(len(columns), -1)
    residual = (found.residuals[number] * root).ravel()
    return TrialRows(rows, index, root, residual, point.local[number], data.unknowns.precision)


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations of shared unknowns, effect parameters, and the unknowns of each trial, in this order.

    Attributes
    ----------
    trials : list of (TrialRows, (M,) ndarray of int)
        Of each trial, and which of all unknowns its rows belong to.
    matrix, gradient : (n, n), (n,) ndarray
        With prior.
    """

    trials: list[tuple[TrialRows, IntArray]]
    matrix: FloatArray
    gradient: FloatArray


def normal_equations(
    problem: Problem,
    found: State,
    candidate: Candidate,
    precision: FloatArray,
    effect_precision: FloatArray | None = None,
) -> NormalEquations:
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
    """
    numbers = range(len(problem.trials))
    trials = [trial_rows(problem, number, found, candidate, precision) for number in numbers]
    at = problem.shared.size + candidate.size
    effect_prior = np.ones(candidate.size) if effect_precision is None else effect_precision
    prior = np.concatenate((problem.shared.precision, effect_prior, *(item.prior for item in trials)))
    shared = (found.point.shared, found.point.effect[: candidate.size])
    matrix = np.diag(prior + LEAST_PRECISION)
    gradient = -prior * np.concatenate((*shared, *(item.value for item in trials)))
    placed = []
    for item in trials:
        place = np.concatenate((at + np.arange(len(item.prior)), item.index))
        at += len(item.prior)
        matrix[np.ix_(place, place)] += item.rows @ item.rows.T
        gradient[place] += item.rows @ item.residual
        placed.append((item, place))
    return NormalEquations(placed, matrix, gradient)
