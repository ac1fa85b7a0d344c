"""The most probable sizes and correlation times of missing forces, by Newton's method."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from discrepancy.campaign.records import FloatArray

from .filtered import Process

Processes = Mapping[int, Process]
"""Missing forces by the numbers of their ports."""

SIZE_DEVIATION, TIME_DEVIATION = 3.0, 1.2
"""Prior deviations of the logarithms of a process's size and correlation time."""
PRIOR_DEVIATIONS = np.array((SIZE_DEVIATION, TIME_DEVIATION))
START_FACTORS = np.log(list(product((10.0, 1.0, 0.1, 0.01), (0.3, 1.0, 3.0, 10.0))))
"""Logarithms of factors of sizes and times, at the best of which Newton's method begins: what
remains beside a law is a part of what was missing."""
FARTHEST = 5.0
"""Prior deviations from the median within which processes are looked for."""
DIFFERENCE = 0.02
"""Difference of logarithms by which slopes are found."""
LONGEST_STEP, SHORTEST_STEP = 1.5, 1e-4
"""Steps of Newton's method that are taken, as differences of logarithms."""
MOST_STEPS = 20
"""Steps of Newton's method, at most."""


def prior_log_density(median: Processes, processes: Processes) -> float:
    """Return the logarithm of the prior density of processes [nat], up to a constant."""
    ratios = np.log([_values_over(process, median[port]) for port, process in processes.items()])
    return -0.5 * float(np.sum(np.square(ratios / PRIOR_DEVIATIONS)))


def _values_over(process: Process, median: Process) -> tuple[float, float]:
    """Return size and time of a process over those of another."""
    return process.size / median.size, process.time / median.time


@dataclass(frozen=True, eq=False)
class ProcessSearch:
    """The logarithms of sizes and times of P missing forces, and the evidence as their function.

    Attributes
    ----------
    log_evidence : callable
        Takes processes by port; returns the logarithm of evidence times prior [nat].
    begin : mapping of int to Process
        The processes to begin with; what is no size or time stays as it is in them.
    low, high : (P, 2) ndarray
        Bounds of the logarithms.
    """

    log_evidence: Callable[[dict[int, Process]], float]
    begin: Processes
    low: FloatArray
    high: FloatArray

    @classmethod
    def around(
        cls,
        log_evidence: Callable[[dict[int, Process]], float],
        median: Processes,
        begin: Processes,
        time_range: tuple[float, float],
    ) -> "ProcessSearch":
        """Return the search within `FARTHEST` prior deviations, and times within a range [s]."""
        center = logarithms({port: median[port] for port in begin})
        low = center - FARTHEST * PRIOR_DEVIATIONS
        high = center + FARTHEST * PRIOR_DEVIATIONS
        shortest, longest = np.log(time_range)
        low[:, 1] = np.clip(low[:, 1], shortest, longest)
        high[:, 1] = np.clip(high[:, 1], shortest, longest)
        return cls(log_evidence, begin, low, high)

    def processes(self, logs: FloatArray) -> dict[int, Process]:
        """Return the processes whose sizes and times have logarithms (P, 2)."""
        values = np.exp(logs).tolist()
        return {
            port: replace(process, size=size, time=time)
            for (port, process), (size, time) in zip(self.begin.items(), values, strict=True)
        }

    def value(self, logs: FloatArray) -> float:
        """Return the logarithm of evidence times prior [nat]."""
        return self.log_evidence(self.processes(logs))

    def most_probable(
        self, *, from_grid: bool, most_steps: int
    ) -> tuple[dict[int, Process], float]:
        """Return the most probable processes, and ln (evidence times prior) there [nat]."""
        logs = np.clip(logarithms(self.begin), self.low, self.high)
        if from_grid:
            logs = self._best_of_grid(logs)
        logs, top = self._climbed(logs, most_steps)
        return self.processes(logs), top

    def _best_of_grid(self, logs: FloatArray) -> FloatArray:
        """Return the best of a grid of sizes and times, port after port."""
        for port in range(len(logs)):
            candidates = []
            for factors in START_FACTORS:
                candidate = logs.copy()
                candidate[port] += factors
                candidates.append(np.clip(candidate, self.low, self.high))
            logs = max(candidates, key=self.value)
        return logs

    def _climbed(self, logs: FloatArray, most_steps: int) -> tuple[FloatArray, float]:
        """Return the top that Newton's method reaches, and the value there.

        Where a search ends before the top a rounding decides; the top does not depend on it.
        """
        top = self.value(logs)
        units = DIFFERENCE * np.eye(logs.size).reshape(-1, *logs.shape)
        curvature = np.empty((logs.size, logs.size))
        last_move = np.inf
        for _ in range(most_steps):
            ahead = np.array([self.value(logs + unit) for unit in units])
            back = np.array([self.value(logs - unit) for unit in units])
            if last_move > DIFFERENCE:  # near the top the last curvature is as good
                curvature = self._curvature(logs, top, ahead, back)
            if not np.isfinite((*curvature.flat, *ahead, *back)).all():
                break
            step = self._newton_step(logs, 0.5 * DIFFERENCE * (ahead - back), curvature)
            reached, value = self._uphill(logs, top, step)
            if value < top:
                break
            last_move = np.abs(reached - logs).max()
            logs, top = reached, value
        return logs, top

    def _curvature(
        self, logs: FloatArray, top: float, ahead: FloatArray, back: FloatArray
    ) -> FloatArray:
        """Return second differences (2 P, 2 P), given the values a unit ahead and back."""
        units = DIFFERENCE * np.eye(logs.size).reshape(-1, *logs.shape)
        curvature = np.diag(ahead + back - 2.0 * top)
        for i, k in zip(*np.triu_indices(logs.size, 1), strict=True):
            ahead_of_both = self.value(logs + units[i] + units[k])
            curvature[i, k] = ahead_of_both - ahead[i] - ahead[k] + top
            curvature[k, i] = curvature[i, k]
        return curvature

    def _newton_step(
        self, logs: FloatArray, slope: FloatArray, curvature: FloatArray
    ) -> FloatArray:
        """Return Newton's step (P, 2) within the bounds, uphill also where values are convex."""
        may_rise = np.ravel(logs < self.high)
        may_fall = np.ravel(logs > self.low)
        free = np.flatnonzero(np.where(slope > 0.0, may_rise, may_fall))
        values, axes = np.linalg.eigh(curvature[np.ix_(free, free)])
        step = np.zeros(logs.size)
        step[free] = axes @ (axes.T @ slope[free] / np.maximum(np.abs(values), 1e-300))
        too_long = max(1.0, float(np.abs(step).max()) / LONGEST_STEP)
        return np.asarray(step.reshape(logs.shape) / too_long)

    def _uphill(self, logs: FloatArray, top: float, step: FloatArray) -> tuple[FloatArray, float]:
        """Return where a step leads and the value there; it is halved until it leads uphill."""
        reached, value = logs, -np.inf
        while value < top and np.abs(step).max() > SHORTEST_STEP:
            reached = np.clip(logs + step, self.low, self.high)
            value = self.value(reached)
            step = 0.5 * step
        return reached, value


def logarithms(processes: Processes) -> FloatArray:
    """Return the logarithms (P, 2) of the sizes and times of processes."""
    return np.log([(process.size, process.time) for process in processes.values()])
