"""Motion of a few modes with laws at ports, step by step: loops over numbers, and nothing else.

The equation of motion is q'' + D q' + W^2 (1 + r t) q = f(t) - sum_j p_j F_j(p_j . q, p_j . v,
memory_j).

The linear part is advanced exactly, in steps of any lengths that `fe.runtime.motion` prepares. The
laws act as half impulses at both ends of a step (splitting of Strang 1968), in the order laws of
speed, laws of position, linear motion, laws of position, laws of speed. Laws of speed have a closed
form. Where friction reverses within a step, its impulse and first moment are corrected for the time
after the reversal. Where friction holds a port, impulses keep it in its position as long as
friction can give them. What a law is `fe.runtime.laws.interface` says; this file knows no law.

A port may have a residual flexibility R that the modes leave out. Its position is then x = p . q -
R L + e: L is the force of the laws there after a lag, beta L' + L = F (the lag of damping in
proportion to the stiffness; backward Euler), and e is what loads add. The force of a law obeys the
law at the port's position at the end of a step, a monotone equation in one unknown. Dry friction is
then an elasto-plastic element of stiffness 1/R.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file
is copied into the FMU. `fe.compilation` compiles it.
"""

import numpy as np

from . import laws
from .arrays import FADING_POSITION, FORCE, LAGGED_FORCE, POSITION, STUCK, FloatArray
from .dry_friction import correct_reversal, hold_stuck_ports, port_acceleration
from .laws import speed
from .motion_arrays import (
    IMMOVABLE,
    SPEED_LAW,
    ModalMotion,
    ModalState,
    PortArrays,
    RecordFields,
    StepArrays,
    StepWorkspace,
    add_scaled,
    port_value,
)
from .static_path import solve_port_position


def integrate(
    step_fields: RecordFields,
    first: int,
    last: int,
    sample: int,
    coupled: bool,
    memory_is_known: bool,
    port_fields: RecordFields,
    state_fields: RecordFields,
    motion_fields: RecordFields,
) -> None:
    """Integrate the motion over some of the steps, and record it at the samples there.

    Records are passed as plain tuples of their fields: numba takes three times as long for named
    ones.

    Parameters
    ----------
    step_fields : tuple
        Fields of `StepArrays`.
    first, last : int
        Boundaries of the steps at which the motion begins and ends.
    sample : int
        First sample to record.
    coupled : bool
        Whether the linear steps couple the modes.
    memory_is_known : bool
        Whether the laws' memory belongs to the state; otherwise each law is loaded from zero to the
        first position of its port.
    port_fields : tuple
        Fields of `PortArrays`.
    state_fields : tuple
        Fields of `ModalState`; changed in place.
    motion_fields : tuple
        Fields of `ModalMotion`; its samples are filled.
    """
    steps = StepArrays(*step_fields)
    ports = PortArrays(*port_fields)
    state = ModalState(*state_fields)
    motion = ModalMotion(*motion_fields)
    by_law = np.zeros((4, len(ports.law_number)))
    by_mode = np.zeros((4, len(state.q)))
    workspace = StepWorkspace(
        by_mode[0], by_mode[1], by_mode[2:].ravel(), by_law[0], by_law[1], by_law[2], by_law[3]
    )
    start_laws(ports, state, memory_is_known)
    # at the beginning, a step without duration: lagged forces stay, or follow at once
    h = 0.0
    lag = 1.0 if memory_is_known and ports.relaxation > 0.0 else 0.0
    fade = 1.0
    for k in range(first, last + 1):
        if k > first:
            h = steps.length[steps.length_of_step[k - 1]]
            lag = ports.relaxation / (ports.relaxation + h)
            fade = lag
            first_half_impulse(steps, k - 1, ports, workspace, state, h)
            linear_step(steps, k - 1, state, workspace.new_state, coupled)
            hold_stuck_ports(steps, k - 1, ports, workspace, state, h)
        update_position_laws(steps, k, ports, state, h, lag, fade, memory_is_known)
        if k > first:
            second_half_impulse(steps, k - 1, ports, workspace, state, h)
        if k == steps.sample_boundary[sample]:
            applied = steps.end_force[k - 1] if k > first else steps.begin_force[k]
            record_sample(steps, k, ports, state, applied, sample, motion)
            sample += 1


def start_laws(ports: PortArrays, state: ModalState, memory_is_known: bool) -> None:
    """Set the forces of the laws at the beginning of the motion.

    If their memory is not known, the speeds are assumed to have been steady before.
    """
    for j in range(len(ports.law_number)):
        x = port_value(ports.motion_rows, j, state.q)
        v = port_value(ports.motion_rows, j, state.v)
        law = ports.parameters[j]
        memory = state.memory[j]
        if ports.leader[j] == SPEED_LAW:
            # it acts by impulses, and has no force; friction at a port at rest sticks
            memory[FORCE] = 0.0
            holds = speed.can_hold(law) and speed.strength(law, x, ports.inverse_mass[j]) > 0.0
            if holds and v == 0.0:
                memory[STUCK] = 1.0
                memory[POSITION] = x
        elif ports.leader[j] == IMMOVABLE:
            memory[FORCE] = 0.0
            memory[LAGGED_FORCE] = 0.0
        elif ports.depends_on_speed[j] == 0:
            memory[FORCE], _ = laws.force_and_slope(
                ports.law_number[j], law, memory, memory[POSITION], 1.0
            )
        elif not memory_is_known:
            memory[FORCE] = speed.steady_force(law, x, v)
            memory[LAGGED_FORCE] = memory[FORCE]


