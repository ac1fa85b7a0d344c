"""Response of M u'' + D u' + K u = forces, with internal forces at ports: static, ring-down, forced.

What the wing and a lumped model have in common. A model makes a `SecondOrderSystem` from its parameters and
the structural part of a patch, keeps it, and asks it for a `Motion`; rows of its outputs then give a
`Response`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, eigh
from scipy.linalg.lapack import dpotrs

from discrepancy.campaign.records import Hold, Release
from discrepancy.campaign.sampling import is_even
from discrepancy.errors import ModelError
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.free_motion import free_motion
from discrepancy.models.input_course import Course
from discrepancy.models.second_order_motion import Motion
from discrepancy.models.stepwise import simulate_at
from fe.runtime.errors import SolutionError
from fe.runtime.modal_system import ModalSystem, linear_step
from fe.runtime.motion import Laws, ModalMotion, StaticSolution, simulate, static_solution

FloatArray = NDArray[np.float64]

LEAST_PARTICIPATION = 0.03
"""A mode that moves the release point less than this share of the most moving one is scaled by the share."""

LEAST_LEAD = 1e-9
"""A first sample that is later than the begin by less than this share of the interval is at the begin."""


@dataclass(frozen=True, eq=False)
class SecondOrderSystem:
    """A linear structure of few unknowns, and its first modes.

    Attributes
    ----------
    mass, damping, stiffness : (n, n) ndarray
        Symmetric; mass and stiffness positive definite.
    ports : mapping of str to (n,) ndarray
        Rows of the ports where internal forces act: displacement [m] or rotation [rad] is row . u.
    mode_count : int
        Modes that move; the others follow without inertia.
    relaxation : float
        Factor of the part of the damping that goes with the stiffness, for the modes without inertia [s].
    on_modes : frozenset of str
        Ports whose position is that of the modes that move alone.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    ports: Mapping[str, FloatArray]
    mode_count: int = 8
    relaxation: float = 0.0
    on_modes: frozenset[str] = frozenset()

    @cached_property
    def _modes(self) -> tuple[FloatArray, FloatArray]:
        count = min(self.mode_count, len(self.mass))
        try:
            square, shapes = eigh(self.stiffness, self.mass, subset_by_index=[0, count - 1])
        except np.linalg.LinAlgError as cause:
            raise ModelError(f"The mass matrix must be positive definite ({cause}).") from cause
        if square[0] <= 0.0:
            raise ModelError(
                f"The stiffness matrix must be positive definite, but an eigenvalue is {square[0]:g} 1/s^2."
            )
        return np.sqrt(square), np.ascontiguousarray(shapes)

    @property
    def angular_frequency(self) -> FloatArray:
        """Angular frequencies (M,) [rad/s], rising."""
        return self._modes[0]

    @property
    def shapes(self) -> FloatArray:
        """Mass-normalised mode shapes (n, M)."""
        return self._modes[1]

    @property
    def truncated(self) -> bool:
        """Whether modes are left out."""
        return len(self.angular_frequency) < len(self.mass)

    @cached_property
    def modal(self) -> ModalSystem:
        """The modes with damping and ports; damping that couples modes by rounding only is made diagonal."""
        damping = self.shapes.T @ self.damping @ self.shapes
        diagonal = np.diag(np.diag(damping))
        if np.max(np.abs(damping - diagonal)) <= 1e-10 * np.max(np.abs(diagonal), initial=1e-300):
            damping = diagonal
        return ModalSystem(
            self.angular_frequency,
            damping,
            {name: np.asarray(row @ self.shapes) for name, row in self.ports.items()},
            self._left_out,
            self.relaxation,
        )

    @cached_property
    def _left_out(self) -> FloatArray | None:
        """Flexibility (P,) of the ports that the modes leave out; None if there is none."""
        if not (self.truncated and self.ports):
            return None
        rows = np.array(list(self.ports.values()))
        left_out = np.einsum("pn,np->p", rows, self.residual(rows.T))
        whole = np.einsum("pn,np->p", rows, self.flexibility(rows.T))
        flexible = [name not in self.on_modes for name in self.ports]
        return np.where((left_out > 1e-9 * whole) & flexible, left_out, 0.0)  # less is rounding

    def _feed(self, row: FloatArray, laws: Laws) -> FloatArray:
        """Return positions (J,) of the laws' ports by a unit force at a row that the modes leave out."""
        if not (self.truncated and len(laws)):
            return np.zeros(len(laws))
        return np.asarray(self.port_rows(laws) @ self.residual(row))

    @cached_property
    def _factor(self) -> tuple[FloatArray, bool]:
        factor: tuple[FloatArray, bool] = cho_factor(self.stiffness)
        return factor

    def flexibility(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, for loads (n,) or (n, k)."""
        # the LAPACK routine itself: checks of its arguments would take ten times as long
        solution, _ = dpotrs(self._factor[0], loads, lower=self._factor[1])
        return np.asarray(solution)

    def residual(self, loads: FloatArray) -> FloatArray:
        """Return the part of K^-1 loads, (n,) or (n, k), that the modes leave out."""
        return np.asarray(self._residual @ loads)

    @cached_property
    def _residual(self) -> FloatArray:
        """Part (n, n) of K^-1 that the modes leave out."""
        held = (self.shapes / self.angular_frequency**2) @ self.shapes.T
        return self.flexibility(np.eye(len(self.mass))) - held

    def port_rows(self, laws: Laws) -> FloatArray:
        """Return the rows (J, n) of the laws' ports."""
        return laws.rows(self.ports, len(self.mass))

    # ------------------------------------------------------------ static

    def static(self, loads: FloatArray, laws: Laws) -> FloatArray:
        """Return the displacements (L, n) under loads (L, n) that follow one another from zero."""
        linear = self.flexibility(loads.T).T
        if not len(laws):
            return linear
        rows = self.port_rows(laws)
        flexible = self.flexibility(rows.T)
        solution = _solve(laws, linear @ rows.T, rows @ flexible)
        return np.asarray(linear - solution.forces @ flexible.T)

    def static_step(
        self, load: FloatArray, laws: Laws, memory: FloatArray | None, before: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the displacement (n,) under a load (n,) reached from the load `before`, and memory.

        For structures that change between load levels; `memory` None: the laws have never been loaded.
        """
        rows = self.port_rows(laws)
        flexible = self.flexibility(rows.T)
        linear = self.flexibility(load)
        start = rows @ self.flexibility(before)
        solution = _solve(laws, (rows @ linear)[None], rows @ flexible, memory, start)
        return np.asarray(linear - flexible @ solution.forces[0]), solution.memory

    # ------------------------------------------------------------ motion

    def ringdown(
        self,
        release_row: FloatArray,
        release: Release,
        initial: FloatArray,
        time: FloatArray,
        laws: Laws,
        *,
        clock: tuple[float, float] = (0.0, 0.0),
        refinement: int = 1,
    ) -> Motion:
        """Return the motion after a release.

        Parameters
        ----------
        release_row : (n,) ndarray
            The release point: row . u is its displacement, and the holding force acts along it.
        release : Release
            How it began.
        initial : (R, 2) ndarray
            As in `Conditions`; rows beyond the modes are passed over.
        time : (N,) ndarray
            Stamps of the samples [s], strictly increasing.
        laws : Laws
            Internal forces.
        clock : tuple of float
            Rate and zero: a sample stamped t shows the motion at (1 + rate) t + zero.
        refinement : int
            Steps are this many times smaller.

        Returns
        -------
        Motion
            Before a release from rest the shape is held. A record that does not begin at rest is continued
            backwards without internal forces where its clock asks for times before zero.

        Raises
        ------
        ModelError
            If the release point cannot be moved, or the static state has no solution.
        """
        times = (1.0 + clock[0]) * time + clock[1]
        at_release = np.zeros(len(laws))
        acts = laws.act_at(0.0)
        q, v, memory, holding = self._released(
            release_row, release, initial, laws.only(acts) if laws.spans else laws
        )
        memory = laws.filled(memory, acts) if memory is not None and laws.spans else memory
        held = 0
        if release.at_rest:
            held = int(np.searchsorted(times, 0.0))  # samples before the release
        nothing = np.zeros(len(times))
        if laws.linear and not self.modal.coupled:
            all_q, all_v = free_motion(self.modal, q, v, times)
            if held:
                all_q[:held], all_v[:held] = q, 0.0
            none = np.zeros((len(times), 0))
            return Motion(self, times, all_q, all_v, nothing, release_row, none, none, laws, held, holding)
        count = len(times)
        all_q, all_v = np.tile(q, (count, 1)), np.tile(v, (count, 1))
        forces, lagged = np.zeros((2, count, len(laws)))
        if held < count:
            lead = float(times[held])
            if memory is not None:
                at_release = memory[:, 2].copy()
            interval = float(times[-1] - times[0]) / (count - 1) if count > 1 else 0.0
            start = 0.0
            if lead < 0.0:
                q, v = self._backwards(q, v, -lead)
                start, lead, memory = lead, 0.0, None
            if lead > LEAST_LEAD * interval:
                first = self._released_from(q, v, memory, laws, np.array([0.0, lead]), lead, refinement)
                q, v, memory, start = first.q[-1], first.v[-1], first.memory, lead
            apart = (interval or 1.0) if is_even(time) else 0.0
            stamps = times[held:] - times[held] + start
            moved = self._released_from(q, v, memory, laws, stamps, apart, refinement)
            all_q[held:], all_v[held:], forces[held:] = moved.q, moved.v, moved.port_forces
            lagged[held:] = moved.lagged
        if held and memory is not None:
            lagged[:held] = at_release
            forces[:held] = at_release
        return Motion(self, times, all_q, all_v, nothing, release_row, forces, lagged, laws, held, holding)

    def forced(
        self,
        input_row: FloatArray,
        course: Course,
        time: FloatArray,
        laws: Laws,
        *,
        clock: tuple[float, float] = (0.0, 0.0),
        refinement: int = 1,
    ) -> Motion:
        """Return the motion at `time` (N,) from rest under the course of a force [N].

        The record of the force is taken as right; with a clock error the samples of the motion are taken at
        (1 + rate) t + zero, and the force is read there from its record. Parameters as in `ringdown`.
        """
        times = (1.0 + clock[0]) * time + clock[1]
        acting, begin = course.at(times), float(course.values[0])
        modes = len(self.angular_frequency)
        modal = self.modal
        shape = np.asarray(input_row @ self.shapes)
        q, v, memory = np.zeros(modes), np.zeros(modes), laws.memory()
        start, lead = float(time[0]), float(times[0] - time[0])
        # At rest before the record: under its first force where that is not zero.
        if begin != 0.0:
            rows = self.port_rows(laws)
            flexible = self.flexibility(rows.T)
            linear = begin * (rows @ self.flexibility(input_row))
            solution = _solve(laws, linear[None], rows @ flexible)
            acts = begin * shape - solution.forces[0] @ laws.rows(modal.ports, modes)
            q, memory = acts / self.angular_frequency**2, solution.memory
        feed = np.stack((self._feed(input_row, laws), np.zeros(len(laws))))
        if lead > LEAST_LEAD * float(time[-1] - time[0]):
            first = simulate(
                modal, laws, q=q, v=v, memory=memory, force=np.array([begin, acting[0]]), interval=lead,
                shape=shape, feed=feed, start=start, refinement=refinement, kernel=compiled_kernel(),
            )  # fmt: skip
            q, v, memory, start = first.q[-1], first.v[-1], first.memory, start + lead
        if course.hold is Hold.LINEAR and is_even(time):
            moved = simulate(
                modal, laws, q=q, v=v, memory=memory, force=acting, shape=shape, feed=feed, start=start,
                interval=float(times[-1] - times[0]) / (len(times) - 1), refinement=refinement,
                kernel=compiled_kernel(),
            )  # fmt: skip
        else:
            moved = simulate_at(
                modal, laws, q=q, v=v, time=times, course=course, shape=shape, memory=memory, feed=feed[0],
                refinement=refinement,
            )  # fmt: skip
        return Motion(self, times, moved.q, moved.v, acting, input_row, moved.port_forces, moved.lagged, laws)

    # ------------------------------------------------------------ parts

    def _released(
        self, row: FloatArray, release: Release, initial: FloatArray, laws: Laws
    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
        """Return modal displacement, velocity, the laws' memory and the holding force at the begin."""
        modes = len(self.angular_frequency)
        shape = np.asarray(row @ self.shapes)
        largest = float(np.max(np.abs(shape)))
        if largest == 0.0:
            raise ModelError("The release point of a ring-down does not move in any mode of the model.")
        safe = np.where(
            np.abs(shape) >= LEAST_PARTICIPATION * largest,
            shape,
            np.where(shape < 0.0, -1.0, 1.0) * LEAST_PARTICIPATION * largest,
        )
        given = np.zeros((modes, 2))
        given[: min(modes, len(initial))] = initial[:modes]
        size = release.displacement
        if not release.at_rest:
            return given[:, 0] * size / safe, given[:, 1] * size * self.angular_frequency / safe, None, 0.0
        goal = size * (1.0 + given[0, 0])
        compliance = float(row @ self.flexibility(row))  # release point, all modes
        holding = goal / compliance
        acts = holding * shape
        memory: FloatArray | None = None
        if len(laws):
            # With the release point held at its displacement: x = x_linear - (C - a a^T / a_0) F.
            rows = self.port_rows(laws)
            along = rows @ self.flexibility(row)
            held = rows @ self.flexibility(rows.T) - np.outer(along, along) / compliance
            solution = _solve(laws, (holding * along)[None], held)
            holding += float(along @ solution.forces[0]) / compliance
            acts = holding * shape - solution.forces[0] @ laws.rows(self.modal.ports, modes)
            memory = solution.memory
            memory[:, 3] = holding * self._feed(row, laws)  # of the port's position, fades after the release
        deviation = given[:, 0] * size / safe
        deviation[0] = 0.0
        return acts / self.angular_frequency**2 + deviation, np.zeros(modes), memory, holding

    def _released_from(
        self,
        q: FloatArray,
        v: FloatArray,
        memory: FloatArray | None,
        laws: Laws,
        time: FloatArray,
        interval: float,
        refinement: int,
    ) -> ModalMotion:
        """Return the motion without loads at stamps (N,) that are `interval` apart, 0 where uneven."""
        if interval and not laws.spans:
            return simulate(
                self.modal, laws, q=q, v=v, memory=memory, force=np.zeros(len(time)), interval=interval,
                start=float(time[0]), refinement=refinement, kernel=compiled_kernel(),
            )  # fmt: skip
        return simulate_at(
            self.modal, laws, q=q, v=v, time=time, course=Course.of(time[:1], np.zeros(1)),
            shape=np.zeros(len(q)), memory=memory, refinement=refinement,
        )  # fmt: skip

    def _backwards(self, q: FloatArray, v: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
        """Return the state a duration [s] earlier, without internal forces."""
        modes = len(q)
        step = linear_step(self.modal, np.zeros(modes), np.zeros(modes), duration).transition
        state = np.linalg.solve(step, np.concatenate((q, v)))
        return np.asarray(state[:modes]), np.asarray(state[modes:])


def _solve(
    laws: Laws,
    linear: FloatArray,
    compliance: FloatArray,
    memory: FloatArray | None = None,
    start: FloatArray | None = None,
) -> StaticSolution:
    try:
        return static_solution(laws, linear, compliance, memory=memory, start=start, kernel=compiled_kernel())
    except SolutionError as cause:
        raise ModelError(str(cause)) from cause
