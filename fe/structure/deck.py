"""The nodes, elements and sets of a mesh file, as the readers of all formats collect them."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from fe.elements.kinds import DECK_KINDS, ElementKind
from fe.runtime.arrays import IntArray
from reporting.formats.toml_file import short_repr

from .deck_text import FLAT, DeckWords, fail, whole
from .mesh import StructureMesh

_MOST_MEMBERS = 5_000_000
"""Members that all sets may have together: a short line can ask for any number."""


class DeckElement(NamedTuple):
    """An element: its type in meshio, and the numbers of its nodes."""

    type: str
    nodes: list[int]


class SurfaceRow(NamedTuple):
    """A line of a surface: an element or set of elements, and a face such as S1."""

    where: str
    member: str
    face: str


class Face(NamedTuple):
    """The nodes of a face, corners first."""

    nodes: list[int]
    corner_count: int


class _NamedSet(NamedTuple):
    """A set's name as the file spells it, and the numbers of its members."""

    name: str
    members: list[int]


class Deck:
    """The nodes, elements and sets of a mesh file that is being read.

    A reader adds them line by line; `mesh` then checks everything and builds the mesh.

    Parameters
    ----------
    words : DeckWords, optional
        The keywords of the dialect. With them, names of sets are not case-sensitive.

    Attributes
    ----------
    nodes : dict of int to tuple of float
        The coordinates by node number [unit of length of the file].
    elements : dict of int to DeckElement
        The elements by number; those of a type in `FLAT` only name nodes and a face.
    surfaces : dict of str to list of SurfaceRow
        The surfaces by name.
    sections : dict of str to str
        File and line where a set of elements got a thickness, an area or a material, by the set's
        name in lower case.
    """

    def __init__(self, path: Path, words: DeckWords | None = None) -> None:
        self.path = path
        self.words = words
        self.nodes: dict[int, tuple[float, ...]] = {}
        self.elements: dict[int, DeckElement] = {}
        self.surfaces: dict[str, list[SurfaceRow]] = {}
        self.sections: dict[str, str] = {}
        self._sets: dict[str, dict[str, _NamedSet]] = {"NSET": {}, "ELSET": {}}
        self._first_of_solid_type: dict[str, str] = {}  # file and line
        self._notes_on_unknown: dict[str, list[str]] = {}  # by word
        self._remarks: dict[str, None] = {}
        self._members_left = _MOST_MEMBERS

    def remark(self, sentence: str) -> None:
        """Note a sentence for the user on how the file was read; repetitions are dropped."""
        self._remarks.setdefault(sentence)

    def pass_over(self, word: str, where: str) -> None:
        """Ignore a keyword that the mesh does not need.

        Raises `MeshError` for a keyword without which the mesh would be another one. A keyword that
        is not known is ignored with a remark.
        """
        assert self.words is not None
        if word in self.words.refused:
            fail(where, f"{self.words.mark}{word} {self.words.refused[word]}.")
        if word not in self.words.harmless:
            note = f"{where}: {self.words.mark}{word}"
            self._notes_on_unknown.setdefault(word, []).append(note)

    def members(self, kind: str, name: str) -> list[int]:
        """Return the list of a set's members, to which a reader may append.

        `kind` is "NSET" or "ELSET", a set of nodes or of elements. A set that is not there is made.
        """
        key = name.casefold() if self.words else name
        return self._sets[kind].setdefault(key, _NamedSet(name, [])).members

    def members_or_number(self, kind: str, where: str, text: str) -> list[int]:
        """Return the members of the set with this name, or else the name as one number.

        `kind` is "NSET" or "ELSET"; `where` is the file and line, for the error message.
        """
        named_set = self._sets[kind].get(text.casefold())
        members = [whole(where, text)] if named_set is None else named_set.members
        return self.counted(where, members)

    def counted(self, where: str, members: Sequence[int]) -> list[int]:
        """Return the members as a list, and count them towards the limit of all sets.

        Raises `MeshError` if all sets together hold more than `_MOST_MEMBERS`.
        """
        self._members_left -= len(members)
        if self._members_left < 0:
            fail(where, f"the sets hold more than {_MOST_MEMBERS:,} members together.")
        return list(members)

    def add_node(self, where: str, number: int, coordinates: Sequence[float]) -> None:
        """Add a node; coordinates are in the file's unit of length.

        Raises `MeshError` if the same number is already at another point.
        """
        point = tuple(float(coordinate) for coordinate in coordinates)
        if self.nodes.setdefault(number, point) != point:
            fail(where, f"node {number} is defined twice, at different places; delete one.")

    def add_element(self, where: str, number: int, element_type: str, nodes: list[int]) -> None:
        """Add an element of a type of meshio; raise `MeshError` if its number is taken."""
        if number in self.elements:
            fail(where, f"element {number} is defined twice; delete one definition.")
        self.elements[number] = DeckElement(element_type, nodes)
        if element_type not in FLAT:
            self._first_of_solid_type.setdefault(element_type, where)

    # ------------------------------------------------------------------ mesh

    def mesh(self, unit: float, unit_name: str) -> StructureMesh:
        """Check everything that was read and build the mesh, in metres.

        Nodes of no solid element are left out. Sets of flat elements become sets of faces.

        Parameters
        ----------
        unit : float
            The file's unit of length [m].
        unit_name : str
            The name of that unit.

        Raises
        ------
        MeshError
            If the elements are of an unknown kind, of several kinds or doubled, or sets or elements
            name something that is not there.
        """
        kind = self._one_kind()
        solids = {
            number: element.nodes
            for number, element in self.elements.items()
            if element.type not in FLAT
        }
        cells = self._cells(solids)
        points = np.array(list(self.nodes.values()))
        numbers = np.array(list(self.nodes), dtype=np.int64)
        # nodes of no solid element are left out; the others are numbered anew
        is_used = np.zeros(len(points), dtype=bool)
        is_used[cells] = True
        new_index = np.where(is_used, np.cumsum(is_used) - 1, -1)
        node_sets = {}
        for name, members in self._sets["NSET"].values():
            indices = self._node_indices(members, f"the set {name!r}")
            node_sets[name] = new_index[_sorted_once(indices)]
        # a set of elements holds cells, or flat elements that stand for faces
        faces_by_name = {}
        for name, rows in self.surfaces.items():
            faces_by_name[name] = list(self._surface_faces(rows, kind, solids))
        cell_sets = {}
        cell_index = {number: index for index, number in enumerate(solids)}
        for name, members in self._sets["ELSET"].values():
            flat_members = [number for number in members if number not in cell_index]
            flat_faces = self._flat_faces(name, flat_members)
            cell_members = [cell_index[number] for number in members if number in cell_index]
            if cell_members or not flat_faces:
                cell_sets[name] = _sorted_once(cell_members)
            else:
                faces_by_name.setdefault(name, flat_faces)
        face_sets = {}
        for name, faces in faces_by_name.items():
            face_nodes: list[int] = []
            corners = set()
            for face in faces:
                indices = self._node_indices(face.nodes, f"the set {name!r}")
                nodes = new_index[indices].tolist()
                face_nodes += nodes
                if face.corner_count > 2:
                    corners.add(tuple(sorted(nodes[: face.corner_count])))
            node_sets.setdefault(name, _sorted_once(face_nodes))
            if corners:
                face_sets[name] = frozenset(corners)
        return StructureMesh(
            source=str(self.path),
            kind=kind,
            points=unit * points[is_used],
            cells=new_index[cells],
            unit=unit,
            unit_name=unit_name,
            node_numbers=numbers[is_used],
            cell_numbers=np.array(list(solids), dtype=np.int64),
            node_sets=node_sets,
            cell_sets=cell_sets,
            face_sets=face_sets,
            loose=numbers[~is_used],
            remarks=(*self._remarks, *self._remarks_on_unknown()),
        )

    def _cells(self, solids: dict[int, list[int]]) -> IntArray:
        """Return the node indices (E, n) of the solid elements; refuse two with the same nodes."""
        rows = [self._node_indices(nodes, f"element {number}") for number, nodes in solids.items()]
        cells = np.array(rows, dtype=np.int64)
        _, first_occurrences = np.unique(np.sort(cells, axis=1), axis=0, return_index=True)
        doubled = np.delete(np.array(list(solids), dtype=np.int64), first_occurrences)
        if len(doubled):
            fail(
                str(self.path),
                f"{len(doubled)} elements, such as {doubled[0]}, have the nodes of another; delete "
                "them.",
            )
        return cells

    def _remarks_on_unknown(self) -> Iterator[str]:
        """Yield a sentence on each unknown keyword."""
        for notes in self._notes_on_unknown.values():
            times = f" ({len(notes)} times)" if len(notes) > 1 else ""
            yield (
                f"{notes[0]}{times} is not known and was passed over; make sure that the model may "
                "do without."
            )

    def _one_kind(self) -> ElementKind:
        """Return the kind of the solid elements; raise `MeshError` if there are several."""
        solid_types = [
            element.type for element in self.elements.values() if element.type not in FLAT
        ]
        counts = Counter(solid_types)
        if len(counts) != 1 or not counts.keys() <= DECK_KINDS.keys():
            self._refuse_kinds(counts)
        (solid_type,) = counts
        return DECK_KINDS[solid_type]

    def _refuse_kinds(self, counts: Mapping[str, int]) -> NoReturn:
        """Raise the error for elements that are not all of one known kind."""
        known_names = ", ".join(kind.name for kind in DECK_KINDS.values())
        found_kinds = []
        for solid_type, count in counts.items():
            is_known = solid_type in DECK_KINDS
            name = DECK_KINDS[solid_type].name if is_known else solid_type
            found_kinds.append(f"{count} {name}")
        found_list = ", ".join(found_kinds) or "none that is solid"
        line_of_last_type = [str(self.path), *self._first_of_solid_type.values()][-1]
        fail(
            line_of_last_type,
            f"a whole mesh of one kind of elements is expected ({known_names}), but the mesh has "
            f"{found_list}; mesh it with tetrahedra alone.",
        )

    def _node_indices(self, numbers: Iterable[int], owner: str) -> list[int]:
        """Return node indices by number; `owner` is what names the nodes, for the error message."""
        try:
            return [self._node_index[number] for number in numbers]
        except KeyError as missing:
            fail(str(self.path), f"{owner} names node {missing}, which is not defined.")

    @cached_property
    def _node_index(self) -> dict[int, int]:
        return {number: index for index, number in enumerate(self.nodes)}

    def _flat_faces(self, name: str, members: list[int]) -> list[Face]:
        """Return the flat elements of a set as faces.

        Raises `MeshError` if the set has a section: its elements then carry loads.
        """
        for number in members:
            if number not in self.elements:
                fail(
                    str(self.path),
                    f"the set {name!r} names element {number}, which is not defined.",
                )
        section = self.sections.get(name.casefold())
        if members and section:
            fail(
                section,
                f"{len(members)} bars, membranes or shells of the set {name!r} have a section and "
                "bear loads, but solids alone are read; delete one or the other.",
            )
        faces = []
        for number in members:
            element = self.elements[number]
            faces.append(Face(element.nodes, FLAT[element.type].corner_count))
        return faces

    def _surface_faces(
        self, rows: list[SurfaceRow], kind: ElementKind, solids: dict[int, list[int]]
    ) -> Iterator[Face]:
        """Yield the faces of a surface."""
        face_count = len(kind.faces)
        for row in rows:
            label = row.face.upper()
            face = int(label[1:]) if re.fullmatch("S[1-6]", label) else 0
            if not 1 <= face <= face_count:
                fail(
                    row.where,
                    f"a face S1 to S{face_count} of {kind.name} is expected, but "
                    f"{short_repr(row.face)} was given.",
                )
            for number in set(self.members_or_number("ELSET", row.where, row.member)):
                if number not in solids:
                    fail(
                        row.where,
                        f"the surface names element {number}, which is not a solid element.",
                    )
                nodes = [solids[number][index] for index in kind.face_nodes[face - 1]]
                yield Face(nodes, corner_count=len(kind.faces[face - 1]))


def _sorted_once(numbers: list[int]) -> IntArray:
    """Return the distinct numbers in ascending order."""
    return np.unique(np.array(numbers, dtype=np.int64))
