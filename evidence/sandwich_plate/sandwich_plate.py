"""The wing as a sandwich plate: a second model of the same design, an order of magnitude cheaper.

Skins are the faces, at the height of the section. Webs, ribs and the leading-edge wall are solid
cores. Between them there is no core: the deflection runs straight from web to web along the chord,
and the skins bend on their own only as the beams of a frame (`plate_frame`). Every number is from
the design. The operators are affine like those of the box, K(e, z) = e K_skin + (1 - z1) K_1 + ...
+ K_0, and have the same three unknowns of the root at the end.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from fe.runtime.state import STANDARD_GRAVITY
from fe.structure.affine import StiffnessTerm
from fe.structure.affine_fields import affine_fields
from fe.wing.design import WingDesign, wing_structure
from fe.wing.gauges import averaging_points
from fe.wing.operators import ROOT_UNKNOWNS, AffineWing, outputs, stiffness_parts
from fe.wing.parts import DISTRIBUTIONS, PointMassPlace

from .plate import (
    CELL_UNKNOWNS,
    FIELDS,
    A,
    B,
    Plate,
    Surface,
    U,
    V,
    W,
    plane_stress,
    surface_strain,
)
from .plate_frame import frame_stiffness
from .plate_layout import PlateLayout

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

ALONG_SPAN = np.diag([0.0, 1.0, 0.0])
"""Elasticity, over the modulus, of a core that is stiff along the span alone."""


@dataclass(frozen=True)
class PlateOperators(AffineWing):
    """Affine plate model of the wing on its n free unknowns.

    `expansion` gives the five fields of all nodes.

    Attributes
    ----------
    kept : (n - 3,) array
        Index of each free unknown except those of the root, among the five fields of all nodes.
    plate : Plate
        Nodes and cells.
    wing_design : WingDesign
        The design of the wing.
    """

    kept: IntArray
    plate: Plate
    wing_design: WingDesign

    def fields(self, free: FloatArray) -> FloatArray:
        """Return the fields u, v, a, b, w (5, N) of all nodes from free unknowns (n,)."""
        return np.asarray(self.expansion @ free).reshape(len(FIELDS), -1)

    def free_unknowns(self, fields: FloatArray) -> FloatArray:
        """Return the free unknowns (n,) of fields (5, N) that are zero at the root."""
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
    plan = design.planform
    expansion, free_in_fields = _expansion(layout)

    load_distance = plan.semi_span - design.tip_load.distance_from_tip
    load_tip = _deflection(layout, load_distance, design.tip_load.chord)
    tip = _deflection(layout, plan.semi_span, design.tip_load.chord)
    structure_mass, *point_masses = _mass_terms(layout)
    structure_design = wing_structure(design.regions, len(design.gauges.positions))
    fields = affine_fields(
        structure_design,
        expansion,
        structure_mass,
        point_masses,
        loads=(_lift(layout), load_tip),
        outputs=outputs(_gauge_output(layout), tip),
    )
    return PlateOperators(
        design=structure_design,
        **fields,
        stiffness_terms=_free_stiffness_terms(layout, expansion),
        design_hash=design.hash,
        kept=free_in_fields,
        plate=layout.plate,
        wing_design=design,
    )


def _free_stiffness_terms(
    layout: PlateLayout, expansion: sparse.csr_array
) -> tuple[StiffnessTerm, ...]:
    """Return the stiffness terms on the free unknowns, given their expansion csr (5 N, n).

    The last term includes the springs of the root.
    """
    design = layout.design
    root = design.root
    restriction = expansion.T.tocsr()
    springs = np.zeros(expansion.shape[1])
    springs[-ROOT_UNKNOWNS:] = (root.transverse_spring, root.flap_spring, root.yaw_spring)
    *skin_terms, base_term = (
        (restriction @ (term @ expansion)).tocsr() for term in _stiffness_terms(layout)
    )
    base_with_springs = (base_term + sparse.diags_array(springs)).tocsr()
    matrices = [*skin_terms, base_with_springs]
    return tuple(
        StiffnessTerm(matrix, parameter, region)
        for matrix, (parameter, region) in zip(
            matrices, stiffness_parts(design.regions), strict=True
        )
    )


class _Entries(NamedTuple):
    """Entries of a sparse matrix; arrays of one length."""

    rows: IntArray
    columns: IntArray
    values: FloatArray


def _expansion(layout: PlateLayout) -> tuple[sparse.csr_array, IntArray]:
    """Return the expansion of the free unknowns to all unknowns.

    The root is a rigid rib. The deflection is straight between the webs.

    Returns
    -------
    expansion : csr (5 N, n)
        Free unknowns to all unknowns; the last three are those of the root.
    free_in_fields : (n - 3,) array
        Index of each free unknown except those of the root, among all unknowns.
    """
    plate = layout.plate
    web_lines = _lines_of_webs(layout)
    is_free = np.zeros((len(FIELDS), plate.nodes), dtype=bool)
    is_free[[U, V, A, B]] = True
    is_free[W, layout.half_grid[web_lines].ravel()] = True
    is_free[:, _root_nodes(layout)] = False
    free_in_fields = np.flatnonzero(is_free.ravel())
    free_count = len(free_in_fields)
    free_number = np.full(is_free.size, -1)
    free_number[free_in_fields] = np.arange(free_count)

    identity = _Entries(free_in_fields, free_number[free_in_fields], np.ones(free_count))
    entries = [
        identity,
        *_root_entries(layout, free_count),
        *_interpolation_entries(layout, web_lines, free_number),
    ]
    rows = np.concatenate([group.rows for group in entries])
    columns = np.concatenate([group.columns for group in entries])
    values = np.concatenate([group.values for group in entries])
    shape = (plate.unknowns, free_count + ROOT_UNKNOWNS)
    expansion = sparse.coo_array((values, (rows, columns)), shape=shape).tocsr()
    return expansion, free_in_fields


def _lines_of_webs(layout: PlateLayout) -> IntArray:
    """Return the lines of nodes in the half grid that lie on a web: its edges and its middle."""
    stiff = np.flatnonzero(layout.stiff_columns)
    return np.unique(np.concatenate((2 * stiff, 2 * stiff + 1, 2 * stiff + 2)))


def _root_nodes(layout: PlateLayout) -> IntArray:
    """Return the nodes at the root."""
    first_row, *_ = layout.half_grid.T
    return np.asarray(first_row)


def _root_entries(layout: PlateLayout, free_count: int) -> Iterator[_Entries]:
    """Yield the motions of the root as a rigid rib: heave, flap and yaw.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    free_count : int
        Number of free unknowns before those of the root.
    """
    plate = layout.plate
    nodes = _root_nodes(layout)
    x, _ = plate.node_points[nodes].T
    one = np.ones(len(nodes))
    heave, flap, yaw = free_count + np.arange(ROOT_UNKNOWNS)
    yield _Entries(W * plate.nodes + nodes, np.full(len(nodes), heave), one)
    yield _Entries(B * plate.nodes + nodes, np.full(len(nodes), flap), -one)
    yield _Entries(V * plate.nodes + nodes, np.full(len(nodes), yaw), x)


def _interpolation_entries(
    layout: PlateLayout, web_lines: IntArray, free_number: IntArray
) -> Iterator[_Entries]:
    """Yield the deflections between the webs, which are interpolated along the chord.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    web_lines : (k,) array
        Lines of nodes in the half grid that lie on a web.
    free_number : (5 N,) array
        Number of each unknown among the free ones; -1 if it is not free.
    """
    plate = layout.plate
    grid = layout.half_grid
    lines_between = np.setdiff1d(np.arange(len(grid)), web_lines)
    next_web_line = np.searchsorted(web_lines, lines_between)
    # Nodes at the root follow from its motions.
    nodes = grid[lines_between, 1:]
    nodes_before = grid[web_lines[next_web_line - 1], 1:]
    nodes_after = grid[web_lines[next_web_line], 1:]
    x, _ = np.moveaxis(plate.node_points, -1, 0)
    weight_after = (x[nodes] - x[nodes_before]) / (x[nodes_after] - x[nodes_before])
    weight_before = 1.0 - weight_after
    deflections = W * plate.nodes + nodes.ravel()
    for end, weight in ((nodes_before, weight_before), (nodes_after, weight_after)):
        columns = free_number[W * plate.nodes + end.ravel()]
        yield _Entries(deflections, columns, weight.ravel())


def _stiffness_terms(layout: PlateLayout) -> tuple[sparse.csr_array, ...]:
    """Return the stiffness terms on all unknowns, each (5 N, 5 N).

    The terms are the skin without the damage regions, each region, and all else.
    """
    design = layout.design
    plate = layout.plate
    skin = design.skin
    modulus = layout.skin_modulus
    sheet = plane_stress(modulus, skin.poisson_ratio, skin.in_plane_shear_ratio * modulus)
    upper = layout.surface(plate.points, 0.5 * skin.thickness)
    lower = Surface(-upper.height, -upper.slope_x, -upper.slope_y)
    regions = [layout.defect(number) for number in range(len(design.defects))]

    def upper_skin(inside: BoolArray) -> sparse.csr_array:
        elasticity = sheet * inside[..., np.newaxis, np.newaxis]
        return plate.face_stiffness(plate.every_cell, upper, skin.thickness, elasticity)

    undamaged_upper_skin = upper_skin(~np.any(regions, axis=0))
    lower_skin = plate.face_stiffness(plate.every_cell, lower, skin.thickness, sheet)
    half_height = layout.surface(plate.points, skin.thickness).height
    skin_term = undamaged_upper_skin + lower_skin
    skin_term = skin_term + frame_stiffness(layout)
    skin_term = skin_term + _wall(layout, half_height)
    base_term = _webs_and_ribs(layout, half_height) + _rods(layout)
    region_terms = [upper_skin(region) for region in regions]
    return (skin_term.tocsr(), *region_terms, base_term.tocsr())


def _wall(layout: PlateLayout, half_height: FloatArray) -> sparse.csr_array:
    """Return the stiffness (5 N, 5 N) of the leading-edge wall, which is made of skin.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    half_height : (cells, q) array
        Height of the inner side of the upper skin [m].
    """
    skin = layout.design.skin
    cells = np.flatnonzero(layout.wall)
    modulus = layout.skin_modulus[cells]
    # The wall stands upright: the shear in its plane is y-z.
    shear_ratios = np.array([skin.transverse_shear_ratio, skin.in_plane_shear_ratio])
    return layout.plate.core_stiffness(
        cells,
        half_height[cells],
        plane_stress(modulus, skin.poisson_ratio, skin.transverse_shear_ratio * modulus),
        modulus[..., np.newaxis] * shear_ratios,
    )


class _Core(NamedTuple):
    """A solid core of a web or rib.

    Attributes
    ----------
    cells : (c,) array
        Cells that the core fills.
    young_modulus, poisson_ratio, shear_modulus : float
        Young's modulus [Pa], Poisson's ratio [1] and shear modulus [Pa].
    """

    cells: IntArray
    young_modulus: float
    poisson_ratio: float
    shear_modulus: float


def _cores(layout: PlateLayout) -> Iterator[_Core]:
    """Yield the cores of all webs, then those of all ribs."""
    design = layout.design
    for index, web in enumerate(design.webs):
        cells = np.flatnonzero(layout.web == index)
        yield _Core(cells, web.young_modulus, web.poisson_ratio, web.shear_modulus)
    for index, rib in enumerate(design.ribs):
        cells = np.flatnonzero(layout.rib == index)
        isotropic_shear = rib.young_modulus / (2.0 * (1.0 + rib.poisson_ratio))
        yield _Core(cells, rib.young_modulus, rib.poisson_ratio, isotropic_shear)


def _webs_and_ribs(layout: PlateLayout, half_height: FloatArray) -> sparse.csr_array:
    """Return the stiffness (5 N, 5 N) of all webs and ribs.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    half_height : (cells, q) array
        Height of the inner side of the upper skin [m].
    """
    plate = layout.plate
    stiffness = plate.no_stiffness()
    for core in _cores(layout):
        height = half_height[core.cells]
        one = np.ones_like(height)
        elasticity = plane_stress(
            core.young_modulus * one, core.poisson_ratio, core.shear_modulus * one
        )
        shear = np.full((*height.shape, 2), core.shear_modulus)
        stiffness = stiffness + plate.core_stiffness(core.cells, height, elasticity, shear)
    return stiffness


def _rods(layout: PlateLayout) -> sparse.csr_array:
    """Return the stiffness (5 N, 5 N) of the rods.

    E A and E I along the span are distributed over the width of the webs of the rods.
    """
    plate = layout.plate
    design = layout.design
    stiffness = plate.no_stiffness()
    for rod in design.rods:
        cells = np.flatnonzero(layout.web == rod.web)
        inside = plate.span_distance[cells] < rod.reach * design.planform.semi_span
        area = 0.25 * np.pi * rod.diameter**2
        # A strip of this half height has the same I / A.
        half_height = np.sqrt(3.0) / 4.0 * rod.diameter
        web_thickness = design.webs[rod.web].thickness
        modulus = rod.young_modulus * area / (2.0 * half_height * web_thickness)
        elasticity = (modulus * inside)[..., np.newaxis, np.newaxis] * ALONG_SPAN
        no_shear = np.zeros((*inside.shape, 2))
        stiffness = stiffness + plate.core_stiffness(
            cells, np.full(inside.shape, half_height), elasticity, no_shear
        )
    return stiffness.tocsr()


class _MassPerArea(NamedTuple):
    """Mass of the structure per area of the plan; arrays (cells, q).

    Attributes
    ----------
    translation : (cells, q) array
        Mass per area [kg/m^2].
    rotation : (cells, q) array
        Rotary inertia per area [kg].
    """

    translation: FloatArray
    rotation: FloatArray


def _mass_per_area(layout: PlateLayout) -> _MassPerArea:
    """Return the mass of the structure per area of the plan."""
    design = layout.design
    plate = layout.plate
    skin = design.skin
    added = layout.added_density

    # Both faces
    face = layout.surface(plate.points, 0.5 * skin.thickness)
    face_mass = 2.0 * (skin.density + added) * skin.thickness * face.area_ratio
    face_inertia = face_mass * face.height**2

    # Solid cores
    half_height = layout.surface(plate.points, skin.thickness).height
    density = np.zeros(len(plate.every_cell))
    density[layout.wall] = skin.density
    for index, web in enumerate(design.webs):
        density[layout.web == index] = web.density
    for index, rib in enumerate(design.ribs):
        density[layout.rib == index] = rib.density
    is_solid = layout.wall | (layout.web >= 0) | (layout.rib >= 0)
    solid_mass = 2.0 * half_height * (density[:, np.newaxis] + added)
    core_mass = np.where(is_solid[:, np.newaxis], solid_mass, 0.0)
    core_inertia = core_mass * half_height**2 / 3.0

    translation = face_mass + core_mass
    for rod in design.rods:
        on_web = layout.web == rod.web
        within_reach = plate.span_distance < rod.reach * design.planform.semi_span
        per_area = rod.mass_per_length / design.webs[rod.web].thickness
        translation += per_area * (on_web[:, np.newaxis] & within_reach)
    return _MassPerArea(translation, face_inertia + core_inertia)


def _mass_terms(layout: PlateLayout) -> Iterator[sparse.csr_array]:
    """Yield the masses (5 N, 5 N) of the structure, of 1 kg in each servo and in the pitot."""
    design = layout.design
    plate = layout.plate
    per_area = _mass_per_area(layout)
    yield plate.mass(plate.every_cell, per_area.translation, per_area.rotation)
    for kind in ("servo", "pitot"):
        mass = plate.no_stiffness()
        for point_mass in design.point_masses:
            if point_mass.kind == kind:
                mass = mass + _unit_point_mass(layout, point_mass)
        yield mass.tocsr()


def _unit_point_mass(layout: PlateLayout, point_mass: PointMassPlace) -> sparse.csr_array:
    """Return the mass (5 N, 5 N) of 1 kg at the position of a point mass."""
    plate = layout.plate
    deflection = _point_mass_deflection(layout, point_mass)
    mass = plate.no_stiffness()
    for field in (U, V, W):
        # The weights of the deflection, moved to the unknowns of the field
        weights = np.roll(deflection, (field - W) * plate.nodes)
        row = sparse.csr_array(weights[np.newaxis])
        mass = mass + row.T @ row
    return mass


def _point_mass_deflection(layout: PlateLayout, point_mass: PointMassPlace) -> FloatArray:
    """Return the weights (5 N,) of the deflection at a point mass."""
    distance = point_mass.station * layout.design.planform.semi_span
    return _deflection(layout, distance, point_mass.chord)


def _lift(layout: PlateLayout) -> FloatArray:
    """Return the load (5 N,) [N] at load factor 1: up and forward, with or without the weight.

    The design says whether its weight relieves the lift. The sums are exactly those of the design.
    """
    design = layout.design
    plate = layout.plate
    plan = design.planform
    lift = design.lift
    distribution = DISTRIBUTIONS[lift.distribution]
    per_length = distribution(plan, layout.station)
    chord = (
        plan.root_chord + (plan.tip_chord - plan.root_chord) * plate.span_distance / plan.semi_span
    )
    chordwise = (1.0 - layout.chord_fraction(plate.points)) ** lift.chordwise_exponent
    pressure = per_length * chordwise / chord
    pressure = pressure / (pressure * plate.weights).sum()
    forward = plate.load(U, lift.forward_force / lift.load_factor * pressure)
    weight = np.zeros(plate.unknowns)
    if lift.inertia_relief:
        structure_mass = plate.load(W, _mass_per_area(layout).translation)
        weight = STANDARD_GRAVITY * (structure_mass + _point_mass_loads(layout))
    upward_force = lift.force / lift.load_factor + weight.sum()
    return plate.load(W, upward_force * pressure) - forward - weight


def _point_mass_loads(layout: PlateLayout) -> FloatArray:
    """Return the nominal point masses (5 N,) [kg] as a load on the deflection."""
    design = layout.design
    masses = {"servo": design.masses.servo, "pitot": design.masses.pitot}
    load = np.zeros(layout.plate.unknowns)
    for point_mass in design.point_masses:
        load = load + masses[point_mass.kind] * _point_mass_deflection(layout, point_mass)
    return load


def _deflection(layout: PlateLayout, distance: float, chord_fraction: float) -> FloatArray:
    """Return the weights (5 N,) of the deflection at a point.

    Parameters
    ----------
    layout : PlateLayout
        The plate.
    distance : float
        Distance from the root [m].
    chord_fraction : float
        Fraction of the chord.
    """
    plan = layout.design.planform
    x = (chord_fraction - plan.straight_chord_line) * plan.chord(distance / plan.semi_span)
    point = layout.plate.at(np.array([[x, distance]]))
    unknowns_of_field = point.unknowns.reshape(len(FIELDS), -1)
    weights = np.zeros(layout.plate.unknowns)
    weights[unknowns_of_field[W]] = point.shapes.values.ravel()
    return weights


class _GaugePoint(NamedTuple):
    """A point of the patch over which a gauge takes the mean strain.

    Attributes
    ----------
    gauge : int
        Number of the gauge.
    weight : float
        Weight of the point in the mean.
    x, y : float
        Position in the plan [m].
    """

    gauge: int
    weight: float
    x: float
    y: float


def _gauge_points(layout: PlateLayout) -> Iterator[_GaugePoint]:
    """Yield the points of the patches of all gauges, gauge by gauge."""
    gauges = layout.design.gauges
    plan = layout.design.planform
    for gauge, (distance, chord_fraction) in enumerate(gauges.positions):
        chord = plan.chord(distance / plan.semi_span)
        middle = (chord_fraction - plan.straight_chord_line) * chord
        span_points = averaging_points(distance, gauges.averaging_spanwise, layout.across)
        for y, span_weight in zip(span_points.positions, span_points.weights, strict=True):
            lines = layout.lines_at(y)
            chord_points = averaging_points(middle, gauges.averaging_chordwise, lines)
            for x, chord_weight in zip(chord_points.positions, chord_points.weights, strict=True):
                yield _GaugePoint(gauge, span_weight * chord_weight, x, y)


def _gauge_output(layout: PlateLayout) -> sparse.csr_array:
    """Return the strain of each gauge, csr (gauges, 5 N), positive in compression.

    It is the strain along the span, tangent to the surface, as a mean over the patch of the gauge.
    """
    design = layout.design
    plate = layout.plate
    gauge_points = list(_gauge_points(layout))
    gauge_of_point = np.array([point.gauge for point in gauge_points])
    mean_weights = np.array([point.weight for point in gauge_points])
    positions = np.array([(point.x, point.y) for point in gauge_points])

    # Strains in the plan
    depth = 0.5 * design.skin.thickness if design.gauges.surface == "middle" else 0.0
    surface = layout.surface(positions, depth)
    point_shapes = plate.at(positions)
    strain = surface_strain(surface, point_shapes.shapes)

    # The unit tangent nearest to the span is p a_x + q a_y with a_x = (1, 0, z_x), a_y = (0, 1,
    # z_y).
    normal_x = -surface.slope_x / surface.area_ratio
    normal_y = -surface.slope_y / surface.area_ratio
    q = np.sqrt(1.0 - normal_y**2)
    p = -normal_x * normal_y / q
    along_span = np.stack((p**2, q**2, p * q), axis=-1)
    strain_along_span = np.einsum("ps,psn->pn", along_span, strain)

    values = -mean_weights[:, np.newaxis] * strain_along_span
    rows = np.repeat(gauge_of_point, CELL_UNKNOWNS)
    columns = point_shapes.unknowns.ravel()
    shape = (len(design.gauges.positions), plate.unknowns)
    return sparse.coo_array((values.ravel(), (rows, columns)), shape=shape).tocsr()
