"""Internal forces at the ports of an FMU by explicit co-simulation, and the FMU's ports as a linear system.

The force of a law is held over each communication step: that at the middle of the step, extrapolated from
displacement and velocity at its begin. What the port's speed answers to the force within one step is measured
beforehand, so that friction can stop it. Second order in the step. The laws are those of `fe.motion_kernel`.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, logm

from discrepancy.compiled_motion import MODULE, compiled_kernel
from fe.motion import Laws
from fe.motion_kernel import BOUC_WEN, FIRST_PARTS, MICRO_SLIP, POWER_DAMPING

FloatArray = NDArray[np.float64]

MOST_STATES = 40
"""Largest order of a linear system that is made from records."""
HANKEL_ROWS = 160
FIT = 1e-7
"""Largest error of a linear system against the record that it is made of, as a share of the record."""


@dataclass(frozen=True, eq=False)
class PortSystem:
    """What forces at P ports do to C outputs of a linear FMU, step by step, beside its free motion.

    s(k+1) = A s(k) + B f(k), y(k+1) = C s(k+1) + D f(k), f held over the step.

    Attributes
    ----------
    transition, drive, outputs, direct : ndarray
        A (n, n), B (n, P), C (C, n), D (C, P).
    step : float
        [s].
    """

    transition: FloatArray
    drive: FloatArray
    outputs: FloatArray
    direct: FloatArray
    step: float

    @cached_property
    def generator(self) -> FloatArray:
        """Matrix (n, n) of the motion in time, s' = G s without forces [1/s]."""
        return np.asarray(np.real(logm(self.transition)) / self.step)

    def refined(self, parts: int) -> "PortSystem":
        """Return the same system with steps that are so many times smaller."""
        order = len(self.transition)
        block = np.zeros((2 * order, 2 * order))
        block[:order, :order], block[:order, order:] = self.generator, np.eye(order)
        whole, part = expm(block * self.step), expm(block * self.step / parts)
        start = np.linalg.solve(whole[:order, order:], self.drive)
        return PortSystem(
            part[:order, :order], part[:order, order:] @ start, self.outputs, self.direct, self.step / parts
        )

    def motion(self, forces: FloatArray) -> FloatArray:
        """Return the outputs (N + 1, C) under forces (N, P), from rest."""
        states = np.zeros((len(forces) + 1, len(self.transition)))
        for k, force in enumerate(forces):
            states[k + 1] = self.transition @ states[k] + self.drive @ force
        return self.seen(states, forces)

    def seen(self, states: FloatArray, forces: FloatArray) -> FloatArray:
        """Return the outputs (N + 1, C) of states (N + 1, n) and forces (N, P)."""
        values = states @ self.outputs.T
        values[1:] += forces @ self.direct.T
        return np.asarray(values)

    def start_of(self, free: FloatArray, tolerance: float) -> FloatArray | None:
        """Return the state (n,) from which the system moves as `free` (K, C), None if it does not."""
        rows = np.empty((*free.shape, len(self.transition)))
        rows[0] = self.outputs
        for k in range(1, len(free)):
            rows[k] = rows[k - 1] @ self.transition
        size = np.max(np.abs(free), axis=0)
        weight = 1.0 / np.where(size > 0.0, size, 1.0)
        flat = (rows * weight[:, None]).reshape(-1, len(self.transition))
        unit = np.max(np.abs(flat), axis=0)
        unit[unit == 0.0] = 1.0
        goal = (free * weight).ravel()
        start = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0]
        if np.max(np.abs(flat / unit @ start - goal)) > tolerance:
            return None
        return np.asarray(start / unit)

    def free(self, start: FloatArray, steps: int) -> FloatArray:
        """Return the free motion (steps + 1, C) from a state (n,)."""
        states = np.empty((steps + 1, len(start)))
        states[0] = start
        block = [np.eye(len(start))]
        for _ in range(min(64, steps + 1)):
            block.append(self.transition @ block[-1])
        jump, powers = block.pop(), np.stack(block)
        now = start
        for k in range(0, steps + 1, len(powers)):
            part = powers @ now
            states[k : k + len(powers)] = part[: steps + 1 - k]
            now = jump @ now
        return np.asarray(states @ self.outputs.T)

    def gain(self) -> FloatArray:
        """Return the outputs (C, P) at rest under constant unit forces."""
        still = np.linalg.solve(np.eye(len(self.transition)) - self.transition, self.drive)
        return np.asarray(self.outputs @ still + self.direct)

    def modes(self, row: FloatArray, port: int) -> tuple[FloatArray, FloatArray]:
        """Return the modes that a port sees: angular frequencies [rad/s] and squared shapes at it [1/kg].

        `row` (n,) is that of the port's displacement.
        """
        values, shapes = np.linalg.eig(self.transition)
        into = np.linalg.solve(shapes, self.drive[:, port].astype(complex))
        keep = (values.imag > 1e-12) & (np.abs(values) > 0.0)
        values, into, out = values[keep], into[keep], (row @ shapes)[keep]
        rate = np.log(values) / self.step
        # over a step the force adds (e^(rate h) - 1) / rate of what it gives at once
        residue = out * into * rate / (values - 1.0)
        return np.abs(rate), np.abs(2.0 * rate.imag * residue)


