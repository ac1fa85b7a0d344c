"""Files of finite element codes, read and checked: meshes, and matrices and vectors.

Meshes are of Gmsh, Abaqus and CalculiX, VTU, Nastran and what else meshio reads. Of matrices, what stands in
a file tells its format: MatrixMarket; archives of NumPy and SciPy (`.npz`, `.npy`); DMIG of Nastran; tables
of `row column value` (CalculiX' `.sti` and `.mas`, Abaqus' COORDINATE) or of `node component node component
value` (Abaqus' MATRIX INPUT). Those that name nodes bring their own unknowns.

Also how much memory a structure of the mesh takes, before it is taken.
"""

import contextlib
import io
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy import io as scipy_io
from scipy import sparse
from scipy.sparse import csgraph

from fe.elements.cells import BATCH, jacobians
from fe.elements.kinds import KINDS, meshio_with_wedges
from fe.full.fronts import analyse
from fe.runtime.arrays import BoolArray, FloatArray, IntArray
from fe.runtime.errors import MeshError
from fe.sentences import said
from reporting.memory import available_memory
from reporting.text_file import read_text
from reporting.words import counted, is_or_are

from .deck import FLAT, Deck, fail
from .decks import cards, read_abaqus, read_nastran
from .design import file_of
from .mesh import StructureMesh

_READERS: dict[str, Callable[[Path], Deck]] = {
    ".inp": read_abaqus, ".bdf": read_nastran, ".nas": read_nastran, ".fem": read_nastran,
}  # fmt: skip
"""Readers of this project; meshio reads what has another ending."""
_MOST_VALUES = 1000
_LEFT_OUT = 0
"""Number that no element has: they are counted from one."""
LARGEST_EDGE_SHIFT = 0.3
"""A mid-edge node may lie so far from the middle of its edge, in lengths of the edge."""


@np.errstate(over="ignore", invalid="ignore")  # what overflows has no Jacobian that is positive and finite
def read_mesh(path: Path, unit: float, unit_name: str) -> StructureMesh:
    """Read a mesh file and check it.

    Parameters
    ----------
    path : Path
        The file; its ending says its format.
    unit : float
        Metres in its unit of length.
    unit_name : str
        Name of the unit.

    Raises
    ------
    MeshError
        One sentence that names the file and the place: cells of an unknown kind or of several, a negative
        Jacobian, a mid-edge node far from its edge, parts that do not hang together.
    """
    if not path.is_file():
        what = "a folder" if path.is_dir() else "not there"
        raise MeshError(said("mesh.missing", path=path, what=what))
    if not path.stat().st_size:
        raise MeshError(f"The mesh file {path} is empty; write it anew.")
    mesh = _READERS.get(path.suffix.lower(), read_by_meshio)(path).mesh(unit, unit_name)
    _check_edges(mesh)
    _check_jacobians(mesh)
    _check_parts(mesh)
    return mesh


def _check_edges(mesh: StructureMesh) -> None:
    first = len(mesh.kind.corners)
    for number, (a, b) in enumerate(mesh.kind.edges):
        start, end = mesh.nodes[:, a], mesh.nodes[:, b]
        shift = np.linalg.norm(mesh.nodes[:, first + number] - 0.5 * (start + end), axis=1)
        far = shift > LARGEST_EDGE_SHIFT * np.linalg.norm(end - start, axis=1)
        if far.any():
            cell = int(far.argmax())
            node = mesh.node_numbers[mesh.cells[cell, first + number]]
            raise MeshError(said("mesh.bent", mesh=mesh, node=node, cell=mesh.cell(cell)))


