"""A linear system with ports, M z'' + C z' + K z = loads: its modes and its equilibrium.

Displacements u and states x, M u'' + C u' + K u = F x + b(t), T x' + R x = G u' + H u + d(t): a
state is the speed of a coordinate that has no stiffness, x = s', so that both are one equation in z
= (u, s). A prescribed motion (a drive) takes its direction out of u; what remains moves in its
modes. For the laws at ports the drive is a coordinate of its own, so heavy that the laws do not
move it (`HEAVY_RATIO`), and it is corrected at every step. The wing, a structure on springs and a
lumped rig are such systems.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import eigh, null_space

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.errors import ModelError
from discrepancy.system.excitation import Excitation
from fe.compilation import compiled_kernel
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import static_solution
from fe.runtime.port_laws import NO_LAWS, PortLaws

HEAVY_RATIO = 1e12
"""Mass of a prescribed coordinate, relative to the largest entry of the mass matrix."""
LEAST_PIVOT = 1e-9
"""Relative singular value below which nothing restores a motion (`rcond` of the least squares)."""
ROUNDING = 1e-10
"""Entries below this fraction of the largest one are rounding errors."""


class Modes(NamedTuple):
    """Modes of a system; coordinates of states come after those of displacements.

    Attributes
    ----------
    angular_frequency : (M,) ndarray
        Angular frequencies [rad/s], rising; zero for rigid motions and states.
    shapes : (N, M) ndarray
        The mass-normalised shapes of M modes, in N degrees of freedom.
    displacement_count : int
        The number of the coordinates that are displacements.
    """

    angular_frequency: FloatArray
    shapes: FloatArray
    displacement_count: int


class ModalFrequencies(Protocol):
    """The frequencies of the modes of a structure."""

    @property
    def frequency(self) -> FloatArray:
        """The natural frequencies (M,) of the M modes [Hz]."""


class SolvedStructure(Protocol):
    """A structure that knows its modes and its flexibility: a reduced or a patched one."""

    @property
    def modes(self) -> ModalFrequencies:
        """The natural frequencies of the modes that have inertia."""

    @property
    def mode_shapes(self) -> FloatArray:
        """The mass-normalised shapes (n, M) of the M modes with inertia."""

    def static(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, for loads (n,) or (n, k)."""


class StaticPath(NamedTuple):
    """Equilibrium at successive load levels.

    Attributes
    ----------
    values : (L, N) or (L, C) ndarray
        Displacements and states at each level, or rows times these.
    memory : ndarray, optional
        The memory of the laws at the last level, a row for each law; None without laws.
    """

    values: FloatArray
    memory: FloatArray | None


