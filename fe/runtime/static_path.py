"""Solve the positions of ports with laws: at rest along a load path, or of one port in motion.

At rest x + C F(x) = x_linear: C F are the displacements by the forces F of the laws, which
act against the motion, and x_linear is the position of the linear structure. Written in the subset
of Python that numba compiles too. NumPy and relative imports only: this file is copied into the
FMU.
"""

import numpy as np

from . import laws
from .arrays import FADING_POSITION, FORCE, LAGGED_FORCE, POSITION
from .laws import speed
from .motion_arrays import FloatArray, PortArrays, RecordFields

_SMALLEST_PART = 1.0 / 256.0
"""Fraction of a load level below which it is not divided further: it has no solution."""
_MOST_STATIC_STEPS = 60
"""Largest number of Newton steps for an equilibrium of all ports."""
_SMALLEST_FRACTION = 4e-4
"""Fraction below which a Newton step is not shortened."""
_ACCURATE = 1e-12
"""Relative residual at which an equilibrium counts as exact."""
_MOST_MOTION_STEPS = 80
"""Largest number of iterations for the position of one port in motion."""
_UNKNOWN_END = 1e300
"""Distance to an end of the bracket that is not known yet."""


def static_path(
    linear_positions: FloatArray,
    compliance: FloatArray,
    port_fields: RecordFields,
    memory: FloatArray,
    start: FloatArray,
    positions: FloatArray,
    forces: FloatArray,
) -> int:
    """Solve x + C F(x) = x_linear for load levels that follow one another.

    A level that Newton's method does not reach from the previous one is approached in smaller
    steps.

    Parameters
    ----------
    linear_positions : (L, J) array
        x_linear, positions of the laws' ports without internal forces, at each level.
    compliance : (J, J) array
        C, positions of the ports (rows) under unit forces at them (columns).
    port_fields : tuple
        Fields of `PortArrays`; those of modes are not used.
    memory : (J, 5 + E) array
        Memory of the laws at the start; changed in place to that of the last level.
    start : (J,) array
        Linear positions at the start; zero at rest without load.
    positions, forces : (L, J) array
        Results, in place: positions of the ports and forces of the laws.

    Returns
    -------
    int
        -1, or the index of the level that has no solution.
    """
    ports = PortArrays(*port_fields)
    count = len(start)
    previous_level = start.copy()
    x = memory[:, POSITION].copy()
    x_forces = np.zeros(count)
    for level in range(len(linear_positions)):
        # approach the level in parts; a part is halved if Newton's method fails, else doubled
        fraction_done = 0.0
        step = 1.0
        while fraction_done < 1.0:
            fraction = min(fraction_done + step, 1.0)
            goal = previous_level + (linear_positions[level] - previous_level) * fraction
            solved, solution, x_forces = solve_static_position(goal, x, ports, memory, compliance)
            if solved:
                x = solution
                update_memory(ports, memory, x, x_forces)
                fraction_done = fraction
                step *= 2.0
            else:
                step *= 0.5
                if step < _SMALLEST_PART:
                    return level
        previous_level = linear_positions[level]
        for j in range(count):  # numba takes two seconds to compile `positions[level] = x`
            positions[level, j] = x[j]
            forces[level, j] = x_forces[j]
    return -1


