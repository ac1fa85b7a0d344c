"""Statics and modes of the full wing: Kapteyn et al. 2021, eqs. (13), (15) and (16)."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.full.modes import lowest_eigenpairs, track
from fe.full.statics import Factorisation
from fe.runtime.state import Losses

from .operators import ROOT_UNKNOWNS, AffineOperators, point_masses

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CANTILEVER_WAVE_NUMBERS = (1.8751040687119611, 4.694091132974175, 7.854757438237613)


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
        Indices of the first and second flapwise bending mode.
    """

    frequency: FloatArray
    shape: FloatArray
    strain: FloatArray
    tip_displacement: FloatArray
    load_point_displacement: FloatArray
    lift_participation: FloatArray
    flapwise_bending: IntArray


def cantilever_bending(
    distance: FloatArray, span: float, count: int = 2
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield deflection and slope (n,) of the bending shapes of a uniform cantilever, Euler and Bernoulli's.

    Parameters
    ----------
    distance : (n,)
        From the clamp [m].
    span : float
        Length [m].
    count : int
        Number of shapes, at most 3.
    """
    for wave in _CANTILEVER_WAVE_NUMBERS[:count]:
        s = wave * distance / span
        ratio = (np.cosh(wave) + np.cos(wave)) / (np.sinh(wave) + np.sin(wave))
        deflection = np.cosh(s) - np.cos(s) - ratio * (np.sinh(s) - np.sin(s))
        yield deflection, wave / span * (np.sinh(s) + np.sin(s) - ratio * (np.cosh(s) - np.cos(s)))


def cantilever_bending_shapes(operators: AffineOperators, count: int = 2) -> FloatArray:
    """Flapwise bending shapes (n, count) of a uniform cantilever on the nodes of the wing.

    Plane sections: u_z = w(y), u_y = -z w'(y), with the Euler-Bernoulli shapes w of a clamped-free beam.
    """
    points = operators.wing_mesh.points
    span = operators.wing_mesh.design.planform.semi_span
    free = operators.expansion[:, : operators.unknowns - ROOT_UNKNOWNS]
    shapes = np.zeros((operators.unknowns, count))
    for number, (deflection, slope) in enumerate(cantilever_bending(points[:, 1], span, count)):
        full = np.zeros(3 * len(points))
        full[1::3], full[2::3] = -points[:, 2] * slope, deflection
        # Rows of held unknowns are empty, so that the transpose picks the free ones.
        shapes[: free.shape[1], number] = free.T @ full
    return shapes


def flapwise_bending_modes(operators: AffineOperators, shapes: FloatArray, mass: sparse.sparray) -> IntArray:
    """Find the first and second flapwise bending mode among shapes (n, m): indices (2,).

    They are the modes whose modal assurance with the bending shapes of a cantilever is the greatest.
    """
    return track(cantilever_bending_shapes(operators), shapes, mass)


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
        flapwise_bending=flapwise_bending_modes(operators, shapes, mass),
    )
