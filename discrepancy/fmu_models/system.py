"""An FMU with ports: its system where it is linear, what moves it, and at which pace it is stepped."""

from collections.abc import Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from math import ceil
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import root_scalar
from scipy.signal import periodogram

from discrepancy.campaign.records import FloatArray, Hold, Trial
from discrepancy.errors import ModelError, said
from discrepancy.fmu_models.description import FmuModelDescription, FmuVariables, ReleaseOf
from discrepancy.system.excitation import SMOOTH_PARTS, Acting, Course, Load, straight
from fe.compilation import compiled_kernel
from fe.runtime.arrays import IntArray
from fe.runtime.modal_system import ModalSystem
from fe.runtime.motion import NO_LAWS, Begin, Laws, advance, steps_under, substeps
from fmu_asset.door.runs import FmuRuns, Run, State, StateSpace, realised
from fmu_asset.errors import FmuError
from reporting.memory import ResultCache

NONE: Any = np.zeros(0, dtype=np.int64)
KEPT = 64
"""Systems that are kept."""
ROUNDING = 1e-9
"""Share of the displacement at rest below which what a force moves at once is rounding."""
LINEAR = 1e-6
"""Largest deviation from superposition, as a share of the motion, of an FMU that is taken as linear."""
PHASE = 0.1
"""Longest communication step without laws: radians of the first mode."""
LEAST_RECORD, RECORD = 64, 600
"""Least and most steps of the answer to a force or a release that are recorded."""
SAFE_TURN = 0.8 * np.pi
"""Turn of a mode in a step up to which it does not become half a circle as parameters change [rad]."""
MOST_PARTS = 16
"""Parts of an interval at which the system is looked for."""
SAME_PACE = 1e-2
"""A mode that turns by more than half a circle in a step looks like a slower one there: half the step tells
by more than this share of the motion."""


class Case(NamedTuple):
    """What moves an FMU.

    Attributes
    ----------
    state : State
        Of the FMU.
    step : float
        At which it is asked [s].
    record : int
        Steps after which it is known what each of the following does alone.
    inputs : tuple of str
        By which something may push it: a recorded force, or laws.
    levers : mapping of str to float
        How much of the recorded force inputs have.
    course : Course, optional
        Of that force.
    starts : mapping of str to float
        Parameters that release it, with displacement [m] and velocity [m/s] of the release point; or the
        input that holds it until then, with the displacement.
    at_rest : bool
        Whether it is to come to rest.
    """

    state: State
    step: float
    record: int
    inputs: tuple[str, ...] = ()
    levers: Mapping[str, float] = MappingProxyType({})
    course: Course | None = None
    starts: Mapping[str, float] = MappingProxyType({})
    at_rest: bool = False

    @property
    def lever(self) -> FloatArray:
        """How much of the recorded force each of the inputs (E,) has."""
        return np.array([self.levers.get(name, 0.0) for name in self.inputs])


