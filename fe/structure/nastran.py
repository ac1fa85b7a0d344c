"""Read meshes of Nastran from the bulk data of decks (`.bdf`, `.nas`, `.fem`).

meshio reads such files as well, but takes every grid point for Cartesian, ignores rigid elements,
and does not name the line of a fault.
"""

import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from fe.elements.kinds import KINDS
from fe.runtime.arrays import FloatArray
from reporting.formats.toml_file import short_repr

from .coordinates import GLOBAL, CoordinateSystem, axes_by_points
from .deck import Deck
from .deck_text import FLAT, fail, lines_of, real, whole, words_of

_CORNERS_OF_SOLIDS = {"CTETRA": 4, "CHEXA": 8, "CPENTA": 6}
_ORDER_FOR_MESHIO = {
    "hexahedron20": (*range(12), *range(16, 20), *range(12, 16)),
    "wedge15": (*range(9), *range(12, 15), *range(9, 12)),
}
"""Indices of nodes: Nastran counts the middles of the upright edges before those of the top."""

_FLAT_WORDS = words_of("nastran").flat
_SECTION_WORDS = re.compile("P(BAR|BEAM|BCOMP|COMP|LPLANE|ROD|SHEAR|SHELL|TUBE)[GL]?")
_SYSTEM_WORDS = re.compile(r"CORD([12])([RCS])")
_COMMENT = re.compile(r"\$.*")
_INCLUDE = re.compile(r"\s*INCLUDE\b(.*)", re.IGNORECASE)
_BEGIN = re.compile(r"\s*BEGIN\b", re.IGNORECASE)
_MARKER = re.compile(r"\+(?![\d.])")
_MOST_NESTED_SYSTEMS = 50
_MOST_REPLICAS = 1_000_000
_WHOLE_NUMBER = re.compile(r"[+-]?\d+")


class _Card(NamedTuple):
    """An entry of the bulk data.

    Attributes
    ----------
    keyword : str
        Such as `GRID`, in capital letters.
    where : str
        File and line of the entry.
    fields : list of str
        The fields after the keyword, with those of continuation lines.
    """

    keyword: str
    where: str
    fields: list[str]

    def integer(self, index: int, default: int = 0) -> int:
        """Return a field as an integer, or the default if it is empty or missing."""
        text = self.fields[index] if index < len(self.fields) else ""
        return whole(self.where, text) if text else default

    def floats(self, first: int, count: int) -> list[float]:
        """Return `count` fields from the index `first` on as floats, empty or missing ones as 0."""
        padded_fields = self.fields + [""] * (first + count)
        return [real(self.where, text) for text in padded_fields[first : first + count]]

    @property
    def is_by_grid_points(self) -> bool:
        """Whether the card defines a coordinate system by grid points, such as CORD1R."""
        return self.keyword[4] == "1"


def read_nastran(path: Path) -> Deck:
    """Read the mesh of a Nastran deck, with or without the sections above the bulk data.

    The elements of a property become the set `nastran:ref=` with the property's number.

    Raises
    ------
    MeshError
        If the deck cannot be read, or has an entry that the mesh would lose. The message names the
        line.
    """
    deck = Deck(path, words_of("nastran"))
    points = _GridPoints()
    for card in cards(path):
        keyword = card.keyword
        if keyword == "GRID":
            points.add_grid(card)
        elif keyword == "GRDSET":
            points.default_system = card.integer(1)
        elif _SYSTEM_WORDS.fullmatch(keyword):
            points.add_systems(card)
        elif keyword in _CORNERS_OF_SOLIDS or keyword in _FLAT_WORDS:
            _add_element(deck, card)
        elif _SECTION_WORDS.fullmatch(keyword):
            deck.sections[f"nastran:ref={card.integer(0)}"] = card.where
        else:
            deck.pass_over(keyword, card.where)
    for number, card in points.grids.items():
        deck.add_node(card.where, number, points.point(number, card.where).tolist())
    return deck


