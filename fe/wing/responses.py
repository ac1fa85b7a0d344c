"""Statics and modes of the full wing: Kapteyn et al. 2021, eqs. (13), (15) and (16)."""

from typing import NamedTuple

import numpy as np

from fe.full.factorisation import most_moved
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.state import Losses, losses_of
from fe.structure.affine import StaticResponse, natural_frequencies, static_response

from .operators import AffineWing


def wing_values(
    wing: AffineWing, young_modulus_factor: float, stiffness_loss: Losses, **others: float
) -> dict[str, float]:
    """Return values by the names of all that can be chosen of a wing."""
    losses = dict(zip(wing.regions, losses_of(stiffness_loss, wing.regions), strict=True))
    return {"young_modulus_factor": young_modulus_factor, **losses, **others}


def solve_static(
    operators: AffineWing,
    young_modulus_factor: float = 1.0,
    stiffness_loss: Losses = (),
    load_factor: float = 1.0,
    tip_force: float = 0.0,
) -> StaticResponse:
    """Solve K(e, z) u = f, Kapteyn et al. 2021, eq. (13), and evaluate the gauge strains, eq. (15).

    Strains are positive in compression; the output is the upward displacement at the tip [m].

    Parameters
    ----------
    operators : AffineWing
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
    loads = {"load_factor": load_factor, "tip_force": tip_force}
    return static_response(operators, wing_values(operators, young_modulus_factor, stiffness_loss, **loads))


class Eigenmodes(NamedTuple):
    """Undamped modes in the order of their frequencies.

    Attributes
    ----------
    frequency : (m,) Hz
    shape : (n, m)
        Mass-normalised shapes of the free unknowns, in which the tip moves up.
    flapwise_bending : (2,)
        Indices of the first and second flapwise bending mode: those that a force near the tip moves most.
    """

    frequency: FloatArray
    shape: FloatArray
    flapwise_bending: IntArray


def eigenmodes(
    operators: AffineWing,
    young_modulus_factor: float,
    stiffness_loss: Losses,
    servo_mass: float,
    pitot_mass: float,
    count: int = 6,
) -> Eigenmodes:
    """Lowest modes of K(e, z) phi = omega^2 M(m) phi, Kapteyn et al. 2021, eq. (16).

    Parameters
    ----------
    operators : AffineWing
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
    masses = {"servo_mass": servo_mass, "pitot_mass": pitot_mass}
    values = wing_values(operators, young_modulus_factor, stiffness_loss, **masses)
    frequency, shapes = natural_frequencies(operators, count, values)
    shapes = shapes * np.where(operators.tip_row @ shapes < 0.0, -1.0, 1.0)
    return Eigenmodes(frequency, shapes, most_moved(operators.load_tip, frequency**2, shapes))
