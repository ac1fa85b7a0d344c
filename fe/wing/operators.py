"""Affine operators of the wing: the full finite element model as a few matrices.

K(e, z) = e K_skin + (1 - z1) K_1 + ... + K_0 and M(m) = M_0 + m_servo M_s + m_pitot M_p, where K_skin is the
skin without the damage regions: in the published model the factor e does not scale them.
The root is a rigid rib on three springs; its held motions are eliminated, so that all matrices act on the
free unknowns: those of the nodes outside the root section, then root heave [m], flap [rad] and yaw [rad].
Gauge strains are weights of nodal displacements: Kapteyn et al. 2021, eq. (15).
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy import sparse

from fe.elements import cells as elements
from fe.elements.kinds import gauss_points
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.state import TIP_FORCE
from fe.structure.affine import AffineStructure, StiffnessTerm, designed
from fe.structure.mesh import RigidSet, SupportedUnknowns, rigid_motions

from .design import WingDesign, wing_structure
from .mesh import WingMesh, build_mesh
from .parts import PointMassPlace
from .turn_load import STANDARD_GRAVITY, lift_load


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


def gauge_output(mesh: WingMesh, turned: float = 0.0) -> sparse.csr_array:
    """Strain of each gauge, csr (gauges, full) [1/m]: eq. (15) at the true gauge points.

    The strain along the span of the upper skin, on its outer surface or in the middle of its thickness,
    averaged over the gauge's patch piece by piece between the mesh lines, positive in compression. A gauge
    `turned` [rad] in the skin from the span towards the tip's rear reads along its own direction.
    """
    design = mesh.design
    gauges, plan = design.gauges, design.planform
    found: list[tuple[int, float, int, FloatArray]] = []
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        # The patch is a rectangle: the same distances fore and aft of the gauge's own chord line.
        middle = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
        for place, span_weight in zip(
            *patch_pieces(distance, gauges.averaging_spanwise, mesh.span_lines), strict=True
        ):
            lead = plan.straight_chord_line * plan.chord(place / plan.semi_span)
            behind = patch_pieces(middle + lead, gauges.averaging_chordwise, mesh.chord_places(place))
            for chordwise, chord_weight in zip(*behind, strict=True):
                found.append((gauge, span_weight * chord_weight, *mesh.skin_point(place, chordwise)))
    owner, share, cells, local = map(np.array, zip(*found, strict=True))
    if gauges.surface == "middle":
        local[:, 2] = 0.5
    direction, aft = _in_skin(mesh, cells, local)
    direction = np.cos(turned) * direction + np.sin(turned) * aft
    return mesh.strain_rows(owner, -share, cells, local, direction)


def _in_skin(mesh: WingMesh, cells: IntArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Find the unit directions (p, 3) along span and chord in the skin, at one point of each of p cells."""
    jacobian = elements.point_jacobians(mesh.kind, mesh.nodes[cells], local)
    normal = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    direction = np.array([0.0, 1.0, 0.0]) - normal[:, 1:2] * normal
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return direction, np.cross(direction, normal)


ROOT_UNKNOWNS = 3


@dataclass(frozen=True)
class AffineWing(AffineStructure):
    """A wing as a structure: a factor on its skin, two point masses, a turn and a force near its tip."""

    followed_load = TIP_FORCE

    @classmethod
    def of(
        cls,
        regions: tuple[str, ...],
        stiffness: Iterable[sparse.csr_array],
        masses: Iterable[sparse.csr_array],
        loads: Iterable[FloatArray],
        gauge_output: sparse.csr_array,
        tip: FloatArray,
        expansion: sparse.csr_array,
        **own: Any,
    ) -> Self:
        """Name what a wing is made of; all but its stiffness is given on all unknowns.

        Parameters
        ----------
        regions : tuple of str
            Names of the K damage regions.
        stiffness : iterable of csr (n, n)
            Skin without the damage regions, each of these, and the rest with the root springs [N/m].
        masses : iterable of csr (full, full)
            Structure [kg], and 1 kg in each servo and in the pitot [1].
        loads : iterable of (full,)
            A turn at load factor 1 [N], and 1 N upwards at the place of the static test [1].
        gauge_output : csr (gauges, full) 1/m
            Strain of each gauge, positive in compression (upper skin under positive lift), dimensionless.
        tip : (full,) 1
            Upward displacement at the tip, on the chord line of the static test.
        expansion : csr (full, n)
            Free unknowns to all unknowns.
        **own
            Hash, and what a subclass holds.
        """
        pairs = (("young_modulus_factor", None), *((None, name) for name in regions), (None, None))
        outputs = {
            "gauge": gauge_output,
            "displacement": sparse.csr_array(tip[np.newaxis]),
            "acceleration": sparse.csr_array((0, len(tip))),
        }
        structure, *point_masses = masses
        design = wing_structure(regions, gauge_output.shape[0])
        return cls(
            **designed(design, expansion, structure, point_masses, loads, outputs),
            stiffness_terms=tuple(
                StiffnessTerm(term, *pair) for term, pair in zip(stiffness, pairs, strict=True)
            ),
            **own,
        )

    @property
    def load_lift(self) -> FloatArray:
        """Load (n,) [N] of a turn at load factor 1."""
        return self.load_terms[0].vector

    @property
    def load_tip(self) -> FloatArray:
        """Upward load (n,) of 1 N at the place of the static test; as a row, the displacement there."""
        return self.load_terms[1].vector

    @property
    def tip_row(self) -> FloatArray:
        """Upward displacement (n,) at the tip, on the chord line of the static test."""
        return np.asarray(self.displacement_output.todense()).ravel()

    def turn(self, load_factor: float, tip_force: float = 0.0) -> FloatArray:
        """Load (n,) [N] at a load factor and an upward tip force [N]."""
        return load_factor * self.load_lift + tip_force * self.load_tip


