"""What a new trial is expected to tell about which of several hypotheses is right.

Each hypothesis predicts the new trial with the uncertainty of its parameters and of the trial's
nuisances. The information is the mutual information of hypothesis and data (Lindley 1956, Ann.
Math. Statist. 27, 986-1005), by simulation with a fixed seed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from discrepancy.campaign.records import Channel, FloatArray, IntArray, Trial
from discrepancy.fits.candidate import Point
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.normal_equations import check_finite
from discrepancy.fits.problem import Problem
from discrepancy.system.interface import Model
from fe.runtime.patch import ModelPatch

OUTCOME_SAMPLES = 300
"""Simulated outcomes of a trial for each hypothesis."""
SEED = 20210527
"""Seed of the outcomes."""
FREE_PRECISION = 1e-4
"""Precision of a scaled unknown with a flat prior: a free zero is known to a hundred noise
deviations."""
LEAST_VARIANCE = 1e-12
"""Variance that is added to that of each scaled unknown, so that a covariance that is singular to
rounding has a Cholesky factor."""
LEAST_SINGULAR_VALUE = 1e-6
"""Singular value, relative to the largest, below which a direction in the space of readings is left
out: all hypotheses predict the same there."""


class AddedSensor(NamedTuple):
    """A sensor that a campaign does not have yet.

    Attributes
    ----------
    channel : Channel
        The channel that it gives. An error of its gain is independent of all others.
    noise_of : str
        The channel of the campaign whose noise it has.
    """

    channel: Channel
    noise_of: str


@dataclass(frozen=True)
class Proposal:
    """A feasible trial.

    Attributes
    ----------
    trial : Trial
        The trial; its readings are not used, as it has not been made.
    description, reason : str
        The sentences for the user: what to do, and why.
    cost : float
        The cost relative to one more trial of a kind that was done already.
    added_patch : ModelPatch
        The change of the structure for this trial, such as a mass at the tip.
    added_sensor : AddedSensor, optional
        A sensor that is mounted for this trial.
    """

    trial: Trial
    description: str
    reason: str
    cost: float
    added_patch: ModelPatch = field(default_factory=ModelPatch)
    added_sensor: AddedSensor | None = None


class Worth(NamedTuple):
    """What a new trial is expected to tell about which hypothesis is right.

    Attributes
    ----------
    information : float
        The mutual information of the hypothesis and the readings [nat].
    certainty : float
        The probability that the hypothesis that is most probable after the trial is right.
    """

    information: float
    certainty: float


class Alternatives(NamedTuple):
    """Hypotheses between which a new trial is to decide.

    Attributes
    ----------
    fits : sequence of CandidateFit
        The fit of each of H hypotheses, the most probable first.
    weights : (H,) array
        Their probabilities, of sum one.
    classes : (H,) array of int
        The class of each, in ascending order. The question is to which class the right hypothesis
        belongs; members of one class, such as one effect at several places, need not be told apart.
    """

    fits: Sequence[CandidateFit]
    weights: FloatArray
    classes: IntArray

    @classmethod
    def single(cls, fits: Sequence[CandidateFit], weights: FloatArray) -> "Alternatives":
        """Return hypotheses each of which is a class of its own."""
        return cls(fits, weights, np.arange(len(fits)))

    def class_log_sums(self, log_posterior: FloatArray) -> FloatArray:
        """Return log posteriors (H, M) of the hypotheses summed by class, (classes, M)."""
        _, first_of_class = np.unique(self.classes, return_index=True)
        return np.logaddexp.reduceat(log_posterior, first_of_class, axis=0)


def worth_of_trial(problem: Problem, proposal: Proposal, alternatives: Alternatives) -> Worth:
    """Return what a proposed trial is expected to tell about which hypothesis is right."""
    model = (
        problem.model.with_patch(proposal.added_patch)
        if len(proposal.added_patch)
        else problem.model
    )
    sensors = () if proposal.added_sensor is None else (proposal.added_sensor,)
    predictions = _predictions(problem, proposal.trial, sensors, alternatives.fits, model)
    return _simulate_worth(predictions, alternatives)


def worths_of_sensors(
    problem: Problem,
    trial: Trial,
    sensors: Sequence[AddedSensor],
    alternatives: Alternatives,
) -> list[Worth]:
    """Return what each of some sensors is expected to tell, if it is added to a trial.

    The trial is predicted once for all sensors.
    """
    predictions = _predictions(problem, trial, sensors, alternatives.fits, problem.model)
    present_count = len(trial.channels)
    worths = []
    for number in range(len(sensors)):
        columns = [*range(present_count), present_count + number]
        with_sensor = [prediction.of_channels(columns) for prediction in predictions]
        worths.append(_simulate_worth(with_sensor, alternatives))
    return worths


def _predictions(
    problem: Problem,
    trial: Trial,
    sensors: Sequence[AddedSensor],
    fits: Sequence[CandidateFit],
    model: Model,
) -> "list[_PredictedTrial]":
    """Return the prediction of a new trial, with additional sensors, by each hypothesis.

    An additional sensor has the noise of a present channel, `AddedSensor.noise_of`.
    """
    noise_ratio_of_channels = _recorded_over_actual_noise(problem, most_probable_fit=fits[0])
    # the channels of the problem come first, then the additional sensors
    noise_channel_indices = [problem.channel_names.index(sensor.noise_of) for sensor in sensors]
    noise_ratios = np.append(
        noise_ratio_of_channels, noise_ratio_of_channels[noise_channel_indices]
    )
    problem_with_sensors = problem
    for sensor in sensors:
        problem_with_sensors = problem_with_sensors.with_channel(sensor.channel, sensor.noise_of)
    trial_problem = problem_with_sensors.with_trials((_with_sensors(trial, sensors),), model)
    return [_predicted_trial(trial_problem, fit, noise_ratios) for fit in fits]


def _recorded_over_actual_noise(problem: Problem, most_probable_fit: CandidateFit) -> FloatArray:
    """Return the assumed noise deviation of each channel over its actual one, (channels,).

    It is one for a channel with a noise record. Without a record, the deviation by which residuals
    are divided is a mere assumption, and the rms residual of the most probable hypothesis is taken
    as the actual one.
    """
    recorded_over_rms_residual = np.sqrt(
        problem.noise_precisions(most_probable_fit.squares_by_channel)
    )
    return np.where(problem.record_freedom > 0.0, 1.0, recorded_over_rms_residual)


class _PredictedTrial(NamedTuple):
    """The Gaussian prediction of N readings of C channels, in units of their noise deviation.

    Attributes
    ----------
    mean : (N, C) array
        The mean of the prediction.
    factor : (K, N, C) array
        A factor S of the prediction's covariance S^T S, which K unknowns cause. The covariance of
        the noise comes on top.
    """

    mean: FloatArray
    factor: FloatArray

    def of_channels(self, columns: Sequence[int]) -> "_PredictedTrial":
        """Return the prediction of some channels alone, without unknowns that move none of them."""
        factor = self.factor[:, :, columns]
        is_moving = factor.any(axis=(1, 2))
        return _PredictedTrial(self.mean[:, columns], factor[is_moving])


def _predicted_trial(
    trial_problem: Problem, fit: CandidateFit, recorded_over_actual_noise: FloatArray
) -> _PredictedTrial:
    """Return what a hypothesis predicts for a new trial, in units of the actual noise deviation.

    The prediction is Gaussian. Its covariance has three sources:

    - the prior of the trial's local unknowns, such as zeros of channels;
    - the posterior of the unknowns that the trial shares with the fitted trials;
    - the prior of gain errors of channels that no fitted trial has.

    Parameters
    ----------
    trial_problem : Problem
        The problem of the new trial alone.
    recorded_over_actual_noise : (channels,) array
        The recorded noise deviation of each channel, divided by the actual one.
    """
    data = trial_problem.trials[0]  # the new trial, the only one of the problem
    local_count = data.unknowns.unknown_count
    # the local unknowns are at their prior means: no reading has determined them
    point = Point(fit.point.shared, (np.zeros(local_count),), fit.point.effect)
    derivatives = trial_problem.linearise(0, point, fit.candidate)
    derivatives_by_unknowns, shared_indices = trial_problem.prediction_derivatives(
        0, point, derivatives, fit.candidate
    )
    # `standardise` divides readings by the recorded noise deviation; times this factor they are
    # divided by the actual one
    reading_scale = recorded_over_actual_noise[data.channel_indices]  # (C,)
    # (unknowns, N, C), the local unknowns first
    jacobian = data.standardise(derivatives_by_unknowns) * reading_scale
    local_jacobian, shared_jacobian = np.split(jacobian, [local_count])
    prediction = trial_problem.prediction(0, point, derivatives.response)
    mean = data.standardise(prediction) * reading_scale
    # Factors S of the covariance S^T S. Shared unknowns have the posterior covariance P = R R^T.
    # With the derivatives J of the readings by them, J^T P J = (R^T J)^T (R^T J). Local unknowns
    # are independent with the variance 1 / precision.
    covariance = fit.covariance[np.ix_(shared_indices, shared_indices)]
    covariance_root = np.linalg.cholesky(covariance + LEAST_VARIANCE * np.eye(len(shared_indices)))
    prior_precision = np.maximum(data.unknowns.precision, FREE_PRECISION)
    local_factor = local_jacobian / np.sqrt(prior_precision)[:, np.newaxis, np.newaxis]
    shared_factor = np.tensordot(covariance_root.T, shared_jacobian, 1)
    gain_factor = _factor_of_new_gains(trial_problem, mean)
    return _PredictedTrial(mean, np.concatenate((local_factor, shared_factor, gain_factor)))


def _factor_of_new_gains(trial_problem: Problem, mean: FloatArray) -> FloatArray:
    """Return the factor (K, N, C) of the gain errors of channels that no fitted trial has.

    `mean` (N, C) is the prediction. The gains of other channels are shared unknowns.
    """
    known_gains = (*trial_problem.shared.gain_channels, *trial_problem.shared.fixed_gain)
    factors = []
    for column, name in enumerate(trial_problem.trials[0].trial.channels):
        deviation = trial_problem.campaign.channels[name].gain_deviation
        if name not in known_gains and 0.0 < deviation < np.inf:
            factor = np.zeros(mean.shape)
            factor[:, column] = deviation * mean[:, column]
            factors.append(factor)
    return np.array(factors).reshape(-1, *mean.shape)


class _Gaussian(NamedTuple):
    """A Gaussian density: mean (K,) and Cholesky factor (K, K) of its covariance."""

    mean: FloatArray
    root: FloatArray

    def log_density(self, outcomes: FloatArray) -> FloatArray:
        """Return the log density (M,) at M outcomes (M, K), up to a constant."""
        standardised = np.linalg.solve(self.root, (outcomes - self.mean).T)
        log_determinant = np.log(np.diag(self.root)).sum()
        return np.asarray(-0.5 * (standardised**2).sum(axis=0) - log_determinant)


def _reduce_dimensions(
    predictions: Sequence[_PredictedTrial], weights: FloatArray
) -> list[_Gaussian]:
    """Return the predictions of all hypotheses, noise included, in the subspace where they differ.

    The subspace is spanned by the differences of the means and by the rows of the factors of the
    covariances. Along all other directions of the space of readings, every hypothesis predicts the
    same noise, so that these directions do not separate the hypotheses. The means that are returned
    are relative to the mean over all hypotheses.

    Parameters
    ----------
    predictions : sequence of _PredictedTrial
        The predictions of the H hypotheses.
    weights : (H,) array
        The probabilities of the hypotheses, of sum one.
    """
    means = [prediction.mean.ravel() for prediction in predictions]
    factors = [
        prediction.factor.reshape(len(prediction.factor), prediction.mean.size)
        for prediction in predictions
    ]
    mean_of_hypotheses = np.average(means, axis=0, weights=weights)
    directions = np.concatenate((np.stack(means) - mean_of_hypotheses, *factors))
    _, singular_values, basis = np.linalg.svd(check_finite(directions), full_matrices=False)
    # no direction is left if all hypotheses predict the same, with singular values of zero
    largest_singular_value = singular_values[0]
    differ_along = singular_values > LEAST_SINGULAR_VALUE * largest_singular_value
    basis = basis[differ_along & (singular_values > 0.0)]
    # the rows of the basis are orthonormal, so the noise keeps its unit covariance
    gaussians = []
    for mean, factor in zip(means, factors, strict=True):
        covariance = np.eye(len(basis)) + (basis @ factor.T) @ (basis @ factor.T).T
        gaussians.append(
            _Gaussian(basis @ (mean - mean_of_hypotheses), np.linalg.cholesky(covariance))
        )
    return gaussians


def _simulate_worth(predictions: Sequence[_PredictedTrial], alternatives: Alternatives) -> Worth:
    """Return what a trial is expected to tell, by simulated outcomes.

    The information is the entropy of the probabilities of the classes, minus the mean entropy of
    their posterior probabilities over the outcomes. The certainty is the mean of the largest of
    these.

    Parameters
    ----------
    predictions : sequence of _PredictedTrial
        The predictions of the trial by the H hypotheses.
    """
    weights = alternatives.weights
    hypotheses = _reduce_dimensions(predictions, weights)
    generator = np.random.default_rng(SEED)
    standard_normal = generator.standard_normal((OUTCOME_SAMPLES, len(hypotheses[0].mean)))
    log_prior = alternatives.class_log_sums(np.log(weights)[:, np.newaxis])
    entropy = -float((np.exp(log_prior) * log_prior).sum())
    entropy_after = 0.0
    certainty = 0.0
    for true_hypothesis, weight in zip(hypotheses, weights.tolist(), strict=True):
        outcomes = true_hypothesis.mean + standard_normal @ true_hypothesis.root.T
        # log posterior of the hypotheses, then of the classes, at the outcomes by Bayes' theorem
        log_posterior = np.stack([hypothesis.log_density(outcomes) for hypothesis in hypotheses])
        log_posterior += np.log(weights)[:, np.newaxis]
        log_posterior -= logsumexp(log_posterior, axis=0)
        log_of_classes = alternatives.class_log_sums(log_posterior)
        of_classes = np.exp(log_of_classes)
        entropy_after -= weight * float((of_classes * log_of_classes).sum(axis=0).mean())
        certainty += weight * float(of_classes.max(axis=0).mean())
    # simulated outcomes may give a slightly negative difference
    return Worth(information=max(entropy - entropy_after, 0.0), certainty=certainty)


def _with_sensors(trial: Trial, sensors: Sequence[AddedSensor]) -> Trial:
    """Return a trial with more sensors, whose readings are used where those of any channel are."""
    sensor_count = len(sensors)
    sample_count = len(trial.values)
    is_used = trial.used.any(axis=1, keepdims=True)
    return replace(
        trial,
        channels=(*trial.channels, *(sensor.channel.name for sensor in sensors)),
        values=np.hstack((trial.values, np.zeros((sample_count, sensor_count)))),
        used=np.hstack((trial.used, np.tile(is_used, sensor_count))),
    )