def state_motion(
    system: StateSpace, acting: Acting, start: FloatArray, laws: Laws = NO_LAWS, columns: IntArray = NONE,
    numbers: IntArray = NONE, still: FloatArray = NONE, refinement: int = 1,
    memory: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return states (N, n) and forces (N, E) of a system at the times of what acts, with laws at ports.

    Position and speed of a law's port are coordinates beside the state, from which they follow: so laws act
    on this system as on any other.

    Parameters
    ----------
    system : StateSpace
        What moves.
    acting : Acting
        Forces, in rows (E,).
    start : (n,) ndarray
        State at the first time.
    laws : Laws
        J internal forces.
    columns, numbers : (J,) ndarray of int
        Column of the displacement, and number of the force, of each law's port.
    still : (J,) ndarray
        Position of each law's port without forces.
    refinement : int
        Steps with laws are this many times smaller.
    memory : ndarray, optional
        Of the laws at the first time; by default loaded from zero at once.
    """
    acts, modal, law = _with_ports(system, laws.ports, tuple(columns.tolist()), tuple(numbers.tolist()))
    smooth = any(course.hold is Hold.SMOOTH for _, course, _ in acting.loads)
    least = SMOOTH_PARTS if smooth else 1
    boundaries = substeps(modal, laws, acting.sampled, refinement, least, acting.edges)
    begin, end = straight(lambda time: acting.load_at(time, acts.T), boundaries.time)
    feed, seen = acting.load_at(boundaries.time, system.direct[columns].T), system.outputs[columns[law]]
    first = Begin(
        np.concatenate((seen @ start + still[law], 0.0 * start)),
        np.concatenate((seen @ system.generator @ start, start)), memory,
    )  # fmt: skip
    found = advance(modal, laws, steps_under(modal, boundaries, begin, end, feed), first, compiled_kernel())
    forces = acting.load_at(acting.sampled, np.eye(system.push.shape[1]))
    np.subtract.at(forces.T, numbers, found.port_forces.T)
    return found.v[:, len(law) :], forces


@lru_cache(maxsize=KEPT)
def _with_ports(
    system: StateSpace, names: tuple[str, ...], columns: tuple[int, ...], numbers: tuple[int, ...]
) -> tuple[FloatArray, ModalSystem, IntArray]:
    """Return along what forces act (N, E), the system of ports and state, and a law of each port."""
    places, law = np.unique(names, return_index=True)
    count, order = len(law), len(system.generator)
    column, number = (np.array(given, dtype=np.int64)[law] for given in (columns, numbers))
    seen = system.outputs[column] @ system.generator
    acts = np.vstack((seen @ system.push, system.push))
    damping = np.zeros((count + order, count + order))
    damping[:, count:] = -np.vstack((seen @ system.generator, system.generator))
    at_once, gain = (item[column, number] for item in (system.direct, system.gain))
    modal = ModalSystem(
        np.zeros(count + order), damping, dict(zip(places, np.eye(count, count + order), strict=True)),
        np.where(at_once > ROUNDING * gain, at_once, 0.0),
        actions=dict(zip(places, acts.T[number], strict=True)),
    )  # fmt: skip
    return acts, modal, law


class FmuPace(FmuRuns):
    """An FMU with ports: its system where it is linear, and its pace.

    Attributes
    ----------
    nominal : State
        Of motions, at the means of the parameters; set by the model.
    ports, forces : list of str
        Names, and inputs of their forces.
    x, v : list of int
        Columns of the ports' displacements and velocities; -1: there is no velocity.
    release : list of str
        What lets it go, and what gives it a velocity.
    """

    nominal = State()

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        self.description, rest = description, description.static
        with self.refusals():
            self.names = names = FmuVariables(description, folder)
            super().__init__(names.path, names.binding, description.isolated, rest.limit, rest.tolerance)
            # beyond its range it refuses, and a posterior is cut there
            told = [{item.variable: end} for item in description.parameter for end in (item.low, item.high)]
            told += [{f"effect.{name}.active": 1.0} for name in description.effects.values()]
            for given in (*told, rest.parameters, description.motion.parameters):
                self.asset.check_parameters({names.parameter(name): value for name, value in given.items()})
        self.ports = [port.name for port in description.port]
        self.forces = [names.variable(port.force) for port in description.port]
        self.x = [names.columns[f"port.{port}.displacement"] for port in self.ports]
        self.v = [names.columns.get(f"port.{port}.velocity", -1) for port in self.ports]
        way = description.release or ReleaseOf.model_construct()
        ways = (way.displacement, way.velocity)
        self.release = [names.parameter(name) for name in ways if name is not None]
        self.release += [names.variable(way.hold)] if way.hold is not None else []
        self._linear, self._sizes = dict[Hashable, bool](), dict[str, float]()
        self._systems, self._paces = ResultCache(KEPT), ResultCache()

    def refusals(self) -> AbstractContextManager[None]:
        """Return the context that says of which model it is what the FMU refuses."""
        return ModelError.instead_of(FmuError, before=f"The FMU model {self.description.name!r}: ")

    def case(
        self, trial: Trial, state: State, ports: Sequence[str], levers: Mapping[str, float] | None = None
    ) -> Case:
        """Return the case of a trial with laws at ports, or a force at inputs."""
        forces, levers = (self.forces[self.ports.index(name)] for name in ports), levers or {}
        inputs = tuple(dict.fromkeys([*levers, *forces]))
        return Case(state, self.usual(trial)[1], record_of(trial), inputs, levers)

    # ------------------------------------------------------------ its system

    def system(self, case: Case) -> StateSpace | None:
        """Return an FMU as a system; None if it is not linear.

        It is where one system shows its answers to single forces and releases, and predicts what all do.
        """
        kind = case.inputs, *case.starts, case.at_rest
        asked = self.description.superposition and (case.inputs or case.starts)
        if not asked or self._linear.get(kind) is False:
            return None

        def identified() -> StateSpace | None:
            answers = [self._answer(case, name) for name in case.inputs]
            answers += [self._answer(case, name, released=True) for name in case.starts]
            return realised(np.stack(answers, axis=2)[1:], len(case.inputs), case.step)

        found = self._systems.get((kind, *case[:3]), identified)
        if found is not None and kind not in self._linear:
            self._linear[kind] = self._predicts(found, case, LINEAR)
        return found if self._linear.get(kind) else None

    def _answer(self, case: Case, name: str, *, released: bool = False) -> FloatArray:
        """Return the outputs (record + 1, C) after a unit force over the first step, or a release by one."""
        if released:
            usual = self.size(name) if name in self.names.binding.load else case.starts[name] or 1.0
            size = self._sizes.setdefault(name, usual)
            run = self._run(case._replace(course=None), {name: size})
        else:
            size = self.size(name)
            run = Run(*case[:3], courses={name: size * np.eye(1, case.record).ravel()})
        return self.remembered((*case[:3], name, released), lambda: self._moved(case, run) / size)

    def _moved(self, case: Case, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion, less those at the start without anything."""
        return self.followed(run) - self._still(case)

    def _still(self, case: Case) -> FloatArray:
        return self.remembered(case[:2], lambda: self.begun(Run(case.state, case.step, 0))[1])

    def _predicts(self, system: StateSpace, case: Case, tolerance: float) -> bool:
        """Whether a system shows what the FMU does under all that moves it, random forces where laws act."""
        amounts, random = self._amounts(case, linear=True), np.random.default_rng(0)
        run = self._run(case, amounts)
        courses = {name: self.size(name) * random.uniform(-1.0, 1.0, run.steps) for name in case.inputs}
        courses |= run.courses
        moved, time = self._moved(case, run._replace(courses=courses)), case.step * np.arange(run.steps + 1.0)
        held = (Course(time, np.append(values, 0.0), Hold.ZERO_ORDER) for values in courses.values())
        acting = Acting(time, time, list(map(Load, np.eye(len(courses)), held)))
        states, forces = state_motion(system, acting, self._start(system, case, amounts))
        error = np.max(np.abs(moved - states @ system.outputs.T - forces @ system.direct.T)[1:], axis=0)
        return bool(np.all(error <= tolerance * np.max(np.abs(moved), axis=0) + 1e-300))

    def _amounts(self, case: Case, *, linear: bool) -> dict[str, float]:
        """Return the parameters, or the force, that put the release point where it is let go.

        Raises
        ------
        ModelError
            If there are none.
        """
        found, column, way = dict(case.starts), self.names.columns.get("release"), self.description.release
        name, displacement = next(iter(found.items()), ("", 0.0))
        if way is None or column is None or displacement == 0.0:
            return found
        if linear:
            return found | {name: displacement / float(self._answer(case, name, released=True)[0, column])}

        def left(amount: float) -> float:
            run = self._run(case._replace(course=None, record=0), {name: amount})
            shown = self.remembered((*case[:2], name, amount, "begin"), lambda: self.begun(run)[1])
            return float((shown - self._still(case))[column]) - displacement

        first = self.size(name) if name in self.names.binding.load else displacement
        amount = float(root_scalar(left, x0=0.0, x1=first, rtol=1e-10, maxiter=20).root)
        if not abs(left(amount)) <= 1e-6 * abs(displacement):
            raise ModelError(said("models.not_released", way=way, model=self, displacement=displacement))
        return found | {name: amount}

    def _run(self, case: Case, amounts: Mapping[str, float]) -> Run:
        """Return the run by which the FMU follows what moves it, released by amounts."""
        begin = {name: amount for name, amount in amounts.items() if name in self.names.binding.load}
        state = case.state.having({name: item for name, item in amounts.items() if name not in begin})
        run = Run(state, case.step, case.record, begin)
        if case.course is None:
            return run
        begins, ends = straight(case.course.at, case.step * np.arange(case.record + 1.0))
        begin |= {name: lever * float(case.course.values[0]) for name, lever in case.levers.items()}
        return run._replace(
            courses={name: 0.5 * lever * (begins + ends) for name, lever in case.levers.items()}
        )

    def _start(self, system: StateSpace, case: Case, amounts: Mapping[str, float]) -> FloatArray:
        """Return the state (n,) of a system at the begin."""
        start: FloatArray = system.starts @ np.array([*amounts.values()])
        first = 0.0 if case.course is None else float(case.course.values[0])
        return start + system.at_rest(first * case.lever) if first else start

    # ------------------------------------------------------------ pace

    def pace(self, trial: Trial, state: State) -> tuple[float, float]:
        """Return the angular frequency [rad/s] of its first mode, and the communication step [s] of a trial.

        The mode is that which is most flexible at the first port; without port, the loudest. The step is a
        whole part of the sampling interval.
        """
        fixed, interval, parts = self.description.motion.step, trial.interval, 1
        starts = {self.release[0]: 1e-3} if self.release and not self.ports else {}
        inputs = tuple(dict.fromkeys(self.forces)) or (() if starts else tuple(self.names.binding.load)[:1])
        case = Case(state, interval, record_of(trial), inputs, starts=starts)
        while True:
            case = case._replace(step=fixed or interval / parts)
            system = self.system(case)
            if system is None or fixed or parts > MOST_PARTS:
                break
            turn = np.max(np.abs(system.modes[0].imag)) * case.step
            half = case._replace(step=0.5 * case.step)
            if turn <= SAFE_TURN and self._predicts(system, half, SAME_PACE):
                break
            parts *= 2
        mode = None if system is None or not self.ports else system.most_flexible(self.x[0], 0)
        frequency = self.description.scales.angular_frequency or (
            self._loudest(case) if mode is None else mode[0]
        )
        return frequency, fixed or interval / max(parts, ceil(frequency * interval / PHASE))

    def _loudest(self, case: Case) -> float:
        """Return the angular frequency of the largest line in the spectrum of a record [rad/s]."""
        name, *_ = case.starts or case.inputs
        moving = self._answer(case, name, released=bool(case.starts))
        moving = moving - moving[-len(moving) // 4 :].mean(axis=0)
        lines, power = periodogram(moving, 1.0 / case.step, "hann", 4 * len(moving), False, axis=0)
        if not np.any(power):
            raise ModelError(said("models.silent", model=self))
        return 2.0 * np.pi * float(max(lines[1], lines[np.argmax(power.max(axis=1))]))

    def usual(self, trial: Trial) -> tuple[float, float]:
        """Return what `pace` does in the nominal state: steps do not change while parameters are fitted."""
        return self._paces.get(trial.interval, lambda: self.pace(trial, self.nominal))


def record_of(trial: Trial) -> int:
    """Return the steps that are recorded for a trial."""
    return min(max(len(trial.time), LEAST_RECORD), RECORD)
