"""Rest and motion of an FMU: superposed where it proves to be linear, stepped with the laws where not."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from math import ceil, log2

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from discrepancy.campaign import Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_runs import FmuRuns, is_affine
from discrepancy.models.port_coupling import LawStepper, PortMotion, coupled_motion
from discrepancy.models.port_system import PortSystem, port_system
from fe.motion import Laws
from fmu_asset.session import FmiAsset

FloatArray = NDArray[np.float64]

PHASE = {TrialKind.RINGDOWN: 0.1, TrialKind.FORCED: 0.05}
"""Longest communication step without laws: radians of the first mode."""
LINEAR = 1e-6
"""Largest deviation from superposition, as a share of the motion, of an FMU that is taken as linear."""
CONVERGED = 1e-4
"""Largest rms change of a motion with laws when steps are halved, as a share of the largest motion."""
MOST_REFINEMENT = 64
"""Steps that do not converge at this refinement are given up."""
RECORD = 600
"""Steps of the answer to a port's force that are recorded."""
KEPT_SYSTEMS = 64


@dataclass(frozen=True)
class State:
    """Parameters and constant inputs of a run, sorted by name; by keys of the binding and the FMU's names."""

    parameters: tuple[tuple[str, float], ...]
    inputs: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Excitation:
    """What moves the FMU, per unit of a factor.

    Attributes
    ----------
    kind : str
        "displacement", "velocity": parameters of the release; "hold": a force is let go that had brought the
        release point to the displacement; "input": an input.
    name : str
        The input.
    series : (N,) ndarray
        Its values, each held over a step.
    begin : float
        Its value before the motion, under which the FMU is at rest.
    """

    kind: str
    name: str = ""
    series: FloatArray = field(default_factory=lambda: np.zeros(0))
    begin: float = 0.0

    @property
    def key(self) -> Hashable:
        """What tells it from others."""
        return self.kind, self.name, blake2b(self.series.tobytes(), digest_size=16).digest(), self.begin


