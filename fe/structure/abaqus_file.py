"""Reading the mesh of an input file of Abaqus or CalculiX (`.inp`): nodes, elements, sets and surfaces.

meshio reads such files as well, but neither NSET of *NODE, nor GENERATE over several lines, nor *SURFACE,
and it loses element sets of a deck of several blocks; nor does it name the line of a fault.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe.elements.kinds import KINDS
from reporting.section import shown

from .deck import FLAT, GLOBAL, Deck, System, fail, frame, lines_of, real, whole, words_of

_COMMENT = re.compile(r"^\s*\*\*.*")
_INCLUDE = re.compile(r"\s*\*\s*INCLUDE\s*,\s*INPUT\s*=(.*)", re.IGNORECASE)
_VARIANT = re.compile(r"(C3D\d+)(?:[IMR]?H?|T)")
"""Reduced, hybrid and other variants are the same cells; they are integrated here as the plain ones."""
_FLAT = {
    "T3D2": "line", "T3D3": "line3", "CPS3": "triangle", "CPS4": "quad", "CPS6": "triangle6", "CPS8": "quad8",
}  # fmt: skip
"""Elements by which Gmsh and others hand on lines and surfaces: they only name nodes and faces here."""
_TYPES = {kind.calculix: (kind.file_type, kind.node_count) for kind in KINDS.values()} | {
    name: (kind, FLAT[kind][0]) for name, kind in _FLAT.items()
}


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
            fail(block.where, f"*{block.keyword} with {shown(key)} is not read; write what it makes out.")
        if block.keyword == "NODE":
            _add_nodes(deck, block, system)
        elif block.keyword == "ELEMENT":
            _add_elements(deck, block)
        elif block.keyword == "SYSTEM":
            system = _system(block)
        elif block.keyword != "SURFACE":
            _add_members(deck, block)
        elif block.parameters.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            rows = [(where, values[0], (*values, "")[1]) for where, values in block.data]
            deck.surfaces[block.name("NAME")] = rows
    return deck


def _blocks(path: Path) -> Iterator[_Block]:
    found: list[tuple[str, list[str], list[tuple[str, list[str]]]]] = []
    for where, line in lines_of((path,), _COMMENT, _INCLUDE):
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


def _system(block: _Block) -> System:
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


def _add_elements(deck: Deck, block: _Block) -> None:
    name = block.name("TYPE").upper()
    variant = _VARIANT.fullmatch(name)
    plain = variant[1] if variant else name
    if plain not in _TYPES:
        readable = ", ".join(kind.calculix for kind in KINDS.values())
        fail(block.where, f"elements of type {shown(name)} cannot be read; {readable} and variants can.")
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
            fail(where, f"first, last and step are expected, but {shown(','.join(given))} came.")
        members.extend(deck.counted(where, range(first, last + 1, step)))
