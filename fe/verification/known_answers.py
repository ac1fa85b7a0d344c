"""Verification of the finite element model: checks with known answers, each returned as a record.

The patch test, the rigid-body modes and the cantilever check the element and the assembly on bodies of
their own; the balance and the mesh convergence check the wing itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import brentq

from fe.elements.cells import CellMesh, gradients, hexahedra_20, isotropic_elasticity, strain_matrix
from fe.elements.kinds import HEXAHEDRA_20, gauss_points
from fe.full.statics import Factorisation
from fe.structure.location import area_shares
from fe.structure.mesh import Surface
from fe.structure.supports import rigid_motions
from fe.wing.design import WingDesign
from fe.wing.operators import AffineOperators, assemble, cell_density, root_support
from fe.wing.responses import eigenmodes, solve_static

FloatArray = NDArray[np.float64]

_PATCH_GRADIENT = np.array([[1.0, -0.4, 0.3], [0.2, -0.7, 0.5], [-0.6, 0.1, 0.8]]) * 1e-3


def brick(
    lengths: tuple[float, float, float], cells: tuple[int, int, int], distortion: float = 0.0, seed: int = 0
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
    seed : int
        Of the distortion.
    """
    grid = np.stack(
        np.meshgrid(*(np.linspace(0.0, 1.0, n + 1) for n in cells), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    corner = np.array(HEXAHEDRA_20.corners)
    first = np.stack(np.meshgrid(*(np.arange(n) for n in cells), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    numbers = np.ravel_multi_index(tuple(np.moveaxis(first + corner, 2, 0)), tuple(n + 1 for n in cells))
    inside = np.all((grid > 1e-9) & (grid < 1.0 - 1e-9), axis=1)
    shift = np.random.default_rng(seed).uniform(-distortion, distortion, grid.shape) / np.array(cells)
    points = (grid + shift * inside[:, None]) * np.array(lengths)
    return hexahedra_20(points, numbers)


def _uniform_stiffness(body: CellMesh, elasticity: FloatArray) -> sparse.csr_array:
    return body.stiffness(np.arange(len(body.cells)), elasticity)


@dataclass(frozen=True)
class PatchTest:
    """Errors of a state of constant strain on distorted cells, relative to its largest value.

    Attributes
    ----------
    displacement_error, strain_error : float
        Largest errors over the interior nodes and over the centres of the cells.
    """

    displacement_error: float
    strain_error: float


def patch_test(distortion: float = 0.25) -> PatchTest:
    """Impose a linear displacement on the surface of a distorted brick; it must hold inside."""
    body = brick((1.0, 0.8, 1.2), (3, 3, 3), distortion)
    stiffness = _uniform_stiffness(body, isotropic_elasticity(1.0, 0.3))
    points = body.points
    exact = (points @ _PATCH_GRADIENT.T).ravel()
    edge = np.isclose(points, 0.0) | np.isclose(points, [1.0, 0.8, 1.2])
    free = np.flatnonzero(np.repeat(~edge.any(axis=1), 3))
    fixed = np.setdiff1d(np.arange(body.unknowns), free)
    found = exact.copy()
    found[free] = Factorisation(stiffness[free][:, free]).solve(-stiffness[free][:, fixed] @ exact[fixed])
    slopes, _ = gradients(body.kind, body.nodes, np.array([[0.5, 0.5, 0.5]]))
    moved = found[body.unknowns_of(np.arange(len(body.cells)))]
    strain = np.einsum("nij,nj->ni", strain_matrix(slopes[:, 0]), moved)
    symmetric = _PATCH_GRADIENT + _PATCH_GRADIENT.T
    expected = np.array([*(0.5 * np.diag(symmetric)), symmetric[1, 2], symmetric[0, 2], symmetric[0, 1]])
    return PatchTest(
        float(np.abs(found - exact).max() / np.abs(exact).max()),
        float(np.abs(strain - expected).max() / np.abs(expected).max()),
    )


@dataclass(frozen=True)
class RigidBodyCheck:
    """Eigenvalues of an unsupported body, relative to the largest.

    Attributes
    ----------
    count : int
        Number of eigenvalues below 1e-12 of the largest; six for a sound element.
    largest_zero, smallest_elastic : float
        The sixth and the seventh eigenvalue over the largest.
    """

    count: int
    largest_zero: float
    smallest_elastic: float


def rigid_body_check() -> RigidBodyCheck:
    """Eigenvalues of the stiffness of an unsupported distorted brick."""
    body = brick((1.0, 0.8, 1.2), (2, 2, 2), 0.25)
    stiffness = _uniform_stiffness(body, isotropic_elasticity(1.0, 0.3)).toarray()
    values = np.linalg.eigvalsh(stiffness) / np.linalg.norm(stiffness, 2)
    return RigidBodyCheck(int((values < 1e-12).sum()), float(values[5]), float(values[6]))


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


@dataclass(frozen=True)
class CantileverCheck:
    """Tip deflection of a cantilever of 20-node hexahedra against Timoshenko's beam [m]."""

    deflection: float
    timoshenko: float

    @property
    def relative_error(self) -> float:
        """Deflection over Timoshenko's, less one."""
        return self.deflection / self.timoshenko - 1.0


def cantilever_check(cells_along: int = 10) -> CantileverCheck:
    """Bend a clamped beam of square section by a shear force at its end.

    Poisson's ratio is zero, so that the clamp does not hold back the section and the beam theory with the
    shear coefficient 5/6 is the solution to compare with.
    """
    length, side, modulus, force = 2.0, 0.1, 70e9, 100.0
    body = brick((side, length, side), (2, cells_along, 2))
    second_moment = side**4 / 12.0
    bending = force * length**3 / (3.0 * modulus * second_moment)
    shear = force * length / (5.0 / 6.0 * 0.5 * modulus * side**2)
    bent = force * _end_deflection(body, isotropic_elasticity(modulus, 0.0), length, 2)
    return CantileverCheck(bent, bending + shear)


def _end_deflection(body: CellMesh, elasticity: FloatArray, length: float, component: int) -> float:
    """Mean displacement of the end y = `length` along a unit force there; the other end is clamped."""
    stiffness, shares = _uniform_stiffness(body, elasticity), face_shares(body, length)
    free = np.flatnonzero(np.repeat(body.points[:, 1] > 1e-9, 3))
    load, found = np.zeros(body.unknowns), np.zeros(body.unknowns)
    load[component::3] = shares
    found[free] = Factorisation(stiffness[free][:, free]).solve(load[free])
    return float(found[component::3] @ shares)


def face_shares(body: CellMesh, place: float) -> FloatArray:
    """Consistent shares (nodes,) of a uniform traction on the end face y = `place`; they sum to one."""
    on_end = np.flatnonzero(np.isclose(body.corners[:, :, 1].max(axis=1), place))
    shares = area_shares(body, Surface(on_end, np.full(len(on_end), _END_FACE)))
    return np.asarray(shares / shares.sum())


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
    return _end_deflection(body, isotropic_elasticity(1e7, 0.3), length, component) / exact


@dataclass(frozen=True)
class WingBalance:
    """Sums that must agree for the wing in a turn.

    Attributes
    ----------
    structural_mass : float
        From the mass matrix and a rigid heave [kg].
    volume_mass : float
        From the volumes of the cells [kg].
    lift, spring_force : float
        Total net load and the force in the transverse root spring [N].
    lift_moment, spring_moment : float
        Moment of the load about the root and the moment in the flap spring [N m].
    work, strain_energy : float
        Half the work of the load and the elastic energy [J].
    """

    structural_mass: float
    volume_mass: float
    lift: float
    spring_force: float
    lift_moment: float
    spring_moment: float
    work: float
    strain_energy: float


def wing_balance(operators: AffineOperators, load_factor: float = 3.0) -> WingBalance:
    """Mass, reaction and energy sums of the wing at a load factor."""
    mesh = operators.wing_mesh
    design = mesh.design
    heave, flap, _ = _rigid_motions(operators).T
    local, weight = gauss_points(2)
    volume = gradients(mesh.kind, mesh.nodes, local)[1] @ weight
    solution = solve_static(operators, load_factor=load_factor)
    u = solution.displacement
    load = operators.turn(load_factor)
    return WingBalance(
        structural_mass=float(heave @ (operators.mass_terms[0] @ heave)),
        volume_mass=float(volume @ cell_density(mesh)),
        lift=design.lift.force * load_factor / design.lift.load_factor,
        spring_force=float(design.root.transverse_spring * u[-3]),
        lift_moment=float(flap @ load),
        spring_moment=float(design.root.flap_spring * u[-2]),
        work=float(0.5 * load @ u),
        strain_energy=float(0.5 * u @ (operators.stiffness() @ u)),
    )


@dataclass(frozen=True)
class ConvergenceRow:
    """Results of the wing on one mesh.

    Attributes
    ----------
    refinement : float
        `mesh.refinement` of the design.
    unknowns : int
        Free unknowns.
    tip_stiffness : float
        N/m.
    first_bending, second_bending : float
        Flapwise bending frequencies at the design's nominal masses [Hz].
    strain : (gauges,) dimensionless
        Gauge strains at the load factor of the design's lift.
    """

    refinement: float
    unknowns: int
    tip_stiffness: float
    first_bending: float
    second_bending: float
    strain: FloatArray


def convergence_row(operators: AffineOperators) -> ConvergenceRow:
    """Results of the healthy wing at e = 1 on the mesh of `operators`."""
    design = operators.wing_mesh.design
    factors = Factorisation(operators.stiffness())
    turn = factors.solve(operators.turn(design.lift.load_factor))
    bent = factors.solve(operators.load_tip)
    modes = eigenmodes(operators, 1.0, (), design.masses.servo, design.masses.pitot, count=4)
    first, second = modes.flapwise_bending
    return ConvergenceRow(
        refinement=design.mesh.refinement,
        unknowns=operators.unknowns,
        tip_stiffness=1.0 / float(operators.load_tip @ bent),
        first_bending=float(modes.frequency[first]),
        second_bending=float(modes.frequency[second]),
        strain=np.asarray(operators.gauge_output @ turn),
    )


def mesh_convergence(
    design: WingDesign, refinements: Sequence[float] = (0.5, 1.0, 1.5, 2.0)
) -> tuple[ConvergenceRow, ...]:
    """Results of the same wing on a sequence of meshes; nothing is refitted.

    Raises
    ------
    InvalidDesignError
        If a refinement lies outside the range of the design.
    """
    return tuple(
        convergence_row(assemble(design.changed(mesh={"refinement": refinement})))
        for refinement in refinements
    )


def observed_order(refinements: Sequence[float], values: Sequence[float]) -> float:
    """Order p of v = v_0 + c refinement^-p through the last three of a sequence of meshes.

    Returns
    -------
    float
        The order; NaN where the values do not approach a limit from one side with an order of 0.05 to 12.
    """
    coarse, middle, fine = (1.0 / refinement for refinement in refinements[-3:])
    first, second = values[-2] - values[-3], values[-1] - values[-2]
    if first * second <= 0.0:
        return float("nan")

    def mismatch(order: float) -> float:
        return float((coarse**order - middle**order) * second - (middle**order - fine**order) * first)

    ends = 0.05, 12.0
    if mismatch(ends[0]) * mismatch(ends[1]) > 0.0:
        return float("nan")
    return float(brentq(mismatch, *ends))
