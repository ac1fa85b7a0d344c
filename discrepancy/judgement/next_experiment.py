"""The next experiment: the feasible test that tells most about what is still open, for its cost.

Each open hypothesis predicts the new trial with the uncertainty of its parameters and of the trial's
nuisances; the information is the mutual information of hypothesis and data, by simulation with a fixed seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logsumexp

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import SENTENCES, DiscrepancyError
from discrepancy.fits.candidate import Point
from discrepancy.fits.fitting import CandidateFit, finite
from discrepancy.fits.problem import Problem
from discrepancy.verdict import Experiment
from fe.runtime.patch import ModelPatch, ModulusTemperature, PointMass

SAMPLES = 300
"""Simulated outcomes of a trial for each hypothesis."""
SEED = 20210527
LEAST_INFORMATION = 0.03
"""Experiments that tell less are not proposed [nat]."""
PROPOSED = 4


@dataclass(frozen=True)
class Proposal:
    """A feasible trial.

    Attributes
    ----------
    trial : Trial
        What would be measured; its values count for nothing.
    description, reason : str
        For people.
    cost : float
        Relative to one more trial of a kind that was done already.
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
    """Return the experiments that decide most among open hypotheses.

    Parameters
    ----------
    problem : Problem
        Campaign and model of the fits.
    open_fits : sequence of (CandidateFit, float)
        Hypotheses that are still open, with their probabilities.

    Returns
    -------
    tuple of Experiment
        Most information for the cost first.
    """
    weights = np.array([max(p, 1e-3) for _, p in open_fits])
    weights /= weights.sum()
    found = []
    swings = oscillates(problem, open_fits[0][0]) if open_fits else True
    for proposal in proposals(problem, swings=swings):
        try:
            information = mutual_information(problem, proposal, [item for item, _ in open_fits], weights)
        except DiscrepancyError:  # not feasible with this model
            continue
        if information >= LEAST_INFORMATION:
            found.append(Experiment(proposal.description, information, proposal.cost, proposal.reason))
    return tuple(sorted(found, key=lambda item: -item.information / item.cost)[:PROPOSED])


def mutual_information(
    problem: Problem, proposal: Proposal, fits: Sequence[CandidateFit], weights: FloatArray
) -> float:
    """Return the mutual information [nat] of hypothesis and the data of a trial.

    Parameters
    ----------
    problem : Problem
        Of the fits.
    proposal : Proposal
        The trial.
    fits : sequence of CandidateFit
        One for each hypothesis.
    weights : (H,) ndarray
        Their probabilities, of sum one.
    """
    model = problem.model.patched(proposal.added) if len(proposal.added) else problem.model
    there = problem.with_trials((proposal.trial,), model)
    data = there.trials[0]
    # without a record, what the most probable hypothesis left stands for the noise
    rest = np.sqrt(problem.precisions(fits[0].sums))
    unit = np.where(problem.freedom > 0.0, 1.0, rest)[data.groups]
    noise_units = np.broadcast_to(unit, data.weight.shape).ravel()
    means, spreads = [], []
    for item in fits:
        point = Point(item.point.shared, (np.zeros(data.unknowns.size),), item.point.effect)
        parts = there.linearise(0, point, item.candidate)
        columns, index = there.columns(0, point, parts, item.candidate)
        rows = data.standardised(columns).reshape(len(columns), noise_units.size) * noise_units
        local, shared = np.split(rows, [data.unknowns.size])
        means.append(data.standardised(there.prediction(0, point, parts.response)).ravel() * noise_units)
        root = np.linalg.cholesky(item.covariance[np.ix_(index, index)] + 1e-12 * np.eye(len(index)))
        precision = np.maximum(data.unknowns.precision, 1e-4)  # a free zero is known to a hundred s0
        spreads.append(np.concatenate((local / np.sqrt(precision)[:, np.newaxis], root.T @ shared)))
    middle = np.average(means, axis=0, weights=weights)
    columns = np.concatenate((np.stack(means) - middle, *spreads))
    _, values, basis = np.linalg.svd(finite(columns), full_matrices=False)
    basis = basis[values > 1e-6 * max(values[0], 1e-300)]
    means_in = [basis @ (mean - middle) for mean in means]
    roots = [
        np.linalg.cholesky(np.eye(len(basis)) + (basis @ spread.T) @ (basis @ spread.T).T)
        for spread in spreads
    ]
    generator = np.random.default_rng(SEED)
    noise = generator.standard_normal((SAMPLES, len(basis)))
    entropy = float(-(weights * np.log(weights)).sum())
    left = 0.0
    for true, weight in enumerate(weights):
        outcomes = means_in[true] + noise @ roots[true].T
        scores = np.stack([_log_density(outcomes, m, r) for m, r in zip(means_in, roots, strict=True)])
        scores += np.log(weights)[:, np.newaxis]
        scores -= logsumexp(scores, axis=0)
        left -= weight * float((np.exp(scores) * scores).sum(axis=0).mean())
    return max(entropy - left, 0.0)