def solve_static_position(
    goal: FloatArray,
    start: FloatArray,
    ports: PortArrays,
    memory: FloatArray,
    compliance: FloatArray,
) -> tuple[bool, FloatArray, FloatArray]:
    """Solve x + C F(x) = goal by Newton's method with step halving.

    Parameters
    ----------
    goal, start : (J,) array
        Linear positions of the ports, and the positions from which to begin.
    memory : (J, 5 + E) array
        The memory of the laws; not changed.
    compliance : (J, J) array
        C, positions of the ports (rows) under unit forces at them (columns).

    Returns
    -------
    solved : bool
        Whether the positions are a stable solution.
    x, forces : (J,) array
        Positions of the ports and forces of the laws.
    """
    unit = np.eye(len(goal))
    x = start.copy()
    forces, slopes = static_forces(x, ports, memory)
    displaced = compliance @ forces  # a preloaded law displaces the ports even without a load
    # The residual is judged by the largest displacement; the last term avoids a scale of zero.
    scale = np.max(np.abs(goal)) + np.max(np.abs(start)) + np.max(np.abs(displaced)) + 1e-300
    residual = x + displaced - goal
    residual_norm = np.max(np.abs(residual))
    for _ in range(_MOST_STATIC_STEPS):
        if residual_norm <= _ACCURATE * scale:
            break
        # The Jacobian is I + C dF/dx. The tiny multiple of I keeps a singular one invertible. `inv`
        # and not `solve`, which takes numba five seconds longer to compile.
        step = np.linalg.inv(unit + compliance * slopes + 1e-14 * unit) @ residual
        fraction = 1.0
        previous_norm = residual_norm
        while residual_norm == previous_norm and fraction > _SMALLEST_FRACTION:
            candidate = x - fraction * step
            candidate_forces, candidate_slopes = static_forces(candidate, ports, memory)
            candidate_residual = candidate + compliance @ candidate_forces - goal
            candidate_norm = np.max(np.abs(candidate_residual))
            if candidate_norm < residual_norm:
                x = candidate
                forces = candidate_forces
                slopes = candidate_slopes
                residual = candidate_residual
                residual_norm = candidate_norm
            fraction *= 0.5
        if residual_norm == previous_norm:
            break
    # Near 1e-9 the remaining residual may be rounding, or that of a kink of a law. A negative
    # determinant means an unstable equilibrium, on another branch, which snap-through separates
    # from this one.
    solved = residual_norm <= 1e-9 * scale and np.linalg.det(unit + compliance * slopes) > -1e-9
    return solved, x, forces


