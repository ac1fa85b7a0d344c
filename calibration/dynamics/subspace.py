"""Subspace identification: the poles of systems with given correlations (Ho-Kalman realisation)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from reporting.arrays import Float

from .damped_cosine import ComplexArray

LARGEST_RATIO = 0.3
"""Largest damping ratio of a mode of a structure."""
_FALSE_MODE_PROBABILITY = 1e-3
"""Probability that noise alone is taken for a mode, over all frequencies where that can happen."""


class IdentifiedPoles(NamedTuple):
    """P poles with positive frequency.

    Attributes
    ----------
    pole : (P,) array
        The poles s [1/s].
    shape : (P, A) array
        The complex shapes.
    size : (P,) array
        The size of the part of the record that belongs to each pole.
    chi_square : (P,) array
        The reduction of the sum of squares by each pole over the scatter; chi-square distributed
        where there is only noise.
    frequency_count : int
        The number of independent frequencies at which noise could have given a pole.
    """

    pole: ComplexArray
    shape: ComplexArray
    size: Float
    chi_square: Float
    frequency_count: int

    @property
    def is_structural(self) -> NDArray[np.bool_]:
        """Whether the damping of each pole is that of a structure (P,)."""
        ratio = -self.pole.real / np.abs(self.pole)
        return np.asarray((ratio > 0.0) & (ratio < LARGEST_RATIO))

    @property
    def is_beyond_noise(self) -> NDArray[np.bool_]:
        """Whether noise alone would hardly give each pole, at any frequency (P,)."""
        degrees_of_freedom = 2 + 4 * self.shape.shape[1]
        probability = _FALSE_MODE_PROBABILITY / self.frequency_count
        return np.asarray(self.chi_square > chdtri(degrees_of_freedom, probability))

    def modal_values(self, number: int) -> Float:
        """Return frequency [Hz], damping ratio [1] and relative shape of a pole, (1 + A,)."""
        s = self.pole[number]
        relative_shape = (self.shape[number, 1:] / self.shape[number, 0]).real
        return np.array([abs(s) / (2.0 * np.pi), -s.real / abs(s), *relative_shape])

    def strongest(self, low: float, high: float) -> int | None:
        """Return the number of the strongest pole in a band [Hz]; None if it may be noise."""
        frequency = np.abs(self.pole) / (2.0 * np.pi)
        is_inside = (frequency >= low) & (frequency <= high) & self.is_structural
        if not is_inside.any():
            return None
        strongest = int(np.argmax(np.where(is_inside, self.size, -1.0)))
        return strongest if self.is_beyond_noise[strongest] else None


def _hankel(correlation: Float) -> Float:
    """Return the block Hankel matrix of the correlations of C channels.

    Parameters
    ----------
    correlation : (2 L, C, C) array
        The correlations at the lags 1 to 2 L.

    Returns
    -------
    (L C, L C) array
    """
    lags = len(correlation) // 2
    channels = correlation.shape[1]
    lag_of_block = np.arange(lags)[:, None] + np.arange(lags)
    blocks = correlation[lag_of_block].transpose(0, 2, 1, 3)
    return np.asarray(blocks.reshape(lags * channels, lags * channels))


class _Realisation(NamedTuple):
    """The modal form of a system of order n with C channels.

    Attributes
    ----------
    pole : (n,) array
        The poles s [1/s].
    eigenvector : (n, n) array
        The eigenvectors of the transition matrix (columns).
    shape : (C, n) array
        The shapes of the poles in the channels.
    """

    pole: ComplexArray
    eigenvector: ComplexArray
    shape: ComplexArray


class Subspace:
    """Systems of any order with the correlations of a record (Ho-Kalman realisation).

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
        """Return the system of given correlations, whose states are those of a basis (L C, n)."""
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
        """Return right singular vectors over the roots of their singular values, (L C, order)."""
        vectors = self._right_vectors[:order].T
        return np.asarray(vectors / np.sqrt(self._singular_values[:order]))

    def poles(self, order: int, variance: Float | float = 1.0) -> tuple[IdentifiedPoles, float]:
        """Return the poles of the system of an order, and its misfit.

        Parameters
        ----------
        order : int
            The number of states.
        variance : (2 L, C, C) array or float
            The variance of the correlations; without it the values of chi-square have no meaning.

        Returns
        -------
        poles : IdentifiedPoles
            The poles with positive frequency.
        misfit : float
            The mean squared misfit of the correlations over their variance [1].
        """
        basis = self._basis(order)
        lags, channels, _ = self._correlation.shape
        system = self._realisation(self._correlation, basis)

        # Correlations of each pole
        input_matrix = (basis[:channels] * self._singular_values[:order]).T
        participation = np.linalg.solve(system.eigenvector, input_matrix.astype(np.complex128))
        time = np.arange(lags) / self._sampling_rate
        decay = np.exp(np.multiply.outer(time, system.pole))
        correlation_of_pole = np.einsum("cn,ln,nd->nlcd", system.shape, decay, participation)

        # Misfit with all poles, and without each pair of conjugate poles
        is_positive = system.pole.imag > 0.0
        residual = self._correlation - correlation_of_pole.sum(axis=0).real
        correlation_of_pair = 2.0 * correlation_of_pole[is_positive].real
        increase = (residual + correlation_of_pair) ** 2 - residual**2
        squared_size = np.abs(correlation_of_pole[is_positive]) ** 2
        poles = IdentifiedPoles(
            pole=system.pole[is_positive],
            shape=system.shape.T[is_positive],
            size=np.sqrt(np.sum(squared_size, axis=(1, 2, 3))),
            chi_square=np.sum(increase / variance, axis=(1, 2, 3)),
            frequency_count=lags,
        )
        return poles, float(np.mean(residual**2 / variance))

    def modal_values_after_change(
        self, change: Float, order: int, poles: ComplexArray
    ) -> list[Float]:
        """Return the modal values of poles after a small change of the correlations.

        Parameters
        ----------
        change : (2 L, C, C) array
            The change.
        order : int
            The number of states.
        poles : (P,) array
            The poles before the change [1/s].
        """
        system = self._realisation(self._correlation + change, self._basis(order))
        nearest = np.argmin(np.abs(system.pole - poles[:, None]), axis=1)
        not_needed = np.ones(len(poles))
        changed = IdentifiedPoles(
            pole=system.pole[nearest],
            shape=system.shape.T[nearest],
            size=not_needed,
            chi_square=not_needed,
            frequency_count=1,
        )
        return [changed.modal_values(number) for number in range(len(poles))]