def _check_jacobians(mesh: StructureMesh) -> None:
    local = np.vstack((mesh.kind.node_positions, mesh.kind.stiffness_rule[0]))
    parts = np.array_split(mesh.nodes, len(mesh.nodes) // BATCH + 1)
    least = np.concatenate([np.linalg.det(jacobians(mesh.kind, part, local)).min(axis=1) for part in parts])
    bad = ~((least > 0.0) & (least < np.inf))
    if bad.any():
        worst, count = mesh.cell(int(least.argmin())), bad.sum()
        raise MeshError(said("mesh.inverted", mesh=mesh, count=count, all=len(bad), cell=worst))


def _check_parts(mesh: StructureMesh) -> None:
    rows, columns = np.repeat(mesh.cells[:, :1], mesh.cells.shape[1], axis=1), mesh.cells
    links = (np.ones(columns.size, dtype=np.int8), (rows.ravel(), columns.ravel()))
    graph = sparse.coo_array(links, shape=(len(mesh.points), len(mesh.points)))
    count, part = csgraph.connected_components(graph, directed=False)
    if count > 1:
        part = part[mesh.cells[:, 0]]
        cells = np.bincount(part, minlength=count)
        first = int((part == cells.argmin()).argmax())
        place = mesh.place(mesh.centres[first])
        raise MeshError(said("mesh.parts", mesh=mesh, count=count, cells=cells.min(), place=place))


def read_by_meshio(path: Path) -> Deck:
    """Read the mesh of a file of any other format, see `read_mesh`."""
    found = _found_by_meshio(path)
    deck, where, suffix = Deck(path), str(path), path.suffix.lower()
    if suffix == ".msh":
        _check_element_lines(path)
    points = np.atleast_2d(found.points)
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    deck.nodes = dict(enumerate(map(tuple, points.tolist()), start=1))
    numbers, first, count = [], dict[Any, int](), 0
    outside = _outside_physical_groups(found)
    left_out = sum(int(rows.sum()) for rows in outside)
    if left_out:
        what = f"{counted(left_out, 'element')} of no physical group {is_or_are(left_out)} left out"
        deck.remark(f"{path}: {what}; set Mesh.SaveAll = 0 in Gmsh, and it saves none of them.")
    for block, is_outside in zip(found.cells, outside, strict=True):
        known = block.type in KINDS or block.type in FLAT
        table = block.data if known else np.zeros((len(block.data), 0), dtype=np.int64)
        if suffix == ".med" and block.type in KINDS:
            table = table[:, KINDS[block.type].med_order]
        mine = []
        for nodes, without_group in zip((table + 1).tolist(), is_outside.tolist(), strict=True):
            count += 1
            if without_group:
                mine.append(_LEFT_OUT)
                continue
            # Gmsh writes an element once for each of its physical groups.
            mine.append(first.setdefault((block.type, *sorted(nodes)) if suffix == ".msh" else count, count))
            if mine[-1] == count:
                deck.add_element(where, count, block.type, nodes)
        numbers.append(np.array(mine, dtype=np.int64))
    point_sets, point_data = (
        {name: [part] for name, part in own.items()} for own in (found.point_sets, found.point_data)
    )
    for key, members, sets, data in (
        ("ELSET", numbers, found.cell_sets, found.cell_data),
        ("NSET", [np.array(list(deck.nodes))], point_sets, point_data),
    ):
        for number, own in enumerate(members):
            named = [
                (name, np.asarray(parts[number], dtype=np.int64))
                for name, parts in sets.items()
                if parts[number] is not None and not name.startswith("gmsh:")
            ]
            for label, arrays in data.items():
                tagged = _named(found, label, arrays, number)
                named += [(name, places) for name, places in tagged if name not in sets]
            for name, places in named:
                numbers_of_set = own[places]
                kept = numbers_of_set[numbers_of_set != _LEFT_OUT]
                if len(kept) or not len(numbers_of_set):
                    deck.members(key, name).extend(kept.tolist())
    return deck


def _outside_physical_groups(found: Any) -> list[BoolArray]:
    """Return for each block of a mesh from Gmsh which of its elements belong to no part of the structure.

    Gmsh writes elements without a physical group, as group 0, if its option Mesh.SaveAll is set. They are
    construction geometry if other elements of their dimension have a group. If no solid element has one,
    the groups name faces only, and all solid elements are the structure.
    """
    groups = found.cell_data.get("gmsh:physical")
    if groups is None:
        return [np.zeros(len(block.data), dtype=bool) for block in found.cells]
    has_groups = any(np.any(group) for group in groups)
    blocks = [*zip(found.cells, groups, strict=True)]
    has_solids = any(np.any(group) for block, group in blocks if block.type not in FLAT)
    outside = []
    for block, group in blocks:
        groups_choose_elements = has_groups if block.type in FLAT else has_solids
        outside.append((np.asarray(group) == 0) & groups_choose_elements)
    return outside


def _check_element_lines(path: Path) -> None:
    """Refuse a text file of Gmsh with more lines of elements than it declares: the last would be lost.

    Version 2 declares the number of elements, version 4 the numbers of blocks and of elements; Gmsh writes
    one line for each.
    """
    lines = [line.strip() for line in path.read_bytes().splitlines()]
    is_text = lines[lines.index(b"$MeshFormat") + 1].split()[1] == b"0" if b"$MeshFormat" in lines else False
    if not is_text or b"$Elements" not in lines or b"$EndElements" not in lines:
        return
    start = lines.index(b"$Elements") + 1
    header, *rows = filter(None, lines[start : lines.index(b"$EndElements")])
    declared = sum(int(number) for number in header.split()[:2])
    if len(rows) > declared:
        fail(
            f"{path}, line {start + 1}",
            f"$Elements declares {declared} lines of blocks and elements, but {len(rows)} follow, and the"
            " last would be lost. Delete the line that is there twice, or write the mesh anew.",
        )


def _found_by_meshio(path: Path) -> Any:
    """Return what meshio reads of a file, or say in one sentence why it does not."""
    printed = io.StringIO()
    try:
        # meshio writes what it thinks of a file to the terminal, and ends the program where it fails.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(printed),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            return meshio_with_wedges().read(path)
    except SystemExit:
        why = printed.getvalue().removeprefix("Error: ")
    except Exception as error:  # noqa: BLE001 - the readers of formats fail in any way
        why = getattr(error, "strerror", None) or str(error) or "its format is not known"
        if "gmsh:physical" in why:  # of version 4, where some blocks of elements have it and others do not
            fail(
                str(path),
                "some elements are in a physical group and others in none, as Gmsh saves them with"
                " Mesh.SaveAll = 1. Set Mesh.SaveAll = 0 and save the mesh anew.",
            )
    raise MeshError(said("mesh.unread", path=path, why=" ".join(why[:500].split()).rstrip(".")))


def _named(found: Any, label: str, arrays: list[Any], number: int) -> Iterator[tuple[str, IntArray]]:
    """Yield the sets of one of several arrays of integers: each value, by the names that the file has."""
    array = np.asarray(arrays[number])
    values = np.unique(array) if array.ndim == 1 else array
    if values.ndim != 1 or not np.issubdtype(array.dtype, np.integer) or len(values) > _MOST_VALUES:
        return
    # MED counts families of named groups; meshio writes a set alone as 0 and -1, others write 1 and 0.
    families = getattr(found, label, {}) if label in ("cell_tags", "point_tags") else {}
    mask = {(-1, 0): 0, (0, 1): 1}.get(tuple(np.unique(np.concatenate(arrays)).tolist()))
    for value in values.tolist():
        names = families.get(value, [f"{label}={value}"])
        if label == "gmsh:physical":
            kind = found.cells[number].type
            place = [value, min(FLAT[kind][1], 3) - 1 if kind in FLAT else 3]
            names = [name for name, tag in found.field_data.items() if tag.tolist() == place] or names
        if value == mask and ":" not in label:
            names = [*names, label]
        for name in names:
            yield name, np.flatnonzero(array == value)


GIB = 2.0**30
_PROGRAM = 0.35 * GIB  # libraries, and the triplets of a part of the cells
_MATRICES = 5  # stiffness, its terms, their sum, mass and the residual's copy, each with as many entries
_ENTRY = 12  # bytes of an entry of a sparse matrix
_BULKY = 520.0
"""Bytes over unknowns^(4/3) of factors and fronts of a cube, the bulkiest body (measured 340 to 500)."""


def memory_estimate(mesh: StructureMesh) -> float:
    """Bytes that assembly and factorisation take, from the order of elimination that this mesh leads to."""
    cells = np.repeat(np.arange(len(mesh.cells)), mesh.cells.shape[1])
    shape = (len(mesh.cells), len(mesh.points))
    inside = sparse.coo_array((np.ones(len(cells), dtype=np.int32), (cells, mesh.cells.ravel())), shape=shape)
    graph = (inside.T @ inside).tocsr()  # of nodes that share a cell
    sizes = [(front.end - front.start, len(front.boundary)) for front in analyse(graph)[1]]
    pivots, boundary = np.array(sizes).T
    factors = pivots * (pivots + boundary)
    most = factors.sum() + (2 * factors + boundary**2).max()  # the last fronts are the largest
    return float(_PROGRAM + _MATRICES * _ENTRY * 9 * graph.nnz + 8 * 9 * most)


def check_memory(mesh: StructureMesh, limit: float | None = None) -> None:
    """Refuse a mesh whose assembly and factorisation would take more than `limit` bytes.

    Parameters
    ----------
    mesh : StructureMesh
        The mesh.
    limit : float, optional
        Bytes; what the machine has left by default.

    Raises
    ------
    MeshError
        If it would take more.
    """
    allowed = available_memory() if limit is None else limit
    entries = 9 * mesh.cells.size * mesh.cells.shape[1]  # four times those that are left of them
    bulky = _PROGRAM + _MATRICES * _ENTRY * entries / 4.0 + _BULKY * mesh.unknowns ** (4.0 / 3.0)
    if bulky > allowed and (needed := memory_estimate(mesh)) > allowed:
        of = "left on this machine" if limit is None else "allowed"
        raise MeshError(said("mesh.memory", mesh=mesh, needed=needed / GIB, allowed=allowed / GIB, of=of))


Place = tuple[int, int]
"""Node and component: 1, 2, 3 along x, y, z, then 4, 5, 6 about them."""

_PLACE = re.compile(r"\s*(\d+)\s*[.,;\s]\s*([1-6])\s*")
_SQUARE, _REAL = (1, 6), (1, 2)  # forms and types of Nastran


def read_unknowns(path: Path) -> list[Place]:
    """Read the node and component of each row, a line each: `97.3`, `97 3` or `97,3`.

    Raises
    ------
    MeshError
        If it cannot be read, or a line is no such pair.
    """
    found = []
    for number, line in enumerate(read_text(path, MeshError, what="file of unknowns").splitlines(), start=1):
        match = _PLACE.fullmatch(line)
        if match is not None:
            found.append((int(match[1]), int(match[2])))
        elif line.strip():
            fail(f"{path}, line {number}", said("matrices.unknowns", came=line))
    return found


def read_matrix(folder: Path, name: str) -> tuple[sparse.csr_array, list[Place] | None]:
    """Read the matrix that `FILE` or `FILE:MATRIX` names, and the unknown of each row where the file says it.

    One of each two entries that mirror each other may be left out of a table.

    Raises
    ------
    MeshError
        If it cannot be read, or holds no such matrix.
    """
    file, chosen = file_of(name)
    path = folder / file
    table, is_table = _read(path, chosen)
    if not is_table:
        if table.ndim != 2 or table.shape[0] != table.shape[1] or table.dtype.kind not in "fiu":
            came = f"{table.dtype} of shape {table.shape}"
            fail(str(path), f"a square matrix of real numbers is expected, but {came} came.")
        return sparse.csr_array(table, dtype=np.float64), None
    width = table.shape[1]
    if width not in (3, 5) or not table.size or not np.array_equal(table[:, :-1], np.rint(table[:, :-1])):
        fail(str(path), said("matrices.lines", count=len(table), width=width))
    whole, places = table[:, :-1].astype(np.int64), None
    if width == 5:
        own, number = np.unique(whole.reshape(-1, 2), axis=0, return_inverse=True)
        places = [(node, component) for node, component in own.tolist()]
        whole = number.reshape(-1, 2) + 1
    elif whole.min() < 1:
        fail(str(path), "rows and columns are counted from 1, but there is a smaller one.")
    at, size = tuple(whole.T - 1), int(whole.max())
    matrix, pattern = (
        sparse.coo_array((values, at), (size, size)).tocsr() for values in (table[:, -1], np.ones(len(table)))
    )
    both = pattern.multiply(pattern.T).tocoo()
    if (both.row == both.col).all():
        matrix = (matrix + matrix.T - sparse.diags_array(matrix.diagonal())).tocsr()
    return matrix, places


def read_vector(folder: Path, name: str, named: Callable[[Place], FloatArray], size: int) -> FloatArray:
    """Read a vector (n,): as many numbers as there are unknowns, or lines of node, component and value.

    Parameters
    ----------
    folder : Path
        Where the file is.
    name : str
        `FILE` or `FILE:ARRAY`.
    named : callable
        Return the vector (n,) that 1 at a node's component stands for.
    size : int
        Number n of unknowns.

    Raises
    ------
    MeshError
        If it cannot be read or has another length.
    """
    file, chosen = file_of(name)
    found, is_table = _read(folder / file, chosen)
    if is_table and found.shape[1] == 3:
        parts = [value * named((int(node), int(component))) for node, component, value in found]
        return np.asarray(np.sum(parts, axis=0))
    values = np.asarray(found.todense() if sparse.issparse(found) else found, dtype=np.float64)
    if values.size != size or max(values.shape) != size:
        fail(str(folder / file), said("matrices.vector", size=size, shape=values.shape))
    return values.ravel()


def _read(path: Path, chosen: str) -> tuple[Any, bool]:
    """Return the array of a file, and whether it is a table: lines of a place or two, and a value."""
    try:
        if path.suffix in (".npz", ".npy"):
            return _archived(path, chosen), False
        text = read_text(path, MeshError, what="matrix file", otherwise="latin-1")
        if text.startswith("%%MatrixMarket"):
            return scipy_io.mmread(path), False
        if re.search(r"^DMIG", text, re.MULTILINE):
            return _nastran(path, chosen), True
        if not text.strip():
            raise ValueError("it is empty")
        lines = io.StringIO(text.replace(",", " "))
        return np.loadtxt(lines, comments=("**", "#", "$"), ndmin=2), True
    except (ValueError, OSError, KeyError, EOFError, zipfile.BadZipFile) as error:
        fail(str(path), f"the file cannot be read as a matrix: {' '.join(str(error).split())}.")


def _archived(path: Path, chosen: str) -> Any:
    if path.suffix == ".npy":
        return np.load(path, allow_pickle=False)
    with np.load(path, allow_pickle=False) as archive:
        if "format" in archive:
            return sparse.load_npz(path)
        names = list(archive)
        if chosen not in names and (chosen or len(names) != 1):
            fail(str(path), f"one of its arrays is expected, as FILE:ARRAY; it has {', '.join(names)}.")
        return archive[chosen or names[0]]


def _nastran(path: Path, chosen: str) -> FloatArray:
    """Read a real square matrix from the DMIG of the bulk data."""
    kind: dict[str, int] = {}
    entries: dict[str, list[tuple[float, ...]]] = {}
    for card in cards(path):
        if card.word != "DMIG":
            continue
        name = card.fields[0].upper()
        if name not in kind:  # the first of a name is its head
            kind[name] = card.whole(2)
            if card.whole(3) not in _REAL:
                fail(card.where, f"a real matrix is expected, but {name} is complex.")
            entries[name] = []
            continue
        column = (card.whole(1), max(card.whole(2), 1))
        for first in range(4, len(card.fields), 4):
            if card.fields[first]:
                row = (card.whole(first), max(card.whole(first + 1), 1))
                entries[name].append((*row, *column, *card.reals(first + 2, 1)))
    wanted = chosen.upper() or (next(iter(kind)) if len(kind) == 1 else "")
    if wanted not in entries or not entries[wanted]:
        fail(str(path), f"one of its matrices is expected, as FILE:MATRIX; it has {', '.join(kind)}.")
    if kind[wanted] not in _SQUARE:
        fail(str(path), f"a square or symmetric matrix is expected, but {wanted} is of form {kind[wanted]}.")
    return np.array(entries[wanted])
