"""Symbolic analysis of a sparse matrix: the order of elimination, and the fronts.

A front is a small dense matrix of two kinds of unknowns: those of a leaf or separator of a nested
dissection (its pivots), and later unknowns to which the pivots are coupled (its boundary).
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import sparse

from fe.runtime.arrays import IntArray

from .dissection import elimination_blocks

LEAF_UNKNOWNS = 120
"""Largest number of unknowns in a part of the mesh that is eliminated as one dense front."""


class Front(NamedTuple):
    """Unknowns that are eliminated together, by their positions in the order of elimination.

    Attributes
    ----------
    start, end : int
        The pivots are at positions start to end - 1.
    boundary : (b,) array of int
        Later positions to which the pivots are coupled, ascending.
    parent : int
        Index of the front that receives the Schur complement; -1 if the boundary is empty.
    """

    start: int
    end: int
    boundary: IntArray
    parent: int


def analyse(matrix: sparse.csr_array) -> tuple[IntArray, tuple[Front, ...]]:
    """Find an order of elimination by nested dissection, and the fronts that follow from it.

    Parameters
    ----------
    matrix : csr (n, n)
        A symmetric pattern with a full diagonal; the values do not count.

    Returns
    -------
    order : (n,) array of int
        The unknown at each position of the order.
    fronts : tuple of Front
        The fronts in the order of elimination.
    """
    # unknowns with equal rows, such as those of a node, are ordered as one group
    representatives, group_of_unknown = _groups_of_equal_rows(matrix)
    graph = matrix[representatives][:, representatives]
    group_sizes = np.bincount(group_of_unknown)
    group_weights = group_sizes.astype(np.float64)
    block = elimination_blocks(graph, group_weights, LEAF_UNKNOWNS)
    group_order = np.argsort(block, kind="stable")
    block_starts = np.unique(block)
    group_position = np.empty(len(group_order), dtype=np.int64)
    group_position[group_order] = np.arange(len(group_order))
    # from positions of groups to positions of unknowns
    sizes = group_sizes[group_order]
    offsets = np.concatenate(([0], np.cumsum(sizes)))
    fronts = []
    for group_front in _fronts_of_groups(graph[group_order], group_position, block_starts):
        front = Front(
            start=int(offsets[group_front.start]),
            end=int(offsets[group_front.end]),
            boundary=_positions_of_unknowns(group_front.boundary, sizes, offsets),
            parent=group_front.parent,
        )
        fronts.append(front)
    order = np.argsort(group_position[group_of_unknown], kind="stable")
    return order, tuple(fronts)


def _groups_of_equal_rows(matrix: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Group the unknowns that are coupled to the same unknowns.

    Returns the first unknown of each group, and the group (n,) of each unknown. Rows are compared
    by the sum of random 64-bit keys of their columns. If two different rows ever had the same sum,
    the order of elimination would still be valid, only less efficient.
    """
    random_numbers = np.random.default_rng(1973)
    column_keys = random_numbers.integers(2**63, size=matrix.shape[0], dtype=np.int64)
    key_of_entry = column_keys[matrix.indices]
    row_starts = matrix.indptr[:-1]
    row_sums = np.add.reduceat(key_of_entry, row_starts)
    _, representatives, group = np.unique(
        row_sums,
        return_index=True,
        return_inverse=True,
    )
    return representatives.astype(np.int64), group.astype(np.int64)


def _fronts_of_groups(
    graph: sparse.csr_array, position: IntArray, starts: IntArray
) -> Iterator[Front]:
    """Yield the fronts in positions of groups of unknowns.

    The rows of the graph (g, g) are in the order of elimination; `position` (g,) is the position of
    each group, `starts` (f,) the first position of each front.
    """
    ends = np.append(starts[1:], graph.shape[0])
    front_numbers = np.arange(len(starts))
    front_of_position = np.repeat(front_numbers, ends - starts)
    coupled_positions = position[graph.indices]
    boundaries_of_children: list[list[IntArray]] = [[] for _ in starts]
    for start, end, child_boundaries in zip(
        starts.tolist(), ends.tolist(), boundaries_of_children, strict=True
    ):
        # a front is coupled to what its rows and the boundaries of its children hold
        first_entry = graph.indptr[start]
        last_entry = graph.indptr[end]
        coupled_by_rows = coupled_positions[first_entry:last_entry]
        coupled = np.unique(np.concatenate((coupled_by_rows, *child_boundaries)))
        first_later = np.searchsorted(coupled, end)
        boundary = coupled[first_later:]
        # the parent is the front that eliminates the first position of the boundary
        parent = -1
        if len(boundary):
            parent = int(front_of_position[boundary[0]])
            boundaries_of_children[parent].append(boundary)
        yield Front(start, end, boundary, parent)


def _positions_of_unknowns(groups: IntArray, sizes: IntArray, offsets: IntArray) -> IntArray:
    """Return the positions of all unknowns of some groups.

    `sizes` and `offsets` are the number of unknowns and the first unknown of each group.
    """
    counts = sizes[groups]
    counts_before = np.cumsum(counts) - counts
    first_positions = np.repeat(offsets[groups] - counts_before, counts)
    return np.asarray(first_positions + np.arange(counts.sum()))
