"""What a mesh file holds, nodes, elements and sets, as the readers of all formats collect it.

Also the coordinate systems of decks: points that are given by radii and angles, or along other axes.
"""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from math import isfinite, nan
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike

from fe.elements.elasticity import axes_of
from fe.elements.kinds import DECK_KINDS, ElementKind
from fe.runtime.arrays import FloatArray, IntArray
from fe.runtime.errors import MeshError
from fe.sentences import said
from reporting.text_file import read_text
from reporting.toml_file import parse_toml, short_repr

from .mesh import StructureMesh

_DIALECTS = parse_toml(
    resources.files("fe.structure").joinpath("deck_words.toml").read_bytes(), "decks", MeshError
)
FLAT: dict[str, list[int]] = _DIALECTS["flat"]
"""Elements that only name nodes and faces, by their names in meshio: how many nodes and corners they have."""
_MOST_NUMBERS = 5_000_000
"""Numbers that all sets may hold together: a short line can ask for any."""
_LARGEST_NUMBER = 2**53
_NO_EXPONENT = re.compile(r"(?<=[\d.])(?=[+-])")


class Words(NamedTuple):
    """What becomes of the words of a dialect, see `deck_words.toml`.

    Attributes
    ----------
    mark : str
        What stands before a word.
    harmless : frozenset of str
        Passed over.
    refused : dict of str to str
        What a word would do, and the remedy: without it the model would be another.
    read : dict of str to list of str
        Words that are read, each with the parameters that are.
    flat : dict of str to str
        Elements in `FLAT`, as other programs hand on lines and surfaces: without a section they only name.
    """

    mark: str
    harmless: frozenset[str]
    refused: dict[str, str]
    read: dict[str, list[str]]
    flat: dict[str, str]


def words_of(dialect: str) -> Words:
    """Return the words of "abaqus" or "nastran"."""
    found = _DIALECTS[dialect]
    refused = {word: group["remedy"] for group in found["refused"] for word in group["words"]}
    return Words(found["mark"], frozenset(found["harmless"]), refused, found.get("read", {}), found["flat"])


def fail(where: str, sentence: str) -> NoReturn:
    """Refuse a file; `where` begins the sentence."""
    raise MeshError(f"{where}: {sentence}")


def lines_of(
    files: tuple[Path, ...], comment: re.Pattern[str], include: re.Pattern[str]
) -> Iterator[tuple[str, str]]:
    """Yield where each line of the last of files that include one another stands, and its text.

    Comments and empty lines are left out; the lines of a file whose name `include` finds stand in its place.
    """
    text = read_text(files[-1], MeshError, what="mesh file", otherwise="latin-1")
    for number, line in enumerate(text.splitlines(), start=1):
        where, line = f"{files[-1]}, line {number}", comment.sub("", line).rstrip()
        if found := include.fullmatch(line):
            inner = (files[-1].parent / found[1].strip(" '\"")).resolve()
            if inner in files:
                fail(where, f"{inner} includes itself.")
            yield from lines_of((*files, inner), comment, include)
        elif line:
            yield where, line


def whole(where: str, text: str) -> int:
    """Return a whole number, or refuse."""
    try:
        number = int(text)
    except ValueError:
        fail(where, f"a whole number is expected, but {short_repr(text)} came.")
    if abs(number) > _LARGEST_NUMBER:
        fail(where, f"the number {short_repr(text)} is too large.")
    return number


def real(where: str, text: str) -> float:
    """Return a real number, 0 for none, or refuse; Fortran writes D for E, and Nastran leaves the E out."""
    try:
        number = float(_NO_EXPONENT.sub("E", text.upper().replace("D", "E") or "0"))
    except ValueError:
        number = nan
    if not isfinite(number):
        fail(where, f"a real number is expected, but {short_repr(text)} came.")
    return number


