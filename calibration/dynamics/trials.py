"""Several ring-down trials together: averages, and how frequency and damping change with the amplitude."""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from calibration.errors import RingDownError

from .damped_cosine import DampedCosines, RingDownMode
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
        return self._average("frequency", mode)

    def damping_ratio(self, mode: int) -> Averaged:
        """Return the damping ratio of mode 0 or 1 [1]."""
        return self._average("damping_ratio", mode)

    def _average(self, name: str, mode: int) -> Averaged:
        values = [float(getattr(fit.modes[mode], name)) for fit in self.fits]
        mean = float(np.mean(values))
        if len(values) == 1:
            return Averaged(mean, math.nan, getattr(self.fits[0].modes[mode], f"{name}_standard_error"))
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
    RingDownError
        If there is no record, or one does not show two decaying modes.
    """
    if not records:
        raise RingDownError("there is no ring-down record; at least one is needed.")
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
