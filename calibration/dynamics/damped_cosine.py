"""A sum of damped cosines, an offset and a drift: Kapteyn et al. 2021, eq. (22).

A wave is the real part of A exp(s t) with the pole s = -decay rate + i damped angular frequency [1/s].
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from reporting.arrays import Float

ComplexArray = NDArray[np.complex128]

_GREATEST_GROWTH = 50.0  # exponent at the end of a record; an iteration may pass through growing waves
_LEAST_VARIANCE = 1e-200  # that a record without noise, or a wave that is gone, is not divided by
_MOST_EVALUATIONS = 300  # of the least squares, for each unknown


class RingDownMode(NamedTuple):
    """One damped cosine of a record as a mode: Kapteyn et al. 2021, eqs. (23) and (24).

    With the natural angular frequency |s|: f = |s| / 2 pi and zeta = -Re s / |s|. Standard errors are
    propagated to first order with all of the covariance, that between both parts of s too, for independent
    residuals of equal variance. A frequency that was not fitted has the share of Re s alone.

    Attributes
    ----------
    pole : complex
        s [1/s].
    wave : complex
        Amplitude at the start of the record [V].
    covariance : (2, 2) array
        Of Re s and Im s [1/s^2].
    """

    pole: complex
    wave: complex
    covariance: Float

    @property
    def frequency(self) -> float:
        """Natural frequency [Hz]."""
        return abs(self.pole) / (2.0 * math.pi)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio [1]."""
        return -self.pole.real / abs(self.pole)

    @property
    def damped_frequency(self) -> float:
        """Frequency of the damped cosine [Hz]."""
        return self.pole.imag / (2.0 * math.pi)

    @property
    def amplitude(self) -> float:
        """Amplitude at the start of the record [V]."""
        return abs(self.wave)

    @property
    def standard_error(self) -> dict[str, float]:
        """Of `frequency` [Hz] and `damping_ratio` [1], by these names."""
        slopes = zip(("frequency", "damping_ratio"), modal_slopes(self.pole), strict=True)
        return {name: math.sqrt(max(float(slope @ self.covariance @ slope), 0.0)) for name, slope in slopes}


def modal_slopes(pole: complex) -> Float:
    """Return the derivatives (2, 2) of natural frequency [Hz] and damping ratio [1] by Re s and Im s."""
    real, imaginary, size = pole.real, pole.imag, abs(pole)
    of_ratio = np.array([-(imaginary**2), real * imaginary]) / size**3
    return np.array([np.array([real, imaginary]) / size / (2.0 * math.pi), of_ratio])


class Solution(NamedTuple):
    """K waves against C signals of N samples, at given poles.

    Attributes
    ----------
    pole : (K,) array
        s [1/s].
    amplitude : (K, C) array
        Complex, at the first sample [V].
    fitted : (N, C) array
        [V].
    deviation : (C,) array
        Standard deviation of the residuals [V].
    covariance : (U, U) array
        Of the K Re s and K Im s, and for each signal of the K Re A, the K Im A, and the line; zero for
        frequencies that were not fitted.
    seen : (K,) array
        Squared amplitudes over their covariance, summed over the signals: what a wave takes off the sum of
        squares, over its scatter [1].
    """

    pole: ComplexArray
    amplitude: ComplexArray
    fitted: Float
    deviation: Float
    covariance: Float
    seen: Float

    @property
    def modes(self) -> tuple[RingDownMode, ...]:
        """The waves as the first signal has them, in the order of the poles."""
        count = len(self.pole)
        pairs = [np.ix_([at, count + at], [at, count + at]) for at in range(count)]
        return tuple(
            RingDownMode(complex(pole), complex(wave), self.covariance[pair])
            for pole, wave, pair in zip(self.pole, self.amplitude[:, 0], pairs, strict=True)
        )


