"""Elements on a distorted mesh: patch test, gauges, mass, points that are found in cells."""

import numpy as np
import pytest

from fe.elements.cells import CellMesh
from fe.elements.elasticity import isotropic_compliance
from fe.elements.kinds import KINDS
from fe.structure.design import Gauge
from fe.structure.gauges import gauge_rows
from fe.structure.location import attach, on_surface
from fe.structure.mesh_file import read_mesh
from tests.meshes import box

SIZE = np.array([1.0, 2.0, 0.5])
"""The box of the mesh [m]."""
HIGHEST_PRODUCTS = {
    "tetra": (1, 0, 0),
    "tetra10": (1, 0, 1),
    "wedge": (1, 0, 1),
    "wedge15": (1, 0, 2),
    "hexahedron": (1, 1, 1),
    "hexahedron20": (2, 1, 1),
}
"""Products of coordinates that a kind of element holds exactly, by their powers."""


def distort(points, cells, kind):
    """Return points of a unit box whose inner nodes are moved; edges stay straight."""
    corner_count = len(kind.corners)
    corners = np.unique(cells[:, :corner_count])
    is_inner = ((points[corners] > 0.0) & (points[corners] < 1.0)).all(axis=1)
    distorted = points.copy()
    distorted[corners[is_inner]] += (0.07, -0.05, 0.06)
    for number, (a, b) in enumerate(kind.edges, start=corner_count):
        middle = 0.5 * (distorted[cells[:, a]] + distorted[cells[:, b]])
        distorted[cells[:, number]] = middle
    return distorted


@pytest.fixture(scope="module", params=sorted(KINDS))
def distorted_mesh(request, write_structure):
    """A box of 2 x 2 x 2 cells or prisms and tetrahedra in them, distorted inside."""
    points, cells = box(request.param, (2, 2, 2))
    distorted = distort(points, cells, KINDS[request.param]) * SIZE
    file = write_structure(distorted, request.param, cells, "")
    return read_mesh(file.parent / "mesh.vtu", 1.0, "m")


# ---------------------------------------------------------------- a linear field

GRADIENT = 1e-3 * np.array([[1.0, 2.0, -0.5], [0.3, -1.5, 0.8], [0.6, -0.2, 0.9]])
GAUGES = (
    Gauge(name="a", point=(0.31, 0.77, 0.5), direction=(1.0, 2.0, 0.0)),
    Gauge(name="b", point=(1.0, 1.2, 0.2), direction=(0.0, 1.0, 1.0), length=0.3),
    Gauge(name="on_a_node", point=(0.5, 1.0, 0.0), direction=(1.0, 0.0, 0.0)),
)


@pytest.fixture(scope="module")
def linear_field(distorted_mesh):
    """Displacements (3 N,) of all nodes with a constant gradient."""
    return (distorted_mesh.points @ GRADIENT.T).ravel()


def test_a_linear_field_is_in_equilibrium_inside(distorted_mesh, linear_field):
    """The patch test: inner nodes are solved for, those of the surface are held."""
    elasticity = np.linalg.inv(isotropic_compliance(7e10, 0.3))
    stiffness = distorted_mesh.stiffness(np.arange(len(distorted_mesh.cells)), elasticity)
    points = distorted_mesh.points
    is_inner = ((points > 1e-9) & (points < SIZE - 1e-9)).all(axis=1)
    free = np.repeat(is_inner, 3)
    assert free.any()

    solution = np.where(free, 0.0, linear_field)
    residual = stiffness @ solution
    solution[free] = np.linalg.solve(stiffness[free][:, free].toarray(), -residual[free])

    tolerance = 1e-12 * np.abs(linear_field).max()
    np.testing.assert_allclose(solution, linear_field, atol=tolerance)


def test_gauges_read_the_strain_of_a_linear_field_along_their_direction(
    distorted_mesh, linear_field
):
    rows, _ = gauge_rows(distorted_mesh, GAUGES)

    for gauge, strain in zip(GAUGES, rows @ linear_field, strict=True):
        along = np.array(gauge.direction) / np.linalg.norm(gauge.direction)
        assert strain == pytest.approx(along @ GRADIENT @ along, rel=1e-10), gauge.name


def test_gauges_on_the_surface_are_not_moved(distorted_mesh):
    _, distances = gauge_rows(distorted_mesh, GAUGES)

    np.testing.assert_allclose(distances, 0.0, atol=1e-12)


# ---------------------------------------------------------------- mass


@pytest.mark.parametrize("name", sorted(KINDS))
def test_the_mass_of_every_kind_is_exact_for_its_shape_functions(name):
    points, cells = box(name, (1, 1, 1))
    mass = CellMesh(KINDS[name], points, cells).mass(np.arange(len(cells)), 1.0)
    power = np.array(HIGHEST_PRODUCTS[name])

    field = (points**power).prod(axis=1)

    integral_of_square = (1.0 / (2.0 * power + 1.0)).prod()
    assert field @ (mass @ field) == pytest.approx(integral_of_square)


# ---------------------------------------------------------------- points in cells


def place_in_cell(mesh, cell, local):
    """Return the place of local coordinates in a cell."""
    values, _ = mesh.kind.shape_functions(local[None])
    (row,) = values
    return row @ mesh.nodes[cell]


RANDOM_POINTS = np.random.default_rng(1).random((12, 3)) * SIZE


def test_a_point_inside_is_found_in_its_cell(distorted_mesh):
    for point in RANDOM_POINTS:
        cell, local = attach(distorted_mesh, point, "here")

        assert np.abs(local - 0.5).max() < 0.5 + 1e-9
        found_place = place_in_cell(distorted_mesh, cell, local)
        np.testing.assert_allclose(found_place, point, atol=1e-12)


def test_a_point_outside_is_found_on_the_surface(distorted_mesh):
    for number, point in enumerate(RANDOM_POINTS):
        outside = point.copy()
        outside[[number % 3, number // 3 % 3]] = -0.004  # beside a face or an edge
        nearest = np.clip(outside, 0.0, SIZE)

        location = on_surface(distorted_mesh, outside, "here")

        assert location.distance == pytest.approx(np.linalg.norm(outside - nearest))
        for cell, local in zip(location.cell, location.local, strict=True):
            found_place = place_in_cell(distorted_mesh, cell, local)
            np.testing.assert_allclose(found_place, nearest, atol=1e-2)
