"""The linear system that the answers of an FMU show, if the FMU is linear.

An FMU hides its equations. Where its outputs after unit forces and releases are those of a linear
system of few states, that system is realised from them, and can then be solved instead of the FMU.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple
from warnings import catch_warnings, simplefilter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import logm

from fe.runtime.arrays import FloatArray, IntArray

ComplexArray = NDArray[np.complex128]

SPEED_JUMP = 1e-2
"""Share of a port's speed that may come at once with a force: coarse solver steps show a little."""
MOST_STATES = 40
"""Largest order of a linear system that is realised from records."""
HANKEL_ROWS = 64
"""Block rows of the Hankel matrix: samples of one column."""
HANKEL_COLUMNS = 160
"""Block columns of the Hankel matrix: samples of one row."""
MIXTURES = 3
"""Random mixtures of all outputs that stand in the Hankel matrix in the place of the outputs."""
LARGEST_CONDITION = 1e5
"""Condition up to which eigenvectors give a matrix logarithm, 20 times faster than `logm`."""
THRESHOLDS = 10.0 ** np.arange(-12, -6)
"""Shares of the largest singular value below which one counts as rounding; tried in this order."""
FIT = 1e-7
"""Largest error of a linear system against its record, as a share of the record."""


class VibratingMode(NamedTuple):
    """A mode between one force and one output.

    Attributes
    ----------
    angular_frequency : float
        Angular frequency [rad/s].
    flexibility : float
        Displacement of the output at rest under a unit force, by this mode alone [m/N].
    """

    angular_frequency: float
    flexibility: float


class PortStiffnesses(NamedTuple):
    """Stiffness between one force and one output [N/m].

    Attributes
    ----------
    modal : float
        Stiffness of the most flexible mode.
    static : float
        Stiffness at rest, of all modes together.
    """

    modal: float
    static: float


