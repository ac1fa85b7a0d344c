"""A linear system with ports: M z'' + C z' + K z = loads, its modes and its rest; `motion` moves it.

Displacements u and states x, M u'' + C u' + K u = F x + b(t), T x' + R x = G u' + H u + d(t): a state is the
speed of a coordinate that has no stiffness, x = s', so that both are one equation in z = (u, s).
A motion that is prescribed takes its direction out of u; what is left moves in its modes. For the laws at
ports the prescribed motion is a coordinate of its own, so heavy that they do not move it (`HEAVY`), and it is
put right at every step. The wing, a structure on springs and a lumped rig are such systems.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.linalg import eigh, null_space

from discrepancy.campaign.records import FloatArray
from discrepancy.errors import ModelError, said
from discrepancy.system.excitation import Acting, Shown, by_order
from discrepancy.system.response import PortedSystem
from fe.compilation import compiled_kernel
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import NO_LAWS, Laws, static_solution
from fe.runtime.patched_wing import PatchedState
from fe.runtime.reduced import ReducedState

HEAVY = 1e12
"""Mass of a prescribed coordinate over the largest of the system."""
LEAST_PIVOT = 1e-9
"""A system whose equilibrium is determined worse than this has none of its own."""
ROUNDING = 1e-10
"""Share of the largest entry below which what couples modes is rounding."""


Modes = tuple[FloatArray, FloatArray, int]
"""Angular frequencies (M,), shapes (N, M) of what is free, and how many are of displacements."""


def _differs(matrix: FloatArray, other: FloatArray) -> bool:
    """Whether two matrices differ by more than rounding."""
    size = np.abs(matrix).max(initial=1e-300)
    return bool(np.abs(matrix - other).max(initial=0.0) > ROUNDING * size)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A linear system of N unknowns, n of them displacements.

    Attributes
    ----------
    mass, damping, stiffness : (N, N) ndarray
        Of (u, s): diag(M, T), [[C, -F], [-G, R]], [[K, 0], [-H, 0]].
    ports : mapping of str to (N,) ndarray
        Rows of the ports where internal forces act: a displacement [m] or rotation [rad] is row . u, or a
        state row . x.
    mode_count : int or None
        Modes that move of a structure that springs hold, with mass and stiffness positive definite; the
        others follow without inertia. None: all, and nothing need hold it.
    relaxation : float
        Factor of the part of the damping that goes with the stiffness, for the modes without inertia [s].
    on_modes : frozenset of str
        Ports whose position is that of the modes that move alone.
    states : int
        N - n.
    drives : (P, N) ndarray
        Rows whose motion is prescribed.
    actions : mapping of str to (N,) ndarray
        Rows along which laws at all ports act, where that is not how they see.
    solved : ReducedState or PatchedState, optional
        The structure that it is, which knows its modes and K^-1.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    ports: Mapping[str, FloatArray]
    mode_count: int | None = None
    relaxation: float = 0.0
    on_modes: frozenset[str] = frozenset()
    states: int = 0
    drives: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    actions: Mapping[str, FloatArray] = field(default_factory=dict)
    solved: ReducedState | PatchedState | None = None

    @property
    def displacements(self) -> int:
        """Displacements n."""
        return len(self.mass) - self.states

    # ------------------------------------------------------------ modes

    @cached_property
    def lift(self) -> FloatArray:
        """Displacements (N, P) by unit motions of the drives."""
        found = np.zeros((len(self.mass), len(self.drives)))
        if len(self.drives):
            found[: self.displacements] = np.linalg.pinv(self.drives[:, : self.displacements])
        return found

    @cached_property
    def modes(self) -> Modes:
        """Its modes."""
        if self.solved is not None:
            frequency = 2.0 * np.pi * self.solved.modes.frequency
            return frequency, np.ascontiguousarray(self.solved.shapes), len(frequency)
        n, most = self.displacements, self.mode_count
        mass, stiffness = self.mass[:n, :n], 0.5 * (self.stiffness[:n, :n] + self.stiffness[:n, :n].T)
        free = np.eye(n)
        if len(self.drives):
            free = null_space(self.drives[:, :n])
            mass, stiffness = free.T @ mass @ free, free.T @ stiffness @ free
        square, shapes = np.zeros(0), np.zeros((0, 0))
        if len(mass):
            chosen = [0, most - 1] if most and most < len(mass) else None
            try:
                square, shapes = eigh(stiffness, mass, subset_by_index=chosen)
            except np.linalg.LinAlgError as cause:
                raise ModelError(f"The mass matrix must be positive definite ({cause}).") from cause
        if most is None:
            square = np.where(np.abs(square) <= ROUNDING * np.max(np.abs(square), initial=0.0), 0.0, square)
        elif square[0] <= 0.0:
            raise ModelError(said("models.indefinite", least=square[0]))
        moving = len(square)
        found = np.zeros((len(self.mass), moving + self.states))
        found[:n, :moving] = free @ shapes
        if self.states:
            capacity, axes = np.linalg.eigh(self.mass[n:, n:])
            found[n:, moving:] = axes / np.sqrt(capacity)
        none = np.zeros(self.states)
        return np.concatenate((np.sqrt(np.maximum(square, 0.0)), none)), found, moving

    @property
    def angular_frequency(self) -> FloatArray:
        """Angular frequencies (M,) [rad/s] of what is free, rising; zero for rigid motions and states."""
        return self.modes[0]

    @property
    def shapes(self) -> FloatArray:
        """Mass-normalised shapes (N, M) of what is free."""
        return self.modes[1]

    @property
    def moving(self) -> int:
        """How many of the coordinates are displacements; the others are states."""
        return self.modes[2]

    @property
    def truncated(self) -> bool:
        """Whether modes are left out."""
        return self.mode_count is not None and self.mode_count < len(self.mass)

    @cached_property
    def heaviness(self) -> float:
        """Square root of the mass of the drives."""
        return float(np.sqrt(HEAVY * np.max(np.abs(self.mass))))

    @cached_property
    def all_shapes(self) -> FloatArray:
        """Shapes (N, M + P) of what is free and of the drives, mass-normalised."""
        return np.hstack((self.shapes, self.lift / self.heaviness)) if len(self.drives) else self.shapes

    @cached_property
    def modal(self) -> ModalSystem:
        """What is free and the drives, with ports; what couples modes by rounding only does not."""
        count, drives = len(self.angular_frequency), len(self.drives)
        frequency, shapes = np.pad(self.angular_frequency, (0, drives)), self.all_shapes
        damping, stiffness = (shapes.T @ matrix @ shapes for matrix in (self.damping, self.stiffness))
        damping[count:] = stiffness[count:] = 0.0  # nothing moves a drive
        diagonal = np.diag(np.diag(damping))
        damping = damping if drives or _differs(damping, diagonal) else diagonal
        loose = self.mode_count is None and (drives > 0 or _differs(stiffness, np.diag(frequency**2)))
        ports, actions = (
            {name: np.asarray(row @ self.all_shapes) for name, row in rows.items()}
            for rows in (self.ports, self.acts)
        )
        whole, left_out = stiffness if loose else None, None
        if self.truncated and ports:
            rows = np.array(list(self.ports.values()))
            left_out = np.einsum("pn,np->p", rows, self.residual(rows.T))
            all_of_it = np.einsum("pn,np->p", rows, self.flexibility(rows.T))
            flexible = [name not in self.on_modes for name in ports]
            left_out = np.where((left_out > 1e-9 * all_of_it) & flexible, left_out, 0.0)  # less is rounding
        return ModalSystem(frequency, damping, ports, left_out, self.relaxation, whole, actions)

    def forces(self, acting: Acting, time: FloatArray) -> FloatArray:
        """Return the modal forces (T, M + P) by what acts at times, that on a drive by its acceleration."""
        found = acting.load_at(time, self.all_shapes)
        if acting.drives:
            given, count = (
                [drive.at(time, 2) for drive in acting.drives.values()],
                len(self.angular_frequency),
            )
            found[:, :count] -= np.transpose(given) @ (self.lift.T @ self.mass @ self.shapes)
            found[:, count:] = self.heaviness * np.transpose(given)
        return found

    def port_rows(self, laws: Laws, time: float | None = None) -> FloatArray:
        """Return the rows (J, N) of the laws' ports, see `Laws.rows`."""
        return laws.rows(self.ports, len(self.mass), time)

    # ------------------------------------------------------------ rest

    @cached_property
    def _root(self) -> FloatArray:
        """L^-1 of the stiffness L L^T."""
        try:
            return np.linalg.inv(np.linalg.cholesky(self.stiffness))
        except np.linalg.LinAlgError as cause:
            raise ModelError(f"The structure has no stiffness left in some direction ({cause}).") from cause

    def flexibility(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, (N,) or (N, k), where springs hold all; raises `ModelError` if they do not."""
        if self.solved is not None:
            return self.solved.static(loads)
        return np.asarray(self._root.T @ (self._root @ loads))

    def residual(self, loads: FloatArray) -> FloatArray:
        """Return what the modes leave out of K^-1 loads, for loads (N,) or (N, k)."""
        return self.flexibility(loads) - (self.shapes / self.angular_frequency**2) @ (self.shapes.T @ loads)

    def resting(self, loads: FloatArray) -> FloatArray:
        """Return displacements and states (L, N) at rest under loads (L, N).

        Raises
        ------
        ModelError
            If nothing holds the system against a load.
        """
        if self.mode_count is not None:
            return self.flexibility(loads.T).T
        free, moving, force = len(self.angular_frequency), self.moving, loads @ self.shapes
        restoring = np.hstack((self.modal.whole[:free, :moving], self.modal.damping[:free, moving:free]))
        found = np.linalg.lstsq(restoring, force.T, rcond=LEAST_PIVOT)[0]
        left = np.max(np.abs(restoring @ found - force.T), initial=0.0)
        if left > 1e-6 * np.max(np.abs(force), initial=1e-300):
            raise ModelError(said("models.unheld", most=np.max(np.abs(restoring), initial=0.0)))
        return np.asarray(found.T @ self.shapes.T)

    def static(
        self, units: FloatArray, laws: Laws = NO_LAWS, amounts: FloatArray | None = None,
        memory: FloatArray | None = None, before: FloatArray | None = None,
        held: FloatArray | float = 0.0, fixed: FloatArray | None = None, seen: FloatArray | None = None,
        time: float | None = None,
    ) -> tuple[FloatArray, FloatArray | None]:  # fmt: skip
        """Return the rest (L, N) under load levels that follow one another from zero, and the laws' memory.

        Parameters
        ----------
        units : (k, N) ndarray
            Loads.
        laws : Laws
            Internal forces; ports of states are at no position. Without any there is no memory.
        amounts : (L, k) ndarray, optional
            How much of each acts at each level; by default they follow one another.
        memory, before : ndarray, optional
            Of the laws, and the amounts (k,) where the first level is reached from; by default never loaded.
        held : (N,) ndarray, optional
            Where something holds the system.
        fixed : (N,) ndarray, optional
            Row of a point that laws do not move.
        seen : (C, N) ndarray, optional
            What these rows show (L, C) is returned instead.
        time : float, optional
            Of laws in windows those act that do then [s].

        Raises
        ------
        ModelError, SolutionError
            If nothing holds the system, or a law takes more than it has.
        """
        rows, levels = self.port_rows(laws, time), np.eye(len(units)) if amounts is None else amounts
        rows[:, self.displacements :] = 0.0
        answers, flexible = self.resting(units) + held, self.resting(rows)
        if fixed is not None:
            own = self.resting(fixed[None])
            flexible = flexible - np.outer(flexible @ fixed, own) / float(own[0] @ fixed)
        at_ports, compliance = answers @ rows.T, rows @ flexible.T
        if seen is not None:
            answers, flexible = answers @ seen.T, flexible @ seen.T
        if not len(laws):
            return levels @ answers, None
        start = None if before is None else before @ at_ports
        solution = static_solution(
            laws, levels @ at_ports, compliance, memory=memory, start=start, kernel=compiled_kernel()
        )
        return levels @ answers - solution.forces @ flexible, solution.memory

    # ------------------------------------------------------------ what acts, and what is seen

    @property
    def acts(self) -> Mapping[str, FloatArray]:
        """Rows along which laws at all ports act."""
        return self.actions or self.ports

    def seen_by(self, shown: Sequence[Shown], shapes: FloatArray) -> PortedSystem:
        """Return the system by which outputs see missing forces, in shapes (N, M) of what is free.

        M q'' + D q' + K q = -sum_p acts_p g_p; of coordinates that are states only the speeds are kept.
        """
        ports, size = tuple(self.ports), len(self.mass)
        sees, acts = (
            np.array([rows[port] for port in ports]).reshape(len(ports), size)
            for rows in (self.ports, self.acts)
        )
        force = np.zeros((len(ports), len(shown)))
        for number, item in enumerate(shown):
            if item.felt is not None:
                force[:, number] = acts @ item.felt
            elif self.truncated:
                force[:, number] = -acts @ self.residual(item.rows[0])
        mass, *others = (shapes.T @ matrix @ shapes for matrix in (self.mass, self.damping, self.stiffness))
        sees, acts = sees @ shapes, acts @ shapes
        push, by_damping, by_stiffness = (np.linalg.solve(mass, item) for item in (acts.T, *others))
        position, speed, acceleration, _ = by_order(shown, shapes)
        count, moving, none = len(mass), self.moving, np.zeros((len(ports), len(mass)))
        generator = np.zeros((moving + count, moving + count))
        generator[:moving, moving : 2 * moving] = np.eye(moving)
        generator[moving:, :moving] = -by_stiffness[:, :moving]
        generator[moving:, moving:] = -by_damping
        outputs = (position - acceleration @ by_stiffness)[:, :moving], speed - acceleration @ by_damping
        return PortedSystem(
            generator, ports, np.hstack((none[:, :moving], push.T)), np.hstack((sees[:, :moving], none)),
            np.hstack((none[:, :moving], sees)), np.hstack(outputs), push.T @ acceleration.T - force,
        )  # fmt: skip
