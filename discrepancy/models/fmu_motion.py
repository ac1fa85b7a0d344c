"""Motion of an FMU without laws at its ports, and what forces there do, as a system where it is linear."""

from collections.abc import Callable, Hashable, Mapping, Sequence
from functools import cached_property
from math import ceil, log2

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Loads, Run, State
from discrepancy.models.interface import Response
from discrepancy.models.memory import Memory
from discrepancy.models.port_system import LINEAR, PortSystem, port_system
from fmu_asset.door.session import FmiAsset

PHASE = {TrialKind.RINGDOWN: 0.1, TrialKind.FORCED: 0.05}
"""Longest communication step without laws: radians of the first mode."""
RECORD = 600
"""Steps of the answer to a port's force that are recorded."""
KEPT_SYSTEMS = 64
SAFE_TURN = 0.8 * np.pi
"""Turn of a mode in a step up to which it does not become half a circle as parameters change [rad]."""
MOST_PARTS = 16
"""Parts of a step at which the system of the ports is looked for."""
SAME_PACE = 1e-2
"""A mode that turns by more than half a circle in a step looks like a slower one there: half the step tells
by more than this share of the motion."""

SLOPES = (
    np.array(
        [
            [-25, 48, -36, 16, -3],
            [-3, -10, 18, -6, 1],
            [1, -8, 0, 8, -1],
            [-1, 6, -18, 10, 3],
            [3, -16, 36, -48, 25],
        ]
    )
    / 12.0
)
"""Weights by which five values on an even grid give the slope at each of them, of fourth order."""