def _log_density(outcomes: FloatArray, mean: FloatArray, root: FloatArray) -> FloatArray:
    scaled = np.linalg.solve(root, (outcomes - mean).T)
    return np.asarray(-0.5 * (scaled**2).sum(axis=0) - np.log(np.diag(root)).sum())


def oscillates(problem: Problem, found: CandidateFit) -> bool:
    """Whether a release swings in a fit: its readings turn more than once in some channel."""
    for data, response in zip(problem.trials, found.responses, strict=True):
        if data.trial.kind is not TrialKind.RINGDOWN:
            continue
        steps = np.diff(response, axis=0)
        large = np.abs(steps) > 1e-9 * np.abs(response).max(initial=0.0)
        for column, moving in zip(steps.T, large.T, strict=True):
            if np.count_nonzero(np.diff(np.sign(column[moving]))) > 1:
                return True
    return False


def proposals(problem: Problem, *, swings: bool = True) -> Iterator[Proposal]:
    """Yield feasible trials: variations of what was done, within its ranges doubled.

    Parameters
    ----------
    problem : Problem
        Campaign with what was done, and model.
    swings : bool
        Whether a release oscillates: a longer record of one that does not shows rest.
    """
    for row in SENTENCES.tables["proposal"]:
        done = [trial for trial in problem.campaign.trials if trial.kind.value == row["kind"]]
        if not done or (row["change"] == "length" and not swings):
            continue
        largest = (min if row.get("of") == "smallest" else max)(done, key=lambda trial: trial.level)
        found = _changed(problem, largest, row["change"], row["by"])
        if found is not None:
            (trial, value, added), top = found, largest.level
            told = {"top": top, "most": abs(row["by"]) * top, "signed": row["by"] * top, "value": value}
            description = row["description"].format(**told)
            yield Proposal(replace(trial, name=row["name"]), description, row["reason"], row["cost"], added)


def _changed(problem: Problem, trial: Trial, what: str, by: float) -> tuple[Trial, float, ModelPatch] | None:
    """Return a trial with something changed by so much; None where that cannot be, or shows nothing.

    Beside it the new value of what is neither load nor release, and what is added to the structure.
    """
    model, stations, nothing = problem.model, problem.model.stations, ModelPatch()
    if what == "release" and trial.release is not None:
        release = replace(trial.release, displacement=by * trial.release.displacement)
        return replace(trial, release=release), 0.0, nothing
    if what in ("force", "load_factor"):
        return replace(trial, **{what: by * getattr(trial, what)}), 0.0, nothing
    if what == "length":
        count = int(by) * len(trial.time)
        time = trial.time[0] + trial.interval * np.arange(count)
        longer = trial.rows(np.arange(count) % len(trial.time), time=time)
        return longer, count * trial.interval, nothing
    if what == "place" and stations is not None:
        place = (round(stations[0] + by * (stations[1] - stations[0]), 3), 0.35)
        return replace(trial, load_place=place), place[0], nothing
    if what == "mass" and model.supports(PointMass):
        mass = by * problem.setting.scales.modal_mass
        at_tip = PointMass(mass, stations[1] if stations is not None else 0.0)
        return trial, 1e3 * mass, ModelPatch((at_tip,))
    known = problem.campaign.reference_temperature is not None
    if what == "temperature" and known and model.supports(ModulusTemperature):
        return replace(trial, temperature=trial.temperature + by), 0.0, nothing
    return None
