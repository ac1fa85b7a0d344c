"""Nested dissection: an order of elimination for sparse Cholesky factors, from the graph alone.

A graph is cut in two by a small set of vertices, the separator, which is eliminated after both
halves; the halves are cut in the same way. All parts of one depth are cut together, so that the
work is a few passes over arrays. Cuts follow the distances, in edges, from two vertices at distant
ends of a part: for a slender body these are sections across it, whatever the shape of its cells.

References
----------
A. George, "Nested dissection of a regular finite element mesh", SIAM Journal on Numerical Analysis
10 (1973).
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from fe.runtime.arrays import BoolArray, FloatArray, IntArray

CUT_FRACTIONS = (0.4, 0.5, 0.6)
"""Fractions of a part's weight at which a cut is tried."""
LARGEST_HALF = 0.8
"""Largest fraction of a part that a cut may leave on one side."""
_IMBALANCE_WEIGHT = 1.2
_HALVES = 2
_SEPARATOR = 2  # number of the separator among the blocks of a part, after both halves
_BLOCKS = 3


class Cuts(NamedTuple):
    """The best cut of each part of a graph with n vertices.

    Attributes
    ----------
    separator : (n,) array of bool
        Whether a vertex belongs to the separator of its part.
    side : (n,) array of bool
        The side of the separator on which any other vertex lies.
    is_cut : (parts,) array of bool
        Whether a part was cut; the others have no cut with balanced halves.
    """

    separator: BoolArray
    side: BoolArray
    is_cut: BoolArray


def best_cuts(part: IntArray, weight: FloatArray, edges: IntArray) -> Cuts:
    """Find for each part of a graph the cheapest cut into two halves.

    A part is cut at a value of one coordinate of its vertices. The values that are tried leave
    fixed fractions of its weight on either side.

    Parameters
    ----------
    part : (n,) array of int
        Index of the part of each vertex.
    weight : (n,) array
        Weight of each vertex.
    edges : (2, m) array of int
        The two vertices of each edge, both in one part.
    """
    total_weight = np.asarray(np.bincount(part, weights=weight), dtype=np.float64)
    weight_before = np.cumsum(total_weight) - total_weight
    lowest_cost = np.full(len(total_weight), np.inf)
    separator = np.zeros(len(part), dtype=bool)
    side = np.zeros(len(part), dtype=bool)
    for coordinate in _coordinates(part, edges):
        order = np.lexsort((coordinate, part))
        cumulative = np.cumsum(weight[order])
        for fraction in CUT_FRACTIONS:
            # cut each part where this fraction of its weight is reached
            weight_at_cut = weight_before + fraction * total_weight
            cut_vertex = order[np.searchsorted(cumulative, weight_at_cut)]
            cut_coordinate = coordinate[cut_vertex]
            is_above = coordinate > cut_coordinate[part]
            first_is_above, second_is_above = is_above[edges]
            crossing_edges = edges[:, first_is_above != second_is_above]
            for half in (True, False):  # the vertices on either side of the cut separate the halves
                is_in_half = is_above[crossing_edges] == half
                on_cut = np.zeros(len(part), dtype=bool)
                on_cut[crossing_edges[is_in_half]] = True
                cost = _cut_costs(part, weight, total_weight, on_cut, is_above)
                # keep the cuts that cost less than the best cuts before
                is_better = cost < lowest_cost
                lowest_cost[is_better] = cost[is_better]
                is_cut_here = is_better[part]
                separator[is_cut_here] = on_cut[is_cut_here]
                side[is_cut_here] = is_above[is_cut_here]
    return Cuts(separator, side, np.isfinite(lowest_cost))


def _cut_costs(
    part: IntArray,
    weight: FloatArray,
    total: FloatArray,
    on_cut: BoolArray,
    is_above: BoolArray,
) -> FloatArray:
    """Return the cost (parts,) of a cut of each part, infinite if its halves are too uneven.

    The cost is the weight of the separator, increased if the halves are uneven. `on_cut` and
    `is_above` (n,) say whether a vertex is on the cut, and on which side of it; `total` is the
    weight of each part.
    """
    in_upper_half = is_above & ~on_cut
    separator_weight = np.bincount(part, weights=weight * on_cut)
    upper_weight = np.bincount(part, weights=weight * in_upper_half)
    lower_weight = total - separator_weight - upper_weight
    imbalance = (upper_weight - lower_weight) / total
    cost = separator_weight * (1.0 + _IMBALANCE_WEIGHT * imbalance**2)
    larger_half = np.maximum(upper_weight, lower_weight)
    is_too_uneven = larger_half > LARGEST_HALF * total
    cost[is_too_uneven] = np.inf
    return np.asarray(cost)


