"""Residuals of a fit with their expected variance, and posterior draws of its effects.

The residuals are used to locate a discrepancy, to prove an effect, and in the report.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, softmax
from scipy.stats import multivariate_t

from calibration.static.posterior import stratified
from discrepancy.campaign.records import FloatArray
from discrepancy.catalogue.entry import NINETY_PERCENT_QUANTILE
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.beginnings import (
    refit_from_first_readings,
    with_initial_states_of_first_readings,
)
from discrepancy.fits.candidate import Candidate, Point
from discrepancy.fits.fitting import CandidateFit, fit, objective
from discrepancy.fits.normal_equations import TrialJacobian, trial_jacobian
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.fits.trial_data import TrialData
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.search_settings import SEARCH


def residual_set(problem: Problem, fit: CandidateFit, *, sensitivities: bool = True) -> ResidualSet:
    """Return the residuals of all trials of a campaign, fitted and held out, with their variance.

    Parameters
    ----------
    sensitivities : bool
        Whether the factor of the exact covariance of the predictions is computed (P columns for
        each sample), or only its diagonal, the leverage. Held-out trials have only the leverage.

    Notes
    -----
    A fit may have a residual process, which describes by how much the model is wrong. It then also
    stands for the uncertainty of the shared unknowns, so only the trials' own unknowns enter the
    leverage: a χ² test against the noise is to show how wrong the model is.

    The noise of a channel without a record is estimated from the residuals of the fitted trials.
    """
    precision = problem.recorded_or_estimated_precisions(fit.squares_by_channel)
    predictions = _TrialPredictions(problem, fit, precision=precision)
    trials = predictions.fitted_trials(sensitivities=sensitivities)
    if problem.campaign.held_out:
        held_out_problem, held_out_fit = fit_held_out(problem, fit)
        held_out_predictions = _TrialPredictions(
            held_out_problem, fit, local_fit=held_out_fit, precision=precision
        )
        trials += held_out_predictions.fitted_trials()
    by_name = {trial.trial.name: trial for trial in trials}
    in_order = [by_name[trial.name] for trial in problem.campaign.trials if trial.name in by_name]
    return ResidualSet(problem.campaign.channels, tuple(in_order))


def fit_held_out(
    problem: Problem, fit_of_other_trials: CandidateFit
) -> tuple[Problem, CandidateFit]:
    """Return the problem of the held-out trials, and the fit of their own unknowns.

    A trial's own unknowns are, for example, zeros of channels and the initial state. The shared
    unknowns and the effects keep the values fitted to the other trials, so that the held-out trials
    test them.
    """
    candidate = fit_of_other_trials.candidate
    held_out = problem.with_trials(problem.campaign.held_out)
    start = replace(
        held_out.prior_mean_point(candidate),
        shared=fit_of_other_trials.point.shared,
        effect=fit_of_other_trials.point.effect,
    )
    if all(trial.name in problem.initial_states for trial in problem.campaign.held_out):
        start = with_initial_states_of_first_readings(held_out, start)
    local_fit = fit(held_out, candidate, start, local_only=True)
    local_fit = refit_from_first_readings(held_out, local_fit, local_only=True)
    # a poor fit may be at a wrong optimum: try again from another release amplitude
    if local_fit.chi_square > SEARCH.far_chi_square * float(held_out.sample_counts.sum()):
        start = _with_best_release_amplitudes(held_out, candidate, start)
        second_fit = fit(held_out, candidate, start, local_only=True)
        if second_fit.objective < local_fit.objective:
            local_fit = second_fit
    return held_out, local_fit


RELEASE_AMPLITUDES = tuple(np.linspace(-2.0, 2.0, 17).tolist())
"""Differences from the nominal amplitude of a release at which the fit of a held-out trial may
begin: in prior deviations, or for a free initial state in tenths of the nominal amplitude."""


def _with_best_release_amplitudes(held_out: Problem, candidate: Candidate, start: Point) -> Point:
    """Return the start, in which each release has the amplitude of least objective on a grid.

    The amplitude is that of the first released mode. If friction ends a motion, there is one
    optimum for each number of half swings, and a descent finds only the nearest one.
    """
    best_local = list(start.local)
    for trial_index, data in enumerate(held_out.trials):
        release = data.trial.release
        amplitude_index = data.unknowns.indices.initial_state.start
        if release is None or amplitude_index >= data.unknowns.unknown_count:
            continue
        # The unknown is scaled by its prior deviation. For a release from rest it is the difference
        # from the nominal amplitude. For a free initial state it is the amplitude itself, in units
        # of the nominal one: there the nominal amplitude 1 has the scaled value 1 / deviation.
        nominal_amplitude = 0.0
        amplitude_step = 1.0
        if not release.at_rest:
            nominal_amplitude = 1.0 / data.unknowns.scale[amplitude_index]
            amplitude_step = 0.1 * nominal_amplitude
        least_objective = np.inf
        for amplitude in nominal_amplitude + amplitude_step * np.array(RELEASE_AMPLITUDES):
            local_values = start.local[trial_index].copy()
            local_values[amplitude_index] = amplitude
            trial_locals = (*best_local[:trial_index], local_values, *best_local[trial_index + 1 :])
            trial_objective = objective(held_out, candidate, replace(start, local=trial_locals))
            if trial_objective < least_objective:
                least_objective = trial_objective
                best_local[trial_index] = local_values
    return replace(start, local=tuple(best_local))


# ---------------------------------------------------------------- expected variances


class _CovarianceFactors(NamedTuple):
    """Factors of the covariance of a trial's prediction, in units of its noise deviation.

    The covariance is `by_local.T @ by_local + by_shared @ by_shared.T`.

    Attributes
    ----------
    by_local : (L, N C) array
        The factor by the trial's own unknowns, given the shared unknowns.
    by_shared : (N C, Q + E) array
        The factor by the shared unknowns and effect parameters, with the trial's own unknowns
        refitted as these change.
    """

    by_local: FloatArray
    by_shared: FloatArray

    def local_variance(self) -> FloatArray:
        """Return the variance (N C,) caused by the trial's own unknowns."""
        return np.asarray(np.einsum("kn,kn->n", self.by_local, self.by_local))

    def shared_variance(self) -> FloatArray:
        """Return the variance (N C,) caused by the shared unknowns and effects."""
        return np.asarray(np.einsum("nk,nk->n", self.by_shared, self.by_shared))


