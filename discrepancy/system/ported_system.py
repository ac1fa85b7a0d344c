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

    In the coordinates q it is M q'' + D q' + K q = -sum_p acts_p g_p. It is returned in first
    order, with the state s = (q, q'). Of a coordinate that stands for a state (its speed is the
    state, and nothing depends on its position) only the speed is kept.

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
        Its matrices; see there for signs.
    """
    names = tuple(system.ports)
    port_rows = np.array([system.ports[name] for name in names]).reshape(
        len(names), system.unknown_count
    )
    law_directions = np.array([system.law_directions[name] for name in names])
    law_directions = law_directions.reshape(len(names), system.unknown_count)
    direct_outputs = _direct_forces(system, equations, law_directions)
    # the system in the coordinates q
    mass = shapes.T @ system.mass @ shapes
    damping = shapes.T @ system.damping @ shapes
    stiffness = shapes.T @ system.stiffness @ shapes
    port_rows = port_rows @ shapes
    law_directions = law_directions @ shapes
    acceleration_per_force = np.linalg.solve(mass, law_directions.T)
    by_damping = np.linalg.solve(mass, damping)
    by_stiffness = np.linalg.solve(mass, stiffness)
    # first order, s = (q, q'), without the integrals of states
    coordinate_count = len(mass)
    displacement_mode_count = system.displacement_mode_count
    generator = np.zeros(
        (displacement_mode_count + coordinate_count, displacement_mode_count + coordinate_count)
    )
    generator[:displacement_mode_count, displacement_mode_count : 2 * displacement_mode_count] = (
        np.eye(displacement_mode_count)
    )
    generator[displacement_mode_count:, :displacement_mode_count] = -by_stiffness[
        :, :displacement_mode_count
    ]
    generator[displacement_mode_count:, displacement_mode_count:] = -by_damping
    # rows of outputs: q'' = M^-1 (-K q - D q' - sum_p acts_p g_p) replaces the accelerations
    output_rows = rows_in_coordinates(equations, shapes)
    of_position = (output_rows.position - output_rows.acceleration @ by_stiffness)[
        :, :displacement_mode_count
    ]
    of_velocity = output_rows.velocity - output_rows.acceleration @ by_damping
    no_position = np.zeros((len(names), displacement_mode_count))
    no_velocity = np.zeros((len(names), coordinate_count))
    return PortedSystem(
        generator=generator,
        ports=names,
        actions=np.hstack((no_position, acceleration_per_force.T)),
        positions=np.hstack((port_rows[:, :displacement_mode_count], no_velocity)),
        speeds=np.hstack((no_position, port_rows)),
        outputs=np.hstack((of_position, of_velocity)),
        through=acceleration_per_force.T @ output_rows.acceleration.T - direct_outputs,
    )


def _direct_forces(
    system: LinearSystem, equations: Sequence[OutputEquation], directions: FloatArray
) -> FloatArray:
    """Return the immediate change (P, C) of each output by a unit force at each port.

    A force adds to the output that is the reaction of a drive, and to outputs of modes without
    inertia, which deform at once.
    """
    direct_forces = np.zeros((len(directions), len(equations)))
    for column, equation in enumerate(equations):
        if equation.law_direction is not None:
            direct_forces[:, column] = directions @ equation.law_direction
        elif system.is_truncated:
            direct_forces[:, column] = -directions @ system.residual_displacements(equation.rows[0])
    return direct_forces
