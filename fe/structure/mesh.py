"""The mesh of a structure: nodes, cells of one kind and named sets, as the file has them, in metres."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fe.elements.cells import CellMesh
from fe.runtime.errors import MeshError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

EVERYTHING = "all"
"""The set of all cells, which no file has to hold."""
_LISTED = 12
_Content = TypeVar("_Content")


@dataclass(frozen=True)
class FileMesh(CellMesh):
    """What a mesh file holds, before it is checked.

    Attributes
    ----------
    kind, points, cells
        As of `CellMesh`, in the unit of the file.
    node_numbers : (nn,)
        Their numbers in the file, or from 1 where it has none.
    cell_numbers : (nc,)
        Numbers of the cells in the file.
    node_sets, cell_sets : dict of str to (m,)
        Nodes and cells of each set.
    face_sets : dict of str to tuple of corner tuples
        Faces, each by its corner nodes in rising order.
    remarks : tuple of str
        What a user should know of the file: words that were passed over though nobody knows what they do.
    """

    node_numbers: IntArray
    cell_numbers: IntArray
    node_sets: dict[str, IntArray]
    cell_sets: dict[str, IntArray]
    face_sets: dict[str, frozenset[tuple[int, ...]]]
    remarks: tuple[str, ...] = ()


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
class StructureMesh(FileMesh):
    """Checked mesh in metres; nodes that no cell uses are left out.

    Attributes
    ----------
    source : str
        The file, for sentences.
    kind, cells, cell_numbers, node_numbers
        As of `FileMesh`.
    points : (nn, 3) m
        Places of the nodes.
    unit : float
        Metres in a unit of length of the file.
    unit_name : str
        Its name.
    node_sets, cell_sets, face_sets
        As of `FileMesh`, without loose nodes.
    loose : (l,)
        Numbers of the nodes that no cell uses.
    loose_in : dict of str to int
        For each node set, how many of its nodes were left out.
    remarks
        As of `FileMesh`.
    """

    source: str = field(kw_only=True)
    unit: float = field(kw_only=True)
    unit_name: str = field(kw_only=True)
    loose: IntArray = field(kw_only=True)
    loose_in: dict[str, int] = field(kw_only=True)

    @cached_property
    def size(self) -> float:
        """Diagonal [m] of the box around the structure."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @cached_property
    def _all_faces(self) -> tuple[Surface, IntArray]:
        """All faces of all cells and their corners (m, 4), rising, -1 before those of a triangle."""
        cells, faces, corners = [], [], []
        for number, face in enumerate(self.kind.faces):
            key = np.sort(self.cells[:, list(face)], axis=1)
            if len(face) == 3:
                key = np.column_stack((np.full(len(key), -1), key))
            cells.append(np.arange(len(key)))
            faces.append(np.full(len(key), number))
            corners.append(key)
        return Surface(np.concatenate(cells), np.concatenate(faces)), np.vstack(corners)

    @cached_property
    def _boundary(self) -> tuple[Surface, IntArray]:
        every, corners = self._all_faces
        _, first, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
        chosen = np.sort(first[count == 1])
        return Surface(every.cell[chosen], every.face[chosen]), corners[chosen]

    @property
    def boundary(self) -> Surface:
        """Faces of one cell alone: the surface of the structure."""
        return self._boundary[0]

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
        if name == EVERYTHING and name not in self.cell_sets:
            return np.arange(len(self.cells))
        found = _found(self.cell_sets, name)
        if found is None:
            known = f"the sets of cells are {_listed((*self.cell_sets, EVERYTHING))}"
            raise MeshError(f"{where}: {self.source} holds no set of cells named {name!r}; {known}.")
        if not len(found):
            raise MeshError(f"{where}: the set {name!r} of {self.source} holds no cell.")
        return found

    def nodes_of(self, name: str, where: str) -> IntArray:
        """Nodes (m,) of a set of nodes or faces, see `cells_of`.

        Raises
        ------
        MeshError
            If there is no such set, it is empty, or holds nodes that no cell uses.
        """
        found = _found(self.node_sets, name)
        if found is None:
            surface = self._named_faces(name)
            if surface is None:
                known = _listed(tuple(dict.fromkeys((*self.node_sets, *self.face_sets))))
                raise MeshError(
                    f"{where}: {self.source} holds no set of nodes or faces named {name!r}; there are "
                    f"{known}."
                )
            found = self._nodes_of_faces(surface)
        left_out = _found(self.loose_in, name) or 0
        if left_out:
            raise MeshError(
                f"{where}: {left_out} of the nodes of the set {name!r} of {self.source} touch no cell; take "
                "them out of the set."
            )
        if not len(found):
            raise MeshError(f"{where}: the set {name!r} of {self.source} holds no node.")
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
        named = self._named_faces(name)
        return self._between(nodes) if named is None else named

    def _named_faces(self, name: str) -> Surface | None:
        wanted = _found(self.face_sets, name)
        if wanted is None:
            return None
        surface, corners = self._boundary
        inside = [tuple(row[row >= 0].tolist()) in wanted for row in corners]
        return Surface(surface.cell[inside], surface.face[inside])

    def _between(self, nodes: IntArray) -> Surface:
        marked = np.zeros(len(self.points) + 1, dtype=bool)  # the last stands for the missing corner
        marked[nodes], marked[-1] = True, True
        surface, corners = self._boundary
        inside = marked[corners].all(axis=1)
        return Surface(surface.cell[inside], surface.face[inside])

    def _nodes_of_faces(self, surface: Surface) -> IntArray:
        found = [
            self.cells[surface.cell[surface.face == number]][:, list(nodes)].ravel()
            for number, nodes in enumerate(self.kind.face_nodes)
        ]
        return np.unique(np.concatenate(found))

    def with_sets(self, node_sets: dict[str, IntArray], cell_sets: dict[str, IntArray]) -> "StructureMesh":
        """Return the mesh with further sets."""
        return replace(self, node_sets=self.node_sets | node_sets, cell_sets=self.cell_sets | cell_sets)


def _found(sets: dict[str, _Content], name: str) -> _Content | None:
    """Return the content of a set by its name, whose case counts only where two differ by nothing else."""
    if name in sets:
        return sets[name]
    alike = [content for key, content in sets.items() if key.casefold() == name.casefold()]
    return alike[0] if len(alike) == 1 else None


def _listed(names: tuple[str, ...]) -> str:
    if not names:
        return "none"
    text = ", ".join(names[:_LISTED])
    return text if len(names) <= _LISTED else f"{text} and {len(names) - _LISTED} more"
