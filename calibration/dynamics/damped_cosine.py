"""Fit a sum of damped cosines, an offset and a drift: Kapteyn et al. 2021, eq. (22).

A damped cosine ("wave") is the real part of A exp(s t) with the complex amplitude A and the pole
s = -decay rate + i damped angular frequency [1/s].
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from reporting.arrays import Float

ComplexArray = NDArray[np.complex128]

_GREATEST_GROWTH = 50.0  # exponent at the end of a record; an iteration may pass through growth
_LEAST_VARIANCE = (
    1e-200  # keeps a record without noise, or a vanished wave, from a division by zero
)
_MOST_EVALUATIONS = 300  # of the least squares, for each unknown


class RingDownMode(NamedTuple):
    """A damped cosine of a record as a mode: Kapteyn et al. 2021, eqs. (23) and (24).

    The natural angular frequency is |s|, so f = |s| / 2 pi and zeta = -Re s / |s|. Standard errors
    are propagated to first order with the full covariance of Re s and Im s, for independent
    residuals of equal variance. If the frequency was not fitted, the variance of Im s is zero.

    Attributes
    ----------
    pole : complex
        The pole s [1/s].
    wave : complex
        The complex amplitude at the start of the record [V].
    covariance : (2, 2) array
        The covariance of Re s and Im s [1/s^2].
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
        """Standard errors of `frequency` [Hz] and `damping_ratio` [1], by these names."""
        frequency_gradient, ratio_gradient = modal_gradients(self.pole)
        return {
            "frequency": self._standard_error_along(frequency_gradient),
            "damping_ratio": self._standard_error_along(ratio_gradient),
        }

    def _standard_error_along(self, gradient: Float) -> float:
        """Return the standard error of a modal value with a gradient (2,) on Re s and Im s."""
        variance = float(gradient @ self.covariance @ gradient)
        return math.sqrt(max(variance, 0.0))


def modal_gradients(pole: complex) -> Float:
    """Return the derivatives of natural frequency and damping ratio by the real and imaginary pole.

    Parameters
    ----------
    pole : complex
        The pole s [1/s].

    Returns
    -------
    (2, 2) array
        The derivatives of the frequency [Hz] and of the damping ratio [1] (rows) with respect to
        Re s and Im s (columns).
    """
    real_part = pole.real
    imaginary_part = pole.imag
    magnitude = abs(pole)
    frequency_gradient = np.array([real_part, imaginary_part]) / magnitude / (2.0 * math.pi)
    ratio_gradient = np.array([-(imaginary_part**2), real_part * imaginary_part]) / magnitude**3
    return np.array([frequency_gradient, ratio_gradient])


class DampedCosineFit(NamedTuple):
    """K waves fitted to C signals of N samples.

    Attributes
    ----------
    pole : (K,) array
        The poles s [1/s].
    amplitude : (K, C) array
        The complex amplitudes at the first sample [V].
    fitted : (N, C) array
        The fitted signals [V].
    deviation : (C,) array
        The standard deviation of the residuals of each signal [V].
    covariance : (U, U) array
        The covariance of the K Re s and K Im s, followed for each signal by the K Re A, the K Im A
        and the coefficients of the line; zero for frequencies that were not fitted.
    chi_square : (K,) array
        The squared amplitudes over their covariance, summed over the signals: the reduction of the
        sum of squares by a wave, over the variance of the residuals [1].
    """

    pole: ComplexArray
    amplitude: ComplexArray
    fitted: Float
    deviation: Float
    covariance: Float
    chi_square: Float

    @property
    def modes(self) -> tuple[RingDownMode, ...]:
        """The waves with their amplitudes in the first signal, in the order of the poles."""
        count = len(self.pole)
        modes = []
        amplitudes_in_first_signal = self.amplitude.T[0].tolist()
        for number, amplitude in enumerate(amplitudes_in_first_signal):
            real_and_imaginary = [number, count + number]
            covariance = self.covariance[np.ix_(real_and_imaginary, real_and_imaginary)]
            pole = complex(self.pole[number])
            modes.append(RingDownMode(pole, amplitude, covariance))
        return tuple(modes)


