"""Verification of the finite element model: checks with known answers, each returned as a record.

The patch test, the rigid-body modes and the cantilever check the element and the assembly on bodies of
their own; the balance and the mesh convergence check the wing itself.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse

from fe.elements.cells import CellMesh, gradients, hexahedra_20, isotropic_compliance
from fe.elements.kinds import HEXAHEDRA_20, gauss_points
from fe.full.factorisation import Factorisation
from fe.runtime.arrays import FloatArray
from fe.structure.affine import static_response
from fe.structure.location import face_areas
from fe.structure.mesh import Surface, rigid_motions
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble, cell_density, root_support
from fe.wing.responses import eigenmodes

_PATCH_GRADIENT = np.array([[1.0, -0.4, 0.3], [0.2, -0.7, 0.5], [-0.6, 0.1, 0.8]]) * 1e-3


def brick(
    lengths: tuple[float, float, float], cells: tuple[int, int, int], distortion: float = 0.0
) -> CellMesh:
    """Brick of 20-node hexahedra with positive Jacobians.

    Parameters
    ----------
    lengths : tuple of float
        Edges [m].
    cells : tuple of int
        Number of cells along each edge.
    distortion : float
        Interior vertices move by up to this fraction of a cell.
    """
    grid = np.indices([n + 1 for n in cells]).reshape(3, -1).T / np.array(cells)
    corner = np.indices(cells).reshape(3, -1).T[:, None] + np.array(HEXAHEDRA_20.corners)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(corner, 2, 0)), tuple(n + 1 for n in cells))
    inside = np.all((grid > 1e-9) & (grid < 1.0 - 1e-9), axis=1)
    shift = np.random.default_rng(0).uniform(-distortion, distortion, grid.shape) / np.array(cells)
    points = (grid + shift * inside[:, None]) * np.array(lengths)
    return hexahedra_20(points, numbers)


def _uniform_stiffness(body: CellMesh, young_modulus: float, poisson_ratio: float) -> sparse.csr_array:
    elasticity = np.asarray(
        np.linalg.inv(isotropic_compliance(young_modulus, poisson_ratio)), dtype=np.float64
    )
    return body.stiffness(np.arange(len(body.cells)), elasticity)


def patch_test() -> tuple[float, float]:
    """Impose a linear displacement on the surface of a distorted brick; it must hold inside.

    Returns
    -------
    displacement, strain : float
        Largest errors over the interior nodes and over the centres of the cells, relative.
    """
    body = brick((1.0, 0.8, 1.2), (3, 3, 3), 0.25)
    stiffness = _uniform_stiffness(body, 1.0, 0.3)
    points = body.points
    exact = (points @ _PATCH_GRADIENT.T).ravel()
    edge = np.isclose(points, 0.0) | np.isclose(points, [1.0, 0.8, 1.2])
    free = np.flatnonzero(np.repeat(~edge.any(axis=1), 3))
    fixed = np.setdiff1d(np.arange(body.unknowns), free)
    found = exact.copy()
    found[free] = Factorisation(stiffness[free][:, free]).solve(-stiffness[free][:, fixed] @ exact[fixed])
    strain = body.strains(found.reshape(-1, 3))[:, 0]
    symmetric = _PATCH_GRADIENT + _PATCH_GRADIENT.T
    expected = np.array([*(0.5 * np.diag(symmetric)), symmetric[1, 2], symmetric[0, 2], symmetric[0, 1]])
    moved, strained = np.abs(found - exact).max(), np.abs(strain - expected).max()
    return float(moved / np.abs(exact).max()), float(strained / np.abs(expected).max())


def rigid_body_values() -> FloatArray:
    """Eigenvalues (n,) of the stiffness of an unsupported distorted brick over the largest, rising."""
    body = brick((1.0, 0.8, 1.2), (2, 2, 2), 0.25)
    values = np.linalg.eigvalsh(_uniform_stiffness(body, 1.0, 0.3).toarray())
    return np.asarray(values / values[-1])


def _rigid_motions(operators: AffineOperators) -> FloatArray:
    """Free unknowns (n, 3) of the rigid motions that the root allows: heave, flap and yaw."""
    expansion = operators.expansion
    full = rigid_motions(operators.wing_mesh.points, np.zeros(3), 2.0)[:, [2, 3, 5]]
    scale = np.asarray((expansion.T @ expansion).diagonal())
    free = (expansion.T @ full) / scale[:, None]
    free[-3:] = np.eye(3)
    return np.asarray(free)


def rigid_body_residual(operators: AffineOperators) -> float:
    """Largest force that a rigid motion of the wing calls forth, over the sum of its terms.

    The motions are those that the root allows, heave, flap and yaw; the forces of the springs are left out.
    """
    free = _rigid_motions(operators)
    stiffness = operators.stiffness()
    force = (stiffness - root_support(operators.wing_mesh).stiffness) @ free
    bound = np.asarray(abs(stiffness) @ np.abs(free))
    return float(np.abs(force).max() / bound.max())


def cantilever_check(cells_along: int = 10) -> float:
    """Bend a clamped beam of square section by a shear force: deflection over Timoshenko's, less one.

    Poisson's ratio is zero, so that the clamp does not hold back the section and the beam theory with the
    shear coefficient 5/6 is the solution to compare with.
    """
    length, side, modulus, force = 2.0, 0.1, 70e9, 100.0
    body = brick((side, length, side), (2, cells_along, 2))
    second_moment = side**4 / 12.0
    bending = force * length**3 / (3.0 * modulus * second_moment)
    shear = force * length / (5.0 / 6.0 * 0.5 * modulus * side**2)
    bent = force * _end_deflection(body, modulus, 0.0, length, 2)
    return bent / (bending + shear) - 1.0


def _end_deflection(
    body: CellMesh, young_modulus: float, poisson_ratio: float, length: float, component: int
) -> float:
    """Mean displacement of the end y = `length` along a unit force there; the other end is clamped."""
    stiffness = _uniform_stiffness(body, young_modulus, poisson_ratio)
    on_end = np.flatnonzero(np.isclose(body.corners[:, :, 1].max(axis=1), length))
    _, shares = face_areas(body, Surface(on_end, np.full(len(on_end), _END_FACE)))
    shares /= shares.sum()
    free = np.flatnonzero(np.repeat(body.points[:, 1] > 1e-9, 3))
    load, found = np.zeros(body.unknowns), np.zeros(body.unknowns)
    load[component::3] = shares
    found[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    return float(found[component::3] @ shares)


_END_FACE = 4  # of a hexahedron, where its second coordinate is one
MACNEAL_HARDER_SHAPES: tuple[str, ...] = ("regular", "trapezoid", "parallelogram")


def macneal_harder_beam(shape: str, *, across_depth: bool) -> float:
    """Tip deflection of MacNeal and Harder's straight slender beam over the exact one.

    Six cells along 6 x 0.2 x 0.1, E = 1e7, nu = 0.3, a unit shear force at the end; R. H. MacNeal and
    R. L. Harder, "A proposed standard set of problems to test finite element accuracy", Finite Elements in
    Analysis and Design 1 (1985), table 3.

    Parameters
    ----------
    shape : str
        One of `MACNEAL_HARDER_SHAPES`; the sides of the cells lean by 45 degrees.
    across_depth : bool
        Bend across the depth of 0.2 (in the plane of the lean), otherwise across the width of 0.1.
    """
    length, depth, width = 6.0, 0.2, 0.1
    regular = brick((depth, length, width), (1, 6, 1))
    points = regular.points[: regular.cells[:, :8].max() + 1].copy()
    line = np.rint(points[:, 1]).astype(int)
    lean = {"regular": 0.0 * line, "trapezoid": (-1.0) ** line, "parallelogram": 1.0 + 0.0 * line}[shape]
    inside = (line > 0) & (line < 6)
    points[:, 1] += np.where(inside, lean * (points[:, 0] - 0.5 * depth), 0.0)
    body = hexahedra_20(points, regular.cells[:, :8])
    component, exact = (0, 0.1081) if across_depth else (2, 0.4321)
    return _end_deflection(body, 1e7, 0.3, length, component) / exact


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
        "mass": (float(heave @ (operators.mass_terms[0] @ heave)), float(volume @ cell_density(mesh)), "kg"),
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
    found: dict[str, list[Any]] = {}
    for refinement in refinements:
        operators = assemble(design.changed(mesh={"refinement": refinement}))
        loads = np.column_stack((operators.turn(design.lift.load_factor), operators.load_tip))
        turn, bent = Factorisation(operators.stiffness()).solve(loads).T
        modes = eigenmodes(operators, 1.0, (), design.masses.servo, design.masses.pitot, 4)
        first, second = modes.frequency[modes.flapwise_bending].tolist()
        for name, value in (
            ("unknowns", operators.unknowns),
            ("tip stiffness", 1.0 / float(operators.load_tip @ bent)),
            ("first bending", first),
            ("second bending", second),
            ("strain", operators.gauge_output @ turn),
        ):
            found.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in found.items()}


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
