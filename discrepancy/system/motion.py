"""Motion of a linear system with internal forces at its ports.

A model makes a `LinearSystem` of its parameters and the structural part of a patch, keeps it, and
asks for a `Motion`, from which the outputs are computed. Between the time stamps the linear part of
the motion is exact (`fe.runtime.motion`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import FloatArray, Start
from discrepancy.system.excitation import Excitation, ReleasePoint
from discrepancy.system.initial_state import released_state, state_at_first_stamp
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.output_equation import OutputEquation, rows_in_coordinates
from discrepancy.system.response import Response
from discrepancy.system.time_history import SMOOTH_PARTS, equivalent_ramps
from fe.compilation import compiled_kernel
from fe.runtime.arrays import LAGGED_FORCE
from fe.runtime.motion import InitialMotion, integrate_motion
from fe.runtime.motion_arrays import ModalMotion, StepArrays
from fe.runtime.port_laws import PortLaws
from fe.runtime.time_steps import Boundaries, loaded_steps, step_boundaries

LEAST_LEAD = 1e-9
"""A first sample counts as taken at the start of the motion if it is later by no more than this
fraction of the mean sampling interval."""
FADING_LAGS = 40.0
"""Number of relaxation times after which a released deflection of the modes without inertia is zero
to machine precision."""


@dataclass(frozen=True)
class Motion:
    """Motion at the samples of a trial.

    Attributes
    ----------
    system : LinearSystem
        The linear system whose motion is computed.
    excitation : Excitation
        Its loads, prescribed motions and release.
    laws : PortLaws
        The laws of the J internal forces at ports.
    time : (N,) ndarray
        Times of the motion since the release or the start of the record [s].
    q, velocity : (N, M + P) ndarray
        Modal coordinates and their rates, mass-normalised; the drives come last.
    port_forces : (N, J) ndarray
        The J internal forces at N samples.
    lagged_forces : (N, J) ndarray
        Internal forces after the first-order lag (time constant `system.relaxation`) with which the
        modes without inertia follow them.
    held_samples : int
        The number of samples before the release, at which the structure is held in its shape.
    holding_force : (n,) ndarray, optional
        The force that holds the release point until the release [N].
    """

    system: LinearSystem
    excitation: Excitation
    laws: PortLaws
    time: FloatArray
    q: FloatArray
    velocity: FloatArray
    port_forces: FloatArray
    lagged_forces: FloatArray
    held_samples: int = 0
    holding_force: FloatArray | None = None

    @cached_property
    def acceleration(self) -> FloatArray:
        """Second derivatives (N, M + P) of the modal coordinates, from the equation of motion.

        The coordinates are those of M modes, then P prescribed motions. Forces of laws act against
        the motion, and count with a minus.
        """
        modal = self.system.modal_system
        applied = self.system.modal_forces(self.excitation, self.time)
        acceleration = applied - self._restoring_forces() - self.velocity @ modal.damping.T
        if len(self.laws):
            acceleration -= self.port_forces @ self.laws.port_rows(modal.actions, self.q.shape[1])
        # samples before the release, while the structure is held
        acceleration[: self.held_samples] = 0.0
        return acceleration

    def _restoring_forces(self) -> FloatArray:
        """Return the modal forces (N, M + P) of the stiffness, which may drift with time."""
        restoring = self.q @ self.system.modal_system.full_stiffness.T
        if self.laws.stiffness_rate != 0.0:
            time_of_drift = self.time[:, None] - self.laws.drift_start
            restoring *= 1.0 + self.laws.stiffness_rate * time_of_drift
        return np.asarray(restoring)

    def displacements_and_speeds_at(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the displacements and speeds (N, P) of row . u at all samples, for rows (P, n).

        A state (such as a temperature) is a speed in this system: the speed that is returned for
        it is the state, and the position is its integral over time.
        """
        shapes = (rows @ self.system.shapes_with_drives).T
        without_inertia = (
            self._displacements_without_inertia(rows) if self.system.is_truncated else 0.0
        )
        return self.q @ shapes + without_inertia, self.velocity @ shapes

    def _displacements_without_inertia(self, rows: FloatArray) -> FloatArray:
        """Return what the modes without inertia add to displacements `rows @ u`: (N, C).

        `rows` is a (C, n) array. Applied forces deform these high modes at once. Internal forces,
        and the end of a holding force, deform them with the first-order lag of their damping.
        """
        system = self.system
        residual_flexibility = system.residual_displacements(rows.T)  # (n, C)
        displacement = np.zeros((len(self.time), len(rows)))
        if self.excitation.loads:
            displacement += self.excitation.loads_at(self.time, residual_flexibility)
        if len(self.laws):  # (N, J) @ (J, C)
            displacement -= self.lagged_forces @ (
                system.rows_of_laws(self.laws) @ residual_flexibility
            )
        if self.holding_force is not None and system.relaxation > 0.0:
            fading_end = FADING_LAGS * system.relaxation
            fading_count = int(np.searchsorted(self.time, fading_end, side="right"))
            decay = np.exp(-np.maximum(self.time[:fading_count], 0.0) / system.relaxation)
            displacement[:fading_count] += np.outer(
                decay, self.holding_force @ residual_flexibility
            )
        return displacement

    def response(self, equations: Sequence[OutputEquation]) -> Response:
        """Return the values and rates (N, C) of outputs at all samples, given their C equations.

        Modes without inertia contribute only to the values of displacements and strains, not to
        rates. The rate of an output on which a load or a force of laws acts directly is the
        difference quotient of its values in time.
        """
        values, rates = self._outputs_of_modal_motion(equations)
        if self.system.is_truncated:
            values += self._displacements_without_inertia(
                np.array([equation.rows[0] for equation in equations])
            )
        for column, equation in enumerate(equations):
            values[:, column] += equation.constant
            for factor, load in equation.feedthrough or ():
                values[:, column] += factor * load.values_at(self.time)
            direction = equation.law_direction
            if direction is not None:
                law_directions = self.laws.port_rows(self.system.law_directions, len(direction))
                values[:, column] += self.port_forces @ (law_directions @ direction)
            if equation.feedthrough or direction is not None:
                rates[:, column] = np.gradient(values[:, column], self.time)
        return Response(values, rates)

    def _outputs_of_modal_motion(
        self, equations: Sequence[OutputEquation]
    ) -> tuple[FloatArray, FloatArray]:
        """Return what the modal coordinates and their derivatives contribute to outputs.

        Returns
        -------
        values, rates : (N, C) arrays
            This part of each output, and its time derivative. The fourth derivative of the
            coordinates is neglected in the rates.
        """
        rows_by_derivative = rows_in_coordinates(equations, self.system.shapes_with_drives)
        is_needed = [bool(np.any(derivative_rows)) for derivative_rows in rows_by_derivative]
        # the rate of an output of one derivative needs the next higher derivative
        derivatives = [self.q, self.velocity]
        if any(is_needed[1:]):
            derivatives.append(self.acceleration)
        if any(is_needed[2:]):
            jerk = np.gradient(self.acceleration, self.time, axis=0)
            derivatives.append(jerk)
        values = np.zeros((len(self.time), len(equations)))
        rates = np.zeros((len(self.time), len(equations)))
        for order, derivative_rows in enumerate(rows_by_derivative):
            if not is_needed[order]:
                continue
            values += derivatives[order] @ derivative_rows.T
            if order < 3:
                rates += derivatives[order + 1] @ derivative_rows.T
        return values, rates


