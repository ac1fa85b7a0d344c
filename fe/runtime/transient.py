"""A structure at rest, or moving in its lowest modes, with or without laws at its ports.

Kapteyn et al. 2021, eq. (12), in modal coordinates: q'' + 2 zeta omega q' + omega^2 q = shape^T f,
one equation for each mode, because Rayleigh damping (17) does not couple the modes. It is solved
exactly for constant loads. The modes that are left out follow the loads without delay (static
correction). Laws at ports couple the modes: `fe.runtime.motion` makes the steps then, and the modes
that are left out follow the forces of the laws with the lag of the damping.

NumPy and relative imports only: this file is copied into the FMU. The modules of laws are imported
only where there are laws.
"""

from dataclasses import dataclass, field, replace
from math import exp, isfinite
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .arrays import FADING_POSITION, FIRST_ELEMENT, LAGGED_FORCE, FloatArray
from .errors import InvalidStateError
from .structure_in_motion import StructureInMotion
from .unit_responses import UnitResponses

if TYPE_CHECKING:
    from .motion_arrays import ModalMotion


INSTANT = 1e-6
"""Duration of a step of which only the state at its beginning is used [s]."""


@dataclass(frozen=True, slots=True)
class TransientState:
    """The complete state of a structure between two time steps.

    Attributes
    ----------
    displacement : (M,) array
        Modal coordinates q [m kg^1/2]; empty for a structure at rest, which has no motion.
    velocity : (M,) array
        Modal velocities [m kg^1/2 / s].
    load : (L,) array
        Present coefficients of the loads; for a wing the load factor [1] and the tip force [N].
    memory : (J, 5 + E) array
        Memory of the laws, among it the lagged forces that the left-out modes follow.
    """

    displacement: FloatArray
    velocity: FloatArray
    load: FloatArray
    memory: FloatArray = field(default_factory=lambda: np.zeros((0, FIRST_ELEMENT)))

    @property
    def moves(self) -> bool:
        """Whether the state has modal coordinates, even with zero speed."""
        return len(self.displacement) > 0