class _TrialPredictions:
    """Predictions of trials by a fit, with the variance that their residuals should have.

    Parameters
    ----------
    problem : Problem
        The trials that are predicted, and the model.
    fit : CandidateFit
        The fit to the fitted trials, with the covariance of shared unknowns and effects.
    local_fit : CandidateFit, optional
        If the trials are held out, the fit of their own unknowns.
    precision : (channels,) array
        The noise precision of each channel in the fitted trials, relative to the recorded one.
    """

    def __init__(
        self,
        problem: Problem,
        fit: CandidateFit,
        *,
        local_fit: CandidateFit | None = None,
        precision: FloatArray,
    ) -> None:
        self.problem = problem
        self.fitted = fit
        self.local_fit = fit if local_fit is None else local_fit
        self.precision = precision
        covariance = fit.covariance
        self.covariance_root = np.linalg.cholesky(covariance + 1e-14 * np.eye(len(covariance)))
        self.is_held_out = local_fit is not None

    def fitted_trials(self, *, sensitivities: bool = False) -> list[FittedTrial]:
        """Return each trial with its prediction, residuals and their expected variance.

        The variance follows from the posterior covariance of the prediction. That is computed as
        two factors, by the trial's own unknowns and by the shared ones (`_CovarianceFactors`). If
        `sensitivities` is true, each trial also gets them as one matrix, `FittedTrial.sensitivity`:
        S with S S^T as the covariance in noise variances. It has a column for each unknown of the
        whole fit, so it is computed only where a test needs it.
        """
        fitted_trials = []
        for trial_index, data in enumerate(self.problem.trials):
            derivatives = trial_jacobian(
                self.problem, trial_index, self.local_fit, self.local_fit.candidate, self.precision
            )
            factors = self._covariance_factors(derivatives, data.unknowns.unknown_count)
            sensitivity = self._sensitivity(trial_index, factors) if sensitivities else None
            fitted_trials.append(self._fitted_trial(trial_index, data, factors, sensitivity))
        return fitted_trials

    def _sensitivity(self, trial_index: int, factors: _CovarianceFactors) -> FloatArray:
        """Return the factor S (N, C, P) of the covariance of a trial's prediction.

        The P columns are the Q + E shared unknowns and effect parameters, then the own unknowns of
        the first trial, of the second, and so on; those of all other trials are zero. With its
        first two axes joined to N C rows, S S^T is the covariance of the prediction in noise
        variances, and S S'^T its covariance with the prediction of another trial, whose factor is
        S'.
        """
        shared_count = factors.by_shared.shape[1]
        local_counts = [data.unknowns.unknown_count for data in self.problem.trials]
        begin = shared_count + sum(local_counts[:trial_index])
        end = begin + local_counts[trial_index]
        sample_count, channel_count = self.local_fit.residuals[trial_index].shape
        matrix = np.zeros((sample_count * channel_count, shared_count + sum(local_counts)))
        matrix[:, :shared_count] = factors.by_shared
        matrix[:, begin:end] = factors.by_local.T  # by_local has a row for each unknown
        return matrix.reshape(sample_count, channel_count, -1)

    def _covariance_factors(
        self, derivatives: TrialJacobian, local_count: int
    ) -> _CovarianceFactors:
        """Return the factors of the covariance of a trial's prediction.

        The rows of `derivatives.jacobian` are those of the prediction by the L = `local_count`
        unknowns of the trial itself, then by the shared unknowns and effects that act on it.
        """
        local_rows, shared_rows = np.split(derivatives.jacobian, [local_count])
        factor, local_per_shared = derivatives.eliminate_local()
        # A = U^T U is the precision of the local unknowns: J_l^T A^-1 J_l = (U^-T J_l)^T (U^-T J_l)
        by_local = solve_triangular(factor, local_rows, trans="T")
        # Schur complement: local unknowns follow the shared ones, J_s - J_l A^-1 B
        total_derivatives = (shared_rows - local_per_shared.T @ local_rows).T
        return _CovarianceFactors(
            by_local, total_derivatives @ self.covariance_root[derivatives.shared_indices]
        )

    def _leverage_and_variance(
        self, trial_index: int, data: TrialData, factors: _CovarianceFactors
    ) -> tuple[FloatArray, FloatArray]:
        """Return the leverage (N, C) of the readings, and the variance (N, C) of a new reading.

        Both are relative to the noise variance; `FittedTrial` defines the leverage.
        """
        shape = self.local_fit.residuals[trial_index].shape
        process = self.fitted.residual_process
        # a residual process stands for the uncertainty of shared unknowns, too
        shared_weight = 1.0 if process is None else 0.0
        local_variance = factors.local_variance()
        shared_variance = factors.shared_variance()
        if self.is_held_out:
            # own unknowns were fitted to the trial and reduce its residuals; the uncertainty of
            # shared unknowns, which were not, adds to them
            leverage = np.maximum(shared_weight * shared_variance - local_variance, -1.0 + 1e-9)
            variance = 1.0 + np.maximum(shared_variance - local_variance, -1.0 + 1e-9).reshape(
                shape
            )
        else:
            leverage = np.minimum(local_variance + shared_weight * shared_variance, 1.0)
            variance = 1.0 + np.maximum(leverage, 0.0).reshape(shape)
        if process is not None and data.trial.is_dynamic:
            # without a noise record the process is part of the noise already
            has_record = self.problem.record_freedom[data.channel_indices] > 0.0
            variance = variance + has_record * process.amplitude[data.channel_indices] ** 2
        return leverage.reshape(shape), variance

    def _fitted_trial(
        self,
        trial_index: int,
        data: TrialData,
        factors: _CovarianceFactors,
        sensitivity: FloatArray | None,
    ) -> FittedTrial:
        """Return a trial with its prediction, its residuals and their expected variance."""
        point = self.local_fit.point
        response = self.local_fit.responses[trial_index]
        prediction = self.problem.prediction(trial_index, point, response)
        residual = self.problem.standardised_residual(trial_index, point, response)
        leverage, variance = self._leverage_and_variance(trial_index, data, factors)
        noise_deviation = data.deviation / np.sqrt(self.precision[data.channel_indices])
        rates = None
        if data.trial.is_dynamic:
            rates = np.gradient(prediction, data.trial.time, axis=0)
        return FittedTrial(
            # as many samples after a gap as the whitening filter is long are not used either
            trial=replace(data.trial, used=data.weight > 0.0),
            prediction=prediction,
            residual=residual * data.deviation,
            noise_deviation=noise_deviation,
            # the variance is relative to that of the noise; the bound keeps the deviation positive
            predictive_deviation=noise_deviation * np.sqrt(np.maximum(variance, 1e-9)),
            leverage=leverage,
            rates=rates,
            sensitivity=sensitivity,
        )


