"""Internal forces at the ports of an FMU by explicit co-simulation.

The force of a law is held over each communication step: that at the middle of the step, extrapolated from
displacement and velocity at its begin. What the port's speed answers to the force within one step is measured
beforehand, so that friction can stop it. Second order in the step. The laws are those of `fe.motion_kernel`.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from discrepancy.compiled_motion import MODULE, compiled_kernel
from discrepancy.models.port_system import PortSystem
from fe.motion import Laws
from fe.motion_kernel import BOUC_WEN, FIRST_PARTS, MICRO_SLIP, POWER_DAMPING

FloatArray = NDArray[np.float64]

# ---------------------------------------------------------------- the laws, step by step


def _held_damping(
    speed: float, push: float, gain: float, strength: float, exponent: float, h: float, damping_kick: Any
) -> float:
    """Return the force that damping gives when it is held over a step.

    `speed` of the port at the begin, its acceleration `push` without this force, `gain` of its speed by a
    unit of force over the step, and `strength` |s|^`exponent` the deceleration by the law.
    """
    if strength == 0.0 or gain <= 0.0:
        return 0.0
    if exponent == 0.0:
        sign = 0.0
        if speed != 0.0:
            sign = 1.0 if speed > 0.0 else -1.0
            last = speed + (push - sign * strength) * h
            if last * sign > 0.0:
                return sign * strength * h / gain
        if abs(push) <= strength:  # it stops, and stays
            return (speed + push * h) / gain
        first = 0.0 if speed == 0.0 else speed / (sign * strength - push)  # time until it turns
        first = min(max(first, 0.0), h)
        back = 1.0 if push > 0.0 else -1.0
        return (sign * first + back * (h - first)) * strength / gain
    middle = speed + 0.5 * h * push
    after = damping_kick(middle, strength, exponent, h)
    if exponent < 1.0 and (after == 0.0 or after * speed < 0.0):
        middle = speed + h * push
        after = damping_kick(middle, strength, exponent, h)
    return float((middle - after) / gain)


def _held_forces(
    x: FloatArray, v: FloatArray, push: FloatArray, before: FloatArray, h: float, gain: FloatArray,
    codes: NDArray[np.int64], values: FloatArray, slips: FloatArray, memory: FloatArray, forces: FloatArray,
    power: Any, displacement_force: Any, advance_memory: Any, damping_kick: Any, held_damping: Any,
) -> None:  # fmt: skip
    """Set `forces` (J,) of the laws over the next step; the memory is carried to its middle.

    Parameters
    ----------
    x, v, push : (J,) ndarray
        Displacement, velocity and acceleration without the laws of each law's port.
    before : (J,) ndarray
        Forces of the last step.
    gain : (J, J) ndarray
        Speed that a unit force of each law (column) takes from the port of another over a step.
    """
    count = len(codes)
    for j in range(count):
        forces[j] = 0.0
        for i in range(count):
            forces[j] += gain[j, i] * before[i]
    taken = forces.copy()
    for j in range(count):
        if codes[j] != POWER_DAMPING:
            middle = x[j] + 0.5 * h * v[j] + h * h / 6.0 * (push[j] - taken[j] / h)
            if codes[j] == MICRO_SLIP or codes[j] == BOUC_WEN:
                advance_memory(codes[j], values[j], slips[j], memory[j], middle, 1)
            forces[j] = displacement_force(codes[j], values[j], memory[j], middle)
    for j in range(count):
        if codes[j] == POWER_DAMPING:
            left = push[j]
            for i in range(count):
                if i < j or codes[i] != POWER_DAMPING:
                    left -= gain[j, i] * forces[i] / h
            middle = x[j] + 0.5 * h * v[j] + 0.125 * h * h * (push[j] - taken[j] / h)
            strength = gain[j, j] / h * values[j, 0] / power(values[j, 3], values[j, 1])
            strength *= power(abs(middle / values[j, 4]), values[j, 2])
            forces[j] = held_damping(v[j], left, gain[j, j], strength, values[j, 1], h, damping_kick)


def _coupled(
    transition: FloatArray, drive: FloatArray, x_rows: FloatArray, x_direct: FloatArray, v_rows: FloatArray,
    v_direct: FloatArray, free_x: FloatArray, free_v: FloatArray, h: float, gain: FloatArray,
    port_of: NDArray[np.int64], codes: NDArray[np.int64], values: FloatArray, slips: FloatArray,
    memory: FloatArray, states: FloatArray, applied: FloatArray, held_forces: Any, power: Any,
    displacement_force: Any, advance_memory: Any, damping_kick: Any, held_damping: Any,
) -> None:  # fmt: skip
    """Couple the laws with a linear system; `states` (N + 1, n) and `applied` (N, P) are filled.

    Rows of the ports (P, n), (P, P) and free motions (N + 1, P) are those of displacement and velocity.
    """
    count, laws = len(applied), len(codes)
    order, ports = transition.shape[0], applied.shape[1]
    x, v, push, last = np.zeros(laws), np.zeros(laws), np.zeros(laws), np.zeros(laws)
    before, forces = np.zeros(laws), np.zeros(laws)
    for k in range(count):
        for j in range(laws):
            p = port_of[j]
            place, speed = free_x[k, p], free_v[k, p]
            for n in range(order):
                place += x_rows[p, n] * states[k, n]
                speed += v_rows[p, n] * states[k, n]
            if k > 0:
                for i in range(ports):
                    place += x_direct[p, i] * applied[k - 1, i]
                    speed += v_direct[p, i] * applied[k - 1, i]
            x[j], v[j] = place, speed
            if k == 0:
                push[j] = (free_v[1, p] - free_v[0, p]) / h
            else:
                push[j] = speed - last[j]
                for i in range(laws):
                    push[j] += gain[j, i] * before[i]
                push[j] /= h
            last[j] = speed
        held_forces(
            x, v, push, before, h, gain, codes, values, slips, memory, forces, power, displacement_force,
            advance_memory, damping_kick, held_damping,
        )  # fmt: skip
        for j in range(laws):
            before[j] = forces[j]
            applied[k, port_of[j]] -= forces[j]
        for n in range(order):
            total = 0.0
            for i in range(ports):
                total += drive[n, i] * applied[k, i]
            for i in range(order):
                total += transition[n, i] * states[k, i]
            states[k + 1, n] = total


@cache
def _compiled() -> dict[str, Callable[..., Any]]:
    compiled_kernel()
    kernel = sys.modules[MODULE]
    functions = {name: getattr(kernel, name) for name in (
        "power", "displacement_force", "advance_memory", "damping_kick",
    )}  # fmt: skip
    for name, function in (
        ("held_damping", _held_damping), ("held_forces", _held_forces), ("coupled", _coupled),
    ):  # fmt: skip
        functions[name] = numba.njit(nogil=True, error_model="numpy")(function)
    return functions


_SHARED = ("power", "displacement_force", "advance_memory", "damping_kick", "held_damping")


def first_memory(laws: Laws, positions: FloatArray) -> FloatArray:
    """Return the memory (J, 2 + E) of laws that were loaded from zero to positions (J,) without turning."""
    memory = laws.memory()
    advance = _compiled()["advance_memory"]
    for j, code in enumerate(laws.codes):
        if code in (MICRO_SLIP, BOUC_WEN):
            advance(code, laws.values[j], laws.slips[j], memory[j], positions[j], FIRST_PARTS)
    return memory


@dataclass(frozen=True)
class PortMotion:
    """Free motion at the ports, rows of a system that give what forces add, and who acts where.

    Attributes
    ----------
    displacement, velocity : (N + 1, P) ndarray
        Without the laws.
    gain : (P, P) ndarray
        Speed of each port after a step with a unit force at another.
    """

    displacement: FloatArray
    velocity: FloatArray
    gain: FloatArray


def coupled_motion(
    system: PortSystem,
    free: PortMotion,
    x_rows: FloatArray,
    x_direct: FloatArray,
    v_rows: FloatArray,
    v_direct: FloatArray,
    laws: Laws,
    port_of: list[int],
) -> tuple[FloatArray, FloatArray]:
    """Return states (N + 1, n) and applied forces (N, P) of a linear system with laws at its ports."""
    functions = _compiled()
    index = np.array(port_of, dtype=np.int64)
    steps = len(free.displacement) - 1
    states = np.zeros((steps + 1, len(system.transition)))
    applied = np.zeros((steps, free.displacement.shape[1]))
    memory = first_memory(laws, free.displacement[0, index])
    arrays = (
        system.transition, system.drive, x_rows, x_direct, v_rows, v_direct, free.displacement, free.velocity,
    )  # fmt: skip
    functions["coupled"](
        *(np.ascontiguousarray(item, dtype=np.float64) for item in arrays), system.step,
        np.ascontiguousarray(free.gain[np.ix_(index, index)]), index, laws.codes, laws.values, laws.slips,
        memory, states, applied, functions["held_forces"], *(functions[name] for name in _SHARED),
    )  # fmt: skip
    return states, applied


class LawStepper:
    """The laws beside an FMU that is stepped: displacement and velocity of the ports in, forces out.

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
    displacement, push : (P,) ndarray
        Displacement of the ports at the start, and their acceleration without the laws.
    """

    def __init__(
        self,
        laws: Laws,
        port_of: list[int],
        gain: FloatArray,
        step: float,
        displacement: FloatArray,
        push: FloatArray,
    ) -> None:
        self._laws, self._index, self._step = laws, np.array(port_of, dtype=np.int64), step
        self._gain = np.ascontiguousarray(gain[np.ix_(self._index, self._index)])
        self._push = push[self._index]
        self._memory = first_memory(laws, displacement[self._index])
        self._before, self._forces = np.zeros((2, len(laws)))
        self._last: FloatArray | None = None
        self._ports = len(displacement)

    def forces(self, displacement: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return what the FMU is given (P,) over the next step."""
        functions = _compiled()
        x, v = displacement[self._index], velocity[self._index]
        push = self._push
        if self._last is not None:
            push = (v - self._last + self._gain @ self._before) / self._step
        self._last = v
        functions["held_forces"](
            x, v, push, self._before, self._step, self._gain, self._laws.codes, self._laws.values,
            self._laws.slips, self._memory, self._forces, *(functions[name] for name in _SHARED),
        )  # fmt: skip
        self._before[:] = self._forces
        given = np.zeros(self._ports)
        np.subtract.at(given, self._index, self._forces)
        return given
