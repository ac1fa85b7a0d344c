"""Split a smooth multi-mode motion into its modes by local least squares, ends of the record included."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray

_PERIODS = 2.0  # of the lowest frequency, or of the closest difference, in a window


class MotionByMode(NamedTuple):
    """Motion of each mode: values, rates / angular frequency and amplitudes, (K, N, C) in the unit given."""

    displacement: FloatArray
    velocity: FloatArray
    amplitude: FloatArray


def modal_motion(values: FloatArray, interval: float, frequencies: Sequence[float]) -> MotionByMode | None:
    """Return the part of each mode in a motion.

    In a window of two periods about each sample (at the ends: the first or last whole window) the motion is a
    constant and, for each mode, (a + b t) cos w t + (c + d t) sin w t, fitted by least squares.

    Parameters
    ----------
    values : (N, C) ndarray
        Motion without noise, such as a prediction.
    interval : float
        Sampling interval [s].
    frequencies : sequence of float
        [Hz], about right within a few per cent, below half the sampling rate.

    Returns
    -------
    MotionByMode or None
        None if the record is shorter than a window, or a window cannot tell the frequencies apart.
    """
    if not frequencies:
        return None
    omega = 2.0 * np.pi * np.sort(np.asarray(frequencies, dtype=float))
    apart = min([float(omega[0]), *np.diff(omega).tolist()])
    if omega[-1] * interval >= np.pi or apart <= 0.02 * omega[-1]:
        return None
    count = len(values)
    unknown = 4 * omega.size + 1
    width = max(round(_PERIODS * 2.0 * np.pi / (apart * interval)), 2 * unknown) | 1
    if width > count:
        return None
    tau = interval * (np.arange(width) - width // 2)
    basis = np.linalg.pinv(_columns(tau, omega, tau[-1]))
    windows = np.lib.stride_tricks.sliding_window_view(values, width, axis=0)  # (n - W + 1, C, W)
    coefficient = windows @ basis.T  # (n - W + 1, C, unknown)
    place = np.clip(np.arange(count) - width // 2, 0, count - width)
    late = interval * (np.arange(count) - width // 2 - place)
    local = coefficient[place]
    cosine, sine = np.cos(omega * late[:, np.newaxis]), np.sin(omega * late[:, np.newaxis])
    stretch = (late / tau[-1])[:, np.newaxis]
    parts = []
    for mode in range(omega.size):
        a, b, c, d = (local[:, :, 4 * mode + n] for n in range(4))
        in_phase, quadrature = a + b * stretch, c + d * stretch
        co, si = cosine[:, [mode]], sine[:, [mode]]
        parts.append((in_phase * co + quadrature * si, -in_phase * si + quadrature * co,
                      np.hypot(in_phase, quadrature)))  # fmt: skip
    displacement, velocity, amplitude = (np.stack(rows) for rows in zip(*parts, strict=True))
    return MotionByMode(displacement, velocity, amplitude)


def _columns(tau: FloatArray, omega: FloatArray, scale: float) -> FloatArray:
    columns = []
    for w in omega:
        cosine, sine = np.cos(w * tau), np.sin(w * tau)
        columns += [cosine, tau / scale * cosine, sine, tau / scale * sine]
    return np.column_stack([*columns, np.ones_like(tau)])
