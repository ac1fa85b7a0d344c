"""Laws at the ports of an FMU: beside their system where it is linear, stepped with the FMU where not."""

from collections.abc import Callable, Hashable, Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_runs import Run, State
from discrepancy.models.linear_system import solved
from discrepancy.models.memory import Memory
from discrepancy.models.port_coupling import coupled_motion, stepper
from discrepancy.models.port_system import PortSystem
from fe.runtime.motion import NO_LAWS, Laws

CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
STATIC_ITERATIONS, STATIC_TOLERANCE = 30, 1e-9
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""

Excite = Callable[[int], Run]
"""The run of a trial with steps that are so many times smaller."""


class FmuLaws:
    """Rest and motion of an FMU with laws at its ports.

    Parameters
    ----------
    motion : FmuMotion
        The FMU without them.
    """

    def __init__(self, motion: FmuMotion) -> None:
        self._motion, self._runs, self._description = motion, motion.runs, motion.runs.description
        self._names = [port.name for port in self._description.port]
        self._refinements: dict[Hashable, tuple[int, float]] = {}
        self._starts = Memory()

    def _port_of(self, laws: Laws) -> list[int]:
        return [self._names.index(name) for name in laws.ports]

    # ------------------------------------------------------------ rest

    def at_rest(
        self, trial: str, states: list[State], loads: list[dict[str, float]], laws: Laws
    ) -> FloatArray:
        """Return the outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        index = self._port_of(laws)
        columns, inputs = np.array(self._motion.x)[index], [self._motion.forces[number] for number in index]
        memory, before, found = None, np.zeros(len(laws)), list[FloatArray]()
        for row, (state, load) in enumerate(zip(states, loads, strict=True)):
            compliance = self._motion.flexibility(state)[np.ix_(index, index)]
            linear = self._motion.rest(state, load)[columns]
            for _ in range(STATIC_ITERATIONS):
                solution = solved(laws, linear[None], compliance, memory, before)
                forces, given = solution.forces[0], dict(load)
                for at, force in zip(inputs, forces.tolist(), strict=True):
                    given[at] = given.get(at, 0.0) - force
                values = self._motion.rest(state, given)
                # where the FMU is not linear, the law is solved again about the point that was reached
                again = values[columns] + compliance @ forces
                change, linear = np.max(np.abs(again - linear)), again
                if change <= STATIC_TOLERANCE * max(np.max(np.abs(again)), 1e-300):
                    break
            else:
                raise ModelError(
                    f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model "
                    f"{self._description.name!r} did not agree at load level {row + 1} of {trial!r} within "
                    f"{STATIC_ITERATIONS} iterations; the force is too strong for the FMU."
                )
            memory, before = solution.memory, linear
            found.append(values)
        return np.array(found)

    # ------------------------------------------------------------ motion

    def added(
        self, laws: Laws, run: Run, free: FloatArray, trial: Trial, seen: Sequence[int]
    ) -> tuple[FloatArray, float] | None:
        """Return what laws add to columns (K, L) of a run's outputs `free`, and the step [s].

        None if the FMU is not linear.
        """
        system = self._motion.system(run.state, self._motion.step(trial), len(trial.time))
        if system is None:
            return None
        watched, at_ports = [*seen, *self._motion.x], system.of_ports(self._motion.x, self._motion.v)

        def moved(parts: int) -> FloatArray:
            beside = self._runs.remembered(
                ("at ports", parts, run.key), lambda: self._free_at_ports(at_ports, run, free, parts)
            )
            start, forces = np.zeros(len(system.push)), np.zeros((parts * run.steps, len(self._names)))
            with np.errstate(all="ignore"):
                states, held = coupled_motion(
                    at_ports, run.step / parts, start, forces, beside, laws, self._port_of(laws)
                )
                held[:-1] = 0.5 * (held[:-1] + held[1:])  # at the ends of the steps
                return system.seen(states, held, watched)

        parts = self._parts(
            laws, trial, watched, run.step, lambda parts: free[:, watched] + moved(parts)[::parts]
        )
        return moved(parts)[:, : len(seen)], run.step / parts

    def _free_at_ports(self, system: PortSystem, run: Run, free: FloatArray, parts: int) -> FloatArray:
        """Return displacements and speeds (N + 1, 2 P) of the ports without laws at parts of the steps.

        Those of their system, from the state that the FMU shows; what is left of what the FMU shows at its
        own steps is small and a spline between them.
        """
        x, count, ports = self._motion.x, len(self._names), self._motion.forces
        forces, first = np.zeros((run.steps, count)), np.zeros(count)
        for part, value in run.loads:
            if part.name in ports:
                forces[: len(part.series), ports.index(part.name)] += value * part.series[: run.steps]
                first[ports.index(part.name)] += value * part.begin
        if any(part.kind == "input" for part, _ in run.loads):
            start = np.asarray(np.linalg.solve(system.generator, system.push @ -first))
        else:
            key = (run.state, run.step, run.steps)
            inverse = self._starts.get(key, lambda: system.starting(count, run.step, run.steps))
            start = inverse @ free[1:, x].ravel()

        def moved(parts: int) -> FloatArray:
            given = np.repeat(forces, parts, axis=0)
            none = np.zeros((len(given) + 1, 2 * count))
            step = run.step / parts
            return system.seen(*coupled_motion(system, step, start, given, none, NO_LAWS, []))

        grid, coarse, found = run.step * np.arange(run.steps + 1), moved(1), moved(parts)
        fine = np.linspace(0.0, grid[-1], len(found))
        for number, (slow, fast) in enumerate(zip(x, self._motion.v, strict=True)):
            left = CubicSpline(grid, free[:, slow] - coarse[:, number])
            found[:, number] += left(fine)
            if fast >= 0:
                left = CubicSpline(grid, free[:, fast] - coarse[:, count + number]).antiderivative()
            found[:, count + number] += left(fine, 1)
        return found

    def stepped(
        self, laws: Laws, excite: Excite, trial: Trial, refinement: int, seen: Sequence[int]
    ) -> tuple[FloatArray, float]:
        """Return columns (K, L) of the outputs of the FMU stepped with the laws beside it, and the step [s].

        Raises
        ------
        ModelError
            If a port has no velocity, or the steps do not converge.
        """
        watched, parts = [*seen, *self._motion.x], 1
        if self._description.motion.step is None:
            parts = self._parts(
                laws, trial, watched, self._motion.step(trial),
                lambda parts: self._stepped(laws, excite(parts))[::parts, watched],
            )  # fmt: skip
        run = excite(parts * refinement)
        return self._stepped(laws, run)[:, seen], run.step

    def _parts(
        self,
        laws: Laws,
        trial: Trial,
        watched: Sequence[int],
        step: float,
        moved: Callable[[int], FloatArray],
    ) -> int:
        """Return into how many parts steps [s] are divided for laws.

        Steps are halved until that changes nothing that is watched by more than `CONVERGED` of its largest
        motion (rms); what was enough is kept for laws of this kind up to twice as strong. An accelerometer
        that nobody reads would ask for steps many times smaller.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        strength = float(np.max(np.abs(laws.values[:, 0])))
        exponents = np.round(np.clip(laws.values[:, 1:3], -9.0, 9.0), 1)  # what is rough needs shorter steps
        kinds = laws.ports, laws.numbers.tobytes(), exponents.tobytes()
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
            f"The internal force at {', '.join(dict.fromkeys(laws.ports))} does not converge in the "
            f"co-simulation with the FMU model {self._description.name!r}: halving steps of "
            f"{2.0 * step / parts:.2g} s still changes the motion by {change:.1g} of its size; the force is "
            f"too stiff for the port."
        )

    def _stepped(self, laws: Laws, run: Run) -> FloatArray:
        """Return the outputs (K, C) of the FMU stepped with the laws beside it."""
        x, v, port_of = self._motion.x, self._motion.v, self._port_of(laws)
        without = [self._names[port] for port in port_of if v[port] < 0]
        if without:
            raise ModelError(
                f"The FMU model {self._description.name!r} is not linear, so its port {without[0]!r} needs a "
                f"velocity output; name it in [[port]]."
            )
        gain = self._runs.remembered(
            ("gain", *run[:2]), lambda: self._motion.records(run.state, run.step, 1)[0]
        )[v]
        at_ports = [*x, *v]
        forces = stepper(laws, port_of, gain, run.step, self._motion.free(run)[:2, at_ports])
        asset, first, histories = self._motion.begin(run)
        values = np.empty((run.steps + 1, len(first)))
        values[0] = first
        names = list(histories)
        rows = np.column_stack([histories[name] for name in names])
        at = [names.index(name) for name in self._motion.forces]
        for k in range(run.steps):
            now = rows[k].copy()
            np.add.at(now, at, forces(values[k, at_ports]))
            values[k + 1] = self._runs.stepped(asset, dict(zip(names, now.tolist(), strict=True)))
        return values
