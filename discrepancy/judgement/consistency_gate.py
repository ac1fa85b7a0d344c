"""The gate of consistency: what a named effect leaves must not follow loads, runs, or its own channel.

An effect that is not in the catalogue can be imitated by one that is, closely enough for the sum of squares
of many thousand samples. The difference then lies along few directions: the response of one kind of test has
another size, slope over the span or zero than the name allows. A score test (Rao 1948, Proc. Camb. Phil. Soc.
44) looks along these directions only, with nuisances and effect free to follow.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import isinf

import numpy as np
from scipy.stats import chi2, f

from discrepancy.campaign.records import FloatArray, Quantity, TrialKind
from discrepancy.errors import said
from discrepancy.fits.candidate import Term
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.fits.trial_data import TrialData
from discrepancy.verdict import Gate
from fe.runtime.patch import SENSORS
from reporting.words import counted

CONSISTENCY_LEVEL = 1e-3
"""Level of the gate, by Bonferroni over its tests; a true name fails it this often."""
IDENTIFIED = 0.5
"""Posterior over prior deviation of an effect parameter below which its prior does not count in the test."""
SEPARATE = 1e-6
"""Share of a direction that must be left when all else has followed."""
LEAST_FREEDOM = 20.0
"""Degrees of freedom from which the noise of the readings concerned is known well enough."""
LEAST_STATIONS = 3


@dataclass(frozen=True)
class ScoreTest:
    """Outcome of a score test.

    Attributes
    ----------
    name : str
        What was freed.
    statistic : float
        Fall of the sum of squares (in units of the noise) that the directions promise.
    count : int
        Number of directions that can be told from what is free already.
    p_value : float
        Of a fall as large, if the fit is right.
    strongest : str
        The direction that departs most by itself, with its size in deviations.
    """

    name: str
    statistic: float
    count: int
    p_value: float
    strongest: str


Direction = Mapping[int, FloatArray]
"""Change of the prediction (N, C) by trial number."""


def consistency_gate(problem: Problem, fit: CandidateFit) -> Gate:
    """Judge whether what is left departs along loads, runs or the channel of the effect.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        What would be named.

    Returns
    -------
    Gate
        `passed` is None where there is no static trial, no flight, and no effect of a single channel, or too
        few readings.
    """
    tests = score_tests(problem, fit, directions(problem, fit))
    if not tests:
        return Gate("consistency", None, np.nan, CONSISTENCY_LEVEL, said("consistency.not_judged"))
    worst = min(tests, key=lambda test: test.p_value)
    statistic = min(1.0, worst.p_value * len(tests))
    passed = statistic >= CONSISTENCY_LEVEL
    along = counted(worst.count, "direction")
    reason = said(f"consistency.{'passed' if passed else 'failed'}", worst=worst, along=along)
    return Gate("consistency", passed, statistic, CONSISTENCY_LEVEL, reason)


def score_tests(
    problem: Problem, fit: CandidateFit, groups: Mapping[str, Mapping[str, Direction]]
) -> list[ScoreTest]:
    """Test groups of directions at a fit, each group by itself.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        Converged, with its linearisations.
    groups : mapping of str to mapping of str to Direction
        Names of tests, names of their directions.

    Returns
    -------
    list of ScoreTest
        Of the groups of which a direction is left and whose channels have enough readings.
    """
    # effect parameters that the data determine follow without their prior: that they are unlikely says
    # nothing of what they leave
    determined = np.diag(fit.effect_covariance) < IDENTIFIED**2
    screen = Screen(problem, fit, record_noise=False, effect_precision=np.where(determined, 0.0, 1.0))
    sign, tests = screen.sign, []
    for name, group in groups.items():
        labels, vectors, slopes = [], [], []
        for label, direction in group.items():
            changes = {number: problem.trials[number].standardised(c) for number, c in direction.items()}
            vector, slope, _ = screen.projected(changes)
            size = float(np.linalg.norm(vector[sign > 0.0]))
            if size > 0.0:
                labels.append(label)
                vectors.append(vector / size)
                slopes.append(slope / size)
        if not labels:
            continue
        gradient, information = np.array(slopes), (np.array(vectors) * sign) @ np.array(vectors).T
        values, modes = np.linalg.eigh(information)
        kept = values > SEPARATE
        count, statistic = int(kept.sum()), float(np.sum((modes.T @ gradient)[kept] ** 2 / values[kept]))
        freedom, share = _freedom(problem, fit, group.values())
        if not count or freedom - count < LEAST_FREEDOM:
            continue
        own = np.diag(information)
        alone = np.abs(gradient) / np.sqrt(np.where(own > SEPARATE, own, np.inf))
        most = int(np.argmax(alone))
        strongest = f"{labels[most]} ({alone[most]:.1f} deviations)"
        tests.append(ScoreTest(name, statistic, count, _p_value(statistic, count, freedom, share), strongest))
    return tests


def _p_value(statistic: float, count: int, freedom: float, share: float) -> float:
    """Return the tail probability; the noise is known with `freedom`, `share` of it left by the unknowns."""
    if isinf(freedom):
        return float(chi2.sf(statistic, count))
    scaled = statistic * share
    if scaled >= freedom:
        return 0.0
    return float(f.sf((scaled / count) / ((freedom - scaled) / (freedom - count)), count, freedom - count))


def _freedom(problem: Problem, fit: CandidateFit, directions: Iterable[Direction]) -> tuple[float, float]:
    """Return degrees of freedom of the noise of the channels concerned, and their share not spent."""
    channels: set[int] = set()
    for direction in directions:
        for number, column in direction.items():
            channels.update(problem.trials[number].groups[np.any(column != 0.0, axis=0)].tolist())
    rows = sorted(channels)
    known = problem.freedom[rows] + problem.counts[rows]
    if np.any(np.isinf(known)):
        return np.inf, 1.0
    left = float(np.sum(known - fit.spent[rows]))
    return left, left / float(known.sum())


def directions(problem: Problem, fit: CandidateFit) -> Mapping[str, Mapping[str, Direction]]:
    """Return the directions of each test by name.

    Loads at rest and in flight: size, zero (at rest only) and slope over the span of the response, by load
    place. Runs: a zero that all channels of a quantity share. The channel of an effect: the size of its
    response by kind of trial and load place, and its drift.
    """
    own = [channel for term in fit.candidate.terms if (channel := _own_channel(problem, term))]
    found: dict[str, dict[str, dict[int, FloatArray]]] = {}
    last = max(abs(data.trial.start) for data in problem.trials) or 1.0
    for number, data in enumerate(problem.trials):
        trial, kind = data.trial, data.trial.kind

        def add(group: str, label: str, column: FloatArray, number: int = number) -> None:
            found.setdefault(group, {}).setdefault(label, {})[number] = column

        response = _response(problem, fit, number)
        static = kind is TrialKind.STATIC
        place = f"under load at {_place(data)}"
        if static or kind is TrialKind.FLIGHT:
            group, where = ("static loads", place) if static else ("loads of flight", "in flight")
            add(group, f"the size {where}", response)
            along = _along_span(problem, data)
            if static:
                zero = response[np.argmax(np.abs(trial.force))]
                add(group, f"the zero {where}", np.broadcast_to(zero, response.shape))
            if along is not None:
                add(group, f"the slope over the span {where}", response * along)
        quantities = [problem.campaign.channels[name].quantity for name in trial.channels]
        for quantity in sorted(set(quantities)) if static else ():
            columns = np.array([item is quantity for item in quantities]) * _scale(problem, quantity)
            where = f"in run {trial.run}" if trial.run else "in the runs without a label"
            label = f"the zero of {quantity.value} {where}"
            add("zeros of the static runs", label, np.broadcast_to(columns, data.weight.shape))
        for channel in own:
            if channel in trial.channels:
                column = np.array([name == channel for name in trial.channels])
                drift = _scale(problem, problem.campaign.channels[channel].quantity) * trial.start / last
                where = place if static else f"in the trials {kind.value}"
                add(f"channel {channel}", f"the size {where}", response * column)
                add(f"channel {channel}", "the zero over time", drift * np.ones(response.shape) * column)
    return found


def _response(problem: Problem, fit: CandidateFit, number: int) -> FloatArray:
    """Return what a trial's motion or load does to the readings (N, C)."""
    trial, response = problem.trials[number].trial, fit.responses[number]
    if trial.kind is TrialKind.STATIC:  # temperature and the offset of a run are no response to the load
        response = response - response[np.argmin(np.abs(trial.force))]
    return np.asarray((1.0 + problem.shared.gains(fit.point.shared, trial.channels)) * response)


