"""The mesh of a structure in metres: nodes, cells of one kind, named sets."""

from collections.abc import Sized
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from fe.elements.cells import CellMesh, OuterFaces
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError
from reporting.words import comma_list

ALL_CELLS = "all"
"""Name of the set of all cells, which exists without being in the file."""
_Content = TypeVar("_Content", bound=Sized)


@dataclass(frozen=True)
class Surface:
    """Some faces of cells.

    Attributes
    ----------
    cell : (m,) array of int
        Cell of each face.
    face : (m,) array of int
        Index of the face in its cell.
    """

    cell: IntArray
    face: IntArray

    def __len__(self) -> int:
        return len(self.cell)


class Spheres(NamedTuple):
    """Bounding spheres of m cells or faces.

    Attributes
    ----------
    centre : (m, 3) array
        Centres [m].
    radius : (m,) array
        Radii [m].
    """

    centre: FloatArray
    radius: FloatArray


class MeshInterface(NamedTuple):
    """An interface between two parts, each of which has nodes of its own there.

    Attributes
    ----------
    nodes, copies : (m,) array of int
        Nodes of the first part, and those of the second part at the same places.
    centre : (3,) array
        Centre of the faces between them [m].
    axes : (3, 3) array
        Rows: unit vectors along the normal, which points to the second part, and along the longer
        and the shorter extent.
    """

    name: str
    nodes: IntArray
    copies: IntArray
    centre: FloatArray
    axes: FloatArray


