"""Internal forces at the ports of an FMU by explicit co-simulation.

The force of a law is held over each communication step: that at the middle of the step, extrapolated from
displacement and velocity at its begin. What the port's speed answers to the force within one step is measured
beforehand, so that friction can stop it. Second order in the step. The laws are those of `fe.runtime.laws`.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.models.compiled_motion import law_functions
from discrepancy.models.port_system import PortSystem
from fe.compilation import callable_when_compiled, compiled
from fe.runtime import laws
from fe.runtime.arrays import IntArray
from fe.runtime.motion import Laws
from fe.runtime.motion_arrays import FIRST_PARTS, Ports

# ---------------------------------------------------------------- the laws, step by step


def held_forces(
    x: FloatArray, v: FloatArray, last: FloatArray, gain: FloatArray, h: float, ports: Ports,
    memory: FloatArray, forces: FloatArray, room: FloatArray,
) -> None:  # fmt: skip
    """Take `forces` (J,) of the laws from those over the last step to those over the next.

    The memory is carried to the middle of the step, and `last` to `v`.

    Parameters
    ----------
    x, v, last : (J,) ndarray
        Displacement and velocity of each law's port, and its velocity a step before.
    gain : (J, J) ndarray
        Speed that a unit force of each law (column) takes from the port of another over a step of `h`.
    room : (2, J) ndarray
        For the speeds that the forces took over the last step, and for accelerations without them.
    """
    count, taken, push = len(ports.numbers), room[0], room[1]
    for j in range(count):
        taken[j] = 0.0
        for i in range(count):
            taken[j] += gain[j, i] * forces[i]
        push[j] = (v[j] - last[j] + taken[j]) / h
        last[j] = v[j]
    for j in range(count):
        forces[j] = taken[j]
    for j in range(count):
        if ports.of_speed[j] == 0:
            middle = x[j] + 0.5 * h * v[j] + h * h / 6.0 * (push[j] - taken[j] / h)
            laws.advance(ports.numbers[j], ports.values[j], memory[j], middle, 1)
            forces[j] = laws.pull(ports.numbers[j], ports.values[j], memory[j], middle, 1.0, 1)[0]
    for j in range(count):
        if ports.of_speed[j] == 1:
            left = push[j]
            for i in range(count):
                if i < j or ports.of_speed[i] == 0:
                    left -= gain[j, i] * forces[i] / h
            middle = x[j] + 0.5 * h * v[j] + 0.125 * h * h * (push[j] - taken[j] / h)
            strength = laws.strength(ports.numbers[j], ports.values[j], gain[j, j] / h)
            strength *= laws.share(ports.numbers[j], ports.values[j], middle)
            forces[j] = laws.held(ports.numbers[j], ports.values[j], v[j], left, gain[j, j], strength, h)


def couple(
    system: tuple[FloatArray, ...], free: FloatArray, h: float, gain: FloatArray, port_of: IntArray,
    ports: Ports, memory: FloatArray, last: FloatArray, states: FloatArray, applied: FloatArray,
) -> None:  # fmt: skip
    """Couple the laws with a linear system; fill `states` (N + 1, n), and add the forces to `applied` (N, P).

    `system` holds transition, drive, and rows (2 P, n), (2 P, P) of the ports' displacements and speeds, to
    which `free` (N + 1, 2 P) is added; `last` (J,) as in `held_forces`.
    """
    transition, drive, seen, direct = system
    count, size = len(applied), len(ports.numbers)
    order, width = transition.shape[0], applied.shape[1]
    rows = np.zeros((5, size))
    x, v, forces, room = rows[0], rows[1], rows[2], rows[3:]
    for k in range(count):
        for j in range(size):
            p = port_of[j]
            x[j], v[j] = free[k, p], free[k, width + p]
            for n in range(order):
                x[j] += seen[p, n] * states[k, n]
                v[j] += seen[width + p, n] * states[k, n]
            for i in range(width if k > 0 else 0):
                x[j] += direct[p, i] * applied[k - 1, i]
                v[j] += direct[width + p, i] * applied[k - 1, i]
        held_forces(x, v, last, gain, h, ports, memory, forces, room)
        for j in range(size):
            applied[k, port_of[j]] -= forces[j]
        for n in range(order):
            total = 0.0
            for i in range(width):
                total += drive[n, i] * applied[k, i]
            for i in range(order):
                total += transition[n, i] * states[k, i]
            states[k + 1, n] = total


def begin(positions: FloatArray, ports: Ports, memory: FloatArray) -> None:
    """Load the laws from zero to positions (J,) without turning."""
    for j in range(len(positions)):
        laws.advance(ports.numbers[j], ports.values[j], memory[j], positions[j], FIRST_PARTS)


@cache
def _compiled(loop: Callable[..., None]) -> Callable[..., None]:
    if loop is couple:
        callable_when_compiled(held_forces, makes_arrays=False)
    return compiled(loop, (*law_functions(), Ports))  # a constant stands in the file of `Ports`


def _ports(internal: Laws) -> Ports:
    """Return the laws for the loops above, which know the ports by their own rows."""
    return internal.at(np.zeros((len(internal), 0)))


def first_memory(internal: Laws, positions: FloatArray) -> FloatArray:
    """Return the memory (J, 5 + E) of laws that were loaded from zero to positions (J,) without turning."""
    memory = internal.memory()
    _compiled(begin)(np.ascontiguousarray(positions), _ports(internal), memory)
    return memory


def coupled_motion(
    system: PortSystem, step: float, start: FloatArray, forces: FloatArray, free: FloatArray,
    laws: Laws, port_of: list[int],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return states (N + 1, n) and applied forces (N, P) of a linear system with laws at its ports.

    Parameters
    ----------
    system : PortSystem
        Its outputs are those of `PortSystem.of_ports`.
    step : float
        [s].
    start, forces : (n,), (N, P) ndarray
        State at the begin, and forces over the steps beside those of the laws.
    free : (N + 1, 2 P) ndarray
        Displacement and velocity of the ports that are not those of the system.
    laws : Laws
        Internal forces.
    port_of : list of int
        Port of each law.
    """
    index, (transition, drive) = np.array(port_of, dtype=np.int64), system.over(step)
    speeds = len(system.outputs) // 2 + index
    gain = (system.outputs[speeds] @ drive + system.direct[speeds])[:, index]
    states, applied = np.zeros((len(forces) + 1, len(start))), forces.copy()
    states[0] = start
    arrays = (transition, drive, system.outputs, system.direct)
    _compiled(couple)(
        tuple(map(np.ascontiguousarray, arrays)), np.ascontiguousarray(free), step,
        np.ascontiguousarray(gain), index, _ports(laws), first_memory(laws, free[0, index]),
        2.0 * free[0, speeds] - free[1, speeds], states, applied,
    )  # fmt: skip
    return states, applied


def stepper(
    laws: Laws, port_of: list[int], gain: FloatArray, step: float, free: FloatArray
) -> Callable[[FloatArray], FloatArray]:
    """Return what gives the forces (P,) over the next step of an FMU, from how its ports are and move (2 P,).

    Parameters
    ----------
    laws : Laws
        Internal forces.
    port_of : list of int
        Port of each law.
    gain : (P, P) ndarray
        Speed of each port after a step with a unit force at another.
    step : float
        [s].
    free : (2, 2 P) ndarray
        Displacement and velocity of the ports without the laws, at the start and a step later.
    """
    index, ports = np.array(port_of, dtype=np.int64), _ports(laws)
    speeds = len(gain) + index
    own = np.ascontiguousarray(gain[np.ix_(index, index)])
    memory, last = first_memory(laws, free[0, index]), 2.0 * free[0, speeds] - free[1, speeds]
    forces, room = np.zeros(len(laws)), np.zeros((2, len(laws)))

    def forces_at(moving: FloatArray) -> FloatArray:
        _compiled(held_forces)(moving[index], moving[speeds], last, own, step, ports, memory, forces, room)
        given = np.zeros(len(gain))
        np.subtract.at(given, index, forces)
        return given

    return forces_at
