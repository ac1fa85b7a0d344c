"""Several ring-down trials together: averages, and how frequency and damping change with the amplitude."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.errors import RingDownError

from .damped_cosine import DampedCosines
from .records import RingDownRecord
from .ringdown import FIRST_PEAK, Frequencies, RingDownFit, fit_ring_down

PUBLISHED_FREQUENCIES = (5.6492, 29.9699)
"""Natural frequencies found by the authors in the raw records, mean of five trials [Hz]."""

PUBLISHED_DAMPING_RATIOS = (0.0281, 0.0717)
"""Damping ratios found by the authors, mean of five trials [1]."""


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

    @property
    def procedure(self) -> Frequencies:
        """How the frequencies were found."""
        return self.fits[0].procedure

    def frequency(self, mode: int) -> Averaged:
        """Return the natural frequency of mode 0 or 1 [Hz]."""
        return _average(
            [(fit.modes[mode].frequency, fit.modes[mode].frequency_standard_error) for fit in self.fits]
        )

    def damping_ratio(self, mode: int) -> Averaged:
        """Return the damping ratio of mode 0 or 1 [1]."""
        return _average(
            [
                (fit.modes[mode].damping_ratio, fit.modes[mode].damping_ratio_standard_error)
                for fit in self.fits
            ]
        )


class AmplitudePoint(NamedTuple):
    """First mode within one window: middle [s], amplitude [V], frequency [Hz], damping ratio [1]."""

    time: float
    amplitude: float
    frequency: float
    damping_ratio: float


def fit_trials(
    records: Sequence[RingDownRecord],
    procedure: Frequencies = Frequencies.PEAKS,
    *,
    start: float | None = FIRST_PEAK,
) -> RingDownTrials:
    """Fit every record, see `fit_ring_down`.

    Raises
    ------
    RingDownError
        If there is no record, or one does not show two decaying modes.
    """
    if not records:
        raise RingDownError("there is no ring-down record; at least one is needed.")
    return RingDownTrials(tuple(fit_ring_down(record, procedure, start=start) for record in records))


def amplitude_dependence(
    fit: RingDownFit, *, window: float = 0.8, step: float = 0.4, first: float = 0.4
) -> tuple[AmplitudePoint, ...]:
    """Fit the first mode alone within windows that slide over the record.

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
    record, mode = fit.record, fit.modes[0]
    begin = float(record.time[0]) + first
    omega = 2.0 * math.pi * mode.damped_frequency
    while begin + window <= float(record.time[-1]):
        inside = (record.time >= begin) & (record.time < begin + window)
        time = record.time[inside]
        model = DampedCosines(time, record.signal[inside], record.averaging_width)
        found = model.fitted(np.array([mode.decay_rate]), np.array([omega]))
        solution = model.solve(found.decay, found.omega, frequencies_fitted=True)
        decay, damped = float(found.decay[0]), float(found.omega[0])
        middle = 0.5 * window
        amplitude = abs(complex(solution.amplitude[0])) * math.exp(-decay * middle)
        if amplitude > 4.0 * solution.residual_deviation:
            natural = math.hypot(decay, damped)
            points.append(
                AmplitudePoint(begin + middle, amplitude, natural / (2.0 * math.pi), decay / natural)
            )
        begin += step
    return tuple(points)


def _average(values: list[tuple[float, float]]) -> Averaged:
    mean = float(np.mean([value for value, _ in values]))
    if len(values) == 1:
        return Averaged(mean, math.nan, values[0][1])
    deviation = float(np.std([value for value, _ in values], ddof=1))
    return Averaged(mean, deviation, deviation / math.sqrt(len(values)))
