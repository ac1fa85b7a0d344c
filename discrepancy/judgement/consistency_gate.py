"""The test of consistency: residuals of a fit must not depend on load, run, or sensor channel.

An effect that is not in the catalogue can be imitated by one of the catalogue, so closely that the
sum of squares of many thousand samples does not show the difference. The difference then lies in
few patterns of the readings: in one kind of trial, the response has another amplitude, slope over
the span or zero than with the fitted effect. Such a pattern is called a *direction* here. A score
test (Rao 1948, Proc. Camb. Phil. Soc. 44, 50-57) examines whether the misfit falls along these
directions more than by chance, while nuisances and the parameters of the effect are refitted.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isinf
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2, f

from discrepancy.campaign.records import FloatArray, Quantity, TrialKind
from discrepancy.fits.candidate import EffectTerm
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.fits.screening import Screen
from discrepancy.fits.trial_data import TrialData
from discrepancy.verdict import Gate
from fe.runtime.patch import SENSORS
from reporting.words import counted

CONSISTENCY_LEVEL = 1e-3
"""Level of the whole test, with Bonferroni's correction for its parts: the probability that a true
hypothesis fails it."""
DETERMINED_DEVIATION_RATIO = 0.5
"""Ratio of posterior to prior deviation of an effect parameter below which its prior is left out of
the test."""
LEAST_REMAINING_LENGTH = 1e-6
"""Fraction of the squared length of a direction that must remain after the part that nuisances and
the effect can compensate is projected out."""
LEAST_FREEDOM = 20.0
"""Least degrees of freedom of the noise estimate for a test."""
LEAST_STATIONS = 3
"""Least number of different stations along the span for a slope over the span to be tested."""

Direction = Mapping[int, FloatArray]
"""The change of the prediction (N, C) of each trial, by the index of the trial."""


@dataclass(frozen=True)
class ScoreTest:
    """The outcome of a score test.

    Attributes
    ----------
    name : str
        The name of the group of directions that was tested.
    statistic : float
        The decrease of the sum of squares along the directions, to first order, in units of the
        noise variance.
    count : int
        The number of independent directions that nuisances and effect cannot compensate.
    p_value : float
        The probability of a decrease at least as large if the hypothesis is true.
    strongest : str
        The single direction of the largest score, with its score in standard deviations.
    """

    name: str
    statistic: float
    count: int
    p_value: float
    strongest: str


def check_consistency(problem: Problem, fit: CandidateFit) -> Gate:
    """Test whether residuals of a fit depend on load, on run, or on the channel of an effect.

    A dependence on load is looked for in static trials and in flights, one on the run in static
    trials. For each effect that acts on one channel alone, the readings of this channel in all
    trials are tested. See `directions_by_test`.

    Parameters
    ----------
    fit : CandidateFit
        The fit of the effects that would be named.

    Returns
    -------
    Gate
        The outcome. Its statistic is the least p-value of all tests, multiplied by their number
        (Bonferroni's correction). `passed` is None if nothing can be tested: no trial is static or
        a flight and no effect acts on one channel alone, or there are too few readings, or the
        nuisances and the effects can compensate all directions.
    """
    tests = score_tests(problem, fit, directions_by_test(problem, fit))
    if not tests:
        reason = (
            "No trial is static or a flight, or there are too few readings, so whether the "
            "residuals follow the load cannot be tested."
        )
        return Gate("consistency", None, np.nan, CONSISTENCY_LEVEL, reason)
    worst_test = min(tests, key=lambda test: test.p_value)
    corrected_p_value = min(1.0, worst_test.p_value * len(tests))
    passed = corrected_p_value >= CONSISTENCY_LEVEL
    if passed:
        reason = "The residuals follow neither loads, runs nor the effect's own channel."
    else:
        reason = (
            f"The residuals follow the {worst_test.name}: χ² {worst_test.statistic:.0f} along "
            f"{counted(worst_test.count, 'direction')}, most of all {worst_test.strongest}."
        )
    return Gate("consistency", passed, corrected_p_value, CONSISTENCY_LEVEL, reason)


# ---------------------------------------------------------------- score tests


def score_tests(
    problem: Problem, fit: CandidateFit, groups: Mapping[str, Mapping[str, Direction]]
) -> list[ScoreTest]:
    """Return the score test of each group of directions at a fit.

    Parameters
    ----------
    fit : CandidateFit
        The fit, converged, with its derivatives.
    groups : mapping of str to mapping of str to Direction
        The directions of each test by their names.

    Returns
    -------
    list of ScoreTest
        The tests of the groups that have enough readings and at least one direction that nuisances
        and effect cannot compensate.
    """
    # An effect parameter that the data determine is refitted without its prior: the test is about
    # the residuals, and not about how probable the value of the parameter is.
    is_determined = np.diag(fit.effect_covariance) < DETERMINED_DEVIATION_RATIO**2
    effect_precision = np.where(is_determined, 0.0, 1.0)
    screen = Screen(problem, fit, record_noise=False, effect_precision=effect_precision)
    tests = []
    for name, directions in groups.items():
        projected_directions = _projected_directions(problem, screen, directions)
        if projected_directions.labels:
            test = _score_test(
                name, projected_directions, _noise_freedom(problem, fit, directions.values())
            )
            if test is not None:
                tests.append(test)
    return tests


class _ProjectedDirections(NamedTuple):
    """Directions of unit length after projection, see `Screen.project`.

    Attributes
    ----------
    labels : list of str
        The names of the K directions.
    gradient : (K,) array
        The negative slope of the misfit along each direction, which is its score.
    information : (K, K) array
        The inner products of the projected directions: the Fisher information of their amplitudes.
    """

    labels: list[str]
    gradient: FloatArray
    information: FloatArray


def _projected_directions(
    problem: Problem, screen: Screen, directions: Mapping[str, Direction]
) -> _ProjectedDirections:
    """Return directions without the part that nuisances and effect parameters can compensate.

    The screen must have eliminated both. Directions that change no reading are left out.
    """
    signs = screen.inner_product_signs
    labels = []
    unit_vectors = []
    scores = []
    for label, direction in directions.items():
        changes = {}
        for trial_index, change in direction.items():
            changes[trial_index] = problem.trials[trial_index].standardise(change)
        projected_vector, score, _ = screen.project(changes)
        length = float(np.linalg.norm(projected_vector[signs > 0.0]))
        if length > 0.0:
            labels.append(label)
            unit_vectors.append(projected_vector / length)
            scores.append(score / length)
    if not labels:
        return _ProjectedDirections(labels, np.zeros(0), np.zeros((0, 0)))
    information = (np.array(unit_vectors) * signs) @ np.array(unit_vectors).T
    return _ProjectedDirections(labels, np.array(scores), information)


class _NoiseFreedom(NamedTuple):
    """The degrees of freedom of the noise estimate of some channels.

    Attributes
    ----------
    freedom : float
        The degrees of freedom of noise records and residuals together; infinite if the noise of one
        of the channels is known.
    remaining_share : float
        The fraction of the degrees of freedom of records and readings that the fit did not absorb.
    """

    freedom: float
    remaining_share: float


def _noise_freedom(
    problem: Problem, fit: CandidateFit, directions: Iterable[Direction]
) -> _NoiseFreedom:
    """Return how well the noise is known in the channels that some directions change.

    The variance of the noise of such a channel is known from its record and from its residuals,
    together with `record_freedom + sample_counts` degrees of freedom. The fit has absorbed some of
    them; the result has those that are left, and their ratio to all. The freedom of a noise that is
    stated exactly is infinite, and the ratio is then 1.
    """
    channels: set[int] = set()
    for direction in directions:
        for trial_index, change in direction.items():
            is_changed = np.any(change != 0.0, axis=0)
            channels.update(problem.trials[trial_index].channel_indices[is_changed].tolist())
    channel_indices = sorted(channels)
    freedom = problem.record_freedom[channel_indices] + problem.sample_counts[channel_indices]
    if np.any(np.isinf(freedom)):
        return _NoiseFreedom(np.inf, 1.0)
    residual_freedom = float(np.sum(freedom - fit.absorbed_freedom[channel_indices]))
    return _NoiseFreedom(residual_freedom, residual_freedom / float(freedom.sum()))


def _score_test(
    name: str, directions: _ProjectedDirections, noise: _NoiseFreedom
) -> ScoreTest | None:
    """Return the score test of a group of directions; None if nothing can be tested.

    The statistic is g^T I^+ g, with the gradient g and the pseudo-inverse I^+ of the information.
    `noise` is that of the channels which the directions change.
    """
    gradient = directions.gradient
    eigenvalues, eigenvectors = np.linalg.eigh(directions.information)
    is_independent = eigenvalues > LEAST_REMAINING_LENGTH
    direction_count = int(is_independent.sum())
    gradient_components = (eigenvectors.T @ gradient)[is_independent]
    statistic = float(np.sum(gradient_components**2 / eigenvalues[is_independent]))
    if not direction_count or noise.freedom - direction_count < LEAST_FREEDOM:
        return None
    # the strongest direction by itself
    information_of_single = np.diag(directions.information)
    information_of_single = np.where(
        information_of_single > LEAST_REMAINING_LENGTH, information_of_single, np.inf
    )
    z_scores = np.abs(gradient) / np.sqrt(information_of_single)
    strongest = int(np.argmax(z_scores))
    return ScoreTest(
        name=name,
        statistic=statistic,
        count=direction_count,
        p_value=_p_value(statistic, direction_count, noise),
        strongest=f"{directions.labels[strongest]} ({z_scores[strongest]:.1f} deviations)",
    )


def _p_value(statistic: float, direction_count: int, noise: _NoiseFreedom) -> float:
    """Return the p-value of a score statistic: by χ² if the noise is known, else by an F test."""
    if isinf(noise.freedom):
        return float(chi2.sf(statistic, direction_count))
    # The statistic is in units of the noise variance estimated by all degrees of freedom. In units
    # of the variance estimated by the remaining ones, the sum of squares before the test is
    # `freedom`, and freedom - statistic is what the directions do not explain.
    scaled_statistic = statistic * noise.remaining_share
    if scaled_statistic >= noise.freedom:
        return 0.0
    remaining_freedom = noise.freedom - direction_count
    f_ratio = (scaled_statistic / direction_count) / (
        (noise.freedom - scaled_statistic) / remaining_freedom
    )
    return float(f.sf(f_ratio, direction_count, remaining_freedom))


# ---------------------------------------------------------------- directions


class _DirectionGroups:
    """The directions of all tests while they are collected, by group and label."""

    def __init__(self) -> None:
        self.by_test: dict[str, dict[str, dict[int, FloatArray]]] = {}

    def add_change(self, group: str, label: str, trial_index: int, change: FloatArray) -> None:
        """Add the change of the prediction of a trial to a direction.

        Parameters
        ----------
        group, label : str
            The name of the test, and that of the direction in it.
        change : (N, C) array
            The change of its prediction [unit of the channel].
        """
        self.by_test.setdefault(group, {}).setdefault(label, {})[trial_index] = change


def directions_by_test(
    problem: Problem, fit: CandidateFit
) -> Mapping[str, Mapping[str, Direction]]:
    """Return the directions that each test examines, by the names of the test and the direction.

    A direction is a change of the predicted readings that a false effect may leave, see the head of
    this module. There are three kinds of tests:

    - "static loads" and "loads of flight" (`_add_load_directions`). At each place of a static load,
      and in flight, another amplitude of the response, or a slope over the span if there are enough
      stations. At a static load also an offset with the pattern of the response.
    - "zeros of the static runs" (`_add_run_zeros`). In each run, an offset that all channels of one
      quantity have in common.
    - "channel NAME" (`_add_channel_directions`), for each effect that acts on one channel alone.
      Another amplitude of the channel's response, for each kind of trial or place of a static load,
      and an offset that grows in proportion to the start of the trial.
    """
    groups = _DirectionGroups()
    channels_of_effects = _channels_of_effects(problem, fit)
    latest_start = max(abs(data.trial.start) for data in problem.trials)
    if latest_start == 0.0:
        latest_start = 1.0  # all trials begin at zero: there is no drift, whatever its divisor
    for trial_index, data in enumerate(problem.trials):
        response = _predicted_response(problem, fit, trial_index)
        if data.trial.kind in (TrialKind.STATIC, TrialKind.FLIGHT):
            _add_load_directions(groups, problem, trial_index, response)
        if data.trial.kind is TrialKind.STATIC:
            _add_run_zeros(groups, problem, trial_index)
        for channel in channels_of_effects:
            if channel in data.trial.channels:
                _add_channel_directions(
                    groups, problem, trial_index, channel, response, latest_start
                )
    return groups.by_test


def _add_load_directions(
    groups: _DirectionGroups, problem: Problem, trial_index: int, response: FloatArray
) -> None:
    """Add the directions of a trial under load: size, zero and slope of its response (N, C)."""
    data = problem.trials[trial_index]
    is_static = data.trial.kind is TrialKind.STATIC
    group = "static loads" if is_static else "loads of flight"
    place_text = _load_place_text(data) if is_static else "in flight"
    groups.add_change(group, f"the size {place_text}", trial_index, response)
    if is_static:
        zero = response[np.argmax(np.abs(data.trial.force))]
        groups.add_change(
            group, f"the zero {place_text}", trial_index, np.broadcast_to(zero, response.shape)
        )
    positions = _positions_along_span(problem, data)
    if positions is not None:
        label = f"the slope over the span {place_text}"
        groups.add_change(group, label, trial_index, response * positions)


def _add_run_zeros(groups: _DirectionGroups, problem: Problem, trial_index: int) -> None:
    """Add, for each quantity, a zero that all its channels have in common in a static run."""
    data = problem.trials[trial_index]
    trial = data.trial
    quantities = [problem.campaign.channels[name].quantity for name in trial.channels]
    run_text = f"in run {trial.run}" if trial.run else "in the runs without a label"
    for quantity in sorted(set(quantities)):
        is_quantity = np.array([channel_quantity is quantity for channel_quantity in quantities])
        zero = is_quantity * _zero_scale(problem, quantity)
        label = f"the zero of {quantity.value} {run_text}"
        groups.add_change(
            "zeros of the static runs", label, trial_index, np.broadcast_to(zero, data.weight.shape)
        )


def _add_channel_directions(
    groups: _DirectionGroups,
    problem: Problem,
    trial_index: int,
    channel: str,
    response: FloatArray,
    latest_start: float,
) -> None:
    """Add the directions of one channel in a trial: the size of its response (N, C), and a drift.

    The drift is proportional to the start of the trial [s]. At `latest_start` it is as large as the
    common zero of all channels of the same quantity, see `_zero_scale`.
    """
    data = problem.trials[trial_index]
    kind = data.trial.kind
    is_channel = np.array([name == channel for name in data.trial.channels])
    zero = _zero_scale(problem, problem.campaign.channels[channel].quantity)
    trials_text = f"in the trials {kind.value}"
    if kind is TrialKind.STATIC:
        trials_text = _load_place_text(data)
    group = f"channel {channel}"
    groups.add_change(group, f"the size {trials_text}", trial_index, response * is_channel)
    drift = zero * data.trial.start / latest_start * np.ones(response.shape) * is_channel
    groups.add_change(group, "the zero over time", trial_index, drift)


def _predicted_response(problem: Problem, fit: CandidateFit, trial_index: int) -> FloatArray:
    """Return the part of a trial's predicted readings (N, C) that its motion or load causes."""
    trial = problem.trials[trial_index].trial
    response = fit.responses[trial_index]
    if trial.kind is TrialKind.STATIC:
        # subtract the row of least force: temperature and the offset of a run do not depend on load
        response = response - response[np.argmin(np.abs(trial.force))]
    gains = problem.shared.gains(fit.point.shared, trial.channels)
    return np.asarray((1.0 + gains) * response)


def _zero_scale(problem: Problem, quantity: Quantity) -> float:
    """Return the amplitude of a common zero of the channels of a quantity [SI].

    It is the least noise deviation of these channels, so that it is the same in all trials.
    """
    deviations = []
    for channel in problem.campaign.channels.values():
        if channel.quantity is quantity:
            deviations.append(problem.noise_models[channel.name].static_deviation)
    return min(deviations)


def _load_place_text(data: TrialData) -> str:
    """Return the place of a static load in words."""
    place = data.trial.load_place
    name = place if isinstance(place, str) else f"({place[0]:g}, {place[1]:g})"
    return f"under load at {name}"


def _positions_along_span(problem: Problem, data: TrialData) -> FloatArray | None:
    """Return the position of each channel along the span (C,); None with too few stations.

    A position is the station of the channel minus the mean of all stations, divided by their range.
    It is 0 for a channel without a station.
    """
    stations = [problem.campaign.channels[name].station for name in data.trial.channels]
    station_values = np.array([np.nan if station is None else station for station in stations])
    is_known = np.isfinite(station_values)
    known_stations = station_values[is_known]
    if len(np.unique(known_stations)) < LEAST_STATIONS:
        return None
    return np.asarray(
        np.where(is_known, (station_values - known_stations.mean()) / np.ptp(known_stations), 0.0)
    )


def _channels_of_effects(problem: Problem, fit: CandidateFit) -> Sequence[str]:
    """Return the channel of each effect of a fit that acts on one channel alone."""
    channels = []
    for term in fit.candidate.terms:
        channel = _only_channel_of_term(problem, term)
        if channel:
            channels.append(channel)
    return channels


def _only_channel_of_term(problem: Problem, term: EffectTerm) -> str:
    """Return the only sensor channel that a term acts on; empty if it acts on anything else."""
    patch = term.patch(problem.setting, term.start_values() + 1.0)
    if not all(isinstance(primitive, SENSORS) for primitive in patch):
        return ""
    channels = {getattr(primitive, "channel", "") for primitive in patch}
    if len(channels) != 1:
        return ""
    (channel,) = channels
    return channel if channel in problem.campaign.channels else ""
