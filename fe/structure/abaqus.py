"""Reading the meshes of Abaqus and CalculiX from their input files (`.inp`).

meshio reads such files as well, but neither NSET of *NODE, nor GENERATE over several lines, nor
*SURFACE; it loses element sets of a deck of several blocks, and does not name the line of a fault.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from fe.elements.kinds import DECK_KINDS
from reporting.formats.toml_file import short_repr

from .coordinates import GLOBAL, CoordinateSystem, axes_by_points
from .deck import Deck, SurfaceRow
from .deck_text import FLAT, fail, lines_of, real, whole, words_of

_COMMENT = re.compile(r"^\s*\*\*.*")
_INCLUDE = re.compile(r"\s*\*\s*INCLUDE\s*,\s*INPUT\s*=(.*)", re.IGNORECASE)
_TYPES_OF_MESHIO = {"C3D8RH": "C3D8", "C3D10MH": "C3D10", "C3D20RH": "C3D20"}
"""Types under which meshio writes plain hexahedra and tetrahedra, with the plain types.

In files of other programs these types mean what they say.
"""
_HEADING_OF_MESHIO = "written by meshio"

_HYBRID_OR_THERMAL_TYPE = re.compile(r"(?P<plain_type>C3D(?:4|6|8|10|15|20|20R))[HT]")
"""Hybrid elements (H) and those with a temperature (T).