class FmuMotion:
    """Rest and motion of an FMU, superposed where it proves to be linear, and what forces at its ports do.

    Parameters
    ----------
    runs : FmuRuns
        The FMU.
    nominal : State
        Of motions, at the means of the parameters.

    Attributes
    ----------
    forces : list of str
        Inputs of the ports' forces.
    x, v : list of int
        Columns of the ports' displacements and velocities; -1: there is no velocity.
    """

    def __init__(self, runs: FmuRuns, nominal: State) -> None:
        self.runs, self._nominal, self._description = runs, nominal, runs.description
        ports = runs.description.port
        self.forces = [runs.variable(port.force) for port in ports]
        self.x = [runs.columns[f"port.{port.name}.displacement"] for port in ports]
        self.v = [runs.columns.get(f"port.{port.name}.velocity", -1) for port in ports]
        self._linear, self._silent = dict[Hashable, bool](), dict[Hashable, bool]()
        self._units = dict[Hashable, float]()
        self._resting: State | None = None
        self._quiet = False  # whether it was seen to show nothing without excitation
        self._parts: dict[float, int] = {}
        self._systems, self._frequencies = Memory(KEPT_SYSTEMS), Memory()
        self._proven: bool | None = None  # whether its ports are those of a linear system

    def rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) at rest under inputs; what is not given is zero."""
        given = [(Excitation("rest", name), value) for name, value in sorted(loads.items())]
        return self._superposed(
            ("rest", state),
            lambda loads: self._rest(state, {part.name: value for part, value in loads}),
            given,
            self._description.static.settle,
        )

    def _rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        table = self._description.static
        inputs = self.runs.inputs(state, loads)
        if table.settle:
            return self.runs.started(table.step, dict(state.parameters), inputs, settle=True)[1]
        only = State(state.parameters, ())
        if self._resting != only:  # inputs change from step to step, parameters need a reset
            self.runs.started(table.step, dict(state.parameters), inputs, settle=False)
            self._resting = only
        asset = self.runs.open(table.step)
        return self.runs.stepped(asset, inputs)

    def free(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion."""
        return self._superposed(
            ("free", *run[:3]), lambda loads: self.stepped(run._replace(loads=loads)), run.loads
        )

    def stepped(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion by the FMU itself."""
        asset, first, histories = self.begin(run)
        return np.vstack((first, self.runs.advanced(asset, histories, run.steps)))

    def begin(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        state, step, steps, loads = run
        parameters = dict(state.parameters)
        histories = {name: np.full(steps, value) for name, value in self.runs.inputs(state).items()}
        held: dict[str, float] = {}
        way = self._description.release
        for part, value in loads:
            if part.kind in ("displacement", "velocity"):
                amount = value if part.kind == "velocity" else self._released(state, step, value)
                parameters[self.runs.parameter(str(getattr(way, part.kind)))] = amount
            elif part.kind == "hold":
                assert way is not None
                name = self.runs.variable(str(way.hold))
                held[name] = held.get(name, 0.0) + self._released(state, step, value)
            else:
                histories[part.name][: len(part.series)] += value * part.series[:steps]
                held[part.name] = held.get(part.name, 0.0) + value * part.begin
        settle = any(value != 0.0 for value in held.values())
        asset, first = self.runs.started(step, parameters, self.runs.inputs(state, held), settle=settle)
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
        column = self.runs.columns["release"]

        def shown(amount: float) -> float:
            def start() -> FloatArray:
                parameters, held = dict(state.parameters), {}
                if way.hold is not None:
                    held = {self.runs.variable(way.hold): amount}
                else:
                    parameters[self.runs.parameter(str(way.displacement))] = amount
                inputs = self.runs.inputs(state, held)
                return self.runs.started(step, parameters, inputs, settle=bool(held))[1]

            return float(self.runs.remembered(("released", state, amount), start)[column])

        first = displacement if way.hold is None else min(1.0, 0.1 * self.runs.input_limit(way.hold))
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
            f"{self._description.name!r} at {displacement:g} m; correct displacement, hold or output there."
        )

    def _superposed(
        self,
        key: tuple[Hashable, ...],
        answer: Callable[[Loads], FloatArray],
        loads: Loads,
        possible: bool = True,
    ) -> FloatArray:
        """Return the answer to loads, put together from answers to units where that is proven to be right."""
        parts = [part for part, value in loads if value != 0.0]
        values = [value for _, value in loads if value != 0.0]
        kind = (key[0], tuple((part.kind, part.name) for part in parts))

        def asked(values: Sequence[float]) -> FloatArray:
            given = list(zip(parts, values, strict=True))
            full = tuple((part.key, value) for part, value in given if value != 0.0)
            return self.runs.remembered((key, full or kind), lambda: answer(given))

        if not (possible and parts and self._description.superposition) or self._linear.get(kind) is False:
            return asked(values)
        units = [
            self._units.setdefault((part.kind, part.name), 2.0 ** round(log2(abs(value))))
            for part, value in zip(parts, values, strict=True)
        ]
        moved = [asked(one) for one in np.diag(units).tolist()]
        zero = np.zeros_like(moved[0])
        if not self._silent.get(kind):  # an FMU that shows nothing without excitation does so always
            zero = asked([0.0] * len(parts))
            self._silent.setdefault(kind, not np.any(zero))
        moved, result = [part - zero for part in moved], zero.copy()
        if kind not in self._linear:  # half of all excitations gives half of the sum of what each gives
            half = asked([0.5 * size for size in units]) - zero
            size = np.atleast_2d(np.sum(np.abs(moved), axis=0)).max(axis=0)
            allowed = LINEAR * size + 1e-12 * np.atleast_2d(np.abs(zero)).max(axis=0)
            self._linear[kind] = bool(np.all(np.abs(half - 0.5 * np.sum(moved, axis=0)) <= allowed))
            if not self._linear[kind]:
                return asked(values)
        for value, unit, part in zip(values, units, moved, strict=True):
            result += value / unit * part
        return result

    # ------------------------------------------------------------ pace

    def step(self, trial: Trial, refinement: int = 1) -> float:
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
        return self._frequencies.get(key, lambda: self.measured_frequency(trial, self._nominal))

    def measured_frequency(self, trial: Trial, state: State) -> float:
        """Return what `angular_frequency` does, measured in a state at a trial's interval."""
        step = self._description.motion.step or trial.interval
        system = self.system(state, step, len(trial.time))
        mode = None if system is None else system.most_flexible(self.x[0], 0)
        if mode is not None:
            return mode[0]
        way = self._description.release
        if way is not None:
            kind = "displacement" if way.displacement is not None else "hold"
            size = trial.release.displacement if trial.release is not None else 1e-3
            loads: Loads = [(Excitation(kind), size)]
        else:
            name = self.forces[0] if self.forces else next(iter(self.runs.asset.binding.load))
            loads = [(Excitation("input", name, np.eye(1, len(trial.time)).ravel()), 1.0)]
        values = self.free(Run(state, step, len(trial.time), loads))
        moving = values - values[-len(values) // 4 :].mean(axis=0)
        spectrum = np.abs(np.fft.rfft(moving * np.hanning(len(moving))[:, None], 4 * len(moving), axis=0))
        if not np.any(spectrum):
            raise ModelError(
                f"The FMU model {self._description.name!r} does not move; state angular_frequency in "
                "[scales]."
            )
        best = int(np.argmax(spectrum[:, np.argmax(spectrum.max(axis=0))]))
        return 2.0 * np.pi * max(best, 1) / (4 * len(moving) * step)

    # ------------------------------------------------------------ the system

    def system(self, state: State, step: float, steps: int) -> PortSystem | None:
        """Return what forces at the ports do in a linear FMU; None if it is not linear.

        Made from answers over steps [s], or over parts of them where a mode turns by half a circle in one.
        """
        if not (self._description.superposition and self.forces) or self._proven is False:
            return None
        return self._systems.get((state, step), lambda: self._found(state, step, steps))

    def _found(self, state: State, step: float, steps: int) -> PortSystem | None:
        count = max(min(steps, RECORD), 64)
        known, fixed = step in self._parts, self._description.motion.step is not None
        parts = self._parts.get(step, 1)
        while parts <= MOST_PARTS:
            part = step / parts
            found = port_system(self.records(state, part, count), self.x, part)
            if found is not None and self._proven is None:
                self._proven = self._confirmed(found, state, part, count, LINEAR)
            if found is None or not self._proven:
                return None
            safe = found.fastest * part <= SAFE_TURN
            if fixed or (safe and (known or self._confirmed(found, state, 0.5 * part, count, SAME_PACE))):
                self._parts[step] = parts
                return found
            parts *= 2
        return None

    @cached_property
    def sizes(self) -> FloatArray:
        """Forces (P,) at the ports that their inputs can have."""
        return np.array([min(1.0, 0.1 * self.runs.input_limit(name)) for name in self.forces])

    def records(self, state: State, step: float, count: int) -> FloatArray:
        """Return the outputs (count, C, P) after unit forces over the first step, less those without."""
        zero: FloatArray | float = 0.0
        if not self._quiet:
            zero = self.stepped(Run(state, step, count, []))
            self._quiet = not np.any(zero)
        pulse, parts = np.eye(1, count).ravel(), []
        for name, size in zip(self.forces, self.sizes.tolist(), strict=True):
            moved = self.stepped(Run(state, step, count, [(Excitation("input", name, pulse), size)]))
            parts.append((moved - zero)[1:] / size)
        return np.stack(parts, axis=2)

    def _confirmed(self, system: PortSystem, state: State, step: float, count: int, tolerance: float) -> bool:
        """Whether the FMU answers to many forces as the system says that was made of single ones."""
        signs = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self.forces)))
        loads = [
            (Excitation("input", *of), size)
            for of, size in zip(
                zip(self.forces, signs.T.copy(), strict=True), self.sizes.tolist(), strict=True
            )
        ]
        moved = self.stepped(Run(state, step, count, loads))
        moved -= self.stepped(Run(state, step, count, []))
        error = np.max(np.abs(moved - system.motion(signs * self.sizes, step)), axis=0)
        return bool(np.all(error <= tolerance * np.max(np.abs(moved), axis=0) + 1e-300))

    # ------------------------------------------------------------ stiffness

    def flexibility(self, state: State) -> FloatArray:
        """Return the displacements (P, P) of the ports at rest under unit forces at each."""
        if not self.forces:  # nothing to push, and loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        zero = self.rest(state, {})
        moved = [
            (self.rest(state, {name: size}) - zero)[self.x] / size
            for name, size in zip(self.forces, self.sizes.tolist(), strict=True)
        ]
        return np.array(moved).T

    def stiffness(self, number: int, state: State, step: float) -> tuple[float, float]:
        """Return the stiffness of the first mode and the one at rest at a port [N/m or N m/rad]."""
        system = self.system(state, step, RECORD)
        column = self.x[number]
        if system is None:
            size, still = float(self.sizes[number]), []
            for force in (0.0, size):
                inputs = self.runs.inputs(state, {self.forces[number]: force})
                found = self.runs.started(step, dict(state.parameters), inputs, settle=True)[1]
                still.append(float(found[column]))
            stiffness = size / (still[1] - still[0])
            return stiffness, stiffness
        at_rest = 1.0 / float(system.gain()[column, number])
        frequency, shape = system.most_flexible(column, number) or (1.0, 0.0)
        of_mode = shape / frequency**2
        return (at_rest if of_mode * at_rest < 1e-6 else 1.0 / of_mode), at_rest


