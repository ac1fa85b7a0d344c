"""Interfaces between two parts of a mesh, whose nodes are doubled so that the parts may separate.

The nodes of the second part follow those of the first one, and move against them as a rigid body:
along the normal of the interface and two tangents, and about these axes through its centre. A
spring resists each of these motions, or it is held.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError

from .design import Interface, MeshDesign
from .mesh import MeshInterface, StructureMesh
from .nodal_loads import set_weights
from .tables import INTERFACE_MOTIONS

COINCIDENT = 1e-6
"""Distance below which nodes of two parts lie at one place, relative to the size of the mesh."""
LEAST_EXTENT = 1e-3
"""Extent across an interface, relative to its length, below which its nodes lie on a line."""
EQUAL_EXTENTS = 0.99
"""Ratio of the two extents of an interface from which neither is called the longer one."""


class InterfaceMotion(NamedTuple):
    """A motion of the second part of an interface against the first one.

    Attributes
    ----------
    motion : str
        One of `INTERFACE_MOTIONS`.
    displacements : coo (full, 1)
        Displacements of all nodes by a motion of 1 m or 1 rad.
    spring : float
        Spring that resists it [N/m or N m/rad]; zero if it is held.
    scaled_by : str or None
        Parameter that scales the spring.
    """

    interface: str
    motion: str
    displacements: sparse.coo_array
    spring: float
    scaled_by: str | None


def interface_motions(mesh: StructureMesh, design: MeshDesign) -> Iterator[InterfaceMotion]:
    """Yield the six motions of each interface of a mesh from `with_interfaces`."""
    for interface, row in zip(mesh.interfaces, design.interface, strict=True):
        arms = mesh.points[interface.copies] - interface.centre
        shifts = [np.broadcast_to(axis, arms.shape) for axis in interface.axes]
        turns = [np.cross(axis, arms) for axis in interface.axes]
        unknowns = (3 * interface.copies[:, np.newaxis] + np.arange(3)).ravel()
        for motion, spring, moved in zip(
            INTERFACE_MOTIONS, row.springs, [*shifts, *turns], strict=True
        ):
            entries = (moved.ravel(), (unknowns, np.zeros_like(unknowns)))
            column = sparse.coo_array(entries, (mesh.unknowns, 1))
            yield InterfaceMotion(row.name, motion, column, spring, row.scaled_by)


def with_interfaces(mesh: StructureMesh, design: MeshDesign) -> StructureMesh:
    """Return the mesh with the interfaces of a design.

    Nodes that the two parts share are doubled. If the parts have nodes of their own at the same
    places, these stay as they are.

    Raises
    ------
    MeshError
        If a part is missing or empty, the parts overlap or do not touch in points that span a
        plane, or another part or interface touches them there.
    """
    for label, interface in design.numbered("interface"):
        mesh = _with_interface(mesh, interface, f"{label} ({interface.name})")
    return mesh


def _with_interface(mesh: StructureMesh, interface: Interface, label: str) -> StructureMesh:
    """Return the mesh with one more interface."""
    first_cells, second_cells = (mesh.cells_of(part, label) for part in interface.parts)
    words = " and ".join(map(repr, interface.parts))
    if np.intersect1d(first_cells, second_cells).size:
        raise MeshError(
            f"{label}: the parts {words} share elements; give two sets of elements that only touch."
        )
    of_first = np.unique(mesh.cells[first_cells])
    of_second = np.unique(mesh.cells[second_cells])
    nodes = np.intersect1d(of_first, of_second)
    if nodes.size:
        _check_no_third_part(mesh, nodes, np.union1d(first_cells, second_cells), label)
        copies = len(mesh.points) + np.arange(len(nodes))
        divided = _with_copies(mesh, nodes, second_cells)
    else:
        divided = mesh
        from_first, nearest = KDTree(mesh.points[of_first]).query(mesh.points[of_second])
        is_at_node = from_first <= COINCIDENT * mesh.size
        nodes, copies = of_first[nearest[is_at_node]], of_second[is_at_node]
    if not nodes.size:
        raise MeshError(
            f"{label}: the parts {words} have no node in common, and no nodes at the same places; "
            "mesh them so that their nodes agree where they touch."
        )
    for other in mesh.interfaces:
        if np.isin(nodes, (other.nodes, other.copies)).any():
            raise MeshError(
                f"{label}: some of its nodes belong to the interface {other.name!r}, too; "
                "interfaces must not meet."
            )
    first_centre = mesh.centres[first_cells].mean(axis=0)
    second_centre = mesh.centres[second_cells].mean(axis=0)
    new_interface = MeshInterface(
        name=interface.name,
        nodes=nodes,
        copies=copies,
        centre=_centre(mesh, first_cells, nodes, label),
        axes=_interface_axes(mesh.points[nodes], second_centre - first_centre, label),
    )
    return replace(divided, interfaces=(*mesh.interfaces, new_interface))


def _check_no_third_part(mesh: StructureMesh, nodes: IntArray, cells: IntArray, label: str) -> None:
    """Raise `MeshError` if a cell of neither part has one of the shared nodes."""
    touching = np.flatnonzero(np.isin(mesh.cells, nodes).any(axis=1))
    others = np.setdiff1d(touching, cells)
    if others.size:
        raise MeshError(
            f"{label}: {len(others)} elements of neither part touch the interface, such as "
            f"{mesh.describe_cell(others[0])}; add them to the part to which they belong."
        )


def _with_copies(mesh: StructureMesh, nodes: IntArray, second_cells: IntArray) -> StructureMesh:
    """Return the mesh with a copy of each shared node (m,), which the second part has instead.

    Sets of nodes that hold nodes of the second part alone have the copies, sets of both parts have
    both, and all others the shared nodes.
    """
    node_count = len(mesh.points)
    copy_of_node = np.arange(node_count)
    copy_of_node[nodes] = node_count + np.arange(len(nodes))
    cells = mesh.cells.copy()
    cells[second_cells] = copy_of_node[cells[second_cells]]
    of_second_alone = np.setdiff1d(mesh.cells[second_cells], nodes)
    node_sets = {}
    for name, members in mesh.node_sets.items():
        own = np.setdiff1d(members, nodes)
        is_second = np.isin(own, of_second_alone)
        copied = np.where(members >= 0, copy_of_node[members], members)
        if is_second.any():
            members = copied if is_second.all() else np.unique(np.append(members, copied))
        node_sets[name] = members
    face_sets = {}
    for name, faces in mesh.face_sets.items():
        of_copies = {tuple(sorted(copy_of_node[list(face)].tolist())) for face in faces}
        face_sets[name] = faces | of_copies
    return replace(
        mesh,
        points=np.concatenate((mesh.points, mesh.points[nodes])),
        cells=cells,
        node_numbers=np.concatenate((mesh.node_numbers, mesh.node_numbers[nodes])),
        node_sets=node_sets,
        face_sets=face_sets,
    )


def _centre(mesh: StructureMesh, first_cells: IntArray, nodes: IntArray, label: str) -> FloatArray:
    """Return the centre (3,) of the faces between the nodes of an interface [m]."""
    set_name = label  # of the nodes, as a message would call them
    first_part = replace(
        mesh,
        cells=mesh.cells[first_cells],
        cell_numbers=mesh.cell_numbers[first_cells],
        node_sets={set_name: nodes},
        cell_sets={},
        face_sets={},
        interfaces=(),
    )
    return set_weights(first_part, set_name, label) @ mesh.points


def _interface_axes(points: FloatArray, to_second_part: FloatArray, label: str) -> FloatArray:
    """Return the normal, the long and the short axis of an interface, as unit rows (3, 3).

    - The normal is that of the plane nearest to the points (m, 3). It points to the side to which
      `to_second_part` (3,) points.
    - The long axis is the direction in the plane in which the points extend farthest. If the
      extents are about equal, it is the projection on the plane of that coordinate axis which is
      most nearly tangential. Its component of largest magnitude is positive.
    - The short axis is the cross product of the normal and the long axis.

    `label` of the interface begins the message of an error.

    Raises
    ------
    MeshError
        If there are fewer than three points, or if they lie on a line.
    """
    _, extents, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=True)
    if len(points) < 3 or extents[1] <= LEAST_EXTENT * extents[0]:
        raise MeshError(
            f"{label}: the nodes of the interface lie on a line, about which the parts could turn "
            "freely."
        )
    long_axis, _, normal = axes
    if normal @ to_second_part < 0.0:
        normal = -normal
    if extents[1] > EQUAL_EXTENTS * extents[0]:
        long_axis = np.eye(3)[np.argmin(np.round(np.abs(normal), 6))]
        long_axis = long_axis - (long_axis @ normal) * normal
        long_axis = long_axis / np.linalg.norm(long_axis)
    long_axis = long_axis * np.sign(long_axis[np.abs(long_axis).argmax()])
    short_axis = np.cross(normal, long_axis)
    return np.array([normal, long_axis, short_axis])
