"""Motion of an FMU without laws at its ports, and what forces there do, as a system where it is linear."""

from collections.abc import Hashable, Mapping, Sequence
from functools import cached_property
from math import ceil, log2
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Loads, Run, State
from discrepancy.models.interface import Memory
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

SLOPES = np.array([
    [-25, 48, -36, 16, -3],
    [-3, -10, 18, -6, 1],
    [1, -8, 0, 8, -1],
    [-1, 6, -18, 10, 3],
    [3, -16, 36, -48, 25],
]) / 12.0  # fmt: skip
"""Weights by which five values on an even grid give the slope at each of them, of fourth order."""
Sampled = tuple[FloatArray, FloatArray]
"""Values and rates (N, C) at the samples of a trial."""


class FmuMotion(FmuRuns):
    """Rest and motion of an FMU, superposed where it proves to be linear, and what forces at its ports do.

    Attributes
    ----------
    nominal : State
        Of motions, at the means of the parameters; set by the model.
    forces : list of str
        Inputs of the ports' forces.
    x, v : list of int
        Columns of the ports' displacements and velocities; -1: there is no velocity.
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        self.nominal, ports = State((), ()), description.port
        self.forces = [self.variable(port.force) for port in ports]
        self.x = [self.columns[f"port.{port.name}.displacement"] for port in ports]
        self.v = [self.columns.get(f"port.{port.name}.velocity", -1) for port in ports]
        self._linear, self._silent = dict[Hashable, bool](), dict[Hashable, bool]()
        self._units, self._parts = dict[Hashable, float](), dict[float, int]()
        self._quiet = False  # whether it was seen to show nothing without excitation
        self._systems, self._frequencies = Memory(KEPT_SYSTEMS), Memory()
        self._proven: bool | None = None  # whether its ports are those of a linear system

    def rest(self, state: State, loads: Mapping[str, float]) -> FloatArray:
        """Return the outputs (C,) at rest under inputs; what is not given is zero."""
        given = [(Excitation("input", name, begin=1.0), value) for name, value in sorted(loads.items())]
        return self.free(Run(state, self.description.static.step, 0, given))

    def free(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion, of no steps those at rest (C,).

        They are put together from answers to units where that is proven to be right.
        """
        parts = [part for part, value in run.loads if value != 0.0]
        values = [value for _, value in run.loads if value != 0.0]
        kind = (run.steps == 0, tuple((part.kind, part.name) for part in parts))

        def asked(values: Sequence[float]) -> FloatArray:
            given = run._replace(loads=list(zip(parts, values, strict=True)))
            key = tuple((part.key, value) for part, value in given.loads if value != 0.0)
            answer = self.followed if run.steps else self._rest
            return self.remembered((run[:3], key or kind), lambda: answer(given))

        possible = self.description.superposition and (run.steps or self.description.static.settle)
        if not (possible and parts) or self._linear.get(kind) is False:
            return asked(values)
        units = [
            self._units.setdefault((kind[0], part.kind, part.name), 2.0 ** round(log2(abs(value))))
            for part, value in zip(parts, values, strict=True)
        ]
        moved = np.array([asked(one) for one in np.diag(units).tolist()])
        zero = np.zeros_like(moved[0])
        if not self._silent.get(kind):  # an FMU that shows nothing without excitation does so always
            zero = asked([0.0] * len(parts))
            self._silent.setdefault(kind, not np.any(zero))
        moved -= zero
        if kind not in self._linear:  # half of all excitations gives half of the sum of what each gives
            half = asked([0.5 * size for size in units]) - zero
            size = np.atleast_2d(np.sum(np.abs(moved), axis=0)).max(axis=0)
            allowed = LINEAR * size + 1e-12 * np.atleast_2d(np.abs(zero)).max(axis=0)
            self._linear[kind] = bool(np.all(np.abs(half - 0.5 * np.sum(moved, axis=0)) <= allowed))
            if not self._linear[kind]:
                return asked(values)
        return np.asarray(zero + np.tensordot(np.array(values) / units, moved, 1))

    def _rest(self, run: Run) -> FloatArray:
        parameters, asset = run.state.parameters, self.open(run.step)
        inputs = self.inputs(run.state, {part.name: value for part, value in run.loads})
        if self.description.static.settle:
            return self.started(run.step, dict(parameters), inputs, settle=True)[1]
        if self.resting != (asset, parameters):  # inputs change from step to step, parameters need a reset
            self.started(run.step, dict(parameters), inputs, settle=False)
        self.resting = None
        values = self.one_step(asset, inputs)
        self.resting = asset, parameters
        return values

    def followed(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion by the FMU itself."""
        asset, first, histories = self.begin(run)
        return np.vstack((first, self.advanced(asset, histories, run.steps)))

    def begin(self, run: Run) -> tuple[FmiAsset, FloatArray, dict[str, FloatArray]]:
        """Return an instance at the begin of a motion, its outputs there, and the inputs (steps,) to come."""
        state, step, steps, loads = run
        parameters, held = dict(state.parameters), dict[str, float]()
        histories = {name: np.full(steps, value) for name, value in self.inputs(state).items()}
        for part, value in loads:
            if part.kind == "parameter":
                parameters[part.name] = value
            else:
                histories[part.name][: len(part.series)] += value * part.series[:steps]
                held[part.name] = held.get(part.name, 0.0) + value * part.begin
        settle = any(part.begin for part, _ in loads)
        asset, first = self.started(step, parameters, self.inputs(state, held), settle=settle)
        return asset, first, histories

    def let_go(self, state: State, step: float, displacement: float) -> tuple[Excitation, float]:
        """Return the force and its size [N], or the parameter [m], that put the release point somewhere [m].

        Raises
        ------
        ModelError
            If there is none.
        """
        way = self.description.release
        assert way is not None
        what, first = Excitation("parameter", self.parameter(str(way.displacement))), displacement
        if way.hold is not None:
            what = Excitation("hold", self.variable(way.hold), begin=1.0)
            first = min(1.0, 0.1 * self.input_limit(way.hold))
        if way.output is None or displacement == 0.0:
            return what, displacement

        def shown(amount: float) -> float:
            run = Run(state, step, 0, [(what, amount)])
            found = self.remembered(("begin", run.key), lambda: self.begin(run)[1])
            return float(found[self.columns["release"]])

        kind = (False, ((what.kind, what.name),))
        if way.hold is not None and self._linear.get(kind) and self._silent.get(kind):
            return what, displacement * first / shown(first)
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
            return what, amount
        raise ModelError(
            f"Nothing that [release] names puts {way.output!r} of the FMU model "
            f"{self.description.name!r} at {displacement:g} m; correct displacement, hold or output there."
        )

    # ------------------------------------------------------------ pace

    def step(self, trial: Trial, refinement: int = 1) -> float:
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
        system = self.system(state, step, len(trial.time))
        mode = None if system is None else system.most_flexible(self.x[0], 0)
        if mode is not None:
            return mode[0]
        way = self.description.release
        if way is not None:
            size = trial.release.displacement if trial.release is not None else 1e-3
            loads: Loads = [self.let_go(state, step, size)]
        else:
            name = self.forces[0] if self.forces else next(iter(self.asset.binding.load))
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

    # ------------------------------------------------------------ the system

    def system(self, state: State, step: float, steps: int) -> PortSystem | None:
        """Return what forces at the ports do in a linear FMU; None if it is not linear.

        Made from answers over steps [s], or over parts of them where a mode turns by half a circle in one.
        """
        if not (self.description.superposition and self.forces) or self._proven is False:
            return None
        return self._systems.get((state, step), lambda: self._identified(state, step, steps))

    def _identified(self, state: State, step: float, steps: int) -> PortSystem | None:
        count = max(min(steps, RECORD), 64)
        known, fixed = step in self._parts, self.description.motion.step is not None
        parts = self._parts.get(step, 1)
        while parts <= MOST_PARTS:
            part = step / parts
            found = port_system(self.records(state, part, count), self.x, part)
            if found is not None and self._proven is None:
                self._proven = self._confirmed(found, state, part, count, LINEAR)
            if found is None or not self._proven:
                return None
            safe = np.max(np.abs(np.linalg.eigvals(found.generator).imag)) * part <= SAFE_TURN
            if fixed or (safe and (known or self._confirmed(found, state, 0.5 * part, count, SAME_PACE))):
                self._parts[step] = parts
                return found
            parts *= 2
        return None

    @cached_property
    def sizes(self) -> FloatArray:
        """Forces (P,) at the ports that their inputs can have."""
        return np.array([min(1.0, 0.1 * self.input_limit(name)) for name in self.forces])

    def records(self, state: State, step: float, count: int) -> FloatArray:
        """Return the outputs (count, C, P) after unit forces over the first step, less those without."""
        pulse, parts = np.eye(1, count).ravel(), list[FloatArray]()
        for name, size in zip(self.forces, self.sizes.tolist(), strict=True):
            run = Run(state, step, count, [(Excitation("input", name, pulse), size)])
            parts.append(self._moved(run)[1:] / size)
        return np.stack(parts, axis=2)

    def _moved(self, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion by the FMU itself, less those without loads."""
        moved, still = self.followed(run), run._replace(loads=[])
        if self._quiet:
            return moved
        zero = self.remembered(("without", still.key), lambda: self.followed(still))
        self._quiet = not np.any(zero)
        return moved - zero

    def _confirmed(self, system: PortSystem, state: State, step: float, count: int, tolerance: float) -> bool:
        """Whether the FMU answers to many forces as the system says that was made of single ones."""
        signs = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self.forces)))
        series = zip(self.forces, signs.T.copy(), self.sizes.tolist(), strict=True)
        loads = [(Excitation("input", name, values), size) for name, values, size in series]
        moved = self._moved(Run(state, step, count, loads))
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
            size, push = float(self.sizes[number]), Excitation("input", self.forces[number], begin=1.0)
            still = [self.begin(Run(state, step, 0, [(push, force)]))[1][column] for force in (-size, size)]
            stiffness = 2.0 * size / float(still[1] - still[0])
            return stiffness, stiffness
        gain = system.direct - system.outputs @ np.linalg.solve(system.generator, system.push)
        at_rest = 1.0 / float(gain[column, number])
        frequency, shape = system.most_flexible(column, number) or (1.0, 0.0)
        of_mode = shape / frequency**2
        return (at_rest if of_mode * at_rest < 1e-6 else 1.0 / of_mode), at_rest


