"""Since when, until when: stretches of a record in which a force acts that does not act otherwise.

Beside a force of small size that may be missing throughout, a second one, larger, is on or off. Which it is
in a stretch is weighed with all unknowns of the records: what the readings before a moment tell and what
those after it do are joined, so that the evidence of an event with any begin and any end costs no pass of its
own. Stretches are turned on or off, one after the other, while that gains more than the places of its ends
cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray

from .filtered import Filtered, Process, without
from .kalman import Steps, discretised, joined
from .process_search import SIZE_DEVIATION, TIME_DEVIATION
from .view import View

CHANGE_PRICE = 4.0
"""ln odds against a change, beside the choice of its place."""
STARTS = 40
"""Places between which a stretch is looked for first."""
MOST_STEPS = 400_000
"""Steps of the filter for one such look, of a long record."""
PLACES = 80
"""Places of a change that are weighed at once."""
FINE = 4000
"""Places of a change in a short record: between its samples too."""
WORK = 4000
"""Samples of all records between which events are looked for; of more, some are left out until the last."""
MOST_EVENTS = 6
"""Stretches of a record: more are no events, but a force that varies."""
LARGER, LITTLE = 3.0, 0.003
"""Sizes of both forces with which the search begins, over the process: of the event's, of the other."""
NONE = 1e-3
"""Size of no force over one."""
GROUND = 3.0
"""Evidence over no missing force [nat] from which there is one in a record."""
FEW_PASSES, MOST_PASSES, ROUNDS = 30, 60, 5
LEAST_GAIN = 0.5
REACH = np.array([0.9, 0.7, 0.9, 0.7])
DOUBTS = np.array([SIZE_DEVIATION, 3.0, SIZE_DEVIATION, TIME_DEVIATION])
"""Prior deviations of the logarithms of sizes and times; an event may be a push that stays as it is."""
RANGE = 12.0
"""Evidence below the largest [nat] at which a place is out of the question."""


Forces = tuple[Process, Process]
"""The force of events, and what may be missing throughout."""
Told = tuple[FloatArray, FloatArray]
"""Products of residual and shared unknowns, and half log determinants."""


