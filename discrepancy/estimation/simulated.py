"""The motion of a trial under the laws of a hypothesis alone, without any missing force.

The substeps are those of `linearised`: the laws' force is linear over each of them, and implicit.
But the laws themselves are not made linear, so that dry friction brings a body to rest, and holds
it there.

Shapes: F fine stamps, N samples, n states, P ports, L laws, J lengths of substeps.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled, law_functions
from fe.runtime.arrays import FIRST_ELEMENT, POSITION
from fe.runtime.laws import LAWS, advance, force_and_slope
from fe.runtime.laws.interface import PARAMETERS, PortForce
from fe.runtime.laws.speed import steady_force

from .kernel import multiply, weight_moved_to_end
from .laws import mean_force
from .steps import respond_to_inputs
from .trajectory import Trajectory
from .trial import PortedTrial

LEAST_CHANGE = 1e-12
"""Change of a force at which the search for it ends, as a fraction of the force."""
MOST_REPETITIONS, MOST_EVALUATIONS = 6, 90
"""Largest number of repetitions, and of all evaluations of the laws, in this search."""
SWEEPS = 4
"""Number of times that the forces at several ports are found, each in turn (Gauss-Seidel)."""


class LawArrays(NamedTuple):
    """The laws at the ports of a trial, as compiled loops take them.

    Attributes
    ----------
    ports, numbers : (L,) array of int
        The port of each law, and the index of its class in `LAWS`.
    parameters : (L, R) array
        The parameters of each law, as `PortForce.parameter_row`, filled with zeros.
    of_speed : (L,) array of bool
        Whether a law is a function of position and speed, without memory.
    acting : (L, F) array of bool
        Whether a law acts at each fine stamp.
    memories : (L, M) array
        The memories of the laws, which change along the motion.
    """

    ports: IntArray
    numbers: IntArray
    parameters: FloatArray
    of_speed: BoolArray
    acting: BoolArray
    memories: FloatArray


@callable_when_compiled
def force_at_port(
    laws: LawArrays, port: int, stamp: int, position: float, speed: float, half_width: float
) -> tuple[float, float, float]:
    """Return the force of all laws at a port, and its tangents by position and speed.

    Laws of the speed are averaged over a window, see `mean_force`; their tangents by the position,
    which are small, are left out.
    """
    force, by_position, by_speed = 0.0, 0.0, 0.0
    for k in range(len(laws.ports)):
        if laws.ports[k] != port or not laws.acting[k, stamp]:
            continue
        law = laws.parameters[k]
        if laws.of_speed[k]:
            force += mean_force(law, position, speed, half_width)
            difference_over_window = steady_force(law, position, speed + half_width) - steady_force(
                law, position, speed - half_width
            )
            by_speed += difference_over_window / (2.0 * half_width)
        else:
            force_of_law, slope = force_and_slope(
                laws.numbers[k], law, laws.memories[k], position, 1.0
            )
            force += force_of_law
            by_position += slope
    return force, by_position, by_speed


@callable_when_compiled
def force_at_end(
    laws: LawArrays,
    port: int,
    stamp: int,
    position: float,
    speed: float,
    position_by_force: float,
    speed_by_force: float,
    half_width: float,
) -> tuple[float, float, float]:
    """Return the force that laws have at the end of a substep, and its tangents.

    The motion of the port depends on this force, for which position and speed are given at zero.
    Where a force changes the motion little, it is evaluated again and again. Where it overshoots,
    as dry friction does that stops a body, two values are on both sides of the solution, which lies
    where the line between them is zero (regula falsi).
    """
    force, by_position, by_speed = 0.0, 0.0, 0.0
    guess, excess = 0.0, 0.0
    low, excess_at_low, high, excess_at_high = 0.0, 0.0, 0.0, 0.0
    is_bracketed = False
    for count in range(MOST_EVALUATIONS):
        last_guess, last_excess = guess, excess
        if is_bracketed:
            # regula falsi, with every third step a bisection
            guess = low + (high - low) * excess_at_low / (excess_at_low - excess_at_high)
            if count % 3 == 0:
                guess = 0.5 * (low + high)
        else:
            guess = force
        force, by_position, by_speed = force_at_port(
            laws,
            port,
            stamp,
            position + position_by_force * guess,
            speed + speed_by_force * guess,
            half_width,
        )
        excess = force - guess
        if abs(excess) <= LEAST_CHANGE * abs(force):
            break
        if not is_bracketed and excess * last_excess < 0.0:
            is_bracketed = True
            low, excess_at_low, high, excess_at_high = last_guess, last_excess, guess, excess
        elif is_bracketed and excess * excess_at_low > 0.0:
            low, excess_at_low = guess, excess
        elif is_bracketed:
            high, excess_at_high = guess, excess
        elif count == MOST_REPETITIONS:
            break
        if is_bracketed and abs(high - low) <= LEAST_CHANGE * max(abs(low), abs(high)):
            break
    if is_bracketed:
        force = guess
    return force, by_position, by_speed


def simulate_laws(
    substeps: int,
    interval_of_sample: IntArray,
    transitions: FloatArray,
    by_force_at_begin: FloatArray,
    by_force_at_end: FloatArray,
    position_rows: FloatArray,
    speed_rows: FloatArray,
    least_half_widths: FloatArray,
    laws: LawArrays,
    states: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    forces: FloatArray,
) -> None:
    """Fill the motion of a linear system under laws at its ports.

    Parameters
    ----------
    substeps : int
        The number of substeps between two samples.
    interval_of_sample : (N,) array of int
        The index of the length of the interval that ends at each sample.
    transitions : (J, n, n) array
        The transition of a substep without laws, for each length.
    by_force_at_begin, by_force_at_end : (J, n, P) array
        The change of the state over a substep for a unit force at a port, at the start and at the
        end of the step.
    position_rows, speed_rows : (P, n) array
        The motion of the ports for a unit of each state.
    least_half_widths : (P,) array
        The least half width of the window of speeds at each port, see `half_widths_of_windows`.
    laws : LawArrays
        The laws; their memories are changed.
    states : (F, n) array
        The state that the laws add, which is filled; the first one is given.
    positions, speeds : (F, P) array
        The motion of the ports without laws, to which that by the laws is added.
    forces : (F, P) array
        The force of the laws at each port, which is filled.
    """
    stamps, ports = positions.shape
    count = states.shape[1]
    tangents, last_tangents = np.zeros((2, ports, count))
    begin, end = np.zeros((2, count, ports))
    position_by_force, speed_by_force = np.zeros((2, ports, ports))
    free = states[0].copy()
    half_widths = least_half_widths.copy()
    for j in range(stamps):
        interval = interval_of_sample[(j + substeps - 1) // substeps]
        last_tangents[:] = tangents
        # first with equal weights of the force at both ends, then with those of a stiff law
        moved = 0.0
        for _ in range(2):
            if j > 0:
                begin[:] = (1.0 - moved) * by_force_at_begin[interval]
                end[:] = by_force_at_end[interval] + moved * by_force_at_begin[interval]
                for i in range(count):
                    free[i] = 0.0
                    for k in range(count):
                        free[i] += transitions[interval, i, k] * states[j - 1, k]
                    for p in range(ports):
                        free[i] += begin[i, p] * forces[j - 1, p]
                multiply(position_rows, end, position_by_force)
                multiply(speed_rows, end, speed_by_force)
            for _ in range(1 if ports == 1 else SWEEPS):
                for p in range(ports):
                    position, speed = positions[j, p], speeds[j, p]
                    for i in range(count):
                        position += position_rows[p, i] * free[i]
                        speed += speed_rows[p, i] * free[i]
                    for q in range(ports):
                        if q != p:
                            position += position_by_force[p, q] * forces[j, q]
                            speed += speed_by_force[p, q] * forces[j, q]
                    forces[j, p], by_position, by_speed = force_at_end(
                        laws,
                        p,
                        j,
                        position,
                        speed,
                        position_by_force[p, p],
                        speed_by_force[p, p],
                        half_widths[p],
                    )
                    tangents[p] = by_position * position_rows[p] + by_speed * speed_rows[p]
            if j == 0:
                break
            moved = weight_moved_to_end(
                by_force_at_begin[interval], by_force_at_end[interval], last_tangents, tangents
            )
            if moved == 0.0:
                break
        for i in range(count):
            states[j, i] = free[i]
            for p in range(ports):
                states[j, i] += end[i, p] * forces[j, p]
        for p in range(ports):
            for i in range(count):
                positions[j, p] += position_rows[p, i] * states[j, i]
                speeds[j, p] += speed_rows[p, i] * states[j, i]
            if j > 0:
                passed_speeds = 0.5 * abs(speeds[j, p] - speeds[j - 1, p])
                half_widths[p] = max(least_half_widths[p], passed_speeds)
        for k in range(len(laws.ports)):
            if not laws.of_speed[k]:
                position = positions[j, laws.ports[k]]
                advance(laws.numbers[k], laws.parameters[k], laws.memories[k], position)
                laws.memories[k, POSITION] = position


@cache
def _compiled_simulation() -> Callable[..., None]:
    """Return `simulate_laws`, compiled if numba is installed."""
    return compiled(simulate_laws, law_functions())


def motion_under_laws(
    trial: PortedTrial,
    laws: Sequence[PortForce],
    shared_values: FloatArray,
    local_values: FloatArray,
    start: FloatArray,
    least_half_widths: FloatArray,
) -> Trajectory:
    """Return the motion of a trial under laws at its ports, without missing forces.

    Parameters
    ----------
    trial : PortedTrial
        The trial as a linear system with ports.
    laws : sequence of PortForce
        The laws.
    shared_values, local_values : (K,), (L,) array
        The values of the unknowns that all trials share, and of those of the trial alone.
    start : (n,) array
        The state that forces add at the first sample.
    least_half_widths : (P,) array
        The least half width of the window of speeds over which laws of the speed are averaged, at
        each port [m/s or rad/s].
    """
    stamp_count, count = len(trial.fine_time), len(start)
    states = np.zeros((stamp_count, count))
    states[0] = start
    unknowns = np.concatenate((shared_values, local_values))
    positions, speeds = trial.port_motion(unknowns, np.zeros_like(states))
    forces = np.zeros_like(positions)
    system = trial.system_at(shared_values)
    transitions, by_input_at_begin, by_input_at_end = respond_to_inputs(
        system.generator, trial.intervals.lengths / trial.substeps
    )
    _compiled_simulation()(
        trial.substeps,
        trial.intervals.length_of_sample,
        transitions,
        np.ascontiguousarray(by_input_at_begin @ -system.actions.T),
        np.ascontiguousarray(by_input_at_end @ -system.actions.T),
        np.ascontiguousarray(system.positions),
        np.ascontiguousarray(system.speeds),
        least_half_widths,
        _law_arrays(trial, laws),
        states,
        positions,
        speeds,
        forces,
    )
    ports = sorted({trial.system.ports.index(law.port) for law in laws})
    return Trajectory(states, positions, speeds, {port: forces[:, port] for port in ports})


def _law_arrays(trial: PortedTrial, laws: Sequence[PortForce]) -> LawArrays:
    """Return laws at the ports of a trial as arrays, with memories that are empty."""
    rows = [law.parameter_row for law in laws]
    parameters = np.zeros((len(laws), max(map(len, rows), default=1)))
    for number, row in enumerate(rows):
        parameters[number, : len(row)] = row
    acting = np.zeros((len(laws), len(trial.fine_time)), dtype=np.bool_)
    for number, law in enumerate(laws):
        acting[number] = law.acts_at(trial.fine_time)
    memory_size = FIRST_ELEMENT + max(1, parameters.shape[1] - PARAMETERS)
    return LawArrays(
        ports=np.array([trial.system.ports.index(law.port) for law in laws], dtype=np.int64),
        numbers=np.array([LAWS.index(type(law)) for law in laws], dtype=np.int64),
        parameters=parameters,
        of_speed=np.array([type(law).depends_on_speed for law in laws], dtype=np.bool_),
        acting=acting,
        memories=np.zeros((len(laws), memory_size)),
    )