@dataclass(frozen=True, eq=False)
class FmuStateSpace:
    """How E forces f and R releases move n states s and C outputs y of a linear FMU.

    s' = A s + B f and y = C s + D f. Outputs are those beyond the undisturbed FMU; where a force
    jumps, f is its value just before.

    Attributes
    ----------
    state_matrix : (n, n) ndarray
        A [1/s].
    input_matrix : (n, E) ndarray
        B.
    output_matrix : (C, n) ndarray
        C.
    feedthrough : (C, E) ndarray
        D.
    release_states : (n, R) ndarray
        State just after a unit of each release.
    """

    state_matrix: FloatArray
    input_matrix: FloatArray
    output_matrix: FloatArray
    feedthrough: FloatArray
    release_states: FloatArray

    def in_coordinates_of(self, reference: "FmuStateSpace") -> "FmuStateSpace":
        """Return the same system with the states of another system of its order.

        A realised state has no meaning of its own, so two systems of one FMU with different
        parameters cannot be compared by their states. Outputs and their rates can: the new
        coordinates are those in which both systems show them alike (least squares).
        """
        own_rows = _outputs_and_rates(self)
        reference_rows = _outputs_and_rates(reference)
        scale = _nonzero(np.linalg.norm(reference_rows, axis=1, keepdims=True))
        to_own = np.linalg.lstsq(own_rows / scale, reference_rows / scale, rcond=None)[0]
        from_own = np.linalg.inv(to_own)
        return FmuStateSpace(
            state_matrix=from_own @ self.state_matrix @ to_own,
            input_matrix=from_own @ self.input_matrix,
            output_matrix=self.output_matrix @ to_own,
            feedthrough=self.feedthrough,
            release_states=from_own @ self.release_states,
        )

    def output_rows(
        self, columns: Sequence[int], orders: Sequence[int] | int = 0
    ) -> tuple[FloatArray, FloatArray]:
        """Return the rows (K, n) on the state and (K, E) on the forces of outputs or their rates.

        Parameters
        ----------
        columns : (K,) sequence of int
            The outputs.
        orders : int or (K,) sequence of int
            Order of each one's derivative in time: 0, 1 or 2.
        """
        on_state = self.output_matrix[columns]
        on_forces = self.feedthrough[columns]
        for order in (0, 1):
            is_higher = np.broadcast_to(orders, len(columns))[:, None] > order
            on_forces = np.where(is_higher, on_state @ self.input_matrix, on_forces)
            on_state = np.where(is_higher, on_state @ self.state_matrix, on_state)
        return on_state, on_forces

    def state_at_rest(self, forces: FloatArray) -> FloatArray:
        """Return the state (n, ...) at rest under constant forces (E, ...)."""
        return np.asarray(np.linalg.solve(self.state_matrix, -self.input_matrix @ forces))

    @property
    def gain(self) -> FloatArray:
        """Outputs (C, E) at rest under unit forces."""
        unit_forces = np.eye(self.input_matrix.shape[1])
        return np.asarray(self.feedthrough + self.output_matrix @ self.state_at_rest(unit_forces))

    @cached_property
    def modes(self) -> tuple[ComplexArray, ComplexArray]:
        """Rates (n,) [1/s] and shapes (n, n) of the modes: eigenvalues and vectors of A."""
        rates, shapes = np.linalg.eig(self.state_matrix.astype(complex))
        return rates, shapes

    def _residues(self, output: int, force: int) -> ComplexArray:
        """Return the residue (n,) of each mode in the answer of one output to one force."""
        _, shapes = self.modes
        participation = np.linalg.solve(shapes, self.input_matrix[:, force].astype(complex))
        return np.asarray((self.output_matrix[output] @ shapes) * participation)

    def most_flexible_mode(self, output: int, force: int) -> VibratingMode | None:
        """Return the mode that moves an output most at rest under a force; None if none vibrates.

        Parameters
        ----------
        output, force : int
            Numbers of the output and of the force.
        """
        rates, _ = self.modes
        residues = self._residues(output, force)
        frequency = np.abs(rates)
        vibrates = rates.imag > 1e-9 * np.abs(rates)
        if not vibrates.any():
            return None
        # a pair of conjugate modes: -2 Im(rate) Im(residue) / |rate|^2 at rest
        flexibility = np.where(vibrates, np.abs(2.0 * rates.imag * residues) / frequency**2, 0.0)
        best = int(np.argmax(flexibility))
        return VibratingMode(float(frequency[best]), float(flexibility[best]))

    def stiffness(self, output: int, force: int) -> PortStiffnesses:
        """Return the stiffness between an output and a force: of one mode, and at rest.

        Parameters
        ----------
        output, force : int
            Numbers of the output and of the force.
        """
        static = 1.0 / float(self.gain[output, force])
        mode = self.most_flexible_mode(output, force)
        if mode is None or mode.flexibility * static < 1e-6:
            return PortStiffnesses(modal=static, static=static)
        return PortStiffnesses(modal=1.0 / mode.flexibility, static=static)

    def has_jumping_speed(self, outputs: IntArray, forces: IntArray) -> bool:
        """Return whether the speed of an output jumps with its force.

        Laws at such a port find no mass that holds against them, and cannot be integrated.

        Parameters
        ----------
        outputs, forces : (P,) array of int
            Displacement output and force of each port.
        """
        for output, force in zip(outputs, forces, strict=True):
            residues = self._residues(output, force)
            # the speed after an impulse starts at the sum of the residues
            if abs(residues.sum()) > SPEED_JUMP * np.abs(residues).sum():
                return True
        return False


def _outputs_and_rates(system: FmuStateSpace) -> FloatArray:
    """Return the rows (2 C, n) by which outputs and their rates follow from the state."""
    rates = system.output_matrix @ system.state_matrix
    return np.vstack((system.output_matrix, rates))


def _nonzero(scales: FloatArray) -> FloatArray:
    """Return scales to divide by, with 1 in the place of 0."""
    return np.where(scales == 0.0, 1.0, scales)


# ---------------------------------------------------------------------- realisation


class HankelMatrices(NamedTuple):
    """Records as block Hankel matrices of Ho and Kalman.

    Attributes
    ----------
    hankel : (h m, w k) ndarray
        Block (i, j) is the sample i + j + 1 of m mixtures of outputs, for k forces and releases.
    shifted : (h m, w k) ndarray
        The same, one sample later.
    """

    hankel: FloatArray
    shifted: FloatArray


