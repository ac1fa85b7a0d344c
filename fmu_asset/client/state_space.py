"""Identification of a linear state-space model from the responses of an FMU.

An FMU hides its equations. If its responses to unit forces and to releases from a unit displacement
are those of a linear system of few states, that system is identified here, and can then be solved
instead of the FMU.
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
"""Largest fraction of a port's speed that may appear at once with a force. It is not zero, since
coarse solver steps of an FMU give a little of such a jump."""
MOST_STATES = 40
"""Largest order of a linear system that is realised from records."""
_EXTRA_TRIPLETS = 16
"""Triplets beyond those used, without which the last ones of a randomised SVD are inaccurate."""
_ROUNDING_OF_MATRIX = 1e-13
"""Singular values below this fraction of the largest are rounding errors."""
HANKEL_ROWS = 64
"""Block rows of the Hankel matrix: samples of one column."""
HANKEL_COLUMNS = 160
"""Block columns of the Hankel matrix: samples of one row."""
MIXTURES = 3
"""Number of random linear combinations of all outputs that replace the outputs in the Hankel
matrix. They see every mode that some output sees, and keep the matrix small."""
LARGEST_CONDITION = 1e5
"""Condition up to which eigenvectors give a matrix logarithm, 20 times faster than `logm`."""
THRESHOLDS = 10.0 ** np.arange(-12, -6)
"""Fractions of the largest singular value below which a singular value is taken for rounding. They
are tried in this order, which begins with the largest model."""
FIT = 1e-7
"""Largest error of a linear system against its record, as a share of the record."""


class VibratingMode(NamedTuple):
    """A vibration mode, as one force excites it and one output shows it.

    Attributes
    ----------
    angular_frequency : float
        The angular frequency [rad/s].
    flexibility : float
        The displacement of the output at rest under a unit force, by this mode alone [m/N].
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
    """The linear system of an FMU with n states s, E forces f, C outputs y and R releases.

    s' = A s + B f and y = C s + D f. Outputs are differences from those of the undisturbed FMU. At
    an instant at which a force jumps, f is its value just before the jump.

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
        The state just after a unit of each release.
    """

    state_matrix: FloatArray
    input_matrix: FloatArray
    output_matrix: FloatArray
    feedthrough: FloatArray
    release_states: FloatArray

    def in_coordinates_of(self, reference: "FmuStateSpace") -> "FmuStateSpace":
        """Return the same system in the state coordinates of a reference system of its order.

        The coordinates of an identified state are arbitrary, so that the states of two systems of
        one FMU with different parameters cannot be compared. Their outputs and rates of outputs
        can: the new coordinates are those in which the rows [C; C A] of both systems agree best
        (least squares).
        """
        own_rows = _outputs_and_rates(self)
        reference_rows = _outputs_and_rates(reference)
        # Rows of outputs in different units count alike.
        row_scale = _nonzero(np.linalg.norm(reference_rows, axis=1, keepdims=True))
        # own state = to_own @ new state
        to_own = np.linalg.lstsq(own_rows / row_scale, reference_rows / row_scale, rcond=None)[0]
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
        """Return the matrices that give outputs, or their derivatives, from state and forces.

        Parameters
        ----------
        columns : (K,) sequence of int
            Indices of the outputs.
        orders : int or (K,) sequence of int
            Order of the time derivative of each output: 0, 1 or 2.

        Returns
        -------
        on_state : (K, n) ndarray
            Matrix that multiplies the state.
        on_forces : (K, E) ndarray
            Matrix that multiplies the forces.
        """
        on_state = self.output_matrix[columns]
        on_forces = self.feedthrough[columns]
        # y = C s + D f has the rate C A s + C B f if f is constant; its rate follows in the same
        # way.
        for order in (0, 1):
            is_higher = np.broadcast_to(orders, len(columns))[:, None] > order
            on_forces = np.where(is_higher, on_state @ self.input_matrix, on_forces)
            on_state = np.where(is_higher, on_state @ self.state_matrix, on_state)
        return on_state, on_forces

    def state_at_rest(self, forces: FloatArray) -> FloatArray:
        """Return the state (n, ...) at rest under constant forces (E, ...): -A^-1 B f."""
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
        """Return each mode's residue (n,) in the transfer function from a force to an output."""
        _, shapes = self.modes
        # Partial fractions: C (z - A)^-1 B = sum of residue_k / (z - rate_k)
        participation = np.linalg.solve(shapes, self.input_matrix[:, force].astype(complex))
        return np.asarray((self.output_matrix[output] @ shapes) * participation)

    def most_flexible_mode(self, output: int, force: int) -> VibratingMode | None:
        """Return the vibrating mode that contributes most to a static displacement under a force.

        Returns
        -------
        VibratingMode or None
            None if no mode vibrates.
        """
        rates, _ = self.modes
        residues = self._residues(output, force)
        angular_frequency = np.abs(rates)
        # One mode of each conjugate pair; real rates are modes that only decay.
        vibrates = rates.imag > 1e-9 * np.abs(rates)
        if not vibrates.any():
            return None
        # At rest a mode gives -residue / rate, and a conjugate pair -2 Re(residue / rate). Without
        # damping rate and residue are imaginary, so this is -2 Im(rate) Im(residue) / |rate|^2.
        flexibility = np.where(
            vibrates, np.abs(2.0 * rates.imag * residues) / angular_frequency**2, 0.0
        )
        most_flexible = int(np.argmax(flexibility))
        return VibratingMode(
            float(angular_frequency[most_flexible]), float(flexibility[most_flexible])
        )

    def stiffness(self, output: int, force: int) -> PortStiffnesses:
        """Return the static stiffness between a force and an output, and that of the main mode."""
        static = 1.0 / float(self.gain[output, force])
        mode = self.most_flexible_mode(output, force)
        # A mode without a noticeable part in the static flexibility is rounding.
        if mode is None or mode.flexibility * static < 1e-6:
            return PortStiffnesses(modal=static, static=static)
        return PortStiffnesses(modal=1.0 / mode.flexibility, static=static)

    def has_jumping_speed(self, outputs: IntArray, forces: IntArray) -> bool:
        """Return whether the speed at any of some ports jumps when the force there jumps.

        At such a port no mass resists the force. A missing effect there that depends on the speed
        could not be integrated in time.

        Parameters
        ----------
        outputs, forces : (P,) array of int
            Indices of the displacement and of the force of each port.
        """
        for output, force in zip(outputs, forces, strict=True):
            residues = self._residues(output, force)
            # The speed y' = C A s + C B f jumps with the force by C B, which is the sum of the
            # residues. If a mass resists the force, they cancel.
            if abs(residues.sum()) > SPEED_JUMP * np.abs(residues).sum():
                return True
        return False


