"""Normal equations of a fit, from the derivatives and residuals of all trials over their noise.

Their matrix is the Gauss-Newton approximation of the Hessian of the negative log posterior.
"""

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
"""Precision added for every unknown, so that one without a prior and without influence on the
readings does not make the matrix singular."""


def check_finite(values: FloatArray) -> FloatArray:
    """Return the values unchanged after checking that all of them are finite.

    Raises
    ------
    FitError
        If one of the values is not finite.
    """
    if not np.all(np.isfinite(values)):
        raise FitError(
            "A fit reached values of the unknowns at which the model gives values or derivatives "
            "that are not finite; check the ranges of its parameters."
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
            "The normal equations of a fit are singular: the readings do not depend on one of its "
            "unknowns, or on several in the same way; state a prior deviation or fix one of them."
        ) from cause


def solve_factored(factor: FloatArray, right_side: FloatArray) -> FloatArray:
    """Return the solution x (n, ...) of U^T U x = b.

    Parameters
    ----------
    factor : (n, n) array
        The upper Cholesky factor U, as `cholesky_factor` returns it.
    right_side : (n, ...) array
        The right-hand sides b.
    """
    return np.asarray(cho_solve((factor, False), right_side, check_finite=False))


# ---------------------------------------------------------------- normal equations


@dataclass(frozen=True, eq=False)
class TrialJacobian:
    """The derivatives and residuals of one trial, in units of the noise deviation.

    The N C readings are those of N samples in C channels, sample by sample.

    Attributes
    ----------
    jacobian : (L + K, N C) array
        The derivatives of the readings: one row for each of the L unknowns of the trial, then one
        for each of the K shared unknowns and effect parameters that act on it.
    shared_indices : (K,) array of int
        The indices of these K among all shared unknowns and effect parameters.
    precision_root : (C,) array
        The recorded noise deviation of each channel over the estimated one.
    residual : (N C,) array
        The readings minus their prediction.
    local_values : (L,) array
        The scaled values of the unknowns of the trial.
    local_precision : (L,) array
        The prior precisions of the unknowns of the trial.
    """

    jacobian: FloatArray
    shared_indices: IntArray
    precision_root: FloatArray
    residual: FloatArray
    local_values: FloatArray
    local_precision: FloatArray

    def eliminate_local(self) -> tuple[FloatArray, FloatArray]:
        """Return the matrices that eliminate the trial's own unknowns from the normal equations.

        Let A be the block of the normal equations of the trial's own unknowns, and B the block
        between them and the shared unknowns. The own unknowns that minimise the objective change
        by -A^-1 B per unit of the shared unknowns.

        Returns
        -------
        factor : (L, L) array
            The upper Cholesky factor of A.
        local_per_shared : (L, K) array
            A^-1 B.
        """
        local_jacobian, shared_jacobian = np.split(self.jacobian, [len(self.local_precision)])
        local_block = local_jacobian @ local_jacobian.T + np.diag(
            self.local_precision + LEAST_PRECISION
        )
        factor = cholesky_factor(local_block)
        return factor, solve_factored(factor, local_jacobian @ shared_jacobian.T)


