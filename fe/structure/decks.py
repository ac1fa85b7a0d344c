"""Reading the meshes of decks: input files of Abaqus or CalculiX (`.inp`), and the bulk data of Nastran.

meshio reads such files as well, but of Abaqus neither NSET of *NODE, nor GENERATE over several lines, nor
*SURFACE, and it loses element sets of a deck of several blocks; of Nastran it takes every grid point for
Cartesian and passes rigid elements over. Nor does it name the line of a fault.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from fe.elements.kinds import DECK_KINDS, KINDS
from fe.runtime.arrays import FloatArray
from reporting.toml_file import short_repr

from .deck import FLAT, GLOBAL, Deck, System, fail, frame, lines_of, real, whole, words_of

_ABAQUS_COMMENT = re.compile(r"^\s*\*\*.*")
_ABAQUS_INCLUDE = re.compile(r"\s*\*\s*INCLUDE\s*,\s*INPUT\s*=(.*)", re.IGNORECASE)
_MESHIO_NAMES = {"C3D8RH": "C3D8", "C3D10MH": "C3D10", "C3D20RH": "C3D20"}
"""What meshio calls hexahedra and tetrahedra that are no special ones."""
_SAME_STIFFNESS = re.compile(r"(C3D(?:4|6|8|10|15|20|20R))[HT]")
"""Hybrid elements, and those with a temperature: the plain ones where the material is compressible."""
_VARIANT = re.compile(r"(C3D\d+)[A-Z]+")
_OTHER_STIFFNESS = {
    "C3D8I": "enhanced by incompatible modes and softer in bending",
    "C3D8R": "integrated at one point and softer in bending",
    "C3D10M": "modified for contact",
}
_TYPES = {kind.calculix: (name, kind.node_count) for name, kind in DECK_KINDS.items()}
_TYPES |= {name: (kind, FLAT[kind][0]) for name, kind in words_of("abaqus").flat.items()}


class _Block(NamedTuple):
    """A keyword with its parameters, the lines of data below it, and where it stands."""

    where: str
    keyword: str
    parameters: dict[str, str]
    data: list[tuple[str, list[str]]]

    def name(self, key: str) -> str:
        """Return a parameter that must be there."""
        if not self.parameters.get(key):
            fail(self.where, f"*{self.keyword} must say {key}=a name.")
        return self.parameters[key]


def read_abaqus(path: Path) -> Deck:
    """Read the mesh of a deck; what is no mesh (materials, steps, loads) is passed over.

    Raises
    ------
    MeshError
        If it cannot be read, or holds what the mesh would lose; the sentence names the line.
    """
    words = words_of("abaqus")
    deck, system = Deck(path, words), GLOBAL
    for block in _blocks(path):
        if block.keyword.endswith(" SECTION"):
            deck.sections[block.parameters.get("ELSET", "").casefold()] = block.where
        if block.keyword not in words.read:
            deck.word(block.keyword, block.where)
            continue
        for key in (key for key in block.parameters if key not in words.read[block.keyword]):
            fail(
                block.where, f"*{block.keyword} with {short_repr(key)} is not read; write what it makes out."
            )
        if block.keyword == "NODE":
            _add_nodes(deck, block, system)
        elif block.keyword == "ELEMENT":
            _add_elements(deck, block)
        elif block.keyword == "SYSTEM":
            system = _system_of(block)
        elif block.keyword != "SURFACE":
            _add_members(deck, block)
        elif block.parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            rows = [(where, values[0], (*values, "")[1]) for where, values in block.data]
            deck.surfaces[block.name("NAME")] = rows
    return deck


def _blocks(path: Path) -> Iterator[_Block]:
    found: list[tuple[str, list[str], list[tuple[str, list[str]]]]] = []
    for where, line in lines_of((path,), _ABAQUS_COMMENT, _ABAQUS_INCLUDE):
        text = line.strip()
        if text.startswith("*"):
            found.append((where, [text[1:]], []))
        elif found and not found[-1][2] and found[-1][1][-1].endswith(","):  # the parameters go on
            found[-1][1].append(text)
        elif found:
            found[-1][2].append((where, [part.strip() for part in text.split(",")]))
    for where, head, data in found:
        keyword, *rest = (" ".join(part.split()) for part in "".join(head).split(","))
        pairs = (part.partition("=") for part in rest if part)
        given = {key.strip().upper(): value.strip().strip('"') for key, _, value in pairs}
        yield _Block(where, keyword.upper(), given, data)


def _system_of(block: _Block) -> System:
    """Return the system of the nodes below: origin, then a point on x, then one in the plane of x and y."""
    rows = [(where, ",".join(values).rstrip(",").split(",")) for where, values in block.data]
    given = [real(where, text) for where, values in rows for text in values]
    if len(given) not in (0, 3, 6, 9):
        fail(block.where, f"*SYSTEM needs one, two or three points, but {len(given)} numbers came.")
    points = np.zeros((3, 3))
    points.flat[: len(given)] = given
    if len(given) < 6:
        points[1:] = points[0] + np.eye(3)[:2]
    elif len(given) < 9:  # z stays, and x is turned about it
        points[1, 2] = points[0, 2]
        points[2] = points[0] + np.cross((0.0, 0.0, 1.0), points[1] - points[0])
    return System(points[0], frame(block.where, points))


def _add_nodes(deck: Deck, block: _Block, system: System) -> None:
    kind = block.parameters.get("SYSTEM", "R").upper()
    if kind not in ("R", "C"):
        fail(block.where, f"*NODE with SYSTEM={kind} is not read; give the nodes in SYSTEM=R or C.")
    numbers = [whole(where, values[0]) for where, values in block.data]
    given = [[real(where, text) for text in (*values[1:], "", "", "")[:3]] for where, values in block.data]
    places = replace(system, kind=kind).place(np.reshape(given, (-1, 3)))
    for (where, _), number, place in zip(block.data, numbers, places.tolist(), strict=True):
        deck.add_node(where, number, place)
    if "NSET" in block.parameters:
        deck.members("NSET", block.name("NSET")).extend(numbers)


def _plain_type(name: str, where: str) -> str:
    """Return the element that is built for a type of a deck; refuse one that is none of ours."""
    same = _SAME_STIFFNESS.fullmatch(name)
    plain = _MESHIO_NAMES.get(name) or (same[1] if same else name)
    if plain not in _TYPES:
        readable = ", ".join(kind.calculix for kind in DECK_KINDS.values())
        variant = _VARIANT.fullmatch(name)
        if variant is None or variant[1] not in _TYPES:
            fail(where, f"elements of type {short_repr(name)} cannot be read; {readable} can.")
        why = f"they are {_OTHER_STIFFNESS.get(name, 'other elements')}, not {variant[1]}"
        remedy = f"write {variant[1]} if that is meant"
        if variant[1] == "C3D8":
            remedy = f"mesh with second-order elements (C3D20, C3D20R or C3D10), or {remedy}"
        fail(where, f"elements of type {name} cannot be read: {why}; {remedy}. {readable} can be read.")
    return plain


def _add_elements(deck: Deck, block: _Block) -> None:
    name = block.name("TYPE").upper()
    plain = _plain_type(name, block.where)
    if plain != name:
        deck.remark(f"{block.where}: elements of type {name} are built as {plain}.")
    kind, width = _TYPES[plain]
    numbers = [(where, whole(where, text)) for where, row in block.data for text in row if text]
    if len(numbers) % (width + 1):
        fail(block.where, f"{len(numbers)} numbers are not a multiple of {width + 1}, as {name} needs.")
    added = []
    for start in range(0, len(numbers), width + 1):
        (where, number), *nodes = numbers[start : start + width + 1]
        deck.add_element(where, number, kind, [node for _, node in nodes])
        added.append(number)
    if "ELSET" in block.parameters:
        deck.members("ELSET", block.name("ELSET")).extend(added)


def _add_members(deck: Deck, block: _Block) -> None:
    members = deck.members(block.keyword, block.name(block.keyword))
    for where, values in block.data:
        given = [value for value in values if value]
        if "GENERATE" not in block.parameters:
            for value in given:
                members.extend(deck.named(block.keyword, where, value))
            continue
        first, last, step = [*(whole(where, value) for value in given), 1, 0, 0][:3]
        if len(given) not in (2, 3) or first < 1 or step < 1:
            fail(where, f"first, last and step are expected, but {short_repr(','.join(given))} came.")
        members.extend(deck.counted(where, range(first, last + 1, step)))


_SOLIDS = {"CTETRA": 4, "CHEXA": 8, "CPENTA": 6}
"""Solid elements with the number of their corners."""
_ORDER = {
    "hexahedron20": (*range(12), *range(16, 20), *range(12, 16)),
    "wedge15": (*range(9), *range(12, 15), *range(9, 12)),
}
"""Nastran counts the middles of the upright edges before those of the top."""
_NASTRAN_FLAT = words_of("nastran").flat
_SECTIONS = re.compile("P(BAR|BEAM|BCOMP|COMP|LPLANE|ROD|SHEAR|SHELL|TUBE)[GL]?")
_SYSTEM = re.compile(r"CORD([12])([RCS])")
_NASTRAN_COMMENT = re.compile(r"\$.*")
_NASTRAN_INCLUDE = re.compile(r"\s*INCLUDE\b(.*)", re.IGNORECASE)
_BEGIN = re.compile(r"\s*BEGIN\b", re.IGNORECASE)
_MARKER = re.compile(r"\+(?![\d.])")
_DEEPEST = 50


class _Card(NamedTuple):
    """A word of the bulk data, where it stands, and its fields from the second on, without continuations."""

    word: str
    where: str
    fields: list[str]

    def whole(self, number: int, default: int = 0) -> int:
        """Return a field as a whole number."""
        text = self.fields[number] if number < len(self.fields) else ""
        return whole(self.where, text) if text else default

    def reals(self, first: int, count: int) -> list[float]:
        """Return fields as real numbers; what is left out is zero."""
        given = (self.fields + [""] * (first + count))[first : first + count]
        return [real(self.where, text) for text in given]


def read_nastran(path: Path) -> Deck:
    """Read the mesh of a deck: its bulk data, with or without the sections above it.

    The elements of a property are the set `nastran:ref=` and its number.

    Raises
    ------
    MeshError
        If it cannot be read, or holds what the mesh would lose; the sentence names the line.
    """
    deck = Deck(path, words_of("nastran"))
    systems, grids, system_of_grids = dict[int, _Card](), dict[int, _Card](), 0
    for card in cards(path):
        word = card.word
        if word == "GRID":
            if grids.setdefault(card.whole(0), card).fields != card.fields:
                fail(card.where, f"the grid point {card.whole(0)} is there twice; delete one.")
        elif word == "GRDSET":
            system_of_grids = card.whole(1)
        elif _SYSTEM.fullmatch(word):
            for first in (0, 4) if word[4] == "1" and card.whole(4) else (0,):
                systems[card.whole(first)] = card._replace(fields=card.fields[first:])
        elif word in _SOLIDS or word in _NASTRAN_FLAT:
            _add_element(deck, card)
        elif _SECTIONS.fullmatch(word):
            deck.sections[f"nastran:ref={card.whole(0)}"] = card.where
        else:
            deck.word(word, card.where)

    # Coordinate systems may be given by grid points, and these in other systems.
    def place(number: int, where: str, depth: int = 0) -> FloatArray:
        if number not in grids:
            fail(where, f"the grid point {number} is not there.")
        card = grids[number]
        return system(card.whole(1, system_of_grids), card.where, depth).place(card.reals(2, 3))

    known: dict[int, System] = {0: GLOBAL}

    def system(number: int, where: str, depth: int) -> System:
        if number in known:
            return known[number]
        if number not in systems:
            fail(where, f"the coordinate system {number} is not there.")
        if depth > _DEEPEST:
            fail(where, f"the coordinate system {number} rests on itself, or on too many others.")
        card = systems[number]
        if card.word[4] == "1":
            points = np.array([place(card.whole(field), card.where, depth + 1) for field in (1, 2, 3)])
        else:
            reference = system(card.whole(1), card.where, depth + 1)
            points = reference.place(np.reshape(card.reals(2, 9), (3, 3)))
        axes = frame(card.where, points, (1, 2, 0))  # origin, a point on z, one in the plane of x and z
        known[number] = System(points[0], axes, card.word[5])
        return known[number]

    for number, card in grids.items():
        deck.add_node(card.where, number, place(number, card.where))
    return deck


def _add_element(deck: Deck, card: _Card) -> None:
    number, kind = card.whole(0), _NASTRAN_FLAT.get(card.word)
    if kind is not None:
        nodes = [card.whole(field) for field in range(2, 2 + FLAT[kind][0])]
    else:
        nodes = [node for node in map(card.whole, range(2, len(card.fields))) if node]
        kinds = {kind.node_count: kind for kind in KINDS.values() if len(kind.corners) == _SOLIDS[card.word]}
        if len(nodes) not in kinds:
            counts = " or ".join(map(str, kinds))
            fail(card.where, f"{card.word} {number} must have {counts} nodes, but {len(nodes)} came.")
        kind = kinds[len(nodes)].file_type
        nodes = [nodes[place] for place in _ORDER.get(kind, range(len(nodes)))]
    deck.add_element(card.where, number, kind, nodes)
    deck.members("ELSET", f"nastran:ref={card.whole(1, number)}").append(number)


class _Line(NamedTuple):
    """A line of the bulk data: its head, its fields, and the marker of the line that continues it."""

    where: str
    head: str
    fields: list[str]
    marker: str

    @property
    def is_continuation(self) -> bool:
        """Whether it continues another line."""
        return not self.head or self.head[0] in "+*"

    @property
    def name(self) -> str:
        """The marker of the line that it continues; empty where that is the one before."""
        return self.head[1:].upper()


def cards(path: Path) -> list[_Card]:
    """Return the entries of the bulk data of a file, each with the fields of its continuations.

    A continuation without a name belongs to the line above it. One with a name belongs to the line that
    ends with this name as its marker, which may stand above or below.
    """
    lines = _bulk_lines(path)
    finished: list[_Card] = []
    waiting_cards: dict[str, _Card] = {}  # cards whose last line ends with a marker, by the marker
    early_lines: dict[str, _Line] = {}  # continuations that stand above the line they belong to, by name
    card: _Card | None = None
    marker = ""
    markers_below = Counter(line.marker for line in lines)
    names_below = Counter(line.name for line in lines if line.is_continuation)
    for line in lines:
        markers_below[line.marker] -= 1
        if not line.is_continuation:
            card = _Card(line.head.upper().rstrip("*_"), line.where, line.fields)  # meshio writes CTETRA_
            finished.append(card)
        else:
            names_below[line.name] -= 1
            # more lines below end with the name than continuations below ask for one: one of them is mine
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
    return finished


def _bulk_lines(path: Path) -> list[_Line]:
    """Return the lines of the bulk data up to ENDDATA."""
    lines = [*lines_of((path,), _NASTRAN_COMMENT, _NASTRAN_INCLUDE)]
    start = next((number for number, (_, text) in enumerate(lines, start=1) if _BEGIN.match(text)), 0)
    bulk: list[_Line] = []
    for where, text in lines[start:]:
        head, *fields, end = _fields(where, text.expandtabs(8))
        if head.upper().startswith("ENDDATA"):
            break
        bulk.append(_Line(where, head, fields, end.lstrip("+*").upper()))
    return bulk


def _refuse_continuation(line: _Line) -> NoReturn:
    fail(line.where, f"the continuation {short_repr(line.head)} stands behind no line that it continues.")


def _fields(where: str, text: str) -> list[str]:
    """Return the word of a line, its four (wide) or eight fields, and the marker of its continuation."""
    if "," in text:
        given = [part.strip() for part in text.split(",")]
        count = 4 if "*" in given[0] else 8
        marker = given.pop() if _MARKER.match(given[-1]) else ""
        if len(given) > count + 2:
            fail(where, f"a line of at most {count + 2} fields is expected, but {len(given)} came.")
        given += [""] * (count + 2 - len(given))
        return [*given[:-1], marker or given[-1]]
    count, width = (4, 16) if "*" in text[:8] else (8, 8)
    middle = [text[8 + width * number : 8 + width * (number + 1)].strip() for number in range(count)]
    return [text[:8].strip(), *middle, text[72:].strip()]
