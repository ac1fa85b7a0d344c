"""The next experiment: the feasible test that tells most about what is still open, for its cost.

Each open hypothesis predicts the new trial with the uncertainty of its parameters and of the trial's
nuisances; the information is the mutual information of hypothesis and data, by simulation with a fixed seed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from discrepancy.campaign.records import Campaign, Trial, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.cholesky import finite
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.linearisation import Point
from discrepancy.fits.problem import Problem
from discrepancy.verdict import Experiment
from fe.runtime.patch import ModelPatch, ModulusTemperature, PointMass

FloatArray = NDArray[np.float64]

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
    problem: Problem, open_fits: Sequence[tuple[CandidateFit, float]], count: int = PROPOSED
) -> tuple[Experiment, ...]:
    """Return the experiments that decide most among open hypotheses.

    Parameters
    ----------
    problem : Problem
        Campaign and model of the fits.
    open_fits : sequence of (CandidateFit, float)
        Hypotheses that are still open, with their probabilities.
    count : int
        Largest number of proposals.

    Returns
    -------
    tuple of Experiment
        Most information for the cost first.
    """
    weights = np.array([max(p, 1e-3) for _, p in open_fits])
    weights /= weights.sum()
    found = []
    swings = oscillates(problem, open_fits[0][0]) if open_fits else True
    for proposal in proposals(problem.campaign, problem, swings=swings):
        try:
            information = mutual_information(problem, proposal, [item for item, _ in open_fits], weights)
        except DiscrepancyError:  # not feasible with this model
            continue
        if information >= LEAST_INFORMATION:
            found.append(Experiment(proposal.description, information, proposal.cost, proposal.reason))
    return tuple(sorted(found, key=lambda item: -item.information / item.cost)[:count])


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
    there = Problem(problem.campaign, model, problem.setting, (proposal.trial,), like=problem)
    data = there.trials[0]
    # without a record, what the most probable hypothesis left stands for the noise
    rest = np.sqrt(problem.precisions(fits[0].sums))
    unit = np.where(problem.freedom > 0.0, 1.0, rest)[data.groups]
    noise_units = np.broadcast_to(unit, data.weight.shape).ravel()
    means, spreads = [], []
    for item in fits:
        point = Point(item.point.shared, (np.zeros(data.unknowns.size),), item.point.effect)
        parts = there.linearise(0, point, item.candidate)
        derivatives = there.derivatives(0, point, parts, item.candidate)
        index = derivatives.index
        local, shared = (part * noise_units for part in derivatives.dense())
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


def proposals(campaign: Campaign, problem: Problem, *, swings: bool = True) -> Iterator[Proposal]:
    """Yield feasible trials: variations of what was done, within its ranges doubled.

    Parameters
    ----------
    campaign : Campaign
        What was done.
    problem : Problem
        For the model's scales.
    swings : bool
        Whether a release oscillates: a longer record of one that does not shows rest.
    """
    ringdowns = [trial for trial in campaign.trials if trial.kind is TrialKind.RINGDOWN]
    statics = [trial for trial in campaign.trials if trial.kind is TrialKind.STATIC]
    flights = [trial for trial in campaign.trials if trial.kind is TrialKind.FLIGHT]
    scales = problem.setting.scales
    if ringdowns:
        yield from _ringdowns(campaign, ringdowns, problem, scales.modal_mass, swings=swings)
    if statics:
        yield from _statics(statics, problem)
    if flights:
        largest = max(flights, key=lambda trial: float(np.abs(trial.load_factor).max()))
        for factor, words in ((0.5, "half"), (-0.5, "minus half"), (1.5, "one and a half times")):
            yield Proposal(
                replace(largest, name="next flight", load_factor=factor * largest.load_factor),
                f"Fly turns at {words} the largest load factor "
                f"({factor * float(np.abs(largest.load_factor).max()):.2g}).",
                "Lift, inertia and stiffness depend differently on the load factor.",
                5.0,
            )


def _ringdowns(
    campaign: Campaign, ringdowns: list[Trial], problem: Problem, modal_mass: float, *, swings: bool
) -> Iterator[Proposal]:
    def release(trial: Trial) -> float:
        return abs(trial.release.displacement) if trial.release is not None else 0.0

    largest = max(ringdowns, key=release)
    smallest = min(ringdowns, key=release)
    if largest.release is None or smallest.release is None:
        return

    def at(trial: Trial, factor: float, name: str) -> Trial:
        assert trial.release is not None  # checked above
        changed = replace(trial.release, displacement=factor * trial.release.displacement)
        return replace(trial, name=name, release=changed)

    for trial, factor, words in (
        (smallest, 0.5, "at half the smallest amplitude so far"),
        (largest, 2.0, "at twice the largest amplitude so far"),
        (largest, -1.0, "to the other side, at the largest amplitude so far"),
    ):
        yield Proposal(
            at(trial, factor, f"release {words}"),
            f"Release {words} ({abs(factor) * release(trial):.3g} at its point, SI).",
            "Linear effects scale with the amplitude, friction, slip and stiffening do not.",
            1.0,
        )
    if swings:
        yield _longer(largest)
    if problem.model.supports(PointMass):
        stations = problem.model.stations()
        mass = 0.1 * modal_mass
        yield Proposal(
            replace(largest, name="added mass"),
            f"Repeat the release with a known mass of {1e3 * mass:.3g} g at the tip.",
            "Mass, stiffness and the clock move the frequencies differently when a known mass is added.",
            1.5,
            ModelPatch((PointMass(mass, stations[1] if stations is not None else 0.0),)),
        )
    if problem.model.supports(ModulusTemperature) and campaign.reference_temperature is not None:
        yield Proposal(
            replace(largest, name="warmer release", temperature=largest.temperature + 15.0),
            "Repeat the release 15 K warmer.",
            "Only effects of temperature follow it.",
            3.0,
        )


def _longer(largest: Trial) -> Proposal:
    """Return the same release, recorded three times as long."""
    count = len(largest.time)
    longer = replace(
        largest,
        name="longer record",
        **{  # type: ignore[arg-type]
            name: np.concatenate([getattr(largest, name)] * 3)
            for name in (
                "values",
                "used",
                "force",
                "load_factor",
                "temperature",
                "health",
                "health_deviation",
            )
        },
        time=largest.time[0] + largest.interval * np.arange(3 * count),
    )
    return Proposal(
        longer,
        f"Record the same release three times as long ({3 * count * largest.interval:.3g} s).",
        "What decays with the motion and what goes on with time part company.",
        1.2,
    )


def _statics(statics: list[Trial], problem: Problem) -> Iterator[Proposal]:
    largest = max(statics, key=lambda trial: float(np.abs(trial.force).max()))
    top = float(np.abs(largest.force).max())
    yield Proposal(
        replace(largest, name="other sign", force=-largest.force),
        f"Load to the other side, to {top:.3g} N.",
        "Gaps, cracks and one-sided contacts show their sign.",
        1.0,
    )
    yield Proposal(
        replace(largest, name="larger load", force=2.0 * largest.force),
        f"Load to {2.0 * top:.3g} N.",
        "Offsets stay, gains grow with the load, stiffening faster.",
        1.0,
    )
    stations = problem.model.stations()
    if stations is not None:
        for share in (0.5, 0.75):
            place = (round(stations[0] + share * (stations[1] - stations[0]), 3), 0.35)
            yield Proposal(
                replace(largest, name="other place", load_place=place),
                f"Load at y = {place[0]:.3g} m instead, to {top:.3g} N.",
                "The root turns with the moment, the load cell with the force, the wing with both.",
                1.0,
            )
    if problem.model.supports(ModulusTemperature) and problem.campaign.reference_temperature is not None:
        yield Proposal(
            replace(largest, name="warmer", temperature=largest.temperature + 15.0),
            "Repeat the static loading 15 K warmer.",
            "Only effects of temperature follow it.",
            3.0,
        )
