"""The Kalman filter with missing forces at ports.

Evidence of columns, and the forces and the motion seen.

A force is a Gaussian process in time of deviation `size` and correlation time `time`: Matern 3/2,
two states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for Signal Processing),
or 1/2. Unknowns that act in proportion follow from what whitened readings and columns share.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from discrepancy.campaign.records import FloatArray

from .backward import later
from .kalman import FilterSteps, discretised, forward
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


class ForceStateSpace(NamedTuple):
    """A trial's system with missing forces and coloured noises as states (n,), scaled to size one.

    Attributes
    ----------
    generator, intensity : (n, n) ndarray
        Rates of the state, and the spectral density of the white noise that drives it.
    output_rows : (C, n) ndarray
        The rows by which readings show the state, over the white part of their noise.
    start_covariance : (n, n) ndarray
        Covariance of the state at the first sample.
    """

    generator: FloatArray
    intensity: FloatArray
    output_rows: FloatArray
    start_covariance: FloatArray


class Smoothed(NamedTuple):
    """What readings show of a trial of F fine stamps and N samples, with P missing forces.

    Attributes
    ----------
    state : (F, n) ndarray
        State that the missing forces add.
    forces : (P, F) ndarray
        The missing forces.
    deviations : (2 P, N) ndarray
        Standard deviations of the forces, then of the speeds of their ports, at the samples.
    """

    state: FloatArray
    forces: FloatArray
    deviations: FloatArray


@dataclass(frozen=True, eq=False)
class ForceFilter:
    """A trial with missing forces at ports.

    Attributes
    ----------
    trial : SeenTrial
        The trial.
    processes : sequence of (int, Process)
        Forces, each with the number of its port; there may be several at one port.
    """

    trial: SeenTrial
    processes: Sequence[tuple[int, Process]]

    @cached_property
    def units(self) -> FloatArray:
        """Units (n,) of the state: those of a force of `size` at the frequencies of the system."""
        system = self.trial.system
        state_count = len(system.generator)
        fastest = max(float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)), 1e-9)
        pushes = [
            np.abs(system.actions[port]).max(initial=0.0) * process.size
            for port, process in self.processes
        ]
        largest_push = max(*pushes, 1e-300)
        units = np.full(state_count, largest_push / fastest)
        has_positions = (
            state_count % 2 == 0
        )  # the first half are positions, the second their speeds
        if has_positions:
            units[: state_count // 2] /= fastest
        return units

    @cached_property
    def places(self) -> list[int]:
        """Index of each force in the whole state."""
        counts = [len(process.generator) for _, process in self.processes]
        begin = len(self.trial.system.generator)
        return [begin + sum(counts[:number]) for number in range(len(counts))]

    @cached_property
    def white(self) -> FloatArray:
        """Standard deviation (C,) of each channel's noise over that of its white part."""
        ratios = np.ones(len(self.trial.deviation))
        for channel, coloured_share, _ in self.trial.coloured:
            ratios[channel] = 1.0 / np.sqrt(1.0 - coloured_share)
        return ratios

    @cached_property
    def system(self) -> ForceStateSpace:
        """The system, its missing forces and the coloured parts of noises, in this order."""
        trial = self.trial
        motion = slice(0, len(trial.system.generator))
        first_noise = motion.stop + sum(len(process.generator) for _, process in self.processes)
        size = first_noise + len(trial.coloured)
        generator = np.zeros((size, size))
        intensity = np.zeros((size, size))
        start = np.zeros((size, size))
        rows = np.zeros((len(trial.deviation), size))
        # the motion
        generator[motion, motion] = trial.system.generator * self.units / self.units[:, None]
        rows[:, motion] = trial.system.outputs * self.units / trial.deviation[:, None]
        # the missing forces, which push it and are seen directly where a reading is an acceleration
        for (port, process), place in zip(self.processes, self.places, strict=True):
            force = slice(place, place + len(process.generator))
            generator[motion, place] = -trial.system.actions[port] * process.size / self.units
            generator[force, force] = process.generator
            intensity[force.stop - 1, force.stop - 1] = process.intensity
            rows[:, place] = -trial.system.through[port] * process.size / trial.deviation
            start[force, force] = np.eye(len(process.generator))
            if trial.settled:  # the trial begins at rest under the missing force too
                at_rest = np.linalg.lstsq(
                    generator[motion, motion], -generator[motion, place], rcond=1e-12
                )[0]
                start[motion, motion] += np.outer(at_rest, at_rest)
                start[motion, place] = at_rest
                start[place, motion] = at_rest
        # the coloured parts of noises, which decay
        for place, (channel, coloured_share, rate) in enumerate(trial.coloured, first_noise):
            generator[place, place] = -rate
            intensity[place, place] = 2.0 * rate
            start[place, place] = 1.0
            rows[channel, place] = np.sqrt(coloured_share)
        rows *= self.white[:, None]
        return ForceStateSpace(generator, intensity, rows, start)

    @property
    def key(self) -> tuple[bytes, ...]:
        """What trials of one system and one grid of samples share; they are filtered together."""
        return tuple(
            array.tobytes() for array in (*self.system, *self.trial.steps, self.trial.used)
        )

    def steps(self, columns: FloatArray) -> FilterSteps:
        """Return the record with columns (K, N, C) to be filtered."""
        lengths, _ = self.trial.steps
        transitions, noises = discretised(self.system.generator, self.system.intensity, lengths)
        whitened = np.ascontiguousarray(np.moveaxis(columns, 0, -1) * self.white[:, None])
        return FilterSteps(transitions, noises, self.system.output_rows, self.trial.used, whitened)

    def products(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return products (K, K) of whitened columns (K, N, C), and half a log determinant [nat].

        Half the sum of the logarithms of the readings' variances given those before: infinite under
        forces far larger than what is read.
        """
        steps = self.steps(columns)
        _, step_of_sample = self.trial.steps
        end = np.array([len(step_of_sample)])
        begin = steps.begin(self.system.start_covariance)
        _, _, products, halves = steps.before(step_of_sample, 0, begin, end)
        return products[0], halves[0] - np.sum(np.log(self.white) * self.trial.used)

    def smoothed(self, readings: FloatArray) -> Smoothed:
        """Return the state and forces that readings (N, C) show, and how well they are known."""
        steps = self.steps(readings[None])
        _, step_of_sample = self.trial.steps
        covariance, mean, *_ = steps.begin(self.system.start_covariance)
        every_sample = np.arange(1, len(readings) + 1)
        record = (steps.moves, steps.noises, step_of_sample, steps.rows, steps.used)
        covariances, means, white, _, gains, variances = forward(
            *record, steps.columns, 0, covariance, mean, every_sample
        )
        additions, informations = later(
            steps.moves, step_of_sample, steps.rows, steps.used, white, gains, variances
        )
        states = self._between_samples(means, covariances, additions)
        posterior = covariances - covariances @ informations @ covariances
        sizes = np.array([process.size for _, process in self.processes])
        return Smoothed(
            state=states[:, : len(self.units)] * self.units,
            forces=states[:, self.places].T * sizes[:, None],
            deviations=self._deviations(posterior),
        )

    def _between_samples(
        self, means: FloatArray, covariances: FloatArray, additions: FloatArray
    ) -> FloatArray:
        """Return the smoothed state (F, n) at all fine stamps.

        Parameters
        ----------
        means, covariances : (N, n, 1), (N, n, n) ndarray
            State after the readings of each sample.
        additions : (N, n) ndarray
            The smoothing additions of each sample, see `later`.
        """
        parts = self.trial.parts
        lengths, step_of_sample = self.trial.steps
        fine_transitions, fine_noises = discretised(
            self.system.generator, self.system.intensity, lengths / parts
        )
        kind = step_of_sample[1:]
        transitions = fine_transitions[kind]
        # what later readings add, carried back from the next sample to each fine stamp before it
        carried_back = [additions[1:, :, None]]
        for _ in range(parts):
            carried_back.append(transitions.mT @ carried_back[-1])
        # the state, carried forward from each sample with what it may have gathered on the way
        state = means[:-1] + covariances[:-1] @ carried_back[-1]
        gathered = np.zeros_like(fine_transitions)
        fine_states = []
        for addition in carried_back[:0:-1]:
            fine_states.append(state + gathered[kind] @ addition)
            state = transitions @ state
            gathered = fine_transitions @ gathered @ fine_transitions.mT + fine_noises
        size = means.shape[1]
        return np.concatenate((np.stack(fine_states, axis=1).reshape(-1, size), means[-1:, :, 0]))

    def _deviations(self, covariances: FloatArray) -> FloatArray:
        """Return deviations (2 P, N) of forces and speeds, given state covariances (N, n, n)."""
        count = len(self.processes)
        rows = np.zeros((2 * count, covariances.shape[-1]))
        for number, (port, process) in enumerate(self.processes):
            rows[number, self.places[number]] = process.size
            rows[count + number, : len(self.units)] = self.trial.system.speeds[port] * self.units
        variances = np.sum((rows @ covariances) * rows, axis=-1)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)).T)


ROUNDING = 1e-12
"""Share of the squared size of a column that rounding may have made."""
LEAST_PRECISION = 1e-10
"""Of an unknown of which nothing is known before."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Unknowns given the readings.

    Log evidence [nat, up to a constant], mean (K,) and covariance (K, K).
    """

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
        Half the log determinant of the covariance of the readings and those unknowns [nat].
    """

    products: FloatArray
    log_determinant: float

    def solve(self, chosen: Sequence[int], precision: FloatArray) -> Solution:
        """Return evidence and values of some of the unknowns, given their prior precisions (K,)."""
        rows = np.array([0, *(1 + k for k in chosen)])
        products = self.products[np.ix_(rows, rows)]
        prior = np.maximum(precision, LEAST_PRECISION)
        # columns may be of any scale and nearly equal: scale the normal equations to unit diagonal
        scale = 1.0 / np.sqrt(np.diag(products)[1:] + prior)
        normal = (products[1:, 1:] + np.diag(prior)) * np.outer(scale, scale)
        factor = cho_factor(normal + ROUNDING * np.eye(len(scale)))
        mean = scale * cho_solve(factor, scale * products[1:, 0])
        covariance = np.outer(scale, scale) * cho_solve(factor, np.eye(len(prior)))
        # Laplace's evidence, exact for a linear model
        combination = np.r_[1.0, -mean]
        misfit = float(combination @ products @ combination + mean @ (prior * mean))
        evidence = -0.5 * misfit - self.log_determinant
        log_determinant = np.sum(np.log(np.diag(factor[0]) / scale))
        evidence -= float(log_determinant - 0.5 * np.sum(np.log(prior)))
        return Solution(evidence, mean, covariance)


def without(
    products: FloatArray, halves: FloatArray, precision: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) with unknowns eliminated."""
    if not len(precision):
        return products, halves
    prior = np.maximum(precision, LEAST_PRECISION)
    count = products.shape[-1] - len(prior)
    # Schur complement of the last columns
    root = np.linalg.cholesky(products[..., count:, count:] + np.diag(prior))
    projected = np.asarray(np.linalg.solve(root, products[..., count:, :count]))
    half_log_determinants = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(-1)
    remaining_halves = halves + half_log_determinants - 0.5 * np.log(prior).sum()
    return products[..., :count, :count] - projected.mT @ projected, remaining_halves


def regression(filtered: Sequence[ForceFilter], rows: Sequence[FloatArray]) -> Regression:
    """Return the products of residuals and columns (1 + K + L, N, C) of all trials."""
    alike: dict[tuple[bytes, ...], list[tuple[ForceFilter, FloatArray]]] = {}
    for trial, columns in zip(filtered, rows, strict=True):
        alike.setdefault(trial.key, []).append((trial, columns))
    total: FloatArray | float = 0.0
    log_determinant = 0.0
    for group in alike.values():
        first_trial, _ = group[0]
        together, half = first_trial.products(np.concatenate([columns for _, columns in group]))
        ends = np.cumsum([0, *(len(columns) for _, columns in group)]).tolist()
        for (trial, _), (begin, end) in zip(group, pairwise(ends), strict=True):
            of_trial = together[begin:end, begin:end]
            products, half_with_local = without(of_trial, half, trial.trial.local_precision)
            total = total + products
            log_determinant += float(half_with_local)
    return Regression(np.asarray(total), log_determinant)
