"""The missing forces of all trials: their processes, their courses, and the motion beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import FloatArray

from .filtered import LEAST_PRECISION, Filtered, Process, Regression, Solution, regression
from .trial import SeenTrial

Processes = Mapping[int, Process]
"""Missing forces by the numbers of their ports."""

SIZE_DOUBT, TIME_DOUBT = 3.0, 1.2
"""Prior deviations of the logarithms of a process's size and correlation time."""
SHARES = (1.0, 0.03)
"""Sizes from which the most probable process is looked for: what is left beside a law is a part of it."""
MOST_PASSES = 30
NEAR, LONGEST, AT_TOP, MOST_STEPS = 0.02, 0.7, 1e-4, 8
"""Of Newton's method: difference of logarithms by which slopes are found, the longest step that is taken,
that after which the top is reached, and how many are taken."""
FARTHEST = 5.0
"""Prior deviations from which on a process is not looked at."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What was in a trial, at the fine stamps.

    Attributes
    ----------
    added : (F, n) ndarray
        State that it adds to the model's own.
    forces : mapping of int to (F,) ndarray
        The missing force of each port, laws of the hypothesis included.
    left : mapping of int to (F,) ndarray
        What no law of the hypothesis is of it.
    explained : (F, n) ndarray
        State that parameters and laws add: without what is left.
    positions, speeds : (F, P) ndarray
        Of the ports.
    speed_deviations : mapping of int to float
        How well the speeds of ports of missing forces are known.
    """

    added: FloatArray
    forces: Mapping[int, FloatArray]
    left: Mapping[int, FloatArray]
    explained: FloatArray
    positions: FloatArray
    speeds: FloatArray
    speed_deviations: Mapping[int, float]

    def part(self, at: slice) -> "Motion":
        """Return the motion at some of the fine stamps."""
        forces, left = ({port: item[at] for port, item in of.items()} for of in (self.forces, self.left))
        return replace(
            self, added=self.added[at], forces=forces, left=left, explained=self.explained[at],
            positions=self.positions[at], speeds=self.speeds[at],
        )  # fmt: skip

    @property
    def laws(self) -> dict[int, FloatArray]:
        """Forces of the hypothesis (F,) by port."""
        return {port: force - self.left.get(port, 0.0) for port, force in self.forces.items()}


@dataclass(frozen=True, eq=False)
class Part:
    """What an effect does in a trial, for a unit of its unknown.

    Attributes
    ----------
    readings : (N, C) ndarray
        Over the noise's deviations.
    added : (F, n) ndarray or None
        State that it adds.
    forces : mapping of int to (F,) ndarray
        Its force at ports, by their numbers.
    """

    readings: FloatArray
    added: FloatArray | None = None
    forces: Mapping[int, FloatArray] = field(default_factory=dict)

    def plus(self, other: "Part", factor: float) -> "Part":
        """Return the sum with another part that is taken `factor` times."""
        added = [item * part.added for item, part in ((1.0, self), (factor, other)) if part.added is not None]
        forces = dict(self.forces)
        for port, force in other.forces.items():
            forces[port] = forces.get(port, 0.0) + factor * force
        readings = self.readings + factor * other.readings
        return Part(readings, sum(added[1:], added[0]) if added else None, forces)


class Turned(NamedTuple):
    """What a unit of a shared unknown makes of the added state: readings (N, C), and state (F, n) if it does.

    It is linear about a value of the unknown.
    """

    readings: FloatArray
    about: float
    state: FloatArray | float = 0.0


Column = Sequence[Part]
"""An effect, by trial."""


def combined(columns: Sequence[Column], factors: Sequence[float]) -> Column:
    """Return the sum of columns, each taken a number of times."""
    first, *others = columns
    found = [Part(np.zeros_like(part.readings)).plus(part, factors[0]) for part in first]
    for column, factor in zip(others, factors[1:], strict=True):
        found = [part.plus(other, factor) for part, other in zip(found, column, strict=True)]
    return found


