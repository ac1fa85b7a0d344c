"""Affine operators of the wing: the full finite element model as a few matrices.

K(e, z) = e K_skin + (1 - z1) K_1 + ... + K_0 and M(m) = M_0 + m_servo M_s + m_pitot M_p, where K_skin is the
skin without the damage regions: in the published model the factor e does not scale them.
The root is a rigid rib on three springs; its held motions are eliminated, so that all matrices act on the
free unknowns: those of the nodes outside the root section, then root heave [m], flap [rad] and yaw [rad].
Gauge strains are weights of nodal displacements: Kapteyn et al. 2021, eq. (15).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.wing.design import WingDesign
from fe.wing.mesh import SurfacePoint, WingMesh, build_mesh
from fe.wing.parts import PointMassPlace

from .affine import AffineSystem
from .assembly import (
    Discretisation,
    cell_axes,
    gauss_points,
    isotropic_elasticity,
    orthotropic_elasticity,
    point_jacobians,
    positions,
    rotate_elasticity,
)
from .turn_load import Weights, inertia_relief, lift_load

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def patch_pieces(middle: float, length: float, lines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gauss points (p,) and weights (p,) of the mean over a length, piece by piece between mesh lines.

    Strain jumps at the edge of a defect, which is a mesh line: points that do not know of it misjudge how
    much of a patch lies beyond.
    """
    if length == 0.0:
        return np.array([middle]), np.array([1.0])
    start, end = middle - 0.5 * length, middle + 0.5 * length
    breaks = np.array([start, *lines[(lines > start) & (lines < end)], end])
    line, weight = np.polynomial.legendre.leggauss(3)
    pieces = np.diff(breaks)[:, None]
    points = breaks[:-1, None] + 0.5 * (1.0 + line) * pieces
    return points.ravel(), (0.5 * weight * pieces / length).ravel()


def gauge_output(mesh: WingMesh, discretisation: Discretisation) -> sparse.csr_array:
    """Strain of each gauge, csr (gauges, full) [1/m]: eq. (15) at the true gauge points.

    The strain along the span of the upper skin, on its outer surface or in the middle of its thickness,
    averaged over the gauge's patch piece by piece between the mesh lines, positive in compression.
    """
    design = mesh.design
    gauges, plan = design.gauges, design.planform
    owner: list[int] = []
    share: list[float] = []
    points: list[SurfacePoint] = []
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        # The patch is a rectangle: the same distances fore and aft of the gauge's own chord line.
        middle = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
        for place, span_weight in zip(
            *patch_pieces(distance, gauges.averaging_spanwise, mesh.span_lines), strict=True
        ):
            lead = plan.straight_chord_line * plan.chord(place / plan.semi_span)
            _, _, lines = mesh.upper_skin_lines(place)
            behind = patch_pieces(middle + lead, gauges.averaging_chordwise, lines)
            for chordwise, chord_weight in zip(*behind, strict=True):
                owner.append(gauge)
                share.append(span_weight * chord_weight)
                points.append(mesh.skin_point(place, chordwise))
    cells = np.array([point.cell for point in points])
    local = np.array([point.local for point in points])
    if gauges.surface == "middle":
        local[:, 2] = 0.5
    dofs, weights = discretisation.strain_along(cells, local, _span_direction(mesh, cells, local))
    weights = -np.array(share)[:, None] * weights
    rows = np.repeat(owner, dofs.shape[1])
    return sparse.coo_array(
        (weights.ravel(), (rows, dofs.ravel())), shape=(len(gauges.positions), discretisation.unknowns)
    ).tocsr()


def _span_direction(mesh: WingMesh, cells: IntArray, local: FloatArray) -> FloatArray:
    """Find the unit direction (p, 3) along the span in the surface, at one point of each of p cells."""
    jacobian = point_jacobians(mesh.corners[cells], local)
    normal = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = np.array([0.0, 1.0, 0.0]) - normal[:, 1:2] * normal
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


MASS_TERM_NAMES: tuple[str, ...] = ("base", "servo", "pitot")
ROOT_UNKNOWNS = 3


@dataclass(frozen=True)
class AffineOperators(AffineSystem):
    """Affine finite element model of the wing on its n free unknowns (held motions are eliminated).

    Attributes
    ----------
    discretisation : Discretisation
        Nodes and cells of the full mesh; `expansion` gives their displacements (3 node + component).
    wing_mesh : WingMesh
        Mesh with its named regions.
    """

    discretisation: Discretisation
    wing_mesh: WingMesh

    def load(self, load_factor: float, tip_force: float = 0.0) -> FloatArray:
        """Load (n,) [N] at a load factor and an upward tip force [N]."""
        return load_factor * self.load_lift + tip_force * self.load_tip

    def full_displacement(self, free: FloatArray) -> FloatArray:
        """Displacements (nodes, 3) of all nodes from free unknowns (n,)."""
        return np.asarray(self.expansion @ free).reshape(-1, 3)


