"""Where ports with laws rest, load level after load level: x + C F(x) = x_linear; or one in motion.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file is copied
into the FMU.
"""

import numpy as np

from . import laws
from .arrays import FADING, FORCE, LAGGED, PLACE
from .motion_arrays import FloatArray, Ports, Unnamed


def static_forces(x: FloatArray, ports: Ports, memory: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return forces and slopes (J,) at positions `x` (J,) reached from `memory`, which stays as it is.

    Laws of speed are zero at rest.
    """
    forces, slopes = np.zeros(len(x)), np.zeros(len(x))
    for j in range(len(x)):
        if ports.of_speed[j] == 0:
            forces[j], slopes[j] = laws.pull(ports.numbers[j], ports.values[j], memory[j], x[j], 1.0)
    return forces, slopes


def static_path(
    linear: FloatArray, compliance: FloatArray, at_ports: Unnamed, memory: FloatArray, start: FloatArray,
    positions: FloatArray, forces: FloatArray,
) -> int:  # fmt: skip
    """Solve x + C F(x) = x_linear for load levels one after the other; `memory` is advanced in place.

    Newton's method with halved steps; a level that it does not reach is approached in up to 256 parts.

    Parameters
    ----------
    linear : (L, J) ndarray
        Positions of the ports without internal forces.
    compliance : (J, J) ndarray
        C, positions of the ports under unit forces at them.
    at_ports : tuple
        The fields of `Ports`; what they do to modes is not used.
    memory : (J, 5 + E) ndarray
        State at the start.
    start : (J,) ndarray
        Linear positions at the start; zero at rest without load.
    positions, forces : (L, J) ndarray
        Results.

    Returns
    -------
    int
        -1, or the number of the level that has no solution.
    """
    ports, count = Ports(*at_ports), len(start)
    old, x = start.copy(), memory[:, PLACE].copy()
    own, unit = np.zeros(count), np.eye(count)
    for level in range(len(linear)):
        done, step = 0.0, 1.0
        while done < 1.0:
            goal = old + (linear[level] - old) * min(done + step, 1.0)
            guess = x.copy()
            own, slopes = static_forces(guess, ports, memory)
            yielded = compliance @ own  # what a law that pulls without a load moves
            scale = np.max(np.abs(goal)) + np.max(np.abs(x)) + np.max(np.abs(yielded)) + 1e-300
            residual = guess + yielded - goal
            size = np.max(np.abs(residual))
            for _ in range(60):
                if size <= 1e-12 * scale:
                    break
                # A singular matrix is moved off its zero. Compiled, `solve` takes five seconds longer.
                move = np.linalg.inv(unit + compliance * slopes + 1e-14 * unit) @ residual
                fraction, before = 1.0, size
                while size == before and fraction > 4e-4:
                    candidate = guess - fraction * move
                    trial, trial_slopes = static_forces(candidate, ports, memory)
                    rest = candidate + compliance @ trial - goal
                    if np.max(np.abs(rest)) < size:
                        guess, own, slopes, residual = candidate, trial, trial_slopes, rest
                        size = np.max(np.abs(rest))
                    fraction *= 0.5
                if size == before:
                    break
            # What is left may be rounding, or a kink met exactly. A solution that is not stable lies on
            # another branch, beyond a snap.
            if size <= 1e-9 * scale and np.linalg.det(unit + compliance * slopes) > -1e-9:
                x = guess
                for j in range(count):
                    if ports.of_speed[j] == 0:
                        laws.advance(ports.numbers[j], ports.values[j], memory[j], x[j])
                    memory[j, PLACE], memory[j, FADING] = x[j], 0.0
                    memory[j, LAGGED] = memory[j, FORCE] = own[j]
                done = min(done + step, 1.0)
                step *= 2.0
            else:
                step *= 0.5
                if step < 1.0 / 256.0:
                    return level
        old = linear[level]
        for j in range(count):  # numba takes two seconds to compile `positions[level] = x`
            positions[level, j] = x[j]
            forces[level, j] = own[j]
    return -1


def settle_port(port: int, ports: Ports, memory: FloatArray, y: float, r: float, h: float) -> float:
    """Return the position x of a port with laws, x + r sum F(x) = y; their forces go to the memory.

    The laws are those whose leader is `port`; of those of position, the memory has the forces at the last
    position. Dry friction first: where it can hold the port, it does. Without a duration `h` forces of speed
    stay what they are. Nothing else of the memory changes.
    """
    count = len(ports.numbers)
    last = memory[port, PLACE]
    start, level, tolerance = 0.0, 0.0, 1e-12
    for j in range(count):
        if ports.leader[j] != port:
            continue
        if ports.of_speed[j] == 0 or h == 0.0:
            start += memory[j, FORCE]
            continue
        tolerance = 1e-15  # a speed is a small difference of positions
        memory[j, FORCE] = 0.0
        if ports.values[j, 1] == 0.0:
            level += laws.pull(ports.numbers[j], ports.values[j], memory[j], last, h)[0]
    push = y - last - r * start
    if level > 0.0 and abs(push) <= r * level:
        for j in range(count):
            if ports.leader[j] == port and ports.of_speed[j] == 1 and ports.values[j, 1] == 0.0:
                own, _ = laws.pull(ports.numbers[j], ports.values[j], memory[j], last, h)
                memory[j, FORCE] = push / r * own / level
        return float(last)
    sign = 1.0 if push > 0.0 else -1.0
    # the root lies that way from the last position, if the structure is stable
    low, high = last, last + sign * 1e300
    x, rest, steep = last + sign * max(abs(push) - r * level, 0.0), 0.0, port
    at = x
    for _ in range(80):
        total, slope, steepest = 0.0, 1.0, -1.0
        for j in range(count):
            if ports.leader[j] != port:
                continue
            if ports.of_speed[j] == 0 or h > 0.0:
                own, change = laws.pull(ports.numbers[j], ports.values[j], memory[j], x, h)
                if ports.of_speed[j] == 1 and ports.values[j, 1] == 0.0:
                    own, change = sign * own, sign * change
                memory[j, FORCE] = own
                slope += r * change
                if change > steepest:
                    steep, steepest = j, change
            total += memory[j, FORCE]
        rest, at = x + r * total - y, x
        if abs(rest) <= 1e-13 * abs(push) + tolerance * (abs(x) + abs(y)):
            return float(x)
        low, high = (low, x) if sign * rest > 0.0 else (x, high)
        if abs(high - low) <= 1e-15 * abs(x):
            break
        step = x - rest / slope if slope > 1e-6 else high
        if sign * (step - low) > 0.0 and sign * (high - step) > 0.0:
            x = step
        elif abs(high) < 1e299:  # nearer to where the way begins: a force of speed may rise steeply there
            x = low + 0.1 * (high - low)
        else:
            x += sign * abs(rest)
    if r > 0.0:  # a force that rises within rounding gives what is missing
        memory[steep, FORCE] -= rest / r
    return float(at)
