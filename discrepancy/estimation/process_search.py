"""The most probable amplitudes and correlation times of missing forces, by Newton's method.

The amplitude of a missing force is its standard deviation as a random process.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from discrepancy.campaign.records import FloatArray
from reporting.arrays import LEAST_DIVISOR

from .force_states import Process

Processes = Mapping[int, Process]
"""Missing forces as processes, by the index of the port."""

PRIOR_LOG_DEVIATION_OF_AMPLITUDE, PRIOR_LOG_DEVIATION_OF_TIME = 3.0, 1.2
"""Prior standard deviations of the logarithms of amplitude and correlation time of a process. They
allow factors of about 20 in amplitude and 3 in time."""
PRIOR_LOG_DEVIATIONS = np.array((PRIOR_LOG_DEVIATION_OF_AMPLITUDE, PRIOR_LOG_DEVIATION_OF_TIME))
"""Both of these deviations, as an array."""
LOG_FACTORS_OF_GRID = np.log(list(product((10.0, 1.0, 0.1, 0.01), (0.3, 1.0, 3.0, 10.0))))
"""Logarithms of the factors on amplitude and time that make the grid around the given processes.
Small amplitudes are in it, as a law may explain most of the force."""
LARGEST_DISTANCE = 5.0
"""Bound of the search, in prior standard deviations from the median."""
DIFFERENCE = 0.02
"""Difference of the logarithms in numerical derivatives."""
LONGEST_STEP, SHORTEST_STEP = 1.5, 1e-4
"""Longest and shortest step of Newton's method that is taken, as a difference of logarithms."""
MOST_STEPS = 20
"""Largest number of steps of Newton's method."""


def prior_log_density(median_processes: Processes, processes: Processes) -> float:
    """Return the log prior density of missing forces [nat], up to a constant.

    The amplitude and the correlation time of a missing force are independent and log-normal.

    Parameters
    ----------
    median_processes : mapping of int to Process
        The prior medians, by the index of the port.
    processes : mapping of int to Process
        The missing forces as random processes, by the index of the port.
    """
    log_ratios = np.log(
        [_ratios_to_median(process, median_processes[port]) for port, process in processes.items()]
    )
    return -0.5 * float(np.sum(np.square(log_ratios / PRIOR_LOG_DEVIATIONS)))


def _ratios_to_median(process: Process, median_process: Process) -> tuple[float, float]:
    """Return amplitude and correlation time of a process over those of its prior median."""
    return (
        process.standard_deviation / median_process.standard_deviation,
        process.correlation_time / median_process.correlation_time,
    )


_TIME = 1
"""Column of the correlation times in the result of `logarithms`."""


