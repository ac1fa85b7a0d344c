"""A linear structure with hidden forces at ports: its static and its free response."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from benchmarks.blind.compilation import compiled
from benchmarks.blind.laws import (
    BOUC_WEN,
    JENKINS,
    NO_FORCE,
    ORDER,
    YIELD,
    Law,
    LawArrays,
    ModalStructure,
    Sampling,
    bouc_wen_rate,
    elastic_force,
    integrate,
    law_arrays,
)

FloatArray = NDArray[np.float64]

STEP = 4e-4
"""Largest time step [s]; a quarter of it changes readings by less than 0.04 standard deviations."""
LOAD_STEPS = 32
"""Increments between two load levels on the path of a static trial."""


NEWTON_ITERATIONS = 60
"""Most iterations of Newton's method for one increment of a load."""


@compiled
def _bouc_wen_after(
    laws: LawArrays, port: int, displacement: float, start: float, bouc_wen: float
) -> float:
    """Return the Bouc-Wen variable of a port after a motion, by the midpoint rule."""
    increment = displacement - start
    sign = np.sign(increment)
    yield_displacement = laws.numbers[port, YIELD]
    order = laws.numbers[port, ORDER]
    middle = bouc_wen + 0.5 * increment * bouc_wen_rate(bouc_wen, sign, yield_displacement, order)
    return bouc_wen + increment * bouc_wen_rate(middle, sign, yield_displacement, order)


@compiled
def _path_force(
    laws: LawArrays,
    port: int,
    displacement: float,
    start: float,
    play: FloatArray,
    bouc_wen: float,
) -> float:
    """Return the force of a port after a motion from `start`, where its history was known."""
    if laws.kinds[port] == BOUC_WEN:
        after = _bouc_wen_after(laws, port, displacement, start, bouc_wen)
        return elastic_force(laws, port, displacement, start, play, after)
    return elastic_force(laws, port, displacement, start, play, bouc_wen)


@compiled
def _tangent(
    x: FloatArray,
    start: FloatArray,
    flexibility: FloatArray,
    laws: LawArrays,
    play: FloatArray,
    bouc_wen: FloatArray,
    difference: float,
) -> FloatArray:
    """Return the derivative (P, P) of x + G F(x) by forward differences."""
    ports = len(x)
    matrix = np.eye(ports)
    for j in range(ports):
        force = _path_force(laws, j, x[j], start[j], play, bouc_wen[j])
        force_ahead = _path_force(laws, j, x[j] + difference, start[j], play, bouc_wen[j])
        for i in range(ports):
            matrix[i, j] += flexibility[i, j] * (force_ahead - force) / difference
    return matrix


@compiled
def _solve_increment(
    start: FloatArray,
    target: FloatArray,
    flexibility: FloatArray,
    laws: LawArrays,
    play: FloatArray,
    bouc_wen: FloatArray,
    difference: float,
) -> tuple[FloatArray, float]:
    """Solve x + G F(x) = target by Newton's method from `start`.

    Returns
    -------
    (P,) array, float
        The solution x, and its largest residual.
    """
    ports = len(start)
    x = start.copy()
    force = np.zeros(ports)
    largest_residual = np.inf
    for _ in range(NEWTON_ITERATIONS):
        for j in range(ports):
            force[j] = _path_force(laws, j, x[j], start[j], play, bouc_wen[j])
        residual = x + flexibility @ force - target
        largest_residual = np.abs(residual).max()
        if largest_residual <= 1e-13 + 1e-11 * np.abs(target).max():
            break
        tangent = _tangent(x, start, flexibility, laws, play, bouc_wen, difference)
        x = x - np.linalg.solve(tangent, residual)
    return x, largest_residual