class SingularTriplets(NamedTuple):
    """Singular value decomposition, left @ diag(values) @ right, perhaps of the largest values."""

    left: FloatArray
    values: FloatArray
    right: FloatArray


class DiscreteSystem(NamedTuple):
    """A system in steps: s(k+1) = transition s(k), y(k) = output_rows s(k), k >= 1.

    Attributes
    ----------
    transition : (n, n) ndarray
        State after a step.
    first_states : (n, E + R) ndarray
        State at the end of the first step, for each unit force and release.
    output_rows : (C, n) ndarray
        Outputs of a state.
    """

    transition: FloatArray
    first_states: FloatArray
    output_rows: FloatArray


def realise_state_space(records: FloatArray, forces: int, step: float) -> FmuStateSpace | None:
    """Return the linear system that gives recorded answers to unit forces and releases.

    The eigensystem realisation of Ho and Kalman (1966) as by Juang and Pappa (1985), on random
    mixtures of the outputs.

    Parameters
    ----------
    records : (K, C, E + R) ndarray
        Outputs at the ends of K steps after a unit of each force, held over the first step only,
        and then after a unit of each release.
    forces : int
        Number of forces, E.
    step : float
        Length of a step [s].

    Returns
    -------
    FmuStateSpace or None
        None if no system of at most `MOST_STATES` states gives the records within `FIT`.
    """
    # scale outputs and inputs, so that units do not decide what is rounding
    output_scale = _nonzero(np.max(np.abs(records[1:]), axis=(0, 2)))
    input_scale = _nonzero(np.max(np.abs(records[1:]) / output_scale[:, None], axis=(0, 1)))
    scaled = records / (output_scale[:, None] * input_scale)
    # find the order and the system in steps
    matrices = _hankel_matrices(scaled)
    triplets = _sufficient_triplets(matrices.hankel)
    significant = [
        int(np.sum(triplets.values > least * triplets.values[0])) for least in THRESHOLDS
    ]
    for order in dict.fromkeys(significant):
        system = _system_of_order(order, matrices, triplets, scaled)
        if system is not None:
            # undo the scales
            system = system._replace(
                first_states=system.first_states * input_scale,
                output_rows=system.output_rows * output_scale[:, None],
            )
            first_outputs = scaled[0, :, :forces] * output_scale[:, None] * input_scale[:forces]
            return _in_continuous_time(system, first_outputs, step)
    return None


