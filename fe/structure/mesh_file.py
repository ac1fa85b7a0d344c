"""Read a mesh file and check its mesh; estimate how much memory its structure takes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from fe.elements.cells import BATCH, jacobians
from fe.full.fronts import analyse
from fe.runtime.errors import MeshError
from reporting.system.memory import available_memory

from .abaqus import read_abaqus
from .deck import Deck
from .mesh import StructureMesh
from .meshio_file import read_by_meshio
from .nastran import read_nastran

_READERS: dict[str, Callable[[Path], Deck]] = {
    ".inp": read_abaqus,
    ".bdf": read_nastran,
    ".nas": read_nastran,
    ".fem": read_nastran,
}
"""Readers of this project by file extension; meshio reads all other files."""

LARGEST_EDGE_SHIFT = 0.3
"""Largest distance of a mid-edge node from the middle of its edge, in lengths of the edge."""


@np.errstate(over="ignore", invalid="ignore")  # an overflow makes the Jacobian fail its check
def read_mesh(
    path: Path, unit: float, unit_name: str, *, in_one_piece: bool = True
) -> StructureMesh:
    """Read a mesh file, in a format given by its extension, and check its mesh.

    Parameters
    ----------
    unit : float
        The file's unit of length [m].
    unit_name : str
        The name of the unit.
    in_one_piece : bool
        Whether a mesh that falls into parts is refused. If not, call `check_connected` later.

    Raises
    ------
    MeshError
        If the file cannot be read, its cells are of an unknown kind or of several, a Jacobian is
        not positive, a mid-edge node lies far from its edge, or the mesh falls into several parts.
    """
    if not path.is_file():
        state = "a folder" if path.is_dir() else "not there"
        raise MeshError(
            f"The mesh file {path} is {state}; `mesh` must name it as seen from the structure file."
        )
    if not path.stat().st_size:
        raise MeshError(f"The mesh file {path} is empty; write it again.")
    reader = _READERS.get(path.suffix.lower(), read_by_meshio)
    mesh = reader(path).mesh(unit, unit_name)
    _check_edges(mesh)
    _check_jacobians(mesh)
    if in_one_piece:
        check_connected(mesh)
    return mesh


def _check_edges(mesh: StructureMesh) -> None:
    """Raise `MeshError` if a mid-edge node lies far from the middle of its edge."""
    corner_count = len(mesh.kind.corners)
    for edge, (start_node, end_node) in enumerate(mesh.kind.edges):
        start, end = mesh.nodes[:, start_node], mesh.nodes[:, end_node]
        mid_edge = mesh.nodes[:, corner_count + edge]
        shift = np.linalg.norm(mid_edge - 0.5 * (start + end), axis=1)
        is_far = shift > LARGEST_EDGE_SHIFT * np.linalg.norm(end - start, axis=1)
        if is_far.any():
            cell = int(is_far.argmax())
            node = mesh.node_numbers[mesh.cells[cell, corner_count + edge]]
            raise MeshError(
                f"{mesh.source}: node {node} of element {mesh.describe_cell(cell)} lies far from "
                "the middle of its edge; the nodes of the element are in another order, or the "
                "edge is bent too much."
            )


def _check_jacobians(mesh: StructureMesh) -> None:
    """Raise `MeshError` if the Jacobian of a cell is not positive everywhere.

    It is checked at the nodes and at the integration points.
    """
    integration_points = mesh.kind.stiffness_rule[0]
    local_points = np.vstack((mesh.kind.node_positions, integration_points))
    least_by_batch = []
    for nodes in np.array_split(mesh.nodes, len(mesh.nodes) // BATCH + 1):
        determinants = np.linalg.det(jacobians(mesh.kind, nodes, local_points))
        least_by_batch.append(determinants.min(axis=1))
    least = np.concatenate(least_by_batch)
    is_bad = ~((least > 0.0) & (least < np.inf))  # also where it is not a number
    if is_bad.any():
        worst = mesh.describe_cell(int(least.argmin()))
        raise MeshError(
            f"{mesh.source}: {is_bad.sum()} of {len(is_bad)} elements are inside out or flat "
            f"(their Jacobian is not positive everywhere), the worst is element {worst}. "
            f"{_remedy_of_bad_elements(mesh)}"
        )


def _remedy_of_bad_elements(mesh: StructureMesh) -> str:
    """Return the advice for cells with a Jacobian that is not positive."""
    if mesh.kind.edges:
        return (
            "At a curved surface make the mesh finer there, or let the mesher optimise its "
            "elements (in Gmsh Mesh.HighOrderOptimize = 2)."
        )
    return "Mesh the part again there, or correct the order of the nodes of these elements."


def check_connected(mesh: StructureMesh) -> None:
    """Raise `MeshError` if the mesh falls into parts that share no node and no interface."""
    # graph from the first node of each element to its other nodes
    cells = mesh.joined_nodes[mesh.cells]
    first_nodes = np.repeat(cells[:, :1], cells.shape[1], axis=1)
    ones = np.ones(cells.size, dtype=np.int8)
    links = (ones, (first_nodes.ravel(), cells.ravel()))
    graph = sparse.coo_array(links, shape=(len(mesh.points), len(mesh.points)))
    _, part_of_node = csgraph.connected_components(graph, directed=False)
    # nodes that follow others at an interface are parts of their own in the graph
    parts, part_of_cell = np.unique(part_of_node[cells[:, 0]], return_inverse=True)
    part_count = len(parts)
    if part_count == 1:
        return
    cell_counts = np.bincount(part_of_cell, minlength=part_count)
    smallest_part = cell_counts.argmin()
    first_cell = int((part_of_cell == smallest_part).argmax())
    raise MeshError(
        f"{mesh.source}: the mesh falls into {part_count} parts that share no node; the smallest, "
        f"of {cell_counts.min()} elements, is around "
        f"{mesh.describe_point(mesh.centres[first_cell])}. Merge the nodes where the parts touch, "
        "or leave parts out."
    )


GIB = 2.0**30
_PROGRAM_BYTES = 0.35 * GIB  # libraries, and the triplets of a part of the cells
_MATRIX_COUNT = 5  # stiffness, its terms, their sum, mass and the residual's copy
_ENTRY_BYTES = 12  # of a sparse matrix
_NUMBER_BYTES = 8  # of a dense matrix
_NUMBERS_OF_PAIR = 9  # components that couple two nodes
_FACTOR_BYTES = 520.0
"""Bytes over unknowns^(4/3) of factors and fronts of a cube, the worst body (340 to 500)."""


def memory_estimate(mesh: StructureMesh) -> float:
    """Estimate the memory [bytes] for assembly and factorisation.

    The fill-in is counted from the order in which the nodes are eliminated.
    """
    # graph of nodes that share a cell
    cell_count, nodes_per_cell = mesh.cells.shape
    cell_of_entry = np.repeat(np.arange(cell_count), nodes_per_cell)
    node_of_entry = mesh.cells.ravel()
    ones = np.ones(len(cell_of_entry), dtype=np.int32)
    nodes_of_cells = sparse.coo_array(
        (ones, (cell_of_entry, node_of_entry)),
        shape=(cell_count, len(mesh.points)),
    )
    graph = (nodes_of_cells.T @ nodes_of_cells).tocsr()
    # nodes in the fronts of the factorisation
    _, fronts = analyse(graph)
    pivots = np.array([front.end - front.start for front in fronts])
    boundary = np.array([len(front.boundary) for front in fronts])
    # pairs of nodes that are held at once: all factors, and the largest front beside them
    factor_pairs = pivots * (pivots + boundary)
    largest_front = (2 * factor_pairs + boundary**2).max()
    most_pairs = factor_pairs.sum() + largest_front
    matrix_bytes = _MATRIX_COUNT * _ENTRY_BYTES * _NUMBERS_OF_PAIR * graph.nnz
    factor_bytes = _NUMBER_BYTES * _NUMBERS_OF_PAIR * most_pairs
    return float(_PROGRAM_BYTES + matrix_bytes + factor_bytes)


def check_memory(mesh: StructureMesh, limit: float | None = None) -> None:
    """Raise `MeshError` if assembly and factorisation would take too much memory.

    `limit` is the allowed memory [bytes], by default what the machine has left.
    """
    allowed_memory = available_memory() if limit is None else limit
    # An upper estimate first, which takes no time; four times as many entries as remain when they
    # are summed.
    entries = _NUMBERS_OF_PAIR * mesh.cells.size * mesh.cells.shape[1]
    matrix_bytes = _MATRIX_COUNT * _ENTRY_BYTES * entries / 4.0
    upper_estimate = _PROGRAM_BYTES + matrix_bytes + _FACTOR_BYTES * mesh.unknowns ** (4.0 / 3.0)
    if upper_estimate <= allowed_memory:
        return
    needed_memory = memory_estimate(mesh)
    if needed_memory > allowed_memory:
        origin = "left on this machine" if limit is None else "allowed"
        raise MeshError(
            f"{mesh.source}: {mesh.unknowns:,} unknowns would take about "
            f"{needed_memory / GIB:.1f} GiB, but {allowed_memory / GIB:.1f} GiB are {origin}; "
            "coarsen the mesh."
        )
