"""The motion of a trial under the laws of a hypothesis alone, without any missing force.

The substeps are those of `linearised`: the laws' force is linear over each of them, and implicit.
But the laws themselves are not made linear, so that dry friction brings a body to rest, and holds
it there.

Shapes: F fine stamps, N samples, n states, P ports, L laws, J different lengths of substeps.
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

from .laws import mean_force, mean_tangent
from .steps import multiply, respond_to_inputs, weight_moved_to_end
from .trajectory import Trajectory
from .trial import PortedTrial

LEAST_CHANGE = 1e-12
"""Change of a force at which the search for it ends, as a fraction of the force."""
MOST_REPETITIONS = 6
"""Largest number of repetitions in this search, as long as the force does not overshoot."""
MOST_EVALUATIONS = 90
"""Largest number of evaluations of the laws in this search."""
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


class SystemArrays(NamedTuple):
    """A linear system with ports, as compiled loops take it.

    Attributes
    ----------
    transitions : (J, n, n) array
        The transition of a substep without laws, for each length.
    by_force_at_begin, by_force_at_end : (J, n, P) array
        The change of the state over a substep for a unit force at a port, at the start and at the
        end of the step.
    position_rows, speed_rows : (P, n) array
        The motion of the ports for a unit of each state.
    """

    transitions: FloatArray
    by_force_at_begin: FloatArray
    by_force_at_end: FloatArray
    position_rows: FloatArray
    speed_rows: FloatArray


@callable_when_compiled
def force_at_port(
    laws: LawArrays, port: int, stamp: int, position: float, speed: float, half_width: float
) -> tuple[float, float, float]:
    """Return the force of all laws at a port, and its derivatives by position and speed.

    Laws of the speed are averaged over a window of speeds, see `mean_force`. Their derivatives by
    the position, which are small, are left out.
    """
    force = 0.0
    by_position = 0.0
    by_speed = 0.0
    for k in range(len(laws.ports)):
        if laws.ports[k] != port or not laws.acting[k, stamp]:
            continue
        law = laws.parameters[k]
        if laws.of_speed[k]:
            force += mean_force(law, position, speed, half_width)
            by_speed += mean_tangent(law, position, speed, half_width)
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
    # the force that the laws have, and its excess over the guess that gave the motion
    force = 0.0
    by_position = 0.0
    by_speed = 0.0
    guess = 0.0
    excess = 0.0
    # two guesses on both sides of the solution
    low = 0.0
    excess_at_low = 0.0
    high = 0.0
    excess_at_high = 0.0
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
            low, excess_at_low = last_guess, last_excess
            high, excess_at_high = guess, excess
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


@callable_when_compiled
def solve_forces(
    system: SystemArrays,
    laws: LawArrays,
    stamp: int,
    state: FloatArray,
    by_force: FloatArray,
    positions: FloatArray,
    speeds: FloatArray,
    half_widths: FloatArray,
    forces: FloatArray,
    tangents: FloatArray,
) -> None:
    """Fill the laws' forces (P,) at the end of a substep, and their tangents (P, n).

    Tangents are the derivatives with respect to the state.

    Parameters
    ----------
    system : SystemArrays
        The linear system.
    laws : LawArrays
        The laws.
    stamp : int
        The fine stamp at the end of the substep.
    state : (n,) array
        The state there without these forces.
    by_force : (n, P) array
        The change of the state for a unit of each of them.
    positions, speeds : (P,) array
        The motion of the ports that the laws do not cause.
    half_widths : (P,) array
        The half width of the window of speeds at each port.
    forces, tangents : (P,), (P, n) array
        The forces, which contain first guesses where there are several ports, and their tangents.
    """
    ports = len(forces)
    # motion of each port by a unit force at each port, and without the forces
    position_by_force, speed_by_force = np.zeros((2, ports, ports))
    multiply(system.position_rows, by_force, position_by_force)
    multiply(system.speed_rows, by_force, speed_by_force)
    free_positions, free_speeds = positions.copy(), speeds.copy()
    add_motion(system, state, free_positions, free_speeds)
    # Gauss-Seidel: each force is solved with the latest forces at the other ports
    for _ in range(1 if ports == 1 else SWEEPS):
        for p in range(ports):
            position, speed = free_positions[p], free_speeds[p]
            for q in range(ports):
                if q != p:
                    position += position_by_force[p, q] * forces[q]
                    speed += speed_by_force[p, q] * forces[q]
            forces[p], by_position, by_speed = force_at_end(
                laws,
                p,
                stamp,
                position,
                speed,
                position_by_force[p, p],
                speed_by_force[p, p],
                half_widths[p],
            )
            tangents[p] = by_position * system.position_rows[p] + by_speed * system.speed_rows[p]


@callable_when_compiled
def add_motion(
    system: SystemArrays, state: FloatArray, positions: FloatArray, speeds: FloatArray
) -> None:
    """Add what a state (n,) adds to the positions and speeds (P,) of the ports, in place."""
    for p in range(len(positions)):
        for i in range(len(state)):
            positions[p] += system.position_rows[p, i] * state[i]
            speeds[p] += system.speed_rows[p, i] * state[i]


@callable_when_compiled
def advance_memories(laws: LawArrays, positions: FloatArray) -> None:
    """Carry the memories of laws to the positions (P,) of the ports, in place."""
    for k in range(len(laws.ports)):
        if not laws.of_speed[k]:
            position = positions[laws.ports[k]]
            advance(laws.numbers[k], laws.parameters[k], laws.memories[k], position)
            laws.memories[k, POSITION] = position


def simulate_laws(
    substeps: int,
    interval_of_sample: IntArray,
    system: SystemArrays,
    laws: LawArrays,
    least_half_widths: FloatArray,
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
    system : SystemArrays
        The linear system.
    laws : LawArrays
        The laws; their memories are changed.
    least_half_widths : (P,) array
        The least half width of the window of speeds at each port, see `PortMotion`.
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
    free_state = states[0].copy()
    half_widths = least_half_widths.copy()
    for j in range(stamps):
        interval = interval_of_sample[(j + substeps - 1) // substeps]
        at_begin, at_end = system.by_force_at_begin[interval], system.by_force_at_end[interval]
        last_tangents[:] = tangents
        # first with equal weights of the force at both ends, then with those of a stiff law
        moved = 0.0
        for _ in range(2):
            if j > 0:
                begin[:] = (1.0 - moved) * at_begin
                end[:] = at_end + moved * at_begin
                for i in range(count):
                    free_state[i] = 0.0
                    for k in range(count):
                        free_state[i] += system.transitions[interval, i, k] * states[j - 1, k]
                    for p in range(ports):
                        free_state[i] += begin[i, p] * forces[j - 1, p]
                forces[j] = forces[j - 1]
            solve_forces(
                system,
                laws,
                j,
                free_state,
                end,
                positions[j],
                speeds[j],
                half_widths,
                forces[j],
                tangents,
            )
            moved = weight_moved_to_end(at_begin, at_end, last_tangents, tangents)
            if j == 0 or moved == 0.0:
                break
        for i in range(count):
            states[j, i] = free_state[i]
            for p in range(ports):
                states[j, i] += end[i, p] * forces[j, p]
        add_motion(system, states[j], positions[j], speeds[j])
        advance_memories(laws, positions[j])
        if j > 0:
            for p in range(ports):
                passed_speeds = 0.5 * abs(speeds[j, p] - speeds[j - 1, p])
                half_widths[p] = max(least_half_widths[p], passed_speeds)


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
    states = np.zeros((len(trial.fine_time), len(start)))
    states[0] = start
    unknowns = np.concatenate((shared_values, local_values))
    positions, speeds = trial.port_motion(unknowns, np.zeros_like(states))
    forces = np.zeros_like(positions)
    _compiled_simulation()(
        trial.substeps,
        trial.intervals.length_of_sample,
        _system_arrays(trial, shared_values),
        _law_arrays(trial, laws),
        least_half_widths,
        states,
        positions,
        speeds,
        forces,
    )
    ports = sorted({trial.ports.index(law.port) for law in laws})
    return Trajectory(states, positions, speeds, {port: forces[:, port] for port in ports})


def _system_arrays(trial: PortedTrial, shared_values: FloatArray) -> SystemArrays:
    """Return the linear system of a trial at values (K,) of the shared unknowns."""
    system = trial.system_at(shared_values)
    transitions, by_input_at_begin, by_input_at_end = respond_to_inputs(
        system.generator, trial.intervals.lengths / trial.substeps
    )
    # a force acts against the motion: s' = A s - b force, see `PortedSystem`
    return SystemArrays(
        transitions=transitions,
        by_force_at_begin=np.ascontiguousarray(by_input_at_begin @ -system.actions.T),
        by_force_at_end=np.ascontiguousarray(by_input_at_end @ -system.actions.T),
        position_rows=np.ascontiguousarray(system.positions),
        speed_rows=np.ascontiguousarray(system.speeds),
    )


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
        ports=np.array([trial.ports.index(law.port) for law in laws], dtype=np.int64),
        numbers=np.array([LAWS.index(type(law)) for law in laws], dtype=np.int64),
        parameters=parameters,
        of_speed=np.array([type(law).depends_on_speed for law in laws], dtype=np.bool_),
        acting=acting,
        memories=np.zeros((len(laws), memory_size)),
    )
