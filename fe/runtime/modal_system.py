"""A linear system in few coordinates, Rayleigh damping, and exact time steps under linear forces.

The damping is that of Kapteyn et al. 2021, eqs. (17) and (18). NumPy and relative imports only:
this file is copied into the FMU.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from .arrays import FloatArray

ComplexArray = npt.NDArray[np.complexfloating[Any, Any]]

_TAYLOR_ORDER = 14
"""Order of the Taylor polynomial of a matrix exponential."""
LARGEST_CONDITION = 1e4
"""Condition number of the eigenvectors up to which free motion is a sum of them."""


def rayleigh_damping_ratio(alpha: float, beta: float, frequency: npt.ArrayLike) -> FloatArray:
    """Return the damping ratios of modes for the damping matrix V = alpha M + beta K.

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
    (M,) array
        Damping ratios [1]; a mode with a ratio of 1 or more does not oscillate.
    """
    frequencies = np.asarray(frequency, dtype=np.float64)
    omega: FloatArray = 2.0 * math.pi * frequencies
    ratio = 0.5 * (alpha / omega + beta * omega)
    return np.asarray(ratio, dtype=np.float64)


def rayleigh_coefficients(
    frequency: tuple[float, float], damping_ratio: tuple[float, float]
) -> tuple[float, float]:
    """Return the Rayleigh coefficients that give two modes certain damping ratios.

    This inverts Kapteyn et al. 2021, eq. (18), for two modes.

    Parameters
    ----------
    frequency : tuple of float
        Two different natural frequencies [Hz].
    damping_ratio : tuple of float
        The damping ratios of the modes [1].

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
    omega_1, omega_2 = (2.0 * math.pi * f for f in frequency)
    if not (omega_1 > 0.0 and omega_2 > 0.0) or omega_1 == omega_2:
        raise ValueError(
            "Two different positive frequencies are needed for two Rayleigh coefficients, but "
            f"{frequency} Hz were given."
        )
    # the solution of zeta_i = (alpha / omega_i + beta omega_i) / 2 for i = 1, 2
    difference = omega_2**2 - omega_1**2
    beta = 2.0 * (damping_ratio[1] * omega_2 - damping_ratio[0] * omega_1) / difference
    alpha = (
        2.0
        * omega_1
        * omega_2
        * (damping_ratio[0] * omega_2 - damping_ratio[1] * omega_1)
        / difference
    )
    return alpha, beta


