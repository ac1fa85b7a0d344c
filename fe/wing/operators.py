"""Affine operators of the wing: the full finite element model as a few matrices.

K(e, z) = e K_skin + (1 - z1) K_1 + ... + K_0 and M(m) = M_0 + m_servo M_s + m_pitot M_p, where K_skin is the
skin without the damage regions: in the published model the factor e does not scale them.
The root is a rigid rib on three springs; its held motions are eliminated, so that all matrices act on the
free unknowns: those of the nodes outside the root section, then root heave [m], flap [rad] and yaw [rad].
Gauge strains are weights of nodal displacements: Kapteyn et al. 2021, eq. (15). Also statics and modes of the
full wing, eqs. (13), (15) and (16).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.elements import cells as elements
from fe.elements.kinds import gauss_points
from fe.full.factorisation import most_moved
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.state import STANDARD_GRAVITY, TIP_FORCE, Losses, losses_of
from fe.structure.affine import AffineStructure, StaticResponse, natural_frequencies, static_response
from fe.structure.mesh import Body, PointMass, RigidSet, Supports, supports

from .design import WingDesign, wing_structure
from .mesh import WingMesh, build_mesh
from .parts import DISTRIBUTIONS


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
    jacobian = mesh.jacobians_at(cells, local)
    normal = elements.unit_vector(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]))
    direction = elements.unit_vector(np.array([0.0, 1.0, 0.0]) - normal[:, 1:2] * normal)
    return direction, np.cross(direction, normal)


ROOT_UNKNOWNS = 3


@dataclass(frozen=True)
class AffineWing(AffineStructure):
    """A wing as a structure: a factor on its skin, two point masses, a turn and a force near its tip."""

    followed_load = TIP_FORCE

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


def stiffness_parts(regions: Iterable[str]) -> tuple[tuple[str | None, str | None], ...]:
    """Parameter and region of each part of the stiffness: skin without regions, each of these, the rest."""
    return ("young_modulus_factor", None), *((None, name) for name in regions), (None, None)


def outputs(gauges: sparse.csr_array, tip: FloatArray) -> dict[str, sparse.csr_array]:
    """Name the rows of gauges, positive in compression, and of the upward displacement (full,) at the tip."""
    nothing = sparse.csr_array((0, len(tip)))
    displacement = sparse.csr_array(tip[np.newaxis])
    return {"gauge": gauges, "displacement": displacement, "acceleration": nothing, "port": nothing}


@dataclass(frozen=True)
class AffineOperators(AffineWing):
    """Affine finite element model of the wing on its n free unknowns (held motions are eliminated).

    Attributes
    ----------
    body : Body
        Its mesh, and what it is made of; `expansion` gives the displacements of the nodes.
    """

    body: Body[WingMesh]

    @property
    def wing_mesh(self) -> WingMesh:
        """Nodes and cells with named regions."""
        return self.body.mesh


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
        compliance = elements.isotropic_compliance(rib.young_modulus, rib.poisson_ratio)
        local[mesh.rib == index] = np.linalg.inv(compliance)
    for rod in design.rods:
        inside = (mesh.web == rod.web) & (station < rod.reach)
        second_moment = design.webs[rod.web].thickness * _web_height(mesh)[inside] ** 3 / 12.0
        local[inside, 1, 1] += rod.bending_stiffness / second_moment
    return elements.rotate_elasticity(local, cell_axes(mesh))


def cell_axes(mesh: WingMesh) -> FloatArray:
    """Local material axes (nc, 3, 3): rows chordwise, spanwise and across the surface of the cell."""
    jacobian = elements.jacobians(mesh.kind, mesh.nodes, np.array([[0.5, 0.5, 0.5]]))[:, 0]
    across = elements.unit_vector(np.cross(jacobian[:, :, 0], jacobian[:, :, 1]))
    along = elements.unit_vector(jacobian[:, :, 1])
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


def structural_mass(design: WingDesign) -> float:
    """Return the mass of the structure without its point masses, from the volumes of the cells [kg]."""
    mesh = build_mesh(design)
    return float(mesh.mass(np.arange(len(mesh.cells)), cell_density(mesh)).sum())


def root_support(mesh: WingMesh) -> Supports:
    """Hold the wing: the root section moves as a rigid rib on springs.

    The rib may heave along z, flap about x and yaw about z, both about the straight chord line; its three
    unknowns come last. Its other motions are held.
    """
    root, nothing = mesh.design.root, np.zeros(mesh.points.shape)
    on_root = np.flatnonzero(np.abs(mesh.points[:, 1]) < 1e-9 * mesh.design.planform.semi_span)
    springs = np.array([0.0, 0.0, root.transverse_spring, root.flap_spring, 0.0, root.yaw_spring])
    rib = RigidSet(on_root, np.zeros(3), springs == 0.0, springs)
    return supports(mesh.points, nothing.astype(bool), nothing, [rib])


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
        cell, local = mesh.skin_point(distance, behind, upper=upper)
        weights[mesh.cells[cell]] += 0.5 * mesh.kind.shape_functions(local[None])[0][0]
    return weights


def upward(weights: FloatArray) -> FloatArray:
    """Weights (full,) of upward displacements from those of nodes (nodes,)."""
    return np.kron(weights, np.array([0.0, 0.0, 1.0]))


def wing_body(mesh: WingMesh) -> Body[WingMesh]:
    """Return what the wing is made of; servos and pitot have the nominal masses of the design."""
    nominal = mesh.design.masses.model_dump()
    shares = {kind: [np.zeros((0, len(mesh.points)))] for kind in nominal}
    for place in mesh.design.point_masses:
        distance = place.station * mesh.design.planform.semi_span
        shares[place.kind].append(section_displacement(mesh, distance, place.chord)[None])
    return Body(
        mesh,
        root_support(mesh),
        cell_elasticity(mesh),
        cell_density(mesh),
        mesh.stiffness_term,
        stiffness_parts(mesh.design.regions),
        tuple(PointMass(f"{kind}_mass", nominal[kind], np.vstack(own)) for kind, own in shares.items()),
        modulus_variation(mesh),
    )


def lift_load(mesh: WingMesh) -> FloatArray:
    """Load (full,) [N] at load factor 1: up and forward, half on each skin.

    Along the span the design's distribution, along the chord (1 - xi)^p with the design's exponent p; each
    skin cell is loaded on its outer face. The sums are exactly those of the design, without the inertia.
    """
    design, plan = mesh.design, mesh.design.planform
    face, weight = gauss_points(4, 2)
    load = np.zeros(len(mesh.points))
    for upper in (True, False):
        cells = np.flatnonzero(mesh.grid_index[:, 2] == (mesh.height_cells + 1 if upper else 0))
        local = np.column_stack([face, np.full(len(face), 1.0 if upper else 0.0)])
        values, _ = mesh.kind.shape_functions(local)
        place = mesh.positions(cells, local)
        jacobian = elements.jacobians(mesh.kind, mesh.nodes[cells], local)
        area = np.linalg.det(jacobian[..., :2, :2])  # in the plan view
        station = np.clip(place[..., 1] / plan.semi_span, 0.0, 1.0)
        chord = plan.chord(station)
        xi = place[..., 0] / chord + plan.straight_chord_line
        along_span = DISTRIBUTIONS[design.lift.distribution](plan, station)
        pressure = along_span * (1.0 - xi) ** design.lift.chordwise_exponent / chord
        np.add.at(load, mesh.cells[cells], (pressure * area * weight) @ values)
    load /= load.sum() * design.lift.load_factor
    full = np.zeros(mesh.unknowns)
    full[2::3] = design.lift.force * load
    full[0::3] = -design.lift.forward_force * load
    return full


def turn_load(body: Body[WingMesh]) -> FloatArray:
    """Load (full,) [N] of load factor 1: the design's lift, net of the weight where that relieves it."""
    load = lift_load(body.mesh)
    if body.mesh.design.lift.inertia_relief:  # the weight where it lies, and as much lift against it
        weight, lift = STANDARD_GRAVITY * body.nodal_mass, load[2::3].copy()
        load[2::3] += lift * (weight.sum() / lift.sum()) - weight
    return load


def assemble(design: WingDesign) -> AffineOperators:
    """Mesh a design and assemble its affine operators.

    Raises
    ------
    MeshError
        If the mesh cannot hold what the design asks for.
    """
    mesh = build_mesh(design)
    body, span, load = wing_body(mesh), design.planform.semi_span, design.tip_load
    at_load, at_tip = (
        upward(section_displacement(mesh, place, load.chord))
        for place in (span - load.distance_from_tip, span)
    )
    named = wing_structure(design.regions, len(design.gauges.positions))
    loads = (turn_load(body), at_load)
    return AffineOperators(
        **body.assembled(named, loads, outputs(gauge_output(mesh), at_tip)), design_hash=design.hash
    )


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
    masses = point_masses(servo_mass, pitot_mass)
    values = wing_values(operators, young_modulus_factor, stiffness_loss, **masses)
    frequency, shapes = natural_frequencies(operators, count, values)
    shapes = shapes * np.where(operators.tip_row @ shapes < 0.0, -1.0, 1.0)
    return Eigenmodes(frequency, shapes, most_moved(operators.load_tip, frequency**2, shapes))