def port_system(records: FloatArray, ports: list[int], step: float) -> PortSystem | None:
    """Return the linear system of answers to unit forces that are held over the first step only.

    The realisation of Ho and Kalman (1966) as by Juang and Pappa (1985), from the displacements of the ports.

    Parameters
    ----------
    records : (K, C, P) ndarray
        Outputs at the ends of the steps for a force at each port.
    ports : list of int
        Columns of the ports' displacements.
    step : float
        [s].

    Returns
    -------
    PortSystem or None
        None if no system of at most `MOST_STATES` states shows the records within `FIT`.
    """
    count, columns, inputs = records.shape
    size = np.max(np.abs(records), axis=(0, 2))
    seen = records[:, ports, :] / np.where(size[ports] > 0.0, size[ports], 1.0)[None, :, None]
    width = min(HANKEL_ROWS, (count - 2) // 2)
    if width < 4:
        return None
    row = np.arange(width)
    both = seen[1 + np.arange(width + 1)[:, None] + row].transpose(0, 2, 1, 3)
    both = both.reshape((width + 1) * len(ports), width * inputs)
    hankel, shifted = both[: -len(ports)], both[len(ports) :]
    left, values, right = np.linalg.svd(hankel, full_matrices=False)
    if values[0] == 0.0:
        return None
    tried = 0
    for threshold in (1e-12, 1e-11, 1e-10, 1e-9, 1e-8, 1e-7):
        order = int(np.sum(values > threshold * values[0]))
        if order == tried or order > MOST_STATES:
            continue
        tried = order
        root = np.sqrt(values[:order])
        transition = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        if np.max(np.abs(np.linalg.eigvals(transition))) > 1.0 + 1e-9:
            continue
        try:
            drive = np.linalg.solve(transition, (root[:, None] * right[:order])[:, :inputs])
        except np.linalg.LinAlgError:
            continue
        states = np.empty((count, order, inputs))
        states[0] = drive
        for k in range(1, count):
            states[k] = transition @ states[k - 1]
        flat = states[1:].transpose(0, 2, 1).reshape(-1, order)
        goal = records[1:].transpose(0, 2, 1).reshape(-1, columns)
        unit = np.max(np.abs(flat), axis=0)
        rows = np.linalg.lstsq(flat / unit, goal, rcond=1e-14)[0].T / unit
        error = np.max(np.abs(goal - flat @ rows.T), axis=0)
        if np.all(error <= FIT * np.max(np.abs(goal), axis=0) + 1e-300):
            return PortSystem(transition, drive, rows, records[0] - rows @ drive, step)
    return None


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