# ---------------------------------------------------------------- draws of the effect

LEAST_MISFIT_RISE = 0.6
"""Rise of the misfit at the ends of a Gaussian 90 % interval below which the posterior is sampled
[nat]; a Gaussian posterior has NINETY_PERCENT_QUANTILE^2 / 2 = 1.35."""
SEED = 20211
"""Seed of the draws."""
ROUNDS = 5
"""Rounds of adaptive importance sampling."""
POINTS_PER_ROUND = 400
"""Points of each round at which the density is evaluated."""
RETURNED_DRAWS = 1000
"""Equally weighted draws that are returned."""


def with_draws(problem: Problem, fit: CandidateFit) -> CandidateFit:
    """Return a fit with posterior draws of its effects if their posterior is not nearly Gaussian.

    Returns
    -------
    CandidateFit
        The given fit if -ln posterior rises by more than `LEAST_MISFIT_RISE` at both ends of the
        Gaussian 90 % interval along every principal axis of the covariance; otherwise the fit with
        `draws`, which errors of a mesh move, too. The same fit always gives the same draws.
    """
    if not fit.candidate.parameter_count:
        return fit
    screen = Screen(problem, fit, record_noise=False)
    fitted_effect = fit.point.effect

    def energy(effect: FloatArray) -> float:
        """Return -ln posterior of effect parameters (E,) relative to the fit [nat]."""
        if np.any(fit.candidate.within_range(effect) != effect):
            return np.inf
        try:
            rise = screen.misfit_rise(effect)
        except DiscrepancyError:  # the effect is larger than the model allows
            return np.inf
        return rise + 0.5 * float(effect @ effect - fitted_effect @ fitted_effect)

    variances, directions = np.linalg.eigh(fit.effect_covariance)
    axes = directions * np.sqrt(np.maximum(variances, 0.0))
    energy_rises = []
    for axis in axes.T:
        energy_rises.append(energy(fitted_effect - NINETY_PERCENT_QUANTILE * axis))
        energy_rises.append(energy(fitted_effect + NINETY_PERCENT_QUANTILE * axis))
    if min(energy_rises) > LEAST_MISFIT_RISE:
        return fit
    draws = importance_draws(energy, fitted_effect, axes)
    if fit.mesh_covariance is not None:
        generator = np.random.default_rng(SEED)
        no_move = np.zeros(len(fitted_effect))
        draws += generator.multivariate_normal(no_move, fit.mesh_covariance, size=len(draws))
    return replace(fit, draws=draws)


