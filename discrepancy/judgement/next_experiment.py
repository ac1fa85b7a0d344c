"""The next experiment: the feasible trial that decides most between open hypotheses, for its cost.

Each open hypothesis predicts the new trial with the uncertainty of its parameters and of the
trial's nuisances. The information is the mutual information of hypothesis and data (Lindley 1956,
Ann. Math. Statist. 27, 986-1005), by simulation with a fixed seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import SENTENCES, DiscrepancyError
from discrepancy.fits.candidate import Point
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.normal_equations import check_finite
from discrepancy.fits.problem import Problem
from discrepancy.system.interface import NO_PATCH
from discrepancy.verdict import Experiment
from fe.runtime.patch import ModelPatch, ModulusTemperature, PointMass

SAMPLES = 300
"""Simulated outcomes of a trial for each hypothesis."""
SEED = 20210527
"""Seed of the outcomes."""
LEAST_INFORMATION = 0.03
"""Information below which an experiment is not proposed [nat]."""
PROPOSED = 4
"""Largest number of experiments that are proposed."""
LEAST_PROBABILITY = 1e-3
"""Least probability that a hypothesis counts with."""
FREE_PRECISION = 1e-4
"""Precision of a scaled unknown with a flat prior: a free zero is known to a hundred noise
deviations."""
LEAST_SINGULAR = 1e-6
"""Relative singular value below which a direction of the prediction counts for nothing."""


@dataclass(frozen=True)
class Proposal:
    """A feasible trial.

    Attributes
    ----------
    trial : Trial
        The trial; its values count for nothing.
    description, reason : str
        What to do, and why, for people.
    cost : float
        The cost relative to one more trial of a kind that was done already.
    added : ModelPatch
        What is added to the structure on purpose.
    """

    trial: Trial
    description: str
    reason: str
    cost: float
    added: ModelPatch = field(default_factory=ModelPatch)


def next_experiments(
    problem: Problem, open_fits: Sequence[tuple[CandidateFit, float]]
) -> tuple[Experiment, ...]:
    """Return the experiments that decide most between open hypotheses, the best for its cost first.

    Parameters
    ----------
    problem : Problem
        The campaign and model of the fits.
    open_fits : sequence of (CandidateFit, float)
        The hypotheses that are still open, with their probabilities.
    """
    weights = np.array([max(probability, LEAST_PROBABILITY) for _, probability in open_fits])
    weights /= weights.sum()
    fits = [fit for fit, _ in open_fits]
    swings = oscillates(problem, fits[0]) if fits else True
    experiments = []
    for proposal in proposals(problem, swings=swings):
        try:
            information = mutual_information(problem, proposal, fits, weights)
        except DiscrepancyError:  # not feasible with this model
            continue
        if information >= LEAST_INFORMATION:
            experiments.append(
                Experiment(proposal.description, information, proposal.cost, proposal.reason)
            )
    experiments.sort(key=lambda experiment: -experiment.information / experiment.cost)
    return tuple(experiments[:PROPOSED])


# ---------------------------------------------------------------- information


def mutual_information(
    problem: Problem, proposal: Proposal, fits: Sequence[CandidateFit], weights: FloatArray
) -> float:
    """Return the mutual information of the hypothesis and the data of a trial [nat].

    Parameters
    ----------
    problem : Problem
        The campaign and model of the fits.
    proposal : Proposal
        The trial.
    fits : sequence of CandidateFit
        The fit of each of the H hypotheses.
    weights : (H,) array
        The probabilities of the hypotheses, of sum one.
    """
    model = problem.model.patched(proposal.added) if len(proposal.added) else problem.model
    trial_problem = problem.with_trials((proposal.trial,), model)
    # without a noise record, what the most probable hypothesis leaves stands for the noise
    residual_scale = np.sqrt(problem.precisions(fits[0].sums))
    noise_scale = np.where(problem.freedom > 0.0, 1.0, residual_scale)
    predictions = [_predicted_trial(trial_problem, fit, noise_scale) for fit in fits]
    gaussians = _reduced(predictions, weights)
    return _information_of(gaussians, weights)


class _PredictedTrial(NamedTuple):
    """The Gaussian prediction of a trial's N C readings, in units of their noise.

    Attributes
    ----------
    mean : (N C,) array
        The mean.
    factor : (K, N C) array
        A factor S of the covariance S^T S without noise.
    """

    mean: FloatArray
    factor: FloatArray


def _predicted_trial(
    trial_problem: Problem, fit: CandidateFit, noise_scale: FloatArray
) -> _PredictedTrial:
    """Return the prediction of a new trial by a hypothesis, with the uncertainty of all unknowns.

    Parameters
    ----------
    trial_problem : Problem
        The problem of the new trial alone.
    fit : CandidateFit
        The fit of the hypothesis.
    noise_scale : (channels,) array
        The recorded over the actual noise deviation of each channel.
    """
    data = trial_problem.trials[0]
    local_count = data.unknowns.size
    point = Point(fit.point.shared, (np.zeros(local_count),), fit.point.effect)
    derivatives = trial_problem.linearise(0, point, fit.candidate)
    columns, index = trial_problem.prediction_derivatives(0, point, derivatives, fit.candidate)
    scale = np.broadcast_to(noise_scale[data.groups], data.weight.shape).ravel()
    rows = data.standardised(columns).reshape(len(columns), scale.size) * scale
    local, shared = np.split(rows, [local_count])
    prediction = trial_problem.prediction(0, point, derivatives.response)
    mean = data.standardised(prediction).ravel() * scale
    covariance = fit.covariance[np.ix_(index, index)]
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(len(index)))
    precision = np.maximum(data.unknowns.precision, FREE_PRECISION)
    local_factor = local / np.sqrt(precision)[:, np.newaxis]
    return _PredictedTrial(mean, np.concatenate((local_factor, root.T @ shared)))


class _Gaussian(NamedTuple):
    """A Gaussian density: mean (K,) and Cholesky factor (K, K) of its covariance."""

    mean: FloatArray
    root: FloatArray

    def log_density(self, outcomes: FloatArray) -> FloatArray:
        """Return the log density at outcomes (M, K), up to a constant, (M,)."""
        scaled = np.linalg.solve(self.root, (outcomes - self.mean).T)
        log_determinant = np.log(np.diag(self.root)).sum()
        return np.asarray(-0.5 * (scaled**2).sum(axis=0) - log_determinant)


def _reduced(predictions: Sequence[_PredictedTrial], weights: FloatArray) -> list[_Gaussian]:
    """Return the predictions with noise in the space in which they differ or are uncertain.

    Along all other directions the data are noise under every hypothesis, and say nothing.
    """
    means = [prediction.mean for prediction in predictions]
    factors = [prediction.factor for prediction in predictions]
    middle = np.average(means, axis=0, weights=weights)
    columns = np.concatenate((np.stack(means) - middle, *factors))
    _, values, basis = np.linalg.svd(check_finite(columns), full_matrices=False)
    basis = basis[values > LEAST_SINGULAR * max(values[0], 1e-300)]
    gaussians = []
    for mean, factor in zip(means, factors, strict=True):
        covariance = np.eye(len(basis)) + (basis @ factor.T) @ (basis @ factor.T).T
        gaussians.append(_Gaussian(basis @ (mean - middle), np.linalg.cholesky(covariance)))
    return gaussians


def _information_of(hypotheses: Sequence[_Gaussian], weights: FloatArray) -> float:
    """Return the mutual information of hypothesis and data [nat], by simulated outcomes.

    It is the entropy of the hypotheses less its mean after the data.
    """
    generator = np.random.default_rng(SEED)
    noise = generator.standard_normal((SAMPLES, len(hypotheses[0].mean)))
    entropy = float(-(weights * np.log(weights)).sum())
    entropy_after = 0.0
    for true, weight in zip(hypotheses, weights, strict=True):
        outcomes = true.mean + noise @ true.root.T
        # posterior log probabilities (H, M) of the hypotheses
        scores = np.stack([hypothesis.log_density(outcomes) for hypothesis in hypotheses])
        scores += np.log(weights)[:, np.newaxis]
        scores -= logsumexp(scores, axis=0)
        entropy_after -= weight * float((np.exp(scores) * scores).sum(axis=0).mean())
    return max(entropy - entropy_after, 0.0)


# ---------------------------------------------------------------- feasible trials


def oscillates(problem: Problem, fit: CandidateFit) -> bool:
    """Return whether a release oscillates in a fit.

    A channel reverses its motion more than once.
    """
    for data, response in zip(problem.trials, fit.responses, strict=True):
        if data.trial.kind is not TrialKind.RINGDOWN:
            continue
        steps = np.diff(response, axis=0)
        is_large = np.abs(steps) > 1e-9 * np.abs(response).max(initial=0.0)
        for column in range(steps.shape[1]):
            directions = np.sign(steps[is_large[:, column], column])
            if np.count_nonzero(np.diff(directions)) > 1:
                return True
    return False


def proposals(problem: Problem, *, swings: bool = True) -> Iterator[Proposal]:
    """Yield feasible trials: variations of those that were done, within twice their range.

    Parameters
    ----------
    problem : Problem
        The campaign with what was done, and the model.
    swings : bool
        Whether a release oscillates: a longer record of one that does not shows rest only.
    """
    for row in SENTENCES.tables["proposal"]:
        done = [trial for trial in problem.campaign.trials if trial.kind.value == row["kind"]]
        if not done or (row["change"] == "length" and not swings):
            continue
        choose = min if row.get("of") == "smallest" else max
        model_trial = choose(done, key=lambda trial: trial.level)
        changed = _changed_trial(problem, model_trial, row["change"], row["by"])
        if changed is None:
            continue
        level = model_trial.level
        description = row["description"].format(
            top=level, most=abs(row["by"]) * level, signed=row["by"] * level, value=changed.value
        )
        trial = replace(changed.trial, name=row["name"])
        yield Proposal(trial, description, row["reason"], row["cost"], changed.added)


class _ChangedTrial(NamedTuple):
    """A trial with one thing changed.

    Attributes
    ----------
    trial : Trial
        The trial.
    value : float
        The new value of what is neither load nor release, as its description prints it.
    added : ModelPatch
        What is added to the structure.
    """

    trial: Trial
    value: float = 0.0
    added: ModelPatch = NO_PATCH


def _changed_trial(
    problem: Problem, trial: Trial, change: str, amount: float
) -> _ChangedTrial | None:
    """Return a trial with one thing changed; None if that is not possible, or shows nothing.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    trial : Trial
        The trial to vary.
    change : str
        What is changed: `change` of a [[proposal]] in `sentences.toml`.
    amount : float
        By how much: a factor, or a difference of temperature [K].
    """
    model = problem.model
    stations = model.stations
    if change == "release" and trial.release is not None:
        release = replace(trial.release, displacement=amount * trial.release.displacement)
        return _ChangedTrial(replace(trial, release=release))
    if change in ("force", "load_factor"):
        return _ChangedTrial(replace(trial, **{change: amount * getattr(trial, change)}))
    if change == "length":
        count = int(amount) * len(trial.time)
        time = trial.time[0] + trial.interval * np.arange(count)
        longer = trial.rows(np.arange(count) % len(trial.time), time=time)
        return _ChangedTrial(longer, count * trial.interval)
    if change == "place" and stations is not None:
        root, tip = stations
        station = round(root + amount * (tip - root), 3)
        return _ChangedTrial(replace(trial, load_place=(station, 0.35)), station)
    if change == "mass" and model.supports(PointMass):
        mass = amount * problem.setting.scales.modal_mass
        at_tip = PointMass(mass, stations[1] if stations is not None else 0.0)
        return _ChangedTrial(trial, 1e3 * mass, ModelPatch((at_tip,)))
    has_reference = problem.campaign.reference_temperature is not None
    if change == "temperature" and has_reference and model.supports(ModulusTemperature):
        return _ChangedTrial(replace(trial, temperature=trial.temperature + amount))
    return None
