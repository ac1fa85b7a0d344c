"""What a deck holds, nodes, elements and sets, as the readers of Abaqus and Nastran collect it.

Last its coordinate systems: points that are given by radii and angles, or along other axes.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from math import isfinite, nan
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fe.elements.kinds import KINDS, ElementKind
from fe.runtime.errors import MeshError
from reporting.toml_file import parse_toml

from .mesh import FileMesh

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MOST_NUMBERS = 5_000_000
"""Numbers that all sets may hold together: a short line can ask for any."""
_LARGEST_NUMBER = 2**53
_SHOWN = 60
_NO_EXPONENT = re.compile(r"(?<=[\d.])(?=[+-])")


@dataclass(frozen=True)
class Words:
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
    """

    mark: str
    harmless: frozenset[str]
    refused: dict[str, str]
    read: dict[str, list[str]]


def words_of(dialect: str) -> Words:
    """Return the words of "abaqus" or "nastran"."""
    text = resources.files("fe.structure").joinpath("deck_words.toml").read_text(encoding="utf-8")
    found = parse_toml(text, "deck_words.toml", MeshError)[dialect]
    refused = {word: group["remedy"] for group in found["refused"] for word in group["words"]}
    return Words(found["mark"], frozenset(found["harmless"]), refused, found.get("read", {}))


def fail(where: str, sentence: str) -> NoReturn:
    """Refuse a file; `where` begins the sentence."""
    raise MeshError(f"{where}: {sentence}")


def included(where: str, files: tuple[Path, ...], name: str) -> tuple[Path, ...]:
    """Return files that include one another and one that the last of them includes; none may come twice."""
    inner = (files[-1].parent / name).resolve()
    if inner in files:
        fail(where, f"{inner} includes itself.")
    return (*files, inner)


def shown(text: str) -> str:
    """Return what came as it stands in a sentence, cut where it is long."""
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def whole(where: str, text: str) -> int:
    """Return a whole number, or refuse."""
    try:
        number = int(text)
    except ValueError:
        fail(where, f"a whole number is expected, but {shown(text)} came.")
    if abs(number) > _LARGEST_NUMBER:
        fail(where, f"the number {shown(text)} is too large.")
    return number


def real(where: str, text: str) -> float:
    """Return a real number, or refuse; Fortran writes D for E, and Nastran leaves the E out."""
    try:
        number = float(_NO_EXPONENT.sub("E", text.upper().replace("D", "E")))
    except ValueError:
        number = nan
    if not isfinite(number):
        fail(where, f"a real number is expected, but {shown(text)} came.")
    return number


def one_kind(where: str, counts: Mapping[str, int]) -> ElementKind:
    """Return the one kind of elements of a mesh, whose elements of each kind of meshio's are counted."""
    readable = ", ".join(kind.name for kind in KINDS.values())
    names = {name: KINDS[name].name if name in KINDS else name for name in counts}
    came = ", ".join(f"{counts[name]} {title}" for name, title in names.items())
    if not counts or not counts.keys() <= KINDS.keys():
        fail(where, f"a mesh of {readable} is expected, but {came or 'none that is solid'} came.")
    if len(counts) > 1:
        fail(where, f"one kind of elements is expected, but {came} came; mesh it with tetrahedra alone.")
    return KINDS[next(iter(counts))]