def _coordinates(part: IntArray, edges: IntArray) -> list[FloatArray]:
    """Return the coordinates (n,) of the vertices along which parts may be cut.

    Each part has two distant ends. The coordinates of a vertex are the difference of its distances
    from the two ends, and each distance by itself, counted in edges.
    """
    size = len(part)
    ones = np.ones(edges.shape[1])
    graph = sparse.coo_array((ones, tuple(edges)), shape=(size, size)).tocsr()

    def distance_from(sources: IntArray) -> FloatArray:
        distance = csgraph.dijkstra(
            graph,
            directed=False,
            unweighted=True,
            indices=sources,
            min_only=True,
        )
        is_connected = np.isfinite(distance)
        # a component that is not connected with the sources counts as the most distant
        largest = distance[is_connected].max()
        return np.asarray(np.where(is_connected, distance, largest + 1.0))

    def most_distant_of_each_part(distance: FloatArray) -> IntArray:
        order = np.lexsort((-distance, part))
        changes_part = np.diff(part[order]) != 0
        is_first_of_part = np.concatenate(([True], changes_part))
        return np.asarray(order[is_first_of_part])

    # an end is the vertex most distant from a vertex that is itself distant
    start = most_distant_of_each_part(np.zeros(size))
    one_end = most_distant_of_each_part(distance_from(start))
    from_one_end = distance_from(one_end)
    from_other_end = distance_from(most_distant_of_each_part(from_one_end))
    return [from_one_end - from_other_end, from_one_end, from_other_end]


class _Parts(NamedTuple):
    """Parts of a graph that are still to be cut.

    Attributes
    ----------
    starts : (p,) array of int
        The first position of each part in the order of elimination.
    vertices : (v,) array of int
        The vertices of all parts.
    part : (v,) array of int
        The number of the part of each vertex.
    """

    starts: IntArray
    vertices: IntArray
    part: IntArray


def elimination_blocks(graph: sparse.csr_array, weight: FloatArray, leaf_weight: float) -> IntArray:
    """Dissect a graph until its parts are light: leaves, and separators between them.

    Leaves and separators follow one another in the order of elimination: of each part first one
    half, then the other, last its separator.

    Parameters
    ----------
    graph : csr (n, n)
        A symmetric pattern; values and diagonal do not count.
    weight : (n,) array
        Weight of the vertices.
    leaf_weight : float
        Parts up to this weight are not cut.

    Returns
    -------
    (n,) array of int
        The first position, in the order of elimination, of the leaf or separator of each vertex.
    """
    size = graph.shape[0]
    # edges from the upper triangle of the symmetric pattern
    entries = graph.tocoo()
    is_upper = entries.row < entries.col
    edges = np.stack((entries.row[is_upper], entries.col[is_upper])).astype(np.int64)
    position = np.zeros(size, dtype=np.int64)
    # the whole graph is the first part
    parts = _Parts(
        starts=np.zeros(1, dtype=np.int64),
        vertices=np.arange(size),
        part=np.zeros(size, dtype=np.int64),
    )
    while True:
        parts = _heavy_parts(parts, weight, leaf_weight)
        vertex_count = len(parts.vertices)
        if not vertex_count:
            return position
        # number the vertices of these parts anew
        new_number = np.full(size, -1)
        new_number[parts.vertices] = np.arange(vertex_count)
        # keep the edges inside parts
        in_parts = (new_number[edges] >= 0).all(axis=0)
        first_position, second_position = position[edges]
        in_one_part = in_parts & (first_position == second_position)
        edges = edges[:, in_one_part]
        cuts = best_cuts(parts.part, weight[parts.vertices], new_number[edges])
        parts = _halves(parts, cuts, position)


def _heavy_parts(parts: _Parts, weight: FloatArray, leaf_weight: float) -> _Parts:
    """Return the parts that are heavier than a leaf."""
    part_count = len(parts.starts)
    part_weight = np.bincount(parts.part, weights=weight[parts.vertices], minlength=part_count)
    is_heavy = part_weight > leaf_weight
    in_heavy_part = is_heavy[parts.part]
    new_number = np.cumsum(is_heavy) - 1
    return _Parts(
        starts=parts.starts[is_heavy],
        vertices=parts.vertices[in_heavy_part],
        part=new_number[parts.part[in_heavy_part]],
    )


def _halves(parts: _Parts, cuts: Cuts, position: IntArray) -> _Parts:
    """Return the halves of the parts that were cut, and set the block of each vertex.

    The blocks are set in `position` (n,), in place.
    """
    # each part that was cut becomes three blocks: two halves (0 and 1) and a separator (2)
    in_cut_part = cuts.is_cut[parts.part]
    vertices = parts.vertices[in_cut_part]
    new_number = np.cumsum(cuts.is_cut) - 1
    block_in_part = np.where(cuts.separator, _SEPARATOR, cuts.side)
    first_block = _BLOCKS * new_number[parts.part]
    block = (first_block + block_in_part)[in_cut_part]
    # the blocks of a part follow one another from its start
    cut_count = int(cuts.is_cut.sum())
    block_count = _BLOCKS * cut_count
    count = np.bincount(block, minlength=block_count).reshape(-1, _BLOCKS)
    count_before = np.cumsum(count, axis=1) - count
    block_starts = parts.starts[cuts.is_cut, np.newaxis] + count_before
    position[vertices] = block_starts.ravel()[block]
    # the halves are the next parts
    cut_part, number_in_part = np.divmod(block, _BLOCKS)
    is_half = number_in_part < _SEPARATOR
    half_number = cut_part * _HALVES + number_in_part
    return _Parts(
        starts=block_starts[:, :_HALVES].ravel(),
        vertices=vertices[is_half],
        part=half_number[is_half],
    )
