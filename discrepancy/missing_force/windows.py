"""When there is a gap in the records: events of the missing force, or of what readings show.

Where a model says how its ports move, an event is a force at the port with the most evidence, or an
error of one channel where that has more, beside all unknowns of the records. Elsewhere it acts on
the pattern over the channels in which the residuals of a fit are largest.
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
"""Kinds of trials that have a course in time."""
SHOWS = 0.2
"""Share of the largest channel's size from which on a channel shows a gap."""
READING_SIZES = (3.0, 30.0, 300.0)
"""Deviations of an error of a reading, over its noise, that are compared with the missing force."""
READING_TIMES = (0.02, 0.3)
"""Correlation times of such an error, over the length of the record."""


def gap_windows(
    problem: Problem, fit: CandidateFit, residuals: ResidualSet, *, seed: int = 0
) -> tuple[GapWindow, ...]:
    """Return when the model as it is has a gap, in held-out records too.

    Parameters
    ----------
    problem : Problem
        The campaign and model.
    fit : CandidateFit
        The fit of the verdict. Where its law at a port, acting throughout, has more evidence than
        events, there are no windows.
    residuals : ResidualSet
        The residuals of the model as it is. They alone are examined where forces cannot be seen,
        and for a model with laws of its own, which are exact only where they are simulated.
    seed : int
        The seed of the draw that restores what the fit has absorbed.
    """
    dynamic_trials = tuple(fitted.trial for fitted in residuals.trials if fitted.trial.is_dynamic)
    _, own_laws = problem.model.apart()
    if not dynamic_trials or not problem.model.shows_ports or len(own_laws):
        return residual_windows(residuals, seed=seed)
    try:
        windows = _force_windows(problem.with_trials(dynamic_trials), fit)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # no verdict rests on it
        return residual_windows(residuals, seed=seed)
    flight = frozenset({TrialKind.FLIGHT})
    return windows + residual_windows(residuals, seed=seed, kinds=flight)


def _force_windows(problem: Problem, fit: CandidateFit) -> tuple[GapWindow, ...]:
    """Return when a force is missing at the port, or at the channel, with the most evidence."""
    search = ForceSearch(problem)
    port = max(search.at, key=lambda name: search.at[name].log_evidence)
    evidence_of_law = _evidence_of_law(search, port, fit)
    channels = [data.trial.channels for data in problem.trials]
    number, hypothesis = _most_probable_place(
        search.ports.index(port), search.rough(port), channels
    )
    if hypothesis.log_evidence < evidence_without_force(hypothesis) + GROUND:
        return ()
    process = hypothesis.processes[number]
    best = events(hypothesis.view, number, process, evidence_of_law)
    shown = []
    for trial, motion in zip(hypothesis.view.trials, hypothesis.motions, strict=True):
        force = motion.forces[number]
        shown.append(trial.readings(trial.pushed(number, force), {number: force}))
    return _windows_of_events(best, channels, shown, with_effect=False)


def _evidence_of_law(search: ForceSearch, port: str, fit: CandidateFit) -> float:
    """Return the evidence of the laws of a fit at a port [nat]; -inf if it has none there."""
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
    """Return when the residuals of a hypothesis are more than noise.

    A flight whose turns came without times has no windows.

    Parameters
    ----------
    residuals : ResidualSet
        The residuals.
    seed : int
        The seed of the draw that restores what the fit has absorbed.
    with_effect : bool
        Whether the hypothesis is the best one, not the model as it is.
    kinds : frozenset of TrialKind
        The kinds of trials that are examined.
    """
    windows: tuple[GapWindow, ...] = ()
    white = residuals.white(np.random.default_rng((seed, 1)))
    for fitted, series in zip(residuals.trials, white, strict=True):
        trial = fitted.trial
        has_course = fitted.used.any() and np.ptp(trial.time) > 0.0
        if trial.kind not in kinds or not has_course:
            continue
        hypothesis, pattern = pattern_of_residuals(trial.name, trial.time, series, fitted.used)
        if hypothesis.log_evidence < evidence_without_force(hypothesis) + GROUND:
            continue
        process = hypothesis.processes[0]
        try:
            best = events(hypothesis.view, 0, process)
        except np.linalg.LinAlgError:  # residuals of millions of noises are there throughout
            best = throughout(hypothesis.view, 0, process)
        shown = hypothesis.motions[0].forces[0][:, None] * pattern
        windows += _windows_of_events(best, [trial.channels], [shown], with_effect=with_effect)
    return windows