def _outputs_and_rates(system: FmuStateSpace) -> FloatArray:
    """Return the matrix (2 C, n) that gives the outputs and their rates from the state."""
    rates = system.output_matrix @ system.state_matrix
    return np.vstack((system.output_matrix, rates))


def _nonzero(scales: FloatArray) -> FloatArray:
    """Return scales in which 1 replaces 0, to divide by."""
    return np.where(scales == 0.0, 1.0, scales)


# ---------------------------------------------------------------------- realisation


class HankelMatrices(NamedTuple):
    """Two block Hankel matrices of recorded responses, as in the method of Ho and Kalman.

    Attributes
    ----------
    hankel : (h m, w k) ndarray
        Block (i, j) is sample i + j + 1 of the records: m mixtures of outputs (rows) for k forces
        and releases (columns).
    shifted : (h m, w k) ndarray
        The same matrix one sample later: block (i, j) is sample i + j + 2.
    """

    hankel: FloatArray
    shifted: FloatArray


class SingularTriplets(NamedTuple):
    """A singular value decomposition, left @ diag(values) @ right, in descending order.

    It may be truncated to the largest singular values.
    """

    left: FloatArray
    values: FloatArray
    right: FloatArray


class DiscreteSystem(NamedTuple):
    """A linear system in discrete time: s(k+1) = F s(k), y(k) = H s(k) for k >= 1.

    Sample k is taken k + 1 steps after the start. Sample 0 lies at the end of the first step, where
    the unit force still acts and contributes by the feedthrough, so y(0) differs from H s(0).

    Attributes
    ----------
    transition : (n, n) ndarray
        F.
    first_states : (n, E + R) ndarray
        s(0) for each unit force and each release.
    output_rows : (C, n) ndarray
        H.
    """

    transition: FloatArray
    first_states: FloatArray
    output_rows: FloatArray


