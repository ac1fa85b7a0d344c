"""Statics and modes of the full wing: Kapteyn et al. 2021, eqs. (13), (15) and (16)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fe.full.modes import lowest_eigenpairs, most_moved
from fe.full.statics import Factorisation
from fe.runtime.state import Losses

from .operators import AffineOperators, point_masses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class StaticSolution:
    """Static response of the full model.

    Attributes
    ----------
    displacement : (n,)
        Free unknowns [m, rad].
    strain : (gauges,) dimensionless
        Strain at the gauges, positive in compression.
    load_point_displacement, tip_displacement : float
        Upward displacement at the place of the static test and at the tip [m].
    """

    displacement: FloatArray
    strain: FloatArray
    load_point_displacement: float
    tip_displacement: float


def solve_static(
    operators: AffineOperators,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
    load_factor: float = 1.0,
    tip_force: float = 0.0,
) -> StaticSolution:
    """Solve K(e, z) u = f, Kapteyn et al. 2021, eq. (13), and evaluate the gauge strains, eq. (15).

    Parameters
    ----------
    operators : AffineOperators
        The model.
    young_modulus_factor, stiffness_loss
        As of `fe.runtime.state.DigitalState`.
    load_factor : float
        Load factor of the turn [1].
    tip_force : float
        Upward force at the place of the static test [N].

    Raises
    ------
    SolutionError
        If the solution is not accurate.
    """
    factors = Factorisation(
        operators.stiffness({"young_modulus_factor": young_modulus_factor}, stiffness_loss)
    )
    displacement = factors.solve(operators.turn(load_factor, tip_force))
    return static_outputs(operators, displacement)


def static_outputs(operators: AffineOperators, displacement: FloatArray) -> StaticSolution:
    """Evaluate the outputs of a displacement (n,) of the free unknowns."""
    return StaticSolution(
        displacement=displacement,
        strain=np.asarray(operators.gauge_output @ displacement),
        load_point_displacement=float(operators.load_tip @ displacement),
        tip_displacement=float(operators.tip_row @ displacement),
    )


def tip_stiffness(
    operators: AffineOperators,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
) -> float:
    """Stiffness [N/m] of the static test: force near the tip over the displacement there."""
    solution = solve_static(operators, young_modulus_factor, stiffness_loss, load_factor=0.0, tip_force=1.0)
    return 1.0 / solution.load_point_displacement


@dataclass(frozen=True)
class Eigenmodes:
    """Undamped modes in the order of their frequencies.

    Attributes
    ----------
    frequency : (m,) Hz
    shape : (n, m)
        Mass-normalised shapes of the free unknowns; the tip of a mode that moves it moves up.
    strain : (gauges, m)
        Gauge strain of each shape.
    tip_displacement, load_point_displacement : (m,)
        Upward displacement of each shape at the tip and at the place of the static test, which is also its
        participation in a tip force of 1 N.
    lift_participation : (m,)
        Product of each shape and the load at load factor 1.
    flapwise_bending : (2,)
        Indices of the first and second flapwise bending mode: those that a force near the tip moves most.
    """

    frequency: FloatArray
    shape: FloatArray
    strain: FloatArray
    tip_displacement: FloatArray
    load_point_displacement: FloatArray
    lift_participation: FloatArray
    flapwise_bending: IntArray


def eigenmodes(
    operators: AffineOperators,
    young_modulus_factor: float,
    stiffness_loss: Losses,
    servo_mass: float,
    pitot_mass: float,
    count: int = 6,
) -> Eigenmodes:
    """Lowest modes of K(e, z) phi = omega^2 M(m) phi, Kapteyn et al. 2021, eq. (16).

    Parameters
    ----------
    operators : AffineOperators
        The model.
    young_modulus_factor, stiffness_loss, servo_mass, pitot_mass
        As of `fe.runtime.state.DigitalState`.
    count : int
        Number of modes, at least 3.

    Raises
    ------
    SolutionError
        If the iteration did not converge to `MODE_RESIDUAL_LIMIT`.
    """
    stiffness = operators.stiffness({"young_modulus_factor": young_modulus_factor}, stiffness_loss).tocsc()
    mass = operators.mass(point_masses(servo_mass, pitot_mass)).tocsc()
    values, shapes = lowest_eigenpairs(stiffness, mass, count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, mass @ shapes))
    tip = operators.tip_row @ shapes
    largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=0)[None], axis=0)[0]
    sign = np.sign(np.where(np.abs(tip) > 1e-6 * np.abs(largest), tip, largest))
    shapes = shapes * sign
    return Eigenmodes(
        frequency=np.sqrt(values) / (2.0 * np.pi),
        shape=shapes,
        strain=np.asarray(operators.gauge_output @ shapes),
        tip_displacement=np.asarray(operators.tip_row @ shapes),
        load_point_displacement=np.asarray(operators.load_tip @ shapes),
        lift_participation=np.asarray(operators.load_lift @ shapes),
        flapwise_bending=most_moved(operators.load_tip, values, shapes),
    )
