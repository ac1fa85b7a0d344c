"""A linear system in few coordinates, Rayleigh damping, and its exact step under a force linear in time.

The damping is that of Kapteyn et al. 2021, eqs. (17) and (18).

NumPy and relative imports only: this file is copied into the FMU.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from .arrays import FloatArray


def rayleigh_damping_ratio(alpha: float, beta: float, frequency: npt.ArrayLike) -> FloatArray:
    """Return the damping ratios of modes under V = alpha M + beta K.

    Kapteyn et al. 2021, eq. (18): zeta = alpha / (2 omega) + beta omega / 2, omega = 2 pi f.

    Parameters
    ----------
    alpha : float
        Mass-proportional coefficient [1/s].
    beta : float
        Stiffness-proportional coefficient [s].
    frequency : (M,) array_like
        Undamped natural frequencies [Hz], all positive.

    Returns
    -------
    (M,) ndarray
        Damping ratios [1]; values of 1 and more mean that the mode does not oscillate.
    """
    angular: Any = 2.0 * math.pi * np.asarray(frequency, dtype=np.float64)
    return np.asarray(0.5 * (alpha / angular + beta * angular), dtype=np.float64)


def rayleigh_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return the Rayleigh coefficients that give two modes their damping ratios.

    The inverse of Kapteyn et al. 2021, eq. (18), for two modes.

    Parameters
    ----------
    frequency : tuple of float
        Two different natural frequencies [Hz].
    damping_ratio : tuple of float
        Their damping ratios [1].

    Returns
    -------
    alpha : float
        Mass-proportional coefficient [1/s].
    beta : float
        Stiffness-proportional coefficient [s].

    Raises
    ------
    ValueError
        If the two frequencies are equal or not positive.
    """
    first, second = (2.0 * math.pi * f for f in frequency)
    if not (first > 0.0 and second > 0.0) or first == second:
        raise ValueError(
            f"Two different positive frequencies are needed for two Rayleigh coefficients, but {frequency} "
            "Hz were given."
        )
    difference = second**2 - first**2
    beta = 2.0 * (damping_ratio[1] * second - damping_ratio[0] * first) / difference
    alpha = 2.0 * first * second * (damping_ratio[0] * second - damping_ratio[1] * first) / difference
    return alpha, beta