def realise_state_space(records: FloatArray, forces: int, step: float) -> FmuStateSpace | None:
    """Identify a linear system from its recorded responses to unit forces and releases.

    The method is the eigensystem realisation algorithm of Juang and Pappa (1985), which builds on
    Ho and Kalman (1966). In the Hankel matrix, a few random linear combinations of the outputs take
    the place of all outputs, which keeps the matrix small.

    Parameters
    ----------
    records : (K, C, E + R) ndarray
        Outputs at the ends of K steps. The first E responses are those to a unit of each force,
        which acts during the first step only; the last R are those to a unit of each release.
    forces : int
        The number of forces E.
    step : float
        The length of a step [s].

    Returns
    -------
    FmuStateSpace or None
        None if no system of at most `MOST_STATES` states reproduces the records within `FIT`.
    """
    # scale outputs and inputs, so that the choice of units does not decide what is rounding
    output_scale = _nonzero(np.max(np.abs(records[1:]), axis=(0, 2)))
    input_scale = _nonzero(np.max(np.abs(records[1:]) / output_scale[:, None], axis=(0, 1)))
    scaled_records = records / (output_scale[:, None] * input_scale)
    # try the orders, the largest first, until a discrete-time system reproduces the records
    matrices = _hankel_matrices(scaled_records)
    triplets = _sufficient_triplets(matrices.hankel)
    candidate_orders = [
        int(np.sum(triplets.values > least * triplets.values[0])) for least in THRESHOLDS
    ]
    for order in dict.fromkeys(candidate_orders):
        system = _system_of_order(order, matrices, triplets, scaled_records)
        if system is not None:
            # undo the scales
            system = system._replace(
                first_states=system.first_states * input_scale,
                output_rows=system.output_rows * output_scale[:, None],
            )
            first_outputs = (
                scaled_records[0, :, :forces] * output_scale[:, None] * input_scale[:forces]
            )
            return _in_continuous_time(system, first_outputs, step)
    return None


