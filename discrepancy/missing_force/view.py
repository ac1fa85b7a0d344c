"""The missing forces of all trials: their processes, their courses, and the motion beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from discrepancy.campaign.records import FloatArray

from .filtered import Filtered, Process, Regression, Solution, local_solution, regression
from .trial import SeenTrial

Processes = Mapping[int, Process]
"""Missing forces by the numbers of their ports."""

SIZE_DOUBT, TIME_DOUBT = 3.0, 1.2
"""Prior deviations of the logarithms of a process's size and correlation time."""
DOUBTS = np.array([SIZE_DOUBT, TIME_DOUBT])
UNSOUND = -1e12
"""Evidence of forces under which variances are lost to rounding [nat]."""
AT_TOP = {"eps": 2e-3, "ftol": 1e-6, "gtol": 0.05, "maxiter": 12}
"""Of the descent: difference of logarithms by which slopes are found, and where it ends."""
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
        return [Filtered(trial, processes) for trial in self.trials]

    def products(self, processes: Processes) -> Regression:
        """Return the products of all columns beside missing forces."""
        return regression(self.filtered(processes), self.residuals, self.columns)

    def solve(self, processes: Processes) -> Solution:
        """Return evidence and values of all unknowns beside missing forces."""
        return self.products(processes).solve(range(len(self.precisions)), self.precisions)

    def most_probable(
        self, about: Processes, begins: Sequence[Processes]
    ) -> tuple[dict[int, Process], float]:
        """Return the processes of the largest evidence times their prior, and its logarithm [nat].

        Parameters
        ----------
        about : mapping of int to Process
            Medians of the prior.
        begins : sequence of mapping of int to Process
            From each of which they are looked for.
        """
        first = begins[0]
        median = np.log([(about[port].size, about[port].time) for port in first])
        low, high = median - FARTHEST * DOUBTS, median + FARTHEST * DOUBTS
        low[:, 1], high[:, 1] = np.clip((low[:, 1], high[:, 1]), *np.log(self.times))

        def at(logs: FloatArray) -> dict[int, Process]:
            items = zip(first.items(), np.exp(logs.reshape(median.shape)).tolist(), strict=True)
            return {port: replace(one, size=size, time=time) for (port, one), (size, time) in items}

        def lack(logs: FloatArray) -> float:
            return -self.evidence(about, at(logs))

        pairs = ([(begin[port].size, begin[port].time) for port in first] for begin in begins)
        bounds = list(zip(low.ravel(), high.ravel(), strict=True))
        how = {"method": "L-BFGS-B", "bounds": bounds, "options": AT_TOP}
        tops = [minimize(lack, np.clip(np.log(pair), low, high).ravel(), **how) for pair in pairs]
        best = min(tops, key=lambda top: float(top.fun))
        return at(best.x), -float(best.fun)

    @cached_property
    def times(self) -> tuple[float, float]:
        """Shortest and longest correlation time [s]: that of a sample, and that of a record."""
        stamps = [trial.time for trial in self.trials]
        return min(float(np.median(np.diff(t))) for t in stamps), max(float(t[-1] - t[0]) for t in stamps)

    def evidence(self, about: Processes, processes: Processes) -> float:
        """Return the evidence of processes times their prior, as a logarithm [nat]."""
        away = [
            (np.log(one.size / about[port].size), np.log(one.time / about[port].time)) / DOUBTS
            for port, one in processes.items()
        ]
        filters = self.filtered(processes)
        if not all(one.is_sound for one in filters):
            return UNSOUND
        products = regression(filters, self.residuals, self.columns)
        value = products.solve(range(len(self.precisions)), self.precisions).evidence
        return float(value - 0.5 * np.sum(np.square(away)))

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
            values = np.zeros(0)
            if len(trial.local):
                whole = one.whitened(np.concatenate((left[None], trial.local)))
                values = local_solution(whole[:, :1], whole[:, 1:], trial.local_precision)[0][:, 0]
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
