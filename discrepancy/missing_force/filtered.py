"""The Kalman filter with missing forces at ports: evidence of columns, and the forces and the motion seen.

A force is a Gaussian process in time of deviation `size` and correlation time `time`: Matern 3/2, two
states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for Signal Processing), or 1/2.
Unknowns that act in proportion follow from what whitened readings and columns share.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.campaign.sampling import IntArray

from . import kalman_kernels as kernels
from .trial import SeenTrial

LATER = 200
"""Samples after which more of them tell nothing of a moment."""


@dataclass(frozen=True)
class Process:
    """The missing force as a process.

    Attributes
    ----------
    size : float
        Deviation [N, N m or the port's flow].
    time : float
        Correlation time [s].
    rough : bool
        Whether it may jump (Matern 1/2), not bend only (3/2).
    """

    size: float
    time: float
    rough: bool = False

    @property
    def generator(self) -> FloatArray:
        """Of its states (1 or 2), the force over `size` first."""
        if self.rough:
            return np.array([[-1.0 / self.time]])
        rate = np.sqrt(3.0) / self.time
        return np.asarray(rate * np.array([[0.0, 1.0], [-1.0, -2.0]]))

    @property
    def intensity(self) -> float:
        """Spectral density of the white noise that drives the last state."""
        return 2.0 / self.time if self.rough else 4.0 * np.sqrt(3.0) / self.time


class Passed(NamedTuple):
    """A pass of the filter over covariances, see `kalman_kernels`."""

    moves: FloatArray
    which: IntArray
    rows: FloatArray
    used: BoolArray
    slot: IntArray
    gains: FloatArray
    sizes: FloatArray


Covered = tuple[Passed, FloatArray, FloatArray]
"""What the other passes take, and predicted and filtered covariances (S, n, n) by slot."""


@dataclass(frozen=True, eq=False)
class Filtered:
    """A trial with missing forces at ports.

    Attributes
    ----------
    trial : SeenTrial
        Which.
    processes : sequence of (int, Process)
        Forces, each with the number of its port; there may be several at one.
    passes : dict
        Passes over covariances by what they depend on: trials of one system and grid share theirs.
    """

    trial: SeenTrial
    processes: Sequence[tuple[int, Process]]
    passes: dict[tuple[bytes, ...], Covered] = field(default_factory=dict)

    @cached_property
    def _scale(self) -> FloatArray:
        """Units (n,) of the state: those of a force of `size` at the frequencies of the system."""
        system = self.trial.system
        n = len(system.generator)
        pace = max(float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)), 1e-9)
        pushes = [np.abs(system.actions[p]).max(initial=0.0) * one.size for p, one in self.processes]
        push = max(*pushes, 1e-300)
        units = np.full(n, push / pace)
        half = n // 2 if 2 * (n // 2) == n else 0
        units[:half] /= pace
        return units

    @cached_property
    def _places(self) -> list[int]:
        """Where each force stands in the whole state."""
        counts = [len(one.generator) for _, one in self.processes]
        begin = len(self.trial.system.generator)
        return [begin + sum(counts[:number]) for number in range(len(counts))]

    @cached_property
    def white(self) -> FloatArray:
        """Deviation (C,) of each channel's noise over that of what is white of it."""
        found = np.ones(len(self.trial.deviation))
        for channel, share, _ in self.trial.coloured:
            found[channel] = 1.0 / np.sqrt(1.0 - share)
        return found

    @cached_property
    def system(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Generator, noise intensity, rows of the readings, covariance at the first sample."""
        trial = self.trial
        n, units, noises = len(trial.system.generator), self._scale, len(trial.coloured)
        begin = n + sum(len(one.generator) for _, one in self.processes)
        whole = begin + noises
        generator, intensity, start = np.zeros((3, whole, whole))
        generator[:n, :n] = trial.system.generator * units / units[:, None]
        rows = np.zeros((len(trial.deviation), whole))
        rows[:, :n] = trial.system.outputs * units / trial.deviation[:, None]
        for (port, one), at in zip(self.processes, self._places, strict=True):
            force = slice(at, at + len(one.generator))
            generator[:n, at] = -trial.system.actions[port] * one.size / units
            generator[force, force] = one.generator
            intensity[force.stop - 1, force.stop - 1] = one.intensity
            rows[:, at] = -trial.system.through[port] * one.size / trial.deviation
            start[force, force] = np.eye(len(one.generator))
            if trial.settled:  # at rest under the missing force too
                begun = np.linalg.lstsq(generator[:n, :n], -generator[:n, at], rcond=1e-12)[0]
                start[:n, :n] += np.outer(begun, begun)
                start[:n, at] = start[at, :n] = begun
        for at, (channel, share, rate) in enumerate(trial.coloured, begin):
            generator[at, at], intensity[at, at], start[at, at] = -rate, 2.0 * rate, 1.0
            rows[channel, at] = np.sqrt(share)
        rows *= self.white[:, None]
        return generator, intensity, rows, start

    def _steps(self, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return transitions and noises (J, n, n) of steps (J,) [s]."""
        return kernels.discretised(*self.system[:2], lengths)

    @cached_property
    def _passed(self) -> Covered:
        (lengths, which), used = self.trial.steps, self.trial.used
        key = tuple(item.tobytes() for item in (*self.system, lengths, which, used))
        if key not in self.passes:
            moves, noises = self._steps(lengths)
            rows, start = self.system[2:]
            covers = kernels.covariances(moves, noises, which, rows, used, start)
            self.passes[key] = Passed(moves, which, rows, used, *covers[:3]), *covers[3:]
        return self.passes[key]

    @property
    def is_sound(self) -> bool:
        """Whether no variance has been lost to rounding, as under forces far larger than what is read."""
        return bool(np.all(self._passed[0].sizes > 0.5))

    @property
    def log_determinant(self) -> float:
        """Half the sum of the logarithms of the readings' variances given those before [nat]."""
        one = self._passed[0]
        return float(np.sum((0.5 * np.log(one.sizes[one.slot]) - np.log(self.white)) * one.used))

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns (K, N, C) as independent numbers of variance one (N C, K)."""
        given = np.moveaxis(columns, 0, -1)
        given = np.ascontiguousarray(given * self.white[:, None] if self.trial.coloured else given)
        found = kernels.whitened(*self._passed[0], given)
        return np.asarray(found.reshape(-1, found.shape[-1]))

    def smoothed(self, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the added state (F, n) and the missing forces (P, F) at the fine stamps, given readings."""
        one, _, filtered = self._passed
        means, later = kernels.smoothed(*one, np.ascontiguousarray(readings * self.white))
        parts = self.trial.parts
        fine = self._steps(self.trial.steps[0] / parts)
        found = kernels.between(parts, *fine, one.which, one.slot, filtered, means, later)
        sizes = np.array([one.size for _, one in self.processes])
        forces = found[:, self._places].T * sizes[:, None]
        return np.asarray(found[:, : len(self._scale)] * self._scale), np.asarray(forces)

    def deviation(self, port: int) -> FloatArray:
        """Return the deviation (N,) of the missing force of a port at the samples, columns being known."""
        shown = np.zeros(len(self.system[0]))
        at = [number for number, _ in self.processes].index(port)
        shown[self._places[at]] = self.processes[at][1].size
        return self._deviations(shown, slice(None))

    def speed_deviation(self, port: int) -> float:
        """Return that of a port's speed, at a sample with many that follow."""
        shown = np.zeros(len(self.system[0]))
        shown[: len(self._scale)] = self.trial.system.speeds[port] * self._scale
        return float(self._deviations(shown, slice(-LATER, None))[0])

    def _deviations(self, shown: FloatArray, at: slice) -> FloatArray:
        """Return the smoothed deviation of a row (n,) of the state at last samples."""
        one, predicted, _ = self._passed
        last = one._replace(which=one.which[at], used=one.used[at], slot=one.slot[at])
        return np.asarray(np.sqrt(kernels.variances(*last, predicted, shown)))


ROUNDING = 1e-12
"""Share of the squared size of a column that rounding may have made."""
LEAST_PRECISION = 1e-10
"""Of an unknown of which nothing is known before."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Unknowns given the readings: log evidence [nat, up to a constant], mean (K,) and covariance (K, K)."""

    evidence: float
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class Regression:
    """Products of the whitened residual (first) and K columns, summed over trials.

    Attributes
    ----------
    products : (1 + K, 1 + K) ndarray
        Unknowns of single trials are gone from it.
    log_determinant : float
        What the covariance of the readings and those unknowns take from the evidence [nat].
    """

    products: FloatArray
    log_determinant: float

    def solve(self, chosen: Sequence[int], precision: FloatArray) -> Solution:
        """Return evidence and values of some of the columns (from 0), of given prior precisions (K,)."""
        at = np.array([0, *(1 + k for k in chosen)])
        part = self.products[np.ix_(at, at)]
        prior = np.maximum(precision, LEAST_PRECISION)
        size = 1.0 / np.sqrt(np.diag(part)[1:] + prior)  # columns may be of any scale, and nearly one another
        scaled = (part[1:, 1:] + np.diag(prior)) * np.outer(size, size) + ROUNDING * np.eye(len(size))
        factor = cho_factor(scaled)
        mean = size * cho_solve(factor, size * part[1:, 0])
        left = np.r_[1.0, -mean]
        value = -0.5 * float(left @ part @ left + mean @ (prior * mean)) - self.log_determinant
        value -= float(np.sum(np.log(np.diag(factor[0]) / size)) + 0.5 * np.sum(np.log(prior)))
        return Solution(value, mean, np.outer(size, size) * cho_solve(factor, np.eye(len(prior))))


def without(products: FloatArray, halves: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) without the last, unknown, columns."""
    if not len(precision):
        return products, halves
    prior = np.maximum(precision, LEAST_PRECISION)
    count = products.shape[-1] - len(prior)
    root = np.linalg.cholesky(products[..., count:, count:] + np.diag(prior))
    along = np.asarray(np.linalg.solve(root, products[..., count:, :count]))
    halves = halves + np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1) - 0.5 * np.log(prior).sum()
    return products[..., :count, :count] - np.swapaxes(along, -1, -2) @ along, halves


def regression(
    filtered: Sequence[Filtered], residuals: Sequence[FloatArray], columns: Sequence[FloatArray]
) -> Regression:
    """Return the products of residuals (N, C) and columns (K, N, C), one of a trial each, whitened alike."""
    total: FloatArray | float = 0.0
    log_determinant = 0.0
    for one, residual, given in zip(filtered, residuals, columns, strict=True):
        trial = one.trial
        whole = one.whitened(np.concatenate((residual[None], given, trial.local)))
        products, half = without(whole.T @ whole, np.zeros(()), trial.local_precision)
        total = total + products
        log_determinant += one.log_determinant + float(half)
    return Regression(np.asarray(total), log_determinant)