def trial_jacobian(
    problem: Problem, trial_index: int, state: FitState, candidate: Candidate, precision: FloatArray
) -> TrialJacobian:
    """Return the derivatives and residuals of a trial in units of the estimated noise deviation.

    These are the trial's rows of the least-squares problem that `normal_equations` assembles.

    Parameters
    ----------
    precision : (channels,) array
        The estimated noise precision (inverse variance) of each channel over the recorded one.
    """
    data = problem.trials[trial_index]
    prediction_derivatives, shared_indices = problem.prediction_derivatives(
        trial_index, state.point, state.trial_derivatives[trial_index], candidate
    )
    precision_root = np.sqrt(precision[data.channel_indices])
    # in estimated noise deviations: a value in recorded ones times recorded / estimated deviation,
    # which is the root of the precision of each channel; it is broadcast over unknowns and samples
    scaled_residual = (state.residuals[trial_index] * precision_root).ravel()
    jacobian = (data.standardise(prediction_derivatives) * precision_root).reshape(
        len(prediction_derivatives), scaled_residual.size
    )
    return TrialJacobian(
        jacobian=jacobian,
        shared_indices=shared_indices,
        precision_root=precision_root,
        residual=scaled_residual,
        local_values=state.point.local[trial_index],
        local_precision=data.unknowns.precision,
    )


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """The normal equations of a fit: matrix @ step = gradient.

    The n unknowns are the shared ones, the effect parameters, and those of each trial, in this
    order.

    Attributes
    ----------
    trials : list of (TrialJacobian, (M,) array of int)
        The derivatives of each trial, and the indices of their M rows among the n unknowns.
    matrix : (n, n) array
        The Gauss-Newton approximation of the Hessian of the negative log posterior.
    gradient : (n,) array
        The negative gradient of the negative log posterior, which points downhill.
    """

    trials: list[tuple[TrialJacobian, IntArray]]
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
    precision : (channels,) array
        The estimated noise precision (inverse variance) of each channel over the recorded one.
    effect_precision : (E,) array, optional
        The prior precisions of the effect parameters; 1 if left out.
    """
    trial_indices = range(len(problem.trials))
    trial_equations = [
        trial_jacobian(problem, trial_index, state, candidate, precision)
        for trial_index in trial_indices
    ]
    # prior: each scaled unknown u adds precision u^2 / 2 to the objective
    if effect_precision is None:
        effect_precision = np.ones(candidate.parameter_count)
    local_priors = [trial.local_precision for trial in trial_equations]
    prior_precision = np.concatenate((problem.shared.precision, effect_precision, *local_priors))
    effect = state.point.effect[: candidate.parameter_count]
    local_values = [trial.local_values for trial in trial_equations]
    scaled_values = np.concatenate((state.point.shared, effect, *local_values))
    matrix = np.diag(prior_precision + LEAST_PRECISION)
    gradient = -prior_precision * scaled_values
    # readings: J J^T and J r of each trial, with its derivatives J (M, N C) and residuals r
    first_local = problem.shared.unknown_count + candidate.parameter_count
    trials_with_indices = []
    for trial in trial_equations:
        local_indices = first_local + np.arange(len(trial.local_precision))
        unknown_indices = np.concatenate((local_indices, trial.shared_indices))
        first_local += len(trial.local_precision)
        matrix[np.ix_(unknown_indices, unknown_indices)] += trial.jacobian @ trial.jacobian.T
        gradient[unknown_indices] += trial.jacobian @ trial.residual
        trials_with_indices.append((trial, unknown_indices))
    return NormalEquations(trials_with_indices, matrix, gradient)


def covariance_by_mesh_errors(
    problem: Problem, equations: NormalEquations, covariance: FloatArray
) -> FloatArray | None:
    """Return the covariance (E, E) of the effect parameters by errors of a mesh in the readings.

    The fit attributes these errors to its unknowns: errors e of the readings move all unknowns by
    H^-1 J e, with the derivatives J. Errors of different trials and channels are taken as
    independent. `covariance` (E, n) has the rows of H^-1 that belong to the effect parameters. The
    result is None if no errors of a mesh are fitted.
    """
    if not problem.model.nuisance_parameters:
        return None
    by_mesh = np.zeros((len(covariance), len(covariance)))
    for data, (trial_jacobian, unknown_indices) in zip(
        problem.trials, equations.trials, strict=True
    ):
        derivatives = trial_jacobian.jacobian.reshape(-1, *data.weight.shape)  # (M, N, C)
        for column, errors in enumerate(data.mesh_errors):
            weighted_errors = trial_jacobian.precision_root[column] * errors
            moves = covariance[:, unknown_indices] @ (derivatives[:, :, column] @ weighted_errors)
            by_mesh += moves @ moves.T
    return by_mesh