class _GridPoints:
    """The grid points of a deck, and the coordinate systems that they are given in.

    Systems may be defined by grid points, and these in other systems. So both are resolved only
    after the whole deck was read.

    Attributes
    ----------
    grids : dict of int to _Card
        The cards of the grid points by number.
    default_system : int
        The system of grid points that do not name one.
    """

    def __init__(self) -> None:
        self.grids: dict[int, _Card] = {}
        self.default_system = 0
        self._system_cards: dict[int, _Card] = {}
        self._systems: dict[int, CoordinateSystem] = {0: GLOBAL}

    def add_grid(self, card: _Card) -> None:
        """Add the card of a grid point."""
        number = card.integer(0)
        if self.grids.setdefault(number, card).fields != card.fields:
            fail(card.where, f"the grid point {number} is defined twice; delete one definition.")

    def add_systems(self, card: _Card) -> None:
        """Add the coordinate systems of a card; a card by grid points may hold two."""
        holds_two = card.is_by_grid_points and card.integer(4) != 0
        for first_field in (0, 4) if holds_two else (0,):
            number = card.integer(first_field)
            self._system_cards[number] = card._replace(fields=card.fields[first_field:])

    def point(self, number: int, where: str, depth: int = 0) -> FloatArray:
        """Return the global coordinates (3,) of a grid point.

        `where` is the file and line that refer to it, for the error message; `depth` is the number
        of coordinate systems that are being resolved.
        """
        if number not in self.grids:
            fail(where, f"the grid point {number} is not defined.")
        card = self.grids[number]
        system = self._system(card.integer(1, self.default_system), card.where, depth)
        return system.to_space(card.floats(2, 3))

    def _system(self, number: int, where: str, depth: int) -> CoordinateSystem:
        """Return the coordinate system of a number, with those it refers to resolved.

        `where` is the file and line that refer to it, for the error message. `depth` is the number
        of coordinate systems that are being resolved; if it is large, they refer to each other in a
        circle.
        """
        if number in self._systems:
            return self._systems[number]
        if number not in self._system_cards:
            fail(where, f"the coordinate system {number} is not defined.")
        if depth > _MOST_NESTED_SYSTEMS:
            fail(
                where,
                f"the coordinate system {number} refers to itself, or to a chain of more than "
                f"{_MOST_NESTED_SYSTEMS} others.",
            )
        card = self._system_cards[number]
        # rows of `points`: the origin, a point on z, and one in the plane of x and z
        if card.is_by_grid_points:
            three_points = [
                self.point(card.integer(field), card.where, depth + 1) for field in (1, 2, 3)
            ]
            points = np.array(three_points)
        else:
            reference = self._system(card.integer(1), card.where, depth + 1)
            points = reference.to_space(np.reshape(card.floats(2, 9), (3, 3)))
        # hence the axes are found in the order z, x, y; `order` puts them in the order x, y, z
        axes = axes_by_points(card.where, points, order=(1, 2, 0))
        kind = card.keyword[5]
        self._systems[number] = CoordinateSystem(points[0], axes, kind)
        return self._systems[number]


def _add_element(deck: Deck, card: _Card) -> None:
    """Add an element, also to the set of its property."""
    number = card.integer(0)
    if card.keyword in _FLAT_WORDS:
        meshio_name = _FLAT_WORDS[card.keyword]
        node_count = FLAT[meshio_name].node_count
        nodes = [card.integer(field) for field in range(2, 2 + node_count)]
    else:
        meshio_name, nodes = _solid_element(card)
    deck.add_element(card.where, number, meshio_name, nodes)
    deck.members("ELSET", f"nastran:ref={card.integer(1, number)}").append(number)


def _solid_element(card: _Card) -> tuple[str, list[int]]:
    """Return the meshio type of a solid element, and its node numbers in the order of meshio."""
    fields = [card.integer(field) for field in range(2, len(card.fields))]
    nodes = [node for node in fields if node]
    corner_count = _CORNERS_OF_SOLIDS[card.keyword]
    kinds = {kind.node_count: kind for kind in KINDS.values() if len(kind.corners) == corner_count}
    if len(nodes) not in kinds:
        counts = " or ".join(str(count) for count in kinds)
        fail(
            card.where,
            f"{card.keyword} {card.integer(0)} must have {counts} nodes, but {len(nodes)} were "
            "given.",
        )
    meshio_name = kinds[len(nodes)].file_type
    order = _ORDER_FOR_MESHIO.get(meshio_name, range(len(nodes)))
    return meshio_name, [nodes[place] for place in order]


class _Line(NamedTuple):
    """A line of the bulk data, with the marker that names its continuation."""

    where: str
    head: str
    fields: list[str]
    marker: str

    @property
    def is_continuation(self) -> bool:
        """Whether the line continues another one."""
        return not self.head or self.head[0] in "+*"

    @property
    def name(self) -> str:
        """The marker of the line that this one continues; empty for the previous line."""
        return self.head[1:].upper()


def cards(path: Path) -> list[_Card]:
    """Return the entries of the bulk data, each with the fields of its continuation lines.

    A continuation without a name belongs to the line above it. One with a name belongs to the line
    that ends with this name as its marker, which may be above or below.
    """
    lines = _bulk_lines(path)
    finished_cards: list[_Card] = []
    waiting_cards: dict[str, _Card] = {}  # cards whose last line ends with a marker, by the marker
    early_lines: dict[
        str, _Line
    ] = {}  # continuations that stand above the line they belong to, by name
    card: _Card | None = None
    marker = ""
    markers_below = Counter(line.marker for line in lines)
    names_below = Counter(line.name for line in lines if line.is_continuation)
    for line in lines:
        markers_below[line.marker] -= 1
        if not line.is_continuation:
            card = _Card(
                line.head.upper().rstrip("*_"), line.where, line.fields
            )  # meshio writes CTETRA_
            finished_cards.append(card)
        else:
            names_below[line.name] -= 1
            # more lines below end with the name than continuations below ask for one: one of them
            # is mine
            belongs_below = bool(line.name) and markers_below[line.name] > names_below[line.name]
            if line.name in waiting_cards:
                card = waiting_cards.pop(line.name)
            elif belongs_below:
                early_lines[line.name] = line
                card = None
                marker = line.marker
                continue
            elif card is None or (line.name and marker):
                _refuse_continuation(line)
            card.fields.extend(line.fields)
        # continuations that stood above follow here, one after the other
        marker = line.marker
        while marker in early_lines:
            continuation = early_lines.pop(marker)
            card.fields.extend(continuation.fields)
            marker = continuation.marker
        if marker:
            waiting_cards[marker] = card
    for line in early_lines.values():
        _refuse_continuation(line)
    return finished_cards


