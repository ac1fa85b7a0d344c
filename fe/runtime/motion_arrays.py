"""The arrays that the compiled loops of motion work on.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Any, NamedTuple

from .arrays import FloatArray as FloatArray
from .arrays import IntArray as IntArray

RecordFields = tuple[Any, ...]
"""The fields of one of the records below, as a plain tuple, which numba compiles faster."""

SPEED_LAW, IMMOVABLE = -1, -2
"""Values of `PortArrays.leader` for a law of speed that acts on the modes, and for a law whose port
cannot move."""


class StepArrays(NamedTuple):
    """K time steps of M modes with J laws; boundary k is the beginning of step k.

    Attributes
    ----------
    transition : (S, 2M, 2M) array
        Transition matrix of the state (q, v) over a step, for each of S distinct lengths.
    length : (S,) array
        Distinct lengths of steps [s].
    length_of_step : (K,) array of int
        Number of the length of each step.
    increment : (K, 2M) array
        Change of the state (q, v) by the applied forces in each step.
    begin_force, end_force : (K, M) array
        Applied modal forces at the beginning and at the end of each step.
    residual_position : (K + 1, J) array
        Displacements of the laws' ports under the loads in the modes that are left out, at each
        boundary.
    time : (K + 1,) array
        Times of the boundaries [s].
    sample_boundary : (N,) array of int
        Boundary of each sample; the first sample is at boundary 0.
    stiffness : (M, M) array
        S, which couples a mode with the drives, and is else diagonal [1/s^2].
    damping : (M, M) array
        D [1/s].
    """

    transition: FloatArray
    length: FloatArray
    length_of_step: IntArray
    increment: FloatArray
    begin_force: FloatArray
    end_force: FloatArray
    residual_position: FloatArray
    time: FloatArray
    sample_boundary: IntArray
    stiffness: FloatArray
    damping: FloatArray


class PortArrays(NamedTuple):
    """J laws with at most E hysteretic elements, and the ports at which they act.

    Attributes
    ----------
    motion_rows : (J, M) array
        Modal row of the motion of each law's port.
    force_rows : (J, M) array
        Modal row along which each law acts. It equals the motion row, except for a law that moves
        something from one state into another (such as a flow between tanks).
    inverse_mass : (J,) array
        Speed of the law's port after a unit impulse of the law: motion row . force row.
    leader : (J,) array of int
        The first of the laws that share a port position, which is solved once for all of them;
        or `SPEED_LAW`, or `IMMOVABLE`.
    impulse_response : (S, J, 2M) array
        State (q, v) at the end of a step of each length after a unit impulse of the law at its
        beginning.
    law_number : (J,) array of int
        Index of each law in `fe.runtime.laws.LAWS`.
    depends_on_speed : (J,) array of int
        1 for a law of speed, 0 for a law of position.
    parameters : (J, 5 + E) array
        Parameters of each law, then those of its hysteretic elements.
    flexibility : (J,) array
        R, the residual flexibility: position of each law's port under a unit force there, without
        the contribution of the modes.
    relaxation : float
        beta, the time constant of the residual position [s].
    stiffness_rate : float
        r, the drift of the whole structure's stiffness [1/s].
    """

    motion_rows: FloatArray
    force_rows: FloatArray
    inverse_mass: FloatArray
    leader: IntArray
    impulse_response: FloatArray
    law_number: IntArray
    depends_on_speed: IntArray
    parameters: FloatArray
    flexibility: FloatArray
    relaxation: float
    stiffness_rate: float


class ModalState(NamedTuple):
    """Modal coordinates `q` and speeds `v` (M,), and the `memory` (J, 5 + E) of the laws."""

    q: FloatArray
    v: FloatArray
    memory: FloatArray


class StepWorkspace(NamedTuple):
    """Values at the beginning of a step that are needed at its end, and a buffer for the new state.

    Attributes
    ----------
    q, v : (M,) array
        Modal coordinates and speeds at the beginning.
    new_state : (2M,) array
        Buffer for (q, v).
    forces : (J,) array
        Forces of the laws at the beginning.
    speed : (J,) array
        Speed of the port of each law of speed at the beginning.
    speed_lost : (J,) array
        Decrease of that speed by the first half of the law's impulse.
    broke_loose : (J,) array
        1 if dry friction that held the port gave way in this step, else 0.
    """

    q: FloatArray
    v: FloatArray
    new_state: FloatArray
    forces: FloatArray
    speed: FloatArray
    speed_lost: FloatArray
    broke_loose: FloatArray


class ModalMotion(NamedTuple):
    """Motion at N samples.

    Attributes
    ----------
    q, v : (N, M) array
        Modal coordinates and speeds.
    port_forces : (N, J) array
        Forces of the laws [N or N m].
    lagged_forces : (N, J) array
        The forces after the first-order lag with which the residual position follows them.
    memory : (J, 5 + E) array
        Memory of the laws after the last sample.
    """

    q: FloatArray
    v: FloatArray
    port_forces: FloatArray
    lagged_forces: FloatArray
    memory: FloatArray


def port_value(rows: FloatArray, j: int, q: FloatArray) -> float:
    """Return `rows[j] @ q`: the position or speed of the port of law `j`."""
    value = 0.0
    for m in range(len(q)):
        value += rows[j, m] * q[m]
    return value


def add_scaled(target: FloatArray, row: FloatArray, factor: float) -> None:
    """Add a row times a factor to modal coordinates or speeds (M,), in place."""
    for m in range(len(target)):
        target[m] += row[m] * factor
