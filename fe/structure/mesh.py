"""The mesh of a structure: nodes, cells of one kind and named sets, as the file has them, in metres."""

from collections.abc import Sized
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from fe.elements.cells import CellMesh
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError

EVERYTHING = "all"
"""The set of all cells, which no file has to hold."""
_LISTED = 12
_Content = TypeVar("_Content", bound=Sized)


@dataclass(frozen=True)
class Surface:
    """Faces of cells.

    Attributes
    ----------
    cell, face : (m,)
        Cell of each face and the face's number in it.
    """

    cell: IntArray
    face: IntArray

    def __len__(self) -> int:
        return len(self.cell)


@dataclass(frozen=True)
class StructureMesh(CellMesh):
    """Mesh of a file in metres; nodes that no cell uses are left out.

    Attributes
    ----------
    source : str
        The file, for sentences.
    unit : float
        Metres in a unit of length of the file.
    unit_name : str
        Its name.
    node_numbers : (nn,)
        Numbers of the nodes in the file, or from 1 where it has none.
    cell_numbers : (nc,)
        Numbers of the cells in the file.
    node_sets, cell_sets : dict of str to (m,)
        Nodes and cells of each set; -1 stands for a node that no cell uses.
    face_sets : dict of str to set of corner tuples
        Faces, each by its corner nodes in rising order.
    loose : (l,)
        Numbers of the nodes that no cell uses.
    remarks : tuple of str
        What a user should know of the file: words that were passed over though nobody knows what they do.
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

    @cached_property
    def size(self) -> float:
        """Diagonal [m] of the box around the structure."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def _boundary(self) -> tuple[Surface, IntArray]:
        """Faces of one cell alone and their corners (m, 4), rising, -1 before those of a triangle."""
        faces = []
        for face in self.kind.faces:
            corners = np.sort(self.cells[:, list(face)], axis=1)
            faces.append(np.pad(corners, ((0, 0), (4 - len(face), 0)), constant_values=-1))
        every = np.vstack(faces)
        _, first, count = np.unique(every, axis=0, return_index=True, return_counts=True)
        chosen = np.sort(first[count == 1])
        number, cell = np.divmod(chosen, len(self.cells))
        return Surface(cell, number), every[chosen]

    @property
    def boundary(self) -> Surface:
        """Faces of one cell alone: the surface of the structure."""
        return self._boundary[0]

    @cached_property
    def cell_radius(self) -> FloatArray:
        """Radii (nc,) [m] of the spheres around the centres of the cells that hold their nodes."""
        return np.asarray(np.linalg.norm(self.nodes - self.centres[:, None], axis=2).max(axis=1))

    @cached_property
    def face_spheres(self) -> tuple[FloatArray, FloatArray]:
        """Centres (m, 3) [m] of the faces of the surface and the radii (m,) [m] around them."""
        surface = self.boundary
        centre, radius = np.empty((len(surface), 3)), np.empty(len(surface))
        for number, nodes in enumerate(self.kind.face_nodes):
            on = np.flatnonzero(surface.face == number)
            middle = np.full((1, 2), 1.0 / 3.0 if len(self.kind.faces[number]) == 3 else 0.5)
            values, _ = self.kind.shape_functions(self.kind.face_places(number, middle)[0])
            points = self.nodes[surface.cell[on]]
            centre[on] = np.einsum("a,nai->ni", values[0], points)
            radius[on] = np.linalg.norm(points[:, list(nodes)] - centre[on, None], axis=2).max(axis=1)
        return centre, radius

    def place(self, point: FloatArray) -> str:
        """Return a place [m] as it stands in a sentence, in the unit of the file."""
        text = ", ".join(f"{value / self.unit + 0.0:.6g}" for value in point)
        return f"({text}) {self.unit_name}"

    def cells_of(self, name: str, where: str) -> IntArray:
        """Cells (m,) of a set; `where` is the place in the design, for the sentence.

        Raises
        ------
        MeshError
            If there is no such set of cells, or it is empty.
        """
        sets = self.cell_sets
        if name == EVERYTHING or _named(sets, EVERYTHING) is None:
            sets = sets | {EVERYTHING: sets.get(EVERYTHING, np.arange(len(self.cells)))}
        return self._content(sets, name, "cells", "cell", where)

    def nodes_of(self, name: str, where: str) -> IntArray:
        """Nodes (m,) of a set of nodes or faces, see `cells_of`.

        Raises
        ------
        MeshError
            If there is no such set, it is empty, or holds nodes that no cell uses.
        """
        found = self._content(self.node_sets, name, "nodes or faces", "node", where)
        left_out = int((found < 0).sum())
        if left_out:
            raise MeshError(
                f"{where}: {left_out} of the nodes of the set {name!r} of {self.source} touch no cell; take "
                "them out of the set."
            )
        return found

    def _content(self, sets: dict[str, _Content], name: str, kind: str, member: str, where: str) -> _Content:
        found = _named(sets, name)
        if found is None:
            names = [*sets]
            more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
            raise MeshError(
                f"{where}: {self.source} holds no set of {kind} named {name!r}; there are "
                f"{', '.join(names[:_LISTED]) or 'none'}{more}."
            )
        if not len(found):
            raise MeshError(f"{where}: the set {name!r} of {self.source} holds no {member}.")
        return found

    def faces_of(self, name: str, where: str) -> Surface:
        """Faces of the surface that lie in a set: of faces, or of nodes that hold all corners of a face.

        Raises
        ------
        MeshError
            If there is no such set, or no face of the surface lies in it.
        """
        surface = self.faces_between(name, self.nodes_of(name, where))
        if not len(surface):
            raise MeshError(
                f"{where}: no face of the surface lies in the set {name!r} of {self.source}; a set of faces, "
                "or all nodes of the faces, is expected."
            )
        return surface

    def faces_between(self, name: str, nodes: IntArray) -> Surface:
        """Faces of a set of faces, or else those of the surface all of whose corners are among nodes (m,)."""
        surface, corners = self._boundary
        wanted = _named(self.face_sets, name)
        if wanted is None:
            inside = np.isin(corners, [-1, *nodes]).all(axis=1)
        else:
            rows = (tuple(row[row >= 0].tolist()) for row in corners)
            inside = np.array([row in wanted for row in rows])
        return Surface(surface.cell[inside], surface.face[inside])


def _named(sets: dict[str, _Content], name: str) -> _Content | None:
    """Return the content of a set by its name, whose case counts only where two differ by nothing else."""
    alike = [content for key, content in sets.items() if key.casefold() == name.casefold()]
    return sets.get(name, alike[0] if len(alike) == 1 else None)