@dataclass(frozen=True)
class StructureMesh(CellMesh):
    """The mesh of a file, in metres, without nodes that no cell uses.

    Attributes
    ----------
    source : str
        The name of the file in messages.
    unit : float
        The file's unit of length [m].
    node_numbers : (nn,) array of int
        Numbers of the nodes in the file, or from 1 if it has none.
    cell_numbers : (nc,) array of int
        Numbers of the cells in the file.
    node_sets, cell_sets : dict of str to (m,) array of int
        Nodes and cells of each set; -1 stands for a node that no cell uses.
    face_sets : dict of str to frozenset of tuples
        Faces of each set, a face by its corner nodes in ascending order.
    loose : (l,) array of int
        Numbers of the nodes that no cell uses.
    remarks : tuple of str
        Sentences for the user on how the file was read.
    interfaces : tuple of MeshInterface
        Interfaces at which two parts may move against each other.
    """

    source: str
    unit: float
    unit_name: str
    node_numbers: IntArray
    cell_numbers: IntArray
    node_sets: dict[str, IntArray]
    cell_sets: dict[str, IntArray]
    face_sets: dict[str, frozenset[tuple[int, ...]]]
    loose: IntArray
    remarks: tuple[str, ...] = ()
    interfaces: tuple[MeshInterface, ...] = ()

    @cached_property
    def size(self) -> float:
        """Diagonal of the structure's bounding box [m]."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def joined_nodes(self) -> IntArray:
        """The node (nn,) that each node follows at an interface, itself elsewhere."""
        nodes = np.arange(len(self.points))
        for interface in self.interfaces:
            nodes[interface.copies] = interface.nodes
        return nodes

    @cached_property
    def outer_faces(self) -> OuterFaces:
        """The faces that belong to one cell only, without those at interfaces."""
        joined_cells = self.joined_nodes[self.cells]
        joined_faces = CellMesh(self.kind, self.points, joined_cells).outer_faces
        corners = np.full_like(joined_faces.corners, -1)
        for number, face in enumerate(self.kind.faces):
            rows = np.flatnonzero(joined_faces.number == number)
            own_corners = self.cells[joined_faces.cell[rows]][:, list(face)]
            corners[rows, -len(face) :] = np.sort(own_corners, axis=1)
        return OuterFaces(joined_faces.cell, joined_faces.number, corners)

    @property
    def boundary(self) -> Surface:
        """The surface of the structure: the faces that belong to one cell only."""
        return Surface(self.outer_faces.cell, self.outer_faces.number)

    @cached_property
    def cell_radius(self) -> FloatArray:
        """Radii (nc,) [m] of the bounding spheres around the cells' centres."""
        distance = np.linalg.norm(self.nodes - self.centres[:, None], axis=2)
        return np.asarray(distance.max(axis=1))

    @cached_property
    def face_spheres(self) -> Spheres:
        """Bounding spheres of the faces of the surface, around the means of their nodes."""
        surface = self.boundary
        centre = np.empty((len(surface), 3))
        radius = np.empty(len(surface))
        for number, face_nodes in enumerate(self.kind.face_nodes):
            faces = np.flatnonzero(surface.face == number)
            cell_points = self.nodes[surface.cell[faces]]
            points = cell_points[:, list(face_nodes)]
            centre[faces] = points.mean(axis=1)
            from_centre = points - centre[faces, None]
            distance = np.linalg.norm(from_centre, axis=2)
            radius[faces] = distance.max(axis=1)
        return Spheres(centre, radius)

    def describe_point(self, point: FloatArray) -> str:
        """Format a position (3,) [m] for a message, in the unit of the file."""
        text = ", ".join(f"{value / self.unit + 0.0:.6g}" for value in point)
        return f"({text}) {self.unit_name}"

    def describe_cell(self, number: int) -> str:
        """Format a cell for a message: its number in the file, and its centre."""
        return f"{self.cell_numbers[number]} at {self.describe_point(self.centres[number])}"

    def cells_of(self, name: str, where: str) -> IntArray:
        """Return the cells (m,) of a set.

        Parameters
        ----------
        name : str
            Name of the set; "all" are all cells, unless the file has a set of that name.
        where : str
            The key of the design that names the set, for the error message.

        Raises
        ------
        MeshError
            If there is no such set of cells, or it is empty.
        """
        sets = self.cell_sets
        # The set of all cells is implied, unless the file has a set of this name in other letters.
        has_set_of_all = _set_named(sets, ALL_CELLS) is not None
        if name == ALL_CELLS or not has_set_of_all:
            sets = sets | {ALL_CELLS: sets.get(ALL_CELLS, np.arange(len(self.cells)))}
        return self._members(sets, name, "cells", "cell", where)

    def nodes_of(self, name: str, where: str) -> IntArray:
        """Return the nodes (m,) of a set of nodes or of faces.

        `where` is the key of the design that names the set, for the error message.

        Raises
        ------
        MeshError
            If there is no such set, it is empty, or holds nodes that no cell uses.
        """
        nodes = self._members(self.node_sets, name, "nodes or faces", "node", where)
        loose_count = int((nodes < 0).sum())
        if loose_count:
            raise MeshError(
                f"{where}: {loose_count} of the nodes of the set {name!r} of {self.source} touch "
                "no cell; take them out of the set."
            )
        return nodes

    def _members(
        self, sets: dict[str, _Content], name: str, kind: str, member: str, where: str
    ) -> _Content:
        """Return the members of a set; raise `MeshError` if it is missing or empty.

        `kind` and `member` are the words for what the set holds, in the plural and in the singular,
        for the message; `where` is the key of the design that names the set.
        """
        members = _set_named(sets, name)
        if members is None:
            raise MeshError(
                f"{where}: {self.source} holds no set of {kind} named {name!r}; there are "
                f"{comma_list(sets)}."
            )
        if not len(members):
            raise MeshError(f"{where}: the set {name!r} of {self.source} holds no {member}.")
        return members

    def faces_of(self, name: str, where: str) -> Surface:
        """Return the surface faces of a set.

        These are the faces of a set of faces, or those whose corners all lie in a set of nodes.
        `where` is the key of the design that names the set, for the error message.

        Raises
        ------
        MeshError
            If there is no such set, or no face of the surface lies in it.
        """
        surface = self.faces_between(name, self.nodes_of(name, where))
        if not len(surface):
            raise MeshError(
                f"{where}: no face of the surface lies in the set {name!r} of {self.source}; a set "
                "of faces, or all nodes of the faces, is expected."
            )
        return surface

    def faces_between(self, name: str, nodes: IntArray) -> Surface:
        """Return the faces of a set or, if it holds no faces, those between nodes (m,).

        A face lies between the nodes if they include all of its corners. The result may be empty.
        """
        outer_faces = self.outer_faces
        face_set = _set_named(self.face_sets, name)
        if face_set is None:
            no_corner = -1  # stands before the corners of a triangle
            is_inside = np.isin(outer_faces.corners, [no_corner, *nodes]).all(axis=1)
        else:
            faces = (tuple(row[row >= 0].tolist()) for row in outer_faces.corners)
            is_inside = np.array([face in face_set for face in faces])
        return Surface(outer_faces.cell[is_inside], outer_faces.number[is_inside])


def _set_named(sets: dict[str, _Content], name: str) -> _Content | None:
    """Return the members of a set, or None if no set has this name.

    Upper and lower case are distinguished only if two names differ by nothing else.
    """
    if name in sets:
        return sets[name]
    matches = [members for key, members in sets.items() if key.casefold() == name.casefold()]
    return matches[0] if len(matches) == 1 else None
