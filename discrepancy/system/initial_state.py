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
"""Least participation of a mode at the release point, relative to the largest of all modes. A mode
below it is treated as if it had this participation, since its amplitude is divided by it."""
LEAST_SPEED = 1e-2
"""A drive whose displacement is recorded begins at rest if its first speed is below this fraction
of its largest speed: the slope of the spline at its end is not more accurate."""


class ReleasedState(NamedTuple):
    """State at a release, and the force (n,) that holds the structure until then.

    The force is None if the record does not begin at rest.
    """

    begin: InitialMotion
    holding_force: FloatArray | None


def state_at_first_stamp(
    system: LinearSystem, excitation: Excitation, laws: PortLaws
) -> InitialMotion:
    """Return the state at the first time of a record that is not a ring-down.

    `excitation.begins` decides whether it is the equilibrium under the first loads, rest without
    loads, or the unknown state `excitation.initial`.

    Raises
    ------
    ModelError
        If the record begins at rest but the system has no equilibrium.
    """
    mode_count = len(system.angular_frequency)
    displacement_mode_count = system.displacement_mode_count
    first_stamp = excitation.time[:1]
    motions = list(excitation.prescribed_motions.values())
    drive_positions = np.array([float(motion.values_at(first_stamp)[0]) for motion in motions])
    drive_speeds = _drive_speeds(system, excitation)
    # modal coordinates and their speeds, those of the drives last
    q = np.zeros(mode_count + len(motions))
    v = np.zeros(mode_count + len(motions))
    memory = None
    if excitation.begins is Start.UNKNOWN:
        # in this order: displacements of the modes, their speeds, states (the other speeds)
        initial_state = np.zeros(mode_count + displacement_mode_count)
        initial_state[: len(excitation.initial)] = excitation.initial[: len(initial_state)]
        q[:displacement_mode_count] = initial_state[:displacement_mode_count]
        v[:mode_count] = initial_state[displacement_mode_count:]
    elif excitation.begins is Start.SETTLED:
        amplitudes, memory = _settled_amplitudes(
            system, excitation, laws, drive_positions, drive_speeds
        )
        q[:displacement_mode_count] = amplitudes[:displacement_mode_count]
        v[displacement_mode_count:mode_count] = amplitudes[displacement_mode_count:]
    if motions:
        # coordinates of drives are mass-normalised like those of modes
        q[mode_count:] = system.root_drive_mass * drive_positions
        v[mode_count:] = system.root_drive_mass * drive_speeds
    return InitialMotion(q, v, memory)


def _drive_speeds(system: LinearSystem, excitation: Excitation) -> FloatArray:
    """Return the speeds (P,) of the P prescribed motions at the first time of a record.

    If displacements were recorded, the speed is the slope of a spline, which is set to zero if it
    is nearly zero, because dry friction acts at any other speed. Recorded speeds, prescribed
    states, and the drives of a record that begins in an unknown state keep their values.
    """
    motions = excitation.prescribed_motions.values()
    first_stamp = excitation.time[:1]
    drive_speeds = np.array([float(motion.values_at(first_stamp, 1)[0]) for motion in motions])
    if excitation.begins is Start.UNKNOWN:
        return drive_speeds
    largest_speeds = [np.max(np.abs(motion.values_at(excitation.time, 1))) for motion in motions]
    is_at_rest = np.abs(drive_speeds) < LEAST_SPEED * np.array(largest_speeds)
    has_recorded_displacement = np.array(
        [motion.motion_order == 0 for motion in motions], dtype=np.bool_
    )
    is_slope = has_recorded_displacement & ~system.prescribes_state
    drive_speeds[is_at_rest & is_slope] = 0.0
    return drive_speeds


def _settled_amplitudes(
    system: LinearSystem,
    excitation: Excitation,
    laws: PortLaws,
    drive_positions: FloatArray,
    drive_speeds: FloatArray,
) -> tuple[FloatArray, FloatArray | None]:
    """Return the amplitudes (M,) of the modes in equilibrium at the first stamp of a record.

    The first loads act, and the P drives have their first positions and speeds. The amplitude of a
    mode of displacements is its coordinate, that of a mode of states its speed. The second result
    is the memory of the laws. If nothing acts, all amplitudes are zero, and the memory is None.
    """
    first_stamp = excitation.time[:1]
    load = excitation.loads_at(first_stamp, np.eye(system.unknown_count))  # (1, N)
    # a state is the speed of its coordinate, and a prescribed one acts through the damping
    prescribed_states = np.where(system.prescribes_state, drive_speeds, 0.0)
    if prescribed_states.any():
        load = load - system.damping @ (system.drive_shapes @ prescribed_states)
    if not (load.any() or drive_positions.any()):
        return np.zeros(len(system.angular_frequency)), None
    drive_displacement = system.drive_shapes @ drive_positions
    equilibrium = system.static_path(
        load - system.stiffness @ drive_displacement,
        laws,
        offset=drive_displacement,
        time=float(first_stamp[0]),
    )
    # by the orthogonality of mass-normalised shapes
    amplitudes = system.shapes.T @ (system.mass @ (equilibrium.values[0] - drive_displacement))
    return amplitudes, equilibrium.memory


