"""Two damped modes from the extremes of a record that was read off a plot.

The middle of the ink in a column of pixels is not quite the average of the signal there, while its lowest and
highest points are the signal's extremes within the column, but for the width of the line. A fit to these two
keeps more of a fast mode that dies away within a few columns.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from calibration.errors import RingDownError

from .damped_cosine import RingDownMode
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
    damped = np.array([mode.omega for mode in fit.modes])

    def residual(scaled: NDArray[np.float64]) -> NDArray[np.float64]:
        unknown = scaled * scale
        value = _signal(unknown, damped, within)
        return np.concatenate(
            [value.min(axis=1) - unknown[8] - lowest, value.max(axis=1) + unknown[8] - highest]
        )

    start = [part for mode in fit.modes for part in (mode.wave.real, mode.wave.imag, mode.decay_rate)]
    size = float(np.ptp(record.signal))
    half_line = 0.5 * float(np.percentile(highest - lowest, 10.0))
    scale = np.array([size, size, start[2], size, size, start[5], size, size, size])
    first = np.array([*start, 0.0, 0.0, half_line]) / scale
    found = least_squares(residual, first, method="lm", xtol=1e-10, ftol=1e-12, diff_step=1e-6)
    unknown = found.x * scale
    # Both extremes of a column see the same signal: they count as one reading.
    variance = float(found.cost) / max(time.size - unknown.size, 1)
    covariance = 2.0 * variance * np.linalg.pinv(found.jac.T @ found.jac) * np.outer(scale, scale)
    modes = [
        RingDownMode(
            float(unknown[at + 2]), mode.omega, complex(unknown[at], unknown[at + 1]),
            np.diag([covariance[at + 2, at + 2], 0.0]),
        )
        for at, mode in zip((0, 3), fit.modes, strict=True)
    ]  # fmt: skip
    for number, mode in enumerate(modes, start=1):
        refuse_growing(mode, number, record.source)
    return replace(
        fit,
        modes=(modes[0], modes[1]),
        fitted=_signal(unknown, damped, time),
        residual_deviation=math.sqrt(variance),
    )


def _signal(
    unknown: NDArray[np.float64], damped: NDArray[np.float64], when: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return offset, drift and the decaying modes of the angular frequencies `damped` at some instants."""
    value = unknown[6] + unknown[7] * when
    for number, omega in enumerate(damped.tolist()):
        cosine, sine, decay = unknown[3 * number : 3 * number + 3]
        value = value + np.exp(-decay * when) * (cosine * np.cos(omega * when) - sine * np.sin(omega * when))
    return np.asarray(value)