def first_half_impulse(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    workspace: StepWorkspace,
    state: ModalState,
    h: float,
) -> None:
    """Change the modal speeds by the laws' impulse in the first half of step `k`, of `h` [s].

    A step is split: half the impulse of the laws, then the linear structure alone (`linear_step`),
    then the other half (`second_half_impulse`). Laws of speed act on their ports one after the
    other, each by its closed solution; the forces of laws of position are those at the start.
    """
    half = 0.5 * h
    mode_count = len(state.q)
    law_count = len(ports.law_number)
    # the beginning, for reversals of friction
    for m in range(mode_count):
        workspace.q[m] = state.q[m]
        workspace.v[m] = state.v[m]
    # laws of speed, in closed form
    for j in range(law_count):
        workspace.forces[j] = state.memory[j, FORCE]
        workspace.broke_loose[j] = 0.0
        workspace.speed_lost[j] = 0.0
        if ports.leader[j] != SPEED_LAW:
            continue
        workspace.speed[j] = port_value(ports.motion_rows, j, state.v)
        if state.memory[j, STUCK] == 1.0:
            continue
        law = ports.parameters[j]
        x = port_value(ports.motion_rows, j, state.q)
        strength = speed.strength(law, x, ports.inverse_mass[j])
        # dry friction does not stop at zero: the reversal is looked for after the step
        new_speed = speed.speed_after(law, workspace.speed[j], strength, half, True)
        workspace.speed_lost[j] = workspace.speed[j] - new_speed
        add_scaled(state.v, ports.force_rows[j], -workspace.speed_lost[j] / ports.inverse_mass[j])
    # laws of position
    for j in range(law_count):
        if workspace.forces[j] != 0.0:
            add_scaled(state.v, ports.force_rows[j], -workspace.forces[j] * half)
    if ports.stiffness_rate != 0.0:
        add_stiffness_drift(steps, state, half * ports.stiffness_rate * steps.time[k])


def add_stiffness_drift(steps: StepArrays, state: ModalState, duration_times_change: float) -> None:
    """Give the modes the impulse of a stiffness that has drifted.

    The whole stiffness acts, also where it couples a mode with a drive: a spring between two points
    pulls by their distance, however far both have moved.

    Parameters
    ----------
    state : ModalState
        Its speeds are changed in place.
    duration_times_change : float
        The duration of the impulse times the relative change of the stiffness [s].
    """
    for m in range(len(state.q)):
        for n in range(len(state.q)):
            state.v[m] -= duration_times_change * steps.stiffness[m, n] * state.q[n]


def linear_step(
    steps: StepArrays, k: int, state: ModalState, new_state: FloatArray, coupled: bool
) -> None:
    """Advance modal coordinates and speeds by step `k` of the linear structure, without laws.

    The step is exact: the transition matrix times coordinates and speeds, plus the increment by the
    loads. If the modes are not `coupled`, each depends on itself alone. `new_state` is work space.
    """
    mode_count = len(state.q)
    transition = steps.transition[steps.length_of_step[k]]
    for m in range(mode_count):
        i = mode_count + m  # row of the speed
        low = 0 if coupled else m
        high = mode_count if coupled else m + 1
        q = steps.increment[k, m]
        v = steps.increment[k, i]
        for n in range(low, high):
            q += transition[m, n] * state.q[n] + transition[m, mode_count + n] * state.v[n]
            v += transition[i, n] * state.q[n] + transition[i, mode_count + n] * state.v[n]
        new_state[m] = q
        new_state[i] = v
    for m in range(mode_count):
        state.q[m] = new_state[m]
        state.v[m] = new_state[mode_count + m]


