"""What forces at the ports of an FMU do; as a system of its own where the FMU proves to be linear."""

from functools import cached_property
from math import ceil

import numpy as np

from discrepancy.campaign.records import FloatArray, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_runs import Excitation, Loads, Run, State
from discrepancy.models.memory import Memory
from discrepancy.models.port_system import LINEAR, PortSystem, port_system

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


class FmuPorts:
    """The ports of an FMU.

    Parameters
    ----------
    motion : FmuMotion
        What it does without laws.
    nominal : State
        Of motions, at the means of the parameters.

    Attributes
    ----------
    forces : list of str
        Inputs of the ports' forces.
    x, v : list of int
        Columns of the ports' displacements and velocities; -1: there is no velocity.
    """

    def __init__(self, motion: FmuMotion, nominal: State) -> None:
        self.motion, self._runs, self._nominal = motion, motion.runs, nominal
        runs, description = motion.runs, motion.runs.description
        self._description = description
        self.forces = [runs.variable(port.force) for port in description.port]
        self.x = [runs.columns[f"port.{port.name}.displacement"] for port in description.port]
        self.v = [runs.columns.get(f"port.{port.name}.velocity", -1) for port in description.port]
        self._quiet = False  # whether it was seen to show nothing without excitation
        self._parts: dict[float, int] = {}
        self._systems, self._frequencies = Memory(KEPT_SYSTEMS), Memory()
        self._linear: bool | None = None

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
            name = self.forces[0] if self.forces else next(iter(self._runs.asset.binding.load))
            loads = [(Excitation("input", name, np.eye(1, len(trial.time)).ravel()), 1.0)]
        values = self.motion.free(Run(state, step, len(trial.time), loads))
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
        if not (self._description.superposition and self.forces) or self._linear is False:
            return None
        return self._systems.get((state, step), lambda: self._found(state, step, steps))

    def _found(self, state: State, step: float, steps: int) -> PortSystem | None:
        count = max(min(steps, RECORD), 64)
        known, fixed = step in self._parts, self._description.motion.step is not None
        parts = self._parts.get(step, 1)
        while parts <= MOST_PARTS:
            part = step / parts
            found = port_system(self.records(state, part, count), self.x, part)
            if found is not None and self._linear is None:
                self._linear = self._confirmed(found, state, part, count, LINEAR)
            if found is None or not self._linear:
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
        return np.array([min(1.0, 0.1 * self._runs.input_limit(name)) for name in self.forces])

    def records(self, state: State, step: float, count: int) -> FloatArray:
        """Return the outputs (count, C, P) after unit forces over the first step, less those without."""
        zero: FloatArray | float = 0.0
        if not self._quiet:
            zero = self.motion.stepped(Run(state, step, count, []))
            self._quiet = not np.any(zero)
        pulse, parts = np.eye(1, count).ravel(), []
        for name, size in zip(self.forces, self.sizes.tolist(), strict=True):
            moved = self.motion.stepped(Run(state, step, count, [(Excitation("input", name, pulse), size)]))
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
        moved = self.motion.stepped(Run(state, step, count, loads))
        moved -= self.motion.stepped(Run(state, step, count, []))
        error = np.max(np.abs(moved - system.motion(signs * self.sizes, step)), axis=0)
        return bool(np.all(error <= tolerance * np.max(np.abs(moved), axis=0) + 1e-300))

    # ------------------------------------------------------------ stiffness

    def flexibility(self, state: State) -> FloatArray:
        """Return the displacements (P, P) of the ports at rest under unit forces at each."""
        if not self.forces:  # nothing to push, and loads of zero may be outside of what the FMU takes
            return np.zeros((0, 0))
        zero = self.motion.rest(state, {})
        moved = [
            (self.motion.rest(state, {name: size}) - zero)[self.x] / size
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
                inputs = self._runs.inputs(state, {self.forces[number]: force})
                found = self._runs.started(step, dict(state.parameters), inputs, settle=True)[1]
                still.append(float(found[column]))
            stiffness = size / (still[1] - still[0])
            return stiffness, stiffness
        at_rest = 1.0 / float(system.gain()[column, number])
        frequency, shape = system.most_flexible(column, number) or (1.0, 0.0)
        of_mode = shape / frequency**2
        return (at_rest if of_mode * at_rest < 1e-6 else 1.0 / of_mode), at_rest
