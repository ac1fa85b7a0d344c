"""Nodal loads of forces, pressures and acceleration fields on a mesh: vectors (nodes, 3) [N]."""

import numpy as np
from numpy.typing import NDArray

from .design import Load
from .location import Locator
from .mesh import StructureMesh, Surface

FloatArray = NDArray[np.float64]


def area_vectors(mesh: StructureMesh, surface: Surface) -> FloatArray:
    """Integral (nodes, 3) [m^2] over faces of each node's shape function times the outward normal."""
    total = np.zeros((len(mesh.points), 3))
    for cells, vectors, values in _face_points(mesh, surface):
        np.add.at(total, mesh.cells[cells], np.einsum("nqi,qa->nai", vectors, values))
    return total


def area_shares(mesh: StructureMesh, surface: Surface) -> FloatArray:
    """Integral (nodes,) [m^2] over faces of each node's shape function; together they are the area."""
    total = np.zeros(len(mesh.points))
    for cells, vectors, values in _face_points(mesh, surface):
        np.add.at(total, mesh.cells[cells], np.linalg.norm(vectors, axis=2) @ values)
    return total


def _face_points(
    mesh: StructureMesh, surface: Surface
) -> list[tuple[NDArray[np.int64], FloatArray, FloatArray]]:
    """Cells (n,), weighted outward normals (n, q, 3) [m^2] and shape functions (q, k), face by face."""
    kind, found = mesh.kind, []
    for number in np.unique(surface.face):
        cells = surface.cell[surface.face == number]
        along, weight = kind.face_rule(int(number))
        local, tangents = kind.face_places(int(number), along)
        values, slopes = kind.shape_functions(local)
        edges = np.einsum("nai,qaj,tj->nqti", mesh.nodes[cells], slopes, tangents, optimize=True)
        vectors = np.cross(edges[:, :, 0], edges[:, :, 1]) * weight[:, None]
        # A node off the face has a shape function of zero on it, up to rounding.
        values[:, [n for n in range(kind.node_count) if n not in kind.face_nodes[int(number)]]] = 0.0
        found.append((cells, vectors, values))
    return found


def surface_load(mesh: StructureMesh, locator: Locator, load: Load, where: str) -> FloatArray:
    """Force or pressure (nodes, 3) [N]; `where` is the place in the design, for sentences.

    Raises
    ------
    MeshError
        If its set is missing, empty or holds no face.
    InvalidDesignError
        If its point lies outside.
    """
    if load.pressure is not None:
        assert load.set is not None
        return np.asarray(-load.pressure * area_vectors(mesh, mesh.faces_of(load.set, where)))
    assert load.force is not None
    force = np.asarray(load.force)
    if load.point is not None:
        return np.outer(point_shares(mesh, locator, load.point, where), force)
    assert load.set is not None
    nodes = mesh.nodes_of(load.set, where)
    surface = mesh.faces_between(load.set, nodes)
    shares = np.zeros(len(mesh.points))
    if len(surface):
        shares = area_shares(mesh, surface)
        shares /= shares.sum()
    else:
        shares[nodes] = 1.0 / len(nodes)
    return np.outer(shares, force)


def point_shares(
    mesh: StructureMesh, locator: Locator, point: tuple[float, float, float], where: str
) -> FloatArray:
    """Share (nodes,) of each node in the displacement of a point [unit of length of the mesh].

    Raises
    ------
    InvalidDesignError
        If it lies outside.
    """
    place = f"{where}: the point {mesh.place(mesh.unit * np.asarray(point))}"
    cell, local = locator.attach(mesh.unit * np.asarray(point), place)
    shares = np.zeros(len(mesh.points))
    shares[mesh.cells[cell]] = mesh.kind.shape_functions(local[None])[0][0]
    return shares
