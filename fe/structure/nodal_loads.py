"""Nodal values of loads, and the nodal weights of points, sets and ports."""

from typing import NamedTuple

import numpy as np

from fe.elements.cells import CellMesh
from fe.elements.elasticity import unit_vector
from fe.runtime.arrays import FloatArray

from .design import MeshLoad, MeshPort
from .location import attach
from .mesh import StructureMesh, Surface


class FaceAreas(NamedTuple):
    """Integrals of the shape functions over faces.

    Attributes
    ----------
    vectors : (nodes, 3) array
        Integrals of each node's shape function times the outward unit normal [m^2].
    areas : (nodes,) array
        Integrals of each node's shape function [m^2]; their sum is the area of the faces.
    """

    vectors: FloatArray
    areas: FloatArray


def face_areas(mesh: CellMesh, surface: Surface) -> FaceAreas:
    """Integrate each node's shape function over faces, with and without the outward normal.

    In the comments, F is the number of faces with the same local number, Q of integration points
    on a face, A of nodes of a cell.
    """
    kind = mesh.kind
    frames = kind.face_frames
    vectors = np.zeros((len(mesh.points), 3))
    areas = np.zeros(len(mesh.points))
    for local_face in np.unique(surface.face).tolist():
        cells = surface.cell[surface.face == local_face]  # (F,)
        # shape functions (Q, A) and gradients (Q, A, 3) at the integration points of the face
        rule = kind.face_rule(local_face)
        tangents = frames.tangents[local_face]  # (2, 3), in local coordinates of the cell
        local_positions = frames.corner[local_face] + rule.points @ tangents
        values, gradients = kind.shape_functions(local_positions)
        # the shape function of a node off the face is zero on it; rounding is removed
        off_face = np.setdiff1d(range(kind.node_count), kind.face_nodes[local_face])
        values[:, off_face] = 0.0
        # tangents in space (F, Q, 2, 3): sum over nodes a and local axes j of the node's position,
        # the gradient of its shape function, and the local tangent
        tangents_in_space = np.einsum(
            "nai,qaj,tj->nqti",
            mesh.nodes[cells],
            gradients,
            tangents,
            optimize=True,
        )
        # area vectors (F, Q, 3) of the integration points: outward normals whose length is the area
        along_first, along_second = np.moveaxis(tangents_in_space, 2, 0)
        normals = np.cross(along_first, along_second) * rule.weights[:, None]
        # integrals (F, A, 3) and (F, A)
        area_vectors = np.einsum("nqi,qa->nai", normals, values)
        node_areas = np.linalg.norm(normals, axis=2) @ values
        np.add.at(vectors, mesh.cells[cells], area_vectors)
        np.add.at(areas, mesh.cells[cells], node_areas)
    return FaceAreas(vectors, areas)


def nodal_load(mesh: StructureMesh, load: MeshLoad, where: str) -> FloatArray:
    """Return the nodal values (nodes, 3) of a load: forces [N], or an acceleration [m/s^2].

    `where` is the name of the load, for error messages.

    Raises
    ------
    MeshError
        If the set of the load is missing, empty or holds no face.
    InvalidDesignError
        If the point of the load lies outside the structure.
    """
    if load.acceleration is not None:
        return np.tile(load.acceleration, (len(mesh.points), 1))
    if load.pressure is not None:
        surface = mesh.faces_of(str(load.set), where)
        area_vectors = face_areas(mesh, surface).vectors
        return -load.pressure * area_vectors  # area vectors point outwards
    weights = force_weights(mesh, load, where)
    return np.outer(weights, np.asarray(load.force))


def port_row(mesh: StructureMesh, port: MeshPort, where: str) -> FloatArray:
    """Return the row (nodes, 3) that reads the displacement of a port.

    Transposed, the row is a force of 1 N at the port. `where` is the name of the port, for error
    messages.

    Raises
    ------
    MeshError
        If the set of the port is missing or empty.
    InvalidDesignError
        If the point of the port lies outside the structure.
    """
    return np.outer(force_weights(mesh, port, where), unit_vector(port.direction))


def force_weights(mesh: StructureMesh, part: MeshLoad | MeshPort, where: str) -> FloatArray:
    """Return the weights (nodes,) of nodes in a force at a point or on a set; their sum is one."""
    if part.point is not None:
        return point_weights(mesh, part.point, where)
    return set_weights(mesh, str(part.set), where)


def set_weights(mesh: StructureMesh, name: str, where: str) -> FloatArray:
    """Return the weights (nodes,) of nodes in the mean displacement of a set; their sum is one.

    A set of faces is weighted by area, a set of nodes equally.

    Raises
    ------
    MeshError
        If the set is missing or empty.
    """
    nodes = mesh.nodes_of(name, where)
    surface = mesh.faces_between(name, nodes)
    if len(surface):
        weights = face_areas(mesh, surface).areas
    else:
        weights = np.zeros(len(mesh.points))
        weights[nodes] = 1.0
    return np.asarray(weights / weights.sum())


def point_weights(mesh: StructureMesh, point: tuple[float, float, float], where: str) -> FloatArray:
    """Return the weights (nodes,) of nodes in the displacement of a point.

    Parameters
    ----------
    point : (float, float, float)
        The point, in the unit of length of the mesh.
    where : str
        The name of the load, mass or output at the point, for the error message.

    Raises
    ------
    InvalidDesignError
        If the point lies outside the structure.
    """
    position = mesh.unit * np.asarray(point)
    cell, local_position = attach(
        mesh, position, f"{where}: the point {mesh.describe_point(position)}"
    )
    (values,), _ = mesh.kind.shape_functions(local_position[None])
    weights = np.zeros(len(mesh.points))
    weights[mesh.cells[cell]] = values
    return weights