def static_forces(
    x: FloatArray, ports: PortArrays, memory: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the forces of the laws and their slopes dF/dx (J,) at rest, at positions x (J,).

    Laws of speed have no force at rest. The memory describes the point from which the positions
    are reached; it is not changed.
    """
    forces = np.zeros(len(x))
    slopes = np.zeros(len(x))
    for j in range(len(x)):
        if ports.depends_on_speed[j] == 0:
            forces[j], slopes[j] = laws.force_and_slope(
                ports.law_number[j], ports.parameters[j], memory[j], x[j], 1.0
            )
    return forces, slopes


def update_memory(ports: PortArrays, memory: FloatArray, x: FloatArray, forces: FloatArray) -> None:
    """Update the memory of the laws to positions `x` (J,) at rest under `forces` (J,), in place."""
    for j in range(len(x)):
        if ports.depends_on_speed[j] == 0:
            laws.advance(ports.law_number[j], ports.parameters[j], memory[j], x[j])
        memory[j, POSITION] = x[j]
        memory[j, FADING_POSITION] = 0.0
        memory[j, FORCE] = forces[j]
        memory[j, LAGGED_FORCE] = forces[j]


def solve_port_position(
    port: int, ports: PortArrays, memory: FloatArray, y: float, r: float, h: float
) -> float:
    """Solve x + r sum F(x) = y for the position x of a port in motion at the end of a step.

    The sum is over the laws that act at the port. The equation is solved by Newton's method within
    a bracket. If dry friction is strong enough to hold the port, the position does not change.

    Parameters
    ----------
    port : int
        Index of the leading law among the laws at the port.
    memory : (J, 5 + E) array
        The memory of the laws; that of a law of position has the force at the last position. Only
        the new forces of the port's laws are written to it.
    y : float
        The position of the port without the forces of its laws.
    r : float
        Flexibility of the port with which it follows a force within the step.
    h : float
        Duration of the step [s]; if it is zero, the forces of laws of speed keep their values.
    """
    last_position = memory[port, POSITION]
    start, friction, tolerance = forces_at_last_position(port, ports, memory, h)
    displacement = y - last_position - r * start
    if friction > 0.0 and abs(displacement) <= r * friction:
        share_friction(port, ports, memory, displacement / r, friction, h)
        return float(last_position)
    # For a stable structure the residual increases with x, so that the root lies on the side of
    # the last position to which the free displacement points.
    sign = 1.0 if displacement > 0.0 else -1.0
    low = last_position
    high = last_position + sign * _UNKNOWN_END  # until an iterate lies beyond the root
    x = last_position + sign * max(abs(displacement) - r * friction, 0.0)
    evaluated = x
    residual = 0.0
    steepest = port
    for _ in range(_MOST_MOTION_STEPS):
        total, slope, steepest = port_forces(port, ports, memory, x, r, h, sign, steepest)
        residual = x + r * total - y
        evaluated = x
        if abs(residual) <= 1e-13 * abs(displacement) + tolerance * (abs(x) + abs(y)):
            return float(x)
        # the bracket
        if sign * residual > 0.0:
            high = x
        else:
            low = x
        if abs(high - low) <= 1e-15 * abs(x):
            break
        # Newton's step if it stays within the bracket, else a point near its low end
        newton = x - residual / slope if slope > 1e-6 else high
        if sign * (newton - low) > 0.0 and sign * (high - newton) > 0.0:
            x = newton
        elif abs(high) < 0.1 * _UNKNOWN_END:
            # near to the low end, where a force of speed may rise steeply
            x = low + 0.1 * (high - low)
        else:
            x += sign * abs(residual)
    # The steepest force changes by more than the residual within the rounding of x: it takes the
    # value that makes the residual zero.
    if r > 0.0:
        memory[steepest, FORCE] -= residual / r
    return float(evaluated)


def forces_at_last_position(
    port: int, ports: PortArrays, memory: FloatArray, h: float
) -> tuple[float, float, float]:
    """Return the forces of a port's laws before the port moves.

    The forces of laws of speed are set to zero in the memory, unless the duration `h` is zero.

    Returns
    -------
    force : float
        The sum of the forces in the memory, without those of laws of speed.
    friction : float
        Largest force of dry friction.
    tolerance : float
        Relative accuracy to which the position must be solved.
    """
    last_position = memory[port, POSITION]
    force = 0.0
    friction = 0.0
    tolerance = 1e-12
    for j in range(len(ports.law_number)):
        if ports.leader[j] != port:
            continue
        if ports.depends_on_speed[j] == 0 or h == 0.0:
            force += memory[j, FORCE]
            continue
        tolerance = 1e-15  # a speed is a small difference of positions
        memory[j, FORCE] = 0.0
        if speed.is_dry_friction(ports.parameters[j]):
            largest, _ = laws.force_and_slope(
                ports.law_number[j], ports.parameters[j], memory[j], last_position, h
            )
            friction += largest
    return force, friction, tolerance


def share_friction(
    port: int,
    ports: PortArrays,
    memory: FloatArray,
    force: float,
    friction: float,
    h: float,
) -> None:
    """Share a force among a port's laws of dry friction, in proportion to their largest forces.

    Parameters
    ----------
    force : float
        The force that holds the port.
    friction : float
        Sum of the largest forces.
    h : float
        Duration of the step [s].
    """
    last_position = memory[port, POSITION]
    for j in range(len(ports.law_number)):
        is_of_port = ports.leader[j] == port and ports.depends_on_speed[j] == 1
        if is_of_port and speed.is_dry_friction(ports.parameters[j]):
            largest, _ = laws.force_and_slope(
                ports.law_number[j], ports.parameters[j], memory[j], last_position, h
            )
            memory[j, FORCE] = force * largest / friction


def port_forces(
    port: int,
    ports: PortArrays,
    memory: FloatArray,
    x: float,
    r: float,
    h: float,
    sign: float,
    steepest: int,
) -> tuple[float, float, int]:
    """Return the total force of a port's laws at `x`, and write each force to the memory.

    Parameters
    ----------
    r : float
        Flexibility of the port, see `solve_port_position`.
    h : float
        Duration of the step [s].
    sign : float
        Sign of the motion, for dry friction.
    steepest : int
        Any law of the port, returned if the force of none rises.

    Returns
    -------
    total_force : float
        Sum of the forces.
    slope : float
        1 + r times the sum of their derivatives by `x`.
    steepest : int
        The law whose force rises most steeply.
    """
    total_force = 0.0
    slope = 1.0
    largest_slope = -1.0
    for j in range(len(ports.law_number)):
        if ports.leader[j] != port:
            continue
        if ports.depends_on_speed[j] == 0 or h > 0.0:
            law = ports.parameters[j]
            force, force_slope = laws.force_and_slope(ports.law_number[j], law, memory[j], x, h)
            if ports.depends_on_speed[j] == 1 and speed.is_dry_friction(law):
                force = sign * force
                force_slope = sign * force_slope
            memory[j, FORCE] = force
            slope += r * force_slope
            if force_slope > largest_slope:
                steepest = j
                largest_slope = force_slope
        total_force += memory[j, FORCE]
    return total_force, slope, steepest
