"""Reading and checking a mesh file: Gmsh, Abaqus and CalculiX, VTU, Nastran and what else meshio reads.

Last how much memory a structure of the mesh takes, before it is taken.
"""

import contextlib
import io
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from fe.elements.cells import BATCH, jacobians
from fe.elements.kinds import meshio_with_wedges
from fe.full.cholesky import analyse
from fe.runtime.errors import MeshError

from .abaqus_file import read_abaqus
from .deck import one_kind
from .mesh import FileMesh, StructureMesh
from .nastran_file import read_nastran

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FLAT = {
    "vertex": 1, "line": 2, "line3": 2, "triangle": 3, "triangle6": 3, "quad": 4, "quad8": 4, "quad9": 4,
}  # fmt: skip
"""Cells that only name nodes and faces, with the number of their corners."""
_READERS: dict[str, Callable[[Path], FileMesh]] = {
    ".inp": read_abaqus, ".bdf": read_nastran, ".nas": read_nastran, ".fem": read_nastran,
}  # fmt: skip
"""Readers of this project; meshio reads what has another ending."""
_MOST_VALUES = 1000
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
    if path.is_dir():
        raise MeshError(
            f"The mesh {path} is a folder; `mesh` must name a mesh file, as seen from the structure file."
        )
    if path.is_file() and not path.stat().st_size:
        raise MeshError(f"The mesh file {path} is empty; write it anew.")
    found = _READERS.get(path.suffix.lower(), _from_meshio)(path)
    if not np.isfinite(found.points).all():
        number = int(found.node_numbers[~np.isfinite(found.points).all(axis=1)][0])
        raise MeshError(f"{path}: the coordinates of node {number} are not finite numbers.")
    mesh = _without_loose_nodes(_each_once(found, path), path, unit, unit_name)
    _check_edges(mesh)
    _check_jacobians(mesh)
    _check_parts(mesh)
    return mesh


def _each_once(found: FileMesh, path: Path) -> FileMesh:
    """Merge elements that Gmsh writes once for each physical group; refuse doubled ones of other files."""
    rows = np.sort(found.cells, axis=1)
    _, first, back = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    twins = found.cell_numbers[np.setdiff1d(np.arange(len(rows)), first)]
    if not len(twins):
        return found
    if path.suffix.lower() != ".msh":
        raise MeshError(
            f"{path}: {len(twins)} elements, such as {twins[0]}, have the nodes of another; delete them."
        )
    kept = np.sort(first)
    place = np.searchsorted(kept, first[back.ravel()])
    return replace(
        found,
        cells=found.cells[kept],
        cell_numbers=found.cell_numbers[kept],
        cell_sets={name: np.unique(place[members]) for name, members in found.cell_sets.items()},
    )


def _without_loose_nodes(found: FileMesh, path: Path, unit: float, unit_name: str) -> StructureMesh:
    used = np.zeros(len(found.points), dtype=bool)
    used[found.cells] = True
    place = np.cumsum(used) - 1
    return StructureMesh(
        source=str(path),
        kind=found.kind,
        points=unit * found.points[used],
        node_numbers=found.node_numbers[used],
        cells=place[found.cells],
        cell_numbers=found.cell_numbers,
        unit=unit,
        unit_name=unit_name,
        node_sets={name: place[nodes[used[nodes]]] for name, nodes in found.node_sets.items()},
        cell_sets=found.cell_sets,
        face_sets={
            name: frozenset(tuple(place[list(face)].tolist()) for face in faces if used[list(face)].all())
            for name, faces in found.face_sets.items()
        },
        loose=found.node_numbers[~used],
        loose_in={name: int((~used[nodes]).sum()) for name, nodes in found.node_sets.items()},
        remarks=found.remarks,
    )


def _check_edges(mesh: StructureMesh) -> None:
    first = len(mesh.kind.corners)
    for number, (a, b) in enumerate(mesh.kind.edges):
        start, end = mesh.nodes[:, a], mesh.nodes[:, b]
        shift = np.linalg.norm(mesh.nodes[:, first + number] - 0.5 * (start + end), axis=1)
        far = shift > LARGEST_EDGE_SHIFT * np.linalg.norm(end - start, axis=1)
        if far.any():
            cell = int(np.flatnonzero(far)[0])
            raise MeshError(
                f"{mesh.source}: node {mesh.node_numbers[mesh.cells[cell, first + number]]} of element "
                f"{mesh.cell_numbers[cell]} at {mesh.place(mesh.centres[cell])} lies far from the middle of "
                "its edge; the nodes of the element stand in another order, or the edge is bent too much."
            )


