"""A linear rig: displacements and states of first order, loads, prescribed motions, laws at ports.

M u'' + C u' + K u = F x + b(t), T x' + R x = G u' + H u + d(t). A state is the speed of a coordinate that
has no stiffness, x = s', so that both are one equation in z = (u, s). A motion that is prescribed takes its
direction out of u; what is left moves in its modes, exactly from stamp to stamp. For the laws at ports the
prescribed motion is a coordinate of its own, so heavy that they do not move it (`HEAVY`), and it is put right
at every step.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, null_space

from discrepancy.campaign.records import Quantity, Start
from discrepancy.errors import ModelError
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.input_course import SMOOTH_PARTS
from discrepancy.models.interface import Response
from discrepancy.models.rig_records import Acting, Effort, Shown
from discrepancy.models.stepwise import Boundaries, CoupledModes, ExactSteps, advance, exact_steps, substeps
from fe.runtime.errors import SolutionError
from fe.runtime.motion import Laws, ModalMotion, static_solution

FloatArray = NDArray[np.float64]

HEAVY = 1e12
"""Mass of a prescribed coordinate over the largest of the rig."""
LEAST_PIVOT = 1e-9
"""A rig whose equilibrium is determined worse than this has none of its own."""


@dataclass(frozen=True, eq=False)
class Rig:
    """A linear rig.

    Attributes
    ----------
    mass, damping, stiffness : (n + m, n + m) ndarray
        Of (u, s): diag(M, T), [[C, -F], [-G, R]], [[K, 0], [-H, 0]].
    displacements : int
        n.
    ports : mapping of str to (n + m,) ndarray
        Rows where internal forces act, on displacements or on states.
    drives : (P, n + m) ndarray
        Rows whose motion is prescribed.
    actions : mapping of str to (n + m,) ndarray
        Rows along which laws at ports act, where that is not how they see.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    displacements: int
    ports: Mapping[str, FloatArray]
    drives: FloatArray
    actions: Mapping[str, FloatArray] = field(default_factory=dict)

    @cached_property
    def acting_rows(self) -> dict[str, FloatArray]:
        """Rows (n + m,) along which laws at the ports act."""
        return {**self.ports, **self.actions}

    @cached_property
    def lift(self) -> FloatArray:
        """Displacements (n + m, P) by unit motions of the drives."""
        found = np.zeros((len(self.mass), len(self.drives)))
        if len(self.drives):
            found[: self.displacements] = np.linalg.pinv(self.drives[:, : self.displacements])
        return found

    @cached_property
    def _modes(self) -> tuple[FloatArray, FloatArray, int]:
        """Angular frequencies (M,), shapes (n + m, M) of what is free, and how many are of displacements."""
        n = self.displacements
        free = null_space(self.drives[:, :n]) if len(self.drives) else np.eye(n)
        square, shapes = np.zeros(0), np.zeros((free.shape[1], 0))
        if free.shape[1]:
            half = free.T @ (0.5 * (self.stiffness[:n, :n] + self.stiffness[:n, :n].T)) @ free
            square, shapes = eigh(half, free.T @ self.mass[:n, :n] @ free)
            square = np.where(np.abs(square) <= 1e-10 * np.max(np.abs(square), initial=0.0), 0.0, square)
        capacity, axes = np.zeros(0), np.zeros((0, 0))
        if len(self.mass) > n:
            capacity, axes = np.linalg.eigh(self.mass[n:, n:])
        found = np.zeros((len(self.mass), len(square) + len(capacity)))
        found[:n, : len(square)] = free @ shapes
        found[n:, len(square) :] = axes / np.sqrt(capacity)
        frequency = np.sqrt(np.concatenate((np.maximum(square, 0.0), np.zeros(len(capacity)))))
        return frequency, found, len(square)

    @property
    def angular_frequency(self) -> FloatArray:
        """Angular frequencies (M,) [rad/s] of what is free; zero for rigid motions and states."""
        return self._modes[0]

    @property
    def moving(self) -> int:
        """How many of the coordinates are displacements; the others are states."""
        return self._modes[2]

    @cached_property
    def shapes(self) -> FloatArray:
        """Shapes (n + m, M + P) of what is free and of the drives, mass-normalised."""
        return np.hstack((self._modes[1], self.lift / np.sqrt(self._heavy)))

    @cached_property
    def _heavy(self) -> float:
        return HEAVY * float(np.max(np.abs(self.mass)))

    @cached_property
    def free(self) -> CoupledModes:
        """What is free, without ports."""
        frequency, shapes, _ = self._modes
        damping = shapes.T @ self.damping @ shapes
        stiffness = shapes.T @ self.stiffness @ shapes
        largest = float(np.max(np.abs(stiffness), initial=1e-300))
        plain = bool(np.max(np.abs(stiffness - np.diag(frequency**2)), initial=0.0) <= 1e-10 * largest)
        diagonal = np.diag(np.diag(damping))
        if np.max(np.abs(damping - diagonal), initial=0.0) <= 1e-10 * np.max(
            np.abs(diagonal), initial=1e-300
        ):
            damping = diagonal
        return CoupledModes(frequency, damping, stiffness_matrix=None if plain else stiffness)

    @cached_property
    def modal(self) -> CoupledModes:
        """What is free and the drives, with ports."""
        count, whole = len(self.angular_frequency), self.shapes.shape[1]
        damping = np.zeros((whole, whole))
        damping[:count, :count] = self.free.damping
        stiffness = None
        if self.free.stiffness_matrix is not None:
            stiffness = np.zeros((whole, whole))
            stiffness[:count, :count] = self.free.stiffness_matrix
        return CoupledModes(
            np.concatenate((self.angular_frequency, np.zeros(whole - count))), damping,
            {name: np.asarray(row @ self.shapes) for name, row in self.ports.items()},
            stiffness_matrix=stiffness,
            actions={
                name: np.asarray(row @ self.shapes) for name, row in self.acting_rows.items()
            } if self.actions else {},
        )  # fmt: skip

    # ------------------------------------------------------------ rest

    @cached_property
    def _restoring(self) -> FloatArray:
        """Matrix (M, M) of the modal forces at rest by displacements and states."""
        stiffness = self.free.stiffness_matrix
        stiffness = np.diag(self.free.stiffness) if stiffness is None else stiffness
        return np.hstack((stiffness[:, : self.moving], self.free.damping[:, self.moving :]))

    def at_rest(self, force: FloatArray) -> FloatArray:
        """Return displacements of the modes and states (L, M) at rest under modal forces (L, M).

        Raises
        ------
        ModelError
            If nothing holds the rig against a force.
        """
        restoring = self._restoring
        size = float(np.max(np.abs(restoring), initial=0.0))
        values = np.linalg.svd(restoring, compute_uv=False) if restoring.size else np.ones(1)
        if values[-1] > LEAST_PIVOT * max(values[0], 1e-300):
            return np.asarray(np.linalg.solve(restoring, force.T).T)
        found = np.linalg.lstsq(restoring, force.T, rcond=LEAST_PIVOT)[0]
        if np.max(np.abs(restoring @ found - force.T)) > 1e-6 * max(float(np.max(np.abs(force))), 1e-300):
            raise ModelError(
                "the rig has no rest under what acts at the first sample (nothing holds it): say "
                f'`begins` = "still" or "unknown" (its largest restoring coefficient is {size:.3g})'
            )
        return np.asarray(found.T)

    def settled(
        self, force: FloatArray, drive: FloatArray, laws: Laws
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return displacements (L, M + P), states as speeds (L, M + P) at rest, and the laws' memory.

        `force` (L, M) are modal forces, `drive` (L, P) the drives' motions; levels follow one another.
        """
        count, moving = len(self.angular_frequency), self.moving
        linear = self.at_rest(force)
        memory = None
        if len(laws):
            rows = laws.rows(self.modal.ports, self.shapes.shape[1])
            along = rows[:, :moving]
            answer = self.at_rest(np.hstack((along, np.zeros((len(rows), count - moving)))))
            positions = linear[:, :moving] @ along.T + drive * np.sqrt(self._heavy) @ rows[:, count:].T
            try:
                solution = static_solution(
                    laws, positions, along @ answer[:, :moving].T, kernel=compiled_kernel()
                )
            except SolutionError as cause:
                raise ModelError(str(cause)) from cause
            linear, memory = linear - solution.forces @ answer, solution.memory
        q, v = np.zeros((2, len(force), self.shapes.shape[1]))
        q[:, :moving], v[:, moving:count] = linear[:, :moving], linear[:, moving:]
        q[:, count:] = drive * np.sqrt(self._heavy)
        return q, v, memory

    # ------------------------------------------------------------ motion

    @property
    def state_count(self) -> int:
        """How many numbers a state has: displacement and speed of each mode, and the states."""
        return len(self.angular_frequency) + self.moving

    def motion(self, acting: Acting, laws: Laws, refinement: int = 1) -> "RigMotion":
        """Return the motion of a trial.

        Raises
        ------
        ModelError
            If it begins at rest where there is none.
        """
        known, times = acting.time, (1.0 + acting.clock[0]) * acting.time + acting.clock[1]
        early = times[0] > known[0] + 1e-9 * (known[-1] - known[0])
        stamps = np.concatenate((known[:1], times)) if early else times
        smooth = bool(acting.drives) or any(course.is_smooth for _, course in acting.loads)
        least = SMOOTH_PARTS if smooth else 1
        edges = (*laws.edges, *(moment for _, course in acting.loads for moment in course.edges))
        boundaries = substeps(self.modal, laws, stamps, refinement, least, edges)
        count, whole = len(self.angular_frequency), self.shapes.shape[1]
        begin, end = self._modal_forces(acting, boundaries)
        steps = exact_steps(self.free, boundaries.lengths)
        push = np.zeros((len(begin), 2 * whole))
        moved = steps.push(begin[:, :count], end[:, :count])
        push[:, :count], push[:, whole : whole + count] = moved[:, :count], moved[:, count:]
        root = np.sqrt(self._heavy)
        for number, drive in enumerate(acting.drives):
            push[:, count + number] = root * drive.at(boundaries.time[1:], 0)
            push[:, whole + count + number] = root * drive.at(boundaries.time[1:], 1)
        q, v, memory = self._first(acting, laws)
        moved_at = advance(
            self.modal, laws, self._widened(steps), boundaries, q, v, push, begin, end,
            np.zeros((len(boundaries.time), len(laws))), memory,
        )  # fmt: skip
        if acting.begins is not Start.UNKNOWN:
            self._rest_on_drives(moved_at, v, laws)
        late = slice(1, None) if early else slice(None)
        return RigMotion(
            self, acting, times, moved_at.q[late], moved_at.v[late], moved_at.port_forces[late], laws
        )

    def _first(self, acting: Acting, laws: Laws) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Return the state at the first stamp and the laws' memory."""
        count, moving = len(self.angular_frequency), self.moving
        first = acting.time[:1]
        drive = np.array([[float(item.at(first, 0)[0]) for item in acting.drives]])
        drive = drive.reshape(1, len(acting.drives))
        root = np.sqrt(self._heavy)
        speeds = [root * float(item.at(first, 1)[0]) for item in acting.drives]
        if acting.begins is not Start.UNKNOWN and acting.clock[1] == 0.0:
            speeds = [root * item.first_speed for item in acting.drives]  # dry friction is zero at rest
        if acting.begins is Start.SETTLED:
            still = self._force_of(acting, first, moving=False)
            acts = laws.act_at(float(first[0]))
            at_rest, states, memory = self.settled(still, drive, laws.only(acts) if laws.spans else laws)
            states[0, count:] = speeds
            if memory is None or not (np.any(still) or np.any(drive)):
                return at_rest[0], states[0], None
            return at_rest[0], states[0], laws.filled(memory, acts)
        q, v = np.zeros((2, self.shapes.shape[1]))
        if acting.begins is Start.UNKNOWN:
            given = np.zeros(self.state_count)
            given[: len(acting.initial)] = acting.initial[: self.state_count]
            q[:moving], v[:count] = given[:moving], given[moving:]
        q[count:], v[count:] = root * drive[0], speeds
        return q, v, None

    def _rest_on_drives(self, found: ModalMotion, v: FloatArray, laws: Laws) -> None:
        """Take laws of speed at ports that only drives move as nothing where they begin at rest.

        The force by which a drive would be held there, were it a mass, is none that a reading shows.
        """
        if not len(laws):
            return
        rows = laws.rows(self.modal.ports, self.shapes.shape[1])
        driven = ~np.any(rows[:, : len(self.angular_frequency)], axis=1)
        found.port_forces[0, driven & (rows @ v == 0.0) & (laws.of_speed == 1)] = 0.0

    def _widened(self, steps: ExactSteps) -> ExactSteps:
        """Return the steps with the drives, which follow from nothing but what is prescribed."""
        count, whole = len(self.angular_frequency), self.shapes.shape[1]
        at = np.r_[0:count, whole : whole + count]
        transition = np.zeros((len(steps.length), 2 * whole, 2 * whole))
        transition[:, at[:, None], at] = steps.transition
        return ExactSteps(steps.length, steps.which, transition, steps.begin, steps.end)

    def _modal_forces(self, acting: Acting, boundaries: Boundaries) -> tuple[FloatArray, FloatArray]:
        """Return the modal forces (K, M + P) at both ends of each step, those of splines made good for it.

        Straight lines through f - h^2/12 f'' have the mean effect of the curve to fourth order in the step h.
        """
        shapes, count = self._modes[1], len(self.angular_frequency)
        begin = np.zeros((len(boundaries.lengths), self.shapes.shape[1]))
        begin[:, :count] = acting.constant @ shapes
        end = begin.copy()
        for row, course in acting.loads:
            first, last = course.ends(boundaries.time)
            begin[:, :count] += np.outer(first, row @ shapes)
            end[:, :count] += np.outer(last, row @ shapes)
        parts = [shapes.T @ matrix @ self.lift for matrix in (self.stiffness, self.damping, self.mass)]
        bend = boundaries.lengths**2 / 12.0
        for number, drive in enumerate(acting.drives):
            for side, time in ((begin, boundaries.time[:-1]), (end, boundaries.time[1:])):
                w = [drive.at(time, order) for order in range(4)]
                side[:, :count] -= np.outer(w[0] - bend * w[2], parts[0][:, number])
                side[:, :count] -= np.outer(w[1] - bend * w[3], parts[1][:, number])
                side[:, :count] -= np.outer(w[2], parts[2][:, number])
                side[:, count + number] = np.sqrt(self._heavy) * w[2]
        return begin, end

    def load_at(self, acting: Acting, time: FloatArray) -> FloatArray:
        """Return the loads (N, n + m) at times, those that are held as they were just before."""
        total = np.tile(acting.constant, (len(time), 1))
        for row, course in acting.loads:
            total += np.outer(course.at(time), row)
        return np.asarray(total)

    def _force_of(self, acting: Acting, time: FloatArray, *, moving: bool = True) -> FloatArray:
        """Return the modal forces (N, M) at times; without `moving` the drives are taken as at rest."""
        total = self.load_at(acting, time)
        matrices = (self.stiffness, self.damping, self.mass)
        for number, drive in enumerate(acting.drives):
            for order, matrix in enumerate(matrices if moving else matrices[:1]):
                total -= np.outer(drive.at(time, order), matrix @ self.lift[:, number])
        return np.asarray(total @ self._modes[1])


@dataclass(frozen=True)
class RigMotion:
    """Motion of a rig at the samples of a trial.

    Attributes
    ----------
    rig : Rig
        What moved.
    acting : Acting
        What acted.
    time : (N,) ndarray
        Of the samples [s].
    q, velocity : (N, M + P) ndarray
        Modal coordinates and their rates.
    port_forces : (N, J) ndarray
        Internal forces.
    laws : Laws
        Their laws.
    """

    rig: Rig
    acting: Acting
    time: FloatArray
    q: FloatArray
    velocity: FloatArray
    port_forces: FloatArray
    laws: Laws

    @cached_property
    def acceleration(self) -> FloatArray:
        """Second derivatives (N, M + P) of the modal coordinates, from the equation of motion."""
        rig, count = self.rig, len(self.rig.angular_frequency)
        found = np.empty_like(self.q)
        q, v = self.q[:, :count], self.velocity[:, :count]
        stiffness = rig.free.stiffness_matrix
        stiffness = np.diag(rig.free.stiffness) if stiffness is None else stiffness
        found[:, :count] = rig._force_of(self.acting, self.time) - q @ stiffness.T - v @ rig.free.damping.T
        if self.laws.rate != 0.0:
            found[:, :count] -= self.laws.rate * self.time[:, None] * (q @ stiffness.T)
        if len(self.laws):
            rows = self.laws.rows(rig.modal.actions or rig.modal.ports, self.q.shape[1])
            found[:, :count] -= self.port_forces @ rows[:, :count]
        for number, drive in enumerate(self.acting.drives):
            found[:, count + number] = np.sqrt(rig._heavy) * drive.at(self.time, 2)
        return found

    def reaction(self, number: int) -> FloatArray:
        """Return the force (N,) by which a drive makes its motion."""
        rig, along = self.rig, self.rig.lift[:, number]
        total = -self.rig.load_at(self.acting, self.time) @ along
        pairs = ((rig.mass, self.acceleration), (rig.damping, self.velocity), (rig.stiffness, self.q))
        for matrix, coordinates in pairs:
            total += coordinates @ (along @ matrix @ rig.shapes)
        if len(self.laws):
            total += self.port_forces @ (self.laws.rows(rig.acting_rows, len(rig.mass)) @ along)
        return np.asarray(total)

    def effort(self, effort: Effort) -> FloatArray:
        """Return what a controller gives (N,)."""
        n, shapes = self.rig.displacements, self.rig.shapes
        total = self.q @ (effort.by_displacement @ shapes[:n])
        total += self.velocity @ (effort.by_speed @ shapes[:n] + effort.by_state @ shapes[n:])
        for factor, course in effort.courses:
            total += factor * course.at(self.time)
        return np.asarray(total)

    def displacements(self, rows: FloatArray) -> FloatArray:
        """Return row . u and row . x (N, C) of rows (C, n + m)."""
        n, shapes = self.rig.displacements, self.rig.shapes
        return np.asarray(
            self.q @ (rows[:, :n] @ shapes[:n]).T + self.velocity @ (rows[:, n:] @ shapes[n:]).T
        )

    def response(self, shown: Sequence[Shown]) -> Response:
        """Return what the outputs show, and the rates."""
        n, shapes = self.rig.displacements, self.rig.shapes
        motion = [self.q, self.velocity, self.acceleration, None, None]
        values, rates = np.empty((2, len(self.time), len(shown)))
        for column, item in enumerate(shown):
            if item.reaction is not None:
                values[:, column] = self.reaction(item.reaction)
                rates[:, column] = np.gradient(values[:, column], self.time)
                continue
            if item.effort is not None:
                values[:, column] = self.effort(item.effort)
                rates[:, column] = np.gradient(values[:, column], self.time)
                continue
            if max(item.order, item.further + 1) >= 2 and motion[3] is None:
                motion[3] = np.gradient(self.acceleration, self.time, axis=0)
            of_u, of_x = item.row[:n] @ shapes[:n], item.row[n:] @ shapes[n:]
            for target, more in ((values, 0), (rates, 1)):
                first, second = motion[item.order + more], motion[item.further + 1 + more]
                target[:, column] = 0.0
                if first is not None and np.any(of_u):
                    target[:, column] += first @ of_u
                if second is not None and np.any(of_x):
                    target[:, column] += second @ of_x
            values[:, column] += item.constant
        return Response(values, rates)


def order_of(quantity: Quantity) -> int:
    """Return how often a displacement is derived to be of a quantity."""
    return quantity.moving.index(quantity) if quantity.moving else 0
