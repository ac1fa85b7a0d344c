"""The linear system from missing forces at ports to outputs."""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.output_equation import OutputEquation, rows_in_coordinates
from discrepancy.system.response import PortedSystem


def ported_system(
    system: LinearSystem, equations: Sequence[OutputEquation], shapes: FloatArray
) -> PortedSystem:
    """Return the linear system from missing forces g at the P ports to the outputs.

    In the coordinates q the equation of motion is M q'' + D q' + K q = -sum_p acts_p g_p, where
    acts_p is the direction of the force at port p. The system is returned in first order, with the
    state s = (q, q'). Of a coordinate that stands for a state (its speed is the state, and nothing
    depends on its position) only the speed is kept.

    Parameters
    ----------
    system : LinearSystem
        The linear system of the model.
    equations : sequence of OutputEquation
        The equation of each of the C outputs.
    shapes : (N, M) array
        The shapes of the coordinates q, the columns of u = shapes q.

    Returns
    -------
    PortedSystem
        Its matrices, for the signs that its docstring states.
    """
    names = tuple(system.ports)
    port_rows = np.array([system.ports[name] for name in names]).reshape(
        len(names), system.unknown_count
    )
    law_directions = np.array([system.law_directions[name] for name in names])
    law_directions = law_directions.reshape(len(names), system.unknown_count)
    direct_outputs = _direct_forces(system, equations, law_directions)
    # the system in the M coordinates q
    mass = shapes.T @ system.mass @ shapes
    damping = shapes.T @ system.damping @ shapes
    stiffness = shapes.T @ system.stiffness @ shapes
    port_rows = port_rows @ shapes  # (P, M)
    law_directions = law_directions @ shapes  # (P, M)
    acceleration_per_force = np.linalg.solve(mass, law_directions.T)  # (M, P)
    by_damping = np.linalg.solve(mass, damping)
    by_stiffness = np.linalg.solve(mass, stiffness)
    # first order: the state is (q, q') with only the k coordinates q that are displacements
    coordinate_count = len(mass)
    k = system.displacement_mode_count
    generator = np.zeros((k + coordinate_count, k + coordinate_count))
    generator[:k, k : 2 * k] = np.eye(k)
    generator[k:, :k] = -by_stiffness[:, :k]
    generator[k:, k:] = -by_damping
    # rows of outputs: q'' = M^-1 (-K q - D q' - sum_p acts_p g_p) replaces the accelerations
    output_rows = rows_in_coordinates(equations, shapes)
    of_position = (output_rows.position - output_rows.acceleration @ by_stiffness)[:, :k]
    of_velocity = output_rows.velocity - output_rows.acceleration @ by_damping
    no_position = np.zeros((len(names), k))
    no_velocity = np.zeros((len(names), coordinate_count))
    return PortedSystem(
        generator=generator,
        ports=names,
        actions=np.hstack((no_position, acceleration_per_force.T)),
        positions=np.hstack((port_rows[:, :k], no_velocity)),
        speeds=np.hstack((no_position, port_rows)),
        outputs=np.hstack((of_position, of_velocity)),
        through=acceleration_per_force.T @ output_rows.acceleration.T - direct_outputs,
    )


def _direct_forces(
    system: LinearSystem, equations: Sequence[OutputEquation], directions: FloatArray
) -> FloatArray:
    """Return the change (P, C) of each output at the instant at which a unit force acts at a port.

    `directions` (P, N) are those in which the forces act. An output that is the force needed for a
    prescribed motion changes by the force itself. If modes are truncated, the force deforms those
    without inertia at once, which changes displacements. All other changes are zero.
    """
    direct_forces = np.zeros((len(directions), len(equations)))
    for column, equation in enumerate(equations):
        if equation.law_direction is not None:
            direct_forces[:, column] = directions @ equation.law_direction
        elif system.is_truncated:
            direct_forces[:, column] = -directions @ system.residual_displacements(equation.rows[0])
    return direct_forces
