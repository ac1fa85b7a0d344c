"""When there is a gap in the records in time: events of the missing force, or of what readings show.

Where a model tells how its ports move, an event is a force at the port that tells most, or on the reading of
one channel where that tells more, beside all unknowns of the records. Elsewhere it acts on the pattern over
the channels in which the residuals of a fit are largest.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.location.residuals import ResidualSet
from discrepancy.system.response import PortedSystem
from discrepancy.verdict import GapWindow, Moment

from .events import GROUND, MOST_EVENTS, Events, events, throughout
from .explained import Explained, seen
from .filtered import Process
from .naming import ForceSearch
from .shares import of_nothing
from .switched_record import changes
from .trial import SeenTrial
from .view import View

IN_TIME = frozenset(TrialKind) - {TrialKind.STATIC}

SHOWS = 0.2
"""Share of the largest channel's size from which on a channel shows a gap."""
READING_SIZES, READING_TIMES = (3.0, 30.0, 300.0), (0.02, 0.3)
"""Processes on a reading that are weighed against the force: over the noise, over the record's length."""


def gap_windows(
    problem: Problem, fit: CandidateFit, residuals: ResidualSet, *, seed: int = 0
) -> tuple[GapWindow, ...]:
    """Return when there is a gap of the model as it was, in records held out too.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        Of the verdict: where its law at a port, acting throughout, tells more than events, there are none.
    residuals : ResidualSet
        Of the model as it was; those of trials whose force cannot be seen, and of a model with laws
        of its own, are looked at themselves.
    seed : int
        Of the draw that restores what the fit has absorbed.
    """
    dynamic = tuple(item.trial for item in residuals.trials if item.trial.is_dynamic)
    own = problem.model.apart()[1]  # laws that are exact where they are simulated, not along what is seen
    if not dynamic or not problem.model.shows_ports or len(own):
        return residual_windows(residuals, seed=seed)
    try:
        found = _of_force(problem.with_trials(dynamic), fit)
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):  # no verdict rests on it
        return residual_windows(residuals, seed=seed)
    return found + residual_windows(residuals, seed=seed, kinds=frozenset({TrialKind.FLIGHT}))


def _of_force(problem: Problem, fit: CandidateFit) -> tuple[GapWindow, ...]:
    """Return when a force is missing at the port, or the reading, that tells most."""
    search = ForceSearch(problem)
    port = max(search.at, key=lambda name: search.at[name].log_evidence)
    laws = [number for number, term in enumerate(fit.candidate.terms) if term.place == port]
    law = search.followed(search.at[port], *fit.candidate.some(laws, fit.effect)) if laws else None
    channels = [data.trial.channels for data in problem.trials]
    number, found = _most_telling(search.ports.index(port), search.rough(port), channels)
    if found.log_evidence < of_nothing(found) + GROUND:
        return ()
    best = events(found.view, number, found.processes[number], -np.inf if law is None else law.log_evidence)
    shown = []
    for trial, motion in zip(found.view.trials, found.motions, strict=True):
        force = motion.forces[number]
        shown.append(trial.readings(trial.pushed(number, force), {number: force}))
    return _windows(best, channels, shown, with_effect=False)


def residual_windows(
    residuals: ResidualSet,
    *,
    seed: int = 0,
    with_effect: bool = False,
    kinds: frozenset[TrialKind] = IN_TIME,
) -> tuple[GapWindow, ...]:
    """Return when the residuals of a hypothesis are more than noise, in trials of some kinds.

    `with_effect`: whether it is the best one, not the model as it was. A flight whose turns came without
    times has none.
    """
    found: tuple[GapWindow, ...] = ()
    white = residuals.white(np.random.default_rng((seed, 1)))
    for item, series in zip(residuals.trials, white, strict=True):
        if item.trial.kind in kinds and item.used.any() and np.ptp(item.trial.time) > 0.0:
            one, pattern = of_series(item.trial.name, item.trial.time, series, item.used)
            if one.log_evidence < of_nothing(one) + GROUND:
                continue
            shown = one.motions[0].forces[0][:, None] * pattern
            try:
                best = events(one.view, 0, one.processes[0])
            except np.linalg.LinAlgError:  # a hypothesis that leaves millions of noises is off throughout
                best = throughout(one.view, 0, one.processes[0])
            found += _windows(best, [item.trial.channels], [shown], with_effect=with_effect)
    return found