@compiled
def _advance_hysteresis(
    x: FloatArray,
    start: FloatArray,
    laws: LawArrays,
    play: FloatArray,
    bouc_wen: FloatArray,
) -> None:
    """Advance Jenkins elements and Bouc-Wen variables in place for a motion from `start` to `x`."""
    for j in range(len(x)):
        if laws.kinds[j] == BOUC_WEN:
            bouc_wen[j] = _bouc_wen_after(laws, j, x[j], start[j], bouc_wen[j])
        elif laws.kinds[j] == JENKINS:
            for e in range(play.shape[1]):
                slip = laws.slip[j, e]
                play[j, e] = min(max(play[j, e] + x[j] - start[j], -slip), slip)


@compiled
def _static_path(
    linear: FloatArray,
    flexibility: FloatArray,
    laws: LawArrays,
    play: FloatArray,
    bouc_wen: FloatArray,
    increments: int,
) -> FloatArray:
    """Return the forces of elastic laws along a path of static loads, x + G F(x) = x_linear.

    Parameters
    ----------
    linear : (N, P) array
        Port displacements without the laws, row by row.
    flexibility : (P, P) array
        Flexibility G of the structure between the ports.
    laws : LawArrays
        The law of each port.
    play : (P, E) array
        Initial deflections of the Jenkins elements; they are advanced in place.
    bouc_wen : (P,) array
        Initial Bouc-Wen variables; they are advanced in place.
    increments : int
        Increments from row to row, and from rest to the first.

    Returns
    -------
    (N, P) array
        Forces; NaN from the row on that has no state on this path. A softening structure has no
        stiffness left there (the determinant of the tangent is not positive), and a solution of
        Newton's method, if there is one, lies on another branch.
    """
    rows, ports = linear.shape
    forces = np.full((rows, ports), np.nan)
    x = np.zeros(ports)
    previous = np.zeros(ports)
    accepted_residual = 1e-6 * np.abs(linear).max() + 1e-12
    for row in range(rows):
        for increment in range(1, increments + 1):
            target = previous + (linear[row] - previous) * (increment / increments)
            difference = 1e-6 * (np.abs(target).max() + 1e-9)
            start = x
            x, residual = _solve_increment(
                start, target, flexibility, laws, play, bouc_wen, difference
            )
            tangent = _tangent(x, start, flexibility, laws, play, bouc_wen, difference)
            if residual > accepted_residual or np.linalg.det(tangent) <= 0.0:
                return forces
            _advance_hysteresis(x, start, laws, play, bouc_wen)
        for j in range(ports):
            forces[row, j] = _path_force(laws, j, x[j], x[j], play, bouc_wen[j])
        previous[:] = linear[row]
    return forces


@dataclass(frozen=True)
class Release:
    """A release from rest.

    Attributes
    ----------
    amplitude : float
        Displacement of the release point under the holding force [m].
    load : (r,)
        Direction of the holding force, in the coordinates of the structure.
    measured_at : (r,)
        Weights of the release point's displacement.
    times : (n,)
        Times since the release [s], evenly spaced, the first not negative.
    """

    amplitude: float
    load: FloatArray
    measured_at: FloatArray
    times: FloatArray


@dataclass(frozen=True)
class HeldState:
    """The state of a structure that is held before a release.

    Attributes
    ----------
    holding_force : float
        Force at the release point.
    forces : (P,) array
        Forces of the laws.
    play : (P, E) array
        Deflections of their Jenkins elements.
    bouc_wen : (P,) array
        Their Bouc-Wen variables.
    """

    holding_force: float
    forces: FloatArray
    play: FloatArray
    bouc_wen: FloatArray


