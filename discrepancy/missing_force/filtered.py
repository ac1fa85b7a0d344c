"""The Kalman filter with missing forces at ports: evidence of columns, and the forces and the motion seen.

A force is a Gaussian process in time of deviation `size` and correlation time `time`: Matern 3/2, two
states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for Signal Processing), or 1/2.
Unknowns that act in proportion follow from what whitened readings and columns share.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray

from .kalman import Steps, discretised, forward, later
from .trial import SeenTrial


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


@dataclass(frozen=True, eq=False)
class Filtered:
    """A trial with missing forces at ports.

    Attributes
    ----------
    trial : SeenTrial
        Which.
    processes : sequence of (int, Process)
        Forces, each with the number of its port; there may be several at one.
    """

    trial: SeenTrial
    processes: Sequence[tuple[int, Process]]

    @cached_property
    def units(self) -> FloatArray:
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
    def places(self) -> list[int]:
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
        n, units, noises = len(trial.system.generator), self.units, len(trial.coloured)
        begin = n + sum(len(one.generator) for _, one in self.processes)
        whole = begin + noises
        generator, intensity, start = np.zeros((3, whole, whole))
        generator[:n, :n] = trial.system.generator * units / units[:, None]
        rows = np.zeros((len(trial.deviation), whole))
        rows[:, :n] = trial.system.outputs * units / trial.deviation[:, None]
        for (port, one), at in zip(self.processes, self.places, strict=True):
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

    @property
    def key(self) -> tuple[bytes, ...]:
        """What trials of one system and grid have alike, which are filtered together."""
        return tuple(item.tobytes() for item in (*self.system, *self.trial.steps, self.trial.used))

    def steps(self, columns: FloatArray) -> Steps:
        """Return the record with columns (K, N, C) to be filtered."""
        generator, intensity, rows, _ = self.system
        lengths, _ = self.trial.steps
        given = np.ascontiguousarray(np.moveaxis(columns, 0, -1) * self.white[:, None])
        return Steps(*discretised(generator, intensity, lengths), rows, self.trial.used, given)

    def products(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return products (K, K) of columns (K, N, C), whitened, and what they take from the evidence [nat].

        Half the sum of the logarithms of the readings' variances given those before: infinite under forces
        far larger than what is read.
        """
        steps, which = self.steps(columns), self.trial.steps[1]
        end = np.array([len(which)])
        _, _, products, halves = steps.before(which, 0, steps.begin(self.system[3]), end)
        return products[0], halves[0] - np.sum(np.log(self.white) * self.trial.used)

    def smoothed(self, readings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return what readings (N, C) show: state, forces, and how well forces and speeds are known.

        The added state (F, n) and the missing forces (P, F) are at the fine stamps, the deviations (2 P, N)
        of these forces, and of the speeds of their ports, at the samples.
        """
        steps, parts = self.steps(readings[None]), self.trial.parts
        lengths, which = self.trial.steps
        cover, mean, *_ = steps.begin(self.system[3])
        every = np.arange(1, len(readings) + 1)
        given = steps.moves, steps.noises, which, steps.rows, steps.used
        covers, means, white, _, gains, sizes = forward(*given, steps.columns, 0, cover, mean, every)
        adds, knows = later(steps.moves, *given[2:], white, gains, sizes)
        fine, more = discretised(*self.system[:2], lengths / parts)
        step = which[1:]
        moves = fine[step]
        back = [adds[1:, :, None]]
        for _ in range(parts):
            back.append(moves.mT @ back[-1])
        state, noise, found = means[:-1] + covers[:-1] @ back[-1], np.zeros_like(fine), []
        for add in back[:0:-1]:
            found.append(state + noise[step] @ add)
            state, noise = moves @ state, fine @ noise @ fine.mT + more
        states = np.concatenate((np.stack(found, axis=1).reshape(-1, len(mean)), means[-1:, :, 0]))
        sizes_of = np.array([one.size for _, one in self.processes])
        n, count = len(self.units), len(self.processes)
        shown = np.zeros((2 * count, len(mean)))
        for number, (port, one) in enumerate(self.processes):
            shown[number, self.places[number]] = one.size
            shown[count + number, :n] = self.trial.system.speeds[port] * self.units
        squares = np.sum((shown @ (covers - covers @ knows @ covers)) * shown, axis=-1)
        forces = states[:, self.places].T * sizes_of[:, None]
        return states[:, :n] * self.units, forces, np.sqrt(np.maximum(squares, 0.0)).T


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
        value -= float(np.sum(np.log(np.diag(factor[0]) / size)) - 0.5 * np.sum(np.log(prior)))
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
    return products[..., :count, :count] - along.mT @ along, halves


def regression(filtered: Sequence[Filtered], rows: Sequence[FloatArray]) -> Regression:
    """Return the products of residuals and columns (1 + K + L, N, C), of a trial each, whitened alike."""
    total: FloatArray | float = 0.0
    log_determinant = 0.0
    alike: dict[tuple[bytes, ...], list[tuple[Filtered, FloatArray]]] = {}
    for one, given in zip(filtered, rows, strict=True):
        alike.setdefault(one.key, []).append((one, given))
    for group in alike.values():
        whole, half_of = group[0][0].products(np.concatenate([given for _, given in group]))
        ends = np.cumsum([0, *(len(given) for _, given in group)]).tolist()
        for (one, _), (begin, end) in zip(group, pairwise(ends), strict=True):
            products, half = without(whole[begin:end, begin:end], half_of, one.trial.local_precision)
            total = total + products
            log_determinant += float(half)
    return Regression(np.asarray(total), log_determinant)
