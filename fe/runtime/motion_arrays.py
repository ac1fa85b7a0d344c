"""The arrays that the compiled loops of motion work on.

NumPy and relative imports only: this file is copied into the FMU.
"""

from typing import Any, NamedTuple

from .arrays import FloatArray as FloatArray
from .arrays import IntArray as IntArray

RecordFields = tuple[Any, ...]
"""The fields of one of the records below, as a plain tuple, which numba compiles faster."""

SPEED_LAW, IMMOVABLE = -1, -2
"""In the place of a leader: a law of speed that acts on the modes; a law whose port does not
move."""


class StepArrays(NamedTuple):
    """K time steps of M modes with J laws; boundary k is the begin of step k.

    Attributes
    ----------
    transition : (S, 2M, 2M) array
        New state (q, v) by the old one, for each of S distinct lengths.
    length : (S,) array
        Distinct lengths of steps [s].
    length_of_step : (K,) array of int
        Number of the length of each step.
    increment : (K, 2M) array
        What the applied forces add to (q, v) in each step.
    begin_force, end_force : (K, M) array
        Applied modal forces at the begin and at the end of each step.
    residual_position : (K + 1, J) array
        What loads add to the positions of the laws' ports beyond the modes, at each boundary.
    time : (K + 1,) array
        Times of the boundaries [s].
    sample_boundary : (N,) array of int
        Boundary of each sample; the first sample is at boundary 0.
    stiffness : (M,) array
        Squared angular frequencies [1/s^2].
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
    """J laws with E hysteretic elements at most, and the ports that they act on.

    Attributes
    ----------
    motion_rows : (J, M) array
        Modal row of the motion of each law's port.
    force_rows : (J, M) array
        Modal row along which each law acts. It is the motion row, but for flows from one store into
        another.
    inverse_mass : (J,) array
        Speed of the law's port after a unit impulse of the law: motion row . force row.
    leader : (J,) array of int
        The first law at the same position of a port, which settles the position for all of them;
        or `SPEED_LAW`, or `IMMOVABLE`.
    impulse_response : (S, J, 2M) array
        State (q, v) at the end of a step of each length after a unit impulse of the law at its
        begin.
    law_number : (J,) array of int
        Number of each law in `fe.runtime.laws.LAWS`.
    depends_on_speed : (J,) array of int
        1 for a law of speed, 0 for a law of position.
    parameters : (J, 5 + E) array
        Parameters of each law, then those of its hysteretic elements.
    flexibility : (J,) array
        R, the residual flexibility: position of each law's port under a unit force there, without
        the part of the modes.
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
    """What a step needs to know of its begin, and room for a new state.

    Attributes
    ----------
    q, v : (M,) array
        Modal coordinates and speeds at the begin.
    new_state : (2M,) array
        Room for (q, v).
    forces : (J,) array
        Forces of the laws at the begin.
    speed : (J,) array
        Speed of the port of each law of speed at the begin.
    speed_lost : (J,) array
        What the first half of the law's impulse took of it.
    broke_loose : (J,) array
        1 where dry friction let its port go in this step.
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
        The forces as the residual position follows them.
    memory : (J, 5 + E) array
        Memory of the laws after the last sample.
    """

    q: FloatArray
    v: FloatArray
    port_forces: FloatArray
    lagged_forces: FloatArray
    memory: FloatArray


def port_value(rows: FloatArray, j: int, q: FloatArray) -> float:
    """Return row `j` of `rows` (J, M) times `q` (M,): position or speed of the port of a law."""
    value = 0.0
    for m in range(len(q)):
        value += rows[j, m] * q[m]
    return value


def add_scaled(target: FloatArray, row: FloatArray, factor: float) -> None:
    """Add a row times a factor to modal coordinates or speeds (M,), in place."""
    for m in range(len(target)):
        target[m] += row[m] * factor
