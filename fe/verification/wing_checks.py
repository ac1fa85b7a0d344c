"""Checks of a wing's model: what its rigid motions call forth, sums that must agree, convergence."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from fe.elements.cells import gradients
from fe.elements.kinds import gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.structure.affine import static_response
from fe.structure.mesh import rigid_motions
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble
from fe.wing.responses import eigenmodes


def _rigid_motions(operators: AffineOperators) -> FloatArray:
    """Free unknowns (n, 3) of the rigid motions that the root allows: heave, flap and yaw."""
    full = rigid_motions(operators.wing_mesh.points, np.zeros(3), 2.0)[:, [2, 3, 5]]
    return np.vstack((full[operators.body.supports.alone], np.eye(3)))


def rigid_body_residual(operators: AffineOperators) -> float:
    """Largest force that a rigid motion of the wing calls forth, over the sum of its terms.

    The motions are those that the root allows, heave, flap and yaw; the forces of the springs are left out.
    """
    free, stiffness = _rigid_motions(operators), operators.stiffness()
    force = (stiffness - operators.body.supports.stiffness) @ free
    return float(np.abs(force).max() / (abs(stiffness) @ np.abs(free)).max())


def wing_balance(operators: AffineOperators, load_factor: float = 3.0) -> dict[str, tuple[float, float, str]]:
    """Return sums that must agree for the wing at a load factor, each with the other and their unit.

    The mass of the matrix and of the volumes; the force of the root spring and the net load; the moment of
    the flap spring and that of the load about the root; the elastic energy and half the work of the load.
    """
    mesh, design = operators.wing_mesh, operators.wing_mesh.design
    heave, flap, _ = _rigid_motions(operators).T
    local, weight = gauss_points(2)
    volume = gradients(mesh.kind, mesh.nodes, local)[1] @ weight
    u = static_response(operators, {"load_factor": load_factor}).displacement
    load = operators.turn(load_factor)
    lift = design.lift.force * load_factor / design.lift.load_factor
    energy = 0.5 * u @ (operators.stiffness() @ u)
    return {
        "mass": (
            float(heave @ (operators.mass_terms[0] @ heave)),
            float(volume @ operators.body.density),
            "kg",
        ),
        "reaction": (float(design.root.transverse_spring * u[-3]), lift, "N"),
        "root moment": (float(design.root.flap_spring * u[-2]), float(flap @ load), "N m"),
        "energy and work": (float(energy), float(0.5 * load @ u), "J"),
    }


def mesh_convergence(design: WingDesign, refinements: Sequence[float]) -> dict[str, FloatArray]:
    """Results of the healthy wing at e = 1 on a sequence of meshes; nothing is refitted.

    Returns
    -------
    dict of str to (meshes, ...)
        Free `unknowns`; `tip stiffness` [N/m]; frequencies of `first bending` and `second bending` at the
        design's nominal masses [Hz]; `strain` (meshes, gauges) at the load factor of the design's lift.

    Raises
    ------
    InvalidDesignError
        If a refinement lies outside the range of the design.
    """
    names = ("unknowns", "tip stiffness", "first bending", "second bending", "strain")
    found: list[tuple[Any, ...]] = []
    for refinement in refinements:
        operators = assemble(design.changed(mesh={"refinement": refinement}))
        loads = np.column_stack((operators.turn(design.lift.load_factor), operators.load_tip))
        turn, bent = Factorisation(operators.stiffness()).solve(loads).T
        modes = eigenmodes(operators, 1.0, (), design.masses.servo, design.masses.pitot, 4)
        first, second = modes.frequency[modes.flapwise_bending].tolist()
        stiffness = 1.0 / float(operators.load_tip @ bent)
        found.append((operators.unknowns, stiffness, first, second, operators.gauge_output @ turn))
    return dict(zip(names, map(np.array, zip(*found, strict=True)), strict=True))


def observed_order(ratio: float, values: Sequence[float]) -> float:
    """Order p of v = v_0 + c h^p through the last three of values on meshes, h each `ratio` times less.

    Returns
    -------
    float
        The order; NaN where the values do not approach a limit from one side with an order of 0.05 to 12.
    """
    first, second = values[-2] - values[-3], values[-1] - values[-2]
    order = math.log(first / second) / math.log(ratio) if first * second > 0.0 else math.nan
    return order if 0.05 < order < 12.0 else math.nan
