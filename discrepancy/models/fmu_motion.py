"""Rest and motion of an FMU: superposed where it proves to be linear, stepped with the laws where not."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import partial
from math import ceil, log2

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_ports import LINEAR, FmuPorts
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Loads, Run, State
from discrepancy.models.linear_system import solved
from discrepancy.models.memory import Memory
from discrepancy.models.port_coupling import coupled_motion, stepper
from discrepancy.models.port_system import PortSystem
from fe.runtime.motion import Laws
from fmu_asset.door.session import FmiAsset

PHASE = {TrialKind.RINGDOWN: 0.1, TrialKind.FORCED: 0.05}
"""Longest communication step without laws: radians of the first mode."""
CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
STATIC_ITERATIONS, STATIC_TOLERANCE = 30, 1e-9
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""

Excite = Callable[[int], Run]
"""The run of a trial with steps that are so many times smaller."""


class FmuMotion:
    """Rest and motion of the FMU of a description.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    runs : FmuRuns
        Its FMU.
    nominal : State
        Of motions, at the means of the parameters.
    """

    def __init__(self, description: FmuModelDescription, runs: FmuRuns, nominal: State) -> None:
        self.nominal = nominal
        self.description, self._runs = description, runs
        self._ports = description.port
        self.ports = FmuPorts(description, runs, self._run)
        self._linear: dict[Hashable, bool] = {}
        self._units: dict[Hashable, float] = {}
        self._refinements: dict[Hashable, tuple[int, float]] = {}
        self._frequencies = Memory()
        self._silent: dict[Hashable, bool] = {}
        self._free_linear: dict[Hashable, bool] = {}
        self._resting: State | None = None

    # ------------------------------------------------------------ rest

    def rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) at rest under inputs; what is not given is zero."""
        given = {name: value for name, value in loads.items() if value != 0.0}
        parts = [(Excitation("rest", name), value) for name, value in sorted(given.items())]

        def answer(values: Sequence[float]) -> FloatArray:
            names = [part.name for part, _ in parts]
            return self._rest(state, dict(zip(names, values, strict=True)))

        if not self.description.static.settle:
            key = ("rest", state, tuple(sorted(given.items())))
            return self._runs.remembered(key, lambda: answer([value for _, value in parts]))
        return self._superposed(("rest", state), answer, parts)

    def rest_with_laws(
        self, trial: str, states: list[State], loads: list[dict[str, float]], laws: Laws
    ) -> FloatArray:
        """Return the outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

        Raises
        ------
        ModelError
            If the law has no solution, or the FMU does not confirm it.
        """
        index = self._port_of(laws)
        columns, inputs = np.array(self.ports.x)[index], [self.ports.forces[number] for number in index]
        memory, before, found = None, np.zeros(len(laws)), list[FloatArray]()
        for row, (state, load) in enumerate(zip(states, loads, strict=True)):
            compliance = self.flexibility(state)[np.ix_(index, index)]
            linear = self.rest(state, load)[columns]
            for _ in range(STATIC_ITERATIONS):
                solution = solved(laws, linear[None], compliance, memory, before)
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
                    f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model "
                    f"{self.description.name!r} did not agree at load level {row + 1} of {trial!r} within "
                    f"{STATIC_ITERATIONS} iterations; the force is too strong for the FMU."
                )
            memory, before = solution.memory, linear
            found.append(values)
        return np.array(found)

    def flexibility(self, state: State) -> FloatArray:
        """Return the displacements (P, P) of the ports at rest under unit forces at each."""
        if not self.ports.forces:  # nothing to push, and loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        zero, sizes = self.rest(state, {}), map(self.ports.size, range(len(self.ports.forces)))
        moved = [
            (self.rest(state, {name: size}) - zero)[self.ports.x] / size
            for name, size in zip(self.ports.forces, sizes, strict=True)
        ]
        return np.array(moved).T

    def _port_of(self, laws: Laws) -> list[int]:
        return [[port.name for port in self._ports].index(name) for name in laws.ports]

    def _rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        table = self.description.static
        inputs = self._runs.inputs(state, loads)
        if table.settle:
            return self._runs.started(table.step, dict(state.parameters), inputs, settle=True)[1]
        only = State(state.parameters, ())
        if self._resting != only:  # inputs change from step to step, parameters need a reset
            self._runs.started(table.step, dict(state.parameters), inputs, settle=False)
            self._resting = only
        asset = self._runs.open(table.step)
        return self._runs.stepped(asset, inputs)

    # ------------------------------------------------------------ free motion

    def step(self, trial: Trial, refinement: int) -> float:
        """Return the communication step [s] of a dynamic trial: a whole part of its sampling interval."""
        if self.description.motion.step is not None:
            return self.description.motion.step
        frequency = self.angular_frequency(trial)
        return trial.interval / (ceil(frequency * trial.interval / PHASE[trial.kind]) * refinement)

    def angular_frequency(self, trial: Trial) -> float:
        """Return that of the mode that is most flexible at the first port [rad/s]; without port, the loudest.

        That of the nominal state, so that steps do not change while parameters are fitted.
        """
        if self.description.scales.angular_frequency is not None:
            return self.description.scales.angular_frequency
        key = (trial.interval, len(trial.time))
        return self._frequencies.get(key, lambda: self.measured_frequency(trial, self.nominal))

    def measured_frequency(self, trial: Trial, state: State) -> float:
        """Return what `angular_frequency` does, measured in a state at a trial's interval."""
        step = self.description.motion.step or trial.interval
        system = self.ports.system(state, step, len(trial.time)) if self._ports else None
        mode = None if system is None else system.most_flexible(self.ports.x[0], 0)
        if mode is not None:
            return mode[0]
        way = self.description.release
        if way is not None:
            kind = "displacement" if way.displacement is not None else "hold"
            size = trial.release.displacement if trial.release is not None else 1e-3
            loads: Loads = [(Excitation(kind), size)]
        else:
            name = self.ports.forces[0] if self.ports.forces else next(iter(self._runs.asset.binding.load))
            loads = [(Excitation("input", name, np.eye(1, len(trial.time)).ravel()), 1.0)]
        values = self.free(Run(state, step, len(trial.time), loads))
        moving = values - values[-len(values) // 4 :].mean(axis=0)
        spectrum = np.abs(np.fft.rfft(moving * np.hanning(len(moving))[:, None], 4 * len(moving), axis=0))
        if not np.any(spectrum):
            raise ModelError(
                f"The FMU model {self.description.name!r} does not move; state angular_frequency in [scales]."
            )
        best = int(np.argmax(spectrum[:, np.argmax(spectrum.max(axis=0))]))
        return 2.0 * np.pi * max(best, 1) / (4 * len(moving) * step)

    def free(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) without laws."""
        given = [(part, value) for part, value in run.loads if value != 0.0]
        parts = [part for part, _ in given]
        return self._superposed(
            ("free", *run[:3]),
            lambda values: self._run(run._replace(loads=list(zip(parts, values, strict=True)))),
            given,
        )

    def _run(self, run: Run) -> FloatArray:
        asset, first, histories = self._begin(run)
        return np.vstack((first, self._runs.advanced(asset, histories, run.steps)))

    def _begin(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        state, step, steps, loads = run
        parameters = dict(state.parameters)
        histories = {name: np.full(steps, value) for name, value in self._runs.inputs(state).items()}
        held: dict[str, float] = {}
        way = self.description.release
        for part, value in loads:
            if part.kind in ("displacement", "velocity"):
                amount = value if part.kind == "velocity" else self._released(state, step, value)
                parameters[self._runs.parameter(str(getattr(way, part.kind)))] = amount
            elif part.kind == "hold":
                assert way is not None
                name = self._runs.variable(str(way.hold))
                held[name] = held.get(name, 0.0) + self._released(state, step, value)
            else:
                histories[part.name][: len(part.series)] += value * part.series[:steps]
                held[part.name] = held.get(part.name, 0.0) + value * part.begin
        settle = any(value != 0.0 for value in held.values())
        asset, first = self._runs.started(step, parameters, self._runs.inputs(state, held), settle=settle)
        return asset, first, histories

    def _released(self, state: State, step: float, displacement: float) -> float:
        """Return force [N] or parameter [m] that puts the release point at a displacement [m].

        Raises
        ------
        ModelError
            If there is none.
        """
        way = self.description.release
        assert way is not None
        if way.output is None:
            return displacement
        column = self._runs.columns["release"]

        def shown(amount: float) -> float:
            def start() -> FloatArray:
                parameters, held = dict(state.parameters), {}
                if way.hold is not None:
                    held = {self._runs.variable(way.hold): amount}
                else:
                    parameters[self._runs.parameter(str(way.displacement))] = amount
                inputs = self._runs.inputs(state, held)
                return self._runs.started(step, parameters, inputs, settle=bool(held))[1]

            return float(self._runs.remembered(("released", state, amount), start)[column])

        first = displacement if way.hold is None else min(1.0, 0.1 * self._runs.input_limit(way.hold))
        if displacement == 0.0:
            return 0.0
        kind = ("free", (("hold", ""),))
        if way.hold is not None and self._linear.get(kind) and self._silent.get(kind):
            return displacement * first / shown(first)
        zero = shown(0.0)
        amount, reached = first, shown(first) - zero
        slope = reached / first
        for _ in range(20):
            if abs(reached - displacement) <= 1e-9 * abs(displacement) or slope == 0.0:
                break
            new = amount + (displacement - reached) / slope
            now = shown(new) - zero
            if new != amount and now != reached:
                slope = (now - reached) / (new - amount)
            amount, reached = new, now
        if abs(reached - displacement) <= 1e-6 * abs(displacement):
            return amount
        raise ModelError(
            f"Nothing that [release] names puts {way.output!r} of the FMU model "
            f"{self.description.name!r} at {displacement:g} m; correct displacement, hold or output there."
        )

    def _superposed(
        self, key: tuple[Hashable, ...], answer: Callable[[Sequence[float]], FloatArray], loads: Loads
    ) -> FloatArray:
        """Return the answer to loads, put together from answers to units where that is proven to be right."""
        kind = (key[0], tuple((part.kind, part.name) for part, _ in loads))

        def asked(values: Sequence[float]) -> FloatArray:
            full = (key, tuple((part.key, value) for (part, _), value in zip(loads, values, strict=True)))
            return self._runs.remembered(full, lambda: answer(values))

        if not loads or not self.description.superposition or self._linear.get(kind) is False:
            return asked([value for _, value in loads])
        units = [
            self._units.setdefault((part.kind, part.name), 2.0 ** round(log2(abs(value))))
            for part, value in loads
        ]

        def unit(number: int) -> FloatArray:
            one = [size * (k == number) for k, size in enumerate(units)]
            return self._runs.remembered((key, "unit", loads[number][0].key), lambda: answer(one))

        parts = [unit(number) for number in range(len(loads))]
        if self._silent.get(kind):  # an FMU that shows nothing without excitation, at any parameters
            zero = np.zeros_like(parts[0])
        else:
            zero = self._runs.remembered((key, "zero"), lambda: answer([0.0] * len(loads)))
            self._silent.setdefault(kind, not np.any(zero))
        moved, result = [part - zero for part in parts], zero.copy()
        if kind not in self._linear:  # half of all excitations gives half of the sum of what each gives
            half = answer([0.5 * size for size in units]) - zero
            size = np.atleast_2d(np.sum(np.abs(moved), axis=0)).max(axis=0)
            allowed = LINEAR * size + 1e-12 * np.atleast_2d(np.abs(zero)).max(axis=0)
            self._linear[kind] = bool(np.all(np.abs(half - 0.5 * np.sum(moved, axis=0)) <= allowed))
            if not self._linear[kind]:
                return asked([value for _, value in loads])
        for (_, value), unit_size, part in zip(loads, units, moved, strict=True):
            result += value / unit_size * part
        return result

    # ------------------------------------------------------------ laws

    def with_laws(
        self, laws: Laws, excite: Excite, trial: Trial, refinement: int, seen: Sequence[int]
    ) -> tuple[FloatArray, float]:
        """Return the outputs (K, C) of a dynamic trial with laws at ports, and the step [s].

        Steps are halved until that changes no column of `seen` by more than `CONVERGED` of its largest motion
        (rms), nor the displacement of a port; what was enough is kept for laws of this kind up to twice as
        strong. An accelerometer that nobody reads would ask for steps many times smaller.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        if self.description.motion.step is not None:
            run = excite(1)
            return self._coupled(laws, run), run.step
        strength = float(np.max(np.abs(laws.values[:, 0])))
        exponents = np.round(np.clip(laws.values[:, 1:3], -9.0, 9.0), 1)  # what is rough needs shorter steps
        watched = sorted({*seen, *self.ports.x})
        kinds = laws.ports, laws.numbers.tobytes(), exponents.tobytes()
        key = (tuple(watched), trial.kind, trial.interval, *kinds)
        known, tried = self._refinements.get(key, (1, 0.0))
        if strength > 2.0 * tried:
            known = self._converged(laws, excite, known, watched)
            self._refinements[key] = (known, strength)
        refinement *= known
        run = excite(refinement)
        return self._coupled(laws, run, refinement), run.step

    def _converged(self, laws: Laws, excite: Excite, begin: int, watched: Sequence[int]) -> int:
        refinement, change, coarse = begin, np.inf, self._coupled(laws, excite(begin), begin)
        while refinement <= MOST_REFINEMENT:
            run = excite(2 * refinement)
            fine = self._coupled(laws, run, 2 * refinement)
            shared = fine[::2, watched][: len(coarse)]
            with np.errstate(all="ignore"):  # an unstable coupling grows beyond all numbers
                size = np.max(np.abs(shared - shared.mean(axis=0)), axis=0)
                difference = np.sqrt(np.mean((coarse[: len(shared), watched] - shared) ** 2, axis=0))
                change = float(np.max(difference / np.where(size > 0.0, size, np.inf)))
            if not np.isfinite(difference).all():
                change = np.inf
            if change <= CONVERGED:
                return refinement
            refinement, coarse = 2 * refinement, fine
        raise ModelError(
            f"The internal force at {', '.join(dict.fromkeys(laws.ports))} does not converge in the "
            f"co-simulation with the FMU model {self.description.name!r}: halving steps of "
            f"{2.0 * run.step:.2g} s still changes the motion by {change:.1g} of its size; the force is too "
            f"stiff for the port."
        )

    def _coupled(self, laws: Laws, run: Run, refinement: int = 1) -> FloatArray:
        free = self._refined_free(run, refinement)
        port_of = self._port_of(laws)
        system = self.ports.system(run.state, run.step, run.steps, refinement)
        if system is None:
            return self._stepped(laws, port_of, run, free)
        key = ("velocity", *run[:3], tuple((part.key, value) for part, value in run.loads))
        grid = run.step * np.arange(run.steps + 1)
        velocity = self._runs.remembered(
            key, lambda: np.asarray(CubicSpline(grid, free[:, self.ports.x])(grid, 1))
        ).copy()
        for number, column in enumerate(self.ports.v):
            if column >= 0:
                velocity[:, number] = free[:, column]
        rows = system.port_rows(self.ports.x, self.ports.v)
        with np.errstate(all="ignore"):
            states, applied = coupled_motion(system, rows, free[:, self.ports.x], velocity, laws, port_of)
            return free + system.seen(states, applied)

    def _refined_free(self, run: Run, refinement: int) -> FloatArray:
        """Return the free motion with small steps; of a release by the ports' system if that has it all."""
        loads = [(part, value) for part, value in run.loads if value != 0.0]
        kind = tuple((part.kind, part.name) for part, _ in loads)
        fine = self.ports.system(run.state, run.step, run.steps, refinement)
        parts = self.ports.parts(run.step * refinement)
        ratio = refinement // parts
        possible = (
            all(name in ("displacement", "velocity", "hold") for name, _ in kind)
            and self.ports.quiet
            and self._linear.get(("free", kind)) is True
            and self._free_linear.get(kind, True)
        )
        if fine is None or ratio < 2 or not loads or not possible:
            return self.free(run)
        larger = run._replace(step=run.step * refinement / parts, steps=ceil(run.steps / ratio))
        moved = []
        for part, value in loads:
            size = self._units[part.kind, part.name]
            one = larger._replace(loads=[(part, size)])
            unit = self._runs.remembered(
                ("refined", *run[:3], refinement, part.key, size),
                partial(self._continued, one, fine, run.steps, parts),
            )
            if not len(unit):
                self._free_linear[kind] = False
                return self.free(run)
            moved.append(value / size * unit)
        return np.asarray(sum(moved))

    def _continued(self, larger: Run, fine: PortSystem, steps: int, parts: int) -> FloatArray:
        """Return a release by the system of small steps, from its own with larger ones; else nothing."""
        base = self.ports.system(larger.state, larger.step, larger.steps, parts)
        coarse = self.free(larger)
        start = None if base is None else base.start_of(coarse, LINEAR)
        return np.zeros(0) if start is None else np.vstack((coarse[:1], fine.free(start, steps)[1:]))

    def _stepped(self, laws: Laws, port_of: list[int], run: Run, free: FloatArray) -> FloatArray:
        """Return the outputs of the FMU stepped with the laws beside it."""
        without = [self._ports[p].name for p in port_of if self.ports.v[p] < 0]
        if without:
            raise ModelError(
                f"The FMU model {self.description.name!r} is not linear, so its port {without[0]!r} needs a "
                f"velocity output; name it in [[port]]."
            )
        gain = self._runs.remembered(
            ("gain", *run[:2]), lambda: self.ports.records(run.state, run.step, 1)[0]
        )[self.ports.v]
        forces = stepper(laws, port_of, gain, run.step, free[:2, self.ports.x], free[:2, self.ports.v])
        asset, first, histories = self._begin(run)
        values = np.empty((run.steps + 1, len(first)))
        values[0] = first
        names = list(histories)
        rows = np.column_stack([histories[name] for name in names])
        at = [names.index(name) for name in self.ports.forces]
        for k in range(run.steps):
            now = rows[k].copy()
            np.add.at(now, at, forces(values[k, self.ports.x], values[k, self.ports.v]))
            values[k + 1] = self._runs.stepped(asset, dict(zip(names, now.tolist(), strict=True)))
        return values