def _differ_beyond_rounding(matrix: FloatArray, other_matrix: FloatArray) -> bool:
    """Return whether two matrices differ by more than `ROUNDING` times the largest entry."""
    largest = np.abs(matrix).max(initial=1e-300)
    return bool(np.abs(matrix - other_matrix).max(initial=0.0) > ROUNDING * largest)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A linear system of N unknowns, n of them displacements.

    Attributes
    ----------
    mass, damping, stiffness : (N, N) ndarray
        Matrices of (u, s): diag(M, T), [[C, -F], [-G, R]], [[K, 0], [-H, 0]].
    ports : mapping of str to (N,) ndarray
        Rows of the ports where internal forces act: a displacement [m] or rotation [rad] is row .
        u, or a state is row . x.
    mode_count : int or None
        For a structure that springs hold, with positive definite mass and stiffness: the number of
        modes that have inertia; the other modes follow without it. None: all modes have inertia,
        and nothing need hold the system.
    relaxation : float
        The factor of the part of the damping that is proportional to the stiffness, for the modes
        without inertia [s].
    on_modes : frozenset of str
        Ports whose position is that of the modes with inertia alone.
    state_count : int
        The number of states, N - n.
    drives : (P, N) ndarray
        Rows that are prescribed: each of displacements alone, whose motion is prescribed, or of
        states alone.
    actions : mapping of str to (N,) ndarray
        The directions in which laws at ports act, for all ports; empty if they are the rows of the
        ports.
    solved : SolvedStructure, optional
        The structure with its modes and K^-1, if they are known.
    """

    mass: FloatArray
    damping: FloatArray
    stiffness: FloatArray
    ports: Mapping[str, FloatArray]
    mode_count: int | None = None
    relaxation: float = 0.0
    on_modes: frozenset[str] = frozenset()
    state_count: int = 0
    drives: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    actions: Mapping[str, FloatArray] = field(default_factory=dict)
    solved: SolvedStructure | None = None

    @property
    def unknown_count(self) -> int:
        """The number N of unknowns: displacements, then states of first order."""
        return len(self.mass)

    @property
    def displacement_count(self) -> int:
        """The number n of the unknowns that are displacements."""
        return self.unknown_count - self.state_count

    @property
    def law_directions(self) -> Mapping[str, FloatArray]:
        """Directions (N,) in which laws act, by port."""
        return self.actions or self.ports

    # ------------------------------------------------------------ modes

    @cached_property
    def drive_shapes(self) -> FloatArray:
        """Displacements and states (N, P) under a unit motion, or a unit state, of each drive.

        Of all shapes that follow the drives, these have the least norm (pseudo-inverse).
        """
        shapes = np.zeros((self.unknown_count, len(self.drives)))
        if len(self.drives):
            n = self.displacement_count
            shapes[:n] = np.linalg.pinv(self.drives[:, :n])
            shapes[n:] = np.linalg.pinv(self.drives[:, n:])
        return shapes

    @cached_property
    def prescribes_state(self) -> BoolArray:
        """Whether each of the P drives prescribes a state, and no motion."""
        return np.asarray(np.any(self.drives[:, self.displacement_count :], axis=1))

    @cached_property
    def modes(self) -> Modes:
        """The modes of all motions and states that no drive prescribes."""
        if self.solved is not None:
            angular_frequency = 2.0 * np.pi * self.solved.modes.frequency
            shapes = np.ascontiguousarray(self.solved.mode_shapes)
            return Modes(angular_frequency, shapes, len(angular_frequency))
        # omega^2 (M,), and shapes (displacement_count, M)
        squares, displacement_shapes = self._displacement_modes()
        displacement_count = self.displacement_count
        mode_count = len(squares)
        state_shapes = self._state_shapes()  # (state_count, K)
        state_mode_count = state_shapes.shape[1]
        # displacements and states do not share a mode: two diagonal blocks
        shapes = np.zeros((self.unknown_count, mode_count + state_mode_count))
        shapes[:displacement_count, :mode_count] = displacement_shapes
        shapes[displacement_count:, mode_count:] = state_shapes
        # modes of states do not oscillate: their frequency is zero
        angular_frequency = np.pad(np.sqrt(np.maximum(squares, 0.0)), (0, state_mode_count))
        return Modes(angular_frequency, shapes, mode_count)

    def _state_shapes(self) -> FloatArray:
        """Return the shapes (state_count, K) of the K independent states that no drive prescribes.

        They are the principal axes of the capacity matrix (the lower right block of `mass`), scaled
        to a modal capacity of 1.
        """
        n = self.displacement_count
        if not self.state_count:
            return np.zeros((0, 0))
        capacity = self.mass[n:, n:]
        state_drives = self.drives[self.prescribes_state, n:]
        if not len(state_drives):
            capacities, principal_axes = np.linalg.eigh(capacity)
            return np.asarray(principal_axes / np.sqrt(capacities))
        # an orthonormal basis of the states that leave all prescribed ones at zero
        undriven_states = null_space(state_drives)
        capacities, principal_axes = np.linalg.eigh(undriven_states.T @ capacity @ undriven_states)
        return np.asarray(undriven_states @ principal_axes / np.sqrt(capacities))

    def _displacement_modes(self) -> tuple[FloatArray, FloatArray]:
        """Return the modes of the n displacements, with all drives held at zero.

        Returns
        -------
        squares : (K,) ndarray
            The squared angular frequencies of the K modes [1/s^2].
        shapes : (n, K) ndarray
            The mode shapes with a modal mass of 1.
        """
        n = self.displacement_count
        mass = self.mass[:n, :n]
        stiffness = 0.5 * (self.stiffness[:n, :n] + self.stiffness[:n, :n].T)
        # an orthonormal basis of the motions that leave all drives at zero
        undriven_motions = np.eye(n)
        drives = self.drives[~self.prescribes_state, :n] if len(self.drives) else self.drives
        if len(drives):
            undriven_motions = null_space(drives)
            mass = undriven_motions.T @ mass @ undriven_motions
            stiffness = undriven_motions.T @ stiffness @ undriven_motions
        # generalised eigenvalue problem: stiffness @ shape = square * mass @ shape
        squares = np.zeros(0)
        shapes = np.zeros((0, 0))
        if len(mass):
            subset = None
            if self.mode_count and self.mode_count < len(mass):
                subset = [0, self.mode_count - 1]
            try:
                squares, shapes = eigh(stiffness, mass, subset_by_index=subset)
            except np.linalg.LinAlgError as cause:
                raise ModelError(f"The mass matrix must be positive definite ({cause}).") from cause
        # A rigid motion has the eigenvalue zero, up to rounding. It is allowed only if nothing need
        # hold the system.
        if self.mode_count is None:
            is_rounding = np.abs(squares) <= ROUNDING * np.max(np.abs(squares), initial=0.0)
            squares = np.where(is_rounding, 0.0, squares)
        elif squares[0] <= 0.0:
            raise ModelError(
                f"The stiffness must be positive definite, but an eigenvalue is {squares[0]:g} "
                "1/s^2."
            )
        return squares, undriven_motions @ shapes

    @property
    def angular_frequency(self) -> FloatArray:
        """Angular frequencies (M,) [rad/s], rising; zero for rigid motions and states."""
        return self.modes.angular_frequency

    @property
    def shapes(self) -> FloatArray:
        """The mass-normalised shapes (N, M) of the M modes in N unknowns."""
        return self.modes.shapes

    @property
    def displacement_mode_count(self) -> int:
        """Number of the modes that are of displacements; the others are states."""
        return self.modes.displacement_count

    @property
    def is_truncated(self) -> bool:
        """Whether some modes have no inertia."""
        return self.mode_count is not None and self.mode_count < self.unknown_count

    @cached_property
    def root_drive_mass(self) -> float:
        """Square root of the mass of the drives, which normalises their shapes."""
        return float(np.sqrt(HEAVY_RATIO * np.max(np.abs(self.mass))))

    @cached_property
    def shapes_with_drives(self) -> FloatArray:
        """Mass-normalised shapes (N, M + P) of the modes and of the drives."""
        if not len(self.drives):
            return self.shapes
        return np.hstack((self.shapes, self.drive_shapes / self.root_drive_mass))

    @cached_property
    def modal_system(self) -> ModalSystem:
        """The equations of motion in modal coordinates, with drives and ports.

        Without drives, a coupling of the modes that is only a rounding error is set to zero.
        """
        mode_count = len(self.angular_frequency)
        drive_count = len(self.drives)
        # the coordinates are the modes, then the drives, which count as modes of frequency zero
        angular_frequency = np.pad(self.angular_frequency, (0, drive_count))
        shapes = self.shapes_with_drives  # (unknowns, modes + drives)
        damping = shapes.T @ self.damping @ shapes
        stiffness = shapes.T @ self.stiffness @ shapes
        # the motion of a drive is prescribed: no damping or stiffness acts on it
        damping[mode_count:] = 0.0
        stiffness[mode_count:] = 0.0
        # an exact diagonal if only rounding errors couple the modes
        diagonal = np.diag(np.diag(damping))
        if not drive_count and not _differ_beyond_rounding(damping, diagonal):
            damping = diagonal
        uncoupled = np.diag(angular_frequency**2)
        is_coupled = drive_count > 0 or _differ_beyond_rounding(stiffness, uncoupled)
        return ModalSystem(
            angular_frequency,
            damping,
            {name: np.asarray(row @ shapes) for name, row in self.ports.items()},
            self._port_residuals(),
            self.relaxation,
            stiffness if self.mode_count is None and is_coupled else None,
            {name: np.asarray(row @ shapes) for name, row in self.law_directions.items()},
        )

    def _port_residuals(self) -> FloatArray | None:
        """Return the compliance (P,) of ports in the modes without inertia.

        The result is None if all modes have inertia. An entry is zero if it is a rounding error, or
        if the port is in `on_modes`.
        """
        if not self.is_truncated or not self.ports:
            return None
        rows = np.array(list(self.ports.values()))  # (P, N)
        residual_compliance = np.einsum("pn,np->p", rows, self.residual_displacements(rows.T))
        compliance = np.einsum("pn,np->p", rows, self.apply_flexibility(rows.T))
        is_flexible = [name not in self.on_modes for name in self.ports]
        is_above_rounding = residual_compliance > 1e-9 * compliance
        return np.where(is_above_rounding & is_flexible, residual_compliance, 0.0)

    def modal_forces(self, excitation: Excitation, time: FloatArray) -> FloatArray:
        """Return the forces (T, M + P) on M modes, then on P drives, at times (T,) [s].

        A drive is a point with a prescribed motion d(t). With the shapes D of the drives and S of
        the modes, the displacement is S q + D d, and the drives accelerate the modes by inertia:

            q'' + ... = S^T loads - S^T M D d''.

        A drive has a large mass m of its own and the coordinate sqrt(m) d. The force on it is that
        which gives it its prescribed acceleration, so that no load changes it.
        """
        forces = excitation.loads_at(time, self.shapes_with_drives)
        if excitation.prescribed_motions:
            motions = excitation.prescribed_motions.values()
            accelerations = np.transpose(
                [motion.values_at(time, derivative=2) for motion in motions]
            )
            mode_count = len(self.angular_frequency)
            modal_inertia = self.drive_shapes.T @ self.mass @ self.shapes
            forces[:, :mode_count] -= accelerations @ modal_inertia
            forces[:, mode_count:] = self.root_drive_mass * accelerations
        return forces

    def rows_of_laws(self, laws: PortLaws, time: float | None = None) -> FloatArray:
        """Return the rows (J, N) of the laws' ports; see `PortLaws.port_rows`."""
        return laws.port_rows(self.ports, self.unknown_count, time)

    # ------------------------------------------------------------ equilibrium

    @cached_property
    def _inverse_cholesky(self) -> FloatArray:
        """The inverse L^-1 of the Cholesky factor of the stiffness K = L L^T."""
        try:
            return np.linalg.inv(np.linalg.cholesky(self.stiffness))
        except np.linalg.LinAlgError as cause:
            raise ModelError(
                f"The structure has no stiffness left in some direction ({cause})."
            ) from cause

    def apply_flexibility(self, loads: FloatArray) -> FloatArray:
        """Return K^-1 loads, for loads (N,) or (N, k) on a structure that springs hold.

        Raises
        ------
        ModelError
            If the stiffness is not positive definite.
        """
        if self.solved is not None:
            return self.solved.static(loads)
        inverse = self._inverse_cholesky  # K^-1 = L^-T L^-1
        return np.asarray(inverse.T @ (inverse @ loads))

    def residual_displacements(self, loads: FloatArray) -> FloatArray:
        """Return the displacements of the modes without inertia under loads (N,) or (N, k).

        The displacements are the residual flexibility times the loads: K^-1 loads minus the static
        displacements of the M modes with inertia, shapes / omega^2 (shapes^T loads).
        """
        in_modes = (self.shapes / self.angular_frequency**2) @ (self.shapes.T @ loads)
        return self.apply_flexibility(loads) - in_modes

    def equilibrium_under(self, loads: FloatArray) -> FloatArray:
        """Return displacements and states (L, N) in equilibrium under constant loads (L, N).

        Raises
        ------
        ModelError
            If nothing holds the system against a load.
        """
        if self.mode_count is not None:
            return self.apply_flexibility(loads.T).T
        # In equilibrium displacements q and states v are constant, so K q + D v = modal loads.
        # Least squares: rigid motions may be unrestored, if no load acts along them.
        mode_count = len(self.angular_frequency)
        displacement_mode_count = self.displacement_mode_count
        modal_loads = loads @ self.shapes  # (L, M)
        restoring = np.hstack(  # (M, M)
            (
                self.modal_system.full_stiffness[:mode_count, :displacement_mode_count],
                self.modal_system.damping[:mode_count, displacement_mode_count:mode_count],
            )
        )
        amplitudes = np.linalg.lstsq(restoring, modal_loads.T, rcond=LEAST_PIVOT)[0]
        unbalanced = np.max(np.abs(restoring @ amplitudes - modal_loads.T), initial=0.0)
        if unbalanced > 1e-6 * np.max(np.abs(modal_loads), initial=1e-300):
            largest_coefficient = np.max(np.abs(restoring), initial=0.0)
            raise ModelError(
                "the rig has no equilibrium under the loads of the first sample (nothing holds "
                "it): "
                'set `begins` = "still" or "unknown" '
                f"(its largest restoring coefficient is {largest_coefficient:.3g})"
            )
        return np.asarray(amplitudes.T @ self.shapes.T)

    def static_path(
        self,
        directions: FloatArray,
        laws: PortLaws = NO_LAWS,
        *,
        levels: FloatArray | None = None,
        memory: FloatArray | None = None,
        previous_level: FloatArray | None = None,
        offset: FloatArray | float = 0.0,
        fixed_row: FloatArray | None = None,
        output_rows: FloatArray | None = None,
        time: float | None = None,
    ) -> StaticPath:
        """Return the equilibrium at successive load levels, on a path that begins without load.

        The path matters to laws with memory, such as dry friction.

        Parameters
        ----------
        directions : (k, N) array
            The load on all unknowns for a value of one of each of k loads.
        laws : PortLaws
            Internal forces; a port of a state counts as undisplaced.
        levels : (L, k) array, optional
            The value of each load at each level; by default there are k levels, with a value of one
            of one load each.
        memory, previous_level : arrays, optional
            The memory of the laws at the end of an earlier path, and the values (k,) of the loads
            there; by default the laws were never loaded.
        offset : (N,) array, optional
            The displacements that drives prescribe, which are added to those under the loads.
        fixed_row : (N,) array, optional
            The row of a point that is held, so that the forces of laws do not move it.
        output_rows : (C, N) array, optional
            Rows whose values are returned instead of displacements and states.
        time : float, optional
            Time [s] that decides which of the laws with time windows act.

        Raises
        ------
        ModelError
            If nothing holds the system.
        SolutionError
            If the equations of the laws have no solution.
        """
        law_rows = self.rows_of_laws(laws, time)  # (J, N)
        law_rows[:, self.displacement_count :] = 0.0
        if levels is None:
            levels = np.eye(len(directions))
        # displacements under unit loads (k, N), and under unit forces of the laws (J, N)
        displacements = self.equilibrium_under(directions) + offset
        flexibility = self.equilibrium_under(law_rows)
        if fixed_row is not None:
            # subtract the displacements under the reaction that holds the point
            point_force_displacement = self.equilibrium_under(fixed_row[None])
            flexibility = flexibility - np.outer(
                flexibility @ fixed_row, point_force_displacement
            ) / float(point_force_displacement[0] @ fixed_row)
        port_displacements = displacements @ law_rows.T  # (k, J)
        port_compliance = law_rows @ flexibility.T  # (J, J)
        if output_rows is not None:
            displacements = displacements @ output_rows.T
            flexibility = flexibility @ output_rows.T
        if not len(laws):
            return StaticPath(levels @ displacements, None)
        # the laws along the path
        solution = static_solution(
            laws,
            levels @ port_displacements,
            port_compliance,
            memory=memory,
            start=None if previous_level is None else previous_level @ port_displacements,
            kernel=compiled_kernel(),
        )
        return StaticPath(levels @ displacements - solution.forces @ flexibility, solution.memory)