def cell_elasticity(mesh: WingMesh) -> FloatArray:
    """Elasticity (nc, 6, 6) [Pa] in space of every cell, at e = 1 and without damage."""
    design, skin = mesh.design, mesh.design.skin
    local = np.empty((len(mesh.cells), 6, 6))
    unit = orthotropic_elasticity(
        1.0,
        skin.poisson_ratio,
        skin.transverse_shear_ratio,
        skin.transverse_shear_ratio,
        skin.in_plane_shear_ratio,
    )
    wall = orthotropic_elasticity(
        1.0,
        skin.poisson_ratio,
        skin.in_plane_shear_ratio,
        skin.transverse_shear_ratio,
        skin.transverse_shear_ratio,
    )
    station = mesh.centres[:, 1] / design.planform.semi_span
    modulus = skin.young_modulus(station)
    shell = (mesh.web < 0) & (mesh.rib < 0)
    local[shell] = np.where(mesh.leading_edge[shell, None, None], wall, unit) * modulus[shell, None, None]
    for index, web in enumerate(design.webs):
        shear = web.shear_modulus
        local[mesh.web == index] = orthotropic_elasticity(
            web.young_modulus, web.poisson_ratio, shear, shear, shear
        )
    for index, rib in enumerate(design.ribs):
        local[mesh.rib == index] = isotropic_elasticity(rib.young_modulus, rib.poisson_ratio)
    for rod in design.rods:
        inside = (mesh.web == rod.web) & (station < rod.reach)
        second_moment = design.webs[rod.web].thickness * _web_height(mesh)[inside] ** 3 / 12.0
        local[inside, 1, 1] += rod.bending_stiffness / second_moment
    return rotate_elasticity(local, cell_axes(mesh.corners))


def modulus_variation(mesh: WingMesh) -> FloatArray:
    """Young's modulus (nc, 27) at the points of `gauss_points(3)` over that at the centre of the cell.

    It differs from one where the skin's modulus is given at stations and therefore changes inside a cell.
    """
    factor = np.ones((len(mesh.cells), 27))
    if mesh.design.skin.stations:
        shell = np.flatnonzero((mesh.web < 0) & (mesh.rib < 0))
        local, _ = gauss_points(3)
        span, skin = mesh.design.planform.semi_span, mesh.design.skin
        place = positions(mesh.corners[shell], local)[..., 1] / span
        centre = skin.young_modulus(mesh.centres[shell, 1] / span)
        factor[shell] = skin.young_modulus(place) / centre[:, None]
    return factor


def _web_height(mesh: WingMesh) -> FloatArray:
    """Height (nc,) [m] between the skins at each cell between them."""
    height = np.ptp(mesh.corners[:, :, 2], axis=1)
    return np.asarray(height * mesh.height_cells)


def cell_density(mesh: WingMesh) -> FloatArray:
    """Density (nc,) [kg/m^3] of every cell."""
    design = mesh.design
    density = np.full(len(mesh.cells), design.skin.density)
    station = mesh.centres[:, 1] / design.planform.semi_span
    for index, web in enumerate(design.webs):
        density[mesh.web == index] = web.density
    for index, rib in enumerate(design.ribs):
        density[mesh.rib == index] = rib.density
    for added in design.added_density:
        density[(station > added.start) & (station < added.end)] += added.density
    for rod in design.rods:
        inside = (mesh.web == rod.web) & (station < rod.reach)
        density[inside] += rod.mass_per_length / (design.webs[rod.web].thickness * _web_height(mesh)[inside])
    return density


def root_expansion(design: WingDesign, discretisation: Discretisation) -> sparse.csr_array:
    """Free unknowns to all unknowns, csr (full, n): the root section moves as a rigid rib.

    The rib may heave along z, flap about x and yaw about z, both about the straight chord line; its three
    unknowns come last. Its other motions are held.
    """
    points = discretisation.node_points
    on_root = np.abs(points[:, 1]) < 1e-9 * design.planform.semi_span
    held = np.repeat(on_root, 3)
    free = np.flatnonzero(~held)
    root = np.flatnonzero(on_root)
    first = len(free)
    rows = [free, 3 * root + 2, 3 * root + 1, 3 * root + 1]
    columns = [np.arange(first), *(np.full(len(root), first + number) for number in range(ROOT_UNKNOWNS))]
    values = [np.ones(first), np.ones(len(root)), -points[root, 2], points[root, 0]]
    return sparse.coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        shape=(discretisation.unknowns, first + ROOT_UNKNOWNS),
    ).tocsr()