def point_masses(servo: float, pitot: float) -> dict[str, float]:
    """Masses [kg] of one servo and of the pitot by their names."""
    return {"servo_mass": servo, "pitot_mass": pitot}


@dataclass(frozen=True)
class AffineOperators(AffineWing):
    """Affine finite element model of the wing on its n free unknowns (held motions are eliminated).

    Attributes
    ----------
    wing_mesh : WingMesh
        Nodes and cells with named regions; `expansion` gives the displacements of the nodes.
    """

    wing_mesh: WingMesh


def cell_elasticity(mesh: WingMesh) -> FloatArray:
    """Elasticity (nc, 6, 6) [Pa] in space of every cell, at e = 1 and without damage."""
    design, skin = mesh.design, mesh.design.skin
    local = np.empty((len(mesh.cells), 6, 6))
    across, along = skin.transverse_shear_ratio, skin.in_plane_shear_ratio
    unit, wall = (
        np.linalg.inv(elements.orthotropic_compliance(1.0, skin.poisson_ratio, shears))
        for shears in ((along, across, across), (across, across, along))
    )
    station = mesh.centres[:, 1] / design.planform.semi_span
    modulus = skin.young_modulus(station)
    shell = (mesh.web < 0) & (mesh.rib < 0)
    local[shell] = np.where(mesh.leading_edge[shell, None, None], wall, unit) * modulus[shell, None, None]
    for index, web in enumerate(design.webs):
        compliance = elements.orthotropic_compliance(web.young_modulus, web.poisson_ratio, web.shear_modulus)
        local[mesh.web == index] = np.linalg.inv(compliance)
    for index, rib in enumerate(design.ribs):
        local[mesh.rib == index] = np.linalg.inv(
            elements.isotropic_compliance(rib.young_modulus, rib.poisson_ratio)
        )
    for rod in design.rods:
        inside = (mesh.web == rod.web) & (station < rod.reach)
        second_moment = design.webs[rod.web].thickness * _web_height(mesh)[inside] ** 3 / 12.0
        local[inside, 1, 1] += rod.bending_stiffness / second_moment
    return elements.rotate_elasticity(local, cell_axes(mesh))


def cell_axes(mesh: WingMesh) -> FloatArray:
    """Local material axes (nc, 3, 3): rows chordwise, spanwise and across the surface of the cell."""
    jacobian = elements.jacobians(mesh.kind, mesh.nodes, np.array([[0.5, 0.5, 0.5]]))[:, 0]
    across = np.cross(jacobian[:, :, 0], jacobian[:, :, 1])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = jacobian[:, :, 1] / np.linalg.norm(jacobian[:, :, 1], axis=1, keepdims=True)
    return np.stack([np.cross(along, across), along, across], axis=1)


def modulus_variation(mesh: WingMesh) -> FloatArray:
    """Young's modulus (nc, 27) at the points of `gauss_points(3)` over that at the centre of the cell.

    It differs from one where the skin's modulus is given at stations and therefore changes inside a cell.
    """
    factor = np.ones((len(mesh.cells), 27))
    if mesh.design.skin.stations:
        shell = np.flatnonzero((mesh.web < 0) & (mesh.rib < 0))
        local, _ = gauss_points(3)
        span, skin = mesh.design.planform.semi_span, mesh.design.skin
        place = mesh.positions(shell, local)[..., 1] / span
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


