"""Several ring-down trials together: averages, and how frequency and damping change with the amplitude.

Of records that were read off a plot, the extremes tell more. The middle of the ink in a column of pixels is
not quite the average of the signal there, while its lowest and highest points are the signal's extremes
within the column, but for the width of the line. A fit to these two keeps more of a fast mode that dies away
within a few columns.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from calibration.errors import ExperimentDataError
from calibration.sentences import said

from .damped_cosine import DampedCosines, FloatArray, RingDownMode
from .records import RingDownRecord
from .ringdown import FIRST_PEAK, Frequencies, RingDownFit, fit_ring_down, refuse_growing

PUBLISHED_FREQUENCIES = (5.6492, 29.9699)
"""Natural frequencies found by the authors in the raw records, mean of five trials [Hz]."""

PUBLISHED_DAMPING_RATIOS = (0.0281, 0.0717)
"""Damping ratios found by the authors, mean of five trials [1]."""

ModalFigure = Literal["frequency", "damping_ratio"]
"""What a mode has."""


class Averaged(NamedTuple):
    """Mean over trials, standard deviation between them, and standard error of the mean."""

    mean: float
    standard_deviation: float
    standard_error: float


@dataclass(frozen=True, eq=False)
class RingDownTrials:
    """The trials of one wing.

    Attributes
    ----------
    fits : tuple of RingDownFit
        One for each trial.
    """

    fits: tuple[RingDownFit, ...]

    def average(self, name: ModalFigure, mode: int) -> Averaged:
        """Return the natural frequency [Hz] or the damping ratio [1] of mode 0 or 1."""
        values = [float(getattr(fit.modes[mode], name)) for fit in self.fits]
        mean = float(np.mean(values))
        if len(values) == 1:
            return Averaged(mean, math.nan, self.fits[0].modes[mode].standard_error[name])
        deviation = float(np.std(values, ddof=1))
        return Averaged(mean, deviation, deviation / math.sqrt(len(values)))


def fit_trials(
    records: Sequence[RingDownRecord],
    procedure: Frequencies = Frequencies.PEAKS,
    *,
    start: float | None = FIRST_PEAK,
) -> RingDownTrials:
    """Fit every record, see `fit_ring_down`.

    Raises
    ------
    ExperimentDataError
        If there is no record, or one does not show two decaying modes.
    """
    if not records:
        raise ExperimentDataError("there is no ring-down record; at least one is needed.")
    return RingDownTrials(tuple(fit_ring_down(record, procedure, start=start) for record in records))


def amplitude_dependence(
    fit: RingDownFit, *, window: float = 0.8, step: float = 0.4, first: float = 0.4
) -> tuple[RingDownMode, ...]:
    """Fit the first mode alone within windows that slide over the record; amplitudes are those in the middle.

    A linear wing gives the same frequency and damping ratio in each. Windows in which the mode no longer
    stands above four times the residuals are left out.

    Parameters
    ----------
    fit : RingDownFit
        A fitted record; its first mode is the start of each window.
    window, step, first : float
        Length of a window, shift between two, start of the first, when mode 2 has died away [s].
    """
    points = []
    record = fit.record
    begin = float(record.time[0]) + first
    while begin + window <= float(record.time[-1]):
        inside = (record.time >= begin) & (record.time < begin + window)
        model = DampedCosines(record.time[inside], record.signal[inside], record.averaging_width)
        solution = model.fit(np.array([fit.modes[0].pole]))
        (seen,) = solution.modes
        seen = seen._replace(wave=seen.wave * cmath.exp(seen.pole * 0.5 * window))
        if seen.amplitude > 4.0 * float(solution.deviation[0]):
            points.append(seen)
        begin += step
    return tuple(points)


_POINTS = 17  # instants within a column at which the model is evaluated


def refine_by_extremes(trials: RingDownTrials) -> RingDownTrials:
    """Fit amplitudes, phases and decay rates anew to the extremes; damped frequencies stay as found.

    Raises
    ------
    ExperimentDataError
        If a record has no extremes, or a mode no longer decays.
    """
    return RingDownTrials(tuple(_refine(fit) for fit in trials.fits))


def _refine(fit: RingDownFit) -> RingDownFit:
    record = fit.record
    if record.lowest is None or record.highest is None:
        raise ExperimentDataError(said("ringdown.envelope", record=record))
    lowest, highest = record.lowest, record.highest
    time = record.time - record.time[0]
    within = time[:, np.newaxis] + np.linspace(-0.5, 0.5, _POINTS) * record.averaging_width
    poles, waves = (np.array([getattr(mode, name) for mode in fit.modes]) for name in ("pole", "wave"))

    def signal(unknown: FloatArray, when: FloatArray) -> FloatArray:
        """Return offset, drift and the decaying modes at some instants."""
        wave = np.exp(np.multiply.outer(when, unknown[4:6] + 1j * poles.imag)) @ (
            unknown[:2] + 1j * unknown[2:4]
        )
        return np.asarray(unknown[6] + unknown[7] * when + wave.real)

    def residual(scaled: FloatArray) -> FloatArray:
        unknown = scaled * scale
        value, half_line = signal(unknown, within), unknown[8]
        return np.hstack([value.min(axis=1) - half_line - lowest, value.max(axis=1) + half_line - highest])

    size = float(np.ptp(record.signal))
    half_line = 0.5 * float(np.percentile(highest - lowest, 10.0))
    scale = np.array([size, size, size, size, *np.abs(poles.real), size, size, size])
    first = np.array([*waves.real, *waves.imag, *poles.real, 0.0, 0.0, half_line]) / scale
    found = least_squares(residual, first, method="lm", xtol=1e-10, ftol=1e-12, diff_step=1e-6)
    unknown = found.x * scale
    # Both extremes of a column see the same signal: they count as one reading.
    variance = float(found.cost) / max(time.size - unknown.size, 1)
    covariance = 2.0 * variance * np.linalg.pinv(found.jac.T @ found.jac) * np.outer(scale, scale)
    first_mode, second_mode = (
        RingDownMode(
            complex(unknown[4 + at], pole.imag), complex(unknown[at], unknown[2 + at]),
            np.diag([covariance[4 + at, 4 + at], 0.0]),
        )
        for at, pole in enumerate(poles)
    )  # fmt: skip
    modes = first_mode, second_mode
    refuse_growing(modes, record.source)
    fitted, deviation = signal(unknown, time), math.sqrt(variance)
    return replace(fit, modes=modes, fitted=fitted, residual_deviation=deviation)
