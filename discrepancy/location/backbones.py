"""Backbones of ring-downs: frequency and damping of each mode over its amplitude."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

import numpy as np

from calibration.dynamics.damped_cosine import DampedCosineFit, DampedCosines
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import FitError

LEAST_AMPLITUDE = 4.0
"""Least amplitude of a mode that still rings in a window, in standard errors."""
_LARGEST_FREQUENCY_CHANGE = 0.3
"""Largest relative change of a frequency from its start value."""
_LEAST_SAMPLES_PER_UNKNOWN = 2.0
"""Fewest samples of a window per unknown of the fit."""


@dataclass(frozen=True, eq=False)
class Backbone:
    """Frequency and damping ratio of one mode along a ring-down.

    Attributes
    ----------
    mode : int
        The number of the mode from one, by start frequency.
    time : (W,) ndarray
        The centroid of the mode's energy in each window [s].
    amplitude, amplitude_error : (W,) ndarray
        The amplitude at that time and its standard error [signal's unit].
    frequency, frequency_error : (W,) ndarray
        Natural frequency |s| / 2 pi with s = -decay + i omega_d, and its standard error [Hz].
    damping_ratio, damping_ratio_error : (W,) ndarray
        Damping ratio decay / |s| and its standard error [1].
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
    """Return how frequency and damping of each mode change along a ring-down.

    Damped cosines, one for each mode that still rings, are fitted in windows that overlap by half.
    The result for a mode is called its backbone: frequency and damping ratio over the amplitude. A
    mode that is not credible in a window (`BackbonePoint.is_credible`) is left out from there on.

    Parameters
    ----------
    time, signal : (N,) ndarray
        The record, evenly spaced [s], [any unit].
    frequencies : sequence of float
        The start values of the frequencies of all modes in the signal [Hz].
    noise_deviation : float, optional
        The standard deviation of the noise [signal's unit]. By default, that of the residuals of
        each window, which also contain what the cosines do not describe.
    averaging_width : float
        The interval over which each value is an average [s]; 0 for samples.
    periods : float
        The length of a window in periods of the lowest frequency. A longer window gives smaller
        standard errors, but averages over a larger change of amplitude: for quadratic damping with
        a ratio of 0.045, windows of three periods give 0.043.

    Raises
    ------
    FitError
        If the record is shorter than a window, or a window has too few samples.
    """
    interval = float(time[-1] - time[0]) / (time.size - 1)
    start = 2.0 * np.pi * np.sort(np.asarray(frequencies, dtype=float))
    width = round(periods * 2.0 * np.pi / (start[0] * interval)) + 1
    unknown_count = 4 * start.size + 2
    least_width = _LEAST_SAMPLES_PER_UNKNOWN * unknown_count
    if width < least_width or width > time.size:
        raise FitError(
            f"A window of {periods:g} periods has {width} samples, but at least {least_width:.0f} "
            f"and at most {time.size}, the record's length, are needed: give a longer or more "
            "finely sampled record."
        )
    is_ringing = np.ones(start.size, dtype=bool)  # (modes,)
    poles = (1j - 0.02) * start  # first guess: a damping ratio of 2 %
    points: list[list[BackbonePoint]] = [[] for _ in start]  # of each mode, in each window
    for first_sample in range(0, time.size - width + 1, max(1, round(0.5 * width))):
        samples = slice(first_sample, first_sample + width)
        window = DampedCosines(time[samples], signal[samples], averaging_width)
        window_time = time[samples] - time[first_sample]
        while is_ringing.any():
            solution = window.fit(poles[is_ringing])
            modes = np.flatnonzero(is_ringing).tolist()
            points_of_window = _points_of_window(window_time, solution, noise_deviation)
            died_away = []
            for mode, point in zip(modes, points_of_window, strict=True):
                if not point.is_credible(start[mode]):
                    died_away.append(mode)
            if not died_away:
                break
            # fit again without these modes, which would spoil the errors of the others
            is_ringing[died_away] = False
        if not is_ringing.any():
            break
        for mode, point in zip(modes, points_of_window, strict=True):
            points[mode].append(point._replace(time=float(time[first_sample]) + point.time))
        # start values for the next window: these poles, with a damping ratio of at least 1e-4
        fitted_poles = solution.pole
        largest_real_part = -1e-4 * fitted_poles.imag
        real_parts = np.minimum(fitted_poles.real, largest_real_part)
        poles[is_ringing] = real_parts + 1j * fitted_poles.imag
    return tuple(
        _backbone_of_points(mode, points_of_mode) for mode, points_of_mode in enumerate(points, 1)
    )


class BackbonePoint(NamedTuple):
    """One mode in one window of a ring-down; the entries are those of a `Backbone`."""

    time: float
    amplitude: float
    amplitude_error: float
    frequency: float
    frequency_error: float
    damping_ratio: float
    damping_ratio_error: float

    def is_credible(self, start: float) -> bool:
        """Return whether the mode still rings, at a frequency close to its start value [rad/s].

        The amplitude of the mode must exceed `LEAST_AMPLITUDE` standard errors, its frequency must
        be within 30 % of the start value, and its damping ratio below 0.5.
        """
        change = abs(2.0 * np.pi * self.frequency / start - 1.0)
        is_above_error = self.amplitude > LEAST_AMPLITUDE * self.amplitude_error
        return (
            is_above_error and change < _LARGEST_FREQUENCY_CHANGE and abs(self.damping_ratio) < 0.5
        )


def _backbone_of_points(mode: int, points: Sequence[BackbonePoint]) -> Backbone:
    """Return the points of a mode as one record of arrays."""
    arrays: dict[str, FloatArray] = {}
    for name in BackbonePoint._fields:
        arrays[name] = np.array([getattr(point, name) for point in points], dtype=float)
    return Backbone(mode=mode, **arrays)


def _points_of_window(
    time: FloatArray, solution: DampedCosineFit, noise_deviation: float | None
) -> list[BackbonePoint]:
    """Return amplitude, frequency and damping of each mode in a window, with standard errors.

    The values belong to the centroid of the mode's energy in time, because a mode that decays
    quickly is visible mainly at the start of the window. Times (N,) count from the start of the
    window [s]. Standard errors are those for the given noise, or for the residuals of the window if
    it is None.
    """
    residual_deviation = float(solution.deviation[0])
    deviation = residual_deviation if noise_deviation is None else noise_deviation
    points = []
    for mode in solution.modes:
        decay = -mode.pole.real
        # (N,), proportional to exp(-2 decay t); centred and clipped against overflow
        energy = np.exp(-2.0 * np.clip(decay * (time - time[-1] / 2.0), -50.0, 50.0))
        centroid = float(energy @ time / energy.sum())
        # number of equally weighted samples with the same information: (sum w)^2 / sum w^2
        effective_samples = float(energy.sum()) ** 2 / float(energy @ energy)
        frequency_error = mode.standard_error["frequency"]
        damping_ratio_error = mode.standard_error["damping_ratio"]
        points.append(
            BackbonePoint(
                time=centroid,
                amplitude=mode.amplitude * float(np.exp(-np.clip(decay * centroid, -50.0, 50.0))),
                amplitude_error=deviation * sqrt(2.0 / effective_samples),
                frequency=mode.frequency,
                frequency_error=frequency_error * deviation / residual_deviation,
                damping_ratio=mode.damping_ratio,
                damping_ratio_error=damping_ratio_error * deviation / residual_deviation,
            )
        )
    return points
