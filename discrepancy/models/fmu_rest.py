"""Rest of an FMU with internal forces at its ports: the law is solved, and the FMU asked whether it holds."""

import numpy as np
from numpy.typing import NDArray

from discrepancy.errors import ModelError
from discrepancy.models.compiled_motion import compiled_kernel
from discrepancy.models.fmu_excitation import State
from discrepancy.models.fmu_motion import FmuMotion
from fe.runtime.errors import SolutionError
from fe.runtime.motion import Laws, static_solution

FloatArray = NDArray[np.float64]

STATIC_ITERATIONS = 30
STATIC_TOLERANCE = 1e-9


def rest_with_laws(
    motion: FmuMotion, trial: str, states: list[State], loads: list[dict[str, float]], laws: Laws
) -> FloatArray:
    """Return all outputs (N, C) where laws follow the load path; the FMU itself is asked at the end.

    Raises
    ------
    ModelError
        If the law has no solution, or the FMU does not confirm it.
    """
    names, ports, found = [port.name for port in motion.description.port], motion.ports, []
    name = motion.description.name
    index = [names.index(port) for port in laws.ports]
    columns, inputs = np.array(ports.x)[index], [ports.forces[number] for number in index]
    memory: FloatArray | None = None
    before = np.zeros(len(laws))
    for row, (state, load) in enumerate(zip(states, loads, strict=True)):
        compliance = port_flexibility(motion, state)[np.ix_(index, index)]
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
            for at, force in zip(inputs, forces, strict=True):
                given[at] = given.get(at, 0.0) - float(force)
            values = motion.rest(state, given)
            # where the FMU is not linear, the law is solved again about the point that was reached
            again = values[columns] + compliance @ forces
            change = np.max(np.abs(again - linear))
            linear = again
            if change <= STATIC_TOLERANCE * max(np.max(np.abs(again)), 1e-300):
                break
        else:
            raise ModelError(
                f"The law at {', '.join(dict.fromkeys(laws.ports))} and the FMU model {name!r} "
                f"did not agree at load level {row + 1} of {trial!r} within {STATIC_ITERATIONS} "
                f"iterations; the force is too strong for the FMU."
            )
        memory, before = solution.memory, linear
        found.append(values)
    return np.array(found)


def port_flexibility(motion: FmuMotion, state: State) -> FloatArray:
    """Return the displacements (P, P) of the ports at rest under unit forces at each."""
    ports = motion.ports
    if not len(ports.forces):  # nothing to push, and loads of zero may be outside of what the FMU takes
        return np.zeros((0, 0))
    zero, moved = motion.rest(state, {}), []
    for number, name in enumerate(ports.forces):
        size = ports.size(number)
        moved.append((motion.rest(state, {name: size}) - zero)[ports.x] / size)
    return np.array(moved).T