class Deck:
    """Nodes, elements and sets by their numbers and names, while a mesh file is read.

    Parameters
    ----------
    path : Path
        The file.
    words : Words, optional
        Of the dialect of a deck, in which the case of a name does not count.
    """

    def __init__(self, path: Path, words: Words | None = None) -> None:
        self.path, self.words = path, words
        self.nodes: dict[int, tuple[float, ...]] = {}
        self.elements: dict[int, tuple[str, list[int]]] = {}
        """Type in meshio and nodes of each; those in `FLAT` only name nodes and a face."""
        self.surfaces: dict[str, list[tuple[str, str, str]]] = {}
        self.sections: dict[str, str] = {}
        """Where a set of elements, by its name in lower case, got a thickness, an area or a material."""
        self._sets: dict[str, dict[str, tuple[str, list[int]]]] = {"NSET": {}, "ELSET": {}}
        self._solids: dict[str, str] = {}
        """Where each type of solid elements came first."""
        self._unknown: dict[str, list[str]] = {}
        self._remarks: dict[str, None] = {}
        self._room = _MOST_NUMBERS

    def remark(self, sentence: str) -> None:
        """Add a sentence on how the file was read, once."""
        self._remarks.setdefault(sentence)

    def word(self, word: str, where: str) -> None:
        """Pass over a word that is no part of the mesh; refuse what must not be lost, note the unknown."""
        assert self.words is not None
        if word in self.words.refused:
            fail(where, f"{self.words.mark}{word} {self.words.refused[word]}.")
        if word not in self.words.harmless:
            note = f"{where}: {self.words.mark}{word}"
            self._unknown.setdefault(word, []).append(note)

    def members(self, key: str, name: str) -> list[int]:
        """Return the members of a set of nodes (NSET) or elements (ELSET), to be added to."""
        return self._sets[key].setdefault(name.casefold() if self.words else name, (name, []))[1]

    def named(self, key: str, where: str, text: str) -> list[int]:
        """Return a copy of the members of a set, or a number alone."""
        found = self._sets[key].get(text.casefold())
        return self.counted(where, [whole(where, text)] if found is None else found[1])

    def counted(self, where: str, members: Sequence[int]) -> list[int]:
        """Return members of a set, or refuse: short lines may ask for more numbers than any mesh has."""
        self._room -= len(members)
        if self._room < 0:
            fail(where, f"the sets hold more than {_MOST_NUMBERS:,} members together.")
        return list(members)

    def add_node(self, where: str, number: int, place: Iterable[float]) -> None:
        """Add a node; one that is there twice must be at the same place."""
        point = tuple(map(float, place))
        if self.nodes.setdefault(number, point) != point:
            fail(where, f"node {number} is there twice, at different places; delete one.")

    def add_element(self, where: str, number: int, kind: str, nodes: list[int]) -> None:
        """Add an element."""
        if number in self.elements:
            fail(where, f"element {number} is there twice; delete one.")
        self.elements[number] = (kind, nodes)
        if kind not in FLAT:
            self._solids.setdefault(kind, where)

    def mesh(self, unit: float, unit_name: str) -> StructureMesh:
        """Return the mesh of all that was added, its nodes in metres; `unit` is that of the file [m].

        Raises
        ------
        MeshError
            If its elements are of no kind that is known, of several, doubled, or sets or elements name what
            is not there.
        """
        source, kind = str(self.path), self._kind()
        solid = {number: nodes for number, (own, nodes) in self.elements.items() if own not in FLAT}
        cell = {number: index for index, number in enumerate(solid)}
        cells = np.array([self._places(nodes, f"element {n}") for n, nodes in solid.items()], dtype=np.int64)
        numbers = np.array(list(solid), dtype=np.int64)
        _, first = np.unique(np.sort(cells, axis=1), axis=0, return_index=True)
        twins = np.delete(numbers, first)
        if len(twins):
            fail(source, said("deck.twins", count=len(twins), number=twins[0]))

        points, own = np.array(list(self.nodes.values())), np.array(list(self.nodes), dtype=np.int64)
        used = np.zeros(len(points), dtype=bool)
        used[cells] = True
        kept = np.where(used, np.cumsum(used) - 1, -1)
        node_sets = {
            name: kept[_once(self._places(members, f"the set {name!r}"))]
            for name, members in self._sets["NSET"].values()
        }
        cell_sets, face_sets = {}, {}
        facets = {name: [*self._of_surface(rows, kind, solid)] for name, rows in self.surfaces.items()}
        for name, members in self._sets["ELSET"].values():
            flat = self._flat(name, [number for number in members if number not in cell])
            inside = _once([cell[number] for number in members if number in cell])
            if len(inside) or not flat:
                cell_sets[name] = inside
            else:
                facets.setdefault(name, flat)
        for name, found in facets.items():
            faces = [
                (kept[self._places(nodes, f"the set {name!r}")].tolist(), count) for nodes, count in found
            ]
            node_sets.setdefault(name, _once([node for nodes, _ in faces for node in nodes]))
            if corners := frozenset(tuple(sorted(nodes[:count])) for nodes, count in faces if count > 2):
                face_sets[name] = corners
        return StructureMesh(
            source=source,
            kind=kind,
            points=unit * points[used],
            cells=kept[cells],
            unit=unit,
            unit_name=unit_name,
            node_numbers=own[used],
            cell_numbers=numbers,
            node_sets=node_sets,
            cell_sets=cell_sets,
            face_sets=face_sets,
            loose=own[~used],
            remarks=(*self._remarks, *self._passed_over()),
        )

    def _passed_over(self) -> Iterator[str]:
        """Yield a sentence on each word that is not known."""
        for notes in self._unknown.values():
            times = f" ({len(notes)} times)" if len(notes) > 1 else ""
            advice = "make sure that the model may do without"
            yield f"{notes[0]}{times} is not known and was passed over; {advice}."

    def _kind(self) -> ElementKind:
        """Return the one kind of the solid elements."""
        counts = Counter(kind for kind, _ in self.elements.values() if kind not in FLAT)
        if len(counts) != 1 or not counts.keys() <= DECK_KINDS.keys():
            named = {name: kind.name for name, kind in DECK_KINDS.items()}
            came = ", ".join(f"{count} {named.get(name, name)}" for name, count in counts.items())
            sentence = said("deck.kinds", known=", ".join(named.values()), came=came or "none that is solid")
            fail([str(self.path), *self._solids.values()][-1], sentence)
        return DECK_KINDS[next(iter(counts))]

    def _places(self, members: Iterable[int], what: str) -> list[int]:
        """Return the places of nodes by their numbers."""
        try:
            return [self._place[number] for number in members]
        except KeyError as lost:
            fail(str(self.path), f"{what} names node {lost}, which is not there.")

    @cached_property
    def _place(self) -> dict[int, int]:
        return {number: index for index, number in enumerate(self.nodes)}

    def _flat(self, name: str, members: list[int]) -> list[tuple[list[int], int]]:
        """Return nodes, of which so many are corners, of elements of a set that only name nodes and faces."""
        lost = next((number for number in members if number not in self.elements), None)
        if lost is not None:
            fail(str(self.path), f"the set {name!r} names element {lost}, which is not there.")
        section = self.sections.get(name.casefold())
        if members and section:
            fail(section, said("deck.section", count=len(members), name=name))
        return [(nodes, FLAT[kind][1]) for kind, nodes in map(self.elements.__getitem__, members)]

    def _of_surface(
        self, rows: list[tuple[str, str, str]], kind: ElementKind, solid: dict[int, list[int]]
    ) -> Iterator[tuple[list[int], int]]:
        """Yield the nodes of the faces of a surface, and how many of them, the first, are corners."""
        for where, member, face in rows:
            label, last = face.upper(), len(kind.faces)
            number = int(label[1:]) if re.fullmatch("S[1-6]", label) else 0
            if not 1 <= number <= last:
                fail(where, f"a face S1 to S{last} of {kind.name} is expected, but {short_repr(face)} came.")
            for element in {*self.named("ELSET", where, member)}:
                if element not in solid:
                    fail(where, f"the surface names element {element}, which is not a solid element.")
                nodes = [solid[element][node] for node in kind.face_nodes[number - 1]]
                yield nodes, len(kind.faces[number - 1])


