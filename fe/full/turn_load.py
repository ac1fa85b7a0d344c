"""Nodal load of a level turn: lift on the skins, and the weight that relieves it."""

import numpy as np
from numpy.typing import NDArray

from fe.wing.design import WingDesign
from fe.wing.lift import DISTRIBUTIONS
from fe.wing.mesh import WingMesh

from .assembly import Discretisation, gauss_points, jacobians, positions, shape_functions

FloatArray = NDArray[np.float64]

STANDARD_GRAVITY = 9.80665
"""m/s^2."""


def lift_load(mesh: WingMesh, discretisation: Discretisation) -> FloatArray:
    """Load (full,) [N] at load factor 1: up and forward, half on each skin.

    Along the span the design's distribution, along the chord (1 - xi)^p with the design's exponent p; each
    skin cell is loaded on its outer face. The sums are exactly those of the design, without the inertia.
    """
    design, plan = mesh.design, mesh.design.planform
    per_length = DISTRIBUTIONS[design.lift.distribution](plan)
    face, weight = gauss_points(4, 2)
    load = np.zeros(discretisation.unknowns // 3)
    for upper in (True, False):
        cells = mesh.skin_cells(upper=upper)
        local = np.column_stack([face, np.full(len(face), 1.0 if upper else 0.0)])
        values, _ = shape_functions(local)
        corners = mesh.corners[cells]
        place = positions(corners, local)
        jacobian = jacobians(corners, local)
        area = (
            jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
        )  # in the plan view
        station = np.clip(place[..., 1] / plan.semi_span, 0.0, 1.0)
        chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * station
        xi = place[..., 0] / chord + plan.straight_chord_line
        pressure = per_length(station) * (1.0 - xi) ** design.lift.chordwise_exponent / chord
        np.add.at(
            load, discretisation.cell_nodes[cells], np.einsum("nq,qa->na", pressure * area * weight, values)
        )
    load /= load.sum() * design.lift.load_factor
    full = np.zeros(discretisation.unknowns)
    full[2::3] = design.lift.force * load
    full[0::3] = -design.lift.forward_force * load
    return full


def inertia_relief(
    design: WingDesign,
    discretisation: Discretisation,
    density: FloatArray,
    point_masses: tuple[tuple[FloatArray, ...], ...],
    lift: FloatArray,
) -> FloatArray:
    """Load (full,) [N] to add at load factor 1: the weight where it lies, and as much lift against it.

    Parameters
    ----------
    design : WingDesign
        The wing; its nominal masses count.
    discretisation : Discretisation
        Degrees of freedom.
    density : (nc,) kg/m^3
        Of the cells.
    point_masses : tuple of two tuples of (nodes,)
        `point_mass_weights` of the servos, and of the pitot.
    lift : (full,) N
        `lift_load`.
    """
    weight = discretisation.nodal_mass(density)
    for mass, places in zip((design.masses.servo, design.masses.pitot), point_masses, strict=True):
        for weights in places:
            weight = weight + mass * weights
    weight = STANDARD_GRAVITY * weight
    added = np.zeros(len(lift))
    added[2::3] = lift[2::3] * (weight.sum() / lift[2::3].sum()) - weight
    return added
