"""The windows in time in which there is a gap between the records and the model.

They are found as events: of the missing force at the port with the most evidence or, if that is
more probable, of an error of one channel, with all unknowns of the records integrated out. If the
model does not describe how its ports move, events are looked for in the residuals of a fit:
in the course of their strongest pattern over the channels (the first singular vector).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.system.response import PortedSystem
from discrepancy.verdict import GapWindow, Moment

from .events import GROUND, MOST_EVENTS, Events, events, throughout
from .explained import ForceHypothesis, with_most_probable_forces
from .filtered import Process
from .naming import ForceSearch
from .port_force import evidence_without_force
from .switched_record import changes
from .trial import SeenTrial
from .view import View

IN_TIME = frozenset(TrialKind) - {TrialKind.STATIC}
"""Kinds of trials whose readings are a course in time."""
SHOWS = 0.2
"""Share of the largest channel's rms from which on a channel is listed as showing the gap."""
READING_SIZES = (3.0, 30.0, 300.0)
"""Standard deviations of an error of a channel, over that of its noise, that are compared with the
missing force."""
READING_TIMES = (0.02, 0.3)
"""Correlation times of such an error, over the duration of the longest record."""


def gap_windows(
    problem: Problem, fit: CandidateFit, residuals: ResidualSet, *, seed: int = 0
) -> tuple[GapWindow, ...]:
    """Return the windows in which the unchanged model has a gap, in held-out records too.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit of the verdict. If its law at a port, acting throughout, has more evidence than
        events, there are no windows.
    residuals : ResidualSet
        The residuals of the unchanged model. They alone are examined if missing forces cannot be
        estimated, or if the model has laws of its own, which are exact only in a simulation.
    seed : int
        The seed of the random draw in `ResidualSet.whitened_residuals`, which restores the part of
        the noise that the fit has absorbed.
    """
    dynamic_trials = tuple(fitted.trial for fitted in residuals.trials if fitted.trial.is_dynamic)
    _, own_laws = problem.model.without_laws()
    if not dynamic_trials or not problem.model.shows_ports or len(own_laws):
        return residual_windows(residuals, seed=seed)
    try:
        windows = _force_windows(problem.with_trials(dynamic_trials), fit)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # no verdict rests on it
        return residual_windows(residuals, seed=seed)
    flight = frozenset({TrialKind.FLIGHT})
    return windows + residual_windows(residuals, seed=seed, kinds=flight)


def _force_windows(problem: Problem, fit: CandidateFit) -> tuple[GapWindow, ...]:
    """Return the windows in which a force is missing at the port with the most evidence.

    If an error of a channel is more probable, they are the windows of that error.

    Parameters
    ----------
    problem : Problem
        The campaign and model, with the dynamic trials.
    fit : CandidateFit
        The fit of the verdict.
    """
    search = ForceSearch(problem)
    port = max(search.at, key=lambda name: search.at[name].log_evidence)
    evidence_of_law = _evidence_of_law(search, port, fit)
    channels = [data.trial.channels for data in problem.trials]
    port_number, hypothesis = _most_probable_place(
        search.ports.index(port), search.rough(port), channels
    )
    if hypothesis.log_evidence < evidence_without_force(hypothesis) + GROUND:
        return ()
    process = hypothesis.processes[port_number]
    best_events = events(hypothesis.view, port_number, process, evidence_of_law)
    readings_by_force = []
    for trial, motion in zip(hypothesis.view.trials, hypothesis.motions, strict=True):
        force = motion.forces[port_number]
        readings_by_force.append(
            trial.readings(trial.pushed(port_number, force), {port_number: force})
        )
    return _windows_of_events(best_events, channels, readings_by_force, with_effect=False)


