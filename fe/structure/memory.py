"""How much memory a structure takes, before it is taken."""

from pathlib import Path

import numpy as np
from scipy import sparse

from fe.full.cholesky import analyse
from fe.runtime.errors import MeshError

from .mesh import StructureMesh

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
