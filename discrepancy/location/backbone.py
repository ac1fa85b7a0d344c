"""Backbone of a ring-down: frequency and damping ratio of each mode against its amplitude.

Viscous damping is flat; Coulomb friction has zeta ~ 1/A, quadratic damping zeta ~ A, a cubic spring a
frequency that changes with A^2; under micro-slip the frequency falls and the damping ratio rises with A.

In windows of a few periods all modes are fitted together as decaying sinusoids with an offset and a drift, by
least squares, which is maximum likelihood under Gaussian noise. Unlike a Hilbert transform this separates
modes, has no end effects, and has error bars from the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from calibration.dynamics.damped_cosine import DampedCosines, Solution
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError, said

SMALLEST_SIGNAL = 4.0
"""A mode counts in a window while its amplitude there is this many standard errors."""

_GREATEST_CHANGE = 0.3  # of a frequency from its start value
_FEWEST_PER_UNKNOWN = 2.0


@dataclass(frozen=True, eq=False)
class Backbone:
    """Frequency and damping ratio of one mode along a ring-down.

    Attributes
    ----------
    mode : int
        Counted from one, by start frequency.
    time : (W,) ndarray
        Centroid of the mode's energy in each window [s].
    amplitude, amplitude_error : (W,) ndarray
        At that time [signal's unit]; standard error.
    frequency, frequency_error : (W,) ndarray
        Natural frequency |s| / 2 pi with s = -decay + i omega_d [Hz].
    damping_ratio, damping_ratio_error : (W,) ndarray
        decay / |s| [1].
    """

    mode: int
    time: FloatArray
    amplitude: FloatArray
    amplitude_error: FloatArray
    frequency: FloatArray
    frequency_error: FloatArray
    damping_ratio: FloatArray
    damping_ratio_error: FloatArray


def backbones(
    time: FloatArray,
    signal: FloatArray,
    frequencies: Sequence[float],
    *,
    noise_deviation: float | None = None,
    averaging_width: float = 0.0,
    periods: float = 4.0,
) -> tuple[Backbone, ...]:
    """Return the backbone of each mode.

    Parameters
    ----------
    time, signal : (N,) ndarray
        The record, evenly spaced [s], [any unit].
    frequencies : sequence of float
        Start values of the frequencies of all modes that ring [Hz].
    noise_deviation : float, optional
        Standard deviation of the noise; without it that of each window's own residuals is taken, which also
        holds what the sinusoids do not describe.
    averaging_width : float
        Interval over which each value is an average [s]; 0 for samples.
    periods : float
        Length of a window in periods of the lowest frequency. Longer windows have smaller errors and smear
        what changes with amplitude: three periods of a quadratic damping with a ratio of 0.045 give 0.043.
        The next window repeats half of it.

    Raises
    ------
    FitError
        If the record is shorter than a window, or a window has too few samples.
    """
    interval = float(time[-1] - time[0]) / (time.size - 1)
    start = 2.0 * np.pi * np.sort(np.asarray(frequencies, dtype=float))
    width = round(periods * 2.0 * np.pi / (start[0] * interval)) + 1
    unknown = 4 * start.size + 2
    if width < _FEWEST_PER_UNKNOWN * unknown or width > time.size:
        ends = width, _FEWEST_PER_UNKNOWN * unknown, time.size
        raise FitError(said("campaign.window", periods=periods, ends=ends))
    active = np.ones(start.size, dtype=bool)
    pole = (1j - 0.02) * start
    rows: list[list[tuple[float, ...]]] = [[] for _ in start]
    for first in range(0, time.size - width + 1, max(1, round(0.5 * width))):
        part = slice(first, first + width)
        window = DampedCosines(time[part], signal[part], averaging_width)
        while active.any():
            solution = window.fit(pole[active])
            points = _points(time[part] - time[first], solution, noise_deviation)
            numbers = np.flatnonzero(active).tolist()
            pairs = list(zip(numbers, points, strict=True))
            lost = [number for number, point in pairs if not _credible(point, start[number])]
            if not lost:
                for number, point in pairs:
                    rows[number].append((float(time[first]) + point[0], *point[1:]))
                found = solution.pole
                pole[active] = np.minimum(found.real, -1e-4 * found.imag) + 1j * found.imag
                break
            # Fit again without the modes that have died away: they would spoil the errors of the others.
            active[lost] = False
        if not active.any():
            break
    return tuple(
        Backbone(number + 1, *np.array(points, dtype=float).reshape(-1, 7).T)
        for number, points in enumerate(rows)
    )


def _points(time: FloatArray, solution: Solution, noise_deviation: float | None) -> list[tuple[float, ...]]:
    """Return time, amplitude, frequency and damping ratio of each mode, each with its error but the time."""
    own = float(solution.deviation[0])
    deviation = own if noise_deviation is None else noise_deviation
    points: list[tuple[float, ...]] = []
    for mode in solution.modes:
        decay = -mode.pole.real
        weight = np.exp(-2.0 * np.clip(decay * (time - time[-1] / 2.0), -50.0, 50.0))
        centre = float(weight @ time / weight.sum())
        effective = float(weight.sum()) ** 2 / float(weight @ weight)
        points.append(
            (
                centre,
                mode.amplitude * float(np.exp(-np.clip(decay * centre, -50.0, 50.0))),
                deviation * sqrt(2.0 / effective),
                mode.frequency,
                mode.standard_error["frequency"] * deviation / own,
                mode.damping_ratio,
                mode.standard_error["damping_ratio"] * deviation / own,
            )
        )
    return points


def _credible(point: tuple[float, ...], start: float) -> bool:
    """Whether a mode is still there: above its error, near its start frequency, damping below critical."""
    _, amplitude, amplitude_error, frequency, _, ratio, _ = point
    near = abs(2.0 * np.pi * frequency / start - 1.0) < _GREATEST_CHANGE
    return amplitude > SMALLEST_SIGNAL * amplitude_error and near and abs(ratio) < 0.5
