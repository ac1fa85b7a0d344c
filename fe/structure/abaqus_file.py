"""Reading the mesh of an input file of Abaqus or CalculiX (`.inp`): nodes, elements, sets and surfaces.

meshio reads such files as well, but neither NSET of *NODE, nor GENERATE over several lines, nor *SURFACE,
and it loses element sets of a deck of several blocks; nor does it name the line of a fault.
"""

import itertools
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from fe.runtime.errors import MeshError
from reporting.text_file import read_text

from .coordinates import GLOBAL, System, frame
from .deck import Deck, fail, real, shown, whole, words_of
from .elements import KINDS
from .mesh import FileMesh

_KINDS = {kind.calculix: kind for kind in KINDS.values()}
_VARIANT = re.compile(r"(C3D\d+)(?:[IMR]?H?|T)")
"""Reduced, hybrid and other variants are the same cells; they are integrated here as the plain ones."""
_FLAT = {"T3D2": 2, "T3D3": 3, "CPS3": 3, "CPS4": 4, "CPS6": 6, "CPS8": 8}
"""Elements by which Gmsh and others hand on lines and surfaces: they only name nodes and faces here."""
_DEEPEST_INCLUDE = 5


@dataclass
class _Block:
    """A keyword with its parameters, the lines of data below it, and where it stands."""

    keyword: str
    parameters: dict[str, str]
    where: str
    data: list[tuple[str, list[str]]] = field(default_factory=list)

    def name(self, key: str) -> str:
        """Return a parameter that must be there."""
        if not self.parameters.get(key):
            fail(self.where, f"*{self.keyword} must say {key}=a name.")
        return self.parameters[key]

    def rows(self, least: int, defaults: tuple[int, ...], what: str) -> Iterator[tuple[str, list[int]]]:
        """Yield the lines of data as whole numbers; of `what`, the first `least` must be given."""
        for where, values in self.data:
            if not all(values[:least]) or len(values) < least or any(values[len(defaults) :]):
                fail(where, f"{what} are expected, but {shown(','.join(values))} came.")
            given = [whole(where, text) if text else n for text, n in zip(values, defaults, strict=False)]
            yield where, [*given, *defaults[len(given) :]]


def read_abaqus(path: Path) -> FileMesh:
    """Read the mesh of a deck; what is no mesh (materials, steps, loads) is passed over.

    Raises
    ------
    MeshError
        If it cannot be read, or holds what the mesh would lose; the sentence names the line.
    """
    reader = _Reader(path)
    for block in _blocks(path, _DEEPEST_INCLUDE):
        reader.take(block)
    return reader.deck.mesh()


def _blocks(path: Path, depth: int) -> Iterator[_Block]:
    block: _Block | None = None
    head = ""
    lines = read_text(path, MeshError, what="mesh file", otherwise="latin-1").splitlines()
    for number, line in enumerate(lines, start=1):
        text = line.strip()
        where = f"{path}, line {number}"
        if not text or text.startswith("**"):
            continue
        if not text.startswith("*") and not head:
            if block is not None:
                block.data.append((where, [part.strip() for part in text.split(",")]))
            continue
        head += text
        if text.endswith(","):  # the parameters go on in the next line
            continue
        if block is not None:
            yield block
        keyword, *rest = (part.strip() for part in head[1:].split(","))
        pairs = (part.partition("=") for part in rest if part)
        block = _Block(
            " ".join(keyword.upper().split()),
            {" ".join(key.upper().split()): value.strip().strip('"') for key, _, value in pairs},
            where,
        )
        head = ""
        if block.keyword == "INCLUDE":
            if not depth:
                fail(where, "more than five files include one another.")
            yield from _blocks(path.parent / block.parameters.get("INPUT", ""), depth - 1)
            block = None
    if block is not None:
        yield block