def _scale(problem: Problem, quantity: Quantity) -> float:
    """Return a size for zeros, the same in all trials, however noisy each was."""
    channels = problem.campaign.channels.values()
    return min(problem.noise[item.name].static_deviation for item in channels if item.quantity is quantity)


def _place(data: TrialData) -> str:
    place = data.trial.load_place
    return place if isinstance(place, str) else f"({place[0]:g}, {place[1]:g})"


def _along_span(problem: Problem, data: TrialData) -> FloatArray | None:
    """Return the station of each channel (C,) from their mean over their range; 0 where it is not known."""
    stations = [problem.campaign.channels[name].station for name in data.trial.channels]
    known = np.array([np.nan if station is None else station for station in stations])
    values = known[np.isfinite(known)]
    if len(np.unique(values)) < LEAST_STATIONS:
        return None
    return np.asarray(np.where(np.isfinite(known), (known - values.mean()) / np.ptp(values), 0.0))


def _own_channel(problem: Problem, term: Term) -> str:
    """Return the channel that a term acts on if it is one alone, else nothing."""
    patch = term.patch(problem.setting, term.start() + 1.0)
    channels = {getattr(item, "channel", "") for item in patch if isinstance(item, SENSORS)}
    if len(channels) != 1 or not all(isinstance(item, SENSORS) for item in patch):
        return ""
    (channel,) = channels
    return channel if channel in problem.campaign.channels else ""
