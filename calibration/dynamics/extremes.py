"""Two damped modes from the extremes of a record that was read off a plot.

The middle of the ink in a column of pixels is not quite the average of the signal there, while its lowest and
highest points are the signal's extremes within the column, but for the width of the line. A fit to these two
keeps more of a fast mode that dies away within a few columns.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from calibration.errors import RingDownError

from .damped_cosine import FloatArray, RingDownMode, damped_waves
from .ringdown import RingDownFit, refuse_growing
from .trials import RingDownTrials

_POINTS = 17  # instants within a column at which the model is evaluated


def refine_by_extremes(trials: RingDownTrials) -> RingDownTrials:
    """Fit amplitudes, phases and decay rates anew to the extremes; damped frequencies stay as found.

    Raises
    ------
    RingDownError
        If a record has no extremes, or a mode no longer decays.
    """
    return RingDownTrials(tuple(_refine(fit) for fit in trials.fits))


def _refine(fit: RingDownFit) -> RingDownFit:
    record = fit.record
    if record.lowest is None or record.highest is None:
        raise RingDownError(
            f"{record.source}: the record has no lowest and highest values; only one read off a plot does."
        )
    lowest, highest = record.lowest, record.highest
    time = record.time - record.time[0]
    within = time[:, np.newaxis] + np.linspace(-0.5, 0.5, _POINTS) * record.averaging_width
    poles, waves = (np.array([getattr(mode, name) for mode in fit.modes]) for name in ("pole", "wave"))

    def signal(unknown: FloatArray, when: FloatArray) -> FloatArray:
        """Return offset, drift and the decaying modes at some instants."""
        wave = damped_waves(unknown[4:6] + 1j * poles.imag, when) @ (unknown[:2] + 1j * unknown[2:4])
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
