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

from .ringdown import RingDownFit, RingDownMode
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
    damped = 2.0 * math.pi * np.array([mode.damped_frequency for mode in fit.modes])

    def residual(scaled: NDArray[np.float64]) -> NDArray[np.float64]:
        unknown = scaled * scale
        value = _signal(unknown, damped, within)
        return np.concatenate(
            [value.min(axis=1) - unknown[8] - lowest, value.max(axis=1) + unknown[8] - highest]
        )

    start = []
    for mode in fit.modes:
        start += [
            mode.amplitude * math.cos(mode.phase), mode.amplitude * math.sin(mode.phase), mode.decay_rate,
        ]  # fmt: skip
    size = float(np.ptp(record.signal))
    half_line = 0.5 * float(np.percentile(highest - lowest, 10.0))
    scale = np.array([size, size, start[2], size, size, start[5], size, size, size])
    first = np.array([*start, 0.0, 0.0, half_line]) / scale
    found = least_squares(residual, first, method="lm", xtol=1e-10, ftol=1e-12, diff_step=1e-6)
    unknown = found.x * scale
    # Both extremes of a column see the same signal: they count as one reading.
    freedom = max(time.size - unknown.size, 1)
    variance = 2.0 * float(found.cost) / 2.0 / freedom
    covariance = 2.0 * variance * np.linalg.pinv(found.jac.T @ found.jac) * np.outer(scale, scale)
    variances = np.diag(covariance).tolist()
    modes = [
        _refined_mode(mode, number, unknown[3 * number :][:3], variances[3 * number + 2], record.source)
        for number, mode in enumerate(fit.modes)
    ]
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


def _refined_mode(
    mode: RingDownMode, number: int, unknown: NDArray[np.float64], variance: float, source: str
) -> RingDownMode:
    """Return a mode with its fitted cosine, sine and decay rate; `variance` is that of the rate."""
    cosine, sine, decay = (float(value) for value in unknown)
    omega = 2.0 * math.pi * mode.damped_frequency
    if not 0.0 < decay < omega:
        raise RingDownError(
            f"{source}: mode {number + 1} at {mode.damped_frequency:.3g} Hz is not a decaying "
            f"oscillation (rate {decay:.3g} 1/s fitted to the extremes); a ring-down record is needed."
        )
    natural = math.hypot(omega, decay)
    error = math.sqrt(variance)
    return RingDownMode(
        frequency=natural / (2.0 * math.pi),
        damping_ratio=decay / natural,
        damped_frequency=mode.damped_frequency,
        decay_rate=decay,
        amplitude=math.hypot(cosine, sine),
        phase=math.atan2(sine, cosine),
        frequency_standard_error=error * decay / natural / (2.0 * math.pi),
        damping_ratio_standard_error=error * omega**2 / natural**3,
    )
