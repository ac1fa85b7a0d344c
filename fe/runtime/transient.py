"""A structure in time: at rest, or its first modes moving, with or without forces of laws at its ports.

Kapteyn et al. 2021, eq. (12), in modal coordinates: q'' + 2 zeta omega q' + omega^2 q = shape^T f, one
equation for each mode, because Rayleigh damping (17) leaves the modes uncoupled; exact for loads that are
held. Modes that are not kept follow the load without delay (static correction). Laws at ports couple the
modes: `fe.runtime.motion` steps them, and omitted modes follow their forces with the lag of the damping.

NumPy and relative imports only: this file is copied into the FMU. Laws are imported where there are any.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import exp, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .arrays import FADING, HEAD, LAGGED, FloatArray
from .errors import InvalidStateError
from .modal_system import ModalSystem, rayleigh_damping_ratio

if TYPE_CHECKING:
    from .motion_arrays import ModalMotion
    from .patched_wing import PatchedWing
    from .reduced import ReducedModel


INSTANT = 1e-6
"""Duration of a step of which only the begin is looked at [s]."""


@dataclass(frozen=True, slots=True)
class TransientState:
    """All that a structure remembers between two steps.

    Attributes
    ----------
    displacement : (M,) ndarray
        Modal coordinates q [m kg^1/2]; none of a structure at rest, which has no motion to remember.
    velocity : (M,) ndarray
        Their rates [m kg^1/2 / s].
    load : (L,) ndarray
        Coefficients of the loads at this moment; of a wing the load factor [1] and the tip force [N].
    memory : (J, 5 + E) ndarray
        What the laws remember; in a column the forces as omitted modes follow them.
    """

    displacement: FloatArray
    velocity: FloatArray
    load: FloatArray
    memory: FloatArray = field(default_factory=lambda: np.zeros((0, HEAD)))


class ModalIntegrator:
    """Response of a structure in time, at one state of health, parameters and masses.

    The integrator itself never changes; what changes is the `TransientState` that its methods take and give.
    When health changes, make another integrator and let it take over the state (`take_over`).

    Parameters
    ----------
    model : ReducedModel or PatchedWing
        The structure.
    vector : (V,) ndarray
        Values of all that can be chosen; those of the controls do not matter.
    damping_alpha, damping_beta : float
        Rayleigh damping [1/s], [s].
    *changes
        Further arguments of the model's `at`: of a wing for patches its patch and temperature.

    Attributes
    ----------
    structure : ReducedState or PatchedState
        The structure in this state, in n coordinates of its own: its `laws`, J forces at its ports, or None;
        `loads` (n, L + J), unit loads, then those at the ports of the laws, also what their points move by,
        and `answers` (n, L + J), displacements at rest under them; M `modes`, their `shapes` (n, M),
        mass-normalised, and `to_modes` (M, n), modal coordinates of a displacement; rows of `outputs` (O, n),
        the last of them where a release is measured, and `accelerations` (A, n); rows `components` (2, G, n)
        of the strains across the gauges and in shear, none where no sensor asks for them; `holding`, the
        number of the load that acts before a release alone, and whose end omitted modes follow as they do
        forces of laws, None where they follow at once; `on_modes`, ports whose position is that of the modes
        alone; `acting`, the coefficients (L,) of the loads at values (V,) of all that can be chosen.
    modes : object
        Its modes.
    damping_ratio : (M,) ndarray
        Damping ratios of its modes, eq. (18).

    Raises
    ------
    OutsideModelError
        If a value lies outside the model's validity box.
    InvalidPatchError
        If the structure cannot carry the patch.
    InvalidStateError
        If a Rayleigh coefficient is negative or not finite.
    """

    def __init__(
        self, model: "ReducedModel | PatchedWing", vector: FloatArray, damping_alpha: float,
        damping_beta: float, *changes: Any,
    ) -> None:  # fmt: skip
        for name, value in (("damping_alpha", damping_alpha), ("damping_beta", damping_beta)):
            if not (isfinite(value) and value >= 0.0):
                raise InvalidStateError(f"{name} must be zero or a positive finite number, but is {value!r}.")
        self.structure = model.at(vector, *changes)
        self._rayleigh = damping_alpha, damping_beta
        self.modes, self._laws = self.structure.modes, self.structure.laws
        self._count = 0 if self._laws is None else len(self._laws)
        self._loads = self.structure.loads.shape[1] - self._count

    @cached_property
    def damping_ratio(self) -> FloatArray:
        """Damping ratios (M,) of the modes."""
        return rayleigh_damping_ratio(*self._rayleigh, self.modes.frequency)

    @cached_property
    def _omega(self) -> FloatArray:
        return np.asarray(2.0 * np.pi * self.modes.frequency)

    @cached_property
    def _participation(self) -> FloatArray:
        """Modal forces (M, L + J) of the unit loads."""
        return np.asarray(self.structure.shapes.T @ self.structure.loads)

    @cached_property
    def _modal_static(self) -> FloatArray:
        return np.asarray(self._participation / self._omega[:, np.newaxis] ** 2)

    @cached_property
    def _left_out(self) -> FloatArray:
        """What the modes that are not kept add to the displacements (n, L + J) under the unit loads."""
        return np.asarray(self.structure.answers - self.structure.shapes @ self._modal_static)

    @cached_property
    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """Outputs (O, M) by modal coordinates, and (O, L + J) by what is beyond the modes."""
        return self.structure.outputs @ self.structure.shapes, self.structure.outputs @ self._left_out

    @cached_property
    def _port_answers(self) -> FloatArray:
        """Motion (J, L + J) of the ports of the laws at rest under the unit loads."""
        return np.asarray(self.structure.loads[:, self._loads :].T @ self.structure.answers)

    @cached_property
    def _system(self) -> ModalSystem:
        """The modes with the ports of the laws."""
        alpha, beta = self._rayleigh
        damping = np.diag(alpha + beta * self._omega**2)
        if self._laws is None:
            return ModalSystem(self._omega, damping)
        rows, names = self._participation[:, self._loads :].T, self._laws.ports
        whole = np.diag(self._port_answers[:, self._loads :])
        left_out = whole - np.sum((rows / self._omega) ** 2, axis=1)
        flexible = np.array([name not in self.structure.on_modes for name in names], dtype=bool)
        left_out = np.where((left_out > 1e-9 * whole) & flexible, left_out, 0.0)  # less is rounding
        ports, beyond = (dict(zip(names, item, strict=True)) for item in (rows, left_out.tolist()))
        return ModalSystem(self._omega, damping, ports, np.array(list(beyond.values())), beta)

    def _moved(
        self, state: TransientState, acting: FloatArray, duration: float, time: float
    ) -> "ModalMotion":
        """Return the motion under laws and loads (L,) that are held, at the begin and the end."""
        from .motion import Begin, advance, steps_under, substeps

        assert self._laws is not None
        boundaries = substeps(self._system, self._laws, np.array([0.0, duration]))
        held = np.tile(self._participation[:, : self._loads] @ acting, (len(boundaries.lengths), 1))
        beyond = self.structure.loads[:, self._loads :].T @ (self._left_out[:, : self._loads] @ acting)
        feed = np.tile(beyond, (len(boundaries.time), 1))
        steps = steps_under(self._system, boundaries, held, held, feed)
        begin = Begin(state.displacement, state.velocity, state.memory)
        return advance(self._system, self._laws, steps._replace(time=time + steps.time), begin)

    def settled(self, load: npt.ArrayLike, before: TransientState | None = None) -> TransientState:
        """Return the equilibrium, without motion, under loads (L,) that are reached from those `before`.

        Raises
        ------
        SolutionError
            If laws have no equilibrium on the way.
        """
        acting, none = np.array(load, dtype=np.float64), np.zeros(0)
        if not self._count:
            return TransientState(none, none, acting)
        assert self._laws is not None
        linear, compliance = np.split(self._port_answers, [self._loads], axis=1)
        before = before or TransientState(none, none, np.zeros(self._loads), self._laws.memory())
        _, memory = self._loaded(linear @ acting, compliance, before.memory, linear @ before.load)
        return TransientState(none, none, acting, memory)

    def _loaded(
        self, linear: FloatArray, compliance: FloatArray, memory: FloatArray, start: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return forces (J,) and memory of the laws at linear positions (J,), see `static_solution`."""
        from .motion import static_solution

        assert self._laws is not None
        found = static_solution(self._laws, linear[np.newaxis], compliance, memory=memory, start=start)
        return found.forces[0], found.memory

    def at_rest(self, load: npt.ArrayLike) -> TransientState:
        """Return the state of equilibrium under loads (L,); raises `SolutionError` as `settled`."""
        return self._moving(self.settled(load))

    def _moving(self, rest: TransientState, held: FloatArray | float = 0.0) -> TransientState:
        """Return a state at rest in its modes, which a force moves by `held`."""
        place = self._modal_static @ self._still(rest) + held
        return replace(rest, displacement=place, velocity=np.zeros_like(place))

    @staticmethod
    def _still(state: TransientState) -> FloatArray:
        return np.concatenate((state.load, -state.memory[:, LAGGED]))

    def released(self, aside: float, load: npt.ArrayLike, point: int) -> TransientState:
        """Return the state just after a structure that was held aside is let go.

        Parameters
        ----------
        aside : float
            How far the holding force had moved the last static output, of a wing its tip, from its
            equilibrium under the other loads, but for what laws add: the held point is where it would be
            without them [m].
        load : (L,) array_like
            The loads that stay.
        point : int
            Number of the load that held it.

        Raises
        ------
        SolutionError
            If laws have no equilibrium on the way.
        """
        rest, answers = self.settled(load), self.structure.answers[:, point]
        held = aside / float(self.structure.outputs[-1] @ answers) if aside else 0.0
        if held and self._count:
            # with the point held where it is moved to: x = x_linear - (C - a a^T / a_0) F
            along, resting = self._port_answers[:, point], self._port_answers[:, : self._loads] @ rest.load
            compliance, forces = self.structure.loads[:, point] @ answers, rest.memory[:, LAGGED]
            start = resting - along / compliance * (along @ forces)
            moved, memory = self._loaded(
                start + held * along,
                self._port_answers[:, self._loads :] - np.outer(along, along) / compliance,
                rest.memory,
                start,
            )
            held += float(along @ (moved - forces) / compliance)
            # of the ports' positions; fades after the release
            memory[:, FADING] = held * (self.structure.loads[:, self._loads :].T @ self._left_out[:, point])
            rest = replace(rest, memory=memory)
        state = self._moving(rest, self._modal_static[:, point] * held)
        if self.structure.holding is not None and self._rayleigh[1] > 0.0:
            state = replace(state, load=state.load + held * np.eye(self._loads)[self.structure.holding])
        if self._count:
            memory = rest.memory.copy()
            memory[:, LAGGED] = self._moved(state, rest.load, INSTANT, 0.0).lagged[0]
            state = replace(state, memory=memory)
        return state

    def advance(
        self, state: TransientState, duration: float, load: npt.ArrayLike, time: float = 0.0
    ) -> TransientState:
        """Return the state after loads that are held; exact for the kept modes where there are no laws.

        If the loads differ from those of `state`, they jump at once, and the structure overshoots.

        Parameters
        ----------
        state : TransientState
            The state before.
        duration : float
            Time [s], positive.
        load : (L,) array_like
            Coefficients of the loads.
        time : float
            Of the begin of the step since the start, for a stiffness that drifts [s].

        Raises
        ------
        InvalidStateError
            If the duration is not positive or a load is not finite.
        """
        acting = np.array(load, dtype=np.float64)
        if not (isfinite(duration) and duration > 0.0 and np.isfinite(acting).all()):
            raise InvalidStateError(
                f"A transient step needs a positive duration and a finite load, but got {duration!r} s and "
                f"{load!r}."
            )
        if self._laws is None or self._laws.linear:
            (transition,), *_ = self._system.exact_steps(np.array([duration]))
            static = self._modal_static[:, : self._loads] @ acting
            free = transition @ np.concatenate((state.displacement - static, state.velocity))
            # plus zero: a structure at rest has the velocity 0, not -0
            place, velocity = free[: len(static)] + static, free[len(static) :] + 0.0
            memory = state.memory
        else:
            moved = self._moved(state, acting, duration, time)
            place, velocity, memory = moved.q[-1], moved.v[-1], moved.memory
        holding, (_, beta) = self.structure.holding, self._rayleigh
        if holding is not None and state.load[holding] != 0.0:
            acting[holding] = state.load[holding] * exp(-duration / beta)
        return TransientState(place, velocity, acting, memory)

    def displacement(self, state: TransientState) -> FloatArray:
        """Return the displacement (n,) at a state, in the coordinates of the structure.

        The modes that are not kept follow the loads at once.
        """
        still = self._still(state)
        if not len(state.displacement):
            return np.asarray(self.structure.answers @ still)
        return np.asarray(self.structure.shapes @ state.displacement + self._left_out @ still)

    def outputs(self, state: TransientState) -> FloatArray:
        """Return gauges, displacements and accelerations (O + A,) at a state.

        An acceleration is that of the kept modes, since the others follow loads that are held without
        inertia; `settled` states have none.
        """
        if not len(state.displacement):
            return np.asarray(self.structure.outputs @ self.displacement(state))
        by_modes, beyond = self._seen
        seen, rows = by_modes @ state.displacement + beyond @ self._still(state), self.structure.accelerations
        if not len(rows):
            return np.asarray(seen)
        omega = self._omega
        acceleration = (
            self._participation @ self._still(state)
            - 2.0 * self.damping_ratio * omega * state.velocity
            - omega**2 * state.displacement
        )
        return np.concatenate((seen, rows @ (self.structure.shapes @ acceleration)))

    def point_displacement(self, state: TransientState, point: int) -> float:
        """Return the displacement along the load of a number at its point [m]."""
        return float(self.structure.loads[:, point] @ self.displacement(state))

    def take_over(self, state: TransientState, before: "ModalIntegrator") -> TransientState:
        """Return a state of another integrator in the modes of this one, after a change of health or mass.

        Displacement and velocity of the structure stay what they were; they are projected on the new modes
        with the new mass matrix (exactly, in reduced coordinates). The part that the new modes cannot hold
        follows the load without delay, as always. The memory of laws stays where these are the same at the
        same ports; others have been loaded from zero to where they are.

        `state` is in the modes of `before`, the integrator of the same model that it belongs to.
        """
        load, memory = state.load, state.memory
        if self._laws is not None and not (before._laws is not None and self._laws.alike(before._laws)):
            memory = self._laws.memory()
            if not len(state.displacement):  # at rest: reached from no load
                load = np.zeros_like(load)
        if not len(state.displacement):
            return replace(state, load=load, memory=memory)
        if self.structure.holding is not None:
            load = load.copy()
            load[self.structure.holding] = 0.0
        place = before.structure.shapes @ state.displacement + before._left_out[:, : len(load)] @ load
        to_modes = self.structure.to_modes
        velocity = to_modes @ (before.structure.shapes @ state.velocity)
        return TransientState(to_modes @ place, velocity, load, memory)