def _once(numbers: list[int]) -> IntArray:
    """Return numbers rising, each once."""
    return np.unique(np.array(numbers, dtype=np.int64))


_LEAST_SINE = 1e-9


@dataclass(frozen=True)
class System:
    """A coordinate system.

    Attributes
    ----------
    origin : (3,)
        Its origin in space.
    axes : (3, 3)
        Its axes x, y, z in space, one in each row.
    kind : {"R", "C", "S"}
        What its coordinates are: x, y, z; radius, angle about z from x in degrees, z; or radius, angle from
        z, angle about z from x.
    """

    origin: FloatArray
    axes: FloatArray
    kind: str = "R"

    def place(self, coordinates: ArrayLike) -> FloatArray:
        """Place in space (..., 3) of coordinates (..., 3)."""
        given = np.asarray(coordinates, dtype=np.float64)
        if self.kind != "R":
            radius, angle, height = np.moveaxis(given, -1, 0)
            if self.kind == "S":
                polar, angle = np.deg2rad(angle), height
                radius, height = radius * np.sin(polar), radius * np.cos(polar)
            turn = np.deg2rad(angle)
            given = np.stack((radius * np.cos(turn), radius * np.sin(turn), height), axis=-1)
        return np.asarray(self.origin + given @ self.axes)


GLOBAL = System(np.zeros(3), np.eye(3))


def frame(where: str, points: FloatArray, order: tuple[int, int, int] = (0, 1, 2)) -> FloatArray:
    """Axes (3, 3) from an origin, a point on the first axis and one beside it, `points` (3, 3).

    `order` says which of the three found axes is x, y and z: the first, the one towards the last point, and
    the one at right angles to both.

    Raises
    ------
    MeshError
        If the points lie on a line.
    """
    first, second = points[1] - points[0], points[2] - points[0]
    size = np.linalg.norm(first) * np.linalg.norm(second)
    if not np.linalg.norm(np.cross(first, second)) > _LEAST_SINE * size:
        fail(where, "the three points of a coordinate system must not lie on a line.")
    return axes_of(first, second)[list(order)]