class _Reader:
    """Takes the blocks of a deck one after the other."""

    def __init__(self, path: Path) -> None:
        self.deck = Deck(path, words_of("abaqus"))
        self.system = GLOBAL
        self._unsorted: set[str] = set()
        self._taken: dict[str, Callable[[_Block], None]] = {
            "NODE": self._nodes,
            "ELEMENT": self._elements,
            "NSET": self._set,
            "ELSET": self._set,
            "SURFACE": self._surface,
            "SYSTEM": self._system,
            "NGEN": self._ngen,
            "NFILL": self._nfill,
            "ELGEN": self._elgen,
        }

    def take(self, block: _Block) -> None:
        """Take one keyword with its data."""
        if block.keyword.endswith(" SECTION") and block.parameters.get("ELSET"):
            self.deck.sections.append((block.where, block.parameters["ELSET"]))
        if block.keyword not in self._taken:
            self.deck.word(block.keyword, block.where)
            return
        for key in block.parameters:
            if key not in self.deck.words.read[block.keyword]:
                fail(
                    block.where,
                    f"*{block.keyword} with {shown(key)} is not read; write nodes and elements out.",
                )
        self._taken[block.keyword](block)

    def _numbers(self, where: str, values: list[str]) -> list[float]:
        return [real(where, value) if value else 0.0 for value in values]

    def _system(self, block: _Block) -> None:
        """Set the system of the nodes below: origin, then a point on x, then one in the plane of x and y."""
        given = [number for where, values in block.data for number in self._numbers(where, values[:6])]
        if len(given) not in (0, 3, 6, 9):
            fail(
                block.where,
                f"one, two or three points are expected below *SYSTEM, but {len(given)} numbers came.",
            )
        points = np.zeros((3, 3))
        points[: len(given) // 3] = np.reshape(given, (-1, 3))
        if len(given) < 6:
            self.system = System(points[0], np.eye(3))
            return
        if len(given) == 6:  # z stays, and x is turned about it
            points[1, 2] = points[0, 2]
            points[2] = points[0] + np.cross((0.0, 0.0, 1.0), points[1] - points[0])
        self.system = System(points[0], frame(block.where, points))

    def _nodes(self, block: _Block) -> None:
        kind = block.parameters.get("SYSTEM", "R").upper()
        if kind not in ("R", "C"):
            fail(block.where, f"*NODE with SYSTEM={kind} is not read; give the nodes in SYSTEM=R or C.")
        system = replace(self.system, kind=kind)
        added = []
        for where, values in block.data:
            place = self._numbers(where, values[1:4])
            place += (3 - len(place)) * [0.0]
            added.append(whole(where, values[0]))
            plain = kind == "R" and self.system is GLOBAL
            self.deck.add_node(where, added[-1], place if plain else system.place(place))
        self._add(block, "NSET", added)

    def _add(self, block: _Block, key: str, members: Iterable[int]) -> None:
        """Add members to the set of nodes (NSET) or elements (ELSET) that a parameter names, if any."""
        if block.parameters.get(key):
            self.deck.members(key, block.parameters[key]).extend(members)

    def _elements(self, block: _Block) -> None:
        name = block.name("TYPE").upper()
        variant = _VARIANT.fullmatch(name)
        kind = _KINDS.get(variant[1]) if variant else None
        width = kind.node_count if kind else _FLAT.get(name)
        if width is None:
            fail(
                block.where,
                f"elements of type {shown(name)} cannot be read; {', '.join(_KINDS)} and their variants can.",
            )
        values = [(where, whole(where, text)) for where, row in block.data for text in row if text]
        if len(values) % (width + 1):
            fail(
                block.where,
                f"{len(values)} numbers below *ELEMENT are not a multiple of {width + 1} ({name}).",
            )
        added = []
        for start in range(0, len(values), width + 1):
            where, number = values[start]
            nodes = [node for _, node in values[start + 1 : start + width + 1]]
            self.deck.add_element(where, number, kind, nodes)
            added.append(number)
        self._add(block, "ELSET", added)

    def _set(self, block: _Block) -> None:
        key = block.keyword
        members = self.deck.members(key, block.name(key))
        if "GENERATE" in block.parameters:
            for where, (first, last, step) in block.rows(2, (0, 0, 1), "first, last and step"):
                members.extend(self.deck.span(where, first, last, step))
            return
        if "UNSORTED" in block.parameters:
            self._unsorted.add(block.parameters[key].casefold())
        for where, values in block.data:
            for value in filter(None, values):
                members.extend(self._named(key, where, value))
        if key == "NSET" and "ELSET" in block.parameters:
            elements = self.deck.found("ELSET", block.name("ELSET"))
            if elements is None:
                fail(block.where, f"there is no set of elements {shown(block.parameters['ELSET'])} above.")
            for number in elements:
                nodes = self.deck.element(block.where, number)[1]
                self.deck.take_room(block.where, len(nodes))
                members.extend(nodes)

    def _named(self, key: str, where: str, text: str) -> list[int]:
        """Return the members of a set, or a number alone."""
        found = self.deck.found(key, text)
        if found is None:
            return [whole(where, text)]
        self.deck.take_room(where, len(found))
        return list(found)

    def _surface(self, block: _Block) -> None:
        if block.parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            self.deck.surfaces[block.name("NAME")] = [
                (where, values[0], (*values, "")[1]) for where, values in block.data
            ]

    def _ngen(self, block: _Block) -> None:
        for where, (first, last, step) in block.rows(2, (0, 0, 1), "two nodes and a step"):
            numbers = self.deck.span(where, first, last, step)
            self._between(where, numbers)
            self._add(block, "NSET", numbers)

    def _between(self, where: str, numbers: Sequence[int]) -> None:
        """Add the nodes on the straight line between the first and the last of some, at equal distances."""
        start, end = (self.deck.place(where, number) for number in (numbers[0], numbers[-1]))
        for share, number in zip(np.linspace(0.0, 1.0, len(numbers))[1:-1], numbers[1:-1], strict=True):
            self.deck.add_node(where, number, start + share * (end - start))

    def _nfill(self, block: _Block) -> None:
        for where, values in block.data:
            if len(values) < 3:
                fail(where, "two sets of nodes, the number of intervals and a step of numbers are expected.")
            ends = [self._named("NSET", where, name) for name in values[:2]]
            ends = [
                part if name.casefold() in self._unsorted else sorted(set(part))
                for part, name in zip(ends, values, strict=False)
            ]
            count, step = whole(where, values[2]), whole(where, (*values, "1")[3] or "1")
            for first, last in zip(*ends, strict=False):
                between = self.deck.span(where, first, first + (count - 1) * step, step)
                self._between(where, (*between, last))
                self._add(block, "NSET", (*between, last))

    def _elgen(self, block: _Block) -> None:
        what = "an element, then numbers of elements with the steps of nodes and elements, up to three times"
        for where, (number, *steps) in block.rows(2, (0, 1, 1, 1, 1, 0, 0, 1, 0, 0), what):
            kind, nodes = self.deck.element(where, number)
            counts = steps[::3]
            if min(counts) < 1:
                fail(where, f"numbers of elements from 1 on are expected, but {counts} came.")
            self.deck.take_room(where, math.prod(counts) * len(nodes))
            for place in itertools.product(*map(range, counts)):
                shift, further = (sum(map(operator.mul, place, steps[n::3])) for n in (1, 2))
                if any(place):
                    self.deck.add_element(where, number + further, kind, [node + shift for node in nodes])
                self._add(block, "ELSET", [number + further])