def simulate_motion(
    system: LinearSystem, excitation: Excitation, laws: PortLaws, refinement: int = 1
) -> Motion:
    """Return the motion of a system at the samples of a dynamic trial.

    The samples may begin later than the motion, if the trial's clock is shifted.

    Parameters
    ----------
    system : LinearSystem
        The system that moves.
    excitation : Excitation
        Its loads, prescribed motions and release, and the times of the samples.
    laws : PortLaws
        The laws of the internal forces at ports; a drift of the stiffness counts from the first
        time of the record.
    refinement : int
        The factor by which time steps are smaller than usual.

    Raises
    ------
    ModelError
        If the motion has to begin at rest but the system has no equilibrium, or if no mode moves
        the release point.
    """
    laws = replace(laws, drift_start=float(excitation.time[0]))
    if excitation.release is None:
        return _motion_from_record(system, excitation, laws, refinement)
    return _motion_from_release(system, excitation, excitation.release, laws, refinement)


def _motion_from_record(
    system: LinearSystem, excitation: Excitation, laws: PortLaws, refinement: int
) -> Motion:
    """Return the motion under recorded inputs, which begins at the first time of the record."""
    times = excitation.sample_times
    first_stamp = float(excitation.time[0])
    first_state = state_at_first_stamp(system, excitation, laws)
    motion = _integrate_from(system, excitation, laws, first_stamp, times, first_state, refinement)
    starts_at_sample = excitation.begins is not Start.UNKNOWN and times[0] <= first_stamp
    if starts_at_sample and len(laws) and len(system.drives):
        # A speed-dependent law at a port that only drives move has no force at the start if the
        # drives begin at rest. The kernel instead computes the force that would hold the drive's
        # coordinate like a free mass, which no reading contains.
        rows = laws.port_rows(system.modal_system.ports, len(first_state.v))  # (J, M + P)
        is_driven = ~np.any(rows[:, : len(system.angular_frequency)], axis=1)
        is_still = rows @ first_state.v == 0.0
        motion.port_forces[0, is_driven & is_still & (laws.depends_on_speed == 1)] = 0.0
    return Motion(
        system,
        excitation,
        laws,
        times,
        q=motion.q,
        velocity=motion.v,
        port_forces=motion.port_forces,
        lagged_forces=motion.lagged_forces,
    )


