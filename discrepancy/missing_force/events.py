"""Since when, until when: stretches of a record in which a force acts that does not act otherwise.

Beside a force of small size that may be missing throughout, a second one, larger, is on or off.
Which it is in a stretch is weighed with all unknowns of the records. Stretches are turned on or
off, one after the other, while that gains more than the places of their ends cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import BoolArray, FloatArray

from .filtered import Process
from .process_search import SIZE_DEVIATION, TIME_DEVIATION
from .switched_record import (
    EventTrials,
    Forces,
    Products,
    SwitchedRecord,
    changes,
    price_of_changes,
)
from .view import View

FINE = 4000
"""Places of a change in a short record: between its samples too."""
WORK = 4000
"""Samples of all records between which events are looked for; of more, some are left out until the
last."""
MOST_EVENTS = 6
"""Stretches of a record: more are no events, but a force that varies."""
EVENT_SIZE, STEADY_SIZE = 3.0, 0.003
"""Sizes of both forces with which the search begins, over the process: of the event's, of the
other."""
NONE = 1e-3
"""Size of no force over one."""
GROUND = 3.0
"""Evidence over no missing force [nat] from which there is one in a record."""
FEW_PASSES, MOST_PASSES = 30, 60
"""Evaluations of the evidence in a fit of sizes and times: of a first one, of a later one."""
ROUNDS = 5
"""Searches of stretches, each beside the forces of the one before, at most."""
LEAST_GAIN = 0.5
"""Evidence [nat] that a round must gain for another one."""
FIRST_MOVES = np.array([0.9, 0.7, 0.9, 0.7])
"""First moves of the logarithms of sizes and times in a fit."""
PRIOR_DEVIATIONS = np.array([SIZE_DEVIATION, 3.0, SIZE_DEVIATION, TIME_DEVIATION])
"""Prior deviations of these logarithms; an event may be a push that stays as it is."""
LARGEST_LOGARITHM = 14.0
"""Of sizes and times over those of the process."""


class EventSearch(EventTrials):
    """Looks for events at a view's port.

    Parameters
    ----------
    view : View
        Trials, unknowns, what is known to act.
    port : int
        Number of the port.
    process : Process
        A force that acts throughout: the scale of both forces' priors.
    every : int
        The step between readings that are looked at; 1 for all.
    """

    def __init__(self, view: View, port: int, process: Process, *, every: int = 1) -> None:
        super().__init__(view, port, every=every)
        self.process = process

    def products(self, forces: Forces, paths: Sequence[BoolArray]) -> list[Products]:
        """Return what each trial tells of the shared unknowns."""
        return [
            SwitchedRecord(self, number, forces).products(on) for number, on in enumerate(paths)
        ]

    def fitted(
        self, begin: Forces, paths: Sequence[BoolArray], passes: int
    ) -> tuple[Forces, float]:
        """Return the most probable forces given events, and ln evidence less the events' price."""
        scale = np.tile((self.process.size, self.process.time), 2)
        values = [value for force in begin for value in (force.size, force.time)]
        first = np.log(np.array(values) / scale)

        def forces(moves: FloatArray) -> Forces:
            """Return both forces, by moves of the logarithms in units of the first ones."""
            logs = np.clip(first + moves * FIRST_MOVES, -LARGEST_LOGARITHM, LARGEST_LOGARITHM)
            event_size, event_time, steady_size, steady_time = (np.exp(logs) * scale).tolist()
            event = replace(self.process, size=event_size, time=event_time)
            return event, replace(self.process, size=steady_size, time=steady_time)

        def objective(moves: FloatArray) -> float:
            prior = float(0.5 * np.sum(((first + moves * FIRST_MOVES) / PRIOR_DEVIATIONS) ** 2))
            return prior - float(self.evidence(self.products(forces(moves), paths)))

        simplex = np.vstack((np.zeros(4), np.eye(4)))
        options = {"xatol": 0.05, "fatol": 0.2, "maxfev": passes, "initial_simplex": simplex}
        fit = minimize(objective, simplex[0], method="Nelder-Mead", options=options)
        return forces(fit.x), -float(fit.fun) - price_of_changes(paths)

    def switched(self, forces: Forces, paths: Sequence[BoolArray]) -> list[BoolArray]:
        """Return paths with stretches turned on or off, one after the other, each of which pays."""
        new_paths = list(paths)
        products = self.products(forces, paths)
        for number, on in enumerate(paths):
            others = products[:number] + products[number + 1 :]
            record = SwitchedRecord(self, number, forces, others)
            better: BoolArray | None = on
            for _ in range(2 * MOST_EVENTS):
                if better is None:
                    break
                new_paths[number] = record.with_changes_placed(better)
                better = record.with_best_stretch_switched(new_paths[number])
            products[number] = record.products(new_paths[number])
        return new_paths


