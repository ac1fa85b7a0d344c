"""Shape functions, faces and element arrays against scikit-fem, closed forms and the patch test."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from skfem import Basis, BilinearForm, ElementVector, MeshHex, MeshTet
from skfem.element import ElementHex1, ElementHexS2, ElementTetP1, ElementTetP2
from skfem.helpers import ddot, sym_grad
from skfem.models.elasticity import lame_parameters, linear_stress

from fe.elements import cells as assembly
from fe.elements.kinds import KINDS
from fe.structure.design import Gauge
from fe.structure.location import attach, face_areas, gauge_rows, on_surface
from fe.structure.mesh import StructureMesh
from fe.structure.mesh_file import read_mesh

PRODUCTS = {  # of coordinates that a kind of element holds, by their powers
    "tetra": (1, 0, 0), "tetra10": (1, 0, 1), "wedge": (1, 0, 1), "wedge15": (1, 0, 2),
    "hexahedron": (1, 1, 1), "hexahedron20": (2, 1, 1),
}  # fmt: skip
SKFEM: dict[str, Any] = {
    "tetra": ElementTetP1(),
    "tetra10": ElementTetP2(),
    "hexahedron": ElementHex1(),
    "hexahedron20": ElementHexS2(),
}


@pytest.fixture(params=sorted(KINDS))
def distorted(
    request: pytest.FixtureRequest, box: Callable[..., Any], write: Callable[..., Path]
) -> StructureMesh:
    """A box whose inner nodes are moved; edges stay straight."""
    points, cells = box(request.param, (2, 2, 2))
    kind = KINDS[request.param]
    corners = np.unique(cells[:, : len(kind.corners)])
    moved = points.copy()
    inner = corners[((points[corners] > 0.0) & (points[corners] < 1.0)).all(axis=1)]
    moved[inner] += (0.07, -0.05, 0.06)
    for number, (a, b) in enumerate(kind.edges):
        moved[cells[:, len(kind.corners) + number]] = 0.5 * (moved[cells[:, a]] + moved[cells[:, b]])
    moved = moved * (1.0, 2.0, 0.5)
    return read_mesh(write(moved, request.param, cells, "").parent / "mesh.vtu", 1.0, "m")


@pytest.mark.parametrize("name", SKFEM)
def test_element_arrays_are_those_of_scikit_fems_forms(name: str, box) -> None:
    (points, cells), kind = box(name, (1, 1, 1)), KINDS[name]
    points = points + 0.1 * points[:, [1, 2, 0]]  # sheared: straight, and no two edges alike
    corners = len(kind.corners)
    mesh = MeshTet if corners == 4 else MeshHex
    order = [int(np.flatnonzero((np.array(kind.corners) == p).all(axis=1))[0]) for p in mesh.elem.refdom.p.T]
    used, vertices = np.unique(cells[:, order], return_inverse=True)
    vertices = np.ascontiguousarray(vertices.reshape(len(cells), corners).T)
    body = mesh(np.ascontiguousarray(points[used].T), vertices, sort_t=False)
    basis = Basis(body, ElementVector(SKFEM[name]), intorder=6)
    stress = linear_stress(*lame_parameters(2.0, 0.3))
    stiffness = BilinearForm(lambda u, v, w: ddot(stress(sym_grad(u)), sym_grad(v))).assemble(basis)
    mass = BilinearForm(lambda u, v, w: sum(u[i] * v[i] for i in range(3))).assemble(basis)
    nodes = points[cells]
    K = assembly.stiffness_blocks(kind, nodes, np.linalg.inv(assembly.isotropic_compliance(2.0, 0.3)))
    M = assembly.mass_blocks(kind, nodes, 1.0, kind.mass_rule)
    # Unknowns of both are told by the places of their nodes: compare the energies of one smooth field.
    field = np.sin(points @ np.array([[1.0, 2.0, 0.5], [0.3, -1.0, 2.0], [0.7, 0.2, 1.0]]))
    ours, theirs = field[cells].reshape(len(cells), -1), np.zeros(basis.N)
    for row, unknowns in enumerate(basis.element_dofs):
        apart = np.linalg.norm(points[:, :, None] - basis.doflocs[:, unknowns], axis=1)
        theirs[unknowns] = field[apart.argmin(axis=0), row % 3]
    assert np.einsum("ni,nij,nj->", ours, K, ours) == pytest.approx(theirs @ stiffness @ theirs, rel=1e-12)
    scalar = np.einsum("nai,nab,nbi->", field[cells], M, field[cells])
    assert scalar == pytest.approx(theirs @ mass @ theirs, rel=1e-12)


def test_patch_test_and_gauges(distorted: StructureMesh) -> None:
    gradient = 1e-3 * np.array([[1.0, 2.0, -0.5], [0.3, -1.5, 0.8], [0.6, -0.2, 0.9]])
    exact = distorted.points @ gradient.T
    elasticity = np.linalg.inv(assembly.isotropic_compliance(7e10, 0.3))
    K = distorted.stiffness(np.arange(len(distorted.cells)), elasticity)
    inner = ((distorted.points > 1e-9) & (distorted.points < np.array([1, 2, 0.5]) - 1e-9)).all(axis=1)
    assert inner.any()
    free = np.repeat(inner, 3)
    found = np.where(free, 0.0, exact.ravel())
    found[free] = np.linalg.solve(K[free][:, free].toarray(), -(K @ found)[free])
    np.testing.assert_allclose(found, exact.ravel(), atol=1e-12 * np.abs(exact).max())
    # The strain of that field along any direction of the surface, with and without a length.
    gauges = (
        Gauge(name="a", point=(0.31, 0.77, 0.5), direction=(1.0, 2.0, 0.0)),
        Gauge(name="b", point=(1.0, 1.2, 0.2), direction=(0.0, 1.0, 1.0), length=0.3),
        Gauge(name="c", point=(0.5, 1.0, 0.0), direction=(1.0, 0.0, 0.0)),  # on a node
    )
    rows, moved = gauge_rows(distorted, gauges)
    np.testing.assert_allclose(moved, 0.0, atol=1e-12)
    for gauge, strain in zip(gauges, rows @ exact.ravel(), strict=True):
        along = np.array(gauge.direction) / np.linalg.norm(gauge.direction)
        assert strain == pytest.approx(along @ gradient @ along, rel=1e-10)


def test_faces_enclose_the_volume(distorted: StructureMesh) -> None:
    normal = face_areas(distorted, distorted.boundary)[0]
    np.testing.assert_allclose(normal.sum(axis=0), 0.0, atol=1e-13)
    # Gauss: the integral of x . n over the surface is three volumes.
    assert np.sum(normal * distorted.points) == pytest.approx(3.0)
    assert face_areas(distorted, distorted.boundary)[1].sum() == pytest.approx(2 * (2.0 + 0.5 + 1.0))
    local, weight = distorted.kind.mass_rule
    volume = (np.linalg.det(assembly.jacobians(distorted.kind, distorted.nodes, local)) * weight).sum()
    assert volume == pytest.approx(1.0)


def test_the_mass_of_every_kind_is_exact_for_its_shape_functions(distorted: StructureMesh, box) -> None:
    points, cells = box(distorted.kind.file_type, (1, 1, 1))
    mass = assembly.CellMesh(distorted.kind, points, cells).mass(np.arange(len(cells)), 1.0)
    power = np.array(PRODUCTS[distorted.kind.file_type])
    field = (points**power).prod(axis=1)
    assert field @ (mass @ field) == pytest.approx((1.0 / (2.0 * power + 1.0)).prod())


def test_a_point_inside_is_found_and_one_outside_on_the_surface(distorted: StructureMesh) -> None:
    size, random = np.array([1.0, 2.0, 0.5]), np.random.default_rng(1)
    for number, point in enumerate(random.random((12, 3)) * size):
        cell, local = attach(distorted, point, "here")
        assert np.abs(local - 0.5).max() < 0.5 + 1e-9
        places = [(cell, local, point, 1e-12)]
        aside = point.copy()
        aside[[number % 3, number // 3 % 3]] = -0.004  # beside a face or an edge
        found = on_surface(distorted, aside, "here")
        nearest = np.clip(aside, 0.0, size)
        # beside the slanting edge of a triangle it is only near the nearest
        assert found.distance < 2.0 * np.linalg.norm(aside - nearest)
        places += [(*on_face, nearest, 1e-2) for on_face in zip(found.cell, found.local, strict=True)]
        for cell, local, wanted, tolerance in places:
            values, _ = distorted.kind.shape_functions(local[None])
            np.testing.assert_allclose(values[0] @ distorted.nodes[cell], wanted, atol=tolerance)