@dataclass(frozen=True)
class ModalSystem:
    """A linear system in M mass-normalised coordinates: q'' + D q' + S q = forces.

    The coordinates may be modes of a structure or states of first order.

    Attributes
    ----------
    angular_frequency : (M,) array
        Undamped angular frequencies [rad/s]; a coordinate of first order has zero.
    damping : (M, M) array
        D [1/s]; the diagonal 2 zeta w for modal damping.
    ports : mapping of str to (M,) array
        Modal rows of the P ports: the motion of a port is row . q, and what the residual
        flexibility adds.
    flexibility : (P,) array, optional
        Residual flexibility of each port: its position under a unit force there, without the part
        that these modes give [m/N, rad/(N m) and so on]. None: the ports have none.
    relaxation : float
        Time constant with which the residual position follows a force: the factor of damping in
        proportion to the stiffness [s].
    stiffness_matrix : (M, M) array, optional
        S [1/s^2]; by default the squared angular frequencies.
    actions : mapping of str to (M,) array
        Modal rows along which laws at the ports act, if they are not those of `ports`.
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
        """The squared angular frequencies (M,) [1/s^2]."""
        return np.ascontiguousarray(self.angular_frequency**2)

    @cached_property
    def coupled(self) -> bool:
        """Whether damping or stiffness couples the coordinates."""
        if self.stiffness_matrix is not None:
            return True
        return bool(np.any(self.damping != np.diag(np.diag(self.damping))))

    @cached_property
    def full_stiffness(self) -> FloatArray:
        """The stiffness matrix S (M, M), also if the stiffness couples no coordinates."""
        return np.diag(self.stiffness) if self.stiffness_matrix is None else self.stiffness_matrix

    @cached_property
    def _eigenvectors(self) -> "_Eigenvectors":
        """The eigenvectors of the free motion, of the state (q, v)."""
        zero = np.zeros_like(self.damping)
        speed_unit = np.where(self.stiffness > 0.0, self.angular_frequency, 1.0)
        matrix = np.block(
            [
                [zero, np.diag(speed_unit)],
                [-self.full_stiffness / speed_unit[:, None], -self.damping],
            ]
        )
        rates, vectors = np.linalg.eig(matrix)
        return _Eigenvectors(speed_unit, rates, vectors)

    @cached_property
    def motion_rates(self) -> FloatArray:
        """Angular frequencies, or magnitudes of the eigenvalues, without zeros [1/s]."""
        if self.stiffness_matrix is None and np.all(self.angular_frequency > 0.0):
            return self.angular_frequency
        # Eigenvalues of zero come out as rounding errors of the largest one.
        magnitude = np.abs(self._eigenvectors.rates)
        return np.asarray(magnitude[magnitude > 1e-7 * np.max(magnitude, initial=0.0)])

    @cached_property
    def _free_modes(self) -> "_FreeModes | None":
        """The free motion as a sum of damped oscillations and decays.

        It is None if the eigenvectors are nearly parallel, as they are close to critical damping:
        the sum would then be inaccurate.
        """
        eigenvectors = self._eigenvectors
        if not np.linalg.cond(eigenvectors.vectors) < LARGEST_CONDITION:
            return None
        # factors (2M,) from the units of the eigenvectors to those of coordinates and speeds
        speed_unit = eigenvectors.speed_unit
        state_units = np.concatenate((np.ones_like(speed_unit), speed_unit))
        # The terms of a conjugate pair of rates add up to twice the real part of one of them. Of
        # each pair only the rate with a positive imaginary part is kept, and its amplitude is
        # doubled. Real rates are kept as they are.
        rates = eigenvectors.rates
        is_upper_half = rates.imag >= 0.0
        multiplicity = np.where(rates.imag > 0.0, 2.0, 1.0)
        amplitudes = np.linalg.inv(eigenvectors.vectors) / state_units * multiplicity[:, None]
        return _FreeModes(
            rates[is_upper_half],
            state_units[:, None] * eigenvectors.vectors[:, is_upper_half],
            amplitudes[is_upper_half],
        )

    def free_motion(
        self, q: FloatArray, v: FloatArray, time: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the free motion from a state at time zero, as a sum of damped oscillations.

        Parameters
        ----------
        q, v : (M,) array
            Coordinates and speeds at time zero.
        time : (N,) array
            Times [s].

        Returns
        -------
        q, v : (N, M) array
            The motion; None close to critical damping, where such a sum is inaccurate and time
            steps are needed.
        """
        if self._free_modes is None:
            return None
        rates, shapes, amplitudes = self._free_modes
        # At evenly spaced times e^(r (t_i + s_j)) = e^(r t_i) e^(r s_j). With blocks of sqrt(N)
        # times, only 2 sqrt(N) exponentials are needed for each r.
        sample_count = len(time)
        even_time = np.linspace(time[0], time[-1], sample_count)
        duration = even_time[-1] - even_time[0]
        # Times count as even if they differ by rounding errors from even ones.
        largest_deviation = np.abs(time - even_time).max()
        if largest_deviation <= 1e-9 * duration / sample_count:
            block_length = math.isqrt(sample_count)
            block_begin = even_time[::block_length]
            offset = even_time[:block_length] - even_time[0]
        else:  # each time is a block of its own
            block_begin = time
            offset = np.zeros(1)
        # the oscillations in a block from time zero, and their factors at the begin of each block
        state = np.concatenate((q, v))
        at_zero = shapes * (amplitudes @ state)
        at_offsets = np.exp(np.outer(offset, rates))[:, None] * at_zero
        in_block = at_offsets.reshape(-1, len(rates)).T
        block_factor = np.exp(np.outer(block_begin, rates))
        # Re(a b) = Re a Re b - Im a Im b, as one real matrix product
        factor_parts = np.hstack((block_factor.real, -block_factor.imag))
        block_parts = np.vstack((in_block.real, in_block.imag))
        motion = factor_parts @ block_parts
        # the last block may reach beyond the last time
        coordinate_count = len(q)
        motion = motion.reshape(-1, 2 * coordinate_count)[:sample_count]
        return motion[:, :coordinate_count], motion[:, coordinate_count:]

    def exact_steps(self, lengths: FloatArray) -> "ExactSteps":
        """Return exact time steps of lengths (S,) [s] under forces that are linear in time.

        All lengths are computed together by matrix exponentials (Van Loan 1978).
        """
        stiffness = self.full_stiffness if self.coupled else self.stiffness
        return _exact_steps(stiffness.tobytes(), self.damping.tobytes(), lengths.tobytes())


