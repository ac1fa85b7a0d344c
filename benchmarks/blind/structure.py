"""A linear structure with ports, and what it does with hidden forces in it: at rest, and after a release."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import linalg

from benchmarks.blind.laws import (
    BOUC_WEN,
    JENKINS,
    NO_FORCE,
    Law,
    bouc_wen_rate,
    elastic_force,
    integrate,
    law_arrays,
)

FloatArray = NDArray[np.float64]

STEP = 4e-4
"""Largest time step [s] of the integration; a quarter of it changes no reading by more than 0.04 noises."""
LOAD_STEPS = 32
"""Increments between two load levels on the path of a static trial."""


@njit(cache=True)
def _tangent(x, x0, flexibility, kinds, numbers, slip, stiffness, z, bouc, h):
    """Return the derivative (P, P) of x + G F(x) by differences of length h."""
    p = len(x)
    matrix = np.eye(p)
    for j in range(p):
        at = _path_force(kinds[j], numbers[j], slip[j], stiffness[j], x[j], x0[j], z[j], bouc[j])
        up = _path_force(kinds[j], numbers[j], slip[j], stiffness[j], x[j] + h, x0[j], z[j], bouc[j])
        for i in range(p):
            matrix[i, j] += flexibility[i, j] * (up - at) / h
    return matrix


@njit(cache=True)
def _static_path(linear, flexibility, kinds, numbers, slip, stiffness, z, bouc, steps):
    """Return the forces (N, P) of elastic laws at each row of the motion `linear` (N, P) without them.

    x + G F(x) = x_linear, by Newton's method with differences, in `steps` increments from row to row and
    from rest to the first. `z` (P, E) and `bouc` (P,) are the state of the hysteresis; they are advanced.
    Forces are NaN from the row on that has no state on this path: a softening structure has no stiffness left
    there (the determinant of the tangent is not positive), and what Newton's method finds, if it ends at all,
    is another branch.
    """
    rows, p = linear.shape
    forces = np.full((rows, p), np.nan)
    x, x0, before = np.zeros(p), np.zeros(p), np.zeros(p)
    force = np.zeros(p)
    missed = 1e-6 * np.abs(linear).max() + 1e-12
    for row in range(rows):
        for step in range(1, steps + 1):
            target = before + (linear[row] - before) * (step / steps)
            h = 1e-6 * (np.abs(target).max() + 1e-9)
            x0[:] = x
            for _ in range(60):
                for j in range(p):
                    force[j] = _path_force(
                        kinds[j], numbers[j], slip[j], stiffness[j], x[j], x0[j], z[j], bouc[j]
                    )
                residual = x + flexibility @ force - target
                if np.abs(residual).max() <= 1e-13 + 1e-11 * np.abs(target).max():
                    break
                tangent = _tangent(x, x0, flexibility, kinds, numbers, slip, stiffness, z, bouc, h)
                x = x - np.linalg.solve(tangent, residual)
            tangent = _tangent(x, x0, flexibility, kinds, numbers, slip, stiffness, z, bouc, h)
            if np.abs(residual).max() > missed or np.linalg.det(tangent) <= 0.0:
                return forces
            for j in range(p):
                if kinds[j] == BOUC_WEN:
                    bouc[j] = _bouc_wen_after(numbers[j], x[j], x0[j], bouc[j])
                elif kinds[j] == JENKINS:
                    for e in range(z.shape[1]):
                        z[j, e] = min(max(z[j, e] + x[j] - x0[j], -slip[j, e]), slip[j, e])
        for j in range(p):
            forces[row, j] = _path_force(
                kinds[j], numbers[j], slip[j], stiffness[j], x[j], x[j], z[j], bouc[j]
            )
        before[:] = linear[row]
    return forces


@njit(cache=True)
def _bouc_wen_after(numbers, x, x0, z):
    dx = x - x0
    sign = np.sign(dx)
    half = z + 0.5 * dx * bouc_wen_rate(z, sign, numbers[1], numbers[2])
    return z + dx * bouc_wen_rate(half, sign, numbers[1], numbers[2])


@njit(cache=True)
def _path_force(kind, numbers, slip, stiffness, x, x0, z, bouc):
    if kind == BOUC_WEN:
        return elastic_force(kind, numbers, slip, stiffness, x, x0, z, _bouc_wen_after(numbers, x, x0, bouc))
    return elastic_force(kind, numbers, slip, stiffness, x, x0, z, bouc)


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
            Forces inside; those that need motion do nothing here: readings are taken when all is at rest,
            and after a knock on the structure, which frees dry friction.
        """
        linear = self.solve(loads)
        elastic = [law for law in laws if law.is_elastic]
        if not elastic:
            return np.asarray((self.outputs @ linear).T)
        ports = np.array([self.ports[law.port] for law in elastic])
        compliance = self.solve(ports.T)
        kinds, numbers, slip, stiffness = law_arrays(tuple(elastic))
        forces = _static_path(
            np.ascontiguousarray((ports @ linear).T),
            ports @ compliance,
            kinds,
            numbers,
            slip,
            stiffness,
            np.zeros(slip.shape),
            np.zeros(len(kinds)),
            LOAD_STEPS,
        )
        return np.asarray((self.outputs @ (linear - compliance @ forces.T)).T)

    def _hold(
        self, release: Release, laws: tuple[Law, ...], ports: FloatArray
    ) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Return the holding force, and the forces (P,) and states (P, E), (P,) of the laws under it."""
        kinds, numbers, slip, stiffness = law_arrays(laws)
        bend = self.solve(release.load)
        unit, target = float(release.measured_at @ bend), release.amplitude
        z, bouc, forces = np.zeros(slip.shape), np.zeros(len(laws)), np.zeros(len(laws))
        if not any(law.is_elastic for law in laws):
            return target / unit, forces, z, bouc
        # The displacement is held, not the force: force = (target + coupling . F) / unit.
        compliance = self.solve(ports.T)
        coupling, along = release.measured_at @ compliance, ports @ bend
        forces = _static_path(
            (target / unit * along)[None],
            np.ascontiguousarray(ports @ compliance - np.outer(along, coupling) / unit),
            kinds,
            numbers,
            slip,
            stiffness,
            z,
            bouc,
            4 * LOAD_STEPS,
        )[0]
        return (target + float(coupling @ forces)) / unit, forces, z, bouc

    def ringdown(self, release: Release, laws: Sequence[Law] = (), refinement: int = 1) -> FloatArray:
        """Return the outputs (n, C) after a release, at `release.times`."""
        return self.fine_ringdown(release, laws, 1, refinement)[0]

    def fine_ringdown(
        self, release: Release, laws: Sequence[Law], split: int, refinement: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs (split (n - 1) + 1, C) after a release, and their times."""
        inside = tuple(laws)
        w2, shapes = self._modal
        own = np.array([self.ports[law.port] for law in inside]).reshape(len(inside), len(self.mass))
        force, forces, z, bouc = self._hold(release, inside, own)
        # The last port carries the holding force until the release, and nothing afterwards.
        ports = np.vstack([own, release.load])
        behind = self.higher(ports.T)
        flexibility = ports @ behind
        for row, law in enumerate(inside):
            if not law.needs_flexibility:
                flexibility[row], flexibility[:, row] = 0.0, 0.0
                behind[:, row] = 0.0
        laws_all = (*inside, Law("", NO_FORCE, ()))
        kinds, numbers, slip, stiffness = law_arrays(laws_all)
        pull = np.append(-forces, force)
        count = len(w2)
        state = np.concatenate(
            [(shapes.T @ (ports.T @ pull)) / w2, np.zeros(count), pull, np.append(bouc, 0.0)]
        )
        times = release.times
        interval = (times[-1] - times[0]) / (len(times) - 1)
        steps = int(np.ceil(interval / (split * STEP) - 1e-9)) * refinement
        kept = integrate(
            state,
            np.vstack([z, np.zeros((1, z.shape[1]))]),
            w2,
            self.alpha + self.beta * w2,
            self.stiffness_rate,
            np.ascontiguousarray(ports @ shapes),
            flexibility,
            self.beta if self.modes < len(self.mass) else 0.0,
            kinds,
            numbers,
            slip,
            stiffness,
            0.0,
            interval / (split * steps),
            float(times[0]),
            split * (len(times) - 1) + 1,
            steps,
        )
        outputs = kept[:, :count] @ (self.outputs @ shapes).T
        outputs += kept[:, 2 * count : 2 * count + len(laws_all)] @ (self.outputs @ behind).T
        fine = times[0] + interval / split * np.arange(len(kept))
        return np.asarray(outputs), fine

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
            rest = force * (self.outputs @ self.higher(release.load[:, None]))[:, 0]
            result += np.exp(-t / self.beta) * rest
        return np.asarray(result)