def sized_windows(
    windows: Sequence[GapWindow], before: ResidualSet, after: ResidualSet
) -> tuple[GapWindow, ...]:
    """Return windows with the sizes and channels that the residuals show in them.

    A window in which no reading counts is left out: nothing shows a gap there.

    Parameters
    ----------
    windows : sequence of GapWindow
        The windows of the model as it is, and of what the hypothesis of the verdict leaves.
    before, after : ResidualSet
        The residuals without and with the hypothesis. Both are divided by the noise of the first,
        so that a size with the effect can be compared with one without it.
    """
    noise = {fitted.trial.name: fitted.noise_deviation for fitted in before.trials}
    sized = []
    for window in windows:
        residuals = after if window.with_effect else before
        (fitted,) = (fitted for fitted in residuals.trials if fitted.trial.name == window.trial)
        inside = _used_in_window(window, fitted)
        if not inside.any():
            continue
        sizes = _rms_inside(inside, fitted, noise[window.trial])
        largest = float(sizes.max())
        shows = (sizes > 0.0) & (sizes >= SHOWS * largest)
        channels = _selected(fitted.trial.channels, shows)
        sized.append(replace(window, size=largest, channels=channels))
    return tuple(sized)


def _used_in_window(window: GapWindow, fitted: FittedTrial) -> BoolArray:
    """Return which readings (N, C) of a trial count and lie within a window."""
    begin = window.first if window.begin is None else window.begin.value
    end = window.last if window.end is None else window.end.value
    time = fitted.trial.time
    return np.asarray(fitted.used & ((time >= begin) & (time <= end))[:, None])


def _rms_inside(inside: BoolArray, fitted: FittedTrial, noise: FloatArray) -> FloatArray:
    """Return the rms residual (C,) of each channel over its noise (C,), of some readings (N, C)."""
    squares = np.where(inside, (fitted.residual / noise) ** 2, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(inside.sum(axis=0), 1)))


def _selected(channels: Sequence[str], is_selected: BoolArray) -> tuple[str, ...]:
    """Return the channels that are selected by a mask (C,)."""
    pairs = zip(channels, is_selected, strict=True)
    return tuple(channel for channel, selected in pairs if selected)


# ---------------------------------------------------------------- errors of readings


def _most_probable_place(
    port: int, at_port: ForceHypothesis, channels: Sequence[tuple[str, ...]]
) -> tuple[int, ForceHypothesis]:
    """Return the missing force at a port, or the error of a channel if that is more probable.

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
        The more probable hypothesis.
    """
    view = at_port.view
    trials = view.trials
    length = max(float(np.ptp(trial.time)) for trial in trials)
    best_port = port
    best = at_port
    for channel in dict.fromkeys(chain(*channels)):
        motions = [replace(motion, forces={}, left={}) for motion in view.motions]
        on_reading = [
            _with_reading_as_port(trial, names, channel)
            for trial, names in zip(trials, channels, strict=True)
        ]
        channel_view = replace(view, trials=on_reading, motions=motions)
        options = []
        for size, relative_time in product(READING_SIZES, READING_TIMES):
            options.append({0: Process(size, relative_time * length, rough=True)})
        evidences = [channel_view.solve(processes).evidence for processes in options]
        number = max(range(len(options)), key=lambda k: evidences[k])
        if evidences[number] > best.log_evidence:
            best_port = 0
            best = with_most_probable_forces(channel_view, options[number], options[number])
    return best_port, best


def _with_reading_as_port(trial: SeenTrial, channels: Sequence[str], channel: str) -> SeenTrial:
    """Return a trial whose only port is a reading; the unit of its force is the noise deviation."""
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
    """Return residuals as a record of one reading: their largest pattern over the channels.

    Parameters
    ----------
    name : str
        The name of the trial.
    time : (N,) array
        The stamps [s].
    series : (N, C) array
        The residuals, over their noise and white if they are noise.
    used : (N, C) array of bool
        Whether a residual counts.

    Returns
    -------
    hypothesis : ForceHypothesis
        The pattern over time, as a missing force at the reading.
    pattern : (C,) array
        The pattern over the channels.
    """
    series = np.where(used, series, 0.0)
    _, _, patterns = np.linalg.svd(series, full_matrices=False)
    pattern = patterns[:1]
    # the largest pattern of noise alone is larger than the noise
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
    """Return the windows of events, with the channels that show them and their size there.

    Parameters
    ----------
    best : Events
        The events.
    channels : sequence of tuple of str
        The channels of each trial.
    shown : sequence of (N, C) array
        What the readings of each trial show of the force, over their noise.
    with_effect : bool
        Whether the gap is that of the best hypothesis, not of the model as it is.
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
        edges = [0, *switches.tolist(), len(is_on)]
        bounds = [None, *moments, None]
        for k in np.flatnonzero(is_on[edges[:-1]]).tolist():
            stretch = slice(edges[k], edges[k + 1])
            sizes = np.sqrt(np.mean(shown[number][stretch] ** 2, axis=0))
            windows.append(
                GapWindow(
                    trial=trial.name,
                    channels=_selected(channels[number], sizes > SHOWS * sizes.max()),
                    begin=bounds[k],
                    end=bounds[k + 1],
                    first=float(trial.time[0]),
                    last=float(trial.time[-1]),
                    size=float(sizes.max()),
                    with_effect=with_effect,
                )
            )
    return tuple(windows)
