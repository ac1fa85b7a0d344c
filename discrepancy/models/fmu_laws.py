"""Laws at the ports of an FMU: beside their system where it is linear, stepped with the FMU where not.

In both the force of a law is held over each step: that at the middle of the step, extrapolated from
displacement and velocity at its begin. What the port's speed answers to the force within one step is measured
beforehand, so that friction can stop it. Second order in the step. The laws are those of `fe.runtime.laws`.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_runs import Run, State
from discrepancy.models.interface import Memory
from discrepancy.models.port_system import PortSystem
from fe.compilation import callable_when_compiled, compiled, compiled_kernel, law_functions
from fe.runtime import laws
from fe.runtime.arrays import PLACE, IntArray
from fe.runtime.laws import speed
from fe.runtime.motion import NO_LAWS, Laws, static_solution
from fe.runtime.motion_arrays import Ports

CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
STATIC_ITERATIONS, STATIC_TOLERANCE = 30, 1e-9
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""


def held_forces(
    x: FloatArray, v: FloatArray, last: FloatArray, gain: FloatArray, h: float, ports: Ports,
    memory: FloatArray, forces: FloatArray, room: FloatArray,
) -> None:  # fmt: skip
    """Take `forces` (J,) of the laws from those over the last step to those over the next.

    The memory is carried to the middle of the step, and `last` to `v`.

    Parameters
    ----------
    x, v, last : (J,) ndarray
        Displacement and velocity of each law's port, and its velocity a step before.
    gain : (J, J) ndarray
        Speed that a unit force of each law (column) takes from the port of another over a step of `h`.
    room : (2, J) ndarray
        For the speeds that the forces took over the last step, and for accelerations without them.
    """
    count, taken, push = len(ports.numbers), room[0], room[1]
    for j in range(count):
        taken[j] = 0.0
        for i in range(count):
            taken[j] += gain[j, i] * forces[i]
        push[j] = (v[j] - last[j] + taken[j]) / h
        last[j] = v[j]
    for j in range(count):
        forces[j] = taken[j]
    for j in range(count):
        if ports.of_speed[j] == 0:
            middle = x[j] + 0.5 * h * v[j] + h * h / 6.0 * (push[j] - taken[j] / h)
            laws.advance(ports.numbers[j], ports.values[j], memory[j], middle)
            memory[j, PLACE] = middle
            forces[j] = laws.pull(ports.numbers[j], ports.values[j], memory[j], middle, 1.0)[0]
    for j in range(count):
        if ports.of_speed[j] == 1:
            left = push[j]
            for i in range(count):
                if i < j or ports.of_speed[i] == 0:
                    left -= gain[j, i] * forces[i] / h
            middle = x[j] + 0.5 * h * v[j] + 0.125 * h * h * (push[j] - taken[j] / h)
            strength = speed.strength(ports.values[j], middle, gain[j, j] / h)
            forces[j] = speed.held(ports.values[j], v[j], left, gain[j, j], strength, h)


def couple(
    system: tuple[FloatArray, ...], free: FloatArray, h: float, gain: FloatArray, port_of: IntArray,
    ports: Ports, memory: FloatArray, last: FloatArray, states: FloatArray, applied: FloatArray,
) -> None:  # fmt: skip
    """Couple the laws with a linear system; fill `states` (N + 1, n), and add the forces to `applied` (N, P).

    `system` holds transition, drive, and rows (2 P, n), (2 P, P) of the ports' displacements and speeds, to
    which `free` (N + 1, 2 P) is added; `last` (J,) as in `held_forces`.
    """
    transition, drive, seen, direct = system
    count, size = len(applied), len(ports.numbers)
    order, width = transition.shape[0], applied.shape[1]
    rows = np.zeros((5, size))
    x, v, forces, room = rows[0], rows[1], rows[2], rows[3:]
    for k in range(count):
        for j in range(size):
            p = port_of[j]
            x[j], v[j] = free[k, p], free[k, width + p]
            for n in range(order):
                x[j] += seen[p, n] * states[k, n]
                v[j] += seen[width + p, n] * states[k, n]
            for i in range(width if k > 0 else 0):
                x[j] += direct[p, i] * applied[k - 1, i]
                v[j] += direct[width + p, i] * applied[k - 1, i]
        held_forces(x, v, last, gain, h, ports, memory, forces, room)
        for j in range(size):
            applied[k, port_of[j]] -= forces[j]
        for n in range(order):
            total = 0.0
            for i in range(width):
                total += drive[n, i] * applied[k, i]
            for i in range(order):
                total += transition[n, i] * states[k, i]
            states[k + 1, n] = total


def begin(positions: FloatArray, ports: Ports, memory: FloatArray) -> None:
    """Load the laws from zero to positions (J,) without turning."""
    for j in range(len(positions)):
        laws.advance(ports.numbers[j], ports.values[j], memory[j], positions[j])
        memory[j, PLACE] = positions[j]


@cache
def _loops() -> tuple[Callable[..., None], ...]:
    """Return `begin`, `held_forces` and `couple`, compiled."""
    functions = (*law_functions(), Ports)  # a constant stands in the file of `Ports`
    callable_when_compiled(held_forces, makes_arrays=False)
    return tuple(compiled(loop, functions) for loop in (begin, held_forces, couple))


class Coupling:
    """Laws in step with what moves: an FMU, or the system of its ports.

    Parameters
    ----------
    internal : Laws
        Internal forces.
    port_of : list of int
        Port of each law.
    gain : (P, P) ndarray
        Speed of each port after a step with a unit force at another.
    step : float
        [s].
    free : (2, 2 P) ndarray
        Displacement and velocity of the ports without the laws, at the start and a step later.
    """

    def __init__(
        self, internal: Laws, port_of: list[int], gain: FloatArray, step: float, free: FloatArray
    ) -> None:
        index = np.array(port_of, dtype=np.int64)
        self._index, self._speeds, self._step = index, len(gain) + index, step
        self._gain = np.ascontiguousarray(gain[np.ix_(index, index)])
        self._ports = internal.at_rest()  # which the loops know by their own rows
        self._memory, self._last = internal.memory(), 2.0 * free[0, self._speeds] - free[1, self._speeds]
        self._forces, self._room = np.zeros(len(index)), np.zeros((2, len(index)))
        _loops()[0](free[0, index], self._ports, self._memory)

    def forces(self, moving: FloatArray) -> FloatArray:
        """Return the forces (P,) over the next step, from how the ports are and move (2 P,)."""
        _loops()[1](
            moving[self._index], moving[self._speeds], self._last, self._gain, self._step, self._ports,
            self._memory, self._forces, self._room,
        )  # fmt: skip
        given = np.zeros(len(moving) // 2)
        np.subtract.at(given, self._index, self._forces)
        return given

    def along(
        self, system: PortSystem, free: FloatArray, start: Any = 0.0, pushed: Any = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return states (N + 1, n) and forces (N, P) of a system beside a free motion (N + 1, 2 P).

        The outputs of the system are those of `PortSystem.of_ports`. It begins at a state (n,), and forces
        (N, P) beside those of the laws push it.
        """
        transition, drive = system.over(self._step)
        applied, states = np.zeros((len(free) - 1, drive.shape[1])), np.zeros((len(free), len(drive)))
        applied[:], states[0] = pushed, start
        arrays = map(np.ascontiguousarray, (transition, drive, system.outputs, system.direct))
        _loops()[2](
            tuple(arrays), np.ascontiguousarray(free), self._step, self._gain, self._index, self._ports,
            self._memory, self._last, states, applied,
        )  # fmt: skip
        return states, applied


