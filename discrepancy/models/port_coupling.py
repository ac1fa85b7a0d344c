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
            laws.advance(ports.numbers[j], ports.values[j], ports.elements[j], memory[j], middle, 1)
            forces[j] = laws.pull(
                ports.numbers[j], ports.values[j], ports.elements[j], memory[j], middle, 1.0, 1
            )[0]
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
    system: tuple[FloatArray, ...], free: tuple[FloatArray, FloatArray], h: float, gain: FloatArray,
    port_of: IntArray, ports: Ports, memory: FloatArray, states: FloatArray, applied: FloatArray,
) -> None:  # fmt: skip
    """Couple the laws with a linear system; `states` (N + 1, n) and `applied` (N, P) are filled.

    `system`: transition, drive, and the rows of the ports (P, n), (P, P), those of displacement and then of
    velocity. `free`: displacement and velocity (N + 1, P) without the laws.
    """
    transition, drive, x_rows, x_direct, v_rows, v_direct = system
    free_x, free_v = free
    count, size = len(applied), len(ports.numbers)
    order, width = transition.shape[0], applied.shape[1]
    rows = np.zeros((6, size))
    x, v, last, forces, room = rows[0], rows[1], rows[2], rows[3], rows[4:]
    for j in range(size):
        last[j] = 2.0 * free_v[0, port_of[j]] - free_v[1, port_of[j]]
    for k in range(count):
        for j in range(size):
            p = port_of[j]
            x[j], v[j] = free_x[k, p], free_v[k, p]
            for n in range(order):
                x[j] += x_rows[p, n] * states[k, n]
                v[j] += v_rows[p, n] * states[k, n]
            for i in range(width if k > 0 else 0):
                x[j] += x_direct[p, i] * applied[k - 1, i]
                v[j] += v_direct[p, i] * applied[k - 1, i]
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
        laws.advance(
            ports.numbers[j], ports.values[j], ports.elements[j], memory[j], positions[j], FIRST_PARTS
        )


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
    system: PortSystem, rows: tuple[FloatArray, ...], free_x: FloatArray, free_v: FloatArray,
    laws: Laws, port_of: list[int],
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return states (N + 1, n) and applied forces (N, P) of a linear system with laws at its ports.

    `rows` are the system's `port_rows`. Free motion (N + 1, P), displacement and velocity, is that without
    the laws; `port_of` the port of each.
    """
    index = np.array(port_of, dtype=np.int64)
    steps, width = len(free_x) - 1, free_x.shape[1]
    states, applied = np.zeros((steps + 1, len(system.transition))), np.zeros((steps, width))
    gain = rows[2] @ system.drive + rows[3]
    arrays = (system.transition, system.drive, *rows, free_x, free_v, gain[np.ix_(index, index)])
    *given, free_x, free_v, gain = (np.ascontiguousarray(item, dtype=np.float64) for item in arrays)
    _compiled(couple)(
        tuple(given), (free_x, free_v), system.step, gain, index, _ports(laws),
        first_memory(laws, free_x[0, index]), states, applied,
    )  # fmt: skip
    return states, applied


def stepper(
    laws: Laws, port_of: list[int], gain: FloatArray, step: float, free_x: FloatArray, free_v: FloatArray
) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Return what gives the forces (P,) over the next step of an FMU, from how its ports are and move.

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
    free_x, free_v : (2, P) ndarray
        Displacement and velocity of the ports without the laws, at the start and a step later.
    """
    index, ports = np.array(port_of, dtype=np.int64), _ports(laws)
    own = np.ascontiguousarray(gain[np.ix_(index, index)])
    memory, last = first_memory(laws, free_x[0, index]), (2.0 * free_v[0] - free_v[1])[index]
    forces, room = np.zeros(len(laws)), np.zeros((2, len(laws)))

    def forces_at(x: FloatArray, v: FloatArray) -> FloatArray:
        _compiled(held_forces)(x[index], v[index], last, own, step, ports, memory, forces, room)
        given = np.zeros(len(gain))
        np.subtract.at(given, index, forces)
        return given

    return forces_at
