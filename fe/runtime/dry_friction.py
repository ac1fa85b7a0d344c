"""Dry friction at ports without residual flexibility: sticking, breaking loose, reversing.

Written in the subset of Python that numba compiles too. NumPy and relative imports only: this file
is copied into the FMU. `fe.compilation` compiles it.
"""

from .arrays import FORCE, POSITION, STUCK, FloatArray
from .laws import speed
from .motion_arrays import (
    SPEED_LAW,
    ModalState,
    PortArrays,
    StepArrays,
    StepWorkspace,
    add_scaled,
    port_value,
)


def hold_stuck_ports(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    workspace: StepWorkspace,
    state: ModalState,
    h: float,
) -> None:
    """Hold ports that stick in step `k` of duration `h` [s], by impulses at its beginning.

    A port that needs a larger impulse than friction can give breaks loose.
    """
    mode_count = len(state.q)
    for j in range(len(ports.law_number)):
        if ports.leader[j] != SPEED_LAW or state.memory[j, STUCK] != 1.0:
            continue
        response = ports.impulse_response[steps.length_of_step[k], j]
        law = ports.parameters[j]
        position = state.memory[j, POSITION]
        inverse_mass = ports.inverse_mass[j]
        strength = speed.strength(law, position, inverse_mass)
        limit = speed.holding_limit(law, strength, 0.5 * h)
        # the impulse after which the port is at the position of sticking at the end of the step
        displacement = position - port_value(ports.motion_rows, j, state.q)
        impulse = displacement / port_value(ports.motion_rows, j, response[:mode_count])
        if abs(impulse) * inverse_mass > limit:
            state.memory[j, STUCK] = 0.0
            workspace.broke_loose[j] = 1.0
            impulse = (limit if impulse > 0.0 else -limit) / inverse_mass
        add_scaled(state.q, response, impulse)
        add_scaled(state.v, response[mode_count:], impulse)


def port_acceleration(
    steps: StepArrays,
    ports: PortArrays,
    j: int,
    q: FloatArray,
    v: FloatArray,
    forces: FloatArray,
    applied: FloatArray,
    time: float,
) -> float:
    """Return the acceleration of the port of law `j`, from the forces on all modes.

    The modes are mass-normalised, so that the acceleration of a mode is its applied force minus
    those of stiffness, damping and laws. The port moves by its motion row times the modes.

    Parameters
    ----------
    q, v : (M,) array
        Modal coordinates and speeds.
    forces : (J,) array
        Forces of the laws; zero for laws of speed that act on the modes.
    applied : (M,) array
        Applied modal forces.
    time : float
        Time, for a stiffness that drifts [s].
    """
    acceleration = 0.0
    for m in range(len(q)):
        modal = applied[m]
        for n in range(len(q)):
            modal -= steps.stiffness[m, n] * (1.0 + ports.stiffness_rate * time) * q[n]
        for n in range(len(q)):
            modal -= steps.damping[m, n] * v[n]
        for i in range(len(forces)):
            modal -= ports.force_rows[i, m] * forces[i]
        acceleration += ports.motion_rows[j, m] * modal
    return acceleration


def correct_reversal(
    steps: StepArrays,
    k: int,
    ports: PortArrays,
    workspace: StepWorkspace,
    state: ModalState,
    j: int,
    strength: float,
    h: float,
) -> None:
    """Correct speed and position of a port whose friction reversed within step `k`.

    In the step the friction of law `j` had its first sign throughout. `strength` is the law's
    strength, see `laws.speed`, and `h` the duration of the step [s].
    """
    speed_lost = workspace.speed_lost[j]
    forces = state.memory[:, FORCE]
    # acceleration at both ends, with friction of the first sign
    at_begin = port_acceleration(
        steps,
        ports,
        j,
        workspace.q,
        workspace.v,
        workspace.forces,
        steps.begin_force[k],
        steps.time[k],
    )
    at_end = port_acceleration(
        steps, ports, j, state.q, state.v, forces, steps.end_force[k], steps.time[k] + h
    )
    friction = -2.0 * speed_lost / h
    slopes = (at_begin + friction, at_end + friction)
    # correction of speed and position
    v = port_value(ports.motion_rows, j, state.v)
    speed_change, position_change, is_held = speed.reversal_correction(
        ports.parameters[j],
        workspace.speed[j],
        v - speed_lost,
        slopes,
        speed_lost,
        strength,
        h,
    )
    if is_held == 1.0:
        speed_change = -v
        x = port_value(ports.motion_rows, j, state.q)
        position_change += port_value(ports.motion_rows, j, workspace.q) - x
        state.memory[j, STUCK] = 1.0
        state.memory[j, POSITION] = x + position_change
    add_scaled(state.q, ports.force_rows[j], position_change / ports.inverse_mass[j])
    add_scaled(state.v, ports.force_rows[j], speed_change / ports.inverse_mass[j])
