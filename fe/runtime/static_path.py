"""Static path of ports with laws, load level after load level: x + C F(x) = x_linear.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file is copied
into the FMU.
"""

import numpy as np

from .laws import advance, parts, pull
from .motion_arrays import FloatArray, IntArray, Ports, Unnamed


def static_forces(
    x: FloatArray, ports: Ports, memory: FloatArray, least: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return forces and slopes (J,) at positions `x` (J,) reached from `memory`, which stays as it is.

    `least` (J,) is the least number of parts in which a hysteretic law follows the way; laws of speed are
    zero at rest.
    """
    forces, slopes = np.zeros(len(x)), np.zeros(len(x))
    for j in range(len(x)):
        if ports.of_speed[j] == 0:
            number, values, elements = ports.numbers[j], ports.values[j], ports.elements[j]
            forces[j], slopes[j] = pull(number, values, elements, memory[j], x[j], 1.0, least[j])
    return forces, slopes


def arrive_at_rest(
    x: FloatArray, ports: Ports, memory: FloatArray, least: IntArray, forces: FloatArray
) -> None:
    """Carry the memory to positions `x` (J,) where the laws rest with `forces` (J,)."""
    for j in range(len(x)):
        if ports.of_speed[j] == 0:
            advance(ports.numbers[j], ports.values[j], ports.elements[j], memory[j], x[j], least[j])
        memory[j, 1] = x[j]
        memory[j, 2] = forces[j]
        memory[j, 3] = 0.0
        memory[j, 4] = 0.0


def static_path(
    linear: FloatArray, compliance: FloatArray, laws: Unnamed, memory: FloatArray, start: FloatArray,
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
    laws : tuple
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
    ports = Ports(*laws)
    levels, count = linear.shape
    old = start.copy()
    x = memory[:, 1].copy()
    own, unit = np.zeros(count), np.eye(count)
    least = np.zeros(count, dtype=np.int64)
    for level in range(levels):
        done, step = 0.0, 1.0
        while done < 1.0:
            goal = old + (linear[level] - old) * min(done + step, 1.0)
            for j in range(count):  # fixed during the iteration, so that the force is a smooth function
                least[j] = parts(ports.numbers[j], ports.values[j], abs(goal[j] - x[j]))
            guess = x.copy()
            own, slopes = static_forces(guess, ports, memory, least)
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
                for _ in range(12):
                    candidate = guess - fraction * move
                    trial, trial_slopes = static_forces(candidate, ports, memory, least)
                    rest = candidate + compliance @ trial - goal
                    if np.max(np.abs(rest)) < size:
                        guess, own, slopes, residual = candidate, trial, trial_slopes, rest
                        size = np.max(np.abs(rest))
                        break
                    fraction *= 0.5
                if size == before:
                    break
            # What is left may be rounding, or a kink met exactly. A solution that is not stable lies on
            # another branch, beyond a snap.
            stable = np.linalg.det(unit + compliance * slopes) > -1e-9
            if size <= 1e-9 * scale and stable:
                x = guess
                arrive_at_rest(guess, ports, memory, least, own)
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