def _motion_from_release(
    system: LinearSystem,
    excitation: Excitation,
    point: ReleasePoint,
    laws: PortLaws,
    refinement: int,
) -> Motion:
    """Return the motion after a release at time zero.

    Samples before a release from rest show the structure in the shape in which it is held. If the
    release is not from rest and the clock puts samples before time zero, the motion is continued
    backwards in time to the first of them, without internal forces.
    """
    times = excitation.sample_times
    released = released_state(system, excitation, point, laws)
    first_state = released.begin
    # The integration needs two times. If at most one sample follows the release, another time is
    # appended, which `_with_held_samples` cuts off again.
    held_count = int(np.searchsorted(times, 0.0)) if point.release.at_rest else 0
    stamps = times[held_count:]
    if held_count >= len(times) - 1:
        stamps = np.append(stamps, abs(times[-1]) + 1.0)
    if stamps[0] < 0.0:
        # the transition matrix (2 M, 2 M) of the linear system over a negative time step
        transition_back = system.modal_system.exact_steps(stamps[:1])[0][0]
        first_state = InitialMotion(
            *np.split(transition_back @ np.concatenate((first_state.q, first_state.v)), 2)
        )
    motion = _integrate_from(system, excitation, laws, 0.0, stamps, first_state, refinement)
    if held_count:
        motion = _with_held_samples(motion, released.begin, held_count, len(times))
    return Motion(
        system,
        excitation,
        laws,
        times,
        q=motion.q,
        velocity=motion.v,
        port_forces=motion.port_forces,
        lagged_forces=motion.lagged_forces,
        held_samples=held_count,
        holding_force=released.holding_force,
    )


def _with_held_samples(
    motion: ModalMotion, begin: InitialMotion, held_count: int, count: int
) -> ModalMotion:
    """Put `held_count` samples of the held shape before a motion, and cut it after `count` samples.

    `motion` is that after the release; `begin` is the state at the release: the held shape.
    """
    law_count = motion.port_forces.shape[1]
    forces = np.zeros(law_count) if begin.memory is None else begin.memory[:, LAGGED_FORCE]

    def prepend(before: FloatArray, after: FloatArray) -> FloatArray:
        """Return the row `before` for each held sample, followed by the rows `after`."""
        return np.vstack((np.tile(before, (held_count, 1)), after))[:count]

    return ModalMotion(
        q=prepend(begin.q, motion.q),
        v=prepend(begin.v, motion.v),
        port_forces=prepend(forces, motion.port_forces),
        lagged_forces=prepend(forces, motion.lagged_forces),
        memory=motion.memory,
    )


# ---------------------------------------------------------------- steps