def importance_draws(
    energy: Callable[[FloatArray], float], centre: FloatArray, axes: FloatArray
) -> FloatArray:
    """Return equally weighted draws of a density by adaptive multiple importance sampling.

    In each round points are drawn from a Cauchy density, whose heavy tails cover those of the
    target. Its location and scale are the weighted mean and covariance of all earlier points. Each
    point is weighted by the target over the mixture of the proposals of all rounds (Cornuet, Marin,
    Mira and Robert 2012, Scand. J. Statist. 39, 798-812). If the density is a bent ridge that is a
    hundred times longer than wide, the draws cover only a part of it.

    Parameters
    ----------
    energy : callable
        Returns -ln of the density at a point (E,), infinite where it vanishes.
    centre : (E,) array
        The location of the first proposal.
    axes : (E, E) array
        The principal axes of the first proposal as columns, each as long as the standard deviation
        along it.

    Returns
    -------
    (RETURNED_DRAWS, E) array
        The draws; the same density gives the same draws.
    """
    generator = np.random.default_rng(SEED)
    parameter_count = len(centre)
    mean = centre
    covariance = axes @ axes.T
    points = np.empty((0, parameter_count))
    energies = np.empty(0)
    proposals = []
    for _ in range(ROUNDS):
        # draw of a Cauchy density: Student's t of one degree of freedom
        proposal = multivariate_t(mean, covariance + 1e-12 * np.eye(parameter_count), df=1.0)
        proposals.append(proposal)
        new_points = proposal.rvs(POINTS_PER_ROUND, generator)
        new_points = new_points.reshape(POINTS_PER_ROUND, parameter_count)
        points = np.concatenate((points, new_points))
        energies = np.append(energies, [energy(point) for point in new_points])
        # weight all points by the mixture of all proposals
        log_mixture = logsumexp([proposal.logpdf(points) for proposal in proposals], axis=0)
        weights = softmax(-energies - log_mixture)
        # adapt the next proposal
        mean = weights @ points
        covariance = np.atleast_2d(np.cov(points.T, aweights=weights))
    # stratified resampling
    quantiles = stratified(generator, RETURNED_DRAWS)
    return np.asarray(points[np.searchsorted(np.cumsum(weights)[:-1], quantiles)])
