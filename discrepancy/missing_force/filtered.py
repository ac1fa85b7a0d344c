"""The Kalman filter with a missing force at one port: evidence of columns, and the force and motion seen.

The force is a Gaussian process in time of deviation `size` and correlation time `time`: Matern 3/2, two
states (Hartikainen and Sarkka 2010, IEEE Workshop on Machine Learning for Signal Processing), or 1/2.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fe.compilation import callable_when_compiled, compiled

from . import kalman_kernels as kernels
from .trial import SeenTrial

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

callable_when_compiled(kernels.is_steady)
discretised = compiled(kernels.discretised)
_covariances = compiled(kernels.covariances)
_whitened = compiled(kernels.whitened)
_smoothed = compiled(kernels.smoothed)
_between = compiled(kernels.between)
_variances = compiled(kernels.variances)


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
    """A trial with a missing force at a port.

    Attributes
    ----------
    trial : SeenTrial
        Which.
    port : int
        Number of the port.
    process : Process
        The force.
    """

    trial: SeenTrial
    port: int
    process: Process

    @cached_property
    def _scale(self) -> FloatArray:
        """Units (n,) of the state: those of a force of `size` at the frequencies of the system."""
        system = self.trial.system
        n = len(system.generator)
        pace = max(float(np.max(np.abs(np.linalg.eigvals(system.generator)), initial=0.0)), 1e-9)
        push = max(float(np.max(np.abs(system.actions[self.port]), initial=0.0)), 1e-300) * self.process.size
        units = np.full(n, push / pace)
        half = n // 2 if 2 * (n // 2) == n else 0
        units[:half] /= pace
        return units

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
        trial, own = self.trial, self.process.generator
        n, units, noises = len(trial.system.generator), self._scale, len(trial.coloured)
        force = slice(n, n + len(own))
        whole = n + len(own) + noises
        generator, intensity, start = np.zeros((3, whole, whole))
        generator[:n, :n] = trial.system.generator * units / units[:, None]
        generator[:n, n] = -trial.system.actions[self.port] * self.process.size / units
        generator[force, force] = own
        intensity[force.stop - 1, force.stop - 1] = self.process.intensity
        rows = np.zeros((len(trial.deviation), whole))
        rows[:, :n] = trial.system.outputs * units / trial.deviation[:, None]
        rows[:, n] = -trial.system.through[self.port] * self.process.size / trial.deviation
        start[force, force] = np.eye(len(own))
        if trial.settled:  # at rest under the missing force too
            begun = np.linalg.lstsq(generator[:n, :n], -generator[:n, n], rcond=1e-12)[0]
            start[:n, :n], start[:n, n], start[n, :n] = np.outer(begun, begun), begun, begun
        for at, (channel, share, rate) in enumerate(trial.coloured, force.stop):
            generator[at, at], intensity[at, at], start[at, at] = -rate, 2.0 * rate, 1.0
            rows[channel, at] = np.sqrt(share)
        rows *= self.white[:, None]
        return generator, intensity, rows, start

    def _steps(self, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return transitions and noises (J, n, n) of steps (J,) [s]."""
        return discretised(*self.system[:2], lengths)

    @cached_property
    def _passed(
        self,
    ) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        lengths, which = self.trial.steps
        moves, noises = self._steps(lengths)
        _, _, rows, start = self.system
        return moves, *_covariances(moves, noises, which, rows, self.trial.used, start)

    @property
    def log_determinant(self) -> float:
        """Half the sum of the logarithms of the readings' variances given those before [nat]."""
        _, slot, _, sizes, _, _ = self._passed
        white = np.sum(self.trial.used * np.log(self.white))
        return 0.5 * float(np.sum(np.log(sizes[slot]) * self.trial.used)) - float(white)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns (K, N, C) as independent numbers of variance one (N C, K)."""
        moves, slot, gains, sizes, _, _ = self._passed
        given = np.ascontiguousarray(np.moveaxis(columns * self.white, 0, -1))
        found = _whitened(
            moves, self.trial.steps[1], self.system[2], self.trial.used, slot, gains, sizes, given
        )
        return np.asarray(found.reshape(-1, found.shape[-1]))

    def smoothed(self, readings: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the added state (F, n) and the missing force (F,) at the fine stamps, given readings."""
        moves, slot, gains, sizes, _, filtered = self._passed
        lengths, which = self.trial.steps
        rows = self.system[2]
        means, later = _smoothed(
            moves,
            which,
            rows,
            self.trial.used,
            slot,
            gains,
            sizes,
            np.ascontiguousarray(readings * self.white),
        )
        parts = self.trial.parts
        fine = self._steps(lengths / parts)
        found = _between(parts, *fine, which, slot, filtered, means, later)
        n = len(self._scale)
        return np.asarray(found[:, :n] * self._scale), np.asarray(found[:, n] * self.process.size)

    def deviation(self) -> FloatArray:
        """Return the deviation (N,) of the missing force at the samples, all columns being known."""
        moves, slot, gains, sizes, predicted, _ = self._passed
        shown = np.zeros((1, len(self.system[0])))
        shown[0, len(self._scale)] = self.process.size
        found = _variances(
            moves, self.trial.steps[1], self.system[2], self.trial.used, slot, gains, sizes, predicted, shown
        )
        return np.asarray(np.sqrt(found[:, 0]))