def _check_jacobians(mesh: StructureMesh) -> None:
    worst, where, count = np.inf, 0, 0
    local = np.vstack((mesh.kind.places, mesh.kind.stiffness_rule[0]))
    for start in range(0, len(mesh.cells), BATCH):
        least = np.linalg.det(jacobians(mesh.kind, mesh.nodes[start : start + BATCH], local)).min(axis=1)
        count += int((~((least > 0.0) & (least < np.inf))).sum())
        if least.min() < worst:
            worst, where = float(least.min()), start + int(least.argmin())
    if count:
        raise MeshError(
            f"{mesh.source}: {count} of {len(mesh.cells)} elements are inside out or flat (their Jacobian is "
            f"not positive everywhere), the worst is element {mesh.cell_numbers[where]} at "
            f"{mesh.place(mesh.centres[where])}."
        )


def _check_parts(mesh: StructureMesh) -> None:
    rows = np.repeat(mesh.cells[:, 0], mesh.cells.shape[1] - 1)
    columns = mesh.cells[:, 1:].ravel()
    graph = sparse.coo_array(
        (np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(len(mesh.points), len(mesh.points))
    )
    count, part = csgraph.connected_components(graph, directed=False)
    if count > 1:
        cells = np.bincount(part[mesh.cells[:, 0]], minlength=count)
        smallest = int(cells.argmin())
        first = int(np.flatnonzero(part[mesh.cells[:, 0]] == smallest)[0])
        raise MeshError(
            f"{mesh.source}: the mesh falls into {count} parts that share no node; the smallest, of "
            f"{cells[smallest]} elements, is around {mesh.place(mesh.centres[first])}. Merge the nodes where "
            "the parts touch, or leave parts out."
        )


def _from_meshio(path: Path) -> FileMesh:
    meshio = meshio_with_wedges()
    if not path.is_file():
        raise MeshError(f"The mesh file {path} is not there.")
    said = io.StringIO()
    try:
        # meshio writes what it thinks of a file to the terminal, and ends the program where it fails.
        with (
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(said),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore")
            found = meshio.read(path)
    except meshio.ReadError as error:
        raise MeshError(
            f"The mesh file {path} cannot be read: {str(error).strip('. ') or 'its format is not known'}; "
            "write it as .msh, .inp, .med or .bdf."
        ) from None
    except OSError as error:
        raise MeshError(f"The mesh file {path} cannot be read: {error.strerror}.") from None
    except SystemExit:
        why = " ".join(said.getvalue().split()).removeprefix("Error: ").rstrip(".")
        raise MeshError(f"The mesh file {path} cannot be read as {path.suffix}: {why}.") from None
    except Exception as error:  # noqa: BLE001 - the readers of formats fail in any way
        raise MeshError(
            f"The mesh file {path} cannot be read as {path.suffix}: the reader (meshio) says {str(error)!r}; "
            "it is damaged, cut off, or of another dialect. Write it anew, or as .msh or .inp."
        ) from None
    counts = Counter[str]()
    for block in found.cells:
        if block.type not in _FLAT:
            counts[block.type] += len(block.data)
    kind = one_kind(str(path), counts)
    numbers = np.cumsum([0, *(len(block.data) for block in found.cells)])
    solid = [number for number, block in enumerate(found.cells) if block.type == kind.file_type]
    cells = np.concatenate([found.cells[number].data for number in solid]).astype(np.int64)
    if path.suffix.lower() == ".med":
        cells = cells[:, kind.mirrored]
    ids = np.concatenate([np.arange(numbers[number], numbers[number + 1]) + 1 for number in solid])
    points = np.zeros((len(found.points), 3))
    points[:, : found.points.shape[1]] = found.points
    node_sets, cell_sets, face_sets = _sets(found, solid)
    return FileMesh(
        kind=kind,
        points=points,
        node_numbers=np.arange(1, len(points) + 1),
        cells=cells,
        cell_numbers=ids,
        node_sets=node_sets,
        cell_sets=cell_sets,
        face_sets=face_sets,
    )


def _sets(
    found: Any, solid: list[int]
) -> tuple[dict[str, IntArray], dict[str, IntArray], dict[str, frozenset[tuple[int, ...]]]]:
    """Collect the sets of nodes, cells and faces: named ones, and the values of integer arrays."""
    offset = dict(zip(solid, np.cumsum([0, *(len(found.cells[n].data) for n in solid)]), strict=False))
    members: dict[str, list[tuple[int, IntArray]]] = {}
    for name, blocks in found.cell_sets.items():
        if not name.startswith("gmsh:"):
            for number, chosen in enumerate(blocks):
                if chosen is not None and len(chosen):
                    members.setdefault(name, []).append((number, np.asarray(chosen, dtype=np.int64)))
    for label, arrays in found.cell_data.items():
        for number in range(len(arrays)):
            for name, chosen in _named(found, label, arrays, number):
                if name not in found.cell_sets:
                    members.setdefault(name, []).append((number, chosen))
    nodes = {name: np.unique(np.asarray(chosen, dtype=np.int64)) for name, chosen in found.point_sets.items()}
    for label, array in found.point_data.items():
        for name, chosen in _named(found, label, [array], 0):
            nodes[name] = np.union1d(nodes.get(name, chosen), chosen)
    cells: dict[str, IntArray] = {}
    faces: dict[str, frozenset[tuple[int, ...]]] = {}
    for name, parts in members.items():
        inside = [offset[number] + chosen for number, chosen in parts if number in offset]
        if inside:
            cells[name] = np.unique(np.concatenate(inside))
            continue
        flat = [(found.cells[number].type, found.cells[number].data[chosen]) for number, chosen in parts]
        nodes.setdefault(name, np.unique(np.concatenate([table.ravel() for _, table in flat])))
        corners = [tuple(sorted(row[: _FLAT[kind]].tolist())) for kind, table in flat for row in table]
        if any(len(row) > 2 for row in corners):
            faces[name] = frozenset(row for row in corners if len(row) > 2)
    return nodes, cells, faces


def _dimension(kind: str) -> int:
    return {1: 0, 2: 1}.get(_FLAT.get(kind, 5), 2 if kind in _FLAT else 3)


def _named(found: Any, label: str, arrays: list[Any], number: int) -> Iterator[tuple[str, IntArray]]:
    """Yield the sets of one of several arrays of integers: each value, by the names that the file has."""
    array = np.asarray(arrays[number])
    if array.ndim != 1 or not np.issubdtype(array.dtype, np.integer):
        return
    values = np.unique(array)
    if len(values) > _MOST_VALUES:
        return
    # MED counts families of named groups; meshio writes a set alone as 0 and -1, others write 1 and 0.
    families = getattr(found, label, {}) if label in ("cell_tags", "point_tags") else {}
    mask = {(-1, 0): 0, (0, 1): 1}.get(tuple(np.unique(np.concatenate(arrays)).tolist()))
    for value in values.tolist():
        names = families.get(value, [f"{label}={value}"])
        if label == "gmsh:physical":
            place = [value, _dimension(found.cells[number].type)]
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


def neighbours(mesh: StructureMesh) -> sparse.csr_array:
    """Nodes that share a cell, csr (nodes, nodes); the values do not count."""
    cells = np.repeat(np.arange(len(mesh.cells), dtype=np.int32), mesh.cells.shape[1])
    shape = (len(mesh.cells), len(mesh.points))
    inside = sparse.coo_array(
        (np.ones(len(cells), dtype=np.int32), (cells, mesh.cells.ravel().astype(np.int32))), shape=shape
    ).tocsr()
    return (inside.T @ inside).tocsr()


def upper_estimate(mesh: StructureMesh) -> float:
    """Bytes that assembly and factorisation take for a bulky body of as many unknowns, from sizes alone."""
    entries = 9 * mesh.cells.size * mesh.cells.shape[1] / 4.0
    return float(_PROGRAM + _MATRICES * _ENTRY * entries + _BULKY * mesh.unknowns ** (4.0 / 3.0))


def analysed_estimate(mesh: StructureMesh) -> float:
    """Bytes that assembly and factorisation take, from the order of elimination that this mesh leads to."""
    graph = neighbours(mesh)
    waiting: dict[int, int] = {}
    factors = peak = 0
    for number, front in enumerate(analyse(graph).fronts):
        pivots, boundary = front.end - front.start, len(front.boundary)
        here = pivots * (pivots + boundary)
        peak = max(peak, factors + sum(waiting.values()) + 2 * here + boundary**2)
        waiting.pop(number, None)
        factors += here
        if front.parent >= 0:
            waiting[front.parent] = waiting.get(front.parent, 0) + boundary**2
    return float(_PROGRAM + _MATRICES * _ENTRY * 9 * graph.nnz + 8 * 9 * peak)


def available_memory() -> float:
    """Bytes that the machine, or the container, has left; infinite where it does not say."""
    left = np.inf
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                left = 1024.0 * float(line.split()[1])
    except (OSError, ValueError, IndexError):
        pass
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = ((group / f"memory.{key}").read_text(encoding="ascii") for key in ("max", "current"))
        left = min(left, float(limit) - float(used))
    except (OSError, ValueError):  # no such files, or the limit is "max"
        pass
    return float(left)


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
    if upper_estimate(mesh) <= allowed:
        return
    needed = analysed_estimate(mesh)
    if needed > allowed:
        raise MeshError(
            f"{mesh.source}: {mesh.unknowns:,} unknowns would take about {needed / GIB:.1f} GiB, but "
            f"{allowed / GIB:.1f} GiB are {'left on this machine' if limit is None else 'allowed'}; coarsen "
            "the mesh."
        )
