"""Rest of an FMU with internal forces at its ports: the law is solved, and the FMU asked whether it holds."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import ModelError
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.fmu_excitation import State
from discrepancy.models.fmu_file import FmuModelDescription
from discrepancy.models.fmu_motion import FmuMotion
from discrepancy.models.fmu_runs import FmuRuns
from fe.runtime.errors import SolutionError
from fe.runtime.motion import Laws, static_solution

FloatArray = NDArray[np.float64]

STATIC_ITERATIONS = 30
STATIC_TOLERANCE = 1e-9


def rest_with_laws(
    motion: FmuMotion,
    description: FmuModelDescription,
    runs: FmuRuns,
    trial: str,
    states: list[State],
    loads: list[dict[str, float]],
    laws: Laws,
) -> FloatArray:
    """Return all outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

    Raises
    ------
    ModelError
        If the law has no solution, or the FMU does not confirm it.
    """
    ports = [port.name for port in description.port]
    index = [ports.index(port) for port in laws.ports]
    columns = [runs.columns[f"port.{ports[p]}.displacement"] for p in index]
    inputs = [runs.variable(description.port[p].force) for p in index]
    values = np.empty((len(states), max(runs.columns.values()) + 1))
    memory: FloatArray | None = None
    before = np.zeros(len(laws))
    for row, (state, load) in enumerate(zip(states, loads, strict=True)):
        compliance = port_flexibility(motion, description, runs, state)[np.ix_(index, index)]
        linear = motion.rest(state, load)[columns]
        for _ in range(STATIC_ITERATIONS):
            try:
                solution = static_solution(
                    laws, linear[None], compliance, memory=memory, start=before, kernel=compiled_kernel()
                )
            except SolutionError as cause:
                raise ModelError(str(cause)) from cause
            forces = solution.forces[0]
            given = dict(load)
            for name, force in zip(inputs, forces, strict=True):
                given[name] = given.get(name, 0.0) - float(force)
            values[row] = motion.rest(state, given)
            # where the FMU is not linear, the law is solved again about the point that was reached
            again = values[row, columns] + compliance @ forces
            change = np.max(np.abs(again - linear))
            linear = again
            if change <= STATIC_TOLERANCE * max(np.max(np.abs(again)), 1e-300):
                break
        else:
            raise ModelError(
                f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model {description.name!r} "
                f"did not agree at load level {row + 1} of {trial!r} within {STATIC_ITERATIONS} "
                f"iterations; the force is too strong for the FMU."
            )
        memory, before = solution.memory, linear
    return values


def port_flexibility(
    motion: FmuMotion, description: FmuModelDescription, runs: FmuRuns, state: State
) -> FloatArray:
    """Return the displacements (P, P) of the ports at rest under unit forces at each."""
    columns = [runs.columns[f"port.{port.name}.displacement"] for port in description.port]
    zero = motion.rest(state, {})[columns]
    result = np.empty((len(columns), len(columns)))
    for number, port in enumerate(description.port):
        name = runs.variable(port.force)
        size = min(1.0, 0.1 * runs.input_limit(port.force))
        result[:, number] = (motion.rest(state, {name: size})[columns] - zero) / size
    return result