@dataclass(frozen=True)
class ModalSystem:
    """A linear system in mass-normalised coordinates: q'' + D q' + S q = forces.

    Attributes
    ----------
    angular_frequency : (M,) ndarray
        Undamped angular frequencies [rad/s]; zero is allowed, and is that of coordinates of first order.
    damping : (M, M) ndarray
        D [1/s]; diagonal 2 zeta w for modal damping.
    ports : mapping of str to (M,) ndarray
        Modal rows of the ports: the motion of a port is row . q, and what the flexibility adds.
    flexibility : (P,) ndarray, optional
        Position of each port, in their order, by a unit force there that these modes leave out; none if it is
        left out [m/N, rad/(N m) and so on].
    relaxation : float
        What is left out follows a force with this lag, the factor of damping in proportion to the stiffness
        [s].
    stiffness_matrix : (M, M) ndarray, optional
        S [1/s^2]; the squared angular frequencies where it is left out.
    actions : mapping of str to (M,) ndarray
        Rows along which laws at ports act, where that is not how they see; empty: everywhere the same.
    """

    angular_frequency: FloatArray
    damping: FloatArray
    ports: Mapping[str, FloatArray] = field(default_factory=dict)
    flexibility: FloatArray | None = None
    relaxation: float = 0.0
    stiffness_matrix: FloatArray | None = None
    actions: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def stiffness(self) -> FloatArray:
        """Squared angular frequencies (M,) [1/s^2]."""
        return np.ascontiguousarray(self.angular_frequency**2)

    @cached_property
    def coupled(self) -> bool:
        """Whether damping or stiffness couples the coordinates."""
        return self.stiffness_matrix is not None or bool(
            np.any(self.damping != np.diag(np.diag(self.damping)))
        )

    @cached_property
    def whole(self) -> FloatArray:
        """S, a matrix where no coordinate is coupled too."""
        return np.diag(self.stiffness) if self.stiffness_matrix is None else self.stiffness_matrix

    @cached_property
    def _eigen(self) -> tuple[FloatArray, Any, Any]:
        """Units (M,) of the speeds, eigenvalues (2M,) [1/s] and eigenvectors (2M, 2M) of (q, v) in them."""
        none, unit = np.zeros_like(self.damping), np.where(self.stiffness > 0.0, self.angular_frequency, 1.0)
        matrix = np.block([[none, np.diag(unit)], [-self.whole / unit[:, None], -self.damping]])
        return unit, *np.linalg.eig(matrix)

    @cached_property
    def paces(self) -> FloatArray:
        """Frequencies, or magnitudes (2M,) of the eigenvalues [1/s] of the motion that are not zero."""
        if self.stiffness_matrix is None and np.all(self.angular_frequency > 0.0):
            return self.angular_frequency
        found = np.abs(self._eigen[1])
        return np.asarray(found[found > 1e-7 * np.max(found, initial=0.0)])

    @cached_property
    def _waves(self) -> tuple[Any, Any, Any] | None:
        """Rates (R,) [1/s] of free motion, one of each conjugate pair, shapes (2M, R) and amounts (R, 2M).

        None where shapes are hardly apart, as under critical damping.
        """
        unit, rates, shapes = self._eigen
        if not np.linalg.cond(shapes) < APART:
            return None
        scale, kept = np.concatenate((np.ones_like(unit), unit)), rates.imag >= 0.0
        amounts = np.linalg.inv(shapes) / scale * np.where(rates.imag > 0.0, 2.0, 1.0)[:, None]
        return rates[kept], scale[:, None] * shapes[:, kept], amounts[kept]

    def free(self, q: FloatArray, v: FloatArray, time: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Return free motion q and v (N, M) at times (N,) from that at zero; None: steps must tell it."""
        if self._waves is None:
            return None
        rates, shapes, amounts = self._waves
        even, first = np.linspace(time[0], time[-1], len(time)), np.zeros(1)
        if np.abs(time - even).max() <= 1e-9 * (even[-1] - even[0]) / len(time):
            block = math.isqrt(len(time))
            time, first = even[::block], even[:block] - even[0]
        moved = shapes * (amounts @ np.concatenate((q, v)))
        moved = (np.exp(np.outer(first, rates))[:, None] * moved).reshape(-1, len(rates)).T
        waves = np.exp(np.outer(time, rates))
        found = np.hstack((waves.real, -waves.imag)) @ np.vstack((moved.real, moved.imag))
        found = found.reshape(-1, 2 * len(q))[: len(even)]
        return found[:, : len(q)], found[:, len(q) :]

    def exact_steps(self, lengths: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the exact steps under forces that are linear in time, for lengths (S,) [s].

        The exponential of one matrix (Van Loan 1978) by scaling, a Taylor polynomial and squaring, all
        lengths at once.

        Returns
        -------
        transition : (S, 2M, 2M) ndarray
            Of (q, v).
        begin, end : (S, 2M, M) ndarray
            By the forces at the begin and at the end of a step.
        """
        matrix = self.whole if self.coupled else self.stiffness
        return _exact_steps(matrix.tobytes(), self.damping.tobytes(), lengths.tobytes())


_TAYLOR = 14
APART = 1e4
"""Condition up to which the shapes of free motion are apart."""


@lru_cache(maxsize=16)  # the same system is often moved again with other laws
def _exact_steps(
    stiffness: bytes, damping: bytes, lengths: bytes
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the steps by S (M, M), or (M,) where nothing couples the coordinates, and by D (M, M)."""
    own, duration = np.frombuffer(stiffness), np.frombuffer(lengths)
    count, size = math.isqrt(len(damping) // 8), len(duration)
    matrix = np.frombuffer(damping).reshape(count, count)
    if len(own) != count:
        transition, begin, end = _exponential(own.reshape(1, count, count), matrix[None], duration)
        return transition[:, 0], begin[:, 0], end[:, 0]
    mode = np.arange(count)
    parts = _exponential(own[:, None, None], np.diag(matrix)[:, None, None], duration)
    whole, forces = np.zeros((size, 2, count, 2, count)), np.zeros((2, size, 2, count, count))
    whole[:, :, mode, :, mode] = parts[0].transpose(1, 0, 2, 3)
    for force, part in zip(forces, parts[1:], strict=True):
        force[:, :, mode, mode] = part[..., 0].transpose(0, 2, 1)
    begin, end = forces.reshape(2, size, 2 * count, count)
    return whole.reshape(size, 2 * count, 2 * count), begin, end


def _exponential(
    stiffness: FloatArray, damping: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the same for B systems (B, n, n) each by itself, as (S, B, 2n, 2n) and (S, B, 2n, n)."""
    count, own = stiffness.shape[1], np.eye(stiffness.shape[1])
    # Velocities are measured in units of the highest frequency, which balances the matrix.
    largest = (np.abs(part).max(axis=(1, 2), keepdims=True) for part in (stiffness, damping))
    fastest, damped = largest
    unit = np.maximum(np.maximum(np.sqrt(fastest), damped), 1.0 / (float(lengths.max()) or 1.0))
    q, v, f, s = (slice(number * count, (number + 1) * count) for number in range(4))
    matrix = np.zeros((len(stiffness), 4 * count, 4 * count))
    matrix[:, q, v] = unit * own
    matrix[:, v, q] = -stiffness / unit
    matrix[:, v, v] = -damping
    matrix[:, v, f] = own / unit
    scaled = matrix * lengths[:, None, None, None]
    scaled[:, :, f, s] = own  # the force changes by one over the step
    both, result = slice(0, 2 * count), exponential(scaled)
    scale = np.concatenate((np.ones_like(unit), unit), axis=1).repeat(count, axis=1)
    slope, whole = result[:, :, both, s] * scale, result[:, :, both, f] * scale
    transition = result[:, :, both, both] * scale / scale.transpose(0, 2, 1)
    return np.ascontiguousarray(transition), whole - slope, np.ascontiguousarray(slope)


def exponential(matrix: FloatArray) -> FloatArray:
    """Return e^A of matrices (..., n, n), by a Taylor polynomial of A in small parts, and squares."""
    norm = float(np.max(np.sum(np.abs(matrix), axis=-1), initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(max(norm, 1e-300) / 0.5))))  # squares double rounding
    part, unity = matrix / 2.0**squarings, np.eye(matrix.shape[-1])
    result = np.broadcast_to(unity, matrix.shape)
    for order in range(_TAYLOR, 0, -1):
        result = unity + part @ result / order
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)
