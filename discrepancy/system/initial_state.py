"""The state in which a motion begins: at the first stamp of a record, or at a release."""

from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import FloatArray, Start
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation, ReleasePoint
from discrepancy.system.linear_system import LinearSystem
from fe.runtime.arrays import FADING_POSITION, LAGGED_FORCE
from fe.runtime.motion import InitialMotion
from fe.runtime.port_laws import PortLaws

LEAST_PARTICIPATION = 0.03
"""A mode that moves the release point by less than this share of what the most moving mode does is
scaled as if it moved the point by that share."""
LEAST_SPEED = 1e-2
"""Share of a drive's largest speed below which its spline cannot tell its first speed from rest."""


class ReleasedState(NamedTuple):
    """State at a release, and the force (n,) that holds a structure at rest until then."""

    begin: InitialMotion
    holding_force: FloatArray | None


def state_at_first_stamp(
    system: LinearSystem, excitation: Excitation, laws: PortLaws
) -> InitialMotion:
    """Return the state at the first stamp of a record that is no ring-down.

    Parameters
    ----------
    system : LinearSystem
        The system that moves.
    excitation : Excitation
        What acts on it.
    laws : Laws
        Internal forces.

    Raises
    ------
    ModelError
        If the record begins at rest where the system has no rest.
    """
    mode_count = len(system.angular_frequency)
    count = system.displacement_modes
    first = excitation.time[:1]
    motions = list(excitation.prescribed_motions.values())
    drive_positions = np.array([float(motion.values_at(first)[0]) for motion in motions])
    drive_speeds = np.array([float(motion.values_at(first, 1)[0]) for motion in motions])
    q = np.zeros(mode_count + len(motions))
    v = np.zeros(mode_count + len(motions))
    memory = None
    if excitation.begins is Start.UNKNOWN:
        # displacement and speed of each mode, and the states
        initial = np.zeros(mode_count + count)
        initial[: len(excitation.initial)] = excitation.initial[: len(initial)]
        q[:count] = initial[:count]
        v[:mode_count] = initial[count:]
    else:
        largest_speeds = [
            np.max(np.abs(motion.values_at(excitation.time, 1))) for motion in motions
        ]
        # dry friction is zero at rest
        drive_speeds[np.abs(drive_speeds) < LEAST_SPEED * np.array(largest_speeds)] = 0.0
    if excitation.begins is Start.SETTLED:
        load = excitation.loads_at(first, np.eye(system.size))
        if load.any() or drive_positions.any():
            offset = system.drive_shapes @ drive_positions
            rest = system.static_path(
                load - system.stiffness @ offset, laws, offset=offset, time=float(first[0])
            )
            memory = rest.memory
            amplitudes = system.shapes.T @ (system.mass @ (rest.values[0] - offset))
            q[:count] = amplitudes[:count]
            v[count:mode_count] = amplitudes[count:]
    if motions:
        q[mode_count:] = system.root_drive_mass * drive_positions
        v[mode_count:] = system.root_drive_mass * drive_speeds
    return InitialMotion(q, v, memory)


def released_state(
    system: LinearSystem, excitation: Excitation, point: ReleasePoint, laws: PortLaws
) -> ReleasedState:
    """Return the state at the release of a ring-down.

    Parameters
    ----------
    system : LinearSystem
        The system that moves.
    excitation : Excitation
        What acts on it.
    point : ReleasePoint
        How and where the system is let go.
    laws : Laws
        Internal forces.

    Raises
    ------
    ModelError
        If no mode moves the release point.
    """
    point_shape = np.asarray(point.row @ system.shapes)
    largest = float(np.max(np.abs(point_shape)))
    if largest == 0.0:
        raise ModelError("The release point of a ring-down does not move in any mode of the model.")
    # modal amplitudes of the release displacement; no mode that hardly moves the point gets a huge
    # one
    least = LEAST_PARTICIPATION * largest
    moves = np.abs(point_shape) >= least
    participation = np.where(moves, point_shape, np.where(point_shape < 0.0, -least, least))
    unit_amplitudes = point.release.displacement / participation
    initial = np.zeros((len(system.angular_frequency), 2))
    initial[: len(excitation.initial)] = excitation.initial[: len(initial)]
    displacements, velocities = initial.T
    load = excitation.loads_at(excitation.time[:1], np.eye(system.size))
    if point.release.at_rest:
        return _held_state(system, point, laws, displacements, unit_amplitudes, load)
    frequency = system.angular_frequency
    under_load = (load @ system.shapes)[0] / frequency**2 if load.any() else 0.0
    q = displacements * unit_amplitudes + under_load
    return ReleasedState(InitialMotion(q, velocities * unit_amplitudes * frequency), None)


def _held_state(
    system: LinearSystem,
    point: ReleasePoint,
    laws: PortLaws,
    displacements: FloatArray,
    unit_amplitudes: FloatArray,
    load: FloatArray,
) -> ReleasedState:
    """Return the state of a structure that a force at the release point holds at rest.

    Parameters
    ----------
    system, point, laws
        The structure, its release point and its internal forces.
    displacements : (M,) array
        Deviations from the static shape by mode, in units of the release displacement; the first
        entry is the deviation of the whole shape.
    unit_amplitudes : (M,) array
        Modal amplitudes of the release displacement.
    load : (1, n) array
        What else acts [N].
    """
    row = point.row
    answer = system.flexibility(row)
    compliance = float(row @ answer)
    deviation = displacements * unit_amplitudes
    deviation[0] = 0.0
    holding = point.release.displacement * (1.0 + displacements[0]) / compliance
    memory = system.static_path(holding * row + load, laws, fixed_row=row, time=0.0).memory
    acting = holding * row + load[0]
    if memory is not None:
        # the holding force carries the laws too
        rows = system.rows_of_laws(laws, 0.0)
        holding += float(rows @ answer @ memory[:, LAGGED_FORCE]) / compliance
        acting = holding * row + load[0] - memory[:, LAGGED_FORCE] @ rows
        if system.is_truncated:
            # the part of the port's position that fades after the release
            memory[:, FADING_POSITION] = holding * (rows @ system.residual(row))
    frequency = system.angular_frequency
    q = acting @ system.shapes / frequency**2 + deviation
    return ReleasedState(InitialMotion(q, np.zeros(len(frequency)), memory), holding * row)