class DampedCosines:
    """Damped cosines and a line against one record of one or more signals, each with noise of its own.

    A value that is the average over an interval of width w carries g(s) = sinh(s w / 2) / (s w / 2).

    Parameters
    ----------
    time : (N,) array
        [s].
    signal : (N,) or (N, C) array
        [V].
    averaging_width : float
        w [s]; 0 for samples.
    drift : bool
        Whether the line may slope; an offset alone otherwise.
    """

    def __init__(
        self, time: Float, signal: Float, averaging_width: float = 0.0, *, drift: bool = True
    ) -> None:
        self._time = time - time[0]
        self._signal = signal.reshape(len(time), -1)
        self._width = averaging_width
        self._line = np.column_stack([np.ones(time.size), self._time - self._time.mean()])[:, : 1 + drift]

    def residual(self, pole: ComplexArray) -> Float:
        """Return the residuals [V], (N C,), with the best amplitudes, offset and drift."""
        orthogonal = np.linalg.qr(self._basis(self._waves(pole)))[0]
        return np.asarray(self._signal - orthogonal @ (orthogonal.T @ self._signal)).ravel()

    def fit(self, start: NDArray[np.complexfloating], *, frequencies_fitted: bool = True) -> Solution:
        """Return the waves nearest to the record, begun at these poles."""
        count, damped = start.size, start.imag
        scale = np.concatenate([start.real, damped] if frequencies_fitted else [start.real])

        def pole(unknown: Float) -> ComplexArray:
            scaled = unknown * scale
            return np.asarray(scaled[:count] + 1j * (scaled[count:] if frequencies_fitted else damped))

        found = least_squares(
            lambda unknown: self.residual(pole(unknown)),
            np.ones(scale.size),
            method="lm",
            xtol=1e-12,
            ftol=1e-14,
            gtol=1e-14,
            max_nfev=_MOST_EVALUATIONS * scale.size,
        )
        return self.solve(pole(found.x), frequencies_fitted=frequencies_fitted)

    def solve(self, pole: ComplexArray, *, frequencies_fitted: bool = True) -> Solution:
        """Return amplitudes, fitted signals and the covariance at these poles."""
        wave = self._waves(pole)
        basis = self._basis(wave)
        coefficient = np.asarray(np.linalg.lstsq(basis, self._signal, rcond=None)[0], dtype=np.float64)
        count, channels, own = pole.size, self._signal.shape[1], basis.shape[1]
        amplitude = coefficient[:count] + 1j * coefficient[count : 2 * count]
        fitted = basis @ coefficient
        square = np.sum((self._signal - fitted) ** 2, axis=0)
        # by the poles; what averages add to it is in proportion to the wave, as its amplitude is
        moved = self._time[:, None] * wave
        covariance = np.zeros((2 * count + channels * own,) * 2)
        used = np.delete(np.arange(len(covariance)), [] if frequencies_fitted else np.s_[count : 2 * count])
        freedom = max(self._signal.size - used.size, 1)
        variance = np.maximum(square * channels / freedom, _LEAST_VARIANCE)
        information = np.zeros_like(covariance)
        for channel in range(channels):
            turned = moved * amplitude[:, channel]
            columns = np.hstack([turned.real, -turned.imag, basis]) / math.sqrt(variance[channel])
            rows = np.r_[: 2 * count, np.arange(own) + 2 * count + channel * own]
            information[np.ix_(rows, rows)] += columns.T @ columns
        np.fill_diagonal(information, np.maximum(np.diag(information), _LEAST_VARIANCE))
        size = np.sqrt(np.diag(information))[used]
        scaled = information[np.ix_(used, used)] / np.outer(size, size)
        covariance[np.ix_(used, used)] = np.linalg.pinv(scaled, hermitian=True) / np.outer(size, size)
        # what is known of the amplitudes of each wave at these poles, (K, 2, 2)
        spread = np.linalg.pinv(basis.T @ basis)[: 2 * count, : 2 * count].reshape(2, count, 2, count)
        weight = np.linalg.pinv(np.einsum("ikjk->kij", spread))
        pair = coefficient[: 2 * count].reshape(2, count, channels)
        scatter = np.maximum(square / max(len(basis) - own, 1), _LEAST_VARIANCE)
        seen = np.einsum("ikc,kij,jkc,c->k", pair, weight, pair, 1.0 / scatter)
        return Solution(pole, amplitude, fitted, np.sqrt(variance), covariance, seen)

    def _waves(self, pole: ComplexArray) -> ComplexArray:
        s = np.minimum(pole.real, _GREATEST_GROWTH / self._time[-1]) + 1j * pole.imag
        half = 0.5 * s * self._width
        return np.asarray(
            (np.sinh(half) / half if self._width else 1.0) * np.exp(np.multiply.outer(self._time, s))
        )

    def _basis(self, wave: ComplexArray) -> Float:
        return np.hstack([wave.real, -wave.imag, self._line])