class ModalIntegrator:
    """The response of a structure in time, at fixed health, parameters and masses.

    The integrator never changes; its methods take a `TransientState` and return a new one. When the
    health changes, make another integrator and let it take over the state (`take_over`).

    Parameters
    ----------
    structure : StructureInMotion
        From `structure_at` of a `ReducedModel` or a `PatchedWing`.
    damping_alpha, damping_beta : float
        Rayleigh damping [1/s], [s].

    Attributes
    ----------
    damping_ratio : (M,) array
        Damping ratios of the modes, eq. (18).

    Raises
    ------
    InvalidStateError
        If a Rayleigh coefficient is negative or not finite.
    """

    def __init__(
        self, structure: StructureInMotion, damping_alpha: float, damping_beta: float
    ) -> None:
        for name, value in (("damping_alpha", damping_alpha), ("damping_beta", damping_beta)):
            if not (isfinite(value) and value >= 0.0):
                raise InvalidStateError(
                    f"{name} must be zero or a positive finite number, but is {value!r}."
                )
        self.structure = structure
        self.modes = structure.modes
        self._responses = UnitResponses(structure, damping_alpha, damping_beta)
        self._laws = structure.laws
        self._law_count = 0 if self._laws is None else len(self._laws)

    @property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,) of the modes."""
        return self._responses.damping_ratio

    # ------------------------------------------------------------ states at rest

    def equilibrium(
        self, load: npt.ArrayLike, previous_state: TransientState | None = None
    ) -> TransientState:
        """Return the equilibrium under loads, as a state without motion.

        Parameters
        ----------
        load : (L,) array_like
            Coefficients of the loads.
        previous_state : TransientState, optional
            The equilibrium from which the loads are reached, by default that without loads.

        Raises
        ------
        SolutionError
            If laws have no equilibrium on the way.
        """
        loads = np.array(load, dtype=np.float64)
        no_motion = np.zeros(0)
        if not self._law_count:
            return TransientState(no_motion, no_motion, loads)
        assert self._laws is not None
        if previous_state is None:
            unloaded = np.zeros(self._responses.load_count)
            memory = self._laws.unloaded_memory()
            previous_state = TransientState(no_motion, no_motion, unloaded, memory)
        _, memory = self._law_forces_at_rest(
            linear_positions=self._responses.port_positions_by_loads @ loads,
            compliance=self._responses.port_compliance,
            memory=previous_state.memory,
            start=self._responses.port_positions_by_loads @ previous_state.load,
        )
        return TransientState(no_motion, no_motion, loads, memory)

    def _law_forces_at_rest(
        self,
        linear_positions: FloatArray,
        compliance: FloatArray,
        memory: FloatArray,
        start: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the forces (J,) of the laws at rest, and their new memory (J, 5 + E).

        `linear_positions` and `start` (J,) are the positions of the ports without internal forces,
        now and before; `compliance` (J, J) are the positions under unit forces.
        """
        from .motion import static_solution

        assert self._laws is not None
        solution = static_solution(
            self._laws, linear_positions[np.newaxis], compliance, memory=memory, start=start
        )
        return solution.forces[0], solution.memory

    def state_at_rest(self, load: npt.ArrayLike) -> TransientState:
        """Return the state of a structure that can move and is at rest under loads (L,).

        Raises
        ------
        SolutionError
            If laws have no equilibrium.
        """
        return self._with_still_modes(self.equilibrium(load))

    def _with_still_modes(
        self, equilibrium: TransientState, holding: FloatArray | float = 0.0
    ) -> TransientState:
        """Give an equilibrium resting modes, displaced by `holding` (M,)."""
        q = self._responses.modal_coordinates @ self._static_loads(equilibrium) + holding
        return replace(equilibrium, displacement=q, velocity=np.zeros_like(q))

    @staticmethod
    def _static_loads(state: TransientState) -> FloatArray:
        """Return the coefficients (L + J,) of the unit loads: loads and lagged forces of laws."""
        return np.concatenate((state.load, -state.memory[:, LAGGED_FORCE]))

    # ------------------------------------------------------------ motion

    def state_after_release(
        self, offset: float, load: npt.ArrayLike, holding_load: int
    ) -> TransientState:
        """Return the state just after the release of a structure that a force has held displaced.

        Parameters
        ----------
        offset : float
            Displacement of the last static output (of a wing, its tip) by the holding force, from
            the equilibrium under the other loads [m]. It is that of the structure without laws.
        load : (L,) array_like
            Coefficients of the loads that stay.
        holding_load : int
            Index of the holding load.

        Raises
        ------
        SolutionError
            If laws have no equilibrium on the way.
        """
        rest_state = self.equilibrium(load)
        # the force that causes the offset, and the static state under it
        response = self.structure.unit_responses[:, holding_load]
        force = offset / float(self.structure.output_rows[-1] @ response) if offset else 0.0
        if force and self._law_count:
            rest_state, force = self._held_by_force(rest_state, force, holding_load)
        state = self._with_still_modes(
            rest_state, self._responses.modal_coordinates[:, holding_load] * force
        )
        if self.structure.holding_load is not None and self._responses.beta > 0.0:
            removed_load = force * np.eye(self._responses.load_count)[self.structure.holding_load]
            state = replace(state, load=state.load + removed_load)
        # the forces of the laws just after the release
        if self._law_count:
            memory = rest_state.memory.copy()
            motion = self._motion_with_laws(state, rest_state.load, INSTANT, 0.0)
            memory[:, LAGGED_FORCE] = motion.lagged_forces[0]
            state = replace(state, memory=memory)
        return state

    def _held_by_force(
        self, rest_state: TransientState, force: float, holding_load: int
    ) -> tuple[TransientState, float]:
        """Return the equilibrium of a structure that a force holds displaced, and the force [N].

        The point is held at the displacement that the given force would cause without laws; the
        laws change the force that this needs. With the forces F of the laws, the compliance C of
        the ports, the response a of the ports to a unit force at the point, and the response a_0 of
        the point itself, the positions of the ports are x = x_linear - (C - a a^T / a_0) F.
        """
        response = self.structure.unit_responses[:, holding_load]
        port_response = self._responses.port_positions[:, holding_load]
        point_response = self.structure.unit_loads[:, holding_load] @ response
        at_rest = self._responses.port_positions_by_loads @ rest_state.load
        forces_before = rest_state.memory[:, LAGGED_FORCE]
        start = at_rest - port_response / point_response * (port_response @ forces_before)
        forces, memory = self._law_forces_at_rest(
            linear_positions=start + force * port_response,
            compliance=self._responses.port_compliance
            - np.outer(port_response, port_response) / point_response,
            memory=rest_state.memory,
            start=start,
        )
        force += float(port_response @ (forces - forces_before) / point_response)
        # the part of the ports' positions that decays after the release
        residual = self._responses.residual_displacements[:, holding_load]
        memory[:, FADING_POSITION] = force * (self._responses.law_loads.T @ residual)
        return replace(rest_state, memory=memory), force

    def advance(
        self, state: TransientState, duration: float, load: npt.ArrayLike, time: float = 0.0
    ) -> TransientState:
        """Return the state after a time step under constant loads.

        Without laws the step is exact for the kept modes. If the loads differ from those of the
        state, they jump at the beginning of the step.

        Parameters
        ----------
        duration : float
            Duration of the step [s], positive.
        load : (L,) array_like
            Coefficients of the loads.
        time : float
            Time at the beginning of the step [s], for a stiffness that drifts.

        Raises
        ------
        InvalidStateError
            If the duration is not positive or a load is not finite.
        """
        loads = np.array(load, dtype=np.float64)
        if not (isfinite(duration) and duration > 0.0 and np.isfinite(loads).all()):
            raise InvalidStateError(
                "A transient step needs a positive duration and a finite load, but got "
                f"{duration!r} s and {load!r}."
            )
        if self._laws is None or self._laws.linear:
            q, v = self._linear_step(state, loads, duration)
            memory = state.memory
        else:
            motion = self._motion_with_laws(state, loads, duration, time)
            q = motion.q[-1]
            v = motion.v[-1]
            memory = motion.memory
        # the residual position still follows the end of the holding force
        holding = self.structure.holding_load
        if holding is not None and state.load[holding] != 0.0:
            loads[holding] = state.load[holding] * exp(-duration / self._responses.beta)
        return TransientState(q, v, loads, memory)

    def _linear_step(
        self, state: TransientState, loads: FloatArray, duration: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return modal coordinates and velocities (M,) after an exact step without laws.

        The modes move freely about the equilibrium under the loads (L,).
        """
        transition = self._responses.system.exact_steps(np.array([duration])).transition[0]
        equilibrium = self._responses.modal_coordinates[:, : self._responses.load_count] @ loads
        begin = np.concatenate((state.displacement - equilibrium, state.velocity))
        end = transition @ begin
        count = len(equilibrium)
        # plus zero: a structure at rest has the velocity 0, not -0
        return end[:count] + equilibrium, end[count:] + 0.0

    def _motion_with_laws(
        self, state: TransientState, loads: FloatArray, duration: float, time: float
    ) -> "ModalMotion":
        """Integrate the motion with laws over a step under constant loads."""
        from .motion import InitialMotion, integrate_motion
        from .time_steps import loaded_steps, step_boundaries

        assert self._laws is not None
        boundaries = step_boundaries(self._responses.system, self._laws, np.array([0.0, duration]))
        modal_force = self._responses.participation[:, : self._responses.load_count] @ loads
        held_forces = np.tile(modal_force, (len(boundaries.lengths), 1))
        residual = self._responses.residual_displacements[:, : self._responses.load_count] @ loads
        port_residual = self._responses.law_loads.T @ residual
        steps = loaded_steps(
            self._responses.system,
            boundaries,
            begin_force=held_forces,
            end_force=held_forces,
            residual_position=np.tile(port_residual, (len(boundaries.time), 1)),
        )
        return integrate_motion(
            self._responses.system,
            self._laws,
            steps._replace(time=time + steps.time),
            InitialMotion(state.displacement, state.velocity, state.memory),
        )

    # ------------------------------------------------------------ outputs

    def displacement(self, state: TransientState) -> FloatArray:
        """Return the displacement (n,) in a state, in the coordinates of the structure.

        The modes that are left out follow the loads at once.
        """
        static_loads = self._static_loads(state)
        if not state.moves:
            return np.asarray(self.structure.unit_responses @ static_loads)
        return np.asarray(
            self.structure.mode_shapes @ state.displacement
            + self._responses.residual_displacements @ static_loads
        )

    def outputs(self, state: TransientState) -> FloatArray:
        """Return gauges [1], displacements [m] and accelerations [m/s^2] (O + A,) in a state.

        Accelerations are those of the kept modes, because the others have no inertia. A state
        without motion has no accelerations: the result is (O,).
        """
        if not state.moves:
            return np.asarray(self.structure.output_rows @ self.displacement(state))
        static_loads = self._static_loads(state)
        outputs = (
            self._responses.modal_outputs @ state.displacement
            + self._responses.residual_outputs @ static_loads
        )
        rows = self.structure.acceleration_rows
        if not len(rows):
            return np.asarray(outputs)
        # equation of motion of the kept modes: q'' = f - 2 zeta omega q' - omega^2 q
        omega = self._responses.omega
        acceleration = (
            self._responses.participation @ static_loads
            - 2.0 * self.damping_ratio * omega * state.velocity
            - omega**2 * state.displacement
        )
        return np.concatenate((outputs, rows @ (self.structure.mode_shapes @ acceleration)))

    def point_displacement(self, state: TransientState, load_number: int) -> float:
        """Return the displacement of a load's point along the load [m]."""
        return float(self.structure.unit_loads[:, load_number] @ self.displacement(state))

    # ------------------------------------------------------------ change of health

    def take_over(
        self, state: TransientState, previous_integrator: "ModalIntegrator"
    ) -> TransientState:
        """Project a state of another integrator on the modes of this one, after a change of health.

        Displacement and velocity of the structure stay the same: they are projected on the new
        modes with the new mass matrix, exactly in reduced coordinates. What the new modes cannot
        represent follows the load without delay, as always. The memory of laws is kept if their
        kinds and ports are the same; otherwise the laws start unloaded.

        Parameters
        ----------
        previous_integrator : ModalIntegrator
            The other integrator, of the same model.
        """
        load = state.load
        memory = state.memory
        laws = self._laws
        previous_laws = previous_integrator._laws
        if laws is not None and (previous_laws is None or not laws.has_same_laws(previous_laws)):
            memory = laws.unloaded_memory()
            if not state.moves:  # the equilibrium is reached from no load
                load = np.zeros_like(load)
        if not state.moves:
            return replace(state, load=load, memory=memory)
        if self.structure.holding_load is not None:
            load = load.copy()
            load[self.structure.holding_load] = 0.0
        residual = previous_integrator._responses.residual_displacements[:, : len(load)] @ load
        displacement = previous_integrator.structure.mode_shapes @ state.displacement + residual
        velocity = previous_integrator.structure.mode_shapes @ state.velocity
        projection = self.structure.modal_projection
        return TransientState(projection @ displacement, projection @ velocity, load, memory)