def _hankel_matrices(records: FloatArray) -> HankelMatrices:
    """Return the Hankel matrices of records (K, C, E + R).

    They have `HANKEL_ROWS` by `HANKEL_COLUMNS` blocks, or fewer if the records are short.
    """
    samples, outputs, inputs = records.shape
    mixing = np.random.default_rng(1).standard_normal((MIXTURES, outputs))
    mixtures = mixing @ records
    height = min(HANKEL_ROWS, (samples - 2) // 2)
    width = min(HANKEL_COLUMNS, samples - 2 - height)
    # Sample 0 is left out, since it contains the feedthrough of the forces. There is one block row
    # more than needed: the two matrices are all but the last, and all but the first.
    sample_of_block = 1 + np.arange(height + 1)[:, None] + np.arange(width)
    blocks = mixtures[sample_of_block].transpose(0, 2, 1, 3)
    matrix = blocks.reshape((height + 1) * MIXTURES, width * inputs)
    return HankelMatrices(hankel=matrix[:-MIXTURES], shifted=matrix[MIXTURES:])


def _sufficient_triplets(matrix: FloatArray) -> SingularTriplets:
    """Return the singular triplets of a matrix, the largest first, as many as a system may need.

    A quarter of them is computed first, which is fast. They suffice if the last one is as small as
    the rounding error of the matrix, because all further ones are rounding errors, too.
    """
    first_triplets = _largest_triplets(matrix, MOST_STATES // 4 + _EXTRA_TRIPLETS)
    if first_triplets.values[-1] <= _ROUNDING_OF_MATRIX * first_triplets.values[0]:
        return first_triplets
    return _largest_triplets(matrix, MOST_STATES + _EXTRA_TRIPLETS)


def _largest_triplets(matrix: FloatArray, count: int) -> SingularTriplets:
    """Return the largest `count` singular triplets of a matrix (r, c), by randomised SVD.

    The matrix is projected on the range of its product with random vectors (Halko, Martinsson and
    Tropp 2011). This is accurate for singular values far above the last one; the caller uses no
    others.
    """
    if min(matrix.shape) <= count:
        left, values, right = np.linalg.svd(matrix, full_matrices=False)
        return SingularTriplets(left, values, right)
    random_vectors = np.random.default_rng(0).standard_normal((matrix.shape[1], count))
    range_basis = np.linalg.qr(matrix @ random_vectors)[0]
    left, values, right = np.linalg.svd(range_basis.T @ matrix, full_matrices=False)
    return SingularTriplets(range_basis @ left, values, right)


def _system_of_order(
    order: int, matrices: HankelMatrices, triplets: SingularTriplets, records: FloatArray
) -> DiscreteSystem | None:
    """Return the discrete-time system of a given order that reproduces scaled records.

    None if the order is out of range, or the system is unstable or misses the records by more than
    `FIT`.
    """
    if not 0 < order <= MOST_STATES:
        return None
    samples, outputs, inputs = records.shape
    # Balanced realisation (Ho and Kalman): the Hankel matrix is the product of the observability
    # matrix, left * root, and the controllability matrix, root * right. The shifted matrix has the
    # transition matrix between the two, so their pseudoinverses on either side isolate it.
    root = np.sqrt(triplets.values[:order])
    left_vectors = triplets.left[:, :order]
    right_vectors = triplets.right[:order]
    transition = (left_vectors / root).T @ matrices.shifted @ (right_vectors.T / root)
    # A growing mode is wrong for the recorded system, which is stable; rounding is allowed.
    if np.max(np.abs(np.linalg.eigvals(transition))) > 1.0 + 1e-9:
        return None
    # The first block column of the controllability matrix is s(1) = transition s(0), since the
    # Hankel matrix begins with sample 1.
    first_columns = (root[:, None] * right_vectors)[:, :inputs]
    first_states = np.asarray(np.linalg.lstsq(transition, first_columns)[0], dtype=np.float64)
    state_history = _states_in_time(transition, first_states, samples)
    # Output matrix by least squares of all outputs on the states. Sample 0 is left out as above.
    state_samples = state_history[1:].transpose(0, 2, 1).reshape(-1, order)
    output_samples = records[1:].transpose(0, 2, 1).reshape(-1, outputs)
    state_scale = np.max(np.abs(state_samples), axis=0)
    # Nearly dependent states: smaller singular values than this are treated as zero.
    scaled_rows = np.linalg.lstsq(state_samples / state_scale, output_samples, rcond=1e-14)[0]
    output_rows = np.asarray(scaled_rows.T / state_scale, dtype=np.float64)
    error = np.max(np.abs(output_samples - state_samples @ output_rows.T), axis=0)
    # 1e-300 accepts an output that is zero throughout.
    if np.all(error <= FIT * np.max(np.abs(output_samples), axis=0) + 1e-300):
        return DiscreteSystem(transition, first_states, output_rows)
    return None


def _states_in_time(transition: FloatArray, first: FloatArray, samples: int) -> FloatArray:
    """Return the free response (K, n, k) that starts at k first states (n, k)."""
    states = first[None]
    power_of_transition = transition
    # Each pass appends as many states as there are: those, advanced by that many steps.
    while len(states) < samples:
        states = np.concatenate((states, power_of_transition @ states))
        power_of_transition = power_of_transition @ power_of_transition
    return states[:samples]


def _in_continuous_time(
    system: DiscreteSystem, first_outputs: FloatArray, step: float
) -> FmuStateSpace:
    """Convert a discrete-time system with a step [s] to the continuous-time system it samples.

    Forces are constant during a step (zero-order hold). `first_outputs` (C, E) are the outputs at
    the end of the first step, during which a unit of each force acts.
    """
    order = len(system.transition)
    forces = first_outputs.shape[1]
    after_force, after_release = np.split(system.first_states, [forces], axis=1)
    # exp([[A, B], [0, 0]] step) = [[transition, after_force], [0, 1]] (Van Loan 1978), so the
    # logarithm of the right-hand side gives A and B.
    augmented = np.block(
        [[system.transition, after_force], [np.zeros((forces, order)), np.eye(forces)]]
    )
    continuous_matrices = _logarithm(augmented)[:order] / step
    state_matrix, input_matrix = np.split(continuous_matrices, [order], axis=1)
    return FmuStateSpace(
        state_matrix=state_matrix,
        input_matrix=input_matrix,
        output_matrix=system.output_rows,
        feedthrough=first_outputs - system.output_rows @ after_force,
        # the first sample is taken one step after the release, so go back by one step
        release_states=np.asarray(np.linalg.solve(system.transition, after_release)),
    )


def _logarithm(matrix: FloatArray) -> FloatArray:
    """Return the real logarithm of a matrix, by eigenvectors if they are well conditioned."""
    values, vectors = np.linalg.eig(matrix)
    if np.linalg.cond(vectors) < LARGEST_CONDITION:
        scaled_vectors = vectors * np.log(values.astype(complex))
        return np.asarray(np.real(scaled_vectors @ np.linalg.inv(vectors)))
    with catch_warnings():
        # logm warns of rounding errors in modes that decay within a step; these do not matter
        simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.real(logm(matrix)))