class FmuLaws(FmuMotion):
    """Rest and motion of an FMU with laws at its ports."""

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        self._names = [port.name for port in description.port]
        self._refinements: dict[Hashable, tuple[int, float]] = {}
        self._starts = Memory()

    def _port_of(self, internal: Laws) -> list[int]:
        return [self._names.index(name) for name in internal.ports]

    def at_rest_under(
        self, internal: Laws, trial: str, states: list[State], loads: list[dict[str, float]]
    ) -> FloatArray:
        """Return the outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        index = self._port_of(internal)
        columns, inputs = np.array(self.x)[index], [self.forces[number] for number in index]
        memory, before, found = None, np.zeros(len(index)), list[FloatArray]()
        for row, (state, load) in enumerate(zip(states, loads, strict=True)):
            compliance = self.flexibility(state)[np.ix_(index, index)]
            linear = self.rest(state, load)[columns]
            for _ in range(STATIC_ITERATIONS):
                solution = static_solution(
                    internal, linear[None], compliance, memory=memory, start=before, kernel=compiled_kernel()
                )
                forces, given = solution.forces[0], dict(load)
                for at, force in zip(inputs, forces.tolist(), strict=True):
                    given[at] = given.get(at, 0.0) - force
                values = self.rest(state, given)
                # where the FMU is not linear, the law is solved again about the point that was reached
                again = values[columns] + compliance @ forces
                change, linear = np.max(np.abs(again - linear)), again
                if change <= STATIC_TOLERANCE * max(np.max(np.abs(again)), 1e-300):
                    break
            else:
                raise ModelError(
                    f"The law at {', '.join(dict.fromkeys(internal.ports))} and the FMU model "
                    f"{self.description.name!r} did not agree at load level {row + 1} of {trial!r} within "
                    f"{STATIC_ITERATIONS} iterations; the force is too strong for the FMU."
                )
            memory, before = solution.memory, linear
            found.append(values)
        return np.array(found)

    def added(
        self, internal: Laws, run: Run, free: FloatArray, trial: Trial, seen: Sequence[int]
    ) -> tuple[FloatArray, float] | None:
        """Return what laws add to columns (K, L) of a run's outputs `free`, and the step [s].

        None if the FMU is not linear.
        """
        system = self.system(run.state, self.step(trial), len(trial.time))
        if system is None:
            return None
        watched, at_ports = [*seen, *self.x], system.of_ports(self.x, self.v)

        def moved(parts: int) -> FloatArray:
            step, key = run.step / parts, ("at ports", parts, run.key)
            beside = self.remembered(key, lambda: self._free_at_ports(at_ports, run, free, parts))
            speeds = slice(len(self.x), None)
            gain = at_ports.outputs[speeds] @ at_ports.over(step)[1] + at_ports.direct[speeds]
            coupling = Coupling(internal, self._port_of(internal), gain, step, beside)
            with np.errstate(all="ignore"):
                states, held = coupling.along(at_ports, beside)
                held[:-1] = 0.5 * (held[:-1] + held[1:])  # at the ends of the steps
                return system.seen(states, held, watched)

        parts = self._parts_for(
            internal, trial, watched, run.step, lambda parts: free[:, watched] + moved(parts)[::parts]
        )
        return moved(parts)[:, : len(seen)], run.step / parts

    def _free_at_ports(self, system: PortSystem, run: Run, free: FloatArray, parts: int) -> FloatArray:
        """Return displacements and speeds (N + 1, 2 P) of the ports without laws at parts of the steps.

        Those of their system, from the state that the FMU shows; what is left of what the FMU shows at its
        own steps is small and a spline between them.
        """
        count = len(self._names)
        forces, first = np.zeros((run.steps, count)), np.zeros(count)
        for part, value in run.loads:
            if part.name in self.forces:
                at = self.forces.index(part.name)
                forces[: len(part.series), at] += value * part.series[: run.steps]
                first[at] += value * part.begin
        if any(part.kind == "input" for part, _ in run.loads):
            start = np.asarray(np.linalg.solve(system.generator, system.push @ -first))
        else:
            key = (run.state, run.step, run.steps)
            inverse = self._starts.get(key, lambda: system.starting(count, run.step, run.steps))
            start = inverse @ free[1:, self.x].ravel()

        def moved(parts: int) -> FloatArray:
            given, none = np.repeat(forces, parts, axis=0), np.zeros((parts * run.steps + 1, 2 * count))
            alone = Coupling(NO_LAWS, [], np.zeros((count, count)), run.step / parts, none)
            return system.seen(*alone.along(system, none, start, given))

        coarse, found = moved(1), moved(parts)
        grid = run.step * np.arange(run.steps + 1)
        fine = np.linspace(0.0, grid[-1], len(found))
        for number, (slow, fast) in enumerate(zip(self.x, self.v, strict=True)):
            left = CubicSpline(grid, free[:, slow] - coarse[:, number])
            found[:, number] += left(fine)
            if fast >= 0:
                left = CubicSpline(grid, free[:, fast] - coarse[:, count + number]).antiderivative()
            found[:, count + number] += left(fine, 1)
        return found

    def stepped(
        self, internal: Laws, excite: Callable[[int], Run], trial: Trial, refinement: int, seen: Sequence[int]
    ) -> tuple[FloatArray, float]:
        """Return columns (K, L) of the outputs of the FMU stepped with the laws beside it, and the step [s].

        `excite` gives the run of the trial with steps that are so many times smaller.

        Raises
        ------
        ModelError
            If a port has no velocity, or the steps do not converge.
        """
        port_of, at_ports = self._port_of(internal), [*self.x, *self.v]
        without = [self._names[port] for port in port_of if self.v[port] < 0]
        if without:
            raise ModelError(
                f"The FMU model {self.description.name!r} is not linear, so its port {without[0]!r} needs a "
                f"velocity output; name it in [[port]]."
            )

        def moved(parts: int) -> FloatArray:
            run = excite(parts)
            gain = self.remembered(("gain", *run[:2]), lambda: self.records(run.state, run.step, 1)[0])
            coupling = Coupling(internal, port_of, gain[self.v], run.step, self.free(run)[:2, at_ports])
            asset, first, histories = self.begin(run)
            names, rows = list(histories), np.column_stack([*histories.values()])
            values, pushed = [first], [names.index(name) for name in self.forces]
            for row in rows:
                np.add.at(row, pushed, coupling.forces(values[-1][at_ports]))
                values.append(self.one_step(asset, dict(zip(names, row.tolist(), strict=True))))
            return np.array(values)

        watched, parts = [*seen, *self.x], 1
        if self.description.motion.step is None:
            parts = self._parts_for(
                internal, trial, watched, self.step(trial), lambda parts: moved(parts)[::parts, watched]
            )
        return moved(parts * refinement)[:, seen], self.step(trial, parts * refinement)

    def _parts_for(
        self, internal: Laws, trial: Trial, watched: Sequence[int], step: float,
        moved: Callable[[int], FloatArray],
    ) -> int:  # fmt: skip
        """Return into how many parts steps [s] are divided for laws.

        Steps are halved until that changes nothing that is watched by more than `CONVERGED` of its largest
        motion (rms); what was enough is kept for laws of this kind up to twice as strong. An accelerometer
        that nobody reads would ask for steps many times smaller.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        strength = float(np.max(np.abs(internal.values[:, 0])))
        exponents = np.round(np.clip(internal.values[:, 1:3], -9.0, 9.0), 1)  # roughness asks for short steps
        kinds = internal.ports, internal.numbers.tobytes(), exponents.tobytes()
        key = (tuple(sorted(set(watched))), trial.kind, trial.interval, *kinds)
        parts, tried = self._refinements.get(key, (1, 0.0))
        if strength <= 2.0 * tried:
            return parts
        coarse = moved(parts)
        while parts <= MOST_REFINEMENT:
            fine = moved(2 * parts)
            rows = min(len(fine), len(coarse))
            with np.errstate(all="ignore"):  # an unstable coupling grows beyond all numbers
                size = np.max(np.abs(fine[:rows] - fine[:rows].mean(axis=0)), axis=0)
                difference = np.sqrt(np.mean((coarse[:rows] - fine[:rows]) ** 2, axis=0))
                change = float(np.max(difference / np.where(size > 0.0, size, np.inf)))
            if np.isfinite(difference).all() and change <= CONVERGED:
                self._refinements[key] = (parts, strength)
                return parts
            parts, coarse = 2 * parts, fine
        raise ModelError(
            f"The internal force at {', '.join(dict.fromkeys(internal.ports))} does not converge in the "
            f"co-simulation with the FMU model {self.description.name!r}: halving steps of "
            f"{2.0 * step / parts:.2g} s still changes the motion by {change:.1g} of its size; the force is "
            f"too stiff for the port."
        )
