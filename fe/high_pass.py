"""High-pass filters of whole records, exact for signals that are linear between samples."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.signal import fftconvolve
from scipy.special import hyp1f1, rgamma

from fe.runtime.arrays import FloatArray
from fe.runtime.errors import InvalidPatchError
from fe.runtime.patch import Filter
from fe.runtime.sensors import SensorRecord, levels_before_record

_ASYMPTOTIC_FROM = 700.0
"""Above this u the asymptotic series of 1F1 is used: exp(-u) is negligible beside powers of u."""

_ASYMPTOTIC_TERMS = 10
"""Terms of the series, which is then exact to rounding."""

_UNEVEN_SAMPLING = 2e-3
"""Relative deviation of a sampling interval above which a record is resampled."""


def filtered_record(
    sensor: Filter, record: SensorRecord, signal: FloatArray, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Apply the high-pass with the stages of a filter to channels and to their rates.

    The filter needs evenly spaced times; the channels are interpolated to such a grid and back.

    Parameters
    ----------
    record : SensorRecord
        Its times and channels, and whether it was settled, are used.
    signal, slope : (N, C) array
        The channels before the filter, and their rates [1/s].

    Returns
    -------
    signal, slope : (N, C) array
        The channels after the filter, and their rates [1/s].
    """
    time = record.time
    time_constant = sensor.time_constant
    # even grid, twice as fine as the usual step if the sampling is uneven
    steps = np.diff(time)
    count = max(len(time) - 1, 1)
    span = float(time[-1] - time[0])
    if count > 1:
        largest_deviation = np.max(np.abs(steps - span / count))
        is_uneven = largest_deviation > _UNEVEN_SAMPLING * span / count
        if is_uneven:
            count = int(np.ceil(2.0 * span / np.median(steps)))
    grid = np.linspace(time[0], time[-1], count + 1)
    interval = span / count
    signal = _interpolated(grid, time, signal)
    slope = _interpolated(grid, time, slope)
    # signal
    levels_before = levels_before_record(sensor, record, signal[0])
    filtered_signal = high_pass(signal, interval, time_constant, sensor.order, levels_before)
    # rate; each of several whole stages obeys y' = x' - y / tau
    is_whole_order = sensor.order == int(sensor.order)
    if is_whole_order:
        for order in range(1, int(sensor.order) + 1):
            stage_output = high_pass(signal, interval, time_constant, order, levels_before)
            slope = slope - stage_output / time_constant
    else:
        slope = high_pass(slope, interval, time_constant, sensor.order, 0.0)
    return _interpolated(time, grid, filtered_signal), _interpolated(time, grid, slope)


def _interpolated(times: FloatArray, known_times: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate columns (N, C) linearly at new times."""
    columns = [np.interp(times, known_times, column) for column in values.T]
    return np.stack(columns, axis=1)


def high_pass(
    signal: FloatArray,
    interval: float,
    time_constant: float,
    order: float = 1.0,
    levels_before: FloatArray | float | None = None,
) -> FloatArray:
    """Apply the high-pass filter (s tau / (1 + s tau))^order to a signal, linear between samples.

    The response to a unit step is 1F1(order; 1; -t / tau), whose integral is t 1F1(order; 2; -t /
    tau): the inverse of s^(order - 1) tau^order / (1 + s tau)^order, Abramowitz and Stegun 1964,
    13.1.2 termwise. The output is the convolution of the signal's increments with it, exact to
    rounding for every order.

    Parameters
    ----------
    signal : (N, ...) array
        The samples, time along the first axis.
    interval : float
        The sampling interval [s].
    time_constant : float
        The time constant tau [s].
    order : float
        The number of equal first-order stages, not necessarily whole, from 0 to 4.
    levels_before : (...) array or float, optional
        The value of the signal at all times before its first sample; by default that first sample.

    Returns
    -------
    (N, ...) array
        The output at the samples.

    Raises
    ------
    InvalidPatchError
        If interval or time constant are not positive, or the order is not within 0 to 4.
    """
    if not (time_constant > 0.0 and interval > 0.0):
        raise InvalidPatchError(
            "A filter needs a positive time constant and sampling interval, but has "
            f"{time_constant} s and {interval} s."
        )
    if not 0.0 <= order <= 4.0:
        raise InvalidPatchError(f"The order of a high-pass must be within 0 to 4, but is {order}.")
    count = len(signal)
    if count == 0:
        return np.array(signal, dtype=np.float64)
    # convolution of the increments with the response to one of them
    responses = _filter_responses(count, interval / time_constant, float(order))
    rows = np.asarray(signal, dtype=np.float64).reshape(count, -1)
    increments = np.diff(rows, axis=0, prepend=rows[:1])
    output = fftconvolve(increments, responses.increment[:, None], axes=0)[:count]
    # the jump from the level before the record to the first sample
    if levels_before is not None:
        level_row = np.broadcast_to(levels_before, np.shape(signal)[1:]).reshape(-1)
        jump = rows[0] - level_row
        output = output + responses.step[:, None] * jump
    return np.asarray(output.reshape(np.shape(signal)))


class _Responses(NamedTuple):
    """Responses of a high-pass filter at the samples.

    Attributes
    ----------
    step : (N,) array
        The response to a unit step.
    increment : (N,) array
        The response to a unit increment that is spread over one interval: entry k is the mean of
        the step response over the interval k.
    """

    step: FloatArray
    increment: FloatArray


@lru_cache(maxsize=32)
def _filter_responses(count: int, ratio: float, order: float) -> _Responses:
    """Return the responses of a filter at `count` samples; `ratio` is the interval over tau."""
    u: FloatArray = ratio * np.arange(count + 1, dtype=np.float64)
    integral = u * _confluent(order, 2, u)
    return _Responses(step=_confluent(order, 1, u[:-1]), increment=np.diff(integral) / ratio)


def _confluent(order: float, second: int, u: FloatArray) -> FloatArray:
    """Return the confluent hypergeometric function 1F1(order; second; -u) for u (N,) >= 0.

    For large u its asymptotic series is used, Abramowitz and Stegun 1964, 13.5.1: SciPy's function
    is infinite from about u = 1418 on.
    """
    exact = hyp1f1(order, second, -np.minimum(u, _ASYMPTOTIC_FROM))
    large_u = np.maximum(u, _ASYMPTOTIC_FROM)
    term = rgamma(second - order) * large_u**-order
    series = np.zeros_like(u)
    for k in range(_ASYMPTOTIC_TERMS):
        series += term
        term = term * (order + k) * (order - second + 1 + k) / ((k + 1) * large_u)
    return np.where(u > _ASYMPTOTIC_FROM, series, exact)