def _integrate_from(
    system: LinearSystem,
    excitation: Excitation,
    laws: PortLaws,
    first_time: float,
    sample_times: FloatArray,
    first_state: InitialMotion,
    refinement: int,
) -> ModalMotion:
    """Return the motion at the sample times (N,) [s], given the state at `first_time` [s].

    If the first sample is not later than `first_time` (but for rounding), the given state is taken
    as the state at the first sample.
    """
    duration = sample_times[-1] - sample_times[0]
    tolerance = LEAST_LEAD * duration / max(len(sample_times) - 1, 1)
    is_late = sample_times[0] - first_time > tolerance
    is_excited = excitation.loads or excitation.prescribed_motions
    # a free linear motion has a closed form, without steps
    if not is_excited and laws.linear:
        since_begin = sample_times - (first_time if is_late else sample_times[0])
        free_motion = system.modal_system.free_motion(first_state.q, first_state.v, since_begin)
        if free_motion is not None:
            q, v = free_motion
            no_forces = np.zeros((len(sample_times), 0))
            return ModalMotion(q, v, no_forces, no_forces, laws.unloaded_memory())
    if not is_late:
        return _integrate_in_steps(system, excitation, laws, sample_times, first_state, refinement)
    # integrate from the earlier begin, and leave out the start itself
    times_with_start = np.append(first_time, sample_times)
    motion = _integrate_in_steps(
        system, excitation, laws, times_with_start, first_state, refinement
    )
    return motion._replace(
        q=motion.q[1:],
        v=motion.v[1:],
        port_forces=motion.port_forces[1:],
        lagged_forces=motion.lagged_forces[1:],
    )


def _integrate_in_steps(
    system: LinearSystem,
    excitation: Excitation,
    laws: PortLaws,
    sample_times: FloatArray,
    first_state: InitialMotion,
    refinement: int,
) -> ModalMotion:
    """Return the motion at the sample times, integrated in time steps from the state at the first.

    Parameters
    ----------
    laws : PortLaws
        The laws of the J internal forces at ports.
    sample_times : (N,) array
        The times of the N samples [s].
    first_state : InitialMotion
        Modal coordinates and their rates at the first sample.
    refinement : int
        Factor on the number of steps in each sampling interval.
    """
    # Divide the sampling intervals into K steps. A load that follows a curve needs several straight
    # lines in an interval, and a step must end wherever a law switches or a load jumps.
    follows_curve = excitation.is_smooth or bool(excitation.prescribed_motions)
    least_steps_per_interval = SMOOTH_PARTS if follows_curve else 1
    jump_times = np.concatenate((laws.switching_times, excitation.jump_times))
    modal = system.modal_system
    step_ends = step_boundaries(
        modal, laws, sample_times, refinement, least_steps_per_interval, jump_times
    )
    # The modes that are not integrated have no inertia, so they follow the loads at once. The
    # displacements (K + 1, J) that this causes at the ports act on the laws, too.
    port_displacements = np.zeros((len(step_ends.time), len(laws)))
    if system.is_truncated and len(laws) and excitation.loads:
        residual_flexibility = system.residual_displacements(system.rows_of_laws(laws).T)  # (n, J)
        port_displacements = excitation.loads_at(step_ends.time, residual_flexibility)
    steps = _linear_steps(system, excitation, step_ends, port_displacements)
    return integrate_motion(modal, laws, steps, first_state, compiled_kernel())


def _linear_steps(
    system: LinearSystem,
    excitation: Excitation,
    step_ends: Boundaries,
    port_displacements: FloatArray,
) -> StepArrays:
    """Return the linear part of the motion in K time steps, for all coordinates.

    Modal coordinates respond to their forces; the coordinate of a drive takes the values of its
    prescribed motion. `port_displacements` (K + 1, J) [m] are those that the loads cause at the
    ports of the J laws in the modes without inertia, at the K + 1 ends of the steps.
    """
    time = step_ends.time
    begin_force, end_force = equivalent_ramps(
        lambda times: system.modal_forces(excitation, times), time
    )
    steps = loaded_steps(system.modal_system, step_ends, begin_force, end_force, port_displacements)
    motions = list(excitation.prescribed_motions.values())
    if not motions:
        return steps
    # The position and speed of a drive are prescribed. They do not depend on the previous step, so
    # that their transition is zero and their increment is the prescribed value (mass-normalised).
    steps = steps._replace(transition=steps.transition.copy())
    coordinate_count = begin_force.shape[1]
    first_drive = len(system.angular_frequency)
    for coordinate, motion in enumerate(motions, first_drive):
        for order in (0, 1):
            row = coordinate + order * coordinate_count
            steps.transition[:, row] = 0.0
            steps.increment[:, row] = system.root_drive_mass * motion.values_at(time[1:], order)
    return steps
