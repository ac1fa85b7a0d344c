"""Eigenmodes of the full model: Kapteyn et al. 2021, eq. (16), tracked by their shapes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh, norm

from fe.runtime.errors import SolutionError
from fe.runtime.state import Losses

from .operators import ROOT_UNKNOWNS, AffineOperators
from .statics import Factorisation

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MODE_RESIDUAL_LIMIT = 1e-12
"""Largest max|K phi - omega^2 M phi| / (|K| max|phi|), in maximum norms, of an accepted mode."""
_CANTILEVER_WAVE_NUMBERS = (1.8751040687119611, 4.694091132974175, 7.854757438237613)


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


def modal_assurance(first: FloatArray, second: FloatArray, mass: sparse.sparray) -> FloatArray:
    """Mass-weighted modal assurance criterion (m1, m2) of shapes (n, m1) and (n, m2); 1 for equal shapes."""
    weighted = mass @ second
    cross = (first.T @ weighted) ** 2
    own_first = np.einsum("im,im->m", first, mass @ first)
    own_second = np.einsum("im,im->m", second, weighted)
    return np.asarray(cross / np.outer(own_first, own_second))


def track(reference: FloatArray, shapes: FloatArray, mass: sparse.sparray) -> IntArray:
    """Index (m1,) of the mode in `shapes` (n, m2) that continues each of `reference` (n, m1), m1 <= m2.

    The assignment has the greatest sum of modal assurance criteria, so that crossing modes keep their names.
    """
    assurance = modal_assurance(reference, shapes, mass)
    rows, columns = linear_sum_assignment(assurance, maximize=True)
    result = np.empty(reference.shape[1], dtype=np.int64)
    result[rows] = columns
    return result


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
    points = operators.discretisation.node_points
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
    stiffness = operators.stiffness(young_modulus_factor, stiffness_loss).tocsc()
    mass = operators.mass(servo_mass, pitot_mass).tocsc()
    values, shapes = lowest_eigenpairs(stiffness, mass, count)
    shapes = shapes / np.sqrt(np.einsum("im,im->m", shapes, mass @ shapes))
    tip = operators.tip_displacement_output @ shapes
    largest = np.take_along_axis(shapes, np.abs(shapes).argmax(axis=0)[None], axis=0)[0]
    sign = np.sign(np.where(np.abs(tip) > 1e-6 * np.abs(largest), tip, largest))
    shapes = shapes * sign
    return Eigenmodes(
        frequency=np.sqrt(values) / (2.0 * np.pi),
        shape=shapes,
        strain=np.asarray(operators.gauge_output @ shapes),
        tip_displacement=np.asarray(operators.tip_displacement_output @ shapes),
        load_point_displacement=np.asarray(operators.displacement_output @ shapes),
        lift_participation=np.asarray(operators.load_lift @ shapes),
        flapwise_bending=flapwise_bending_modes(operators, shapes, mass),
    )


def lowest_eigenpairs(
    stiffness: sparse.sparray, mass: sparse.sparray, count: int
) -> tuple[FloatArray, FloatArray]:
    """Lowest eigenvalues (count,) [rad^2/s^2] and vectors (n, count) by shift-inverted Lanczos.

    Raises
    ------
    SolutionError
        If the iteration did not converge to `MODE_RESIDUAL_LIMIT`.
    """
    factors = Factorisation(stiffness)
    size = stiffness.shape[0]
    inverse = LinearOperator((size, size), matvec=factors.raw_solve, dtype=float)
    start = np.random.default_rng(16).standard_normal(size)  # fixed: the same model gives the same bytes
    try:
        values, shapes = eigsh(stiffness, k=count, M=mass, sigma=0.0, OPinv=inverse, v0=start)
    except ArpackNoConvergence as error:
        raise SolutionError(f"Only {len(error.eigenvalues)} of {count} eigenmodes converged.") from None
    order = np.argsort(values)
    values, shapes = values[order], shapes[:, order]
    scale = float(norm(stiffness, np.inf)) * np.abs(shapes).max(axis=0)
    residual = np.abs(stiffness @ shapes - (mass @ shapes) * values).max(axis=0) / scale
    if not residual.max() <= MODE_RESIDUAL_LIMIT:
        raise SolutionError(
            f"Eigenmode {int(residual.argmax())} has a residual of {residual.max():.2g}, more than "
            f"{MODE_RESIDUAL_LIMIT:g}; the stiffness matrix is nearly singular."
        )
    return values, shapes
