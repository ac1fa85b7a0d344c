"""Elasticity and density of the cells of a wing."""

import numpy as np

from fe.elements.cells import jacobians
from fe.elements.elasticity import (
    isotropic_compliance,
    orthotropic_compliance,
    rotate_elasticity,
    unit_vector,
)
from fe.elements.kinds import gauss_points
from fe.runtime.arrays import BoolArray, FloatArray

from .mesh import WingMesh
from .parts import Rod

_SPANWISE = 1  # of the local axes, and of the strains in them


def cell_elasticity(mesh: WingMesh) -> FloatArray:
    """Return the elasticity (nc, 6, 6) [Pa] of each cell in global axes, at e = 1, undamaged."""
    elasticities = np.empty((len(mesh.cells), 6, 6))
    _set_skin_elasticity(mesh, elasticities)
    for index, web in enumerate(mesh.design.webs):
        is_in_web = mesh.web == index
        compliance = orthotropic_compliance(web.young_modulus, web.poisson_ratio, web.shear_modulus)
        elasticities[is_in_web] = np.linalg.inv(compliance)
    for index, rib in enumerate(mesh.design.ribs):
        is_in_rib = mesh.rib == index
        compliance = isotropic_compliance(rib.young_modulus, rib.poisson_ratio)
        elasticities[is_in_rib] = np.linalg.inv(compliance)
    _add_rod_stiffness(mesh, elasticities)
    return rotate_elasticity(elasticities, cell_axes(mesh))


def _set_skin_elasticity(mesh: WingMesh, elasticities: FloatArray) -> None:
    """Set the elasticity of the skin and of the leading-edge wall in local axes, in place.

    The local axes are chordwise (1), spanwise (2) and across (3). The wall stands upright: its
    thickness lies along the chord, so that its in-plane shear is that of axes 2 and 3.
    """
    skin = mesh.design.skin
    in_plane_ratio = skin.in_plane_shear_ratio
    transverse_ratio = skin.transverse_shear_ratio

    def unit_elasticity(shear_moduli: tuple[float, float, float]) -> FloatArray:
        compliance = orthotropic_compliance(1.0, skin.poisson_ratio, shear_moduli)
        return np.asarray(np.linalg.inv(compliance))

    skin_unit_elasticity = unit_elasticity((in_plane_ratio, transverse_ratio, transverse_ratio))
    wall_unit_elasticity = unit_elasticity((transverse_ratio, transverse_ratio, in_plane_ratio))
    is_skin = mesh.is_skin
    modulus = skin.young_modulus(mesh.centre_stations)[is_skin]
    is_wall = mesh.leading_edge[is_skin]
    unit_elasticities = np.where(
        is_wall[:, np.newaxis, np.newaxis], wall_unit_elasticity, skin_unit_elasticity
    )
    elasticities[is_skin] = unit_elasticities * modulus[:, np.newaxis, np.newaxis]


def _add_rod_stiffness(mesh: WingMesh, elasticities: FloatArray) -> None:
    """Add the flapwise bending stiffness of rods to their webs, in local axes, in place."""
    for rod in mesh.design.rods:
        has_rod = _cells_with_rod(mesh, rod)
        height = _web_height(mesh)[has_rod]
        thickness = mesh.design.webs[rod.web].thickness
        # an additional spanwise modulus E with E I = the rod's bending stiffness, I that of the web
        second_moment = thickness * height**3 / 12.0
        elasticities[has_rod, _SPANWISE, _SPANWISE] += rod.bending_stiffness / second_moment


def _cells_with_rod(mesh: WingMesh, rod: Rod) -> BoolArray:
    """Return whether each cell (nc,) belongs to the part of a web with a rod."""
    on_web = mesh.web == rod.web
    within_reach = mesh.centre_stations < rod.reach
    return np.asarray(on_web & within_reach)


def cell_axes(mesh: WingMesh) -> FloatArray:
    """Return the local material axes (nc, 3, 3) of each cell, as rows.

    They are chordwise, spanwise and normal to the surface of the cell.
    """
    centre = np.array([[0.5, 0.5, 0.5]])
    jacobian = jacobians(mesh.kind, mesh.nodes, centre).squeeze(axis=1)
    along_chord, along_span, _ = np.moveaxis(jacobian, 2, 0)
    across = unit_vector(np.cross(along_chord, along_span))
    spanwise = unit_vector(along_span)
    chordwise = np.cross(spanwise, across)
    return np.stack([chordwise, spanwise, across], axis=1)


def modulus_variation(mesh: WingMesh) -> FloatArray:
    """Return Young's modulus at Gauss points of cells relative to their centres: (nc, 27).

    The points are those of `gauss_points(3)`. The ratio differs from one if the skin's modulus is
    given at stations, between which it is linear, so that it changes within a cell.
    """
    rule = gauss_points(3)
    factor = np.ones((len(mesh.cells), len(rule.weights)))
    skin = mesh.design.skin
    if not skin.stations:
        return factor
    skin_cells = np.flatnonzero(mesh.is_skin)
    _, y, _ = np.moveaxis(mesh.positions(skin_cells, rule.points), 2, 0)
    stations = y / mesh.design.planform.semi_span
    central_modulus = skin.young_modulus(mesh.centre_stations[skin_cells])
    modulus = skin.young_modulus(stations)
    factor[skin_cells] = modulus / central_modulus[:, np.newaxis]
    return factor


def _web_height(mesh: WingMesh) -> FloatArray:
    """Return the height (nc,) [m] between the skins at each cell between them."""
    _, _, z = np.moveaxis(mesh.corners, 2, 0)
    cell_height = np.ptp(z, axis=1)
    return np.asarray(cell_height * mesh.height_cells)


def cell_density(mesh: WingMesh) -> FloatArray:
    """Return the density (nc,) [kg/m^3] of each cell."""
    design = mesh.design
    density = np.full(len(mesh.cells), design.skin.density)
    station = mesh.centre_stations
    for index, web in enumerate(design.webs):
        density[mesh.web == index] = web.density
    for index, rib in enumerate(design.ribs):
        density[mesh.rib == index] = rib.density
    for added in design.added_density:
        is_inside = (station > added.start) & (station < added.end)
        density[is_inside] += added.density
    for rod in design.rods:
        has_rod = _cells_with_rod(mesh, rod)
        height = _web_height(mesh)[has_rod]
        web_area = design.webs[rod.web].thickness * height
        density[has_rod] += rod.mass_per_length / web_area
    return density