def _through_thickness(
    mesh: WingMesh, distance: float, chord_fraction: float
) -> tuple[SurfacePoint, SurfacePoint]:
    behind = chord_fraction * mesh.design.planform.chord(distance / mesh.design.planform.semi_span)
    return mesh.skin_point(distance, behind, upper=True), mesh.skin_point(distance, behind, upper=False)


def section_displacement(
    mesh: WingMesh, discretisation: Discretisation, distance: float, chord_fraction: float
) -> FloatArray:
    """Weights (nodes,) of the mean displacement of the upper and lower skin at a place.

    Parameters
    ----------
    mesh : WingMesh
        The mesh.
    discretisation : Discretisation
        Its degrees of freedom.
    distance : float
        Distance from the root [m].
    chord_fraction : float
        Place along the local chord.
    """
    weights = np.zeros(discretisation.unknowns // 3)
    for point in _through_thickness(mesh, distance, chord_fraction):
        nodes, values = discretisation.point_values(point.cell, point.local)
        weights[nodes] += 0.5 * values
    return weights


def _upward(weights: FloatArray) -> FloatArray:
    full = np.zeros(3 * len(weights))
    full[2::3] = weights
    return full


def point_mass_weights(mesh: WingMesh, discretisation: Discretisation, place: PointMassPlace) -> FloatArray:
    """Weights (nodes,) of the displacement of a point mass: half on each skin."""
    distance = place.station * mesh.design.planform.semi_span
    return section_displacement(mesh, discretisation, distance, place.chord)


def all_point_mass_weights(mesh: WingMesh, discretisation: Discretisation) -> Weights:
    """`point_mass_weights` of the servos, and of the pitots."""
    return tuple(
        tuple(
            point_mass_weights(mesh, discretisation, place)
            for place in mesh.design.point_masses
            if place.kind == kind
        )
        for kind in ("servo", "pitot")
    )


def assemble(design: WingDesign) -> AffineOperators:
    """Mesh a design and assemble its affine operators.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    """
    mesh = build_mesh(design)
    discretisation = Discretisation(mesh.skfem_mesh)
    expansion = root_expansion(design, discretisation)
    restriction = expansion.T.tocsr()

    def reduced(matrix: sparse.csr_array) -> sparse.csr_array:
        return (restriction @ (matrix @ expansion)).tocsr()

    elasticity, density, variation = cell_elasticity(mesh), cell_density(mesh), modulus_variation(mesh)
    terms = []
    for term in range(len(design.regions) + 1):
        cells = np.flatnonzero(mesh.stiffness_term == term)
        terms.append(reduced(discretisation.stiffness(cells, elasticity[cells], variation[cells])))
    cells = np.flatnonzero(mesh.stiffness_term == len(design.regions) + 1)
    springs = np.zeros(expansion.shape[1])
    root = design.root
    springs[-ROOT_UNKNOWNS:] = root.transverse_spring, root.flap_spring, root.yaw_spring
    terms.append(
        (
            reduced(discretisation.stiffness(cells, elasticity[cells], variation[cells]))
            + sparse.diags_array(springs)
        ).tocsr()
    )

    weights = all_point_mass_weights(mesh, discretisation)
    masses = [discretisation.mass(np.arange(len(mesh.cells)), density)]
    for places in weights:
        matrix = sparse.csr_array(masses[0].shape)
        for place in places:
            column = sparse.csr_array(place[:, None])
            matrix = matrix + sparse.kron(column @ column.T, sparse.eye_array(3), format="csr")
        masses.append(matrix)

    load_place = design.planform.semi_span - design.tip_load.distance_from_tip
    at_load = _upward(section_displacement(mesh, discretisation, load_place, design.tip_load.chord))
    at_tip = _upward(
        section_displacement(mesh, discretisation, design.planform.semi_span, design.tip_load.chord)
    )
    at_load_free = np.asarray(restriction @ at_load)
    lift = lift_load(mesh, discretisation)
    if design.lift.inertia_relief:
        lift = lift + inertia_relief(design, discretisation, density, weights, lift)
    return AffineOperators(
        regions=design.regions,
        stiffness_terms=tuple(terms),
        mass_terms=tuple(reduced(mass) for mass in masses),
        load_lift=np.asarray(restriction @ lift),
        load_tip=at_load_free,
        gauge_output=(gauge_output(mesh, discretisation) @ expansion).tocsr(),
        tip_displacement_output=np.asarray(restriction @ at_tip),
        expansion=expansion,
        discretisation=discretisation,
        wing_mesh=mesh,
        design_hash=design.hash,
    )