@dataclass(frozen=True, eq=False)
class View:
    """Trials with what may act in them.

    Attributes
    ----------
    trials : sequence of SeenTrial
        All that are looked at.
    shared_precision : (K,) ndarray
        Prior precision of the shared unknowns.
    motions : sequence of Motion
        By trial, along which laws and parameters act; empty: that of the model.
    effects : sequence of Column
        What acts in proportion to one more unknown each.
    precision : sequence of float
        Prior precision of these unknowns.
    known : Column or None
        What the hypothesis has beside them.
    own : Column or None
        What the model has beside its linear system.
    """

    trials: Sequence[SeenTrial]
    shared_precision: FloatArray
    motions: Sequence[Motion] = ()
    effects: Sequence[Column] = ()
    precision: Sequence[float] = ()
    known: Column | None = None
    own: Column | None = None

    @cached_property
    def precisions(self) -> FloatArray:
        """Prior precision of all unknowns, those of the effects last."""
        return np.concatenate((self.shared_precision, self.precision))

    @cached_property
    def turned(self) -> list[dict[int, Turned]]:
        """What shared unknowns, by their numbers, make of the added state, by trial."""
        found: list[dict[int, Turned]] = [{} for _ in self.trials]
        for trial, motion, of_trial in zip(self.trials, self.motions, found, strict=False):
            for k, slope in enumerate(trial.slopes):
                if slope is not None:
                    state, readings = trial.turned(slope, motion.added, motion.forces)
                    of_trial[k] = Turned(readings, float(trial.about[k]), state)
            shown = trial.readings(motion.added, motion.forces)
            for k, channel, scale in trial.gains:
                alone = scale * np.eye(shown.shape[1])[channel]
                of_trial[k] = Turned(shown * alone, float(trial.about[k]))
        return found

    @cached_property
    def columns(self) -> list[FloatArray]:
        """What all unknowns do to the readings (K, N, C), by trial."""
        found = []
        for number, trial in enumerate(self.trials):
            effects = [item[number].readings for item in self.effects]
            columns = (
                np.moveaxis(np.stack([*trial.shared, *effects], axis=-1), -1, 0)
                if len(trial.shared) + len(effects)
                else np.zeros((0, *trial.residual.shape))
            )
            for k, turned in self.turned[number].items():
                columns[k] += turned.readings
            found.append(columns)
        return found

    @cached_property
    def residuals(self) -> list[FloatArray]:
        """Residuals (N, C) beside what is known, by trial."""
        known = [item for item in (self.known, self.own) if item is not None]
        found = []
        for number, trial in enumerate(self.trials):
            left = trial.residual - sum(
                (item[number].readings for item in known), np.zeros_like(trial.residual)
            )
            for turned in self.turned[number].values():
                left = left + turned.about * turned.readings
            found.append(left)
        return found

    def filtered(self, processes: Processes) -> list[Filtered]:
        """Return the filters of missing forces."""
        return [Filtered(trial, tuple(processes.items())) for trial in self.trials]

    def products(self, processes: Processes) -> Regression:
        """Return the products of all columns beside missing forces."""
        return regression(self.filtered(processes), self.residuals, self.columns)

    def solve(self, processes: Processes) -> Solution:
        """Return evidence and values of all unknowns beside missing forces."""
        return self.products(processes).solve(range(len(self.precisions)), self.precisions)

    def most_probable(
        self, about: Processes, begins: Sequence[Processes], shares: Sequence[float] = SHARES
    ) -> tuple[dict[int, Process], float]:
        """Return the processes of the largest evidence times their prior, and its logarithm [nat].

        Parameters
        ----------
        about : mapping of int to Process
            Medians of the prior.
        begins : sequence of mapping of int to Process
            From each of which they are looked for, port after port, and from some shares of their sizes; with
            no share from what is near alone.
        """
        climbs = []
        for begin in begins:
            found, greatest = dict(begin), -np.inf
            for _ in range(min(len(begin), 2)):
                for port in begin:
                    first = np.log((found[port].size, found[port].time))
                    for share in shares:
                        best, value = self._climbed(
                            about, found, port, first + np.array([np.log(share), 0.0])
                        )
                        if value > greatest:
                            found, greatest = best, value
            climbs.append((greatest, found))
        return self._settled(about, max(climbs, key=lambda item: item[0])[1])

    @np.errstate(invalid="ignore")
    def _settled(self, about: Processes, begin: Processes) -> tuple[dict[int, Process], float]:
        """Return the processes at the top near some, and the logarithm there [nat], by Newton's method.

        Where a climb ends a rounding decides; the top does not depend on it.
        """
        first = np.log([(one.size, one.time) for one in begin.values()])
        unit, logs, far = NEAR * np.eye(first.size), np.zeros(first.size), np.inf

        def at(move: FloatArray) -> dict[int, Process]:
            items = zip(begin.items(), np.exp(first + move.reshape(first.shape)).tolist(), strict=True)
            return {port: replace(one, size=size, time=time) for (port, one), (size, time) in items}

        for _ in range(MOST_STEPS):
            ahead, back = (
                np.array([self.evidence(about, at(logs + step)) for step in steps]) for steps in (unit, -unit)
            )
            if far > NEAR:
                top = self.evidence(about, at(logs))
                bend = np.diag(ahead + back - 2.0 * top)
                for i, k in zip(*np.triu_indices(first.size, 1), strict=True):
                    both = self.evidence(about, at(logs + unit[i] + unit[k]))
                    bend[i, k] = bend[k, i] = both - ahead[i] - ahead[k] + top
            if not np.isfinite((*bend.flat, *ahead, *back)).all():
                break
            values, axes = np.linalg.eigh(bend)  # uphill where it is hollow, too
            step = axes @ (axes.T @ (0.5 * NEAR * (ahead - back)) / np.maximum(np.abs(values), 1e-300))
            far = np.abs(step).max()
            logs = logs + step / max(1.0, far / LONGEST)
            if far < AT_TOP:
                break
        ends = ((item, self.evidence(about, item)) for item in (dict(begin), at(logs)))
        return max(ends, key=lambda item: item[1])

    @cached_property
    def times(self) -> tuple[float, float]:
        """Shortest and longest correlation time [s]: that of a sample, and that of a record."""
        stamps = [trial.time for trial in self.trials]
        return min(float(np.median(np.diff(t))) for t in stamps), max(float(t[-1] - t[0]) for t in stamps)

    def evidence(self, about: Processes, processes: Processes) -> float:
        """Return the evidence of processes times their prior, as a logarithm [nat]."""
        away = [
            (
                np.log(one.size / about[port].size) / SIZE_DOUBT,
                np.log(one.time / about[port].time) / TIME_DOUBT,
            )
            for port, one in processes.items()
        ]
        shortest, longest = self.times
        outside = any(not shortest <= one.time <= longest for one in processes.values())
        if outside or np.abs(away).max() > FARTHEST:
            return -np.inf
        filters = self.filtered(processes)
        if not all(one.is_sound for one in filters):
            return -np.inf
        products = regression(filters, self.residuals, self.columns)
        value = products.solve(range(len(self.precisions)), self.precisions).evidence
        return float(value - 0.5 * np.sum(np.square(away)))

    def _climbed(
        self, about: Processes, processes: Processes, port: int, first: FloatArray
    ) -> tuple[dict[int, Process], float]:
        """Return processes with that of a port at its most probable, from logarithms of size and time."""

        def at(logs: FloatArray) -> dict[int, Process]:
            size, time = np.exp(logs)
            return {**processes, port: replace(processes[port], size=float(size), time=float(time))}

        low, high = np.log(self.times)
        first = np.array([first[0], np.clip(first[1], low, high - 0.7)])
        simplex = first + np.array([[0.0, 0.0], [0.9, 0.0], [0.0, 0.7]])
        options = {"xatol": 0.2, "fatol": 1.0, "maxfev": MOST_PASSES, "initial_simplex": simplex}
        found = minimize(
            lambda logs: -self.evidence(about, at(logs)), first, method="Nelder-Mead", options=options
        )
        return at(found.x), -float(found.fun)

    def smoothed(
        self, processes: Processes, given: Solution | None = None
    ) -> tuple[Solution, list[FloatArray], list[Motion]]:
        """Return the unknowns, those of the trials alone, and motion and missing forces of each trial."""
        solution = given or self.solve(processes)
        motions, local = [], []
        count = len(self.shared_precision)
        for number, one in enumerate(self.filtered(processes)):
            trial = one.trial
            left = self.residuals[number] - np.tensordot(solution.mean, self.columns[number], 1)
            whole = one.whitened(np.concatenate((left[None], trial.local)))
            shown, own = whole[:, 0], whole[:, 1:].T
            prior = np.diag(np.maximum(trial.local_precision, LEAST_PRECISION))
            values = np.linalg.solve(own @ own.T + prior, own @ shown)
            left = left - np.tensordot(values, trial.local, 1)
            free, forces = one.smoothed(left)
            added = free.copy()
            for k, turned in self.turned[number].items():
                added = added + (solution.mean[k] - turned.about) * turned.state
            remaining = dict(zip(processes, forces, strict=True))
            what = Part(left, added, remaining)
            for mean, item in zip(solution.mean[count:], self.effects, strict=True):
                what = what.plus(item[number], float(mean))
            what = what if self.known is None else what.plus(self.known[number], 1.0)
            moved = what if self.own is None else what.plus(self.own[number], 1.0)
            assert moved.added is not None
            moving = trial.port_motion(np.concatenate((solution.mean[:count], values)), moved.added)
            doubts = {port: one.speed_deviation(port) for port in processes}
            motions.append(Motion(moved.added, what.forces, remaining, moved.added - free, *moving, doubts))
            local.append(values)
        return solution, local, motions
