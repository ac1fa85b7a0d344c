"""The remainder: what a hypothesis leaves beside the noise, as a coloured process of each channel.

No model of a real thing leaves white noise. Each channel may carry a stationary Gaussian process of zero mean
with the covariance s^2 exp(-t / tau) cos(omega t) (Ornstein and Uhlenbeck where omega is nought), beside its
white noise of variance one. As a state space process with two states it is whitened by one pass of a Kalman
filter, whatever the time stamps: with size, time and frequency given, the remainder is a linear filter of
residuals and derivatives and a log determinant. Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63, 425-464;
Foreman-Mackey et al. 2017, Astron. J. 154, 220, for the kernel. Trials at rest have none.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

from .trial_data import TrialData

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Remainder:
    """Remainders of all channels.

    Attributes
    ----------
    size : (channels,) ndarray
        Standard deviation over that of the channel's white noise; nought without one.
    time : (channels,) ndarray
        tau, over which it forgets [s].
    angular_frequency : (channels,) ndarray
        omega [rad/s]; nought for a process that does not swing.
    of_noise : (channels,) ndarray of bool
        Where it is the colour of the noise itself: both together then have the variance of the noise record.
    """

    size: FloatArray
    time: FloatArray
    angular_frequency: FloatArray
    of_noise: NDArray[np.bool_]

    @classmethod
    def none(cls, channels: int) -> "Remainder":
        """Return no remainder in any channel."""
        return cls(np.zeros(channels), np.ones(channels), np.zeros(channels), np.zeros(channels, dtype=bool))

    @property
    def acts(self) -> bool:
        """Whether a channel has a remainder."""
        return bool(np.any(self.size > 0.0))

    @property
    def beyond_noise(self) -> FloatArray:
        """Sizes (channels,) of what is left beside the noise, its own colour not counted."""
        return np.where(self.of_noise, 0.0, self.size)

    def _variance(self, channel: int) -> float:
        """Return the variance of noise and colour together, over the unit that residuals are divided by."""
        return 1.0 + float(self.size[channel]) ** 2 if self.of_noise[channel] else 1.0

    def of(self, channel: int) -> tuple[float, float, float]:
        """Return size, time and frequency of a channel."""
        return float(self.size[channel]), float(self.time[channel]), float(self.angular_frequency[channel])

    def whitened(self, data: TrialData, columns: FloatArray, channels: Any = None) -> FloatArray:
        """Return standardised columns (..., N, C) of a trial made white.

        Parameters
        ----------
        data : TrialData
            Of the trial.
        columns : (..., N, C) ndarray
            Over s0; noughts where samples do not count.
        channels : sequence of int, optional
            Which columns of the trial these are; all if left out.
        """
        if not data.trial.is_dynamic:
            return columns
        chosen = range(len(data.groups)) if channels is None else channels
        found = columns
        for place, column in enumerate(chosen):
            group = int(data.groups[column])
            if self.size[group] <= 0.0:
                continue
            if found is columns:
                found = columns.copy()
            used = data.weight[:, column] > 0.0
            gains, _ = filter_gains(data.steps, used, *self.of(group))
            series = np.ascontiguousarray(columns[..., place].reshape(-1, len(used)))
            white = kernels()[1](series, gains, used) * np.sqrt(self._variance(group))
            found[..., place] = white.reshape(columns[..., place].shape)
        return found

    def log_determinant(self, data: TrialData) -> float:
        """Return half the log determinant of a trial's covariance [nat], noise of variance one."""
        if not data.trial.is_dynamic:
            return 0.0
        total = 0.0
        for column, group in enumerate(data.groups.tolist()):
            if self.size[group] > 0.0:
                used = data.weight[:, column] > 0.0
                total += filter_gains(data.steps, used, *self.of(group))[1]
                total -= 0.5 * float(used.sum()) * float(np.log(self._variance(group)))
        return total


def filter_gains(
    steps: FloatArray, used: NDArray[np.bool_], size: float, time: float, angular_frequency: float
) -> tuple[FloatArray, float]:
    """Return what the filter does at each sample, and half the log determinant [nat].

    Parameters
    ----------
    steps : (N,) ndarray
        Time since the sample before [s]; the first is not used.
    used : (N,) ndarray of bool
        Samples that count.
    size, time, angular_frequency : float
        Of the remainder.

    Returns
    -------
    gains : (N, 5) ndarray
        Transition (cosine and sine with the decay), gains of both states, one over the deviation of the
        innovation.
    half_log_determinant : float
        Of the covariance.
    """
    gains = np.empty((len(steps), 5))
    return gains, float(kernels()[0](steps, used, size, time, angular_frequency, gains))