class EventSearch:
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
        Of so many readings one is looked at.

    Attributes
    ----------
    trials, columns : sequence of SeenTrial, sequence of (K, N, C) ndarray
        What is looked at: stamps, and which readings count; residuals and columns of all unknowns.
    """

    def __init__(self, view: View, port: int, process: Process, *, every: int = 1) -> None:
        self.view, self.port, self.process = view, port, process
        self.trials = [replace(one, time=one.time[::every], used=one.used[::every]) for one in view.trials]
        self.columns = [rows[:, ::every] for rows in view.rows]

    def told(self, forces: Forces, paths: Sequence[BoolArray]) -> list[Told]:
        """Return what each trial tells of the shared unknowns."""
        return [SwitchedRecord(self, k, forces).whole(on) for k, on in enumerate(paths)]

    def evidence(self, told: Sequence[Told]) -> FloatArray:
        """Return ln evidence (...) of what trials tell together."""
        products, halves = (sum(items) for items in zip(*told, strict=True))
        left, halves = without(products, halves, self.view.shared_precision)
        return -0.5 * left[..., 0, 0] - halves

    def fitted(self, about: Forces, paths: Sequence[BoolArray], passes: int) -> tuple[Forces, float]:
        """Return the most probable forces beside events, from some on, and ln evidence less all prices."""
        process = self.process
        scale = np.tile((process.size, process.time), 2)
        first = np.log(np.array([value for one in about for value in (one.size, one.time)]) / scale)

        def forces(move: FloatArray) -> Forces:
            size, time, rest, slow = (np.exp(np.clip(first + move * REACH, -14.0, 14.0)) * scale).tolist()
            return replace(process, size=size, time=time), replace(process, size=rest, time=slow)

        def objective(move: FloatArray) -> float:
            prior = float(0.5 * np.sum(((first + move * REACH) / DOUBTS) ** 2))
            return prior - float(self.evidence(self.told(forces(move), paths)))

        simplex = np.vstack((np.zeros(4), np.eye(4)))
        options = {"xatol": 0.05, "fatol": 0.2, "maxfev": passes, "initial_simplex": simplex}
        found = minimize(objective, simplex[0], method="Nelder-Mead", options=options)
        return forces(found.x), -float(found.fun) - prices(paths)

    def turned(self, forces: Forces, paths: Sequence[BoolArray]) -> list[BoolArray]:
        """Return paths with stretches turned on or off, one after the other, each of which pays."""
        found, told = list(paths), self.told(forces, paths)
        for number, on in enumerate(paths):
            one = SwitchedRecord(self, number, forces, told[:number] + told[number + 1 :])
            better: BoolArray | None = on
            for _ in range(2 * MOST_EVENTS):
                if better is None:
                    break
                found[number] = one.placed(better)
                better = one.turned(found[number])
            told[number] = one.whole(found[number])
        return found


class SwitchedRecord:
    """A trial in which the force of events is on or off.

    Parameters
    ----------
    search : EventSearch
        Whose trial it is.
    number : int
        Which.
    forces : (Process, Process)
        That of events, and what may be missing throughout.
    others : sequence of Told
        What the other trials tell of the shared unknowns.
    parts : int
        How many times smaller its steps are than those of the record.
    """

    def __init__(
        self, search: EventSearch, number: int, forces: Forces, others: Sequence[Told] = (), parts: int = 1
    ) -> None:
        self.search, self.others, trial = search, others, search.trials[number]
        self.local_precision = trial.local_precision
        one = Filtered(trial, [(search.port, force) for force in forces])
        generator, intensity, rows, start = one.system
        f = len(trial.system.generator)  # where the event's force stands
        lengths, which = trial.steps
        quiet, calm, still = generator.copy(), intensity.copy(), start.copy()
        still[:f, :f] -= np.outer(start[:f, f], start[:f, f])
        for item in (quiet, calm, still):
            item[f], item[:, f] = 0.0, 0.0
        on = discretised(generator, intensity, lengths / parts)
        off = discretised(quiet, calm, lengths / parts)
        # kinds of steps: the force is off, begins at the end, ends there, is on
        moves, noises = (np.stack((no, no, yes, yes)) for no, yes in zip(off, on, strict=True))
        moves[:3, :, f] = 0.0
        noises[:3, :, f], noises[:3, :, :, f] = 0.0, 0.0
        noises[1, :, f, f] = 1.0
        used = np.zeros(((len(trial.time) - 1) * parts + 1, trial.used.shape[1]), dtype=bool)
        used[::parts] = trial.used
        columns = np.zeros((*used.shape, len(search.columns[number])))
        columns[::parts] = np.moveaxis(search.columns[number] * one.white, 0, -1)
        self.length = np.concatenate((which[:1], np.repeat(which[1:], parts)))
        self.size = moves.shape[1]
        moves, noises = (items.reshape(-1, *start.shape) for items in (moves, noises))
        self.steps = Steps(moves, noises, rows, used, columns)
        self.begun = [self.steps.begin(cover) for cover in (still, start)]

    def which(self, on: BoolArray) -> IntArray:
        """Return the step (N,) that leads to each sample, the force acting from some on."""
        return np.asarray((2 * np.r_[False, on[:-1]] + on) * self.size + self.length)

    def whole(self, on: BoolArray) -> Told:
        """Return what the trial tells of the shared unknowns."""
        end = np.array([len(on)])
        *_, products, halves = self.steps.before(self.which(on), 0, self.begun[int(on[0])], end)
        return without(products[0], halves[0], self.local_precision)

    def ways(self, on: BoolArray, starts: IntArray, ends: IntArray) -> FloatArray:
        """Return ln evidence (A, B) with the event the other way from each start to each end after it."""
        steps, which, last = self.steps, self.which(on), ends == len(on)
        after = steps.after(which, ends)
        width = 1 + len(self.search.view.shared_precision)
        products, halves = (
            np.zeros((len(starts), len(ends), width, width)),
            np.full((len(starts), len(ends)), np.inf),
        )
        states = steps.before(which, 0, self.begun[int(on[0])], starts)
        to = np.where(last, 0, ends)
        at = (2 * ~on[ends - 1] + on[to]) * self.size + self.length[to]
        moves = np.where(last[:, None, None], np.eye(len(steps.rows[0])), steps.moves[at])
        noises = np.where(last[:, None, None], 0.0, steps.noises[at])
        for k, start in enumerate(starts.tolist()):
            state = [item[k] for item in states] if start else self.begun[int(not on[0])]
            there = ends > start
            other = on.copy()
            other[start:] ^= True
            cover, mean, *sums = steps.before(self.which(other), start, state, ends[there])
            move = moves[there]
            arrived = move @ cover @ move.mT + noises[there], move @ mean, *sums
            found = joined(arrived, [item[there] for item in after])
            products[k, there], halves[k, there] = without(*found, self.local_precision)
        return self.search.evidence([(products, halves), *self.others])

    def turned(self, on: BoolArray) -> BoolArray | None:
        """Return a path with the stretch turned on or off that gains most; None where none pays."""
        count = len(on)
        size = min(max(MOST_STEPS // count, 12), STARTS, count)
        grid = np.unique(np.r_[np.linspace(0, count, size + 1).round(), changes(on)]).astype(np.int64)
        cost = change_price(count) * np.where(np.isin(grid, changes(on)), -1.0, 1.0)
        cost[[0, -1]] = 0.0
        gains = self.ways(on, grid[:-1], grid[1:]) - cost[:-1, None] - cost[None, 1:]
        a, b = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[a, b] <= self.search.evidence([self.whole(on), *self.others]):
            return None
        found = on.copy()
        found[grid[a] : grid[b + 1]] ^= True
        return found

    def placed(self, on: BoolArray) -> BoolArray:
        """Return a path with its changes where they are most probable beside each other."""
        for _ in range(3):
            before = on.copy()
            for k, old in enumerate(changes(on)):
                places, values = self.curve(on, k)
                new = places[np.argmax(values)]
                on = on.copy()
                on[min(old, new) : max(old, new)] = on[old] if new < old else on[old - 1]
            if np.array_equal(on, before):
                break
        return on

    def curve(self, on: BoolArray, k: int) -> tuple[IntArray, FloatArray]:
        """Return places of a change, densest where it is probable, and ln evidence of each."""
        low, at, high = np.r_[0, changes(on), len(on)][k : k + 3]
        later = on.copy()
        later[low:high] = on[at]
        places, values = np.zeros(0, dtype=np.int64), np.zeros(0)
        first, last = low + 1, high - 1
        while True:
            new = np.setdiff1d(np.linspace(first, last, PLACES).round().astype(np.int64), places)
            if not len(new):
                return places, values
            places, values = np.r_[places, new], np.r_[values, self.ways(later, np.array([low]), new)[0]]
            order = np.argsort(places)
            places, values = places[order], values[order]
            near = np.flatnonzero(values >= values.max() - RANGE)
            first, last = places[max(near[0] - 1, 0)], places[min(near[-1] + 1, len(places) - 1)]


def changes(on: BoolArray) -> IntArray:
    """Return the samples from which on a force acts that did not, or does not any more."""
    return np.flatnonzero(np.diff(on)) + 1


def change_price(count: int) -> float:
    """Return what a change costs in a record of `count` samples [nat]: its place, and that it is there."""
    return float(np.log(count)) + CHANGE_PRICE


def prices(paths: Sequence[BoolArray]) -> float:
    """Return what all changes cost [nat]."""
    return sum(len(changes(on)) * change_price(len(on)) for on in paths)


@dataclass(frozen=True, eq=False)
class Events:
    """Events at a view's port: whether the force acts from each sample on, by trial.

    Attributes
    ----------
    search : EventSearch
        What they were looked for in.
    forces : (Process, Process)
        That of events, and what may be missing throughout.
    paths : sequence of (N,) ndarray of bool
        By trial.
    score : float
        ln evidence less the prices of all changes, priors of the forces included [nat].
    """

    search: EventSearch
    forces: Forces
    paths: Sequence[BoolArray]
    score: float

    def record(self, number: int, parts: int) -> SwitchedRecord:
        """Return a trial in finer steps, beside the others."""
        told = self.search.told(self.forces, self.paths)
        return SwitchedRecord(self.search, number, self.forces, told[:number] + told[number + 1 :], parts)

    def moments(self, number: int) -> FloatArray:
        """Return median and both ends of the 90 % interval (C, 3) of each change in a trial [s]."""
        on, time = self.paths[number], self.search.trials[number].time
        parts = max(1, FINE // len(on))
        one = self.record(number, parts)
        fine = np.repeat(on, parts)[: (len(on) - 1) * parts + 1]
        found = np.zeros((len(changes(on)), 3))
        for k in range(len(found)):
            places, values = one.curve(fine, k)
            at = np.interp(places / parts, np.arange(len(on)), time)
            weight = np.exp(values - values.max())
            share = np.r_[0.0, np.cumsum(0.5 * (weight[1:] + weight[:-1]) * np.diff(at))]
            found[k] = np.interp((0.5, 0.05, 0.95), share / share[-1], at)
        return found


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
        With changes where these tell more than a force that acts throughout the records that have one.
    """
    every = -(-sum(len(trial.time) for trial in view.trials) // WORK)
    event = Process(LARGER * process.size, process.time, rough=True)
    forces = event, replace(process, size=LITTLE * process.size)
    search = EventSearch(view, port, process, every=every)
    off = [np.zeros(len(trial.time), dtype=bool) for trial in search.trials]
    steady, best = _throughout(search, off), _round(search, forces, off, FEW_PASSES)
    for _ in range(ROUNDS):
        again = _round(search, best.forces, best.paths, MOST_PASSES)
        if again.score < best.score + LEAST_GAIN:
            break
        best = again
    if every > 1:
        best, steady = _in_full(best, every), _in_full(steady, every)
    changed = any(len(changes(on)) for on in best.paths)
    return best if changed and best.score > max(least, steady.score) else steady


def throughout(view: View, port: int, process: Process) -> Events:
    """Return a force that acts in all records from the first sample to the last, nothing being weighed."""
    always = [np.ones(len(trial.time), dtype=bool) for trial in view.trials]
    return Events(EventSearch(view, port, process), (process, process), always, -np.inf)


def _in_full(found: Events, every: int) -> Events:
    """Return events found in a part of the readings, placed among all."""
    part = found.search
    search = EventSearch(part.view, part.port, part.process)
    moves = zip(found.paths, search.trials, strict=True)
    paths = [np.repeat(on, every)[: len(trial.time)] for on, trial in moves]
    whole = Events(search, found.forces, paths, -np.inf)
    for number in range(len(paths)):
        paths[number] = whole.record(number, 1).placed(paths[number])
    score = float(search.evidence(search.told(found.forces, paths)))
    return replace(whole, score=score - prices(paths))


def _throughout(search: EventSearch, off: Sequence[BoolArray]) -> Events:
    """Return a force that acts throughout the records in which there is one."""
    rest = replace(search.process, size=NONE * search.process.size)
    paths = [~on for on in off]
    (event, _), score = search.fitted((search.process, rest), paths, FEW_PASSES)
    forces = event, rest
    for number, on in enumerate(off):
        fewer = [*paths[:number], on, *paths[number + 1 :]]
        less, more = (search.evidence(search.told(forces, each)) for each in (fewer, paths))
        paths = fewer if less > more - GROUND else paths
    return Events(search, forces, paths, score)


def _round(search: EventSearch, forces: Forces, paths: Sequence[BoolArray], passes: int) -> Events:
    paths = search.turned(forces, paths)
    forces, score = search.fitted(forces, paths, passes)
    return Events(search, forces, paths, score)