class _Eigenvectors(NamedTuple):
    """Eigenvalues and eigenvectors of the motion of M coordinates.

    Attributes
    ----------
    speed_unit : (M,) array
        The unit of each coordinate's speed in the eigenvectors, which balances the matrix: the
        angular frequency of the coordinate, or 1 if that is zero [1/s].
    rates : (2M,) array
        Eigenvalues [1/s].
    vectors : (2M, 2M) array
        Eigenvectors, in columns: coordinates, then speeds in their units.
    """

    speed_unit: FloatArray
    rates: ComplexArray
    vectors: ComplexArray


class _FreeModes(NamedTuple):
    """The terms that make up free motion: an oscillation for each conjugate pair of rates.

    A real rate has a term of its own, which decays or is constant.

    Attributes
    ----------
    rates : (R,) array
        Eigenvalues [1/s].
    shapes : (2M, R) array
        Coordinates and speeds of each term.
    amplitudes : (R, 2M) array
        Amplitude of each term (row) per unit of each coordinate and speed at time zero.
    """

    rates: ComplexArray
    shapes: ComplexArray
    amplitudes: ComplexArray


class ExactSteps(NamedTuple):
    """Exact time steps of S lengths for the state (q, v) of M coordinates.

    Attributes
    ----------
    transition : (S, 2M, 2M) array
        Transition matrix from the old to the new state.
    begin, end : (S, 2M, M) array
        Change of the new state by unit forces at the beginning, and at the end, of a step.
    """

    transition: FloatArray
    begin: FloatArray
    end: FloatArray


