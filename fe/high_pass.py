"""High-pass filters of whole records, of any order, exact for signals that are linear between samples."""

from functools import lru_cache

import numpy as np
from scipy.signal import fftconvolve
from scipy.special import hyp1f1, rgamma

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import HighPass
from fe.runtime.sensors import SensorRecord, levels_before_record

FAR, TERMS = 700.0, 10
"""Beyond which exp(-u) is nothing beside powers of u, and how many of these are taken, to rounding."""


def filtered_record(
    item: HighPass, record: SensorRecord, signal: FloatArray, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pass columns (N, C) of a record, and their rates, through a filter, on an even grid and back."""
    time, tau = record.time, item.time_constant
    count, span, steps = max(len(time) - 1, 1), float(time[-1] - time[0]), np.diff(time)
    if count > 1 and np.max(np.abs(steps - span / count)) > 2e-3 * span / count:
        count = int(np.ceil(2.0 * span / np.median(steps)))  # a grid twice as fine as the usual step
    grid, interval = np.linspace(time[0], time[-1], count + 1), span / count
    signal, slope = _at(grid, time, signal), _at(grid, time, slope)
    held = levels_before_record(item, record, signal[0])
    shown = high_pass(signal, interval, tau, item.order, held)
    if item.order == int(item.order):  # each stage obeys y' = x' - y / tau
        for order in range(1, int(item.order) + 1):
            slope = slope - high_pass(signal, interval, tau, order, held) / tau
    else:
        slope = high_pass(slope, interval, tau, item.order, 0.0)
    return _at(time, grid, shown), _at(time, grid, slope)


def _at(times: FloatArray, known: FloatArray, values: FloatArray) -> FloatArray:
    """Return columns (N, C) that are known at some times at others, linear in between."""
    return np.stack([np.interp(times, known, column) for column in values.T], axis=1)


def high_pass(
    signal: FloatArray,
    interval: float,
    time_constant: float,
    order: float = 1.0,
    held: FloatArray | float | None = None,
) -> FloatArray:
    """Return the output of (s tau / (1 + s tau))^order for a signal that is linear between its samples.

    The response to a unit step is 1F1(order; 1; -t / tau), whose integral is t 1F1(order; 2; -t / tau): the
    inverse of s^(order - 1) tau^order / (1 + s tau)^order, Abramowitz and Stegun 1964, 13.1.2 termwise. The
    output is the convolution of the signal's increments with it, exact to rounding for every order.

    Parameters
    ----------
    signal : (N, ...) ndarray
        Samples, time along the first axis.
    interval : float
        Of sampling [s].
    time_constant : float
        tau [s].
    order : float
        Number of equal first-order stages, not necessarily whole, from 0 to 4.
    held : (...) ndarray or float, optional
        Value that the signal had held for ever before its first sample; that first sample by default.

    Raises
    ------
    InvalidPatchError
        If interval or time constant are not positive, or the order is not within 0 to 4.
    """
    if not (time_constant > 0.0 and interval > 0.0):
        raise InvalidPatchError(
            f"A high-pass needs a positive time constant and sampling interval, but has {time_constant} s "
            f"and {interval} s."
        )
    if not 0.0 <= order <= 4.0:
        raise InvalidPatchError(f"The order of a high-pass must be within 0 to 4, but is {order}.")
    count = len(signal)
    if count == 0:
        return np.array(signal, dtype=np.float64)
    step, ramp = _kernel(count, interval / time_constant, float(order))
    rows = np.asarray(signal, dtype=np.float64).reshape(count, -1)
    output = fftconvolve(np.diff(rows, axis=0, prepend=rows[:1]), ramp[:, None], axes=0)[:count]
    if held is not None:
        jump = rows[0] - np.broadcast_to(held, np.shape(signal)[1:]).reshape(-1)
        output = output + step[:, None] * jump
    return np.asarray(output.reshape(np.shape(signal)))


@lru_cache(maxsize=32)
def _kernel(count: int, ratio: float, order: float) -> tuple[FloatArray, FloatArray]:
    """Return the responses (N,) to a unit step and to a unit increment that is spread over one interval.

    `ratio` is the sampling interval over tau. Entry k of the second is what is left, k samples later, of the
    increment: the mean of the step response over that interval.
    """
    u: FloatArray = ratio * np.arange(count + 1, dtype=np.float64)
    return _confluent(order, 1, u[:-1]), np.diff(u * _confluent(order, 2, u)) / ratio


def _confluent(order: float, second: int, u: FloatArray) -> FloatArray:
    """Return 1F1(order; second; -u) for u from 0 on and a `second` of 1 or 2.

    Far out by its asymptotic series, Abramowitz and Stegun 1964, 13.5.1: SciPy's is infinite about u = 1418.
    """
    near, far = hyp1f1(order, second, -np.minimum(u, FAR)), np.maximum(u, FAR)
    term = rgamma(second - order) * far**-order
    series = np.zeros_like(u)
    for k in range(TERMS):
        series += term
        term = term * (order + k) * (order - second + 1 + k) / ((k + 1) * far)
    return np.where(u > FAR, series, near)