class Deck:
    """Nodes, elements and sets by their numbers and names, while a deck is read."""

    def __init__(self, path: Path, words: Words) -> None:
        self.path = path
        self.nodes: dict[int, tuple[float, ...]] = {}
        self.elements: dict[int, tuple[ElementKind | None, list[int]]] = {}
        """Kind and nodes of each; those without a kind are flat and only name nodes and a face."""
        self.surfaces: dict[str, list[tuple[str, str, str]]] = {}
        self.sections: dict[str, str] = {}
        """Where a set of elements, by its name in lower case, got a thickness, an area or a material."""
        self.words = words
        self._sets: dict[str, dict[str, tuple[str, list[int]]]] = {"NSET": {}, "ELSET": {}}
        self._kinds: dict[str, str] = {}
        self._unknown: dict[str, list[str]] = {}
        self._room = _MOST_NUMBERS

    def word(self, word: str, where: str) -> None:
        """Pass over a word that is no part of the mesh; refuse what must not be lost, note the unknown."""
        if word in self.words.refused:
            fail(where, f"{self.words.mark}{word} {self.words.refused[word]}.")
        if word not in self.words.harmless:
            self._unknown.setdefault(word, []).append(where)

    def members(self, key: str, name: str) -> list[int]:
        """Return the members of a set of nodes (NSET) or elements (ELSET), to be added to."""
        return self._sets[key].setdefault(name.casefold(), (name, []))[1]

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

    def add_element(self, where: str, number: int, kind: ElementKind | None, nodes: list[int]) -> None:
        """Add an element."""
        if number in self.elements:
            fail(where, f"element {number} is there twice; delete one.")
        self.elements[number] = (kind, nodes)
        if kind is not None:
            self._kinds.setdefault(kind.file_type, where)

    def mesh(self) -> FileMesh:
        """Return the mesh of all that was added."""
        source = str(self.path)
        if not self._kinds:
            fail(source, "the deck holds no whole block of solid elements: was it cut off?")
        counts = Counter(kind.file_type for kind, _ in self.elements.values() if kind)
        kind = one_kind(list(self._kinds.values())[-1], counts)
        place = {number: index for index, number in enumerate(self.nodes)}

        def places(members: Iterable[int], what: str) -> list[int]:
            try:
                return [place[number] for number in members]
            except KeyError as lost:
                fail(source, f"{what} names node {lost}, which is not there.")

        solid = {number: nodes for number, (kind, nodes) in self.elements.items() if kind}
        cells = np.array([places(nodes, f"element {n}") for n, nodes in solid.items()], dtype=np.int64)
        cell = {number: index for index, number in enumerate(solid)}
        node_sets = {
            name: np.unique(np.array(places(members, f"the set {name!r}"), dtype=np.int64))
            for name, members in self._sets["NSET"].values()
        }
        cell_sets, face_sets = {}, {}
        for name, members in self._sets["ELSET"].values():
            lost = next((number for number in members if number not in self.elements), None)
            if lost is not None:
                fail(source, f"the set {name!r} names element {lost}, which is not there.")
            flat = [places(self.elements[n][1], f"element {n}") for n in members if n not in cell]
            section = self.sections.get(name.casefold())
            if flat and section:
                what = (
                    f"{len(flat)} bars, membranes or shells of the set {name!r} have a section and bear loads"
                )
                fail(section, f"{what}, but solids alone are read; delete one or the other.")
            inside = np.unique(np.array([cell[n] for n in members if n in cell], dtype=np.int64))
            if len(inside) or not flat:
                cell_sets[name] = inside
            else:
                face_sets[name] = frozenset(_corners(nodes) for nodes in flat)
                node_sets.setdefault(name, np.unique(np.concatenate(flat)))
        for name, rows in self.surfaces.items():
            face_sets[name] = self._faces(rows, kind, cells, cell)
        return FileMesh(
            kind=kind,
            points=np.array(list(self.nodes.values()), dtype=np.float64),
            node_numbers=np.array(list(self.nodes), dtype=np.int64),
            cells=cells,
            cell_numbers=np.array(list(solid), dtype=np.int64),
            node_sets=node_sets,
            cell_sets=cell_sets,
            face_sets=face_sets,
            remarks=tuple(
                f"{where[0]}: {self.words.mark}{word}{f' ({len(where)} times)' * (len(where) > 1)} is not "
                "known and was passed over; make sure that the model may do without."
                for word, where in self._unknown.items()
            ),
        )

    def _faces(
        self, rows: list[tuple[str, str, str]], kind: ElementKind, cells: IntArray, cell: dict[int, int]
    ) -> frozenset[tuple[int, ...]]:
        found: set[tuple[int, ...]] = set()
        for where, member, face in rows:
            label = face.upper()
            number = int(label[1:]) if re.fullmatch("S[1-6]", label) else 0
            if not 1 <= number <= len(kind.faces):
                last = len(kind.faces)
                fail(where, f"a face S1 to S{last} of {kind.name} is expected, but {shown(face)} came.")
            members = set(self.named("ELSET", where, member))
            for lost in members - cell.keys():
                fail(where, f"the surface names element {lost}, which is not a solid element.")
            inside = np.array([cell[element] for element in members], dtype=np.int64)
            corners = np.sort(cells[inside][:, kind.faces[number - 1]], axis=1)
            found.update(map(tuple, corners.tolist()))
        return frozenset(found)


def _corners(nodes: list[int]) -> tuple[int, ...]:
    """Corners of a surface element, rising; a line has none that bound a face."""
    count = {6: 3, 8: 4}.get(len(nodes), len(nodes))
    return tuple(sorted(nodes[:count]))


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
    third = np.cross(first, second)
    size = np.linalg.norm(first) * np.linalg.norm(second)
    if not np.linalg.norm(third) > _LEAST_SINE * size:
        fail(where, "the three points of a coordinate system must not lie on a line.")
    axes = np.array([first, np.cross(third, first), third])
    return np.asarray((axes / np.linalg.norm(axes, axis=1)[:, None])[list(order)])
