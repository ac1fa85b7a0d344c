"""Nodes, elements and sets of a deck, with elements of any type."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fe.runtime.arrays import FloatArray
from fe.structure.abaqus import KeywordBlock
from fe.structure.deck_text import fail, whole

_NODES_OF_TYPE = {
    "B31": 2,
    "B31R": 2,
    "B32": 3,
    "B32R": 3,
    "DASHPOTA": 2,
    "DCOUP3D": 1,
    "GAPUNI": 2,
    "MASS": 1,
    "SPRING1": 1,
    "SPRING2": 2,
    "SPRINGA": 2,
    "T2D2": 2,
    "T3D2": 2,
    "T3D3": 3,
}
"""Number of nodes of element types whose names do not contain it."""
_COUNT_IN_NAME = re.compile(r"(?:C3D|CPS|CPE|CAX|M3D|S)(\d+)[A-Z]*")


@dataclass(frozen=True)
class TypedElement:
    """An element: its type in capital letters, and the numbers of its nodes."""

    type_name: str
    nodes: tuple[int, ...]

    @property
    def has_rotations(self) -> bool:
        """Whether the nodes bear moments, as those of shells and beams do."""
        return re.fullmatch(r"S\d.*|B\d.*", self.type_name) is not None


@dataclass
class DeckMesh:
    """The mesh of a deck.

    Attributes
    ----------
    points : dict of int to (3,) array
        Position of each node, in the deck's unit of length.
    elements : dict of int to TypedElement
        The elements by their numbers.
    node_sets, element_sets : dict of str to list of int
        Members of each set, in the order of the deck, by the set's name in capital letters.
    """

    points: dict[int, FloatArray] = field(default_factory=dict)
    elements: dict[int, TypedElement] = field(default_factory=dict)
    node_sets: dict[str, list[int]] = field(default_factory=dict)
    element_sets: dict[str, list[int]] = field(default_factory=dict)

    @cached_property
    def axisymmetric_nodes(self) -> frozenset[int]:
        """The nodes of axisymmetric elements."""
        return frozenset(
            node
            for element in self.elements.values()
            if element.type_name.startswith("CAX")
            for node in element.nodes
        )

    def nodes_named(self, text: str, where: str) -> list[int]:
        """Return the nodes of a set, or the node with this number."""
        return _members(self.node_sets, text, where)

    def elements_named(self, text: str, where: str) -> list[int]:
        """Return the elements of a set, or the element with this number."""
        return _members(self.element_sets, text, where)


def read_deck_mesh(blocks: Sequence[KeywordBlock]) -> DeckMesh:
    """Read nodes, elements and sets from the blocks of a deck.

    Raises
    ------
    MeshError
        If a number or a set cannot be read; the message names the line.
    """
    mesh = DeckMesh()
    for block in blocks:
        if block.keyword == "NODE":
            _add_nodes(mesh, block)
        elif block.keyword == "ELEMENT":
            _add_elements(mesh, block)
        elif block.keyword == "NSET":
            _add_members(mesh.node_sets, block)
        elif block.keyword == "ELSET":
            _add_members(mesh.element_sets, block)
    return mesh


def _members(sets: dict[str, list[int]], text: str, where: str) -> list[int]:
    """Return the members of a set, or the text as the only member if it is a number."""
    name = text.upper()
    if name in sets:
        return sets[name]
    if not text.isdigit():
        fail(where, f"a number or the name of a set is expected, but {text!r} was given.")
    return [int(text)]


def _add_nodes(mesh: DeckMesh, block: KeywordBlock) -> None:
    """Add the nodes of a *NODE."""
    numbers = []
    for line in block.data:
        number, coordinates = line.node()
        mesh.points[number] = np.array(coordinates)
        numbers.append(number)
    if block.parameters.get("NSET"):
        mesh.node_sets.setdefault(block.parameters["NSET"].upper(), []).extend(numbers)


def _add_elements(mesh: DeckMesh, block: KeywordBlock) -> None:
    """Add the elements of an *ELEMENT; an element may take several lines."""
    type_name = block.required("TYPE").upper()
    node_count = _node_count(type_name)
    numbers = []
    for record in _element_records(block, node_count):
        number, *nodes = record
        mesh.elements[number] = TypedElement(type_name, tuple(nodes))
        numbers.append(number)
    if block.parameters.get("ELSET"):
        mesh.element_sets.setdefault(block.parameters["ELSET"].upper(), []).extend(numbers)


def _node_count(type_name: str) -> int | None:
    """Return the number of nodes of an element type; None for an unknown type."""
    in_name = _COUNT_IN_NAME.fullmatch(type_name)
    return int(in_name[1]) if in_name else _NODES_OF_TYPE.get(type_name)


def _element_records(block: KeywordBlock, node_count: int | None) -> Iterator[list[int]]:
    """Yield number and nodes of each element; one of unknown type takes one line."""
    record: list[int] = []
    for line in block.data:
        record += [whole(line.where, text) for text in line.texts]
        if node_count is None or len(record) > node_count:
            yield record
            record = []


def _add_members(sets: dict[str, list[int]], block: KeywordBlock) -> None:
    """Add the members of an *NSET or *ELSET: listed, given as sets, or generated."""
    members = sets.setdefault(block.required(block.keyword).upper(), [])
    for line in block.data:
        if "GENERATE" in block.parameters:
            members.extend(line.generated_members())
            continue
        for text in line.texts:
            members.extend(_members(sets, text, line.where))