def _bulk_lines(path: Path) -> list[_Line]:
    """Return the lines of the bulk data up to ENDDATA, with repetitions written out."""
    lines = list(lines_of((path,), _COMMENT, _INCLUDE))
    start = 0
    for number, (_, text) in enumerate(lines, start=1):
        if _BEGIN.match(text):
            start = number
            break
    bulk_lines: list[_Line] = []
    for where, text in lines[start:]:
        head, *fields, end = _fields(where, text.expandtabs(8))
        if head.upper().startswith("ENDDATA"):
            break
        line = _Line(where, head, fields, end.lstrip("+*").upper())
        if head.startswith("="):
            bulk_lines += _replicated(line, bulk_lines)
        else:
            bulk_lines.append(line)
    return bulk_lines


def _replicated(line: _Line, lines_above: list[_Line]) -> list[_Line]:
    """Write out a line that repeats the line above, because a field or its head is `=`.

    A field `=` has the value of the line above, and so have all fields from `==` on; a field `*(i)`
    has that value plus i. A line `=n` stands for n lines with the increments of the line above.
    """
    count_text = line.head.lstrip("=").strip("()")
    if not lines_above or (count_text and len(lines_above) < 2):
        fail(
            line.where, f"the line {short_repr(line.head)} repeats a line above, but none is there."
        )
    previous = lines_above[-1]
    if not count_text:
        return [_with_changed_fields(line, previous)]
    count = whole(line.where, count_text)
    before = lines_above[-2]
    replicas = []
    for _ in range(min(count, _MOST_REPLICAS)):
        fields = [
            _incremented(line.where, last, _increment(line.where, first, last))
            for first, last in zip(before.fields, previous.fields, strict=True)
        ]
        before = previous
        previous = previous._replace(where=line.where, fields=fields)
        replicas.append(previous)
    if count > _MOST_REPLICAS:
        fail(
            line.where, f"at most {_MOST_REPLICAS:,} repetitions are read, but {count:,} are asked."
        )
    return replicas


def _with_changed_fields(line: _Line, previous: _Line) -> _Line:
    """Return the previous line with the fields changed that a line states."""
    fields = list(previous.fields)
    for number, text in enumerate(line.fields[: len(fields)]):
        if text == "==":
            break
        if text.startswith("*"):
            fields[number] = _incremented(line.where, fields[number], text[1:].strip("()"))
        elif text != "=":
            fields[number] = text
    return previous._replace(where=line.where, fields=fields)


def _increment(where: str, first: str, last: str) -> str:
    """Return by how much a field grows from one line to the next; 0 for equal texts."""
    if first == last:
        return "0"
    if _WHOLE_NUMBER.fullmatch(last):
        return str(whole(where, last) - whole(where, first))
    return repr(real(where, last) - real(where, first))


def _incremented(where: str, text: str, increment: str) -> str:
    """Return a field with an increment added; an integer stays one."""
    if increment == "0":
        return text
    if _WHOLE_NUMBER.fullmatch(text):
        return str(whole(where, text) + whole(where, increment))
    return repr(real(where, text) + real(where, increment))


def _refuse_continuation(line: _Line) -> NoReturn:
    """Raise the error for a continuation that belongs to no line."""
    fail(
        line.where,
        f"the continuation {short_repr(line.head)} follows no line that it could continue.",
    )


def _fields(where: str, text: str) -> list[str]:
    """Split a line of Nastran bulk data into its keyword, values and continuation marker.

    The line is in free format, with commas, or in fixed format, in columns of 8 or 16 characters.
    It has eight values, or four if its keyword has a `*`. Absent fields are empty texts.
    """
    if "," not in text:
        return _fields_in_columns(text)
    fields = [field.strip() for field in text.split(",")]
    marker = fields.pop() if _MARKER.match(fields[-1]) else ""
    value_count = 4 if "*" in fields[0] else 8
    most_fields = value_count + 2  # the keyword, the values and the marker
    if len(fields) > most_fields:
        fail(
            where,
            f"a line of at most {most_fields} fields is expected, but {len(fields)} were given.",
        )
    missing_fields = most_fields - len(fields)
    fields += [""] * missing_fields
    if marker:
        fields[-1] = marker
    return fields


def _fields_in_columns(text: str) -> list[str]:
    """Split a line in fixed format, as `_fields` does."""
    word = text[:8]
    marker = text[72:]
    width = 16 if "*" in word else 8
    fields = [word]
    for start in range(8, 72, width):
        fields.append(text[start : start + width])
    fields.append(marker)
    return [field.strip() for field in fields]
