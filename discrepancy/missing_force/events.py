"""Events: the stretches of a record in which a force acts that does not act elsewhere.

Two forces may be missing: a small one throughout, and a larger one, the force of events, that is on
or off. A path (N,) says for each sample whether the force of events is on, and a stretch is a run
of samples between two of its changes. Stretches are turned on or off one after the other, as long
as that raises the log evidence, with all unknowns of the records integrated out, by more than the
price of the changes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.estimation.estimate import LEAST_EVIDENCE
from discrepancy.estimation.force_states import Process
from discrepancy.estimation.linearisation import Linearisation
from discrepancy.estimation.process_search import (
    PRIOR_LOG_DEVIATION_OF_AMPLITUDE,
    PRIOR_LOG_DEVIATION_OF_TIME,
)

from .switched_record import (
    EventTrials,
    ForcePair,
    SwitchedRecord,
    TrialProducts,
    change_samples,
    price_of_changes,
)

CHANGE_GRID_SIZE = 4000
"""Number of points of a record at which a change is looked for when its time is determined. The
intervals of a record with at most half as many samples are divided to reach about this number."""
MOST_SAMPLES = 4000
"""Largest number of samples of all records together in which events are looked for. Of longer
records only every k-th sample is used, except in the last step."""
MOST_EVENTS = 6
"""Largest number of stretches of a record; more of them are a force that varies, not events."""
INITIAL_EVENT_DEVIATION, INITIAL_STEADY_DEVIATION = 3.0, 0.003
"""Standard deviations with which the search for events begins, of the force of events and of the
force throughout, over that of the given process."""
NEGLIGIBLE_DEVIATION = 1e-3
"""Standard deviation that stands for no force, over that of the given process."""
FIRST_EVALUATIONS, LATER_EVALUATIONS = 30, 60
"""Numbers of evaluations of the evidence in the first fit of the forces, and in later fits."""
MOST_ROUNDS = 5
"""Largest number of rounds; each looks for stretches with the forces of the last one."""
LEAST_GAIN = 0.5
"""Least gain of log evidence in a round after which another one follows [nat]."""
SIMPLEX_STEPS = np.array([0.9, 0.7, 0.9, 0.7])
"""First steps of the simplex search in four logarithms: amplitude and correlation time of the force
of events, then of the force throughout."""
PRIOR_DEVIATIONS = np.array(
    [
        PRIOR_LOG_DEVIATION_OF_AMPLITUDE,
        3.0,
        PRIOR_LOG_DEVIATION_OF_AMPLITUDE,
        PRIOR_LOG_DEVIATION_OF_TIME,
    ]
)
"""Prior standard deviations of these logarithms. That of the first correlation time is wide, as the
force of events may stay constant."""
LARGEST_LOGARITHM = 14.0
"""Bound of these logarithms, which are relative to the given process."""


class EventSearch(EventTrials):
    """The search for events at a port.

    Parameters
    ----------
    linearisation : Linearisation
        The trials with the columns of all unknowns, without laws.
    port : int
        The number of the port.
    process : Process
        A force that acts throughout. Its amplitude (standard deviation) and correlation time are
        the prior medians of both forces.
    stride : int
        The step between samples that are used; 1 uses all.
    """

    def __init__(
        self, linearisation: Linearisation, port: int, process: Process, *, stride: int = 1
    ) -> None:
        super().__init__(linearisation, port, stride=stride)
        self.process = process

    @property
    def paths_without_force(self) -> list[BoolArray]:
        """For each trial the path (N,) on which the force of events is never on."""
        return [np.zeros(len(trial.time), dtype=bool) for trial in self.trials]

    def products(self, forces: ForcePair, paths: Sequence[BoolArray]) -> list[TrialProducts]:
        """Return the information of each trial on the shared unknowns, given forces and paths."""
        return [
            SwitchedRecord(self, number, forces).products(is_on)
            for number, is_on in enumerate(paths)
        ]

    def fit_forces(
        self, initial_forces: ForcePair, paths: Sequence[BoolArray], evaluations: int
    ) -> tuple[ForcePair, float]:
        """Return the most probable forces for given events, by a simplex search.

        Parameters
        ----------
        initial_forces : (Process, Process)
            The forces to begin with: that of events, and that throughout.
        paths : sequence of (N,) array of bool
            The events: whether the force is on at each sample, for each trial.
        evaluations : int
            The largest number of evaluations of the evidence.

        Returns
        -------
        forces : (Process, Process)
            The most probable forces.
        score : float
            The log evidence with the priors of the forces, minus the price of all changes [nat].
        """
        prior_medians = np.tile((self.process.standard_deviation, self.process.correlation_time), 2)
        initial_values = [
            value
            for force in initial_forces
            for value in (force.standard_deviation, force.correlation_time)
        ]
        initial_logarithms = np.log(np.array(initial_values) / prior_medians)

        def forces(moves: FloatArray) -> ForcePair:
            """Return both forces at moves (4,) of their logarithms in units of `SIMPLEX_STEPS`."""
            logs = np.clip(
                initial_logarithms + moves * SIMPLEX_STEPS, -LARGEST_LOGARITHM, LARGEST_LOGARITHM
            )
            event_amplitude, event_time, steady_amplitude, steady_time = (
                np.exp(logs) * prior_medians
            ).tolist()
            event = replace(
                self.process, standard_deviation=event_amplitude, correlation_time=event_time
            )
            return event, replace(
                self.process, standard_deviation=steady_amplitude, correlation_time=steady_time
            )

        def objective(moves: FloatArray) -> float:
            minus_log_prior = float(
                0.5 * np.sum(((initial_logarithms + moves * SIMPLEX_STEPS) / PRIOR_DEVIATIONS) ** 2)
            )
            return minus_log_prior - float(self.log_evidence(self.products(forces(moves), paths)))

        # Nelder-Mead search; a move of one is the first step of a logarithm
        simplex = np.vstack((np.zeros(4), np.eye(4)))
        options = {"xatol": 0.05, "fatol": 0.2, "maxfev": evaluations, "initial_simplex": simplex}
        fit = minimize(objective, simplex[0], method="Nelder-Mead", options=options)
        return forces(fit.x), -float(fit.fun) - price_of_changes(paths)

    def improve_paths(self, forces: ForcePair, paths: Sequence[BoolArray]) -> list[BoolArray]:
        """Return more probable paths, by inverting one stretch after the other.

        `paths` are those to begin with, one (N,) for each trial. The trials are treated in turn,
        each given the new paths of those before it.
        """
        new_paths = list(paths)
        products = self.products(forces, paths)
        for trial_index in range(len(new_paths)):
            products_of_others = [*products[:trial_index], *products[trial_index + 1 :]]
            record = SwitchedRecord(self, trial_index, forces, products_of_others)
            new_paths[trial_index] = _improved_path(record, new_paths[trial_index])
            products[trial_index] = record.products(new_paths[trial_index])
        return new_paths


def _improved_path(record: SwitchedRecord, path: BoolArray) -> BoolArray:
    """Return a path (N,) improved in turn by moving its changes and by inverting a stretch.

    It ends when no inversion makes it more probable. The number of inversions is limited, as one
    may undo another.
    """
    path = record.place_changes(path)
    for _ in range(2 * MOST_EVENTS - 1):
        path_with_inverted_stretch = record.invert_best_stretch(path)
        if path_with_inverted_stretch is None:
            break
        path = record.place_changes(path_with_inverted_stretch)
    return path


@dataclass(frozen=True, eq=False)
class Events:
    """The events at a port, as a path for each trial.

    Attributes
    ----------
    search : EventSearch
        The search in which they were found.
    forces : (Process, Process)
        The force of events, and the force that may be missing throughout.
    paths : sequence of (N,) ndarray of bool
        Whether the force of events is on at each sample, for each trial.
    score : float
        The log evidence minus the price of all changes [nat]. It includes the log prior of the
        forces unless the records had to be thinned.
    """

    search: EventSearch
    forces: ForcePair
    paths: Sequence[BoolArray]
    score: float

    def switched_record(self, trial_index: int, substeps: int) -> SwitchedRecord:
        """Return a trial with its filters, given the events of the other trials.

        Each interval between samples is divided into `substeps`, at whose ends a change may lie.
        """
        products = self.search.products(self.forces, self.paths)
        products_of_others = products[:trial_index] + products[trial_index + 1 :]
        return SwitchedRecord(self.search, trial_index, self.forces, products_of_others, substeps)

    def change_times(self, trial_index: int) -> FloatArray:
        """Return the times (C, 3) at which the force of events begins or ends in a trial [s].

        Each row has the median and the ends of the 90 % interval.
        """
        is_on = self.paths[trial_index]
        time = self.search.trials[trial_index].time
        # divide the intervals of a short record, so that a change may lie between samples
        substeps = max(1, CHANGE_GRID_SIZE // len(is_on))
        record = self.switched_record(trial_index, substeps)
        fine_path = np.repeat(is_on, substeps)[: (len(is_on) - 1) * substeps + 1]
        times_of_changes = np.zeros((len(change_samples(is_on)), 3))
        for change in range(len(times_of_changes)):
            samples, log_evidence = record.evidence_of_change_samples(fine_path, change)
            sample_times = np.interp(samples / substeps, np.arange(len(is_on)), time)
            # posterior density of the time of the change, integrated by the trapezoidal rule; its
            # quantiles are found by inverse interpolation
            density = np.exp(log_evidence - log_evidence.max())
            probabilities = 0.5 * (density[1:] + density[:-1]) * np.diff(sample_times)
            distribution = np.r_[0.0, np.cumsum(probabilities)]
            times_of_changes[change] = np.interp(
                (0.5, 0.05, 0.95), distribution / distribution[-1], sample_times
            )
        return times_of_changes


def find_events(
    linearisation: Linearisation, port: int, process: Process, least_score: float = -np.inf
) -> Events:
    """Return the most probable events at a port, or a steady force if that is more probable.

    Parameters
    ----------
    process : Process
        A force that acts throughout.
    least_score : float
        The log evidence of another explanation [nat]; events with a lower score are not returned.

    Returns
    -------
    Events
        The events, if they have changes and a higher score than `least_score` and than the steady
        force of `force_in_records`; otherwise this force.
    """
    search = _search_in_thinned_records(linearisation, port, process)
    steady = _steady_force_where_needed(search)
    # stretches with a large force that may jump, besides a small force throughout
    event_deviation = INITIAL_EVENT_DEVIATION * process.standard_deviation
    steady_deviation = INITIAL_STEADY_DEVIATION * process.standard_deviation
    event_force = Process(event_deviation, process.correlation_time, may_jump=True)
    steady_force = replace(process, standard_deviation=steady_deviation)
    best_events = _search_round(
        search, (event_force, steady_force), search.paths_without_force, FIRST_EVALUATIONS
    )
    for _ in range(MOST_ROUNDS):
        next_events = _search_round(
            search, best_events.forces, best_events.paths, LATER_EVALUATIONS
        )
        if next_events.score < best_events.score + LEAST_GAIN:
            break
        best_events = next_events
    best_events = _refine_to_all_samples(best_events)
    steady = _refine_to_all_samples(steady)
    has_changes = any(len(change_samples(is_on)) for is_on in best_events.paths)
    if has_changes and best_events.score > max(least_score, steady.score):
        return best_events
    return steady


def force_in_records(linearisation: Linearisation, port: int, process: Process) -> Events:
    """Return a steady force: it acts throughout each record whose evidence is larger with it.

    Parameters
    ----------
    process : Process
        The force with which the search for the most probable one begins.
    """
    search = _search_in_thinned_records(linearisation, port, process)
    return _refine_to_all_samples(_steady_force_where_needed(search))


def _search_in_thinned_records(
    linearisation: Linearisation, port: int, process: Process
) -> EventSearch:
    """Return the search in every k-th sample, such that about `MOST_SAMPLES` are used at most."""
    sample_count = sum(len(trial.trial.time) for trial in linearisation.trials)
    return EventSearch(linearisation, port, process, stride=ceil(sample_count / MOST_SAMPLES))


def events_throughout(linearisation: Linearisation, port: int, process: Process) -> Events:
    """Return events that are on in all records from the first sample to the last."""
    always = [np.ones(len(trial.trial.time), dtype=bool) for trial in linearisation.trials]
    return Events(EventSearch(linearisation, port, process), (process, process), always, -np.inf)


def _refine_to_all_samples(coarse_events: Events) -> Events:
    """Return events of thinned records in all samples, with their changes placed again."""
    stride = coarse_events.search.stride
    if stride == 1:
        return coarse_events
    search = EventSearch(
        coarse_events.search.linearisation, coarse_events.search.port, coarse_events.search.process
    )
    paths = [
        np.repeat(is_on, stride)[: len(trial.time)]
        for is_on, trial in zip(coarse_events.paths, search.trials, strict=True)
    ]
    events_in_all_samples = Events(search, coarse_events.forces, paths, -np.inf)
    # the events refer to this list of paths: the changes of each trial are placed given the refined
    # paths of the trials before it
    for trial_index in range(len(paths)):
        record = events_in_all_samples.switched_record(trial_index, 1)
        paths[trial_index] = record.place_changes(paths[trial_index])
    log_evidence = float(search.log_evidence(search.products(coarse_events.forces, paths)))
    return replace(events_in_all_samples, score=log_evidence - price_of_changes(paths))


def _steady_force_where_needed(search: EventSearch) -> Events:
    """Return a force that acts throughout those records whose evidence is larger with it.

    It must be larger by `LEAST_EVIDENCE`, and records are tested one after the other. The force is
    fitted to all records; its score is that before records are left out.
    """
    negligible_force = replace(
        search.process, standard_deviation=NEGLIGIBLE_DEVIATION * search.process.standard_deviation
    )
    # here the steady force is a force of events that is on in whole records
    paths = [~path_without_force for path_without_force in search.paths_without_force]
    (steady_force, _), score = search.fit_forces(
        (search.process, negligible_force), paths, FIRST_EVALUATIONS
    )
    forces = (steady_force, negligible_force)
    for trial_index, path_without_force in enumerate(search.paths_without_force):
        paths_without = [*paths[:trial_index], path_without_force, *paths[trial_index + 1 :]]
        evidence_without = search.log_evidence(search.products(forces, paths_without))
        evidence_with = search.log_evidence(search.products(forces, paths))
        if evidence_without > evidence_with - LEAST_EVIDENCE:
            paths = paths_without
    return Events(search, forces, paths, score)


def _search_round(
    search: EventSearch, forces: ForcePair, paths: Sequence[BoolArray], evaluations: int
) -> Events:
    """Return the events after one round: first the paths are improved, then the forces are fitted.

    `evaluations` is the largest number of evaluations of the evidence in the fit.
    """
    new_paths = search.improve_paths(forces, paths)
    new_forces, score = search.fit_forces(forces, new_paths, evaluations)
    return Events(search, new_forces, new_paths, score)
