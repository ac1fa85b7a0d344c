"""What forces at the ports of an FMU do; as a system of its own where the FMU proves to be linear."""

from collections.abc import Callable
from math import ceil

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_runs import Excitation, FmuRuns, Run, State
from discrepancy.models.memory import Memory
from discrepancy.models.port_system import PortSystem, port_system

LINEAR = 1e-6
"""Largest deviation from superposition, as a share of the motion, of an FMU that is taken as linear."""
RECORD = 600
"""Steps of the answer to a port's force that are recorded."""
KEPT_SYSTEMS = 64
SAFE_TURN = 0.8 * np.pi
"""Turn of a mode in a step up to which it does not become half a circle as parameters change [rad]."""


class FmuPorts:
    """The ports of an FMU.

    Parameters
    ----------
    description : FmuModelDescription
        The model's file.
    runs : FmuRuns
        Its FMU.
    run : callable
        Takes a `Run`; returns the outputs (steps + 1, C).

    Attributes
    ----------
    forces : list of str
        Inputs of the ports' forces.
    x, v : list of int
        Columns of the ports' displacements and velocities; -1: there is no velocity.
    quiet : bool
        Whether the FMU was seen to show nothing without excitation.
    """

    def __init__(
        self, description: FmuModelDescription, runs: FmuRuns, run: Callable[[Run], FloatArray]
    ) -> None:
        self._description, self._runs, self._run = description, runs, run
        self._ports = description.port
        self.forces = [runs.variable(port.force) for port in self._ports]
        self.x = [runs.columns[f"port.{port.name}.displacement"] for port in self._ports]
        self.v = [runs.columns.get(f"port.{port.name}.velocity", -1) for port in self._ports]
        self.quiet = False
        self._parts: dict[float, int] = {}
        self._confirmed_to: dict[float, int] = {}
        self._systems = Memory(KEPT_SYSTEMS)
        self._linear: bool | None = None

    def parts(self, whole: float) -> int:
        """Return into how many parts a step [s] is divided so that its system tells those of smaller steps.

        A mode that turns by more than half a circle in a step looks like a slower one there.
        """
        return self._parts.get(whole, 1)

    def system(self, state: State, step: float, steps: int, refinement: int = 1) -> PortSystem | None:
        """Return what forces at the ports do in a linear FMU; None if it is not linear.

        Where the FMU confirms it once, the system of a `refinement` is computed from that of a larger step.
        """
        if not self._description.superposition or self._linear is False:
            return None
        return self._systems.get((state, step), lambda: self._found(state, step, steps, refinement))

    def _found(self, state: State, step: float, steps: int, refinement: int) -> PortSystem | None:
        system = self._from_larger(state, step, steps, refinement)
        if system is None:
            count = max(min(steps, RECORD), 64)
            system = port_system(self.records(state, step, count), self.x, step)
            if system is not None and self._linear is None:
                self._linear = self._confirmed(system, state, step, count)
                system = system if self._linear else None
        return system

    def _from_larger(self, state: State, step: float, steps: int, refinement: int) -> PortSystem | None:
        """Return the system of a refinement made from that of a larger step; None if there is none such."""
        whole = step * refinement
        parts = self.parts(whole)
        ratio = refinement // parts
        if ratio < 2 or refinement % parts:
            return None
        base = self.system(state, whole / parts, ceil(steps / ratio), parts)
        if base is None:
            return None
        finer = base.refined(ratio)
        known, count = self._confirmed_to.get(base.step, 1), max(min(steps, RECORD), 64)
        new = ratio > known
        if base.largest_turn > SAFE_TURN or (new and not self._confirmed(finer, state, step, count)):
            self._parts[whole] = refinement
            self._systems.clear()  # what was computed from the same step
            return None
        self._confirmed_to[base.step] = max(ratio, known)
        return finer

    def size(self, number: int) -> float:
        """Return a force at a port that its input can have."""
        return min(1.0, 0.1 * self._runs.input_limit(self._ports[number].force))

    def records(self, state: State, step: float, count: int) -> FloatArray:
        """Return the outputs (count, C, P) after unit forces over the first step, less those without."""
        zero: FloatArray | float = 0.0
        if not self.quiet:
            zero = self._run(Run(state, step, count, []))
            self.quiet = not np.any(zero)
        pulse = np.eye(1, count).ravel()
        parts = []
        for number, name in enumerate(self.forces):
            size = self.size(number)
            moved = self._run(Run(state, step, count, [(Excitation("input", name, pulse), size)]))
            parts.append((moved - zero)[1:] / size)
        return np.stack(parts, axis=2)

    def _confirmed(self, system: PortSystem, state: State, step: float, count: int) -> bool:
        """Whether the FMU answers to many forces as the system says that was made of single ones."""
        signs = np.random.default_rng(0).uniform(-1.0, 1.0, (count, len(self._ports)))
        sizes = np.array([self.size(number) for number in range(len(self._ports))])
        loads = [
            (Excitation("input", name, signs[:, number].copy()), float(sizes[number]))
            for number, name in enumerate(self.forces)
        ]
        moved = self._run(Run(state, step, count, loads)) - self._run(Run(state, step, count, []))
        expected = system.motion(signs * sizes)
        error = np.max(np.abs(moved - expected), axis=0)
        return bool(np.all(error <= LINEAR * np.max(np.abs(moved), axis=0) + 1e-300))

    def stiffness(self, number: int, state: State, step: float) -> tuple[float, float]:
        """Return the stiffness of the first mode and the one at rest at a port [N/m or N m/rad]."""
        system = self.system(state, step, RECORD)
        column = self.x[number]
        if system is None:
            size = self.size(number)
            still = []
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
