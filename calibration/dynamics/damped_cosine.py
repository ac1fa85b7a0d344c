"""A sum of damped cosines, an offset and a drift: Kapteyn et al. 2021, eq. (22)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

_GREATEST_GROWTH = 50.0  # exponent at the end of a record; an iteration may pass through growing waves


class Solution(NamedTuple):
    """The fitted signal at given decay rates and frequencies.

    `amplitude` (K,) holds the complex amplitudes at the first sample [V]; `covariance` (2 K, 2 K) belongs to
    the K decay rates and then the K angular frequencies [1/s, rad/s], zero for those that were not fitted.
    """

    amplitude: NDArray[np.complex128]
    fitted: NDArray[np.float64]
    residual_deviation: float
    covariance: NDArray[np.float64]


class Search(NamedTuple):
    """Decay rates (K,) [1/s] and angular frequencies (K,) [rad/s], and half the sum of squares there."""

    decay: NDArray[np.float64]
    omega: NDArray[np.float64]
    cost: float


class DampedCosines:
    """K damped cosines against one record.

    The signal is the real part of sum_k A_k g(s_k) exp(s_k t) with s_k = -decay_k + i omega_k, plus a line.
    A value that is the average over an interval of width w carries g(s) = sinh(s w / 2) / (s w / 2).

    Parameters
    ----------
    time, signal : (N,) array
        The record [s], [V].
    averaging_width : float
        w [s]; 0 for samples.
    """

    def __init__(
        self, time: NDArray[np.float64], signal: NDArray[np.float64], averaging_width: float
    ) -> None:
        self._time = time - time[0]
        self._signal = signal
        self._width = averaging_width
        self._line = np.column_stack([np.ones(time.size), self._time - self._time.mean()])

    def residual(self, decay: NDArray[np.float64], omega: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the residuals [V], (N,), with the best amplitudes, offset and drift."""
        basis = self._basis(decay, omega)
        orthogonal = np.linalg.qr(basis)[0]
        return np.asarray(self._signal - orthogonal @ (orthogonal.T @ self._signal))

    def fitted(
        self, decay: NDArray[np.float64], omega: NDArray[np.float64], *, frequencies_fitted: bool = True
    ) -> Search:
        """Return the decay rates and frequencies nearest to the record, begun at these."""
        scale = np.concatenate([decay, omega]) if frequencies_fitted else decay

        def residual(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
            scaled = unknown * scale
            return self.residual(scaled[: decay.size], scaled[decay.size :] if frequencies_fitted else omega)

        found = least_squares(residual, np.ones(scale.size), method="lm", xtol=1e-12, ftol=1e-14, gtol=1e-14)
        best = found.x * scale
        return Search(
            best[: decay.size], best[decay.size :] if frequencies_fitted else omega, float(found.cost)
        )

    def solve(
        self, decay: NDArray[np.float64], omega: NDArray[np.float64], *, frequencies_fitted: bool
    ) -> Solution:
        """Return amplitudes, fitted signal and the covariance of decay rates and frequencies."""
        basis = self._basis(decay, omega)
        coefficient = np.linalg.lstsq(basis, self._signal, rcond=None)[0]
        fitted = basis @ coefficient
        modes = decay.size
        amplitude = coefficient[0 : 2 * modes : 2] - 1j * coefficient[1 : 2 * modes : 2]
        slope = np.stack([self._derivative(-d + 1j * w) for d, w in zip(decay, omega, strict=True)])
        slope = amplitude[:, np.newaxis] * slope
        columns = [*(-slope).real] + ([*(1j * slope).real] if frequencies_fitted else [])
        jacobian = np.column_stack([*columns, basis])
        # Columns of very different size: scale before inverting.
        size = np.linalg.norm(jacobian, axis=0)
        inverse = np.linalg.pinv(jacobian / size)
        freedom = max(self._signal.size - jacobian.shape[1], 1)
        variance = float(np.sum((self._signal - fitted) ** 2)) / freedom
        covariance = variance * (inverse @ inverse.T) / np.outer(size, size)
        whole = np.zeros((2 * modes, 2 * modes))
        count = len(columns)
        whole[:count, :count] = covariance[:count, :count]
        return Solution(amplitude, fitted, variance**0.5, whole)

    def _basis(self, decay: NDArray[np.float64], omega: NDArray[np.float64]) -> NDArray[np.float64]:
        columns = []
        for d, w in zip(decay, omega, strict=True):
            s = -max(d, -_GREATEST_GROWTH / self._time[-1]) + 1j * w
            wave = self._gain(s) * np.exp(s * self._time)
            columns += [wave.real, wave.imag]
        return np.column_stack([*columns, self._line])

    def _gain(self, s: complex) -> complex:
        half = 0.5 * s * self._width
        return complex(np.sinh(half) / half) if self._width else 1.0 + 0.0j

    def _derivative(self, s: complex) -> NDArray[np.complex128]:
        """Return d/ds of g(s) exp(s t)."""
        half = 0.5 * s * self._width
        slope = 0.5 * self._width * (np.cosh(half) / half - np.sinh(half) / half**2) if self._width else 0.0
        return np.asarray((slope + self._gain(s) * self._time) * np.exp(s * self._time))


class RingDownMode(NamedTuple):
    """One damped cosine of a record as a mode: Kapteyn et al. 2021, eqs. (23) and (24).

    With the natural angular frequency w_n = sqrt(s^2 + w_d^2): f = w_n / 2 pi and zeta = s / w_n. Standard
    errors are propagated to first order with all of the covariance, that between s and w_d too, for
    independent residuals of equal variance. A frequency that was not fitted has the share of s alone.

    Attributes
    ----------
    decay_rate, omega : float
        s [1/s], and the damped angular frequency w_d [rad/s].
    wave : complex
        Amplitude at the start of the cropped record [V].
    covariance : (2, 2) array
        Of decay rate and damped angular frequency [1/s^2].
    """

    decay_rate: float
    omega: float
    wave: complex
    covariance: NDArray[np.float64]

    @property
    def natural(self) -> float:
        """Natural angular frequency [rad/s]."""
        return math.hypot(self.omega, self.decay_rate)

    @property
    def frequency(self) -> float:
        """Natural frequency [Hz]."""
        return self.natural / (2.0 * math.pi)

    @property
    def damping_ratio(self) -> float:
        """Damping ratio [1]."""
        return self.decay_rate / self.natural

    @property
    def damped_frequency(self) -> float:
        """Frequency of the damped cosine [Hz]."""
        return self.omega / (2.0 * math.pi)

    @property
    def amplitude(self) -> float:
        """Amplitude at the start of the cropped record [V]."""
        return abs(self.wave)

    @property
    def phase(self) -> float:
        """Phase there [rad]."""
        return math.atan2(self.wave.imag, self.wave.real)

    @property
    def frequency_standard_error(self) -> float:
        """Of the natural frequency [Hz]."""
        return self._error(np.array([self.decay_rate, self.omega]) / self.natural / (2.0 * math.pi))

    @property
    def damping_ratio_standard_error(self) -> float:
        """Of the damping ratio [1]."""
        return self._error(np.array([self.omega**2, -self.decay_rate * self.omega]) / self.natural**3)

    def _error(self, slope: NDArray[np.float64]) -> float:
        return math.sqrt(max(float(slope @ self.covariance @ slope), 0.0))


def modes_of(found: Search, solution: Solution) -> tuple[RingDownMode, ...]:
    """Return the modes of a solution by ascending frequency."""
    count = found.decay.size
    return tuple(
        RingDownMode(
            float(found.decay[at]),
            float(found.omega[at]),
            complex(solution.amplitude[at]),
            solution.covariance[np.ix_([at, count + at], [at, count + at])],
        )
        for at in np.argsort(found.omega)
    )
