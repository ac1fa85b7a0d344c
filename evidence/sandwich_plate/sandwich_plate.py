"""The wing as a sandwich plate: a second model of the same design, an order of magnitude cheaper.

Skins are the faces, at the section's height; webs, ribs and the leading-edge wall are solid cores where they
stand. Between them there is no core: the deflection runs straight from web to web along the chord, and the
skins bend on their own only as the beams of a frame (`plate_frame`). Every number is the
design's own. The operators are affine as those of the box, K(e, z) = e K_skin + (1 - z1) K_1 + ...
+ K_0, with the same three root unknowns last.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.runtime.state import STANDARD_GRAVITY
from fe.structure.affine import StiffnessTerm
from fe.structure.affine_fields import affine_fields
from fe.wing.design import WingDesign, wing_structure
from fe.wing.gauges import averaging_points
from fe.wing.operators import ROOT_UNKNOWNS, AffineWing, outputs, stiffness_parts
from fe.wing.parts import DISTRIBUTIONS

from .plate import FIELDS, A, B, Plate, Surface, U, V, W, plane_stress, surface_strain
from .plate_frame import frame_stiffness
from .plate_layout import PlateLayout

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class PlateOperators(AffineWing):
    """Affine plate model of the wing on its n free unknowns; `expansion` gives the five fields of all nodes.

    Attributes
    ----------
    kept : (n - 3,)
        Place among the five fields of all nodes of each free unknown before the three of the root.
    plate : Plate
        Nodes and cells.
    wing_design : WingDesign
        The design of the wing.
    """

    kept: NDArray[np.int64]
    plate: Plate
    wing_design: WingDesign

    def fields(self, free: FloatArray) -> FloatArray:
        """Fields u, v, a, b, w (5, N) of all nodes from free unknowns (n,)."""
        return np.asarray(self.expansion @ free).reshape(len(FIELDS), -1)

    def free_unknowns(self, fields: FloatArray) -> FloatArray:
        """Free unknowns (n,) of fields (5, N) that are zero at the root."""
        return np.concatenate((fields.ravel()[self.kept], np.zeros(ROOT_UNKNOWNS)))


def assemble_plate(design: WingDesign, *, straight_section: bool = False) -> PlateOperators:
    """Mesh a design in plan and assemble its plate.

    Parameters
    ----------
    design : WingDesign
        The wing.
    straight_section : bool
        Whether the section is straight between mesh lines, as that of the box is, or the true one.

    Raises
    ------
    MeshError
        If two mesh lines that the design asks for nearly coincide.
    """
    layout = PlateLayout(design, straight_section=straight_section)
    plate = layout.plate
    expansion, kept = _expansion(layout)
    restriction = expansion.T.tocsr()

    springs = np.zeros(expansion.shape[1])
    root = design.root
    springs[-ROOT_UNKNOWNS:] = root.transverse_spring, root.flap_spring, root.yaw_spring
    *skins, base = ((restriction @ (term @ expansion)).tocsr() for term in _stiffness_terms(layout))
    plan = design.planform
    load_place = plan.semi_span - design.tip_load.distance_from_tip
    load_tip, tip = (
        _deflection(layout, distance, design.tip_load.chord) for distance in (load_place, plan.semi_span)
    )
    terms = (*skins, (base + sparse.diags_array(springs)).tocsr())
    mass, *point_masses = _mass_terms(layout)
    named = wing_structure(design.regions, len(design.gauges.positions))
    loads, rows = (_lift(layout), load_tip), outputs(_gauge_output(layout), tip)
    return PlateOperators(
        design=named,
        **affine_fields(named, expansion, mass, point_masses, loads, rows),
        stiffness_terms=tuple(map(StiffnessTerm, terms, *zip(*stiffness_parts(design.regions), strict=True))),
        design_hash=design.hash,
        kept=kept,
        plate=plate,
        wing_design=design,
    )


def _expansion(layout: PlateLayout) -> tuple[sparse.csr_array, NDArray[np.int64]]:
    """Free unknowns to all unknowns, csr (5 N, n), and where the free ones are.

    The root is a rigid rib; the deflection is straight between the webs.
    """
    plate, grid = layout.plate, layout.half_grid
    points, count = plate.node_points, plate.nodes
    stiff = np.flatnonzero(layout.stiff_columns)
    lines = np.unique(np.concatenate((2 * stiff, 2 * stiff + 1, 2 * stiff + 2)))
    at_root = np.zeros(count, dtype=bool)
    at_root[grid[:, 0]] = True
    free = np.zeros((len(FIELDS), count), dtype=bool)
    free[[U, V, A, B]] = True
    free[W, grid[lines].ravel()] = True
    free[:, at_root] = False
    own = np.flatnonzero(free.ravel())
    number = np.full(free.size, -1)
    number[own] = np.arange(len(own))
    heave, flap, yaw = len(own) + np.arange(ROOT_UNKNOWNS)
    entries = [(own, number[own], np.ones(len(own)))]
    root = grid[:, 0]
    for field, unknown, value in (
        (W, heave, np.ones(len(root))),
        (B, flap, -np.ones(len(root))),
        (V, yaw, points[root, 0]),
    ):
        entries.append((field * count + root, np.full(len(root), unknown), value))
    between = np.setdiff1d(np.arange(len(grid)), lines)
    after = np.searchsorted(lines, between)
    here = grid[between, 1:]
    ends = grid[lines[after - 1], 1:], grid[lines[after], 1:]
    share = (points[here, 0] - points[ends[0], 0]) / (points[ends[1], 0] - points[ends[0], 0])
    for end, weight in zip(ends, (1.0 - share, share), strict=True):
        entries.append((W * count + here.ravel(), number[W * count + end.ravel()], weight.ravel()))
    rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    return sparse.coo_array((values, (rows, columns)), shape=(plate.unknowns, yaw + 1)).tocsr(), own


def _stiffness_terms(layout: PlateLayout) -> tuple[sparse.csr_array, ...]:
    """Stiffness of the skin without damage regions, of each of these, and of the rest, all (5 N, 5 N)."""
    design, plate, skin = layout.design, layout.plate, layout.design.skin
    every = np.arange(plate.mesh.nelements)
    modulus = layout.skin_modulus
    sheet = plane_stress(modulus, skin.poisson_ratio, skin.in_plane_shear_ratio * modulus)
    upper = layout.surface(plate.points, 0.5 * skin.thickness)
    lower = Surface(-upper.height, -upper.slope_x, -upper.slope_y)
    regions = [layout.defect(number) for number in range(len(design.defects))]

    def upper_skin(where: BoolArray) -> sparse.csr_array:
        return plate.face_stiffness(every, upper, skin.thickness, sheet * where[..., None, None])

    whole = upper_skin(~np.any(regions, axis=0)) + plate.face_stiffness(every, lower, skin.thickness, sheet)
    whole = whole + frame_stiffness(layout)
    half_height = layout.surface(plate.points, skin.thickness).height
    wall = np.flatnonzero(layout.wall)
    whole = whole + plate.core_stiffness(
        wall,
        half_height[wall],
        plane_stress(modulus, skin.poisson_ratio, skin.transverse_shear_ratio * modulus)[wall],
        modulus[wall, :, None] * np.array([skin.transverse_shear_ratio, skin.in_plane_shear_ratio]),
    )
    rest = sparse.csr_array((plate.unknowns, plate.unknowns))
    cores = [
        (np.flatnonzero(layout.web == index), web.young_modulus, web.poisson_ratio, web.shear_modulus)
        for index, web in enumerate(design.webs)
    ] + [
        (
            np.flatnonzero(layout.rib == index),
            rib.young_modulus,
            rib.poisson_ratio,
            rib.young_modulus / (2.0 * (1.0 + rib.poisson_ratio)),
        )
        for index, rib in enumerate(design.ribs)
    ]
    for cells, young, poisson, shear in cores:
        height = half_height[cells]
        flat = np.ones_like(height)
        elasticity = plane_stress(young * flat, poisson, shear * flat)
        rest = rest + plate.core_stiffness(cells, height, elasticity, np.full((*flat.shape, 2), shear))
    return whole.tocsr(), *(upper_skin(region) for region in regions), (rest + _rods(layout)).tocsr()


def _rods(layout: PlateLayout) -> sparse.csr_array:
    """Stiffness (5 N, 5 N) of the rods: E A and E I along the span, spread over the width of their webs."""
    plate, design = layout.plate, layout.design
    total = sparse.csr_array((plate.unknowns, plate.unknowns))
    for rod in design.rods:
        cells = np.flatnonzero(layout.web == rod.web)
        inside = plate.points[cells, :, 1] < rod.reach * design.planform.semi_span
        area = 0.25 * np.pi * rod.diameter**2
        half = np.sqrt(3.0) / 4.0 * rod.diameter  # a strip of this half height has the same I / A
        elasticity = np.zeros((*inside.shape, 3, 3))
        stiffness = rod.young_modulus * area / (2.0 * half * design.webs[rod.web].thickness)
        elasticity[..., 1, 1] = stiffness * inside
        total = total + plate.core_stiffness(
            cells, np.full(inside.shape, half), elasticity, np.zeros((*inside.shape, 2))
        )
    return total.tocsr()


def _mass_per_area(layout: PlateLayout) -> tuple[FloatArray, FloatArray]:
    """Mass of the structure per area of the plan, and its rotary part, both (cells, q) [kg/m^2], [kg]."""
    design, plate, skin = layout.design, layout.plate, layout.design.skin
    every, added = np.arange(plate.mesh.nelements), layout.added_density
    face = layout.surface(plate.points, 0.5 * skin.thickness)
    translation = 2.0 * (skin.density + added) * skin.thickness * face.area_ratio
    rotation = translation * face.height**2
    height = layout.surface(plate.points, skin.thickness).height
    density = np.zeros(len(every))
    density[layout.wall] = skin.density
    for index, web in enumerate(design.webs):
        density[layout.web == index] = web.density
    for index, rib in enumerate(design.ribs):
        density[layout.rib == index] = rib.density
    solid = layout.wall | (layout.web >= 0) | (layout.rib >= 0)
    core = np.where(solid[:, None], 2.0 * height * (density[:, None] + added), 0.0)
    translation, rotation = translation + core, rotation + core * height**2 / 3.0
    for rod in design.rods:
        inside = layout.web == rod.web
        reached = plate.points[..., 1] < rod.reach * design.planform.semi_span
        per_area = rod.mass_per_length / design.webs[rod.web].thickness
        translation += per_area * (inside[:, None] & reached)
    return translation, rotation


def _mass_terms(layout: PlateLayout) -> tuple[sparse.csr_array, ...]:
    """Mass of the structure and of 1 kg in each servo and in the pitot, all (5 N, 5 N)."""
    design, plate = layout.design, layout.plate
    terms = [plate.mass(np.arange(plate.mesh.nelements), *_mass_per_area(layout))]
    for kind in ("servo", "pitot"):
        total = sparse.csr_array((plate.unknowns, plate.unknowns))
        for place in design.point_masses:
            if place.kind == kind:
                weights = _deflection(layout, place.station * design.planform.semi_span, place.chord)
                shifts = (np.roll(weights, (field - W) * plate.nodes) for field in (U, V, W))
                rows = [sparse.csr_array(shift[None]) for shift in shifts]
                total = total + sum((row.T @ row for row in rows), start=sparse.csr_array(total.shape))
        terms.append(total.tocsr())
    return tuple(terms)


def _lift(layout: PlateLayout) -> FloatArray:
    """Load (5 N,) [N] at load factor 1: up and forward, less the weight where the design says so.

    The sums are exactly those of the design.
    """
    design, plate = layout.design, layout.plate
    points, plan = plate.points, design.planform
    per_length = DISTRIBUTIONS[design.lift.distribution](plan, points[..., 1] / plan.semi_span)
    chord = plan.root_chord + (plan.tip_chord - plan.root_chord) * points[..., 1] / plan.semi_span
    lift = design.lift
    pressure = per_length * (1.0 - layout.chord_fraction(points)) ** lift.chordwise_exponent / chord
    pressure = pressure / (pressure * plate.weights).sum()
    forward = plate.load(U, lift.forward_force / lift.load_factor * pressure)
    weight = np.zeros(plate.unknowns)
    if lift.inertia_relief:
        weight = STANDARD_GRAVITY * (plate.load(W, _mass_per_area(layout)[0]) + _point_mass_loads(layout))
    return plate.load(W, (lift.force / lift.load_factor + weight.sum()) * pressure) - forward - weight


def _point_mass_loads(layout: PlateLayout) -> FloatArray:
    """Nominal point masses (5 N,) [kg] as a load on the deflection."""
    design = layout.design
    masses = {"servo": design.masses.servo, "pitot": design.masses.pitot}
    return sum(
        (
            masses[place.kind] * _deflection(layout, place.station * design.planform.semi_span, place.chord)
            for place in design.point_masses
        ),
        start=np.zeros(layout.plate.unknowns),
    )


def _deflection(layout: PlateLayout, distance: float, chord_fraction: float) -> FloatArray:
    """Weights (5 N,) of the deflection at a distance from the root [m] and a chord fraction."""
    plan = layout.design.planform
    place = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
    dofs, values, _, _ = layout.plate.at(np.array([[place, distance]]))
    found = np.zeros(layout.plate.unknowns)
    found[dofs[0].reshape(len(FIELDS), -1)[W]] = values[0]
    return found


def _gauge_output(layout: PlateLayout) -> sparse.csr_array:
    """Strain of each gauge, csr (gauges, 5 N): along the span, tangent to its surface, patch mean."""
    design, plate = layout.design, layout.plate
    gauges, plan = design.gauges, design.planform
    owner, share, places = [], [], []
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        middle = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
        for y, span_weight in zip(
            *averaging_points(distance, gauges.averaging_spanwise, layout.across), strict=True
        ):
            across = averaging_points(middle, gauges.averaging_chordwise, layout.lines_at(y))
            for x, chord_weight in zip(*across, strict=True):
                owner.append(gauge)
                share.append(span_weight * chord_weight)
                places.append((x, y))
    flat = np.array(places)
    dofs, *shapes = plate.at(flat)
    surface = layout.surface(flat, 0.5 * design.skin.thickness if gauges.surface == "middle" else 0.0)
    strain = surface_strain(surface, *shapes)
    # The unit tangent nearest to the span is p a_x + q a_y with a_x = (1, 0, z_x), a_y = (0, 1, z_y).
    normal_x, normal_y = (-slope / surface.area_ratio for slope in (surface.slope_x, surface.slope_y))
    length = np.sqrt(1.0 - normal_y**2)
    p, q = -normal_x * normal_y / length, length
    along_span = np.stack((p**2, q**2, p * q), axis=-1)
    weights = -np.array(share)[:, None] * np.einsum("ps,psn->pn", along_span, strain)
    rows = np.repeat(owner, dofs.shape[1])
    shape = (len(gauges.positions), plate.unknowns)
    return sparse.coo_array((weights.ravel(), (rows, dofs.ravel())), shape=shape).tocsr()
