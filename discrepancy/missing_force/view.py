"""The missing force at one port over all trials: its process, its course, and the motion beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from discrepancy.fits.linearisation import Point

from .filtered import Filtered, Process
from .regression import Regression, Solution, local_solution, regression
from .trial import SeenTrial

FloatArray = NDArray[np.float64]

SIZE_DOUBT, TIME_DOUBT = 3.0, 1.2
"""Prior deviations of the logarithms of a process's size and correlation time."""
SHARES = (1.0, 0.03)
"""Sizes from which the most probable process is looked for: what is left beside a law is a part of it."""
MOST_PASSES = 30


@dataclass(frozen=True, eq=False)
class Motion:
    """What was in a trial, at the fine stamps: the added state (F, n) and the missing force (F,)."""

    added: FloatArray
    force: FloatArray


@dataclass(frozen=True, eq=False)
class Part:
    """What an effect does in a trial for a unit of its unknown.

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


@dataclass(frozen=True, eq=False)
class Column:
    """An effect as a column.

    Attributes
    ----------
    parts : sequence of Part
        By trial.
    precision : float
        Prior precision of its unknown.
    both_signs : bool
        Whether that may be negative.
    """

    parts: Sequence[Part]
    precision: float
    both_signs: bool = True


@dataclass(frozen=True, eq=False)
class View:
    """A port at which a force may be missing, and laws that may be a part of it.

    Attributes
    ----------
    trials : sequence of SeenTrial
        All that are fitted.
    port : int
        Number of the port.
    shared_precision : (K,) ndarray
        Prior precision of the shared unknowns.
    motions : sequence of Motion
        By trial, along which laws and parameters act; empty: that of the model.
    effects : sequence of Column
        What may be a part of it, each in proportion to one more unknown.
    certain : sequence of Column
        What is known to act, as it is.
    """

    trials: Sequence[SeenTrial]
    port: int
    shared_precision: FloatArray
    motions: Sequence[Motion] = ()
    effects: Sequence[Column] = ()
    certain: Sequence[Column] = ()

    @cached_property
    def precision(self) -> FloatArray:
        """Prior precision of all unknowns, those of the effects last."""
        return np.concatenate((self.shared_precision, [item.precision for item in self.effects]))

    @cached_property
    def turned(self) -> list[list[FloatArray | None]]:
        """State (F, n) that each shared unknown makes of the added one, by trial."""
        if not self.motions:
            return [[None] * len(trial.slopes) for trial in self.trials]
        return [
            [
                None if slope is None or not np.any(slope) else trial.turned(slope, motion.added)
                for slope in trial.slopes
            ]
            for trial, motion in zip(self.trials, self.motions, strict=True)
        ]

    @cached_property
    def columns(self) -> list[FloatArray]:
        """What all unknowns do to the readings (K, N, C), by trial."""
        found = []
        for number, trial in enumerate(self.trials):
            columns = trial.shared.copy()
            for k, state in enumerate(self.turned[number]):
                if state is not None:
                    columns[k] += trial.readings(state)
            effects = [item.parts[number].readings[None] for item in self.effects]
            found.append(np.concatenate((columns, *effects)))
        return found

    @cached_property
    def residuals(self) -> list[FloatArray]:
        """Residuals (N, C) beside what is certain, by trial; the systems are those of their points."""
        found = []
        for number, trial in enumerate(self.trials):
            left = trial.residual - sum(item.parts[number].readings for item in self.certain)
            for value, state in zip(trial.about, self.turned[number], strict=False):
                if state is not None:
                    left = left + value * trial.readings(state)
            found.append(np.asarray(left))
        return found

    def filtered(self, process: Process) -> list[Filtered]:
        """Return the filters of a process."""
        return [Filtered(trial, self.port, process) for trial in self.trials]

    def products(self, process: Process) -> Regression:
        """Return the products of all columns beside a process."""
        return regression(self.filtered(process), self.residuals, self.columns)

    def solve(self, process: Process) -> Solution:
        """Return evidence and values of all unknowns beside a process."""
        return self.products(process).solve(range(len(self.precision)), self.precision)

    def most_probable(self, about: Process, shares: Sequence[float] = SHARES) -> tuple[Process, float]:
        """Return the process of the largest evidence times its prior about one, and its logarithm [nat].

        It is looked for from each of some shares of the size.
        """

        def objective(logs: FloatArray) -> float:
            size, time = np.exp(np.clip(logs, -12.0, 12.0))
            value = self.solve(replace(about, size=about.size * size, time=about.time * time)).evidence
            return float(0.5 * (logs[0] / SIZE_DOUBT) ** 2 + 0.5 * (logs[1] / TIME_DOUBT) ** 2 - value)

        best, least = np.zeros(2), np.inf
        for share in shares:
            first = np.array([np.log(share), 0.0])
            simplex = first + np.array([[0.0, 0.0], [0.9, 0.0], [0.0, 0.7]])
            options = {"xatol": 0.05, "fatol": 0.2, "maxfev": MOST_PASSES, "initial_simplex": simplex}
            found = minimize(objective, first, method="Nelder-Mead", options=options)
            if found.fun < least:
                best, least = found.x, float(found.fun)
        size, time = np.exp(best)
        return replace(about, size=about.size * size, time=about.time * time), -least

    def smoothed(self, process: Process) -> tuple[Solution, list[FloatArray], list[Motion]]:
        """Return the unknowns, those of the trials alone, and motion and missing force of each trial."""
        solution = self.solve(process)
        motions, local = [], []
        for number, one in enumerate(self.filtered(process)):
            trial = one.trial
            left = self.residuals[number] - np.tensordot(solution.mean, self.columns[number], 1)
            if len(trial.local):
                whole = one.whitened(np.concatenate((left[None], trial.local)))
                values = local_solution(whole[:, :1], whole[:, 1:], trial.local_precision)[0][:, 0]
                left = left - np.tensordot(values, trial.local, 1)
            else:
                values = np.zeros(0)
            added, force = one.smoothed(left)
            count = len(trial.slopes)
            about = trial.about if len(trial.about) else np.zeros(count)
            for off, state in zip(solution.mean[:count] - about, self.turned[number], strict=True):
                if state is not None:
                    added = added + off * state
            weights = (*solution.mean[count:], *(1.0 for _ in self.certain))
            for mean, item in zip(weights, (*self.effects, *self.certain), strict=True):
                part = item.parts[number]
                if part.added is not None:
                    added = added + mean * part.added
                if self.port in part.forces and item not in self.certain:
                    force = force + mean * part.forces[self.port]
            motions.append(Motion(added, force))
            local.append(values)
        return solution, local, motions

    def point(self, solution: Solution, local: Sequence[FloatArray], effect: FloatArray) -> Point:
        """Return the point of a solution, to be linear about."""
        return Point(solution.mean[: len(self.shared_precision)], tuple(local), effect)
