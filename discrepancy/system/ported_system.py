"""The linear system by which outputs see missing forces at ports."""

from collections.abc import Sequence

import numpy as np

from discrepancy.campaign.records import FloatArray
from discrepancy.system.linear_system import LinearSystem
from discrepancy.system.output_equation import OutputEquation, rows_in_coordinates
from discrepancy.system.response import PortedSystem


def ported_system(
    system: LinearSystem, equations: Sequence[OutputEquation], shapes: FloatArray
) -> PortedSystem:
    """Return the system by which outputs see missing forces at the ports.

    M q'' + D q' + K q = -sum_p acts_p g_p; of coordinates that are states only the speeds are
    kept.

    Parameters
    ----------
    system : LinearSystem
        The system.
    equations : sequence of OutputEquation
        What each of the C outputs shows.
    shapes : (N, M) array
        Shapes of the coordinates q.
    """
    names = tuple(system.ports)
    port_rows = np.array([system.ports[name] for name in names]).reshape(len(names), system.size)
    directions = np.array([system.law_directions[name] for name in names])
    directions = directions.reshape(len(names), system.size)
    direct = _direct_forces(system, equations, directions)
    # the system in the coordinates q
    mass = shapes.T @ system.mass @ shapes
    damping = shapes.T @ system.damping @ shapes
    stiffness = shapes.T @ system.stiffness @ shapes
    port_rows = port_rows @ shapes
    directions = directions @ shapes
    push = np.linalg.solve(mass, directions.T)
    by_damping = np.linalg.solve(mass, damping)
    by_stiffness = np.linalg.solve(mass, stiffness)
    # first order, s = (q, q'), without the integrals of states
    coordinates = len(mass)
    count = system.displacement_modes
    generator = np.zeros((count + coordinates, count + coordinates))
    generator[:count, count : 2 * count] = np.eye(count)
    generator[count:, :count] = -by_stiffness[:, :count]
    generator[count:, count:] = -by_damping
    # rows of outputs, with accelerations from the equation of motion
    shown = rows_in_coordinates(equations, shapes)
    of_position = (shown.position - shown.acceleration @ by_stiffness)[:, :count]
    of_velocity = shown.velocity - shown.acceleration @ by_damping
    no_position = np.zeros((len(names), count))
    no_velocity = np.zeros((len(names), coordinates))
    return PortedSystem(
        generator=generator,
        ports=names,
        actions=np.hstack((no_position, push.T)),
        positions=np.hstack((port_rows[:, :count], no_velocity)),
        speeds=np.hstack((no_position, port_rows)),
        outputs=np.hstack((of_position, of_velocity)),
        through=push.T @ shown.acceleration.T - direct,
    )


def _direct_forces(
    system: LinearSystem, equations: Sequence[OutputEquation], directions: FloatArray
) -> FloatArray:
    """Return what each output (C,) shows at once of a unit force at each port, as (P, C)."""
    direct = np.zeros((len(directions), len(equations)))
    for column, equation in enumerate(equations):
        if equation.law_direction is not None:
            direct[:, column] = directions @ equation.law_direction
        elif system.is_truncated:
            direct[:, column] = -directions @ system.residual(equation.rows[0])
    return direct