@lru_cache(maxsize=16)  # the same system is often moved again with other laws
def _exact_steps(stiffness: bytes, damping: bytes, lengths: bytes) -> ExactSteps:
    """Return the exact time steps of M coordinates under forces that are linear in time.

    The arguments are the bytes of float64 arrays, since the cache needs arguments with a hash:
    the stiffness K (M, M), or its diagonal if nothing couples the coordinates [1/s^2]; the damping
    D (M, M) [1/s]; and the lengths (S,) [s].
    """
    stiffness_values = np.frombuffer(stiffness)
    duration = np.frombuffer(lengths)
    count = math.isqrt(len(damping) // 8)
    damping_matrix = np.frombuffer(damping).reshape(count, count)
    is_coupled = len(stiffness_values) != count
    if is_coupled:
        stiffness_matrix = stiffness_values.reshape(count, count)
        steps = _linear_force_exponentials(stiffness_matrix[None], damping_matrix[None], duration)
        return ExactSteps(
            transition=steps.transition.squeeze(axis=1),
            begin=steps.begin.squeeze(axis=1),
            end=steps.end.squeeze(axis=1),
        )
    # each coordinate by itself, as a system of one
    damping_values = np.diag(damping_matrix)
    single_steps = _linear_force_exponentials(
        stiffness_values[:, None, None],
        damping_values[:, None, None],
        duration,
    )
    # from the systems of one to blocks of q and v of all coordinates
    mode = np.arange(count)
    steps_count = len(duration)
    transition = np.zeros((steps_count, 2, count, 2, count))
    begin = np.zeros((steps_count, 2, count, count))
    end = np.zeros((steps_count, 2, count, count))
    transition[:, :, mode, :, mode] = single_steps.transition.transpose(1, 0, 2, 3)
    begin[:, :, mode, mode] = single_steps.begin.squeeze(axis=-1).transpose(0, 2, 1)
    end[:, :, mode, mode] = single_steps.end.squeeze(axis=-1).transpose(0, 2, 1)
    return ExactSteps(
        transition=transition.reshape(steps_count, 2 * count, 2 * count),
        begin=begin.reshape(steps_count, 2 * count, count),
        end=end.reshape(steps_count, 2 * count, count),
    )


def _linear_force_exponentials(
    stiffness: FloatArray, damping: FloatArray, lengths: FloatArray
) -> ExactSteps:
    """Return the exact time steps of B independent systems, each of n coordinates of unit mass.

    The equation of motion is q'' + D q' + K q = f, with a force f that is linear in time over each
    step. The state (q, v) is extended by the force f and its change s over the step. So the
    equation becomes homogeneous, and one matrix exponential solves it (Van Loan 1978).

    Parameters
    ----------
    stiffness, damping : (B, n, n) array
        The stiffness K [1/s^2] and the damping D [1/s] of each system.
    lengths : (S,) array
        The lengths of the steps [s].

    Returns
    -------
    ExactSteps
        `transition` is (S, B, 2n, 2n), `begin` and `end` are (S, B, 2n, n).
    """
    count = stiffness.shape[1]
    unity = np.eye(count)
    # q, v / w, f and s have a matrix of balanced entries, with w about the highest frequency
    largest_stiffness = np.abs(stiffness).max(axis=(1, 2), keepdims=True)
    largest_damping = np.abs(damping).max(axis=(1, 2), keepdims=True)
    highest_frequency = np.maximum(np.sqrt(largest_stiffness), largest_damping)
    longest_step = float(lengths.max()) or 1.0
    speed_unit = np.maximum(highest_frequency, 1.0 / longest_step)
    q, v, f, s = (slice(number * count, (number + 1) * count) for number in range(4))
    state = slice(0, 2 * count)
    # the time derivative of (q, v / w, f, s), without that of f
    matrix = np.zeros((len(stiffness), 4 * count, 4 * count))
    matrix[:, q, v] = speed_unit * unity
    matrix[:, v, q] = -stiffness / speed_unit
    matrix[:, v, v] = -damping
    matrix[:, v, f] = unity / speed_unit
    step_matrix = matrix * lengths[:, None, None, None]
    step_matrix[:, :, f, s] = unity  # df / dt = s / h, times the length h
    result = exponential(step_matrix)
    # back from v / w to v: factors 1 on the n coordinates and w on the n speeds, (B, 2n, 1)
    units = np.concatenate((np.ones_like(speed_unit), speed_unit), axis=1)
    scale = units.repeat(count, axis=1)
    by_change = result[:, :, state, s] * scale
    by_constant = result[:, :, state, f] * scale
    # The force is f_begin (1 - t / h) + f_end (t / h). The state responds to 1 - t / h as to the
    # constant 1 minus the change t / h.
    transition = result[:, :, state, state] * scale / scale.transpose(0, 2, 1)
    return ExactSteps(
        transition=np.ascontiguousarray(transition),
        begin=by_constant - by_change,
        end=np.ascontiguousarray(by_change),
    )


def exponential(matrix: FloatArray) -> FloatArray:
    """Return e^A of matrices A (..., n, n), by a Taylor polynomial with scaling and squaring."""
    row_sums = np.sum(np.abs(matrix), axis=-1)
    norm = float(np.max(row_sums, initial=0.0))
    # the scaled matrix has a norm of at most 0.5; few squarings, because each doubles the rounding
    doublings = np.log2(max(norm, 1e-300) / 0.5)
    squarings = max(0, int(np.ceil(doublings)))
    scaled_matrix = matrix / 2.0**squarings
    unity = np.eye(matrix.shape[-1])
    result = np.broadcast_to(unity, matrix.shape)
    for order in range(_TAYLOR_ORDER, 0, -1):
        result = unity + scaled_matrix @ result / order
    for _ in range(squarings):
        result = result @ result
    return np.asarray(result)