def sampled(values: FloatArray, step: float, times: FloatArray, derivatives: Sequence[int]) -> Response:
    """Return values and rates at times, from values on an even grid.

    Parameters
    ----------
    values : (K, C) ndarray
        Outputs at 0, `step`, 2 `step`, ...
    step : float
        Of the grid [s].
    times : (N,) ndarray
        Times of the samples [s]; before zero the first value holds.
    derivatives : sequence of int
        For each column, how often it is derived in the response: 0, 1 or 2.
    """
    before = times < 0.0
    index = np.round(times / step)
    on_grid = bool(np.all(np.abs(times / step - index) < 1e-6))
    if on_grid and len(values) >= len(SLOPES) and not any(derivatives):
        at_index = np.clip(index.astype(int), 0, len(values) - 1)
        first = np.clip(at_index - len(SLOPES) // 2, 0, len(values) - len(SLOPES))
        around = values[first[:, np.newaxis] + np.arange(len(SLOPES))]
        rates = np.einsum("nk,nkc->nc", SLOPES[at_index - first] / step, around)
        rates[before] = 0.0
        return Response(values[at_index], rates)
    grid = step * np.arange(len(values))
    curve = CubicSpline(grid, values)
    at = np.clip(times, 0.0, grid[-1])
    shown, rates = curve(at), curve(at, 1)
    if on_grid:
        shown = values[np.clip(index.astype(int), 0, len(values) - 1)]
    rates[before] = 0.0
    for column, order in enumerate(derivatives):
        if order > 0:
            shown = shown if shown.flags.owndata else shown.copy()
            # derivatives of the derivative's own spline keep the order of the first one
            slope = curve.derivative()(grid)[:, column]
            own = CubicSpline(grid, slope)
            shown[:, column] = own(at, order - 1)
            rates[:, column] = own(at, order)
            shown[before, column] = rates[before, column] = 0.0
    return Response(np.ascontiguousarray(shown), np.ascontiguousarray(rates))