@dataclass(frozen=True)
class Structure:
    """A linear structure on r coordinates.

    Attributes
    ----------
    stiffness, mass : (r, r)
        [N/m], [kg] and so on.
    alpha, beta : float
        Rayleigh damping [1/s], [s].
    outputs : (C, r)
        Outputs per coordinate.
    ports : mapping of str to (r,)
        Motion of each port per coordinate.
    modes : int
        Modes that move with inertia; the higher ones follow without. All, if there are no more.
    stiffness_rate : float
        The stiffness is (1 + `stiffness_rate` t) times as large t after a release [1/s].
    """

    stiffness: FloatArray
    mass: FloatArray
    alpha: float
    beta: float
    outputs: FloatArray
    ports: Mapping[str, FloatArray]
    modes: int
    stiffness_rate: float = 0.0

    @cached_property
    def _modal(self) -> tuple[FloatArray, FloatArray]:
        count = min(self.modes, len(self.mass))
        w2, shapes = linalg.eigh(self.stiffness, self.mass, subset_by_index=(0, count - 1))
        return w2, shapes

    @property
    def angular_frequency(self) -> FloatArray:
        """Of the modes (M,) [rad/s]."""
        return np.sqrt(self._modal[0])

    @property
    def shapes(self) -> FloatArray:
        """Mass-normalised modes (r, M)."""
        return self._modal[1]

    @cached_property
    def _factors(self) -> tuple[FloatArray, bool]:
        factors: tuple[FloatArray, bool] = linalg.cho_factor(self.stiffness)
        return factors

    def solve(self, load: FloatArray) -> FloatArray:
        """Return the static displacement (r,) or (r, n) under loads."""
        return np.asarray(linalg.cho_solve(self._factors, load))

    def higher(self, load: FloatArray) -> FloatArray:
        """Return the static displacement (r, n) under loads (r, n) that the modes do not hold."""
        if self.modes >= len(self.mass):
            return np.zeros_like(load)
        w2, shapes = self._modal
        return self.solve(load) - shapes @ ((shapes.T @ load) / w2[:, None])

    def static(self, loads: FloatArray, laws: Sequence[Law] = ()) -> FloatArray:
        """Return the outputs (n, C) under loads (r, n), applied one after the other from rest.

        Parameters
        ----------
        loads : (r, n)
            Loads.
        laws : sequence of Law
            Forces inside; those that need motion do nothing here: readings are taken when all is at
            rest, and after a knock on the structure, which frees dry friction.
        """
        linear = self.solve(loads)
        elastic = [law for law in laws if law.is_elastic]
        if not elastic:
            return np.asarray((self.outputs @ linear).T)
        ports = np.array([self.ports[law.port] for law in elastic])
        compliance = self.solve(ports.T)
        arrays = law_arrays(tuple(elastic))
        forces = _static_path(
            np.ascontiguousarray((ports @ linear).T),
            ports @ compliance,
            arrays,
            np.zeros(arrays.slip.shape),
            np.zeros(len(elastic)),
            LOAD_STEPS,
        )
        return np.asarray((self.outputs @ (linear - compliance @ forces.T)).T)

    def _hold(self, release: Release, laws: tuple[Law, ...], ports: FloatArray) -> HeldState:
        """Return the state in which the release point is held at its displacement before a release.

        Parameters
        ----------
        release : Release
            The release.
        laws : tuple of Law
            P laws in the structure.
        ports : (P, r) array
            Motion of their ports per coordinate.
        """
        arrays = law_arrays(laws)
        unit_displacement = self.solve(release.load)
        unit = float(release.measured_at @ unit_displacement)
        target = release.amplitude
        play = np.zeros(arrays.slip.shape)
        bouc_wen = np.zeros(len(laws))
        if not any(law.is_elastic for law in laws):
            return HeldState(target / unit, np.zeros(len(laws)), play, bouc_wen)
        # The displacement is held, not the force: force = (target + coupling . F) / unit.
        compliance = self.solve(ports.T)
        coupling = release.measured_at @ compliance
        port_displacement = ports @ unit_displacement
        forces = _static_path(
            (target / unit * port_displacement)[None],
            np.ascontiguousarray(ports @ compliance - np.outer(port_displacement, coupling) / unit),
            arrays,
            play,
            bouc_wen,
            4 * LOAD_STEPS,
        )[0]
        return HeldState((target + float(coupling @ forces)) / unit, forces, play, bouc_wen)

    def ringdown(
        self, release: Release, laws: Sequence[Law] = (), refinement: int = 1
    ) -> FloatArray:
        """Return the outputs (n, C) after a release, at `release.times`."""
        return self.fine_ringdown(release, laws, 1, refinement)[0]

    def fine_ringdown(
        self, release: Release, laws: Sequence[Law], split: int, refinement: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs after a release at times that part each interval of `release.times`.

        Parameters
        ----------
        release : Release
            The release, with n times.
        laws : sequence of Law
            Forces inside the structure.
        split : int
            Parts of each interval.
        refinement : int
            Factor by which the time step of the integration is refined.

        Returns
        -------
        (split (n - 1) + 1, C) array, (split (n - 1) + 1,) array
            Outputs, and their times [s].
        """
        internal = tuple(laws)
        law_ports = [self.ports[law.port] for law in internal]
        law_port_matrix = np.array(law_ports).reshape(len(internal), len(self.mass))
        held = self._hold(release, internal, law_port_matrix)

        # The last port carries the holding force until the release, and nothing afterwards
        ports = np.vstack([law_port_matrix, release.load])
        higher = self.higher(ports.T)
        flexibility = ports @ higher
        for row, law in enumerate(internal):
            if not law.needs_flexibility:
                flexibility[row] = 0.0
                flexibility[:, row] = 0.0
                higher[:, row] = 0.0

        # Initial state: deflection of the modes and of the flexibility under all forces
        w2, shapes = self._modal
        modes = len(w2)
        pull = np.append(-held.forces, held.holding_force)
        modal_deflection = (shapes.T @ (ports.T @ pull)) / w2
        state = np.concatenate(
            [modal_deflection, np.zeros(modes), pull, np.append(held.bouc_wen, 0.0)]
        )

        # Motion
        times = release.times
        interval = (times[-1] - times[0]) / (len(times) - 1)
        steps = int(np.ceil(interval / (split * STEP) - 1e-9)) * refinement
        states = integrate(
            state,
            np.vstack([held.play, np.zeros((1, held.play.shape[1]))]),
            ModalStructure(
                squared_frequency=w2,
                damping=self.alpha + self.beta * w2,
                stiffness_rate=self.stiffness_rate,
                ports=np.ascontiguousarray(ports @ shapes),
                flexibility=flexibility,
                higher_damping=self.beta if self.modes < len(self.mass) else 0.0,
            ),
            law_arrays((*internal, Law("", NO_FORCE, ()))),
            Sampling(
                step=interval / (split * steps),
                lead=float(times[0]),
                states=split * (len(times) - 1) + 1,
                steps_between=steps,
            ),
        )

        # Outputs of the modes and of the flexibility
        outputs = states[:, :modes] @ (self.outputs @ shapes).T
        outputs += states[:, 2 * modes : 2 * modes + len(ports)] @ (self.outputs @ higher).T
        fine_times = times[0] + interval / split * np.arange(len(states))
        return np.asarray(outputs), fine_times

    def free_ringdown(self, release: Release) -> FloatArray:
        """Return the outputs (n, C) after a release without forces inside, in closed form."""
        w2, shapes = self._modal
        bend = self.solve(release.load)
        force = release.amplitude / float(release.measured_at @ bend)
        decay = 0.5 * (self.alpha + self.beta * w2)
        damped = np.sqrt((w2 - decay**2).astype(complex))
        t = release.times[:, None]
        motion = np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))
        start = (shapes.T @ release.load) * force / w2
        result = (motion.real * start) @ (self.outputs @ shapes).T
        if self.modes < len(self.mass):
            higher = force * (self.outputs @ self.higher(release.load[:, None]))[:, 0]
            result += np.exp(-t / self.beta) * higher
        return np.asarray(result)