class DampedCosines:
    """A model of one record: the sum of damped cosines and a line, in one or more signals.

    Each signal has its own noise variance. If the values of the record are averages over intervals
    of width w, the model is averaged too: the average of a wave is the wave times g(s) = sinh(s w /
    2) / (s w / 2).

    Parameters
    ----------
    time : (N,) array
        The times [s].
    signal : (N,) or (N, C) array
        The signals [V].
    averaging_width : float
        The width w of the interval over which each value is an average [s]; 0 for samples.
    drift : bool
        Whether the line may have a slope; otherwise it is an offset.
    """

    def __init__(
        self, time: Float, signal: Float, averaging_width: float = 0.0, *, drift: bool = True
    ) -> None:
        self._time = time - time[0]
        self._signal = signal.reshape(len(time), -1)
        self._averaging_width = averaging_width
        offset = np.ones(time.size)
        if drift:
            self._line = np.column_stack([offset, self._time - self._time.mean()])
        else:
            self._line = offset[:, None]

    def residual(self, poles: ComplexArray) -> Float:
        """Return the residuals (N C,) [V] for poles (K,) [1/s] and the best amplitudes and line."""
        # Variable projection (Golub and Pereyra 1973): the linear unknowns are eliminated by an
        # orthogonal projection on the columns of the basis.
        orthogonal_basis = np.linalg.qr(self._basis(self._waves(poles)))[0]
        fitted_signals = orthogonal_basis @ (orthogonal_basis.T @ self._signal)
        return np.asarray(self._signal - fitted_signals).ravel()

    def fit(
        self, start: NDArray[np.complexfloating], *, frequencies_fitted: bool = True
    ) -> DampedCosineFit:
        """Fit poles, amplitudes and line by nonlinear least squares.

        Parameters
        ----------
        start : (K,) array
            Initial poles [1/s].
        frequencies_fitted : bool
            Whether the damped frequencies are unknown; otherwise they keep their values.
        """
        wave_count = start.size
        if frequencies_fitted:
            start_values = np.concatenate([start.real, start.imag])
        else:
            start_values = np.concatenate([start.real])

        def pole_of(relative_values: Float) -> ComplexArray:
            unknowns = relative_values * start_values
            angular_frequencies = unknowns[wave_count:] if frequencies_fitted else start.imag
            return np.asarray(unknowns[:wave_count] + 1j * angular_frequencies)

        optimum = least_squares(
            lambda relative_values: self.residual(pole_of(relative_values)),
            np.ones(start_values.size),
            method="lm",
            xtol=1e-12,
            ftol=1e-14,
            gtol=1e-14,
            max_nfev=_MOST_EVALUATIONS * start_values.size,
        )
        return self.solve(pole_of(optimum.x), frequencies_fitted=frequencies_fitted)

    def solve(self, pole: ComplexArray, *, frequencies_fitted: bool = True) -> DampedCosineFit:
        """Fit amplitudes and line for fixed poles, and return the covariance.

        Parameters
        ----------
        pole : (K,) array
            The poles s [1/s].
        frequencies_fitted : bool
            Whether the damped frequencies count as unknown in the covariance.
        """
        wave = self._waves(pole)
        basis = self._basis(wave)
        solution = np.linalg.lstsq(basis, self._signal, rcond=None)[0]
        # Rows of the solution: K Re A, K Im A, and the coefficients of the line
        coefficients = np.asarray(solution, dtype=np.float64)
        count = pole.size
        amplitude = coefficients[:count] + 1j * coefficients[count : 2 * count]
        fitted_signals = basis @ coefficients
        sum_of_squares = np.sum((self._signal - fitted_signals) ** 2, axis=0)
        variance, covariance = self._covariance(
            wave, basis, amplitude, sum_of_squares, frequencies_fitted=frequencies_fitted
        )
        return DampedCosineFit(
            pole=pole,
            amplitude=amplitude,
            fitted=fitted_signals,
            deviation=np.sqrt(variance),
            covariance=covariance,
            chi_square=_wave_chi_square(count, basis, coefficients, sum_of_squares),
        )

    def _covariance(
        self,
        wave: ComplexArray,
        basis: Float,
        amplitude: ComplexArray,
        sum_of_squares: Float,
        *,
        frequencies_fitted: bool,
    ) -> tuple[Float, Float]:
        """Return the variance of the residuals (C,), and the covariance (U, U) of all unknowns.

        `wave` (N, K) are the waves of unit amplitude, `basis` (N, B) the basis of a signal's linear
        unknowns, `amplitude` (K, C) the complex amplitudes [V].
        """
        count = wave.shape[1]
        channels = self._signal.shape[1]
        linear_count = basis.shape[1]

        # Variance of the residuals
        unknown_count = 2 * count + channels * linear_count
        fixed = slice(0, 0) if frequencies_fitted else slice(count, 2 * count)
        fitted_unknowns = np.delete(np.arange(unknown_count), fixed)
        degrees_of_freedom = max(self._signal.size - fitted_unknowns.size, 1)
        variance = np.maximum(sum_of_squares * channels / degrees_of_freedom, _LEAST_VARIANCE)

        # Information matrix, the sum of J.T @ J / variance over the signals. A wave has the
        # derivative t exp(s t) A with respect to its pole. That of an averaged wave has a further
        # term proportional to the wave; a change of the amplitude has the same effect, so the
        # covariance of the poles is the same without it.
        wave_derivative = self._time[:, None] * wave
        information = np.zeros((unknown_count, unknown_count))
        for channel in range(channels):
            by_pole = wave_derivative * amplitude[:, channel]
            jacobian = np.hstack([by_pole.real, -by_pole.imag, basis]) / math.sqrt(
                variance[channel]
            )
            first_linear = 2 * count + channel * linear_count
            unknowns = np.r_[: 2 * count, np.arange(linear_count) + first_linear]
            information[np.ix_(unknowns, unknowns)] += jacobian.T @ jacobian
        np.fill_diagonal(information, np.maximum(np.diag(information), _LEAST_VARIANCE))

        # Inverse, scaled to a unit diagonal
        block = np.ix_(fitted_unknowns, fitted_unknowns)
        scale = np.sqrt(np.diag(information))[fitted_unknowns]
        scaled_information = information[block] / np.outer(scale, scale)
        covariance = np.zeros((unknown_count, unknown_count))
        inverse = np.linalg.pinv(scaled_information, hermitian=True)
        covariance[block] = inverse / np.outer(scale, scale)
        return variance, covariance

    def _waves(self, pole: ComplexArray) -> ComplexArray:
        """Return the waves (N, K) of unit amplitude, averaged over the intervals of the record.

        Growth is limited, so that an iteration that passes through it does not overflow.
        """
        decay = np.minimum(pole.real, _GREATEST_GROWTH / self._time[-1])
        s = decay + 1j * pole.imag
        half_exponent = 0.5 * s * self._averaging_width
        averaging_factor = np.sinh(half_exponent) / half_exponent if self._averaging_width else 1.0
        return np.asarray(averaging_factor * np.exp(np.multiply.outer(self._time, s)))

    def _basis(self, wave: ComplexArray) -> Float:
        """Return the basis of a signal's linear unknowns: K Re A, K Im A and the line."""
        # Re(A w) = Re A Re w - Im A Im w
        return np.hstack([wave.real, -wave.imag, self._line])