def _hankel_matrices(records: FloatArray) -> HankelMatrices:
    """Return the Hankel matrices of records (K, C, E + R), as long as the records allow."""
    samples, outputs, inputs = records.shape
    mixing = np.random.default_rng(1).standard_normal((MIXTURES, outputs))
    mixtures = mixing @ records
    height = min(HANKEL_ROWS, (samples - 2) // 2)
    width = min(HANKEL_COLUMNS, samples - 2 - height)
    # one block row more than needed: the two matrices are all but the last, and all but the first
    numbers = 1 + np.arange(height + 1)[:, None] + np.arange(width)
    blocks = mixtures[numbers].transpose(0, 2, 1, 3)
    matrix = blocks.reshape((height + 1) * MIXTURES, width * inputs)
    return HankelMatrices(hankel=matrix[:-MIXTURES], shifted=matrix[MIXTURES:])


def _sufficient_triplets(matrix: FloatArray) -> SingularTriplets:
    """Return singular triplets of a matrix, enough of them to reach its rounding, if possible."""
    few = _largest_triplets(matrix, MOST_STATES // 4 + 16)
    if few.values[-1] <= 1e-13 * few.values[0]:
        return few
    return _largest_triplets(matrix, MOST_STATES + 16)


def _largest_triplets(matrix: FloatArray, count: int) -> SingularTriplets:
    """Return the singular triplets of a matrix, only the largest ones where there are more.

    These follow from its image of random vectors (Halko, Martinsson and Tropp 2011). The caller
    uses values far above the rounding of the first, so that the others change nothing but rounding.
    """
    if min(matrix.shape) <= count:
        left, values, right = np.linalg.svd(matrix, full_matrices=False)
        return SingularTriplets(left, values, right)
    random = np.random.default_rng(0).standard_normal((matrix.shape[1], count))
    image = np.linalg.qr(matrix @ random)[0]
    left, values, right = np.linalg.svd(image.T @ matrix, full_matrices=False)
    return SingularTriplets(image @ left, values, right)


def _system_of_order(
    order: int, matrices: HankelMatrices, triplets: SingularTriplets, records: FloatArray
) -> DiscreteSystem | None:
    """Return the system of n states that gives the records, or None if it does not.

    Parameters
    ----------
    order : int
        n.
    matrices : HankelMatrices
        Hankel matrices of the records.
    triplets : SingularTriplets
        Decomposition of the first of them.
    records : (K, C, E + R) ndarray
        Scaled outputs.
    """
    if not 0 < order <= MOST_STATES:
        return None
    samples, outputs, inputs = records.shape
    # balanced realisation from the largest n triplets
    root = np.sqrt(triplets.values[:order])
    left = triplets.left[:, :order]
    right = triplets.right[:order]
    transition = (left / root).T @ matrices.shifted @ (right.T / root)
    if np.max(np.abs(np.linalg.eigvals(transition))) > 1.0 + 1e-9:
        return None
    # first sample of the Hankel matrix is a step after the end of the first step
    first_columns = (root[:, None] * right)[:, :inputs]
    first_states = np.asarray(np.linalg.lstsq(transition, first_columns)[0], dtype=np.float64)
    states = _states_in_time(transition, first_states, samples)
    # outputs of the states, by least squares on the whole records
    flat_states = states[1:].transpose(0, 2, 1).reshape(-1, order)
    flat_records = records[1:].transpose(0, 2, 1).reshape(-1, outputs)
    state_scale = np.max(np.abs(flat_states), axis=0)
    scaled_rows = np.linalg.lstsq(flat_states / state_scale, flat_records, rcond=1e-14)[0]
    output_rows = np.asarray(scaled_rows.T / state_scale, dtype=np.float64)
    error = np.max(np.abs(flat_records - flat_states @ output_rows.T), axis=0)
    if np.all(error <= FIT * np.max(np.abs(flat_records), axis=0) + 1e-300):
        return DiscreteSystem(transition, first_states, output_rows)
    return None


def _states_in_time(transition: FloatArray, first: FloatArray, samples: int) -> FloatArray:
    """Return the states (samples, n, k) that follow first states (n, k), doubling each time."""
    states = first[None]
    power = transition
    while len(states) < samples:
        states = np.concatenate((states, power @ states))
        power = power @ power
    return states[:samples]


def _in_continuous_time(
    system: DiscreteSystem, first_outputs: FloatArray, step: float
) -> FmuStateSpace:
    """Return the continuous-time system that a system in steps samples, with forces held in a step.

    Parameters
    ----------
    system : DiscreteSystem
        The system in steps, in the units of the FMU.
    first_outputs : (C, E) ndarray
        Outputs at the end of the first step, in which each unit force acts.
    step : float
        Length of a step [s].
    """
    order = len(system.transition)
    forces = first_outputs.shape[1]
    after_force, after_release = np.split(system.first_states, [forces], axis=1)
    # logarithm of [[transition, after_force], [0, 1]] (zero-order hold, Van Loan 1978)
    augmented = np.block(
        [[system.transition, after_force], [np.zeros((forces, order)), np.eye(forces)]]
    )
    rates = _logarithm(augmented)[:order] / step
    state_matrix, input_matrix = np.split(rates, [order], axis=1)
    return FmuStateSpace(
        state_matrix=state_matrix,
        input_matrix=input_matrix,
        output_matrix=system.output_rows,
        feedthrough=first_outputs - system.output_rows @ after_force,
        # the first recorded sample comes one step after the release
        release_states=np.asarray(np.linalg.solve(system.transition, after_release)),
    )


def _logarithm(matrix: FloatArray) -> FloatArray:
    """Return the real logarithm of a matrix, by its eigenvectors where these are independent."""
    values, shapes = np.linalg.eig(matrix)
    if np.linalg.cond(shapes) < LARGEST_CONDITION:
        scaled_shapes = shapes * np.log(values.astype(complex))
        return np.asarray(np.real(scaled_shapes @ np.linalg.inv(shapes)))
    with catch_warnings():
        # it warns of rounding in what decays within a step
        simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(logm(matrix)))
