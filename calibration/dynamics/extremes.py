"""Fit two modes to the extremes of a record that was read off a plot.

In a column of pixels, the middle of the ink is not quite the average of the signal, while its
lowest and highest points are the extremes of the signal within the column, except for the width of
the line. A fit to these two retains more of a fast mode that dies away within a few columns.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from calibration.errors import ExperimentDataError
from reporting.arrays import Float

from .damped_cosine import ComplexArray, RingDownMode
from .trials import Fits, RingDownFit, refuse_growing

_INSTANTS = 17  # within a column of pixels, at which the model is evaluated


def refine_by_extremes(trials: Fits) -> Fits:
    """Fit trials again, to the extremes of their records.

    Amplitudes, phases, decay rates, offset, drift and the thickness of the drawn line are fitted;
    damped frequencies keep their values.

    Raises
    ------
    ExperimentDataError
        If a record has no extremes, or a mode no longer decays.
    """
    return tuple(_refine_by_extremes(fit) for fit in trials)


class _ExtremesUnknowns(NamedTuple):
    """The unknowns of a fit to the extremes of a record, an array (9,) for the solver.

    Attributes
    ----------
    wave : (2,) array
        The complex amplitudes at the start [V].
    decay : (2,) array
        The real parts of the poles [1/s].
    offset, drift : float
        The coefficients of the line [V] and [V/s].
    half_line : float
        Half the thickness of the drawn line [V].
    """

    wave: ComplexArray
    decay: Float
    offset: float
    drift: float
    half_line: float

    @classmethod
    def from_array(cls, values: Float) -> "_ExtremesUnknowns":
        return cls(
            wave=values[:2] + 1j * values[2:4],
            decay=values[4:6],
            offset=values[6],
            drift=values[7],
            half_line=values[8],
        )

    def signal(self, time: Float, omega: Float) -> Float:
        """Return the signal at times [s], for damped angular frequencies (2,) [1/s]."""
        wave = np.exp(np.multiply.outer(time, self.decay + 1j * omega)) @ self.wave
        return np.asarray(self.offset + self.drift * time + wave.real)


def _refine_by_extremes(fit: RingDownFit) -> RingDownFit:
    """Fit one trial to the extremes of its record, starting from its previous fit.

    In each column of pixels the record has the lowest and the highest ink. The model signal is
    evaluated at several times in a column; its extremes, extended by half the thickness of the
    line, are fitted to the ink.
    """
    record = fit.record
    if record.lowest is None or record.highest is None:
        raise ExperimentDataError(
            f"{record.source}: the record has no lowest and highest values; only a record read off "
            "a plot has them."
        )
    lowest = record.lowest
    highest = record.highest
    pole = np.array([mode.pole for mode in fit.modes])
    wave = np.array([mode.wave for mode in fit.modes])
    time = record.time - record.time[0]
    offsets_in_column = np.linspace(-0.5, 0.5, _INSTANTS) * record.averaging_width
    times_in_columns = time[:, np.newaxis] + offsets_in_column

    # Unknowns are scaled to about one: amplitudes by the range of the signal, decays by the start.
    signal_range = float(np.ptp(record.signal))
    scale = np.array(
        [
            signal_range,
            signal_range,
            signal_range,
            signal_range,
            *np.abs(pole.real),
            signal_range,
            signal_range,
            signal_range,
        ]
    )
    half_line = 0.5 * float(np.percentile(highest - lowest, 10.0))
    start = np.array([*wave.real, *wave.imag, *pole.real, 0.0, 0.0, half_line]) / scale

    def residual(relative_values: Float) -> Float:
        unknowns = _ExtremesUnknowns.from_array(relative_values * scale)
        signal = unknowns.signal(times_in_columns, pole.imag)
        lowest_ink = signal.min(axis=1) - unknowns.half_line
        highest_ink = signal.max(axis=1) + unknowns.half_line
        return np.hstack([lowest_ink - lowest, highest_ink - highest])

    optimum = least_squares(residual, start, method="lm", xtol=1e-10, ftol=1e-12, diff_step=1e-6)
    unknowns = _ExtremesUnknowns.from_array(optimum.x * scale)

    # Both extremes of a column see the same signal, so they count as one reading.
    degrees_of_freedom = max(time.size - optimum.x.size, 1)
    variance = float(optimum.cost) / degrees_of_freedom
    inverse = np.linalg.pinv(optimum.jac.T @ optimum.jac)
    covariance = 2.0 * variance * inverse * np.outer(scale, scale)
    decay_variance = np.diag(covariance)[4:6]
    low, high = (
        RingDownMode(
            pole=complex(unknowns.decay[mode], pole[mode].imag),
            wave=complex(unknowns.wave[mode]),
            covariance=np.diag([decay_variance[mode], 0.0]),
        )
        for mode in (0, 1)
    )
    refuse_growing((low, high), record.source)
    return replace(
        fit,
        modes=(low, high),
        fitted=unknowns.signal(time, pole.imag),
        residual_deviation=math.sqrt(variance),
    )
