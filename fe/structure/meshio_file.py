"""Read meshes of Gmsh, VTU, MED and other formats with meshio."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.runtime.arrays import BoolArray, IntArray
from fe.runtime.errors import MeshError
from reporting.words import counted, is_or_are

from .deck import Deck
from .deck_text import FLAT, fail

if TYPE_CHECKING:
    from meshio import Mesh

_MOST_VALUES = 1000
"""Largest number of distinct values for which an array of integers is read as sets."""

_LEFT_OUT = 0
"""Number that no element has: they are counted from one."""

_LONGEST_REASON = 500


def read_by_meshio(path: Path) -> Deck:
    """Read the mesh of a file in any format that meshio knows.

    Raises
    ------
    MeshError
        If meshio cannot read the file, or would lose elements of it.
    """
    if path.suffix.lower() == ".msh":
        _refuse_options_of_gmsh(path)
    mesh = _mesh_of_meshio(path)
    deck = Deck(path)
    if path.suffix.lower() == ".msh":
        _check_element_lines(path)
    points = np.atleast_2d(mesh.points)
    missing_coordinates = 3 - points.shape[1]  # one if the mesh is plane
    points = np.pad(points, ((0, 0), (0, missing_coordinates)))
    for number, point in enumerate(points.tolist(), start=1):
        deck.nodes[number] = tuple(point)
    numbers_of_blocks = _add_elements(deck, mesh)
    cell_arrays = _NamedArrays(mesh.cell_sets, mesh.cell_data)
    for block, element_numbers in enumerate(numbers_of_blocks):
        _add_sets(deck, mesh, "ELSET", element_numbers, cell_arrays, block)
    node_numbers = np.array(list(deck.nodes))
    point_arrays = _NamedArrays(
        sets={name: [members] for name, members in mesh.point_sets.items()},
        data={name: [values] for name, values in mesh.point_data.items()},
    )
    _add_sets(deck, mesh, "NSET", node_numbers, point_arrays, 0)
    return deck


def _add_elements(deck: Deck, mesh: Mesh) -> list[IntArray]:
    """Add the elements of a mesh to a deck; return their numbers, an array for each block.

    Elements outside the physical groups of Gmsh are not added and have the number `_LEFT_OUT`. An
    element that occurs several times in a file of Gmsh is added once.
    """
    suffix = deck.path.suffix.lower()
    outside_blocks = _outside_physical_groups(mesh)
    left_out = sum(int(outside.sum()) for outside in outside_blocks)
    if left_out:
        elements = counted(left_out, "element")
        deck.remark(
            f"{deck.path}: {elements} of no physical group {is_or_are(left_out)} left out; set "
            "Mesh.SaveAll = 0 in Gmsh, and it saves none of them."
        )
    numbers_of_blocks = []
    number_of_nodes: dict[object, int] = {}
    count = 0
    for block, outside in zip(mesh.cells, outside_blocks, strict=True):
        numbers = []
        rows = (_node_rows(block.type, block.data, suffix) + 1).tolist()
        for nodes, is_outside in zip(rows, outside.tolist(), strict=True):
            count += 1
            if is_outside:
                numbers.append(_LEFT_OUT)
                continue
            # Gmsh writes an element once for each of its physical groups.
            key = (block.type, *sorted(nodes)) if suffix == ".msh" else count
            number = number_of_nodes.setdefault(key, count)
            numbers.append(number)
            if number == count:
                deck.add_element(str(deck.path), count, block.type, nodes)
        numbers_of_blocks.append(np.array(numbers, dtype=np.int64))
    return numbers_of_blocks


def _node_rows(block_type: str, data: IntArray, suffix: str) -> IntArray:
    """Return the nodes (E, n) of a block in meshio's order, or none if the type is unknown.

    meshio leaves the nodes of MED files in MED's own order.
    """
    if block_type not in KINDS and block_type not in FLAT:
        return np.zeros((len(data), 0), dtype=np.int64)
    if suffix == ".med" and block_type in KINDS:
        return data[:, KINDS[block_type].med_order]
    return data


class _NamedArrays(NamedTuple):
    """Sets and data of nodes or elements: by name, one array for each block."""

    sets: Mapping[str, Sequence[ArrayLike | None]]
    data: Mapping[str, Sequence[ArrayLike]]


def _add_sets(
    deck: Deck, mesh: Mesh, kind: str, numbers: IntArray, arrays: _NamedArrays, block: int
) -> None:
    """Add to a deck the named sets of its nodes, or of the elements of one block.

    Parameters
    ----------
    kind : {"NSET", "ELSET"}
        Sets of nodes or of elements.
    numbers : (n,) array of int
        The numbers of the nodes or elements in the deck.
    block : int
        The index of the block in the lists of `arrays`; 0 for nodes.
    """
    named_sets: list[tuple[str, IntArray]] = []
    for name, members in arrays.sets.items():
        if members[block] is not None and not name.startswith("gmsh:"):
            named_sets.append((name, np.asarray(members[block], dtype=np.int64)))
    for label, values in arrays.data.items():
        for name, indices in _sets_of_values(mesh, label, values, block):
            if name not in arrays.sets:
                named_sets.append((name, indices))
    for name, indices in named_sets:
        members_of_set = numbers[indices]
        is_in_deck = members_of_set != _LEFT_OUT
        members_in_deck = members_of_set[is_in_deck]
        # a set without members stays, one whose members were all left out does not
        is_empty_in_file = not len(members_of_set)
        if len(members_in_deck) or is_empty_in_file:
            deck.members(kind, name).extend(members_in_deck.tolist())


def _sets_of_values(
    mesh: Mesh, label: str, arrays: Sequence[ArrayLike], block: int
) -> Iterator[tuple[str, IntArray]]:
    """Yield the name and the member indices of each set that an array of integers defines.

    The nodes or elements with the same integer are one set. An array with too many different
    integers defines none. `label` is the name of the array, such as "gmsh:physical" or "cell_tags".
    """
    array = np.asarray(arrays[block])
    if array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        return
    values = np.unique(array)
    if len(values) > _MOST_VALUES:
        return
    all_values = tuple(np.unique(np.concatenate(arrays)).tolist())
    # meshio writes a set alone as an array of 0 in it and -1 outside, others write 1 and 0
    value_of_members = {(-1, 0): 0, (0, 1): 1}.get(all_values)
    for value in values.tolist():
        names = _names_of_value(mesh, label, value, block)
        if value == value_of_members and ":" not in label:
            names = [*names, label]
        for name in names:
            yield name, np.flatnonzero(array == value)


def _names_of_value(mesh: Mesh, label: str, value: int, block: int) -> list[str]:
    """Return the set names that a file gives to a value of an integer array.

    Without a name the set is called `label=value`.
    """
    number_name = f"{label}={value}"
    if label in ("cell_tags", "point_tags"):  # MED counts families of named groups
        families: Mapping[int, list[str]] = getattr(mesh, label, {})
        return families.get(value, [number_name])
    if label != "gmsh:physical":
        return [number_name]
    # Gmsh names a pair of number and dimension
    cell_type = mesh.cells[block].type
    dimension = 3
    if cell_type in FLAT:
        dimension = min(FLAT[cell_type].corner_count, 3) - 1
    names = []
    for name, number_and_dimension in mesh.field_data.items():
        if number_and_dimension.tolist() == [value, dimension]:
            names.append(name)
    return names or [number_name]


def _outside_physical_groups(mesh: Mesh) -> list[BoolArray]:
    """Return for each block of a mesh from Gmsh which elements are not part of the structure.

    If its option Mesh.SaveAll is set, Gmsh also writes elements without a physical group, as group
    0. A face without a group is left out if any element has a group. A solid element without a
    group is left out only if some solid element has one: otherwise the groups name faces only, and
    all solid elements are the structure.
    """
    groups = mesh.cell_data.get("gmsh:physical")
    if groups is None:
        return [np.zeros(len(block.data), dtype=bool) for block in mesh.cells]
    any_has_group = any(np.any(group) for group in groups)
    any_solid_has_group = False
    for block, group in zip(mesh.cells, groups, strict=True):
        if block.type not in FLAT and np.any(group):
            any_solid_has_group = True
    outside_blocks = []
    for block, group in zip(mesh.cells, groups, strict=True):
        groups_choose_elements = any_has_group if block.type in FLAT else any_solid_has_group
        has_no_group = np.asarray(group) == 0
        outside_blocks.append(has_no_group & groups_choose_elements)
    return outside_blocks


_PARAMETRIC = (
    "its nodes have parametric coordinates, which are not read; set Mesh.SaveParametric = 0 in "
    "Gmsh and save the mesh again."
)


def _refuse_options_of_gmsh(path: Path) -> None:
    """Raise `MeshError` for a mesh that is partitioned or has parametric coordinates."""
    content = path.read_bytes()
    if b"$PartitionedEntities" in content or b"$GhostElements" in content:
        fail(
            str(path),
            "the mesh is partitioned for several processors, and is not read so; delete the "
            "partitions in Gmsh (Tools, Partition, Delete) and save the mesh again.",
        )
    if b"$ParametricNodes" in content:
        fail(str(path), _PARAMETRIC)


def _check_element_lines(path: Path) -> None:
    """Raise `MeshError` if a text file of Gmsh has more element lines than it declares.

    Version 2 declares the number of elements, version 4 the numbers of blocks and of elements; Gmsh
    writes one line for each.
    """
    lines = [line.strip() for line in path.read_bytes().splitlines()]
    if b"$MeshFormat" not in lines or b"$Elements" not in lines or b"$EndElements" not in lines:
        return
    format_fields = lines[lines.index(b"$MeshFormat") + 1].split()
    is_text = format_fields[1] == b"0"
    if not is_text:
        return
    start = lines.index(b"$Elements") + 1
    section = lines[start : lines.index(b"$EndElements")]
    header, *rows = [line for line in section if line]
    declared = sum(int(number) for number in header.split()[:2])
    if len(rows) > declared:
        fail(
            f"{path}, line {start + 1}",
            f"$Elements declares {declared} lines of blocks and elements, but {len(rows)} follow, "
            "and the last would be lost. Delete the line that is there twice, or write the mesh "
            "again.",
        )


def _mesh_of_meshio(path: Path) -> Mesh:
    """Let meshio read a file; if it fails, raise `MeshError` with the reason."""
    printed_text = io.StringIO()
    reasons_of_formats = io.StringIO()
    try:
        # meshio writes what it thinks of a file to the terminal, and ends the program if it fails.
        with (
            contextlib.redirect_stdout(reasons_of_formats),
            contextlib.redirect_stderr(printed_text),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            return meshio_with_wedges().read(path)
    except SystemExit:
        reason = printed_text.getvalue().removeprefix("Error: ")
    except Exception as error:  # noqa: BLE001 - the readers of formats fail in any way
        reason = getattr(error, "strerror", None) or str(error) or "its format is not known"
        # version 4 of Gmsh's format, where some blocks of elements have groups and others do not
        if "gmsh:physical" in reason:
            fail(
                str(path),
                "some elements are in a physical group and others in none, as Gmsh saves them with "
                "Mesh.SaveAll = 1. Set Mesh.SaveAll = 0 and save the mesh again.",
            )
    if "parametric nodes" in reasons_of_formats.getvalue() + reason:
        fail(str(path), _PARAMETRIC)
    reason = " ".join(reason[:_LONGEST_REASON].split()).rstrip(".")
    raise MeshError(
        f"The mesh file {path} cannot be read as {path.suffix}: {reason}; it is damaged, cut off, "
        "or of another dialect. Write it again, or as .msh, .inp, .med or .bdf."
    )
