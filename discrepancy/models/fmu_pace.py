"""The system of an FMU where it is linear, what moves it, and at which pace it is stepped."""

from collections.abc import Hashable, Mapping
from math import ceil
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar

from discrepancy.campaign.records import FloatArray, Trial
from discrepancy.errors import ModelError
from discrepancy.models.acting import Course, straight
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_runs import LINEAR, FmuRuns, Run, State
from discrepancy.models.fmu_system import FmuSystem, fmu_system
from discrepancy.models.interface import Memory

PHASE = 0.1
"""Longest communication step without laws: radians of the first mode."""
LEAST_RECORD, RECORD = 64, 600
"""Least and most steps of the answer to a force or a release that are recorded."""
KEPT_SYSTEMS = 64
SAFE_TURN = 0.8 * np.pi
"""Turn of a mode in a step up to which it does not become half a circle as parameters change [rad]."""
MOST_PARTS = 16
"""Parts of an interval at which the system is looked for."""
SAME_PACE = 1e-2
"""A mode that turns by more than half a circle in a step looks like a slower one there: half the step tells
by more than this share of the motion."""


class Motive(NamedTuple):
    """What moves an FMU in a trial.

    Attributes
    ----------
    ports : tuple of str
        Where laws may act.
    levers : mapping of str to float
        Inputs that a recorded force pushes, and how much of it each has.
    course : Course, optional
        Of that force.
    starts : mapping of str to float
        Parameters that release it, with displacement [m] and velocity [m/s] of the release point; or the
        input that holds it until then, with the displacement.
    record : int
        Steps after which it is known what each of these does alone.
    """

    ports: tuple[str, ...] = ()
    levers: Mapping[str, float] = MappingProxyType({})
    course: Course | None = None
    starts: Mapping[str, float] = MappingProxyType({})
    record: int = RECORD


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
    """

    def __init__(self, description: FmuModelDescription, folder: Path) -> None:
        super().__init__(description, folder)
        self.nominal, ports, way = State(), description.port, description.release
        self.ports = [port.name for port in ports]
        self.forces = [self.variable(port.force) for port in ports]
        self.x = [self.columns[f"port.{port.name}.displacement"] for port in ports]
        self._x = np.array(self.x, dtype=np.int64)
        self.v = [self.columns.get(f"port.{port.name}.velocity", -1) for port in ports]
        self.release = list[str]()  # what lets it go, and gives it a velocity
        if way is not None and way.hold is not None:
            self.release = [self.variable(way.hold)]
        elif way is not None:
            names = (way.displacement, way.velocity)
            self.release = [self.parameter(name) for name in names if name is not None]
        self._linear, self._sizes = dict[Hashable, bool](), dict[str, float]()
        self._systems, self._paces = Memory(KEPT_SYSTEMS), Memory()
        self._refinements = dict[Hashable, tuple[int, float]]()

    # ------------------------------------------------------------ its system

    def _pushed(self, motive: Motive) -> list[str]:
        """Return the inputs by which something moves it."""
        ports = (self.forces[self.ports.index(name)] for name in motive.ports)
        return list(dict.fromkeys([*motive.levers, *ports]))

    def system(self, state: State, step: float, motive: Motive) -> FmuSystem | None:
        """Return what moves it, at steps [s], as a system; None if it is not linear.

        It is where one system shows its answers to single forces and releases, and predicts what all do.
        """
        inputs = self._pushed(motive)
        kind = (len(inputs), *inputs, *motive.starts)
        if not (self.description.superposition and kind[1:]) or self._linear.get(kind) is False:
            return None

        def identified() -> FmuSystem | None:
            answers = [self._answer(state, step, name, motive.record) for name in inputs]
            answers += [self._released(state, step, motive, name) for name in motive.starts]
            return fmu_system(np.stack(answers, axis=2)[1:], len(inputs), step)

        found = self._systems.get((state, step, motive.record, kind), identified)
        if found is not None and kind not in self._linear:
            self._linear[kind] = self._predicts(found, state, step, motive, LINEAR)
        return found if self._linear.get(kind) else None

    def _answer(self, state: State, step: float, name: str, steps: int) -> FloatArray:
        """Return the outputs (steps + 1, C) after a unit force over the first step."""
        size = self.size(name)
        run = Run(state, step, steps, courses={name: size * np.eye(1, steps).ravel()})
        return self.remembered((state, step, name, steps), lambda: self._moved(state, run) / size)

    def _released(self, state: State, step: float, motive: Motive, name: str) -> FloatArray:
        """Return the outputs (steps + 1, C) after a release by a unit."""
        usual = self.size(name) if name in self._none else motive.starts[name] or 1.0
        size = self._sizes.setdefault(name, usual)
        run = self._run(state, step, motive.record, Motive(), {name: size})
        key = (state, step, name, motive.record, size)
        return self.remembered(key, lambda: self._moved(state, run) / size)

    def _moved(self, state: State, run: Run) -> FloatArray:
        """Return the outputs (steps + 1, C) of a motion, less those at the start without anything."""
        return self.followed(run) - self._still(state, run.step)

    def _still(self, state: State, step: float) -> FloatArray:
        return self.remembered((state, step), lambda: self.begun(Run(state, step, 0))[1])

    def _predicts(
        self, system: FmuSystem, state: State, step: float, motive: Motive, tolerance: float
    ) -> bool:
        """Whether a system shows what the FMU does under all that moves it, random forces where laws act."""
        amounts, inputs = self._amounts(state, step, motive, linear=True), self._pushed(motive)
        run, random = self._run(state, step, motive.record, motive, amounts), np.random.default_rng(0)
        start = self._start(system, motive, amounts)
        courses = {name: self.size(name) * random.uniform(-1.0, 1.0, run.steps) for name in inputs}
        courses |= run.courses
        forces = np.array([*courses.values()]).reshape(-1, run.steps).T
        moved = self._moved(state, run._replace(courses=courses))
        shown = system.stepped(start, forces, step)
        error = np.max(np.abs(moved - shown)[1:], axis=0)
        return bool(np.all(error <= tolerance * np.max(np.abs(moved), axis=0) + 1e-300))

    def _amounts(self, state: State, step: float, motive: Motive, *, linear: bool) -> dict[str, float]:
        """Return the parameters, or the force, that put the release point where it is let go.

        Raises
        ------
        ModelError
            If there are none.
        """
        found, way = dict(motive.starts), self.description.release
        name, displacement = next(iter(found.items()), ("", 0.0))
        if way is None or way.output is None or displacement == 0.0:
            return found
        column = self.columns["release"]
        if linear:
            return found | {name: displacement / float(self._released(state, step, motive, name)[0, column])}

        def left(amount: float) -> float:
            run = self._run(state, step, 0, Motive(), {name: amount})
            shown = self.remembered((state, step, name, amount, "begin"), lambda: self.begun(run)[1])
            return float((shown - self._still(state, step))[column]) - displacement

        first = self.size(name) if name in self._none else displacement
        amount = float(root_scalar(left, x0=0.0, x1=first, rtol=1e-10, maxiter=20).root)
        if not abs(left(amount)) <= 1e-6 * abs(displacement):
            raise ModelError(
                f"Nothing that [release] names puts {way.output!r} of the FMU model "
                f"{self.description.name!r} at {displacement:g} m; correct displacement, hold or output "
                "there."
            )
        return found | {name: amount}

    def _run(
        self, state: State, step: float, steps: int, motive: Motive, amounts: Mapping[str, float]
    ) -> Run:
        """Return the run by which the FMU follows what moves it, released by amounts."""
        begin = {name: amount for name, amount in amounts.items() if name in self._none}
        state = state.having({name: amount for name, amount in amounts.items() if name not in self._none})
        if motive.course is None:
            return Run(state, step, steps, begin)
        begins, ends = straight(motive.course.at, step * np.arange(steps + 1.0))
        begin |= {name: lever * float(motive.course.values[0]) for name, lever in motive.levers.items()}
        courses = {name: 0.5 * lever * (begins + ends) for name, lever in motive.levers.items()}
        return Run(state, step, steps, begin, courses)

    def _start(self, system: FmuSystem, motive: Motive, amounts: Mapping[str, float]) -> FloatArray:
        """Return the state (n,) of a system at the begin."""
        start: FloatArray = system.starts @ np.array([*amounts.values()])
        first = 0.0 if motive.course is None else float(motive.course.values[0])
        return start + system.at_rest(first * self._levers(motive)) if first else start

    def _levers(self, motive: Motive) -> FloatArray:
        """Return how much of a recorded force each of the inputs (E,) has."""
        return np.array([motive.levers.get(name, 0.0) for name in self._pushed(motive)])

    # ------------------------------------------------------------ pace

    def pace(self, trial: Trial, state: State) -> tuple[float, float]:
        """Return the angular frequency [rad/s] of its first mode, and the communication step [s] of a trial.

        The mode is that which is most flexible at the first port; without port, the loudest. The step is a
        whole part of the sampling interval.
        """
        fixed, interval = self.description.motion.step, trial.interval
        motive = Motive(tuple(self.ports), record=record_of(trial))
        if not self.ports and self.release:
            motive = motive._replace(starts={self.release[0]: 1e-3})
        elif not self.ports:
            motive = motive._replace(levers={next(iter(self._none)): 1.0})
        parts, frequency = 1, self.description.scales.angular_frequency
        while True:
            step = fixed or interval / parts
            system = self.system(state, step, motive)
            if system is None or fixed or parts > MOST_PARTS:
                break
            turn = np.max(np.abs(np.linalg.eigvals(system.generator).imag)) * step
            if turn <= SAFE_TURN and self._predicts(system, state, 0.5 * step, motive, SAME_PACE):
                break
            parts *= 2
        mode = None if system is None or not self.ports else system.most_flexible(self.x[0], 0)
        frequency = frequency or (self._loudest(state, step, motive) if mode is None else mode[0])
        return frequency, fixed or interval / max(parts, ceil(frequency * interval / PHASE))

    def _loudest(self, state: State, step: float, motive: Motive) -> float:
        """Return the angular frequency of the largest line in the spectrum of a record [rad/s]."""
        if motive.starts:
            values = self._released(state, step, motive, *motive.starts)
        else:
            values = self._answer(state, step, self._pushed(motive)[0], motive.record)
        moving = values - values[-len(values) // 4 :].mean(axis=0)
        spectrum = np.abs(np.fft.rfft(moving * np.hanning(len(moving))[:, None], 4 * len(moving), axis=0))
        if not np.any(spectrum):
            raise ModelError(
                f"The FMU model {self.description.name!r} does not move; state angular_frequency in [scales]."
            )
        best = int(np.argmax(spectrum[:, np.argmax(spectrum.max(axis=0))]))
        return 2.0 * np.pi * max(best, 1) / (4 * len(moving) * step)

    def usual(self, trial: Trial) -> tuple[float, float]:
        """Return what `pace` does in the nominal state: steps do not change while parameters are fitted."""
        return self._paces.get(trial.interval, lambda: self.pace(trial, self.nominal))


def record_of(trial: Trial) -> int:
    """Return the steps that are recorded for a trial."""
    return min(max(len(trial.time), LEAST_RECORD), RECORD)