def innovations(
    series: FloatArray, steps: FloatArray, used: NDArray[np.bool_], size: float, time: float, frequency: float
) -> tuple[float, float]:
    """Return the sum of squares of the whitened series, and half the log determinant [nat]."""
    square, half = kernels()[2](series, steps, used, size, time, frequency)
    return float(square), float(half)


@cache
def kernels() -> tuple[Any, Any, Any]:
    """Return the compiled loops: gains, filter, and sum of squares."""
    return compiled(_gains), compiled(_filtered), compiled(_square, error_model="numpy")


def _gains(
    steps: FloatArray, used: NDArray[np.bool_], size: float, time: float, frequency: float, gains: FloatArray
) -> float:
    variance = size * size
    p, c, q = variance, 0.0, variance  # covariance of both states before a sample
    last, cosine, sine, decay = -1.0, 0.0, 0.0, 0.0
    half = 0.0
    for t in range(len(steps)):
        if t > 0:
            if steps[t] != last:
                last = steps[t]
                decay = np.exp(-last / time)
                cosine, sine = decay * np.cos(frequency * last), decay * np.sin(frequency * last)
            fresh = variance * (1.0 - decay * decay)
            before, between, behind = p, c, q
            p = cosine * cosine * before + 2.0 * cosine * sine * between + sine * sine * behind + fresh
            q = sine * sine * before - 2.0 * cosine * sine * between + cosine * cosine * behind + fresh
            c = cosine * sine * (behind - before) + (cosine * cosine - sine * sine) * between
        gains[t, 0], gains[t, 1] = cosine, sine
        if used[t]:
            total = p + 1.0
            gains[t, 2], gains[t, 3] = p / total, c / total
            gains[t, 4] = 1.0 / np.sqrt(total)
            half += 0.5 * np.log(total)
            q -= c * c / total
            p, c = p / total, c / total
        else:
            gains[t, 2], gains[t, 3], gains[t, 4] = 0.0, 0.0, 0.0
    return half


def _filtered(series: FloatArray, gains: FloatArray, used: NDArray[np.bool_]) -> FloatArray:
    white = np.zeros(series.shape)
    for row in range(series.shape[0]):
        a, b = 0.0, 0.0
        for t in range(series.shape[1]):
            cosine, sine = gains[t, 0], gains[t, 1]
            a, b = cosine * a + sine * b, cosine * b - sine * a
            if used[t]:
                rest = series[row, t] - a
                white[row, t] = rest * gains[t, 4]
                a += gains[t, 2] * rest
                b += gains[t, 3] * rest
    return white


def _square(
    series: FloatArray,
    steps: FloatArray,
    used: NDArray[np.bool_],
    size: float,
    time: float,
    frequency: float,
) -> tuple[float, float]:
    variance = size * size
    p, c, q = variance, 0.0, variance
    a, b = 0.0, 0.0
    last, cosine, sine, decay = -1.0, 0.0, 0.0, 0.0
    square, half, product = 0.0, 0.0, 1.0
    for t in range(len(steps)):
        if t > 0:
            if steps[t] != last:
                last = steps[t]
                decay = np.exp(-last / time)
                cosine, sine = decay * np.cos(frequency * last), decay * np.sin(frequency * last)
            fresh = variance * (1.0 - decay * decay)
            before, between, behind = p, c, q
            p = cosine * cosine * before + 2.0 * cosine * sine * between + sine * sine * behind + fresh
            q = sine * sine * before - 2.0 * cosine * sine * between + cosine * cosine * behind + fresh
            c = cosine * sine * (behind - before) + (cosine * cosine - sine * sine) * between
            a, b = cosine * a + sine * b, cosine * b - sine * a
        if used[t]:
            total = p + 1.0
            share = 1.0 / total
            rest = series[t] - a
            square += rest * rest * share
            product *= total
            if product > 1e200:  # a logarithm now and then is enough
                half += 0.5 * np.log(product)
                product = 1.0
            a += p * share * rest
            b += c * share * rest
            q -= c * c * share
            p, c = p * share, c * share
    return square, half + 0.5 * np.log(product)
