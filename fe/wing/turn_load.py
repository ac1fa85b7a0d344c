"""Nodal load of a level turn: lift on the skins.

The lift along the span is that of Schrenk's approximation or of a lifting line: the shape of the lift of a
symmetrically loaded wing as a function that integrates to one over the half-wing; the amount is the design's.

References
----------
O. Schrenk, "A simple approximation method for obtaining the spanwise lift distribution", NACA TM 948 (1940).
H. Glauert, "The Elements of Aerofoil and Airscrew Theory" (1926), chapter XI.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fe.elements.cells import jacobians
from fe.elements.kinds import gauss_points
from fe.runtime.arrays import FloatArray

from .mesh import WingMesh
from .parts import Planform

Distribution = Callable[[ArrayLike], FloatArray]


def schrenk(planform: Planform) -> Distribution:
    """Mean of the chord and of the elliptic distribution of the same area.

    Returns
    -------
    callable
        Station (...,) as a fraction of the semi-span to lift per length over total lift (...,) [1/m].
    """
    span, root, tip = planform.semi_span, planform.root_chord, planform.tip_chord

    def per_length(station: ArrayLike) -> FloatArray:
        eta = np.asarray(station, dtype=float)
        trapezoid = 2.0 * (root + (tip - root) * eta) / (root + tip)
        ellipse = 4.0 / np.pi * np.sqrt(np.clip(1.0 - eta**2, 0.0, None))
        return np.asarray(0.5 * (trapezoid + ellipse) / span)

    return per_length


def lifting_line(planform: Planform, terms: int = 40, section_slope: float = 2.0 * np.pi) -> Distribution:
    """Prandtl's lifting line solved by Glauert's sine series.

    With y = -(b/2) cos(theta), the circulation is 2 b V sum A_n sin(n theta), n odd; collocation at
    `terms` angles solves sum A_n sin(n theta) (n mu + sin theta) = mu alpha sin theta,
    mu = c a0 / (4 b).

    Parameters
    ----------
    planform : Planform
        The half-wing; the wing is untwisted and symmetric.
    terms : int
        Number of odd harmonics.
    section_slope : float
        Lift slope of the section [1/rad].

    Returns
    -------
    callable
        Station (...,) as a fraction of the semi-span to lift per length over total lift (...,) [1/m].
    """
    theta = (np.arange(terms) + 1.0) * np.pi / (2.0 * terms)  # half-wing, tip excluded, root included
    order = 2.0 * np.arange(terms) + 1.0
    chord = planform.chord(np.cos(theta))
    mu = (chord * section_slope / (8.0 * planform.semi_span))[:, None]
    sine = np.sin(np.outer(theta, order))
    amplitude = np.linalg.solve(sine * (order * mu + np.sin(theta)[:, None]), mu[:, 0] * np.sin(theta))
    # Integral of sum A_n sin(n theta) over the half-wing: only n = 1 contributes, A_1 pi/4 * semi-span.
    scale = 1.0 / (amplitude[0] * np.pi / 4.0 * planform.semi_span)

    def per_length(station: ArrayLike) -> FloatArray:
        angle = np.arccos(np.clip(np.asarray(station, dtype=float), 0.0, 1.0))
        return np.asarray(scale * np.tensordot(np.sin(angle[..., None] * order), amplitude, axes=1))

    return per_length


DISTRIBUTIONS = {"schrenk": schrenk, "lifting_line": lifting_line}
"""Lift distributions by their name in a design."""


STANDARD_GRAVITY = 9.80665
"""m/s^2."""


def lift_load(mesh: WingMesh) -> FloatArray:
    """Load (full,) [N] at load factor 1: up and forward, half on each skin.

    Along the span the design's distribution, along the chord (1 - xi)^p with the design's exponent p; each
    skin cell is loaded on its outer face. The sums are exactly those of the design, without the inertia.
    """
    design, plan = mesh.design, mesh.design.planform
    per_length = DISTRIBUTIONS[design.lift.distribution](plan)
    face, weight = gauss_points(4, 2)
    load = np.zeros(len(mesh.points))
    for upper in (True, False):
        cells = np.flatnonzero(mesh.grid_index[:, 2] == (mesh.height_cells + 1 if upper else 0))
        local = np.column_stack([face, np.full(len(face), 1.0 if upper else 0.0)])
        values, _ = mesh.kind.shape_functions(local)
        place = mesh.positions(cells, local)
        jacobian = jacobians(mesh.kind, mesh.nodes[cells], local)
        area = np.linalg.det(jacobian[..., :2, :2])  # in the plan view
        station = np.clip(place[..., 1] / plan.semi_span, 0.0, 1.0)
        chord = plan.chord(station)
        xi = place[..., 0] / chord + plan.straight_chord_line
        pressure = per_length(station) * (1.0 - xi) ** design.lift.chordwise_exponent / chord
        np.add.at(load, mesh.cells[cells], (pressure * area * weight) @ values)
    load /= load.sum() * design.lift.load_factor
    full = np.zeros(mesh.unknowns)
    full[2::3] = design.lift.force * load
    full[0::3] = -design.lift.forward_force * load
    return full