def _evidence_of_law(search: ForceSearch, port: str, fit: CandidateFit) -> float:
    """Return the log evidence of the laws of a fit at a port [nat]; -inf if it has none there.

    Parameters
    ----------
    search : ForceSearch
        The search for the missing force.
    port : str
        The name of the port.
    fit : CandidateFit
        The fit.
    """
    laws = [number for number, term in enumerate(fit.candidate.terms) if term.place == port]
    if not laws:
        return -np.inf
    candidate, effect = fit.candidate.subset(laws, fit.effect)
    law = search.followed(search.at[port], candidate, effect)
    return -np.inf if law is None else law.log_evidence


def residual_windows(
    residuals: ResidualSet,
    *,
    seed: int = 0,
    with_effect: bool = False,
    kinds: frozenset[TrialKind] = IN_TIME,
) -> tuple[GapWindow, ...]:
    """Return the windows in which the residuals of a fit are more than noise.

    A flight whose turns have no times has no windows.

    Parameters
    ----------
    residuals : ResidualSet
        The residuals.
    seed : int
        The seed of the random draw in `ResidualSet.whitened_residuals`, which restores the part of
        the noise that the fit has absorbed.
    with_effect : bool
        Whether the residuals are those of the best hypothesis, not of the unchanged model.
    kinds : frozenset of TrialKind
        The kinds of trials that are examined.
    """
    windows: tuple[GapWindow, ...] = ()
    white = residuals.whitened_residuals(np.random.default_rng((seed, 1)))
    for fitted, white_residuals in zip(residuals.trials, white, strict=True):
        trial = fitted.trial
        extends_in_time = fitted.used.any() and np.ptp(trial.time) > 0.0
        if trial.kind not in kinds or not extends_in_time:
            continue
        hypothesis, pattern = pattern_of_residuals(
            trial.name, trial.time, white_residuals, fitted.used
        )
        if hypothesis.log_evidence < evidence_without_force(hypothesis) + GROUND:
            continue
        process = hypothesis.processes[0]
        try:
            best_events = events(hypothesis.view, 0, process)
        # with residuals of millions of noise deviations matrices become singular: a gap throughout
        except np.linalg.LinAlgError:
            best_events = throughout(hypothesis.view, 0, process)
        residuals_by_pattern = hypothesis.motions[0].forces[0][:, None] * pattern
        windows += _windows_of_events(
            best_events, [trial.channels], [residuals_by_pattern], with_effect=with_effect
        )
    return windows


def sized_windows(
    windows: Sequence[GapWindow], before: ResidualSet, after: ResidualSet
) -> tuple[GapWindow, ...]:
    """Return windows with the sizes and channels that the residuals show in them.

    A window without a reading that counts is left out, as nothing shows a gap in it.

    Parameters
    ----------
    windows : sequence of GapWindow
        The windows of the unchanged model, and those of the hypothesis of the verdict.
    before, after : ResidualSet
        The residuals without and with the hypothesis. Both are divided by the noise of `before`, so
        that sizes with and without the hypothesis can be compared.
    """
    noise = {fitted.trial.name: fitted.noise_deviation for fitted in before.trials}
    windows_with_sizes = []
    for window in windows:
        residuals = after if window.with_effect else before
        (fitted,) = (fitted for fitted in residuals.trials if fitted.trial.name == window.trial)
        inside = _used_in_window(window, fitted)
        if not inside.any():
            continue
        rms_of_channels = _rms_inside(inside, fitted, noise[window.trial])
        largest = float(rms_of_channels.max())
        is_shown = (rms_of_channels > 0.0) & (rms_of_channels >= SHOWS * largest)
        channels = _selected(fitted.trial.channels, is_shown)
        windows_with_sizes.append(replace(window, size=largest, channels=channels))
    return tuple(windows_with_sizes)


def _used_in_window(window: GapWindow, fitted: FittedTrial) -> BoolArray:
    """Return which readings (N, C) of a trial count and lie in a window."""
    begin = window.first if window.begin is None else window.begin.value
    end = window.last if window.end is None else window.end.value
    time = fitted.trial.time
    return np.asarray(fitted.used & ((time >= begin) & (time <= end))[:, None])