def root_support(mesh: WingMesh) -> SupportedUnknowns:
    """Hold the wing: the root section moves as a rigid rib on springs.

    The rib may heave along z, flap about x and yaw about z, both about the straight chord line; its three
    unknowns come last. Its other motions are held.
    """
    root, nothing = mesh.design.root, np.zeros(mesh.unknowns)
    on_root = np.flatnonzero(np.abs(mesh.points[:, 1]) < 1e-9 * mesh.design.planform.semi_span)
    motions = rigid_motions(mesh.points[on_root], np.zeros(3), 2.0)
    springs = np.array([0.0, 0.0, root.transverse_spring, root.flap_spring, 0.0, root.yaw_spring])
    rib = RigidSet(on_root, np.zeros(3), motions, springs == 0.0, springs)
    return SupportedUnknowns(nothing.astype(bool), nothing, (rib,))


def section_displacement(mesh: WingMesh, distance: float, chord_fraction: float) -> FloatArray:
    """Weights (nodes,) of the mean displacement of the upper and lower skin at a place.

    Parameters
    ----------
    mesh : WingMesh
        The mesh.
    distance : float
        Distance from the root [m].
    chord_fraction : float
        Place along the local chord.
    """
    behind = chord_fraction * mesh.design.planform.chord(distance / mesh.design.planform.semi_span)
    weights = np.zeros(len(mesh.points))
    for upper in (True, False):
        point = mesh.skin_point(distance, behind, upper=upper)
        weights[mesh.cells[point.cell]] += 0.5 * mesh.kind.shape_functions(point.local[None])[0][0]
    return weights


def upward(weights: FloatArray) -> FloatArray:
    """Weights (full,) of upward displacements from those of nodes (nodes,)."""
    return np.kron(weights, np.array([0.0, 0.0, 1.0]))


def point_mass_weights(mesh: WingMesh, place: PointMassPlace) -> FloatArray:
    """Weights (nodes,) of the displacement of a point mass: half on each skin."""
    distance = place.station * mesh.design.planform.semi_span
    return section_displacement(mesh, distance, place.chord)


def all_point_mass_weights(mesh: WingMesh) -> tuple[tuple[FloatArray, ...], ...]:
    """`point_mass_weights` of the servos, and of the pitots."""
    places = mesh.design.point_masses
    return tuple(
        tuple(point_mass_weights(mesh, place) for place in places if place.kind == kind)
        for kind in ("servo", "pitot")
    )


def nodal_weight(mesh: WingMesh) -> FloatArray:
    """Weight (nodes,) [N] of structure and nominal point masses."""
    mass = np.asarray(mesh.mass(np.arange(len(mesh.cells)), cell_density(mesh)).sum(axis=1))
    masses = mesh.design.masses
    for own, places in zip((masses.servo, masses.pitot), all_point_mass_weights(mesh), strict=True):
        mass = mass + own * sum(places, np.zeros(len(mass)))
    return STANDARD_GRAVITY * mass


def turn_load(mesh: WingMesh) -> FloatArray:
    """Load (full,) [N] of load factor 1: the design's lift, net of the weight where that relieves it."""
    load = lift_load(mesh)
    if mesh.design.lift.inertia_relief:  # the weight where it lies, and as much lift against it
        weight, lift = nodal_weight(mesh), load[2::3].copy()
        load[2::3] += lift * (weight.sum() / lift.sum()) - weight
    return load


def stiffness_parts(mesh: WingMesh, parts: Iterable[IntArray]) -> Iterator[sparse.csr_array]:
    """Yield the stiffness, csr (full, full) [N/m], of each part of the cells, at e = 1 and without damage."""
    elasticity, variation = cell_elasticity(mesh), modulus_variation(mesh)
    for cells in parts:
        yield mesh.stiffness(cells, elasticity[cells], variation[cells])


def assemble(design: WingDesign) -> AffineOperators:
    """Mesh a design and assemble its affine operators.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    """
    mesh = build_mesh(design)
    held = root_support(mesh)
    restriction, expansion = held.expansion.T.tocsr(), held.expansion
    parts = [np.flatnonzero(mesh.stiffness_term == term) for term in range(len(design.regions) + 2)]
    *skin, rest = ((restriction @ (part @ expansion)).tocsr() for part in stiffness_parts(mesh, parts))
    masses = [mesh.mass(np.arange(len(mesh.cells)), cell_density(mesh))]
    for places in all_point_mass_weights(mesh):
        columns = sparse.csr_array(np.array(places).reshape(-1, len(mesh.points)).T)
        masses.append(columns @ columns.T)
    span, load = design.planform.semi_span, design.tip_load
    at_load, at_tip = (
        upward(section_displacement(mesh, place, load.chord))
        for place in (span - load.distance_from_tip, span)
    )
    return AffineOperators.of(
        design.regions,
        (*skin, (rest + held.stiffness).tocsr()),
        (sparse.kron(mass, sparse.eye_array(3), format="csr") for mass in masses),
        (turn_load(mesh), at_load),
        gauge_output(mesh),
        at_tip,
        expansion,
        design_hash=design.hash,
        wing_mesh=mesh,
    )