They have the stiffness of the plain type where the material is compressible.
"""

_HYBRID_TYPE = re.compile(r"(?P<type_without_h>C3D\d+[A-Z]*)H")
_VARIANT_TYPE = re.compile(r"(?P<plain_type>C3D\d+)[A-Z]+")
_PROPERTY_OF_VARIANT = {
    "C3D8I": "enhanced by incompatible modes and softer in bending",
    "C3D8R": "integrated at one point and softer in bending",
    "C3D10M": "modified for contact",
}
"""How the elements of a variant differ from those of the plain type, as the end of "they are"."""


class _ElementType(NamedTuple):
    """The name of an element type in meshio, and its number of nodes."""

    meshio_name: str
    node_count: int


def _element_types() -> dict[str, _ElementType]:
    """Return the element types that can be read, by their names in a deck."""
    types = {}
    for meshio_name, kind in DECK_KINDS.items():
        types[kind.calculix] = _ElementType(meshio_name, kind.node_count)
    for name, meshio_name in words_of("abaqus").flat.items():
        types[name] = _ElementType(meshio_name, FLAT[meshio_name].node_count)
    return types


_ELEMENT_TYPES = _element_types()


class DataLine(NamedTuple):
    """The values of a data line, with its file and line number."""

    where: str
    values: list[str]

    @property
    def texts(self) -> list[str]:
        """The values that are not empty, as those at the end of a line may be."""
        return [value for value in self.values if value]

    def node(self) -> tuple[int, list[float]]:
        """Return the number and three coordinates of a node; missing ones are 0."""
        number_text, *coordinate_texts = self.values
        three_texts = (*coordinate_texts, "", "", "")[:3]
        return whole(self.where, number_text), [real(self.where, text) for text in three_texts]

    def generated_members(self) -> range:
        """Return the range given by first, last and step; a missing step is 1."""
        numbers = [whole(self.where, text) for text in self.texts]
        first, last, step = [*numbers, 1, 0, 0][:3]
        if len(numbers) not in (2, 3) or first < 1 or step < 1:
            given_text = short_repr(",".join(self.texts))
            fail(self.where, f"first, last and step are expected, but {given_text} was given.")
        return range(first, last + 1, step)


class KeywordBlock(NamedTuple):
    """A keyword with its parameters, and the data lines below it.

    Attributes
    ----------
    where : str
        File and line of the keyword.
    keyword : str
        In capital letters.
    parameters : dict of str to str
        Values by name in capital letters; empty for a parameter without value.
    """

    where: str
    keyword: str
    parameters: dict[str, str]
    data: list[DataLine]

    def required(self, parameter: str) -> str:
        """Return the value of a parameter; raise `MeshError` if it is missing."""
        if not self.parameters.get(parameter):
            fail(self.where, f"*{self.keyword} must say {parameter}=a name.")
        return self.parameters[parameter]


def read_abaqus(path: Path) -> Deck:
    """Read nodes, elements, surfaces and sets from an input file of Abaqus or CalculiX.

    The file consists of blocks: a keyword such as `*NODE`, its parameters, and data lines. Blocks
    that are not part of the mesh, such as materials, steps and loads, are ignored.

    Raises
    ------
    MeshError
        If the file cannot be read, or if it has a keyword or a parameter without which the mesh
        would be another one. The message names the line.
    """
    words = words_of("abaqus")
    deck = Deck(path, words)
    coordinates = GLOBAL  # a *SYSTEM holds for the nodes after it
    types_of_writer: Mapping[str, str] = {}
    for block in read_blocks(path):
        heading = " ".join(value for line in block.data for value in line.values)
        if block.keyword == "HEADING" and _HEADING_OF_MESHIO in heading:
            types_of_writer = _TYPES_OF_MESHIO
        # Only the line of a section is kept, for messages on its set; its data are ignored below.
        if block.keyword.endswith(" SECTION"):
            deck.sections[block.parameters.get("ELSET", "").casefold()] = block.where
        if block.keyword not in words.read:
            deck.pass_over(block.keyword, block.where)
            continue
        for parameter in block.parameters:
            if parameter not in words.read[block.keyword]:
                fail(
                    block.where,
                    f"*{block.keyword} with {short_repr(parameter)} is not read; write what it "
                    "makes out.",
                )
        if block.keyword == "NODE":
            _add_nodes(deck, block, coordinates)
        elif block.keyword == "ELEMENT":
            _add_elements(deck, block, types_of_writer)
        elif block.keyword == "SYSTEM":
            coordinates = _coordinate_system(block)
        elif block.keyword == "SURFACE":
            _add_surface(deck, block)
        else:  # *NSET or *ELSET
            _add_members(deck, block)
    return deck


@dataclass
class _RawBlock:
    """A keyword line with its continuation lines, and the data lines below it."""

    where: str
    head: list[str]
    data: list[DataLine]

    @property
    def head_continues(self) -> bool:
        """Whether the next line continues the keyword line."""
        return not self.data and self.head[-1].endswith(",")


def read_blocks(path: Path) -> Iterator[KeywordBlock]:
    """Yield the keyword blocks of a file."""
    raw_blocks: list[_RawBlock] = []
    for where, line in lines_of((path,), _COMMENT, _INCLUDE):
        text = line.strip()
        if text.startswith("*"):
            raw_blocks.append(_RawBlock(where, [text[1:]], []))
        elif raw_blocks and raw_blocks[-1].head_continues:
            raw_blocks[-1].head.append(text)
        elif raw_blocks:
            values = [value.strip() for value in text.split(",")]
            raw_blocks[-1].data.append(DataLine(where, values))
    for block in raw_blocks:
        keyword, *parameter_texts = "".join(block.head).split(",")
        yield KeywordBlock(
            block.where,
            _with_single_spaces(keyword).upper(),
            _parameters(parameter_texts),
            block.data,
        )


def _parameters(texts: list[str]) -> dict[str, str]:
    """Parse keyword parameters such as NSET=A into values by name in capitals."""
    parameters = {}
    for text in texts:
        name, _, value = _with_single_spaces(text).partition("=")
        if text.strip():
            parameters[name.strip().upper()] = value.strip().strip('"')
    return parameters


def _with_single_spaces(text: str) -> str:
    """Trim a text and reduce its white space to single spaces."""
    return " ".join(text.split())


def _coordinate_system(block: KeywordBlock) -> CoordinateSystem:
    """Return the coordinate system that a *SYSTEM block defines for the nodes after it.

    The block gives up to three points: the origin, a point on the x axis, and a point in the plane
    of x and y. Without the third point, the z axis is the global one, and x is turned about it;
    with the origin alone, all axes are the global ones.
    """
    numbers: list[float] = []
    for where, values in block.data:
        # empty values at the end of a line are not numbers
        for text in ",".join(values).rstrip(",").split(","):
            numbers.append(real(where, text))
    if len(numbers) not in (0, 3, 6, 9):
        fail(
            block.where,
            f"*SYSTEM needs one, two or three points, but {len(numbers)} numbers were given.",
        )
    points = np.zeros((3, 3))
    points.flat[: len(numbers)] = numbers
    origin, point_on_x, _ = points
    if len(numbers) < 6:
        points[1:] = origin + np.eye(3)[:2]
    elif len(numbers) < 9:
        point_on_x[2] = origin[2]
        points[2] = origin + np.cross((0.0, 0.0, 1.0), point_on_x - origin)
    return CoordinateSystem(origin, axes_by_points(block.where, points))


def _add_nodes(deck: Deck, block: KeywordBlock, coordinates: CoordinateSystem) -> None:
    """Add the nodes of a *NODE block, converted from the coordinates of the last *SYSTEM."""
    kind = block.parameters.get("SYSTEM", "R").upper()
    if kind not in ("R", "C"):
        fail(block.where, f"*NODE with SYSTEM={kind} is not read; give the nodes in SYSTEM=R or C.")
    nodes = [line.node() for line in block.data]
    numbers = [number for number, _ in nodes]
    rows = [row for _, row in nodes]
    local_points = np.reshape(rows, (-1, 3))
    system = replace(coordinates, kind=kind)
    points = system.to_space(local_points).tolist()
    for line, number, point in zip(block.data, numbers, points, strict=True):
        deck.add_node(line.where, number, point)
    if "NSET" in block.parameters:
        deck.members("NSET", block.required("NSET")).extend(numbers)


def _add_elements(deck: Deck, block: KeywordBlock, types_of_writer: Mapping[str, str]) -> None:
    """Add the elements of an *ELEMENT block, of which each may take several lines.

    `types_of_writer` maps type names that the writing program uses to the plain types it means.
    """
    type_name = block.required("TYPE").upper()
    plain_type = types_of_writer.get(type_name) or _plain_type(type_name, block.where)
    if plain_type != type_name:
        deck.remark(f"{block.where}: elements of type {type_name} are built as {plain_type}.")
    element_type = _ELEMENT_TYPES[plain_type]
    numbers: list[int] = []
    location_of_number: list[str] = []  # file and line of each number
    for where, values in block.data:
        for text in values:
            if text:
                numbers.append(whole(where, text))
                location_of_number.append(where)
    width = element_type.node_count + 1
    if len(numbers) % width:
        fail(
            block.where,
            f"{len(numbers)} numbers are not a multiple of {width}, as {type_name} needs.",
        )
    added = []
    for start in range(0, len(numbers), width):
        number, *nodes = numbers[start : start + width]
        deck.add_element(location_of_number[start], number, element_type.meshio_name, nodes)
        added.append(number)
    if "ELSET" in block.parameters:
        deck.members("ELSET", block.required("ELSET")).extend(added)


def _plain_type(name: str, where: str) -> str:
    """Return the plain element type, a key of `_ELEMENT_TYPES`, with the same stiffness.

    Raises `MeshError` if elements of this type, such as C3D8I, cannot be read.
    """
    variant = _HYBRID_OR_THERMAL_TYPE.fullmatch(name)
    plain_type = name if variant is None else variant["plain_type"]
    if plain_type not in _ELEMENT_TYPES:
        _refuse_type(name, where)  # never returns
    return plain_type


def _refuse_type(name: str, where: str) -> NoReturn:
    """Raise the error for an element type that cannot be read.

    For a variant of a plain type, such as C3D8R of C3D8, the message says how the two differ, and
    what to write instead.
    """
    readable_types = ", ".join(kind.calculix for kind in DECK_KINDS.values())
    variant = _VARIANT_TYPE.fullmatch(name)
    if variant is None or variant["plain_type"] not in _ELEMENT_TYPES:
        fail(
            where,
            f"elements of type {short_repr(name)} cannot be read; the types {readable_types} can "
            "be read.",
        )
    # H adds a pressure unknown, and leaves the difference of the type without it: C3D8RH is
    # integrated at one point, as C3D8R is.
    hybrid = _HYBRID_TYPE.fullmatch(name)
    type_without_h = name if hybrid is None else hybrid["type_without_h"]
    property_of_variant = _PROPERTY_OF_VARIANT.get(type_without_h, "other elements")
    plain_type = variant["plain_type"]
    remedy = f"write {plain_type} if that is meant"
    if plain_type == "C3D8":
        remedy = f"mesh with second-order elements (C3D20, C3D20R or C3D10), or {remedy}"
    fail(
        where,
        f"elements of type {name} cannot be read: they are {property_of_variant}, not "
        f"{plain_type}; {remedy}. The types {readable_types} can be read.",
    )


def _add_surface(deck: Deck, block: KeywordBlock) -> None:
    """Add the element faces of a *SURFACE; a surface of nodes is ignored."""
    if block.parameters.get("TYPE", "ELEMENT").upper() != "ELEMENT":
        return
    rows = []
    for where, values in block.data:
        member, face = (*values, "")[:2]
        rows.append(SurfaceRow(where, member, face))
    deck.surfaces[block.required("NAME")] = rows


def _add_members(deck: Deck, block: KeywordBlock) -> None:
    """Add the members of an *NSET or *ELSET, listed or generated."""
    members = deck.members(block.keyword, block.required(block.keyword))
    for line in block.data:
        if "GENERATE" in block.parameters:
            members.extend(deck.counted(line.where, line.generated_members()))
            continue
        for text in line.texts:
            members.extend(deck.members_or_number(block.keyword, line.where, text))
