"""Identify the poles of a system from the correlations of its outputs, by subspace methods.

The correlations of the response to white noise decay like free vibration. A realisation as by Ho
and Kalman (1966) therefore gives the poles from the block Hankel matrix of the correlations.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from reporting.arrays import Float

from .damped_cosine import ComplexArray

LARGEST_RATIO = 0.3
"""Largest damping ratio of a mode of a structure."""
_FALSE_MODE_PROBABILITY = 1e-3
"""Probability of a mode at any frequency if a record is noise alone."""


class IdentifiedPoles(NamedTuple):
    """P poles with positive frequency, identified from the record of A accelerometers.

    Attributes
    ----------
    pole : (P,) array
        The poles s [1/s].
    shape : (P, A) array
        The complex mode shapes.
    contribution : (P,) array
        The norm of each pole's contribution to the record or to its correlations.
    chi_square : (P,) array
        The reduction of the sum of squares by each pole, divided by the variance; it has a
        chi-square distribution if there is only noise.
    frequency_count : int
        The number of independent frequencies at which noise could have given a pole.
    """

    pole: ComplexArray
    shape: ComplexArray
    contribution: Float
    chi_square: Float
    frequency_count: int

    @property
    def is_structural(self) -> NDArray[np.bool_]:
        """Whether each of the P poles is damped like a mode of a structure."""
        ratio = -self.pole.real / np.abs(self.pole)
        return np.asarray((ratio > 0.0) & (ratio < LARGEST_RATIO))

    @property
    def is_beyond_noise(self) -> NDArray[np.bool_]:
        """Whether each of the P poles is significant, and not due to noise alone."""
        # Bonferroni: the probability of a false mode is divided among the independent
        # frequencies. Unknowns of a pole: Re s and Im s, and for each channel two complex
        # factors.
        degrees_of_freedom = 2 + 4 * self.shape.shape[1]
        probability = _FALSE_MODE_PROBABILITY / self.frequency_count
        return np.asarray(self.chi_square > chdtri(degrees_of_freedom, probability))

    def modal_values(self, number: int) -> Float:
        """Return the modal values (1 + A,) of a pole.

        They are the natural frequency [Hz], the damping ratio [1], and the real part of the shape
        at the accelerometers after the first, divided by that at the first [1].
        """
        # s = -zeta omega +- i omega sqrt(1 - zeta^2) with |s| = omega
        s = self.pole[number]
        omega = abs(s)
        frequency = omega / (2.0 * np.pi)
        damping_ratio = -s.real / omega
        shape = self.shape[number]
        relative_shape = (shape[1:] / shape[0]).real
        return np.array([frequency, damping_ratio, *relative_shape])

    def strongest(self, low: float, high: float) -> int | None:
        """Return the index of the strongest structural pole in a frequency band [Hz].

        It is None if there is no such pole, or if the pole may be due to noise.
        """
        frequency = np.abs(self.pole) / (2.0 * np.pi)
        is_in_band = (frequency >= low) & (frequency <= high)
        is_candidate = is_in_band & self.is_structural
        if not is_candidate.any():
            return None
        candidate_contributions = np.where(is_candidate, self.contribution, -1.0)
        strongest = int(np.argmax(candidate_contributions))
        return strongest if self.is_beyond_noise[strongest] else None


def _hankel(correlation: Float) -> Float:
    """Return the block Hankel matrix (L C, L C) of correlations (2 L, C, C) at the lags 1 to 2 L.

    Block (i, j) is the correlation at the lag i + j + 1.
    """
    lags = len(correlation) // 2
    channels = correlation.shape[1]
    lag_of_block = np.arange(lags)[:, None] + np.arange(lags)
    blocks = correlation[lag_of_block].transpose(0, 2, 1, 3)
    return np.asarray(blocks.reshape(lags * channels, lags * channels))


class _Realisation(NamedTuple):
    """The modal form of a system with n states and C channels.

    Attributes
    ----------
    pole : (n,) array
        The poles s [1/s].
    eigenvector : (n, n) array
        The eigenvectors of the transition matrix (columns).
    shape : (C, n) array
        The mode shapes at the channels (columns).
    """

    pole: ComplexArray
    eigenvector: ComplexArray
    shape: ComplexArray


class Subspace:
    """Realisations of any order of the system whose outputs have certain correlations.

    Parameters
    ----------
    correlation : (2 L, C, C) array
        The correlations at the lags 1 to 2 L.
    sampling_rate : float
        The sampling rate of the record [Hz].
    """

    def __init__(self, correlation: Float, sampling_rate: float) -> None:
        self._correlation = correlation
        self._sampling_rate = sampling_rate
        _, self._singular_values, self._right_vectors = np.linalg.svd(_hankel(correlation))

    def _realisation(self, correlation: Float, basis: Float) -> _Realisation:
        """Return poles and mode shapes of the system that has the given correlations.

        This is stochastic subspace identification. `correlation` (2 L, C, C) has the correlations
        of C channels at successive lags. `basis` (L C, n) projects their Hankel matrix on n states;
        the product is the observability matrix.
        """
        channels = correlation.shape[1]
        observability = _hankel(correlation) @ basis
        # The observability matrix, shifted by one lag, is itself times the transition matrix.
        transition = np.linalg.lstsq(
            observability[:-channels], observability[channels:], rcond=None
        )[0]
        eigenvalue, eigenvector = np.linalg.eig(transition.astype(np.complex128))
        pole = np.log(eigenvalue) * self._sampling_rate
        return _Realisation(pole, eigenvector, observability[:channels] @ eigenvector)

    def _basis(self, order: int) -> Float:
        """Return the basis (L C, order) of a balanced realisation.

        It holds the first right singular vectors of the Hankel matrix U S V', divided by the roots
        of their singular values, so that the observability matrix is U S^(1/2).
        """
        vectors = self._right_vectors[:order].T
        return np.asarray(vectors / np.sqrt(self._singular_values[:order]))

    def poles(self, order: int, variance: Float | float = 1.0) -> tuple[IdentifiedPoles, float]:
        """Return the poles of the system of some order, and the misfit of its correlations.

        Parameters
        ----------
        order : int
            The number of states.
        variance : (2 L, C, C) array or float
            The variance of the correlations. Without it, `chi_square` of the poles has no meaning.

        Returns
        -------
        poles : IdentifiedPoles
            The poles with positive frequency.
        misfit : float
            The mean squared residual of the correlations, divided by their variance [1].
        """
        basis = self._basis(order)
        lags, channels, _ = self._correlation.shape
        realisation = self._realisation(self._correlation, basis)

        # Contribution of each pole to the correlations. The input matrix is the first block column
        # of the controllability matrix S^(1/2) V', which is S times that of the basis.
        first_block = basis[:channels]
        input_matrix = (first_block * self._singular_values[:order]).T
        complex_input = input_matrix.astype(np.complex128)
        participation = np.linalg.solve(realisation.eigenvector, complex_input)
        time = np.arange(lags) / self._sampling_rate
        decay = np.exp(np.multiply.outer(time, realisation.pole))
        correlation_of_pole = np.einsum("cn,ln,nd->nlcd", realisation.shape, decay, participation)

        # Increase of the squared residuals if a pair of conjugate poles is left out
        is_positive = realisation.pole.imag > 0.0
        reproduced = correlation_of_pole.sum(axis=0).real
        residual = self._correlation - reproduced
        correlation_of_positive = correlation_of_pole[is_positive]
        correlation_of_pair = 2.0 * correlation_of_positive.real
        residual_without_pair = residual + correlation_of_pair
        increase_without_pole = residual_without_pair**2 - residual**2
        squared_magnitude = np.abs(correlation_of_positive) ** 2
        poles = IdentifiedPoles(
            pole=realisation.pole[is_positive],
            shape=realisation.shape.T[is_positive],
            contribution=np.sqrt(np.sum(squared_magnitude, axis=(1, 2, 3))),
            chi_square=np.sum(increase_without_pole / variance, axis=(1, 2, 3)),
            frequency_count=lags,
        )
        return poles, float(np.mean(residual**2 / variance))

    def modal_values_after_change(
        self, change: Float, order: int, poles: ComplexArray
    ) -> list[Float]:
        """Return the modal values of P poles after a small change of the correlations.

        The modal values are natural frequency, damping ratio and relative mode shape, as
        `IdentifiedPoles.modal_values` defines them.

        Parameters
        ----------
        change : (2 L, C, C) array
            The change of the correlations.
        order : int
            The number of states.
        poles : (P,) array
            The poles before the change [1/s]. Each is matched with the nearest pole after the
            change.

        Returns
        -------
        list of (1 + A,) array
            The modal values of each of the P poles.
        """
        realisation = self._realisation(self._correlation + change, self._basis(order))
        # `realisation.pole` holds all n poles, `realisation.shape` their mode shapes in columns
        nearest = np.argmin(np.abs(realisation.pole - poles[:, None]), axis=1)
        not_needed = np.ones(len(poles))
        changed_poles = IdentifiedPoles(
            pole=realisation.pole[nearest],
            shape=realisation.shape.T[nearest],
            contribution=not_needed,
            chi_square=not_needed,
            frequency_count=1,
        )
        return [changed_poles.modal_values(number) for number in range(len(poles))]