@dataclass(frozen=True, eq=False)
class Events:
    """Events at a view's port: whether the force acts from each sample on, by trial.

    Attributes
    ----------
    search : EventSearch
        The search that found them.
    forces : (Process, Process)
        That of events, and what may be missing throughout.
    paths : sequence of (N,) ndarray of bool
        Whether the force acts from each sample on, for each trial.
    score : float
        ln evidence less the prices of all changes, priors of the forces included [nat].
    """

    search: EventSearch
    forces: Forces
    paths: Sequence[BoolArray]
    score: float

    def record(self, number: int, parts: int) -> SwitchedRecord:
        """Return a trial in finer steps, beside the others."""
        products = self.search.products(self.forces, self.paths)
        others = products[:number] + products[number + 1 :]
        return SwitchedRecord(self.search, number, self.forces, others, parts)

    def moments(self, number: int) -> FloatArray:
        """Return median and both ends of the 90 % interval (C, 3) of each change in a trial [s]."""
        on = self.paths[number]
        time = self.search.trials[number].time
        parts = max(1, FINE // len(on))
        record = self.record(number, parts)
        fine_path = np.repeat(on, parts)[: (len(on) - 1) * parts + 1]
        moments = np.zeros((len(changes(on)), 3))
        for change in range(len(moments)):
            places, log_evidence = record.evidence_by_place(fine_path, change)
            place_times = np.interp(places / parts, np.arange(len(on)), time)
            # the posterior of the moment, integrated by the trapezoidal rule
            density = np.exp(log_evidence - log_evidence.max())
            steps = 0.5 * (density[1:] + density[:-1]) * np.diff(place_times)
            distribution = np.r_[0.0, np.cumsum(steps)]
            moments[change] = np.interp(
                (0.5, 0.05, 0.95), distribution / distribution[-1], place_times
            )
        return moments


def events(view: View, port: int, process: Process, least: float = -np.inf) -> Events:
    """Return the most probable events at a view's port.

    Parameters
    ----------
    view : View
        Trials, unknowns.
    port : int
        Number of the port.
    process : Process
        A force that acts throughout.
    least : float
        Evidence of what else explains all [nat]: with less there are no events.

    Returns
    -------
    Events
        With changes where these tell more than a force that acts throughout the records that have
        one.
    """
    every = -(-sum(len(trial.time) for trial in view.trials) // WORK)
    search = EventSearch(view, port, process, every=every)
    never = [np.zeros(len(trial.time), dtype=bool) for trial in search.trials]
    steady = _throughout_some(search, never)
    event = Process(EVENT_SIZE * process.size, process.time, rough=True)
    forces = (event, replace(process, size=STEADY_SIZE * process.size))
    best = _round(search, forces, never, FEW_PASSES)
    for _ in range(ROUNDS):
        again = _round(search, best.forces, best.paths, MOST_PASSES)
        if again.score < best.score + LEAST_GAIN:
            break
        best = again
    if every > 1:
        best = _among_all_samples(best, every)
        steady = _among_all_samples(steady, every)
    has_changes = any(len(changes(on)) for on in best.paths)
    return best if has_changes and best.score > max(least, steady.score) else steady


def throughout(view: View, port: int, process: Process) -> Events:
    """Return a force that acts in all records from the first sample to the last."""
    always = [np.ones(len(trial.time), dtype=bool) for trial in view.trials]
    return Events(EventSearch(view, port, process), (process, process), always, -np.inf)


def _among_all_samples(coarse: Events, every: int) -> Events:
    """Return events found in a part of the readings, placed among all."""
    search = EventSearch(coarse.search.view, coarse.search.port, coarse.search.process)
    paths = [
        np.repeat(on, every)[: len(trial.time)]
        for on, trial in zip(coarse.paths, search.trials, strict=True)
    ]
    events_of_all = Events(search, coarse.forces, paths, -np.inf)
    for number in range(len(paths)):
        paths[number] = events_of_all.record(number, 1).with_changes_placed(paths[number])
    log_evidence = float(search.evidence(search.products(coarse.forces, paths)))
    return replace(events_of_all, score=log_evidence - price_of_changes(paths))


def _throughout_some(search: EventSearch, never: Sequence[BoolArray]) -> Events:
    """Return a force that acts throughout the records in which there is one."""
    nothing_else = replace(search.process, size=NONE * search.process.size)
    paths = [~off for off in never]
    (event, _), score = search.fitted((search.process, nothing_else), paths, FEW_PASSES)
    forces = (event, nothing_else)
    for number, off in enumerate(never):
        without_it = [*paths[:number], off, *paths[number + 1 :]]
        evidence_without = search.evidence(search.products(forces, without_it))
        evidence_with = search.evidence(search.products(forces, paths))
        if evidence_without > evidence_with - GROUND:
            paths = without_it
    return Events(search, forces, paths, score)


def _round(search: EventSearch, forces: Forces, paths: Sequence[BoolArray], passes: int) -> Events:
    """Return events with new stretches beside given forces, and the forces fitted to these."""
    new_paths = search.switched(forces, paths)
    new_forces, score = search.fitted(forces, new_paths, passes)
    return Events(search, new_forces, new_paths, score)