def update_position_laws(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    state: ModalState,
    h: float,
    lag: float,
    fade: float,
    memory_is_known: bool,
) -> None:
    """Solve the positions of ports at boundary `k`, and give the second half of impulses there.

    This concerns laws of position, and laws of speed at ports with residual flexibility. The state
    is changed in place.

    Parameters
    ----------
    k : int
        The boundary.
    h : float
        Duration of the step [s].
    lag : float
        Fraction of the lagged force that remains after the step; a rigid port has no lag.
    fade : float
        Fraction of the position by removed loads that remains after the step.
    memory_is_known : bool
        Whether the memory at the first boundary belongs to the state.
    """
    for port in range(len(ports.law_number)):
        if ports.leader[port] != port:
            continue
        # position of the port, at which all of its laws obey their equations
        flexibility = ports.flexibility[port]
        x = port_value(ports.motion_rows, port, state.q)
        if flexibility > 0.0:
            x += steps.residual_position[k, port] + fade * state.memory[port, FADING_POSITION]
            for j in range(len(ports.law_number)):
                if ports.leader[j] == port:
                    x -= flexibility * lag * state.memory[j, LAGGED_FORCE]
            x = solve_port_position(port, ports, state.memory, x, (1.0 - lag) * flexibility, h)
        # memory and impulse of each law there
        for j in range(len(ports.law_number)):
            if ports.leader[j] != port:
                continue
            memory = state.memory[j]
            law_lag = lag if flexibility > 0.0 else 0.0
            is_of_position = ports.depends_on_speed[j] == 0
            if is_of_position:
                laws.advance(ports.law_number[j], ports.parameters[j], memory, x)
            if is_of_position or h > 0.0 or not memory_is_known:
                memory[POSITION] = x
            if flexibility == 0.0:
                memory[FORCE], _ = laws.force_and_slope(
                    ports.law_number[j], ports.parameters[j], memory, x, 1.0
                )
            memory[LAGGED_FORCE] = law_lag * memory[LAGGED_FORCE] + (1.0 - law_lag) * memory[FORCE]
            memory[FADING_POSITION] *= fade
            add_scaled(state.v, ports.force_rows[j], -0.5 * h * memory[FORCE])


def second_half_impulse(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    workspace: StepWorkspace,
    state: ModalState,
    h: float,
) -> None:
    """Change the modal speeds by the impulse of laws of speed in the second half of step `k`.

    The duration of the step is `h` [s]. If the friction at a port has reversed within the step, its
    impulse is corrected. A port at which the friction can hold the speed at zero sticks.
    """
    half = 0.5 * h
    if ports.stiffness_rate != 0.0:
        add_stiffness_drift(steps, state, half * ports.stiffness_rate * (steps.time[k] + h))
    # laws of speed, in the opposite order of the first half
    for j in range(len(ports.law_number) - 1, -1, -1):
        if ports.leader[j] != SPEED_LAW:
            continue
        x = port_value(ports.motion_rows, j, state.q)
        v = port_value(ports.motion_rows, j, state.v)
        law = ports.parameters[j]
        memory = state.memory[j]
        inverse_mass = ports.inverse_mass[j]
        if memory[STUCK] == 1.0:
            # the impulse that stops the port, as large as friction can give
            strength = speed.strength(law, memory[POSITION], inverse_mass)
            limit = speed.holding_limit(law, strength, half)
            if abs(v) > limit:
                v = limit if v > 0.0 else -limit
                memory[STUCK] = 0.0
            add_scaled(state.v, ports.force_rows[j], -v / inverse_mass)
            continue
        strength = speed.strength(law, x, inverse_mass)
        can_hold = speed.can_hold(law)
        was_moving = workspace.broke_loose[j] == 0.0 and workspace.speed[j] != 0.0
        end_speed = v - workspace.speed_lost[j]
        if can_hold and was_moving and workspace.speed[j] * end_speed <= 0.0:
            correct_reversal(steps, k, ports, workspace, state, j, strength, h)
        else:
            new_speed = speed.speed_after(law, v, strength, half, False)
            if new_speed == 0.0 and can_hold and strength > 0.0:
                memory[STUCK] = 1.0
                memory[POSITION] = x
            add_scaled(state.v, ports.force_rows[j], (new_speed - v) / inverse_mass)


def record_sample(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    state: ModalState,
    applied: FloatArray,
    sample: int,
    motion: ModalMotion,
) -> None:
    """Record state and forces at boundary `k`; `applied` (M,) are the modal forces."""
    for m in range(len(state.q)):
        motion.q[sample, m] = state.q[m]
        motion.v[sample, m] = state.v[m]
    for j in range(len(ports.law_number)):
        law = ports.parameters[j]
        memory = state.memory[j]
        inverse_mass = ports.inverse_mass[j]
        force = memory[FORCE]
        if ports.leader[j] == SPEED_LAW:
            x = port_value(ports.motion_rows, j, state.q)
            v = port_value(ports.motion_rows, j, state.v)
            force = speed.steady_force(law, x, v)
            if memory[STUCK] == 1.0:
                # the force that it takes to hold the port, as large as dry friction can be
                forces = state.memory[:, FORCE]
                acceleration = port_acceleration(
                    steps, ports, j, state.q, state.v, forces, applied, steps.time[k]
                )
                force = acceleration / inverse_mass
                if speed.is_dry_friction(law):
                    limit = speed.strength(law, x, inverse_mass) / inverse_mass
                    force = min(max(force, -limit), limit)
            memory[LAGGED_FORCE] = force
        motion.port_forces[sample, j] = force
        motion.lagged_forces[sample, j] = memory[LAGGED_FORCE]