def _wave_chi_square(count: int, basis: Float, coefficient: Float, sum_of_squares: Float) -> Float:
    """Return the chi-square (K,) of each wave: squared amplitudes over their covariance.

    It is summed over the signals. The first 2 K columns of the basis belong to Re A and Im A;
    `coefficient` (B, C) are the coefficients of each signal.
    """
    channels = coefficient.shape[1]
    # Covariance of Re A and Im A of each wave at unit variance, (K, 2, 2), and its inverse
    unit_covariance = np.linalg.pinv(basis.T @ basis)[: 2 * count, : 2 * count]
    blocks_of_unit_covariance = unit_covariance.reshape(2, count, 2, count)
    inverse_covariance = np.linalg.pinv(np.einsum("ikjk->kij", blocks_of_unit_covariance))
    real_and_imaginary = coefficient[: 2 * count].reshape(2, count, channels)
    degrees_of_freedom = max(len(basis) - basis.shape[1], 1)
    variance = np.maximum(sum_of_squares / degrees_of_freedom, _LEAST_VARIANCE)
    # For each wave k: sum over the signals c of a' W a / variance with a = (Re A, Im A)
    chi_square: Float = np.einsum(
        "ikc,kij,jkc,c->k",
        real_and_imaginary,
        inverse_covariance,
        real_and_imaginary,
        1.0 / variance,
    )
    return chi_square