Loads = Sequence[tuple[Excitation, float]]
Excite = Callable[[int], tuple[float, int, list[tuple[Excitation, float]]]]


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
        self._description, self._runs = description, runs
        self._ports = description.port
        self._forces = [runs.variable(port.force) for port in self._ports]
        self._x = [runs.columns[f"port.{port.name}.displacement"] for port in self._ports]
        self._v = [runs.columns.get(f"port.{port.name}.velocity", -1) for port in self._ports]
        self._zero_inputs = dict.fromkeys(runs.asset.binding.load, 0.0)
        self._linear: dict[Hashable, bool] = {}
        self._units: dict[Hashable, float] = {}
        self._systems: OrderedDict[Hashable, PortSystem | None] = OrderedDict()
        self._refinements: dict[Hashable, tuple[int, float]] = {}
        self._frequencies: dict[Hashable, float] = {}
        self._port_linear: bool | None = None
        self._refinable: bool | None = None
        self._silent: dict[Hashable, bool] = {}
        self._quiet = False
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

        if not self._description.static.settle:
            key = ("rest", state, tuple(sorted(given.items())))
            return self._runs.remembered(key, lambda: answer([value for _, value in parts]))
        return self._superposed(("rest", state), answer, parts)

    def _rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        table = self._description.static
        inputs = self._zero_inputs | dict(state.inputs) | dict(loads)
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
        if self._description.motion.step is not None:
            return self._description.motion.step
        frequency = self.angular_frequency(trial)
        return trial.interval / (ceil(frequency * trial.interval / PHASE[trial.kind]) * refinement)

    def angular_frequency(self, trial: Trial) -> float:
        """Return that of the mode that is most flexible at the first port [rad/s]; without port, the loudest.

        That of the nominal state, so that steps do not change while parameters are fitted.
        """
        if self._description.scales.angular_frequency is not None:
            return self._description.scales.angular_frequency
        key = (trial.interval, len(trial.time))
        if key not in self._frequencies:
            self._frequencies[key] = self.measured_frequency(trial, self.nominal)
        return self._frequencies[key]

    def measured_frequency(self, trial: Trial, state: State) -> float:
        """Return what `angular_frequency` does, measured in a state at a trial's interval."""
        step = self._description.motion.step or trial.interval
        system = self.system(state, step, len(trial.time)) if self._ports else None
        if system is not None:
            frequency, shape = system.modes(system.outputs[self._x[0]], 0)
            if len(frequency):
                return float(frequency[np.argmax(shape / frequency**2)])
        way = self._description.release
        if way is not None:
            kind = "displacement" if way.displacement is not None else "hold"
            size = trial.release.displacement if trial.release is not None else 1e-3
            loads: Loads = [(Excitation(kind), size)]
        else:
            name = self._forces[0] if self._forces else next(iter(self._zero_inputs))
            loads = [(Excitation("input", name, np.eye(1, len(trial.time)).ravel()), 1.0)]
        values = self.free(state, step, len(trial.time), loads)
        moving = values - values[-len(values) // 4 :].mean(axis=0)
        spectrum = np.abs(np.fft.rfft(moving * np.hanning(len(moving))[:, None], 4 * len(moving), axis=0))
        if not np.any(spectrum):
            raise ModelError(
                f"The FMU model {self._description.name!r} does not move; state angular_frequency in "
                "[scales]."
            )
        best = int(np.argmax(spectrum[:, np.argmax(spectrum.max(axis=0))]))
        return 2.0 * np.pi * max(best, 1) / (4 * len(moving) * step)

    def free(self, state: State, step: float, steps: int, loads: Loads) -> FloatArray:
        """Return the outputs (steps + 1, C) without laws."""
        given = [(part, value) for part, value in loads if value != 0.0]
        parts = [part for part, _ in given]
        return self._superposed(
            ("free", state, step, steps),
            lambda values: self._run(state, step, steps, list(zip(parts, values, strict=True))),
            given,
        )

    def _run(self, state: State, step: float, steps: int, loads: Loads) -> FloatArray:
        asset, first, histories = self._begin(state, step, steps, loads)
        return np.vstack((first, self._runs.advanced(asset, histories, steps)))

    def _begin(
        self, state: State, step: float, steps: int, loads: Loads
    ) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        parameters = dict(state.parameters)
        histories: dict[str, FloatArray] = {
            name: np.full(steps, value) for name, value in (self._zero_inputs | dict(state.inputs)).items()
        }
        held: dict[str, float] = {}
        way = self._description.release
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
        inputs = self._zero_inputs | dict(state.inputs)
        for name, value in held.items():
            inputs[name] = inputs.get(name, 0.0) + value
        settle = any(value != 0.0 for value in held.values())
        asset, first = self._runs.started(step, parameters, inputs, settle=settle)
        return asset, first, histories

    def _released(self, state: State, step: float, displacement: float) -> float:
        """Return force [N] or parameter [m] that puts the release point at a displacement [m].

        Raises
        ------
        ModelError
            If there is none.
        """
        way = self._description.release
        assert way is not None
        if way.output is None:
            return displacement
        column = self._runs.columns["release"]
        inputs = self._zero_inputs | dict(state.inputs)
        parameters = dict(state.parameters)

        def shown(amount: float) -> float:
            def start() -> FloatArray:
                if way.hold is not None:
                    name = self._runs.variable(way.hold)
                    given = inputs | {name: inputs[name] + amount}
                    return self._runs.started(step, parameters, given, settle=True)[1]
                key = self._runs.parameter(str(way.displacement))
                return self._runs.started(step, parameters | {key: amount}, inputs, settle=False)[1]

            return float(self._runs.remembered(("released", state, amount), start)[column])

        first = displacement if way.hold is None else min(1.0, 0.1 * self._runs.input_limit(way.hold))
        if displacement == 0.0:
            return 0.0
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
            f"{self._description.name!r} at {displacement:g} m; correct displacement, hold or output there."
        )

    def _superposed(
        self, key: Hashable, answer: Callable[[Sequence[float]], FloatArray], loads: Loads
    ) -> FloatArray:
        """Return the answer to loads, put together from answers to units where that is proven to be right."""
        names = tuple((part.kind, part.name) for part, _ in loads)
        kind = (key[0], names) if isinstance(key, tuple) else names

        def asked(values: Sequence[float]) -> FloatArray:
            full = (key, tuple((part.key, value) for (part, _), value in zip(loads, values, strict=True)))
            return self._runs.remembered(full, lambda: answer(values))

        if not loads or not self._description.superposition or self._linear.get(kind) is False:
            return asked([value for _, value in loads])
        units = [
            self._units.setdefault((part.kind, part.name), 2.0 ** round(log2(abs(value))))
            for part, value in loads
        ]

        def unit(number: int, factor: float = 1.0) -> FloatArray:
            part = loads[number][0]
            full = (key, "unit", part.key, factor)
            return self._runs.remembered(
                full, lambda: answer([factor * units[k] * (k == number) for k in range(len(loads))])
            )

        parts = [unit(number) for number in range(len(loads))]
        if self._silent.get(kind):  # an FMU that shows nothing without excitation, at any parameters
            zero = np.zeros_like(parts[0])
        else:
            zero = self._runs.remembered((key, "zero"), lambda: answer([0.0] * len(loads)))
            self._silent.setdefault(kind, not np.any(zero))
        if kind not in self._linear:
            half = answer([0.5 * size for size in units])
            self._linear[kind] = is_affine(zero, parts, half, LINEAR)
            if not self._linear[kind]:
                return asked([value for _, value in loads])
        result = zero.copy()
        for (_, value), size, part in zip(loads, units, parts, strict=True):
            result += value / size * (part - zero)
        return result

    # ------------------------------------------------------------ ports

    def system(self, state: State, step: float, steps: int, refinement: int = 1) -> PortSystem | None:
        """Return what forces at the ports do in a linear FMU; None if it is not linear.

        Where the FMU confirms it once, the system of a `refinement` is computed from that of the larger step.
        """
        if not self._description.superposition or self._port_linear is False:
            return None
        key = (state, step)
        if refinement > 1 and self._refinable is not False and key not in self._systems:
            base = self.system(state, step * refinement, ceil(steps / refinement))
            if base is not None:
                self._systems[key] = finer = base.refined(refinement)
                if self._refinable is None:
                    self._refinable = self._confirmed(finer, state, step, max(min(steps, RECORD), 64))
                    if not self._refinable:
                        del self._systems[key]
        if key in self._systems:
            self._systems.move_to_end(key)
            return self._systems[key]
        count = max(min(steps, RECORD), 64)
        records = self._records(state, step, count)
        system = port_system(records, self._x, step)
        if system is not None and self._port_linear is None:
            self._port_linear = self._confirmed(system, state, step, count)
            system = system if self._port_linear else None
        self._systems[key] = system
        if len(self._systems) > KEPT_SYSTEMS:
            self._systems.popitem(last=False)
        return system

    def _size(self, number: int) -> float:
        return min(1.0, 0.1 * self._runs.input_limit(self._ports[number].force))

    def _records(self, state: State, step: float, count: int) -> FloatArray:
        """Return the outputs (count, C, P) after unit forces over the first step, less those without."""
        zero: FloatArray | float = 0.0
        if not self._quiet:
            zero = self._run(state, step, count, [])
            self._quiet = not np.any(zero)
        pulse = np.eye(1, count).ravel()
        parts = []
        for number, name in enumerate(self._forces):
            size = self._size(number)
            moved = self._run(state, step, count, [(Excitation("input", name, pulse), size)])
            parts.append((moved - zero)[1:] / size)
        return np.stack(parts, axis=2)

    def _confirmed(self, system: PortSystem, state: State, step: float, count: int) -> bool:
        """Whether the FMU answers to many forces as the system says that was made of single ones."""
        signs = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self._ports)))
        sizes = np.array([self._size(number) for number in range(len(self._ports))])
        loads = [
            (Excitation("input", name, signs[:, number].copy()), float(sizes[number]))
            for number, name in enumerate(self._forces)
        ]
        moved = self._run(state, step, count, loads) - self._run(state, step, count, [])
        expected = system.motion(signs * sizes)
        error = np.max(np.abs(moved - expected), axis=0)
        return bool(np.all(error <= LINEAR * np.max(np.abs(moved), axis=0) + 1e-300))

    def stiffness(self, number: int, state: State, step: float) -> tuple[float, float]:
        """Return the stiffness of the first mode and the one at rest at a port [N/m or N m/rad]."""
        system = self.system(state, step, RECORD)
        column = self._x[number]
        if system is None:
            size = self._size(number)
            inputs = self._zero_inputs | dict(state.inputs)
            still = [
                self._runs.started(
                    step, dict(state.parameters),
                    inputs | {self._forces[number]: inputs[self._forces[number]] + force}, settle=True,
                )[1][column]
                for force in (0.0, size)
            ]  # fmt: skip
            stiffness = size / float(still[1] - still[0])
            return stiffness, stiffness
        at_rest = 1.0 / float(system.gain()[column, number])
        frequency, shape = system.modes(system.outputs[column], number)
        if not len(frequency) or np.max(shape / frequency**2) * at_rest < 1e-6:
            return at_rest, at_rest
        first = int(np.argmax(shape / frequency**2))
        return float(frequency[first] ** 2 / shape[first]), at_rest

    # ------------------------------------------------------------ laws

    def with_laws(
        self, laws: Laws, excite: Excite, trial: Trial, state: State, refinement: int
    ) -> tuple[FloatArray, float]:
        """Return the outputs (K, C) of a dynamic trial with laws at ports, and the step [s].

        Steps are halved until that changes no output by more than `CONVERGED` of its largest motion (rms);
        what was enough is kept for laws of this kind up to twice as strong.

        Raises
        ------
        ModelError
            If the steps do not converge.
        """
        if self._description.motion.step is not None:
            step, steps, loads = excite(1)
            return self._coupled(laws, state, step, steps, loads), step
        strength = float(np.max(np.abs(laws.values[:, 0])))
        exponents = np.round(np.clip(laws.values[:, 1:3], -9.0, 9.0), 1)  # what is rough needs shorter steps
        key = (trial.kind, trial.interval, laws.ports, laws.codes.tobytes(), exponents.tobytes())
        known, tried = self._refinements.get(key, (1, 0.0))
        if strength > 2.0 * tried:
            known = self._converged(laws, excite, state, known)
            self._refinements[key] = (known, strength)
        refinement *= known
        step, steps, loads = excite(refinement)
        return self._coupled(laws, state, step, steps, loads, refinement), step

    def _converged(self, laws: Laws, excite: Excite, state: State, begin: int) -> int:
        refinement, change, coarse = begin, np.inf, None
        while refinement <= MOST_REFINEMENT:
            step, steps, loads = excite(refinement)
            if coarse is None:
                coarse = self._coupled(laws, state, step, steps, loads, refinement)
            step, steps, loads = excite(2 * refinement)
            fine = self._coupled(laws, state, step, steps, loads, 2 * refinement)
            shared = fine[::2][: len(coarse)]
            with np.errstate(all="ignore"):  # an unstable coupling grows beyond all numbers
                size = np.max(np.abs(shared - shared.mean(axis=0)), axis=0)
                difference = np.sqrt(np.mean((coarse[: len(shared)] - shared) ** 2, axis=0))
                change = float(np.max(difference / np.where(size > 0.0, size, np.inf)))
            if not np.isfinite(difference).all():
                change = np.inf
            if change <= CONVERGED:
                return refinement
            refinement, coarse = 2 * refinement, fine
        raise ModelError(
            f"The internal force at {', '.join(dict.fromkeys(laws.ports))} does not converge in the "
            f"co-simulation with the FMU model {self._description.name!r}: halving steps of "
            f"{2.0 * step:.2g} s still changes the motion by {change:.1g} of its size; the force is too "
            f"stiff for the port."
        )

    def _coupled(
        self, laws: Laws, state: State, step: float, steps: int, loads: Loads, refinement: int = 1
    ) -> FloatArray:
        free = self._refined_free(state, step, steps, loads, refinement)
        port_of = [[port.name for port in self._ports].index(name) for name in laws.ports]
        system = self.system(state, step, steps, refinement)
        if system is None:
            return self._stepped(laws, port_of, state, step, steps, loads, free)
        x_rows, x_direct = system.outputs[self._x], system.direct[self._x]
        v_rows, v_direct, velocity = (
            x_rows @ system.generator,
            np.zeros_like(x_direct),
            np.empty((steps + 1, 0)),
        )
        grid = step * np.arange(steps + 1)
        velocity = CubicSpline(grid, free[:, self._x])(grid, 1)
        for number, column in enumerate(self._v):
            if column >= 0:
                v_rows[number], v_direct[number] = system.outputs[column], system.direct[column]
                velocity[:, number] = free[:, column]
        gain = v_rows @ system.drive + v_direct
        motion = PortMotion(free[:, self._x], velocity, gain)
        with np.errstate(all="ignore"):
            states, applied = coupled_motion(
                system, motion, x_rows, x_direct, v_rows, v_direct, laws, port_of
            )
            return free + system.seen(states, applied)

    def _refined_free(
        self, state: State, step: float, steps: int, loads: Loads, refinement: int
    ) -> FloatArray:
        """Return the free motion with small steps; of a release by the ports' system if that has it all."""
        loads = [(part, value) for part, value in loads if value != 0.0]
        kind = tuple(part.kind for part, _ in loads)
        kind_names = tuple((part.kind, part.name) for part, _ in loads)
        released = all(name in ("displacement", "velocity", "hold") for name in kind)
        possible = (
            refinement > 1 and released and self._quiet and self._linear.get(("free", kind_names)) is True
        )
        if not possible or not self._free_linear.get(kind, True):
            return self.free(state, step, steps, loads)
        result = np.zeros(0)
        for part, value in loads:
            size = self._units[part.kind, part.name]

            def moved(part: Excitation = part, size: float = size) -> FloatArray:
                base = self.system(state, step * refinement, ceil(steps / refinement))
                fine = self.system(state, step, steps, refinement)
                if base is None or fine is None or not self._refinable:
                    return np.zeros(0)
                coarse = self.free(state, step * refinement, ceil(steps / refinement), [(part, size)])
                start = base.start_of(coarse, LINEAR)
                return np.zeros(0) if start is None else fine.free(start, steps)

            unit = self._runs.remembered(("refined", state, step, steps, refinement, part.key, size), moved)
            if not len(unit):
                self._free_linear[kind] = False
                return self.free(state, step, steps, loads)
            result = value / size * unit if not len(result) else result + value / size * unit
        if len(result):
            return result
        return self.free(state, step, steps, loads)

    def _stepped(
        self,
        laws: Laws,
        port_of: list[int],
        state: State,
        step: float,
        steps: int,
        loads: Loads,
        free: FloatArray,
    ) -> FloatArray:
        """Return the outputs of the FMU stepped with the laws beside it."""
        without = [self._ports[p].name for p in port_of if self._v[p] < 0]
        if without:
            raise ModelError(
                f"The FMU model {self._description.name!r} is not linear, so its port {without[0]!r} needs a "
                f"velocity output; name it in [[port]]."
            )
        key = ("gain", state, step)
        gain = self._runs.remembered(key, lambda: self._records(state, step, 1)[0])[self._v]
        push = (free[1] - free[0])[self._v] / step
        stepper = LawStepper(laws, port_of, gain, step, free[0, self._x], push)
        asset, first, histories = self._begin(state, step, steps, loads)
        values = np.empty((steps + 1, len(first)))
        values[0] = first
        names = list(histories)
        rows = np.column_stack([histories[name] for name in names])
        at = [names.index(name) for name in self._forces]
        for k in range(steps):
            now = rows[k].copy()
            np.add.at(now, at, stepper.forces(values[k, self._x], values[k, self._v]))
            values[k + 1] = self._runs.stepped(asset, dict(zip(names, now.tolist(), strict=True)))
        return values