@dataclass(frozen=True, eq=False)
class ProcessSearch:
    """The search for the most probable amplitudes and correlation times of P missing forces.

    It is Newton's method on their logarithms (P, 2), with numerical derivatives and within bounds.

    Attributes
    ----------
    log_evidence : callable
        The function that takes processes by port, and returns the log of evidence times prior
        [nat].
    initial : mapping of int to Process
        The processes to begin with; only their amplitudes and times are changed.
    low, high : (P, 2) ndarray
        The bounds of the logarithms of amplitude and time.
    """

    log_evidence: Callable[[dict[int, Process]], float]
    initial: Processes
    low: FloatArray
    high: FloatArray

    @classmethod
    def within_prior(
        cls,
        log_evidence: Callable[[dict[int, Process]], float],
        median_processes: Processes,
        initial_processes: Processes,
        time_range: tuple[float, float],
    ) -> "ProcessSearch":
        """Return a search within `LARGEST_DISTANCE` prior deviations of the medians.

        Parameters
        ----------
        log_evidence : callable
            The function that takes processes by port, and returns the log of evidence times prior
            [nat].
        median_processes : mapping of int to Process
            The prior medians, by the index of the port.
        initial_processes : mapping of int to Process
            The processes to begin with.
        time_range : (float, float)
            The shortest and the longest correlation time that the records can show [s].
        """
        log_medians = logarithms({port: median_processes[port] for port in initial_processes})
        low = log_medians - LARGEST_DISTANCE * PRIOR_LOG_DEVIATIONS
        high = log_medians + LARGEST_DISTANCE * PRIOR_LOG_DEVIATIONS
        log_shortest, log_longest = np.log(time_range)
        low[:, _TIME] = np.clip(low[:, _TIME], log_shortest, log_longest)
        high[:, _TIME] = np.clip(high[:, _TIME], log_shortest, log_longest)
        return cls(log_evidence, initial_processes, low, high)

    def processes(self, log_values: FloatArray) -> dict[int, Process]:
        """Return the processes, given the logarithms (P, 2) of their amplitudes and times."""
        values = np.exp(log_values).tolist()
        return {
            port: replace(process, standard_deviation=amplitude, correlation_time=time)
            for (port, process), (amplitude, time) in zip(self.initial.items(), values, strict=True)
        }

    def log_posterior(self, log_values: FloatArray) -> float:
        """Return the log of evidence times prior at log amplitudes and times (P, 2) [nat]."""
        return self.log_evidence(self.processes(log_values))

    def most_probable(
        self, *, from_grid: bool, most_steps: int
    ) -> tuple[dict[int, Process], float]:
        """Return the most probable processes, and their log of evidence times prior [nat].

        Parameters
        ----------
        from_grid : bool
            Whether to begin at the best point of a grid around `initial`, not at `initial` itself.
        most_steps : int
            The largest number of steps of Newton's method.
        """
        log_values = np.clip(logarithms(self.initial), self.low, self.high)
        if from_grid:
            log_values = self._best_of_grid(log_values)
        log_values, value = self._climb(log_values, most_steps)
        return self.processes(log_values), value

    def _best_of_grid(self, log_values: FloatArray) -> FloatArray:
        """Return the point (P, 2) with the highest log posterior on a grid about a given point.

        The grid of each port is searched in turn, with the other ports at their best values so far.
        """
        for port in range(len(log_values)):
            candidates = []
            for log_factors in LOG_FACTORS_OF_GRID:
                candidate = log_values.copy()
                candidate[port] += log_factors
                candidates.append(np.clip(candidate, self.low, self.high))
            log_values = max(candidates, key=self.log_posterior)
        return log_values

    def _climb(self, log_values: FloatArray, most_steps: int) -> tuple[FloatArray, float]:
        """Return the point (P, 2) that Newton's method reaches, and the log posterior there [nat].

        `most_steps` should be large enough to reach the maximum: before it, the result depends on
        rounding errors.
        """
        value = self.log_posterior(log_values)
        offsets = DIFFERENCE * np.eye(log_values.size).reshape(-1, *log_values.shape)
        curvature = np.empty((log_values.size, log_values.size))
        last_change = np.inf
        for _ in range(most_steps):
            values_above = np.array([self.log_posterior(log_values + offset) for offset in offsets])
            values_below = np.array([self.log_posterior(log_values - offset) for offset in offsets])
            # near the maximum the last curvature is accurate enough
            if last_change > DIFFERENCE:
                curvature = self._curvature(log_values, value, values_above, values_below)
            if not np.isfinite((*curvature.flat, *values_above, *values_below)).all():
                break
            # slope and curvature are both multiplied by DIFFERENCE ** 2, which cancels in the step
            step = self._newton_step(
                log_values, 0.5 * DIFFERENCE * (values_above - values_below), curvature
            )
            next_log_values, next_value = self._backtrack(log_values, value, step)
            if next_value < value:
                break
            last_change = np.abs(next_log_values - log_values).max()
            log_values, value = next_log_values, next_value
        return log_values, value

    def _curvature(
        self,
        log_values: FloatArray,
        value: float,
        values_above: FloatArray,
        values_below: FloatArray,
    ) -> FloatArray:
        """Return the second differences (2 P, 2 P) of the log posterior.

        They are the second derivatives, multiplied by `DIFFERENCE` squared. `value` is the log
        posterior at the point; `values_above` and `values_below` (2 P,) are those with one
        logarithm `DIFFERENCE` larger, or smaller.
        """
        # step i enlarges logarithm i alone
        steps = DIFFERENCE * np.eye(log_values.size).reshape(-1, *log_values.shape)
        # on the diagonal: central differences
        curvature = np.diag(values_above + values_below - 2.0 * value)
        # off the diagonal: forward differences in both logarithms
        for i in range(log_values.size):
            for k in range(i + 1, log_values.size):
                value_with_both_larger = self.log_posterior(log_values + steps[i] + steps[k])
                mixed_difference = (
                    value_with_both_larger - values_above[i] - values_above[k] + value
                )
                curvature[i, k] = mixed_difference
                curvature[k, i] = mixed_difference
        return curvature

    def _newton_step(
        self, log_values: FloatArray, slope: FloatArray, curvature: FloatArray
    ) -> FloatArray:
        """Return a step (P, 2) of Newton's method uphill, at most `LONGEST_STEP` in each logarithm.

        A logarithm at its bound stays there if the log posterior rises beyond the bound. `slope`
        (2 P,) and `curvature` are the first and second derivatives, times `DIFFERENCE` squared.
        """
        may_rise = np.ravel(log_values < self.high)
        may_fall = np.ravel(log_values > self.low)
        free_axes = np.flatnonzero(np.where(slope > 0.0, may_rise, may_fall))
        eigenvalues, eigenvectors = np.linalg.eigh(curvature[np.ix_(free_axes, free_axes)])
        # magnitudes of the eigenvalues: the step leads uphill where the value is convex, too
        step = np.zeros(log_values.size)
        step[free_axes] = eigenvectors @ (
            eigenvectors.T @ slope[free_axes] / np.maximum(np.abs(eigenvalues), LEAST_DIVISOR)
        )
        length_ratio = max(1.0, float(np.abs(step).max()) / LONGEST_STEP)
        return np.asarray(step.reshape(log_values.shape) / length_ratio)

    def _backtrack(
        self, log_values: FloatArray, value: float, step: FloatArray
    ) -> tuple[FloatArray, float]:
        """Return the point (P, 2) after a step, halved until the log posterior is not lower there.

        The log posterior at this point is returned, too. It is below `value`, that before the step,
        if the step became shorter than `SHORTEST_STEP` first.
        """
        next_log_values, next_value = log_values, -np.inf
        while next_value < value and np.abs(step).max() > SHORTEST_STEP:
            next_log_values = np.clip(log_values + step, self.low, self.high)
            next_value = self.log_posterior(next_log_values)
            step = 0.5 * step
        return next_log_values, next_value


def logarithms(processes: Processes) -> FloatArray:
    """Return the logarithms (P, 2) of the amplitudes and correlation times of processes."""
    return np.log(
        [(process.standard_deviation, process.correlation_time) for process in processes.values()]
    )


def scale_processes(
    processes: Processes, amplitude_factor: float, time_factor: float
) -> dict[int, Process]:
    """Return processes with all amplitudes and all correlation times multiplied by a factor."""
    scaled_processes = {}
    for port, process in processes.items():
        scaled_processes[port] = replace(
            process,
            standard_deviation=process.standard_deviation * amplitude_factor,
            correlation_time=process.correlation_time * time_factor,
        )
    return scaled_processes


def processes_within_range(
    processes: Processes, time_range: tuple[float, float]
) -> dict[int, Process]:
    """Return processes whose correlation times are clipped to a range [s].

    The records cannot show longer or shorter ones.
    """
    shortest, longest = time_range
    return {
        port: replace(
            process, correlation_time=min(max(process.correlation_time, shortest), longest)
        )
        for port, process in processes.items()
    }