def sampled(values: FloatArray, step: float, times: FloatArray, derivatives: Sequence[int]) -> Sampled:
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
    before, index = times < 0.0, np.round(times / step)
    row = np.clip(index.astype(int), 0, len(values) - 1)
    on_grid = bool(np.all(np.abs(times / step - index) < 1e-6))
    if on_grid and len(values) >= len(SLOPES) and not any(derivatives):
        first = np.clip(row - len(SLOPES) // 2, 0, len(values) - len(SLOPES))
        around = values[first[:, np.newaxis] + np.arange(len(SLOPES))]
        rates = np.einsum("nk,nkc->nc", SLOPES[row - first] / step, around)
        rates[before] = 0.0
        return values[row], rates
    grid = step * np.arange(len(values))
    curve, at = CubicSpline(grid, values), np.clip(times, 0.0, grid[-1])
    shown, rates = values[row] if on_grid else curve(at), curve(at, 1)
    rates[before] = 0.0
    for column, order in enumerate(derivatives):
        if order > 0:
            # derivatives of the derivative's own spline keep the order of the first one
            own = CubicSpline(grid, curve(grid, 1)[:, column])
            shown[:, column] = own(at, order - 1)
            rates[:, column] = own(at, order)
            shown[before, column] = rates[before, column] = 0.0
    return np.ascontiguousarray(shown), np.ascontiguousarray(rates)
