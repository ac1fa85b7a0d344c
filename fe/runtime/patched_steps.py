"""The patched wing step by step: equilibrium along a load path, and motion under loads that are held.

Statics is that of the reduced model plus what the patch changes in `fe.runtime.patched_wing`, so that a patch
without magnitude changes nothing. Motion is that of the first modes of the patched wing, integrated by
`fe.runtime.motion`; omitted modes follow loads without delay, and internal forces with that of their damping.

NumPy and relative imports only: this file is copied into the FMU.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from .modal_system import ModalSystem
from .motion import Laws, laws_of, simulate, static_solution
from .patch import LOADS, LoadGain, ModelPatch, PointMass
from .patched_structure import Modes, PatchedStructure
from .patched_wing import LOAD_PLACE, ON_MODES, PatchedWing
from .reduced import ReducedModel
from .transient import ModalIntegrator, TransientState

FloatArray = npt.NDArray[np.float64]

MODE_COUNT = 6
"""Modes that move; those whose frequencies the FMU shows."""
_LOADS = 2  # load factor and tip force, as they are recorded


class _Moving(NamedTuple):
    """State of a motion: modes, forces of the laws as omitted modes follow them, loads, memory of the laws.

    `holding` (1,) is what omitted modes still feel of a force that held the wing.
    """

    q: FloatArray
    v: FloatArray
    forces: FloatArray
    loads: FloatArray
    holding: FloatArray
    memory: FloatArray


class PatchedSteps:
    """The wing at one state of health and mass and under one patch, step by step.

    It never changes; what changes is the state, plain floats that its methods take and give.

    Parameters
    ----------
    model : ReducedModel
        The wing without a patch.
    wing : PatchedWing
        The same wing in the basis for patches.
    vector : (V,) ndarray
        Values of all that can be chosen of the model; those of the controls do not matter.
    damping : tuple of float
        Rayleigh's alpha [1/s] and beta [s].
    patch : ModelPatch
        Primitives of sensors are passed over.
    temperature : float
        Less the reference temperature [K].

    Raises
    ------
    InvalidPatchError
        If the wing cannot carry the patch.
    OutsideModelError
        If a parameter lies outside the model's validity box.
    """

    def __init__(
        self,
        model: ReducedModel,
        wing: PatchedWing,
        vector: FloatArray,
        *,
        damping: tuple[float, float],
        patch: ModelPatch,
        temperature: float = 0.0,
    ) -> None:
        self._model, self._wing, self._vector = model, wing, vector
        e, *losses, servo_mass, pitot_mass = vector[:-2].tolist()
        self._state = (e, tuple(losses), servo_mass, pitot_mass)
        self._rayleigh = damping
        self._loads = patch.of(*LOADS)
        self._laws: Laws = laws_of(wing.internal_forces(patch), wing.port_rows)
        self._patched = wing.structure(*self._state, patch, temperature)
        arrays = wing.arrays
        factors = wing.strain_factors(patch)
        self._strain_rows = (
            arrays.strain_rows if factors is None else factors[:, np.newaxis] * arrays.strain_rows
        )
        self._plain_rows = np.vstack((arrays.strain_rows[0], arrays.tip_row, arrays.load_tip))
        self._rows = self._plain_rows
        if factors is not None:
            self._rows = np.vstack((self._strain_rows[0], arrays.tip_row, arrays.load_tip))
        self._units = np.vstack(
            (wing.load_parts(patch.of(*LOADS, PointMass)), wing.force_row(LOAD_PLACE, self._loads))
        )
        self._held_ports = wing.held_ports(self._laws.ports)
        self._held_rows = np.vstack((arrays.load_tip, *self._held_ports.values()))
        self._port_rows = self._laws.rows(wing.port_rows, wing.size)

    def _acting(self, load_factor: float, tip_force: float) -> FloatArray:
        """Factors (3,) of the patched unit loads: load factor, its square, force at the load point."""
        force = tip_force
        for item in self._loads:
            if isinstance(item, LoadGain):
                force = (1.0 + item.gain) * force + (item.tare if tip_force != 0.0 else 0.0)
        return np.array((load_factor, load_factor**2, force))

    @cached_property
    def _plain(self) -> PatchedStructure:
        return self._wing.structure(*self._state)

    @cached_property
    def _answers(self) -> FloatArray:
        """Displacements (n, 3 + J) under the patched unit loads and under unit forces at the laws' ports."""
        return self._patched.static(np.vstack((self._units, self._port_rows)).T)

    @cached_property
    def _plain_answers(self) -> FloatArray:
        """Displacements (n, 2) of the wing without patch under load factor 1 and a tip force of 1 N."""
        arrays = self._wing.arrays
        return self._plain.static(np.stack((arrays.load_lift, arrays.load_tip), axis=1))

    def _plain_outputs(self, load_factor: float, tip_force: float) -> FloatArray:
        """Strains, tip displacement and load point displacement (G + 2,) of the reduced model."""
        vector = self._vector.copy()
        vector[-2:] = load_factor, tip_force
        static = self._model.static_response(vector)
        point = self._model.static_load[1] @ static.coordinates
        return np.concatenate((static.strain, static.displacement, (point,)))

    # ------------------------------------------------------------ at rest

    def settled(self, state: Sequence[float], load_factor: float, tip_force: float) -> list[float]:
        """Return the state of equilibrium under loads that are reached from those of `state`.

        Parameters
        ----------
        state : sequence of float
            The state before; empty: the wing comes from rest without load.
        load_factor, tip_force : float
            Loads [1], [N].

        Raises
        ------
        SolutionError
            If there is no equilibrium on the way.
        """
        laws, after = self._laws, self._acting(load_factor, tip_force)
        forces, memory = np.zeros(len(laws)), laws.memory()
        if len(laws):
            known, start = None, None
            # load factor, tip force, acting loads, forces, memory
            if len(state) == self._settled_size:
                before = np.array(state[_LOADS : _LOADS + 3])
                start = self._port_rows @ self._answers[:, :3] @ before
                known = np.array(state[_LOADS + 3 + len(laws) :]).reshape(memory.shape)
            solution = static_solution(
                laws,
                (self._port_rows @ self._answers[:, :3] @ after)[np.newaxis],
                self._port_rows @ self._answers[:, 3:],
                memory=known,
                start=start,
            )
            forces, memory = solution.forces[0], solution.memory
        return [load_factor, tip_force, *after.tolist(), *forces.tolist(), *memory.ravel().tolist()]

    @property
    def _settled_size(self) -> int:
        return _LOADS + 3 + len(self._laws) + self._laws.memory().size

    # ------------------------------------------------------------ in motion

    @cached_property
    def _modes(self) -> Modes:
        return self._patched.modes(MODE_COUNT, self._held_rows)

    @cached_property
    def _plain_modes(self) -> Modes:
        return self._plain.modes(MODE_COUNT, self._held_rows)

    @cached_property
    def _system(self) -> ModalSystem:
        alpha, beta = self._rayleigh
        omega = self._modes.frequency
        ports = self._held_ports
        rows = np.stack(list(ports.values()))
        modal = rows @ self._modes.shapes
        whole = np.einsum("pn,np->p", rows, self._patched.static(rows.T))
        left_out = whole - np.sum((modal / omega) ** 2, axis=1)
        return ModalSystem(
            omega,
            np.diag(alpha + beta * omega**2),
            dict(zip(ports, modal, strict=True)),
            np.where((left_out > 1e-9 * whole) & [name not in ON_MODES for name in ports], left_out, 0.0),
            beta,
        )

    @cached_property
    def _held_left_out(self) -> FloatArray:
        """Part (n,) of the answer to a unit force at the release point that the modes leave out."""
        holding, modes = self._wing.arrays.load_tip, self._modes
        shape = modes.shapes @ (holding @ modes.shapes / modes.frequency**2)
        return np.asarray(self._patched.static(holding) - shape)

    def _feed(self, constant: FloatArray) -> FloatArray:
        """Return what the modes leave out of the positions (2, J) of the laws' ports under loads (3,)."""
        fed = self._port_rows @ (self._left_out[:, :3] @ constant)
        return np.stack((np.zeros(len(self._laws)), fed))

    @cached_property
    def _participation(self) -> FloatArray:
        """Modal forces (M, 3) of the patched unit loads."""
        return np.asarray((self._units @ self._modes.shapes).T)

    @cached_property
    def _ports_of_modes(self) -> FloatArray:
        """Motion (J, M) of the laws' ports by unit modal coordinates."""
        return self._laws.rows(self._system.ports, len(self._modes.frequency))

    @cached_property
    def _left_out(self) -> FloatArray:
        """Part (n, 3 + J) of the answers to unit loads and unit port forces that the modes leave out."""
        forces = np.concatenate((self._participation, self._ports_of_modes.T), axis=1)
        return np.asarray(
            self._answers - self._modes.shapes @ (forces / self._modes.frequency[:, np.newaxis] ** 2)
        )

    def released(self, tip_displacement: float, load_factor: float, tip_force: float) -> list[float]:
        """Return the state just after a wing that was held aside at its load point is let go.

        Parameters
        ----------
        tip_displacement : float
            How far the holding force moved the tip from its equilibrium under the loads, but for what
            internal forces add: the load point is held where it would be without them [m].
        load_factor, tip_force : float
            The loads that stay [1], [N].

        Raises
        ------
        SolutionError
            If there is no equilibrium on the way.
        """
        modes, laws = self._modes, self._laws
        omega2 = modes.frequency**2
        loads = self._acting(load_factor, tip_force)
        holding = self._wing.arrays.load_tip  # the release point: the holding force acts there
        flexible = self._patched.static(holding)
        compliance = float(holding @ flexible)
        goal = tip_displacement * compliance / float(self._wing.arrays.tip_row @ flexible)
        memory, forces = laws.memory(), np.zeros(len(laws))
        whole = self._port_rows @ self._answers[:, 3:]
        resting = self._port_rows @ (self._answers[:, :3] @ loads)
        if len(laws) and np.any(loads):
            settled = static_solution(laws, resting[np.newaxis], whole)
            forces, memory = settled.forces[0], settled.memory
        force = goal / compliance
        if goal != 0.0 and len(laws):
            along = self._port_rows @ flexible
            # with the point held where it is moved to: x = x_linear - (C - a a^T / a_0) F
            before = along / compliance * (along @ forces)
            moved = static_solution(
                laws,
                (resting + force * along - before)[np.newaxis],
                whole - np.outer(along, along) / compliance,
                memory=memory if np.any(loads) else None,
                start=resting - before if np.any(loads) else None,
            )
            force += float(along @ (moved.forces[0] - forces)) / compliance
            forces, memory = moved.forces[0], moved.memory
            # of the ports' positions; fades after the release
            memory[:, 3] = force * (self._port_rows @ self._held_left_out)
        acts = self._participation @ loads + force * (holding @ modes.shapes) - forces @ self._ports_of_modes
        q = acts / omega2
        # without damping omitted modes let go at once
        _, beta = self._rayleigh
        last = np.array((load_factor, tip_force)), np.array((force if beta > 0.0 else 0.0,))
        state = _Moving(q, np.zeros_like(q), forces, *last, memory)
        return self._packed(self._felt(state))

    def _felt(self, state: _Moving) -> _Moving:
        """Return a state with the forces of the laws at this moment."""
        if not len(self._laws):
            return state
        acting = self._acting(*state.loads.tolist())
        seen = simulate(
            self._system, self._laws, q=state.q, v=state.v, force=np.zeros(1), interval=1.0,
            constant=self._participation @ acting, feed=self._feed(acting), memory=state.memory,
        )  # fmt: skip
        return state._replace(forces=seen.lagged[0])

    def advance(
        self, state: Sequence[float], duration: float, load_factor: float, tip_force: float, time: float
    ) -> list[float]:
        """Return the state after a step with the loads held.

        Parameters
        ----------
        state : sequence of float
            The state before.
        duration : float
            Of the step [s].
        load_factor, tip_force : float
            Loads [1], [N]; if they differ from those of the state, they jump at once.
        time : float
            Of the begin of the step since the start, for a stiffness that drifts [s].
        """
        before = self._unpacked(state)
        acting = self._acting(load_factor, tip_force)
        moved = simulate(
            self._system,
            self._laws,
            q=before.q,
            v=before.v,
            force=np.zeros(2),
            interval=duration,
            constant=self._participation @ acting,
            feed=self._feed(acting),
            memory=before.memory,
            start=time,
        )
        loads = np.array((load_factor, tip_force))
        _, beta = self._rayleigh
        holding = before.holding * (np.exp(-duration / beta) if beta > 0.0 else 0.0)
        after = _Moving(moved.q[-1], moved.v[-1], moved.lagged[-1], loads, holding, moved.memory)
        return self._packed(after)

    # ------------------------------------------------------------ what is seen

    def read(self, state: Sequence[float], *, moving: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return strains, tip displacement and load point displacement, and strains across and in shear.

        Parameters
        ----------
        state : sequence of float
            Of a motion, or of an equilibrium.
        moving : bool
            Which of them.

        Returns
        -------
        values, transverse, shear : (G + 2,) ndarray
            Dimensionless and [m]; the last two are zero for displacements.
        """
        if moving:
            now = self._unpacked(state)
            load_factor, tip_force = now.loads.tolist()
            acting = self._acting(load_factor, tip_force)
            still = np.concatenate((acting, -now.forces))
            displacement = self._modes.shapes @ now.q + self._left_out @ still
            if now.holding[0] != 0.0:
                displacement = displacement + now.holding[0] * self._held_left_out
        else:
            load_factor, tip_force = state[:_LOADS]
            acting = np.array(state[_LOADS : _LOADS + 3])
            forces = np.array(state[_LOADS + 3 : _LOADS + 3 + len(self._laws)])
            displacement = self._answers @ np.concatenate((acting, -forces))
        # the reduced model, and what the patch changes of the wing for patches
        plain = self._plain_answers @ np.array((load_factor, tip_force))
        if self._rows is self._plain_rows:
            change = self._rows @ (displacement - plain)
        else:
            change = self._rows @ displacement - self._plain_rows @ plain
        values = self._plain_outputs(load_factor, tip_force) + change
        _, *components = self._strain_rows
        across, shear = (np.append(rows @ displacement, (0.0, 0.0)) for rows in components)
        return values, across, shear

    def modal_data(self) -> tuple[FloatArray, FloatArray]:
        """Return natural frequencies [Hz] and damping ratios [1] of the modes, without internal forces."""
        alpha, beta = self._rayleigh
        omega = self._modes.frequency
        return omega / (2.0 * np.pi), 0.5 * (alpha / omega + beta * omega)

    # ------------------------------------------------------------ another structure

    def take_over(self, state: Sequence[float], before: "PatchedSteps", *, moving: bool) -> list[float]:
        """Return a state of another structure in the modes of this one: the wing stays where it is.

        The memory of the internal forces stays where these are the same laws at the same ports; others have
        been loaded from zero to where they are.
        """
        same = (
            self._laws.ports == before._laws.ports
            and np.array_equal(self._laws.numbers, before._laws.numbers)
            and self._laws.elements.shape == before._laws.elements.shape
        )
        if not moving:
            return list(state) if same else []
        old = before._unpacked(state)
        memory = old.memory if same else self._laws.memory()
        return self._carried(before._place(old), before._modes.shapes @ old.v, old.loads, memory)

    def take_over_unpatched(self, state: TransientState, before: ModalIntegrator) -> list[float]:
        """Return the state of a wing without patch in the modes of this one.

        Modes are matched by rank; those of the other wing that have no counterpart here are lost.
        """
        modes = self._plain_modes
        count = len(modes.frequency)
        deviation = (state.displacement - before.at_rest(state.load).displacement)[:count]
        place = modes.shapes @ deviation + self._plain_answers @ state.load
        velocity = modes.shapes @ state.velocity[:count]
        return self._carried(place, velocity, state.load, self._laws.memory())

    def give_back(self, state: Sequence[float], after: ModalIntegrator) -> TransientState:
        """Return a state in the modes of the wing without patch, as `take_over_unpatched` takes it."""
        now, modes = self._unpacked(state), self._plain_modes
        rest = after.at_rest(now.loads)
        displacement, velocity = rest.displacement.copy(), rest.velocity.copy()
        count = min(len(displacement), len(modes.frequency))
        aside = self._place(now) - self._plain_answers @ now.loads
        displacement[:count] += (modes.to_modes @ aside)[:count]
        velocity[:count] = (modes.to_modes @ (self._modes.shapes @ now.v))[:count]
        return TransientState(displacement, velocity, now.loads.copy())

    def _place(self, state: _Moving) -> FloatArray:
        """Displacement (n,) of a motion, without what port forces add beside the modes."""
        acting = self._acting(*state.loads.tolist())
        return np.asarray(self._modes.shapes @ state.q + self._left_out[:, :3] @ acting)

    def _carried(
        self, place: FloatArray, velocity: FloatArray, loads: FloatArray, memory: FloatArray
    ) -> list[float]:
        """Return the state with displacement and velocity (n,) of the whole wing."""
        to_modes = self._modes.to_modes
        none, held = np.zeros(len(self._laws)), np.zeros(1)
        state = _Moving(to_modes @ place, to_modes @ velocity, none, loads, held, memory)
        return self._packed(self._felt(state))

    def _packed(self, state: _Moving) -> list[float]:
        return [float(value) for part in state for value in part.ravel()]

    def _unpacked(self, state: Sequence[float]) -> _Moving:
        values, memory = np.array(state, dtype=np.float64), self._laws.memory()
        sizes = (len(self._modes.frequency),) * 2 + (len(self._laws), _LOADS, 1)
        q, v, forces, loads, holding, rest = np.split(values, np.cumsum(sizes))
        return _Moving(q, v, forces, loads, holding, rest.reshape(memory.shape))
