"""Motion of a linear system with internal forces at its ports.

A model makes a `LinearSystem` of its parameters and the structural part of a patch, keeps it, and
asks for a `Motion`, which says what outputs show. Between the stamps the linear part is exact
(`fe.runtime.motion`).
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
"""Share of an interval by which a first sample is later than the begin and still is at it."""
FADING_LAGS = 40.0
"""Relaxation times after which the end of a holding force has faded in modes without inertia."""


@dataclass(frozen=True)
class Motion:
    """Motion at the samples of a trial.

    Attributes
    ----------
    system : LinearSystem
        The system that moves.
    excitation : Excitation
        What acts on it.
    laws : Laws
        J internal forces.
    time : (N,) ndarray
        Times of the motion since the release or the begin of the record [s].
    q, velocity : (N, M + P) ndarray
        Modal coordinates and their rates, mass-normalised; the drives come last.
    port_forces : (N, J) ndarray
        Internal forces.
    lagged_forces : (N, J) ndarray
        Internal forces as the modes without inertia follow them.
    held_samples : int
        Number of first samples that lie before the release, where the shape is held.
    holding_force : (n,) ndarray, optional
        Force that holds the release point until the release [N].
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
        """Second derivatives (N, M + P) of the modal coordinates, from the equation of motion."""
        modal = self.system.modal
        restoring = self.q @ modal.full_stiffness.T
        if self.laws.stiffness_rate != 0.0:
            restoring *= 1.0 + self.laws.stiffness_rate * (
                self.time[:, None] - self.laws.drift_start
            )
        forces = self.system.modal_forces(self.excitation, self.time)
        acceleration = forces - restoring - self.velocity @ modal.damping.T
        if len(self.laws):
            acceleration -= self.port_forces @ self.laws.port_rows(modal.actions, self.q.shape[1])
        acceleration[: self.held_samples] = 0.0
        return acceleration

    def at_rows(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the positions and the speeds (N, P) of rows (P, n) of the unknowns.

        The position of a row of a state is the state's integral, its speed is the state.
        """
        shapes = (rows @ self.system.all_shapes).T
        without_inertia = self._without_inertia(rows) if self.system.is_truncated else 0.0
        return self.q @ shapes + without_inertia, self.velocity @ shapes

    def _without_inertia(self, rows: FloatArray) -> FloatArray:
        """Return what modes without inertia add to row . u, as (N, C) for rows (C, n).

        They follow applied forces without delay, and internal forces and the end of a holding force
        with the delay of their damping.
        """
        system = self.system
        residual = system.residual(rows.T)
        displacement = np.zeros((len(self.time), len(rows)))
        if self.excitation.loads:
            displacement += self.excitation.loads_at(self.time, residual)
        if len(self.laws):
            displacement -= self.lagged_forces @ (system.rows_of_laws(self.laws) @ residual)
        if self.holding_force is not None and system.relaxation > 0.0:
            last = FADING_LAGS * system.relaxation
            count = int(np.searchsorted(self.time, last, side="right"))
            fading = np.exp(-np.maximum(self.time[:count], 0.0) / system.relaxation)
            displacement[:count] += np.outer(fading, self.holding_force @ residual)
        return displacement

    def response(self, equations: Sequence[OutputEquation]) -> Response:
        """Return what outputs show, and the rates of it.

        Modes without inertia are only in outputs that are not differentiated.
        """
        values, rates = self._of_derivatives(equations)
        if self.system.is_truncated:
            values += self._without_inertia(np.array([equation.rows[0] for equation in equations]))
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

    def _of_derivatives(self, equations: Sequence[OutputEquation]) -> tuple[FloatArray, FloatArray]:
        """Return what outputs show of the coordinates and their derivatives, and its rates."""
        rows = rows_in_coordinates(equations, self.system.all_shapes)
        is_asked = [bool(np.any(of_derivative)) for of_derivative in rows]
        derivatives = [self.q, self.velocity]
        if any(is_asked[1:]):
            derivatives.append(self.acceleration)
        if any(is_asked[2:]):
            derivatives.append(np.gradient(self.acceleration, self.time, axis=0))
        values = np.zeros((len(self.time), len(equations)))
        rates = np.zeros((len(self.time), len(equations)))
        for order, of_derivative in enumerate(rows):
            if not is_asked[order]:
                continue
            values += derivatives[order] @ of_derivative.T
            if order < 3:
                rates += derivatives[order + 1] @ of_derivative.T
        return values, rates


def motion_of(
    system: LinearSystem, excitation: Excitation, laws: PortLaws, refinement: int = 1
) -> Motion:
    """Return the motion of a trial, also of one whose clock makes the samples begin late.

    Parameters
    ----------
    system : LinearSystem
        The system that moves.
    excitation : Excitation
        What acts on it.
    laws : Laws
        Internal forces.
    refinement : int
        Steps are this many times smaller.

    Raises
    ------
    ModelError
        If the motion begins at rest where there is no rest, or the release point cannot be moved.
    """
    laws = replace(laws, drift_start=float(excitation.time[0]))
    if excitation.release is None:
        return _motion_from_record(system, excitation, laws, refinement)
    return _motion_from_release(system, excitation, excitation.release, laws, refinement)


def _motion_from_record(
    system: LinearSystem, excitation: Excitation, laws: PortLaws, refinement: int
) -> Motion:
    """Return the motion from the first stamp of a record that is no ring-down."""
    times = excitation.sample_times
    first = float(excitation.time[0])
    begin = state_at_first_stamp(system, excitation, laws)
    motion = _advance(system, excitation, laws, first, times, begin, refinement)
    starts_at_sample = excitation.begins is not Start.UNKNOWN and times[0] <= first
    if starts_at_sample and len(laws) and len(system.drives):
        # Laws of speed at ports that only drives move are zero where the drives begin at rest: the
        # kernel's
        # force would hold the drive as if it were a mass, and no reading shows that force.
        rows = laws.port_rows(system.modal.ports, len(begin.v))
        is_driven = ~np.any(rows[:, : len(system.angular_frequency)], axis=1)
        is_still = rows @ begin.v == 0.0
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

    Before a release from rest the shape is held. A release that is not from rest is continued
    backwards without internal forces where its clock asks for times before zero.

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
    refinement : int
        Steps are this many times smaller.
    """
    times = excitation.sample_times
    released = released_state(system, excitation, point, laws)
    begin = released.begin
    # samples after the release, at least one interval of them
    held = int(np.searchsorted(times, 0.0)) if point.release.at_rest else 0
    stamps = times[held:]
    if held >= len(times) - 1:
        stamps = np.append(stamps, abs(times[-1]) + 1.0)
    if stamps[0] < 0.0:
        backwards = system.modal.exact_steps(stamps[:1])[0][0]
        begin = InitialMotion(*np.split(backwards @ np.concatenate((begin.q, begin.v)), 2))
    motion = _advance(system, excitation, laws, 0.0, stamps, begin, refinement)
    if held:
        motion = _with_held_samples(motion, released.begin, held, len(times))
    return Motion(
        system,
        excitation,
        laws,
        times,
        q=motion.q,
        velocity=motion.v,
        port_forces=motion.port_forces,
        lagged_forces=motion.lagged_forces,
        held_samples=held,
        holding_force=released.holding_force,
    )


def _with_held_samples(
    motion: ModalMotion, begin: InitialMotion, held: int, count: int
) -> ModalMotion:
    """Return a motion of `count` samples, of which the first `held` show the held shape."""
    laws = motion.port_forces.shape[1]
    forces = np.zeros(laws) if begin.memory is None else begin.memory[:, LAGGED_FORCE]

    def prepend(before: FloatArray, after: FloatArray) -> FloatArray:
        return np.vstack((np.tile(before, (held, 1)), after))[:count]

    return ModalMotion(
        q=prepend(begin.q, motion.q),
        v=prepend(begin.v, motion.v),
        port_forces=prepend(forces, motion.port_forces),
        lagged_forces=prepend(forces, motion.lagged_forces),
        memory=motion.memory,
    )


# ---------------------------------------------------------------- steps


def _advance(
    system: LinearSystem,
    excitation: Excitation,
    laws: PortLaws,
    first: float,
    stamps: FloatArray,
    begin: InitialMotion,
    refinement: int,
) -> ModalMotion:
    """Return the motion at stamps from a state at a time that may lie before them.

    Parameters
    ----------
    system, excitation, laws
        What moves, and what acts on it.
    first : float
        Time of the state `begin` [s].
    stamps : (N,) array
        Times at which the motion is asked for [s].
    begin : Begin
        The state at `first`.
    refinement : int
        Steps are this many times smaller.
    """
    tolerance = LEAST_LEAD * (stamps[-1] - stamps[0]) / max(len(stamps) - 1, 1)
    is_late = stamps[0] - first > tolerance
    is_excited = excitation.loads or excitation.prescribed_motions
    if not is_excited and laws.linear:
        since_begin = stamps - (first if is_late else stamps[0])
        free = system.modal.free_motion(begin.q, begin.v, since_begin)
        if free is not None:
            q, v = free
            no_forces = np.zeros((len(stamps), 0))
            return ModalMotion(q, v, no_forces, no_forces, laws.unloaded_memory())
    if not is_late:
        return _advance_in_steps(system, excitation, laws, stamps, begin, refinement)
    from_begin = np.append(first, stamps)
    motion = _advance_in_steps(system, excitation, laws, from_begin, begin, refinement)
    return motion._replace(
        q=motion.q[1:],
        v=motion.v[1:],
        port_forces=motion.port_forces[1:],
        lagged_forces=motion.lagged_forces[1:],
    )


def _advance_in_steps(
    system: LinearSystem,
    excitation: Excitation,
    laws: PortLaws,
    stamps: FloatArray,
    begin: InitialMotion,
    refinement: int,
) -> ModalMotion:
    """Return the motion at stamps (N,) [s] from a state at the first of them, step by step."""
    modal = system.modal
    is_smooth = excitation.is_smooth or bool(excitation.prescribed_motions)
    least_parts = SMOOTH_PARTS if is_smooth else 1
    edges = (*laws.switching_times, *excitation.edges)
    boundaries = step_boundaries(modal, laws, stamps, refinement, least_parts, edges)
    # what loads add to the ports beyond the modes
    port_displacements = np.zeros((len(boundaries.time), len(laws)))
    if system.is_truncated and len(laws) and excitation.loads:
        residual = system.residual(system.rows_of_laws(laws).T)
        port_displacements = excitation.loads_at(boundaries.time, residual)
    steps = _steps(system, excitation, boundaries, port_displacements)
    return integrate_motion(modal, laws, steps, begin, compiled_kernel())


def _steps(
    system: LinearSystem,
    excitation: Excitation,
    boundaries: Boundaries,
    port_displacements: FloatArray,
) -> StepArrays:
    """Return the steps of all coordinates; drives follow their prescribed motions alone.

    `port_displacements` (K + 1, J) is what loads add to the positions of laws' ports beyond the
    modes.
    """
    time = boundaries.time
    begin, end = equivalent_ramps(lambda times: system.modal_forces(excitation, times), time)
    steps = loaded_steps(system.modal, boundaries, begin, end, port_displacements)
    motions = list(excitation.prescribed_motions.values())
    if not motions:
        return steps
    # each drive's position and speed, in place of an integrated one
    steps = steps._replace(transition=steps.transition.copy())
    coordinate_count = begin.shape[1]
    first_drive = len(system.angular_frequency)
    for coordinate, motion in enumerate(motions, first_drive):
        for order in (0, 1):
            row = coordinate + order * coordinate_count
            steps.transition[:, row] = 0.0
            steps.increment[:, row] = system.root_drive_mass * motion.values_at(time[1:], order)
    return steps