def released_state(
    system: LinearSystem, excitation: Excitation, point: ReleasePoint, laws: PortLaws
) -> ReleasedState:
    """Return the state at the release of a ring-down.

    A structure at rest is held at its release point, in equilibrium with the laws. Otherwise the
    state is that of `excitation.initial`, and the laws have no memory.

    Raises
    ------
    ModelError
        If no mode moves the release point.
    """
    point_shape = np.asarray(point.row @ system.shapes)
    largest_participation = float(np.max(np.abs(point_shape)))
    if largest_participation == 0.0:
        raise ModelError("The release point of a ring-down does not move in any mode of the model.")
    # The amplitude of each mode (M,) that alone moves the point by the release displacement. A mode
    # that hardly moves the point would need a huge one, hence the least participation.
    least_participation = LEAST_PARTICIPATION * largest_participation
    moves = np.abs(point_shape) >= least_participation
    participation = np.where(
        moves, point_shape, np.where(point_shape < 0.0, -least_participation, least_participation)
    )
    unit_amplitudes = point.release.displacement / participation
    # displacements and speeds of the modes (or deviations from the shape), in these amplitudes
    initial_by_mode = np.zeros((len(system.angular_frequency), 2))
    initial_by_mode[: len(excitation.initial)] = excitation.initial[: len(initial_by_mode)]
    relative_displacements, relative_velocities = initial_by_mode.T
    first_load = np.zeros((1, system.unknown_count))
    if excitation.loads:
        first_load = excitation.loads_at(excitation.time[:1], np.eye(system.unknown_count))
    if point.release.at_rest:
        return _held_state(system, point, laws, relative_displacements, unit_amplitudes, first_load)
    angular_frequency = system.angular_frequency
    # the loads shift the position of rest: a load f has the modal amplitudes shapes.T f / omega^2
    displacement_by_loads: FloatArray | float = 0.0
    if first_load.any():
        displacement_by_loads = (first_load @ system.shapes)[0] / angular_frequency**2
    q = relative_displacements * unit_amplitudes + displacement_by_loads
    v = relative_velocities * unit_amplitudes * angular_frequency
    return ReleasedState(InitialMotion(q, v), None)


def _held_state(
    system: LinearSystem,
    point: ReleasePoint,
    laws: PortLaws,
    displacements: FloatArray,
    unit_amplitudes: FloatArray,
    load: FloatArray,
) -> ReleasedState:
    """Return the state of a structure that is held at rest by a force at its release point.

    The force moves the release point by the release displacement, counted from its position under
    the other loads. The holding force also compensates the forces of the laws, which would move the
    point back.

    Parameters
    ----------
    system, point, laws
        The structure, its release point and its internal forces.
    displacements : (M,) array
        The deviations from the static shape by mode, in units of the release displacement; the
        first entry is the deviation of the whole shape.
    unit_amplitudes : (M,) array
        The modal amplitudes of the release displacement.
    load : (1, n) array
        The sum of the other loads [N].
    """
    row, pull = point.row, point.pull
    unit_force_displacement = system.apply_flexibility(pull)
    compliance = float(row @ unit_force_displacement)
    # the first entry scales the whole shape, by the holding force
    deviation = displacements * unit_amplitudes
    deviation[0] = 0.0
    holding_force = point.release.displacement * (1.0 + displacements[0]) / compliance
    memory = system.static_path(holding_force * pull + load, laws, fixed_row=row, time=0.0).memory
    total_force = holding_force * pull + load[0]
    if memory is not None:
        law_rows = system.rows_of_laws(laws, 0.0)  # (J, N)
        holding_force += (
            float(law_rows @ unit_force_displacement @ memory[:, LAGGED_FORCE]) / compliance
        )
        total_force = holding_force * pull + load[0] - memory[:, LAGGED_FORCE] @ law_rows
        if system.is_truncated:
            # the part of the port's position that fades after the release
            memory[:, FADING_POSITION] = holding_force * (
                law_rows @ system.residual_displacements(pull)
            )
    angular_frequency = system.angular_frequency
    q = total_force @ system.shapes / angular_frequency**2 + deviation
    return ReleasedState(
        InitialMotion(q, np.zeros(len(angular_frequency)), memory), holding_force * pull
    )
