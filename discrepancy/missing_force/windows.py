"""The windows in time in which there is a gap between the records and the model.

The windows are found as events: stretches of time in which a force acts. The force is the missing
one at the port with the most evidence or, if that is more probable, an error of one channel. All
unknowns of the records are integrated out. If a missing force cannot be estimated, events are
looked for in the residuals of a fit: in the amplitude over time of their strongest pattern over the
channels (the first singular vector).
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, product

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, TrialKind
from discrepancy.errors import DiscrepancyError
from discrepancy.estimation.estimate import Estimate, estimate_of_processes
from discrepancy.estimation.force_search import ForceSearch
from discrepancy.estimation.force_states import Process
from discrepancy.estimation.linearisation import Linearisation, plain_linearisation
from discrepancy.estimation.process_search import Processes
from discrepancy.estimation.regression import Priors
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.system.response import PortedSystem
from discrepancy.trials_in_motion.trial import PortedTrial
from discrepancy.verdict import GapWindow, Moment

from .events import MOST_EVENTS, Events, events_throughout, find_events, force_in_records
from .switched_record import change_samples

TIMED_KINDS = frozenset(TrialKind) - {TrialKind.STATIC}
"""Kinds of trials whose readings follow each other in time; those of a static trial do not."""
LEAST_RMS_SHARE = 0.2
"""Least rms of a channel, over the largest rms of all channels, with which it is listed in a
window."""
CHANNEL_ERROR_DEVIATIONS = (3.0, 30.0, 300.0)
"""Standard deviations of an error of a channel, over that of its noise, that are compared with the
missing force."""
CHANNEL_ERROR_TIMES = (0.02, 0.3)
"""Correlation times of such an error, over the duration of the longest record."""


def gap_windows(
    problem: Problem,
    fit: CandidateFit,
    residuals: ResidualSet,
    *,
    leaves_no_force: bool = False,
    seed: int = 0,
) -> tuple[GapWindow, ...]:
    """Return the windows in which the unchanged model has a gap, in held-out records too.

    Parameters
    ----------
    fit : CandidateFit
        The fit of the verdict. If its law at a port, acting throughout, has more evidence than
        events, each window is a whole record.
    residuals : ResidualSet
        The residuals of the unchanged model. They alone are examined if missing forces cannot be
        estimated, or if the model has laws of its own, which are exact only in a simulation.
    leaves_no_force : bool
        Whether no force is missing beside the effects of this fit, which act throughout. A window
        is then a whole record, and no events are looked for.
    seed : int
        The seed of the random draw in `ResidualSet.whitened_residuals`, which restores the part of
        the noise that the fit has absorbed.
    """
    dynamic_trials = tuple(
        fitted_trial.trial for fitted_trial in residuals.trials if fitted_trial.trial.is_dynamic
    )
    _, laws_of_model = problem.model.without_laws()
    if not dynamic_trials or not problem.model.shows_ports or len(laws_of_model):
        return windows_of_residuals(residuals, seed=seed)
    try:
        windows = _windows_of_missing_force(
            problem.with_trials(dynamic_trials), fit, leaves_no_force=leaves_no_force
        )
    # windows are an addition to the verdict: if the force cannot be estimated, use the residuals
    except (DiscrepancyError, np.linalg.LinAlgError, ValueError):
        return windows_of_residuals(residuals, seed=seed)
    flight = frozenset({TrialKind.FLIGHT})
    return windows + windows_of_residuals(residuals, seed=seed, kinds=flight)


def _windows_of_missing_force(
    problem: Problem, fit: CandidateFit, *, leaves_no_force: bool
) -> tuple[GapWindow, ...]:
    """Return the windows in which a force is missing at the port with the most evidence.

    If an error of a channel is more probable, they are the windows of that error. The problem must
    have trials in motion only.
    """
    search = ForceSearch(problem)
    port = max(search.estimate_by_port, key=lambda name: search.estimate_by_port[name].log_evidence)
    channels_by_trial = [data.trial.channels for data in problem.trials]
    port_number, estimate = _port_or_channel_error(
        search.ported.ports.index(port), search.estimate_with_jumps(port), channels_by_trial
    )
    # no windows without a missing force
    if estimate.leaves_no_force:
        return ()
    process = estimate.processes[port_number]
    if leaves_no_force:
        best_events = force_in_records(estimate.linearisation, port_number, process)
    else:
        evidence_of_law = _evidence_of_law(search, port, fit)
        best_events = find_events(estimate.linearisation, port_number, process, evidence_of_law)
    # the size of a window is that of the readings that the force causes in it
    readings_by_force = []
    for smoothed_trial, linear_trial in zip(
        estimate.trials, estimate.linearisation.in_motion, strict=True
    ):
        trial = linear_trial.trial
        force = smoothed_trial.lacking_forces[port_number]
        readings_by_force.append(
            trial.readings_of_state(
                trial.state_under_force(port_number, force), {port_number: force}
            )
        )
    return _windows_of_events(best_events, channels_by_trial, readings_by_force, with_effect=False)


def _evidence_of_law(search: ForceSearch, port: str, fit: CandidateFit) -> float:
    """Return the log evidence of those laws of a fit that act at a port [nat].

    These laws alone are fitted to the missing force at the port. The evidence is -inf if the fit
    has no law there, or if they cannot be fitted.
    """
    terms_at_port = [index for index, term in enumerate(fit.candidate.terms) if term.port == port]
    if not terms_at_port:
        return -np.inf
    laws_at_port, parameters = fit.candidate.subset_of_terms(terms_at_port, fit.effect)
    with_laws = search.estimate_effects(search.estimate_by_port[port], laws_at_port, parameters)
    return -np.inf if with_laws is None else with_laws.log_evidence


def windows_of_residuals(
    residuals: ResidualSet,
    *,
    seed: int = 0,
    with_effect: bool = False,
    kinds: frozenset[TrialKind] = TIMED_KINDS,
) -> tuple[GapWindow, ...]:
    """Return the windows in which the residuals of a fit are more than noise.

    Trials whose samples all have the same time, such as flights without times, have no windows.

    Parameters
    ----------
    seed : int
        The seed of the random draw in `ResidualSet.whitened_residuals`, which restores the part of
        the noise that the fit has absorbed.
    with_effect : bool
        Whether the residuals are those of the best hypothesis, not of the unchanged model.
    """
    windows: tuple[GapWindow, ...] = ()
    white_residuals_of_trials = residuals.whitened_residuals(np.random.default_rng((seed, 1)))
    for fitted_trial, white_residuals in zip(
        residuals.trials, white_residuals_of_trials, strict=True
    ):
        trial = fitted_trial.trial
        extends_in_time = fitted_trial.used.any() and np.ptp(trial.time) > 0.0
        if trial.kind not in kinds or not extends_in_time:
            continue
        estimate, pattern = strongest_pattern(
            trial.name, trial.time, white_residuals, fitted_trial.used
        )
        if estimate.leaves_no_force:
            continue
        process = estimate.processes[0]
        try:
            best_events = find_events(estimate.linearisation, 0, process)
        # with residuals of millions of noise deviations matrices become singular: a gap throughout
        except np.linalg.LinAlgError:
            best_events = events_throughout(estimate.linearisation, 0, process)
        residuals_by_pattern = estimate.trials[0].missing_forces[0][:, None] * pattern
        windows += _windows_of_events(
            best_events, [trial.channels], [residuals_by_pattern], with_effect=with_effect
        )
    return windows


def add_window_sizes(
    windows: Sequence[GapWindow], residuals_before: ResidualSet, residuals_after: ResidualSet
) -> tuple[GapWindow, ...]:
    """Return windows with their sizes, and with the channels that show a gap in them.

    The size of a window is the largest rms residual of a channel in it, in units of the noise
    deviation. Channels with at least `LEAST_RMS_SHARE` of it show the gap. A window without a
    usable reading is left out, as nothing shows a gap in it.

    Parameters
    ----------
    windows : sequence of GapWindow
        The windows in which a gap remains with a hypothesis (`with_effect`), and those of the
        unchanged model.
    residuals_before, residuals_after : ResidualSet
        The residuals of the unchanged model, and those with the hypothesis. Both are divided by the
        noise of `residuals_before`, so that sizes with and without the hypothesis can be compared.
    """
    noise = {
        fitted_trial.trial.name: fitted_trial.noise_deviation
        for fitted_trial in residuals_before.trials
    }
    windows_with_sizes = []
    for window in windows:
        residuals = residuals_after if window.with_effect else residuals_before
        (fitted_trial,) = (
            fitted_trial
            for fitted_trial in residuals.trials
            if fitted_trial.trial.name == window.trial
        )
        is_in_window = _used_in_window(window, fitted_trial)
        if not is_in_window.any():
            continue
        rms_of_channels = _rms_by_channel(is_in_window, fitted_trial, noise[window.trial])
        largest = float(rms_of_channels.max())
        is_shown = (rms_of_channels > 0.0) & (rms_of_channels >= LEAST_RMS_SHARE * largest)
        channels = _select_channels(fitted_trial.trial.channels, is_shown)
        windows_with_sizes.append(replace(window, size=largest, channels=channels))
    return tuple(windows_with_sizes)


def _used_in_window(window: GapWindow, fitted_trial: FittedTrial) -> BoolArray:
    """Return which readings (N, C) of a trial are usable and lie in a window."""
    begin = window.first if window.begin is None else window.begin.value
    end = window.last if window.end is None else window.end.value
    time = fitted_trial.trial.time
    return np.asarray(fitted_trial.used & ((time >= begin) & (time <= end))[:, None])


def _rms_by_channel(
    is_selected: BoolArray, fitted_trial: FittedTrial, noise: FloatArray
) -> FloatArray:
    """Return the rms over selected readings (N, C) of each channel's residual over its noise (C,).

    The noise is a standard deviation [unit of the channel]. The rms is 0 without a reading.
    """
    squares = np.where(is_selected, (fitted_trial.residual / noise) ** 2, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(is_selected.sum(axis=0), 1)))


def _select_channels(channels: Sequence[str], is_selected: BoolArray) -> tuple[str, ...]:
    """Return the channels whose entry in a mask (C,) is true."""
    pairs = zip(channels, is_selected, strict=True)
    return tuple(channel for channel, selected in pairs if selected)


# ---------------------------------------------------------------- errors of readings


def _port_or_channel_error(
    port: int, at_port: Estimate, channels: Sequence[tuple[str, ...]]
) -> tuple[int, Estimate]:
    """Return the missing force at a port, or an error of a channel if that is more probable.

    Parameters
    ----------
    at_port : Estimate
        The estimate of a missing force at that port alone.

    Returns
    -------
    port : int
        The number of the port; 0 for a channel, which is the only port of the returned trials.
    estimate : Estimate
        The more probable of both.
    """
    linearisation = at_port.linearisation
    trials = [linear_trial.trial for linear_trial in linearisation.in_motion]
    longest_duration = max(float(np.ptp(trial.time)) for trial in trials)
    best_port = port
    best_estimate = at_port
    channel_names = dict.fromkeys(chain(*channels))  # each once, in order
    for channel in channel_names:
        with_channel_error = plain_linearisation(
            [
                _with_channel_as_port(trial, names, channel)
                for trial, names in zip(trials, channels, strict=True)
            ],
            linearisation.priors,
        )
        evidence, processes = _most_probable_channel_error(with_channel_error, longest_duration)
        if evidence > best_estimate.log_evidence:
            best_port = 0
            best_estimate = estimate_of_processes(with_channel_error, processes, processes)
    return best_port, best_estimate


def _most_probable_channel_error(
    linearisation: Linearisation, longest_duration: float
) -> tuple[float, Processes]:
    """Return the random process that describes the error of one channel best, with its evidence.

    All pairs of a standard deviation from `CHANNEL_ERROR_DEVIATIONS` and a correlation time from
    `CHANNEL_ERROR_TIMES` are compared.

    Parameters
    ----------
    linearisation : Linearisation
        The trials. Their only port is the channel: a force at this port is an error of its readings
        in units of the noise deviation, see `_with_channel_as_port`.
    longest_duration : float
        The duration of the longest trial [s].

    Returns
    -------
    best_evidence : float
        The log evidence of the trials with the best process [nat].
    best_processes : mapping of int to Process
        The best process, under the number 0 of the only port.
    """
    channel_port = 0
    best_evidence = -np.inf
    best_processes: Processes = {}
    for deviation, relative_time in product(CHANNEL_ERROR_DEVIATIONS, CHANNEL_ERROR_TIMES):
        # an error of a sensor may begin suddenly, so the process may jump
        process = Process(
            standard_deviation=deviation,
            correlation_time=relative_time * longest_duration,
            may_jump=True,
        )
        processes = {channel_port: process}
        evidence = linearisation.solve(processes).log_evidence
        # the first process is taken in any case, even if its evidence is minus infinity
        is_first = not best_processes
        if is_first or evidence > best_evidence:
            best_evidence = evidence
            best_processes = processes
    return best_evidence, best_processes


def _with_channel_as_port(trial: PortedTrial, channels: Sequence[str], channel: str) -> PortedTrial:
    """Return a trial in which the missing force is an error of the readings of one channel.

    The ports of the model, at which forces act on the structure, are replaced by a single port
    that acts on the readings alone. A force of one there raises the reading of the channel by one
    standard deviation of its noise. `channels` are the names of all channels of the trial.
    """
    # The readings (C,) are C s - e f, with state s and force f; `through` is e, an array (1, C).
    # It has a minus sign, so that a positive force raises the reading.
    has_error = np.array(channels) == channel
    through = -trial.deviation[None] * has_error
    zeros_of_states = np.zeros((1, len(trial.system.generator)))
    zeros_of_samples = np.zeros((len(trial.port_positions), 1))
    system = replace(
        trial.system,
        ports=("reading",),
        actions=zeros_of_states,
        positions=zeros_of_states,
        speeds=zeros_of_states,
        through=through,
    )
    return replace(
        trial,
        system=system,
        port_positions=zeros_of_samples,
        port_speeds=zeros_of_samples,
        port_motion_derivatives={},  # the port does not move
    )


def strongest_pattern(
    name: str, time: FloatArray, series: FloatArray, is_used: BoolArray
) -> tuple[Estimate, FloatArray]:
    """Return the amplitude over time of the strongest pattern of residuals, and the pattern.

    The pattern is the first right singular vector of the residuals.

    Parameters
    ----------
    time : (N,) array
        The times of the samples [s].
    series : (N, C) array
        The residuals, divided by their noise; white noise of variance one if there is no gap.
    is_used : (N, C) array of bool
        Whether each residual counts.

    Returns
    -------
    estimate : Estimate
        The amplitude of the pattern over time, as a missing force in a record of one channel.
    pattern : (C,) array
        The pattern over the channels, of norm one.
    """
    series = np.where(is_used, series, 0.0)
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
    trial = PortedTrial(
        name=name,
        time=time,
        residual=series @ pattern.T / deviation,
        used=np.any(is_used, axis=1).reshape(-1, 1),
        deviation=np.array([deviation]),
        coloured_noises=(),
        shared_derivatives=no_unknowns,
        local_derivatives=no_unknowns,
        local_precision=np.zeros(0),
        system=system,
        system_derivatives=(),
        substeps=1,
        port_positions=no_motion,
        port_speeds=no_motion,
        begins_at_rest=False,
    )
    rms_amplitude = max(float(np.sqrt(np.mean(trial.residual**2))), 1.0)
    processes = {0: Process(rms_amplitude, 0.1 * float(np.ptp(time)), may_jump=True)}
    linearisation = plain_linearisation([trial], Priors.without_ranges(np.zeros(0)))
    return estimate_of_processes(linearisation, processes, processes), pattern[0]


# ---------------------------------------------------------------- windows


def _windows_of_events(
    events: Events,
    channels: Sequence[tuple[str, ...]],
    readings_by_force: Sequence[FloatArray],
    *,
    with_effect: bool,
) -> tuple[GapWindow, ...]:
    """Return the windows of events, with the channels that show them and the size of the gap.

    The size is the largest rms of a channel in units of its noise.

    Parameters
    ----------
    readings_by_force : sequence of (N, C) array
        The part of the readings of each trial that the force makes, divided by the noise.
    with_effect : bool
        Whether the gap is that of the best hypothesis, not of the unchanged model.
    """
    windows: list[GapWindow] = []
    for trial_index, channel_names in enumerate(channels):
        windows += _windows_in_trial(
            events,
            trial_index,
            channel_names,
            readings_by_force[trial_index],
            with_effect=with_effect,
        )
    return tuple(windows)


def _windows_in_trial(
    events: Events,
    trial_index: int,
    channels: Sequence[str],
    readings_by_force: FloatArray,
    *,
    with_effect: bool,
) -> list[GapWindow]:
    """Return the windows of events in one trial: the stretches in which the force is on.

    If the path has more than twice `MOST_EVENTS` changes, the window is the whole record.
    The other arguments are those of `_windows_of_events`, for this trial.
    """
    trial = events.search.trials[trial_index]
    is_on = events.paths[trial_index]
    changes = change_samples(is_on)
    change_times: list[Moment | None] = []
    if len(changes) > 2 * MOST_EVENTS:
        # a force that varies, not events: one stretch from the first sample to the last
        is_on = np.ones_like(is_on)
        changes = changes[:0]
    elif len(changes):
        change_times = [Moment(*times) for times in events.change_times(trial_index).tolist()]
    stretch_edges = [0, *changes.tolist(), len(is_on)]
    # None: the stretch begins with the record, or ends with it
    edge_times = [None, *change_times, None]
    windows = []
    for stretch in np.flatnonzero(is_on[stretch_edges[:-1]]).tolist():
        samples = slice(stretch_edges[stretch], stretch_edges[stretch + 1])
        rms_of_channels = np.sqrt(np.mean(readings_by_force[samples] ** 2, axis=0))
        largest_rms = float(rms_of_channels.max())
        window = GapWindow(
            trial=trial.name,
            channels=_select_channels(channels, rms_of_channels > LEAST_RMS_SHARE * largest_rms),
            begin=edge_times[stretch],
            end=edge_times[stretch + 1],
            first=float(trial.time[0]),
            last=float(trial.time[-1]),
            size=largest_rms,
            with_effect=with_effect,
        )
        windows.append(window)
    return windows
