"""First-order high-pass filters in series, of any order, exact for signals that are linear between samples.

NumPy and standard library only: this file is copied into the FMU.
"""

from functools import lru_cache
from math import gamma

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray
from .errors import InvalidPatchError

_SERIES_LIMIT = 30.0  # beyond it the asymptotic series of the confluent function is exact to rounding


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
    step, spectrum, length = _kernel(count, interval / time_constant, float(order))
    shape = signal.shape
    rows = np.ascontiguousarray(np.asarray(signal, dtype=np.float64).reshape(count, -1).T)
    increments = np.zeros((len(rows), count))
    np.subtract(rows[:, 1:], rows[:, :-1], out=increments[:, 1:])
    output = np.fft.irfft(np.fft.rfft(increments, length) * spectrum, length)[:, :count].T
    if held is not None:
        jump = rows[:, 0] - np.broadcast_to(held, shape[1:]).reshape(-1)
        if np.any(jump):
            output = output + step[:, np.newaxis] * jump
    return output.reshape(shape)


@lru_cache(maxsize=32)
def _kernel(count: int, ratio: float, order: float) -> tuple[FloatArray, NDArray[np.complex128], int]:
    """Return step response, spectrum of the ramp's kernel and the length of the transform.

    `ratio` is the sampling interval over tau. Entry k of the kernel is what is left, k samples later, of a
    unit increment that was spread over one interval: the mean of the step response over that interval.
    """
    u: FloatArray = ratio * np.arange(count + 1, dtype=np.float64)
    integral = u * _confluent(order, 2, u)
    ramp = np.diff(integral) / ratio
    step = _confluent(order, 1, u[:-1])
    length = 1 << (2 * count - 1).bit_length()
    return step, np.fft.rfft(ramp, length), length


def _confluent(order: float, b: int, u: FloatArray) -> FloatArray:
    """Return 1F1(order; b; -u) for u >= 0, b = 1 or 2.

    Kummer's transformation turns it into e^-u 1F1(b - order; b; u), whose series has terms of one sign (after
    finitely many); far out the asymptotic series takes over (Abramowitz and Stegun 1964, 13.1.27, 13.5.1).
    """
    a = b - order
    if a <= 0.0 and float(a).is_integer():  # whole orders: a polynomial times e^-u
        return np.exp(-u) * _polynomial(int(-a), b, u)
    if order == 1.0:
        return np.where(u > 0.0, -np.expm1(-u) / np.where(u > 0.0, u, 1.0), 1.0)
    near = u <= _SERIES_LIMIT
    result = np.empty_like(u)
    x = u[near]
    term = np.ones_like(x)
    total = np.ones_like(x)
    for k in range(160):
        term = term * ((a + k) / ((b + k) * (k + 1.0))) * x
        total += term
    result[near] = np.exp(-x) * total
    x = u[~near]
    if x.size:
        term = np.ones_like(x)
        total = np.ones_like(x)
        for k in range(24):
            term = term * ((order + k) * (order - b + 1.0 + k) / ((k + 1.0) * x))
            total += term
        result[~near] = gamma(b) / gamma(a) * x**-order * total
    return result


def _polynomial(degree: int, b: int, u: FloatArray) -> FloatArray:
    """Return the terminating series 1F1(-degree; b; u)."""
    term = np.ones_like(u)
    total = np.ones_like(u)
    for k in range(degree):
        term = term * ((k - degree) / ((b + k) * (k + 1.0))) * u
        total = total + term
    return total
