"""Reading the mesh of an input file of Abaqus or CalculiX (`.inp`): nodes, elements, sets and surfaces.

meshio reads such files as well, but neither NSET of *NODE, nor GENERATE over several lines, nor *SURFACE,
and it loses element sets of a deck of several blocks; nor does it name the line of a fault.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from fe.runtime.errors import MeshError
from reporting.text_file import read_text

from .elements import KINDS, ElementKind
from .mesh import FileMesh

IntArray = NDArray[np.int64]

_KINDS = {
    "C3D4": "tetra", "C3D10": "tetra10", "C3D8": "hexahedron", "C3D20": "hexahedron20", "C3D6": "wedge",
}  # fmt: skip
_VARIANT = re.compile(r"(C3D\d+)(?:[IMR]?H?|T)")
"""Reduced, hybrid and other variants are the same cells; they are integrated here as the plain ones."""
_FLAT = {"T3D2": 2, "T3D3": 3, "CPS3": 3, "CPS4": 4, "CPS6": 6, "CPS8": 8}
"""Elements by which Gmsh and others hand on lines and surfaces: they only name nodes and faces here."""
_DEEPEST_INCLUDE = 5


@dataclass
class _Lines:
    """A keyword with its parameters, the lines of data below it, and where it stands."""

    keyword: str
    parameters: dict[str, str]
    where: str
    data: list[tuple[str, list[str]]] = field(default_factory=list)


def read_abaqus(path: Path) -> FileMesh:
    """Read the mesh of a deck; what is no mesh (materials, steps, loads) is passed over.

    Raises
    ------
    MeshError
        If it cannot be read; the sentence names the line.
    """
    reader = _Reader(path)
    for block in _blocks(path, _DEEPEST_INCLUDE):
        reader.take(block)
    return reader.mesh()


def _fail(where: str, sentence: str) -> NoReturn:
    raise MeshError(f"{where}: {sentence}")


def _blocks(path: Path, depth: int) -> Iterator[_Lines]:
    block: _Lines | None = None
    for number, line in enumerate(read_text(path, MeshError, what="mesh file").splitlines(), start=1):
        text = line.strip()
        where = f"{path}, line {number}"
        if not text or text.startswith("**"):
            continue
        if text.startswith("*"):
            if block is not None:
                yield block
            keyword, *rest = (part.strip() for part in text[1:].split(","))
            pairs = (part.partition("=") for part in rest if part)
            block = _Lines(
                " ".join(keyword.upper().split()),
                {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs},
                where,
            )
            if block.keyword == "INCLUDE":
                if not depth:
                    _fail(where, "more than five files include one another.")
                yield from _blocks(path.parent / block.parameters.get("INPUT", ""), depth - 1)
                block = None
        elif block is not None:
            block.data.append((where, [part.strip() for part in text.split(",")]))
    if block is not None:
        yield block


class _Reader:
    """Takes the blocks of a deck one after the other."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.nodes: dict[int, tuple[float, ...]] = {}
        self.elements: dict[int, list[int]] = {}
        self.kind: ElementKind | None = None
        self.flat: dict[int, list[int]] = {}
        self.sets: dict[str, dict[str, list[int]]] = {"NSET": {}, "ELSET": {}}
        self.surfaces: dict[str, list[tuple[str, str, str]]] = {}

    def take(self, block: _Lines) -> None:
        """Take one keyword with its data."""
        if block.keyword == "NODE":
            self._nodes(block)
        elif block.keyword == "ELEMENT":
            self._elements(block)
        elif block.keyword in ("NSET", "ELSET"):
            self._set(block)
        elif block.keyword == "SURFACE" and block.parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            name = self._name(block, "NAME")
            self.surfaces[name] = [(where, values[0], (*values, "")[1]) for where, values in block.data]
        elif block.keyword in ("PART", "INSTANCE"):
            _fail(
                block.where,
                f"a deck with *{block.keyword} is not read; write it without parts and instances.",
            )

    def _name(self, block: _Lines, key: str) -> str:
        if not block.parameters.get(key):
            _fail(block.where, f"*{block.keyword} must say {key}=a name.")
        return block.parameters[key]

    def _whole(self, where: str, text: str) -> int:
        try:
            return int(text)
        except ValueError:
            _fail(where, f"a whole number is expected, but {text!r} came.")

    def _nodes(self, block: _Lines) -> None:
        added = []
        for where, values in block.data:
            number = self._whole(where, values[0])
            try:
                place = tuple(float(value.upper().replace("D", "E")) for value in values[1:4] if value)
            except ValueError:
                _fail(where, f"the coordinates of a node are expected, but {','.join(values[1:])!r} came.")
            self.nodes[number] = (*place, *(3 - len(place)) * (0.0,))
            added.append(number)
        if block.parameters.get("NSET"):
            self.sets["NSET"].setdefault(block.parameters["NSET"], []).extend(added)

    def _elements(self, block: _Lines) -> None:
        name = self._name(block, "TYPE").upper()
        variant = _VARIANT.fullmatch(name)
        kind = KINDS.get(_KINDS.get(variant[1] if variant else "", ""))
        width = kind.node_count if kind else _FLAT.get(name)
        if width is None:
            readable = ", ".join(_KINDS)
            _fail(block.where, f"elements of type {name} cannot be read; {readable} and their variants can.")
        if kind and self.kind and kind is not self.kind:
            _fail(
                block.where,
                f"{kind.name} ({name}) stand beside {self.kind.name}; a mesh of one kind of elements is "
                "expected.",
            )
        self.kind = kind or self.kind
        values = [(where, self._whole(where, text)) for where, row in block.data for text in row if text]
        if len(values) % (width + 1):
            _fail(
                block.where,
                f"{len(values)} numbers below *ELEMENT are not a multiple of {width + 1} ({name}).",
            )
        added = []
        for start in range(0, len(values), width + 1):
            where, number = values[start]
            if number in self.elements or number in self.flat:
                _fail(where, f"element {number} is there twice.")
            nodes = [node for _, node in values[start + 1 : start + width + 1]]
            (self.elements if kind else self.flat)[number] = nodes
            added.append(number)
        if block.parameters.get("ELSET"):
            self.sets["ELSET"].setdefault(block.parameters["ELSET"], []).extend(added)

    def _set(self, block: _Lines) -> None:
        sets = self.sets[block.keyword]
        members: list[int] = sets.setdefault(self._name(block, block.keyword), [])
        for where, values in block.data:
            given = [value for value in values if value]
            if "GENERATE" in block.parameters:
                numbers = [self._whole(where, value) for value in given]
                if len(numbers) not in (2, 3) or min(numbers) < 1:
                    _fail(
                        where,
                        f"first, last and step are expected with GENERATE, but {','.join(given)!r} came.",
                    )
                members.extend(range(numbers[0], numbers[1] + 1, *numbers[2:]))
                continue
            for value in given:
                other = self._other(sets, value)
                members.extend([self._whole(where, value)] if other is None else other)

    @staticmethod
    def _other(sets: dict[str, list[int]], name: str) -> list[int] | None:
        return next((list(sets[key]) for key in sets if key.casefold() == name.casefold()), None)

    def mesh(self) -> FileMesh:
        """Return the mesh of all that was taken."""
        if self.kind is None:
            _fail(str(self.path), "the deck holds no whole block of solid elements: was it cut off?")
        numbers = np.array(list(self.nodes), dtype=np.int64)
        place = {number: index for index, number in enumerate(self.nodes)}
        cell = {number: index for index, number in enumerate(self.elements)}

        def node(number: int, what: str) -> int:
            if number not in place:
                _fail(str(self.path), f"{what} names node {number}, which is not there.")
            return place[number]

        cells = [
            [node(other, f"element {number}") for other in nodes] for number, nodes in self.elements.items()
        ]
        node_sets = {
            name: np.unique(np.array([node(n, f"the set {name!r}") for n in members], dtype=np.int64))
            for name, members in self.sets["NSET"].items()
        }
        cell_sets, face_sets = {}, {}
        for name, members in self.sets["ELSET"].items():
            lost = [number for number in members if number not in cell and number not in self.flat]
            if lost:
                _fail(str(self.path), f"the set {name!r} names element {lost[0]}, which is not there.")
            flat = [
                [node(n, f"element {number}") for n in self.flat[number]]
                for number in members
                if number in self.flat
            ]
            solid = np.unique(np.array([cell[n] for n in members if n in cell], dtype=np.int64))
            if len(solid) or not flat:
                cell_sets[name] = solid
            else:
                face_sets[name] = frozenset(_corners(nodes) for nodes in flat)
                node_sets.setdefault(name, np.unique(np.concatenate([np.array(n) for n in flat])))
        table = np.array(cells, dtype=np.int64)
        for name, rows in self.surfaces.items():
            face_sets[name] = self._faces(rows, self.kind, table, cell)
        return FileMesh(
            kind=self.kind,
            points=np.array(list(self.nodes.values()), dtype=np.float64),
            node_numbers=numbers,
            cells=table,
            cell_numbers=np.array(list(self.elements), dtype=np.int64),
            node_sets=node_sets,
            cell_sets=cell_sets,
            face_sets=face_sets,
        )

    def _faces(
        self, rows: list[tuple[str, str, str]], kind: ElementKind, cells: IntArray, cell: dict[int, int]
    ) -> frozenset[tuple[int, ...]]:
        found = set()
        for where, member, face in rows:
            label = face.upper()
            number = int(label[1:]) if label[:1] == "S" and label[1:].isdigit() else 0
            if not 1 <= number <= len(kind.faces):
                _fail(
                    where, f"a face S1 to S{len(kind.faces)} of {kind.name} is expected, but {face!r} came."
                )
            members = self._other(self.sets["ELSET"], member)
            for element in [self._whole(where, member)] if members is None else members:
                if element not in cell:
                    _fail(where, f"the surface names element {element}, which is not a solid element.")
                corners = cells[cell[element], list(kind.faces[number - 1])]
                found.add(tuple(sorted(corners.tolist())))
        return frozenset(found)


def _corners(nodes: list[int]) -> tuple[int, ...]:
    """Corners of a surface element, rising; a line has none that bound a face."""
    count = {6: 3, 8: 4}.get(len(nodes), len(nodes))
    return tuple(sorted(nodes[:count]))