def _rms_inside(inside: BoolArray, fitted: FittedTrial, noise: FloatArray) -> FloatArray:
    """Return the rms residual (C,) of each channel divided by its noise, over selected readings.

    Parameters
    ----------
    inside : (N, C) array of bool
        The selected readings.
    fitted : FittedTrial
        The residuals of the trial.
    noise : (C,) array
        The standard deviation of the noise of each channel [unit of the channel].
    """
    squares = np.where(inside, (fitted.residual / noise) ** 2, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(inside.sum(axis=0), 1)))


def _selected(channels: Sequence[str], is_selected: BoolArray) -> tuple[str, ...]:
    """Return the channels whose entry in a mask (C,) is true."""
    pairs = zip(channels, is_selected, strict=True)
    return tuple(channel for channel, selected in pairs if selected)


# ---------------------------------------------------------------- errors of readings


def _most_probable_place(
    port: int, at_port: ForceHypothesis, channels: Sequence[tuple[str, ...]]
) -> tuple[int, ForceHypothesis]:
    """Return the missing force at a port, or an error of a channel if that is more probable.

    Parameters
    ----------
    port : int
        The number of the port.
    at_port : ForceHypothesis
        The missing force there.
    channels : sequence of tuple of str
        The channels of each trial.

    Returns
    -------
    port : int
        The number of the port; 0 for a channel, which is the only port of its view.
    hypothesis : ForceHypothesis
        The more probable of both.
    """
    view = at_port.view
    trials = view.trials
    longest_duration = max(float(np.ptp(trial.time)) for trial in trials)
    best_port = port
    best_hypothesis = at_port
    for channel in dict.fromkeys(chain(*channels)):
        motions = [replace(motion, forces={}, left={}) for motion in view.motions]
        trials_with_error = [
            _with_reading_as_port(trial, names, channel)
            for trial, names in zip(trials, channels, strict=True)
        ]
        channel_view = replace(view, trials=trials_with_error, motions=motions)
        processes_to_try = []
        for size, relative_time in product(READING_SIZES, READING_TIMES):
            processes_to_try.append(
                {0: Process(size, relative_time * longest_duration, rough=True)}
            )
        evidences = [channel_view.solve(processes).evidence for processes in processes_to_try]
        best_option = max(range(len(processes_to_try)), key=lambda k: evidences[k])
        if evidences[best_option] > best_hypothesis.log_evidence:
            best_port = 0
            best_hypothesis = with_most_probable_forces(
                channel_view, processes_to_try[best_option], processes_to_try[best_option]
            )
    return best_port, best_hypothesis


def _with_reading_as_port(trial: SeenTrial, channels: Sequence[str], channel: str) -> SeenTrial:
    """Return a trial whose only port is a channel: a force there is an error of its readings.

    Parameters
    ----------
    trial : SeenTrial
        The trial.
    channels : sequence of str
        The channels of the trial.
    channel : str
        The channel with the error. A force of 1 changes its reading by one noise deviation.
    """
    # readings are C s - e f (see `PortedSystem`): the minus sign makes a positive force raise them
    through = -trial.deviation[None] * (np.array(channels) == channel)
    no_motion = np.zeros((len(trial.positions), 1))
    no_action = np.zeros((1, len(trial.system.generator)))
    system = replace(
        trial.system,
        ports=("reading",),
        actions=no_action,
        positions=no_action,
        speeds=no_action,
        through=through,
    )
    return replace(trial, system=system, positions=no_motion, speeds=no_motion, by_unknowns={})


