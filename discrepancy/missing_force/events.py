"""Since when, until when: stretches of a record in which a force acts that does not act otherwise.

Beside a force of small size that may be missing throughout, a second one, larger, is on or off. Which it is
in a stretch is weighed with all unknowns of the records: a filter tells what is known before a moment, its
counterpart backwards what the readings after it say (Fraser and Potter 1969, IEEE Transactions on Automatic
Control 14, 387-390), so that the evidence of an event with any begin and any end costs no pass of its own.
Stretches are turned on or off, one after the other, while that gains more than the places of its ends cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.campaign.sampling import IntArray

from .event_steps import Steps, joined
from .filtered import Filtered, Process, without
from .kalman_kernels import discretised
from .view import SIZE_DOUBT, TIME_DOUBT, View

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
DOUBTS = np.array([SIZE_DOUBT, 3.0, SIZE_DOUBT, TIME_DOUBT])
"""Prior deviations of the logarithms of sizes and times; an event may be a push that stays as it is."""
RANGE = 12.0
"""Evidence below the largest [nat] at which a place is out of the question."""


@dataclass(frozen=True)
class Acting:
    """The force of events, and what may be missing throughout."""

    event: Process
    rest: Process


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
    flips : sequence of (N,) ndarray of bool
        By trial, the samples at which the force of events turns its sign.
    """

    def __init__(self, view: View, port: int, process: Process, flips: Sequence[BoolArray]) -> None:
        self.view, self.port, self.process, self.flips = view, port, process, flips
        self.columns = [
            np.concatenate((residual[None], columns, trial.local))
            for trial, residual, columns in zip(view.trials, view.residuals, view.columns, strict=True)
        ]

    def steps(self, number: int, acting: Acting, parts: int = 1) -> Steps:
        """Return a trial as the kernels take it."""
        trial = self.view.trials[number]
        one = Filtered(trial, ((self.port, acting.event), (self.port, acting.rest)))
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
        moves, noises = (np.concatenate((items, items), axis=1) for items in (moves, noises))
        half = moves.shape[1] // 2
        moves[:, half:, f] *= -1.0  # the force turns with the motion
        noises[:, half:, f] *= -1.0
        noises[:, half:, :, f] *= -1.0
        fine = (len(trial.time) - 1) * parts + 1
        used = np.zeros((fine, trial.used.shape[1]), dtype=bool)
        used[::parts] = trial.used
        columns = np.zeros((*used.shape, len(self.columns[number])))
        columns[::parts] = np.moveaxis(self.columns[number] * one.white, 0, -1)
        length = np.concatenate((which[:1], np.repeat(which[1:], parts)))
        length[::parts] += half * self.flips[number]
        begun = np.stack((still, start))
        return Steps(
            moves.reshape(-1, *start.shape),
            noises.reshape(-1, *start.shape),
            length,
            rows,
            used,
            columns,
            begun,
        )

    def whole(self, number: int, steps: Steps, on: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return products of residual and shared unknowns of a trial, and half log determinants."""
        begin = [item[None] for item in steps.begin(bool(on[0]))]
        found = joined(begin, steps.after(on, np.array([0])))
        products, halves = without(*found, self.view.trials[number].local_precision)
        return products[0], halves[0]

    def ways(
        self, number: int, steps: Steps, on: BoolArray, starts: IntArray, ends: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the same (A, B, ..) with the event the other way from each start to each end after it."""
        after, size, shape = steps.after(on, ends), len(steps.moves) // 4, (len(starts), len(ends))
        width = 1 + len(self.view.shared_precision)
        products, halves = np.zeros((*shape, width, width)), np.full(shape, np.inf)
        states = steps.before(on, 0, steps.begin(bool(on[0])), starts)
        last = ends == len(on)
        to = np.where(last, 0, ends)
        at = (2 * ~on[ends - 1] + on[to]) * size + steps.length[to]
        moves = np.where(last[:, None, None], np.eye(len(steps.rows[0])), steps.moves[at])
        noises = np.where(last[:, None, None], 0.0, steps.noises[at])
        for k, start in enumerate(starts):
            state = [item[k] for item in states] if start else steps.begin(not on[0])
            there = ends > start
            other = on.copy()
            other[start:] ^= True
            cover, mean, *sums = steps.before(other, int(start), state, ends[there])
            move = moves[there]
            arrived = move @ cover @ np.swapaxes(move, -1, -2) + noises[there], move @ mean, *sums
            found = joined(arrived, [item[there] for item in after])
            products[k, there], halves[k, there] = without(*found, self.view.trials[number].local_precision)
        return products, halves

    def evidence(self, products: FloatArray, halves: FloatArray) -> FloatArray:
        """Return ln evidence (...) from products and half log determinants summed over trials."""
        left, halves = without(products, halves, self.view.shared_precision)
        return -0.5 * left[..., 0, 0] - halves

    def total(self, acting: Acting, paths: Sequence[BoolArray]) -> float:
        """Return ln evidence of events in all trials."""
        parts = [self.whole(k, self.steps(k, acting), on) for k, on in enumerate(paths)]
        products, halves = (np.sum(items, axis=0) for items in zip(*parts, strict=True))
        return float(self.evidence(products, halves))

    def fitted(self, about: Acting, paths: Sequence[BoolArray], passes: int) -> tuple[Acting, float]:
        """Return the most probable forces beside events, from some on, and ln evidence less all prices."""
        process = self.process
        scale = np.tile((process.size, process.time), 2)
        given = (about.event.size, about.event.time, about.rest.size, about.rest.time)
        first = np.log(np.array(given) / scale)

        def acting(move: FloatArray) -> Acting:
            size, time, rest, slow = np.exp(np.clip(first + move * REACH, -14.0, 14.0)) * scale
            event = replace(process, size=float(size), time=float(time))
            return Acting(event, replace(process, size=float(rest), time=float(slow)))

        def objective(move: FloatArray) -> float:
            prior = float(0.5 * np.sum(((first + move * REACH) / DOUBTS) ** 2))
            try:
                return prior - self.total(acting(move), paths)
            except np.linalg.LinAlgError:  # a force far larger than what is read
                return np.inf

        simplex = np.vstack((np.zeros(4), np.eye(4)))
        options = {"xatol": 0.05, "fatol": 0.2, "maxfev": passes, "initial_simplex": simplex}
        found = minimize(objective, simplex[0], method="Nelder-Mead", options=options)
        return acting(found.x), -float(found.fun) - prices(paths)

    def turned(self, acting: Acting, paths: Sequence[BoolArray]) -> list[BoolArray]:
        """Return paths with stretches turned on or off, one after the other, each of which pays."""
        steps = [self.steps(number, acting) for number in range(len(paths))]
        alone = [self.whole(*item) for item in zip(range(len(paths)), steps, paths, strict=True)]
        found = list(paths)
        for number, on in enumerate(paths):
            one = _Record(self, number, steps[number], [item for k, item in enumerate(alone) if k != number])
            better: BoolArray | None = on
            for _ in range(2 * MOST_EVENTS):
                if better is None:
                    break
                found[number] = one.placed(better)
                better = one.turned(found[number])
            alone[number] = self.whole(number, steps[number], found[number])
        return found

    def record(self, number: int, acting: Acting, paths: Sequence[BoolArray], parts: int) -> "_Record":
        """Return a trial in finer steps, beside the others as they are."""
        others = [self.whole(k, self.steps(k, acting), on) for k, on in enumerate(paths) if k != number]
        return _Record(self, number, self.steps(number, acting, parts), others)


class _Record:
    """A trial whose changes are looked for, beside what the others tell of the shared unknowns."""

    def __init__(
        self, search: EventSearch, number: int, steps: Steps, others: Sequence[tuple[FloatArray, FloatArray]]
    ) -> None:
        self.search, self.number, self.steps, self.others = search, number, steps, others

    def _evidence(self, products: FloatArray, halves: FloatArray) -> FloatArray:
        for more, half in self.others:
            products, halves = products + more, halves + half
        return self.search.evidence(products, halves)

    def turned(self, on: BoolArray) -> BoolArray | None:
        """Return a path with the stretch turned on or off that gains most; None where none pays."""
        count = len(on)
        size = min(max(MOST_STEPS // count, 12), STARTS, count)
        grid = np.unique(np.r_[np.linspace(0, count, size + 1).round(), changes(on)]).astype(np.int64)
        values = self._evidence(*self.search.ways(self.number, self.steps, on, grid[:-1], grid[1:]))
        cost = change_price(count) * np.where(np.isin(grid, changes(on)), -1.0, 1.0)
        cost[[0, -1]] = 0.0
        gains = values - cost[:-1, None] - cost[None, 1:]
        a, b = np.unravel_index(np.argmax(gains), gains.shape)
        if gains[a, b] <= self._evidence(*self.search.whole(self.number, self.steps, on)):
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
            found = self.search.ways(self.number, self.steps, later, np.array([low]), new)
            places, values = np.r_[places, new], np.r_[values, self._evidence(*found)[0]]
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
    acting : Acting
        The forces.
    paths : sequence of (N,) ndarray of bool
        By trial.
    score : float
        ln evidence less the prices of all changes, priors of the forces included [nat].
    """

    search: EventSearch
    acting: Acting
    paths: Sequence[BoolArray]
    score: float

    def moments(self, number: int) -> FloatArray:
        """Return median and both ends of the 90 % interval (C, 3) of each change in a trial [s]."""
        on, time = self.paths[number], self.search.view.trials[number].time
        parts = max(1, FINE // len(on))
        one = self.search.record(number, self.acting, self.paths, parts)
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
    coarse = thinned(view, every)
    off = [np.zeros(len(trial.time), dtype=bool) for trial in coarse.trials]
    always, tried = [], []
    for with_speed, flips in enumerate(turns(coarse, port)):
        search = EventSearch(coarse, port, process, flips)
        always.append((_throughout(search, off), with_speed))
        event = Process(LARGER * process.size, process.time, rough=True)
        acting = Acting(event, replace(process, size=LITTLE * process.size))
        tried.append((_round(search, acting, off, FEW_PASSES), with_speed))
    best, turning = max(tried, key=lambda item: item[0].score)
    for _ in range(ROUNDS):
        again = _round(best.search, best.acting, best.paths, MOST_PASSES)
        if again.score < best.score + LEAST_GAIN:
            break
        best = again
    steady, never = max(always, key=lambda item: item[0].score)
    if every > 1:
        best, steady = _in_full(best, view, turning, every), _in_full(steady, view, never, every)
    changed = any(len(changes(on)) for on in best.paths)
    return best if changed and best.score > max(least, steady.score) else steady


def throughout(view: View, port: int, process: Process) -> Events:
    """Return a force that acts in all records from the first sample to the last, nothing being weighed."""
    search = EventSearch(view, port, process, turns(view, port)[0])
    always = [np.ones(len(trial.time), dtype=bool) for trial in view.trials]
    return Events(search, Acting(process, process), always, -np.inf)


def _in_full(found: Events, view: View, turning: int, every: int) -> Events:
    """Return events found in a part of the readings, placed among all."""
    search = EventSearch(
        view, found.search.port, found.search.process, turns(view, found.search.port)[turning]
    )
    paths = [
        np.repeat(on, every)[: len(trial.time)] for on, trial in zip(found.paths, view.trials, strict=True)
    ]
    for number in range(len(paths)):
        paths[number] = search.record(number, found.acting, paths, 1).placed(paths[number])
    return Events(search, found.acting, paths, search.total(found.acting, paths) - prices(paths))


def thinned(view: View, every: int) -> View:
    """Return a view with every so many one of the readings."""
    trials, motions = [], []
    for number, trial in enumerate(view.trials):
        at = slice(None, None, every)
        fine = slice((len(trial.time) - 1) // every * every * trial.parts + 1)
        known = sum(item[number].readings for item in (view.known, view.own) if item is not None)
        trials.append(
            replace(
                trial, time=trial.time[at], residual=(trial.residual - known)[at], used=trial.used[at],
                shared=trial.shared[:, at], local=trial.local[:, at], parts=trial.parts * every,
                positions=trial.positions[fine], speeds=trial.speeds[fine],
            )
        )  # fmt: skip
        if view.motions:
            motions.append(view.motions[number].part(fine))
    return replace(view, trials=trials, motions=motions, known=None, own=None)


def _throughout(search: EventSearch, off: Sequence[BoolArray]) -> Events:
    """Return a force that acts throughout the records in which there is one."""
    rest = replace(search.process, size=NONE * search.process.size)
    paths = [~on for on in off]
    acting, score = search.fitted(Acting(search.process, rest), paths, FEW_PASSES)
    acting = replace(acting, rest=rest)
    for number, on in enumerate(off):
        fewer = [*paths[:number], on, *paths[number + 1 :]]
        if search.total(acting, fewer) > search.total(acting, paths) - GROUND:
            paths = fewer
    return Events(search, acting, paths, score)


def _round(search: EventSearch, acting: Acting, paths: Sequence[BoolArray], passes: int) -> Events:
    paths = search.turned(acting, paths)
    acting, score = search.fitted(acting, paths, passes)
    return Events(search, acting, paths, score)


def turns(view: View, port: int) -> list[list[BoolArray]]:
    """Return where a force may turn its sign, by trial (N,): nowhere, or with the speed of its port."""
    never = [np.zeros(len(trial.time), dtype=bool) for trial in view.trials]
    turning = []
    for trial, motion in zip(view.trials, view.motions, strict=False):  # of readings alone nothing moves
        speed = motion.speeds[:: trial.parts, port]
        turning.append(np.r_[False, np.diff(speed > 0.0)])
    return [never, turning] if any(flips.any() for flips in turning) else [never]