def sized_windows(
    windows: Sequence[GapWindow], before: ResidualSet, after: ResidualSet
) -> tuple[GapWindow, ...]:
    """Return windows with the sizes and channels that the residuals show in them.

    A window in which no reading counts is left out: nothing shows a gap there.

    Parameters
    ----------
    windows : sequence of GapWindow
        Of the model as it was, and of what the hypothesis of the verdict leaves.
    before, after : ResidualSet
        Residuals without and with the hypothesis. Both are over the noise of the first, so that a size with
        the effect can be compared with one without it.
    """
    noise = {item.trial.name: item.noise_deviation for item in before.trials}
    found = []
    for window in windows:
        residuals = after if window.with_effect else before
        (item,) = [item for item in residuals.trials if item.trial.name == window.trial]
        begin = window.first if window.begin is None else window.begin.value
        end = window.last if window.end is None else window.end.value
        time = item.trial.time
        inside = item.used & ((time >= begin) & (time <= end))[:, None]
        if not inside.any():
            continue
        squares = np.where(inside, (item.residual / noise[window.trial]) ** 2, 0.0).sum(axis=0)
        sizes = np.sqrt(squares / np.maximum(inside.sum(axis=0), 1))
        largest = float(sizes.max())
        shows = zip(item.trial.channels, (sizes > 0.0) & (sizes >= SHOWS * largest), strict=True)
        channels = tuple(channel for channel, does in shows if does)
        found.append(replace(window, size=largest, channels=channels))
    return tuple(found)


def _most_telling(port: int, at: Explained, channels: Sequence[tuple[str, ...]]) -> tuple[int, Explained]:
    """Return the missing force, or what one channel shows where that tells more, and its port first.

    `channels` are those of each trial.
    """
    view, best = at.view, (port, at)
    trials = view.trials
    for channel in dict.fromkeys(chain(*channels)):
        motions = [replace(motion, forces={}, left={}) for motion in view.motions]
        shown = [_reading(*pair, channel) for pair in zip(trials, channels, strict=True)]
        on_reading = replace(view, trials=shown, motions=motions)
        length = max(float(np.ptp(trial.time)) for trial in trials)
        processes = [
            {0: Process(size, time * length, rough=True)}
            for size, time in product(READING_SIZES, READING_TIMES)
        ]
        about = max(processes, key=lambda item: on_reading.solve(item).evidence)
        if on_reading.solve(about).evidence > best[1].log_evidence:
            best = 0, seen(on_reading, about, about)
    return best


def _reading(trial: SeenTrial, channels: Sequence[str], channel: str) -> SeenTrial:
    """Return a trial whose only port is a reading; a unit of its force is the deviation of the noise."""
    shown = -trial.deviation[None] * (np.array(channels) == channel)
    still = np.zeros((len(trial.positions), 1))
    none = np.zeros((1, len(trial.system.generator)))
    system = replace(
        trial.system, ports=("reading",), actions=none, positions=none, speeds=none, through=shown
    )
    return replace(trial, system=system, positions=still, speeds=still, by_unknowns={})


def of_series(
    name: str, time: FloatArray, series: FloatArray, used: BoolArray
) -> tuple[Explained, FloatArray]:
    """Return residuals in noises (N, C) as a record of one reading: their largest pattern (C,), which too."""
    series = np.where(used, series, 0.0)
    pattern = np.linalg.svd(series, full_matrices=False)[2][:1]
    deviation = 1.0 + np.sqrt((series.shape[1] - 1) / len(time))  # of the largest pattern of noise alone
    none, columns = np.zeros((1, 0)), np.zeros((0, len(time), 1))
    still = np.zeros((len(time), 1))
    system = PortedSystem(np.zeros((0, 0)), ("readings",), none, none, none, none, -np.ones((1, 1)))
    trial = SeenTrial(
        name, time, series @ pattern.T / deviation, np.any(used, axis=1).reshape(-1, 1),
        np.array([deviation]), (),
        columns, columns, np.zeros(0), system, (), 1, still, still, False,
    )  # fmt: skip
    size = max(float(np.sqrt(np.mean(trial.residual**2))), 1.0)
    about = {0: Process(size, 0.1 * float(np.ptp(time)), rough=True)}
    found = seen(View([trial], np.zeros(0)), about, about)
    return found, pattern[0]


def _windows(
    best: Events, channels: Sequence[tuple[str, ...]], shown: Sequence[FloatArray], *, with_effect: bool
) -> tuple[GapWindow, ...]:
    """Return the windows of events, given by trial the channels and what these show of the force (N, C)."""
    windows = []
    for number, (trial, on) in enumerate(zip(best.search.trials, best.paths, strict=True)):
        ends = (float(trial.time[0]), float(trial.time[-1]))
        at = changes(on)
        if len(at) > 2 * MOST_EVENTS:
            on, at = np.ones_like(on), at[:0]
        moments = [Moment(*map(float, item)) for item in best.moments(number)] if len(at) else []
        edges, known = [0, *at, len(on)], [None, *moments, None]
        for k in np.flatnonzero(on[edges[:-1]]):
            size = np.sqrt(np.mean(shown[number][edges[k] : edges[k + 1]] ** 2, axis=0))
            rows = zip(channels[number], size > SHOWS * size.max(), strict=True)
            names = tuple(name for name, shows in rows if shows)
            largest = float(size.max())
            windows.append(GapWindow(trial.name, names, known[k], known[k + 1], *ends, largest, with_effect))
    return tuple(windows)