def pattern_of_residuals(
    name: str, time: FloatArray, series: FloatArray, used: BoolArray
) -> tuple[ForceHypothesis, FloatArray]:
    """Return the strongest pattern of residuals over channels, and its course as a force.

    Parameters
    ----------
    name : str
        The name of the trial.
    time : (N,) array
        The stamps [s].
    series : (N, C) array
        The residuals, divided by their noise; white noise of variance one if there is no gap.
    used : (N, C) array of bool
        Whether a residual counts.

    Returns
    -------
    hypothesis : ForceHypothesis
        The course of the pattern, as a missing force at the one channel of a record.
    pattern : (C,) array
        The pattern over the channels, of norm one.
    """
    series = np.where(used, series, 0.0)
    _, _, patterns = np.linalg.svd(series, full_matrices=False)
    pattern = patterns[:1]
    # the largest singular value of noise alone is about sqrt(N) + sqrt(C - 1): over sqrt(N) it is
    # the standard deviation of the strongest pattern
    deviation = 1.0 + np.sqrt((series.shape[1] - 1) / len(time))
    no_state = np.zeros((1, 0))
    system = PortedSystem(
        generator=np.zeros((0, 0)),
        ports=("readings",),
        actions=no_state,
        positions=no_state,
        speeds=no_state,
        outputs=no_state,
        through=-np.ones((1, 1)),
    )
    no_unknowns = np.zeros((0, len(time), 1))
    no_motion = np.zeros((len(time), 1))
    trial = SeenTrial(
        name=name,
        time=time,
        residual=series @ pattern.T / deviation,
        used=np.any(used, axis=1).reshape(-1, 1),
        deviation=np.array([deviation]),
        coloured=(),
        shared=no_unknowns,
        local=no_unknowns,
        local_precision=np.zeros(0),
        system=system,
        slopes=(),
        parts=1,
        positions=no_motion,
        speeds=no_motion,
        settled=False,
    )
    size = max(float(np.sqrt(np.mean(trial.residual**2))), 1.0)
    processes = {0: Process(size, 0.1 * float(np.ptp(time)), rough=True)}
    hypothesis = with_most_probable_forces(View([trial], np.zeros(0)), processes, processes)
    return hypothesis, pattern[0]


# ---------------------------------------------------------------- windows


def _windows_of_events(
    best: Events,
    channels: Sequence[tuple[str, ...]],
    shown: Sequence[FloatArray],
    *,
    with_effect: bool,
) -> tuple[GapWindow, ...]:
    """Return the windows of events, with the channels that show them and their size in these.

    Parameters
    ----------
    best : Events
        The events.
    channels : sequence of tuple of str
        The channels of each trial.
    shown : sequence of (N, C) array
        The part of the readings of each trial that the force makes, divided by the noise.
    with_effect : bool
        Whether the gap is that of the best hypothesis, not of the unchanged model.
    """
    windows = []
    for number, (trial, path) in enumerate(zip(best.search.trials, best.paths, strict=True)):
        is_on = path
        switches = changes(path)
        if len(switches) > 2 * MOST_EVENTS:  # a force that comes and goes acts throughout
            is_on = np.ones_like(path)
            switches = switches[:0]
        moments: list[Moment | None] = []
        if len(switches):
            moments = [Moment(*map(float, moment)) for moment in best.moments(number)]
        stretch_edges = [0, *switches.tolist(), len(is_on)]
        # None: the stretch begins with the record, or ends with it
        bounds = [None, *moments, None]
        for k in np.flatnonzero(is_on[stretch_edges[:-1]]).tolist():
            samples_of_stretch = slice(stretch_edges[k], stretch_edges[k + 1])
            rms_of_channels = np.sqrt(np.mean(shown[number][samples_of_stretch] ** 2, axis=0))
            windows.append(
                GapWindow(
                    trial=trial.name,
                    channels=_selected(
                        channels[number], rms_of_channels > SHOWS * rms_of_channels.max()
                    ),
                    begin=bounds[k],
                    end=bounds[k + 1],
                    first=float(trial.time[0]),
                    last=float(trial.time[-1]),
                    size=float(rms_of_channels.max()),
                    with_effect=with_effect,
                )
            )
    return tuple(windows)
