"""Nested dissection: an order of elimination for sparse Cholesky factors, from the graph alone.

A graph is cut in two by a small set of vertices, the separator, which is eliminated after both halves; the
halves are cut in the same way. All parts of one depth are cut together, so that the work is a few passes
over arrays. Cuts follow the distances, in edges, from two vertices at far ends of a part: for a slender body
these are sections across it, whatever the shape of its cells.

References
----------
A. George, "Nested dissection of a regular finite element mesh", SIAM Journal on Numerical Analysis 10 (1973).
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from fe.runtime.arrays import BoolArray, FloatArray, IntArray

CUT_PLACES = (0.4, 0.5, 0.6)
"""Shares of a part's weight at which a cut is tried."""
LARGEST_HALF = 0.8
"""A cut may leave at most this share of a part on one side."""
_IMBALANCE_WEIGHT = 1.2


def best_cut(part: IntArray, weight: FloatArray, ends: IntArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Find the best cut of each part.

    Parameters
    ----------
    part : (n,)
        Number of the part of each vertex.
    weight : (n,)
        Weight of each vertex.
    ends : (2, m)
        Vertices at the ends of each edge, both in one part.

    Returns
    -------
    separator, side : (n,) bool
        Whether a vertex belongs to the separator, and on which side of it the others lie.
    done : (parts,) bool
        Whether a part was cut; the others hang together too closely.
    """
    total = np.bincount(part, weights=weight)
    best = np.full(len(total), np.inf)
    separator, side = np.zeros((2, len(part)), dtype=bool)
    before = np.cumsum(total) - total
    for coordinate in _coordinates(part, ends):
        order = np.lexsort((coordinate, part))
        reached = np.cumsum(weight[order])
        for share in CUT_PLACES:
            middle = order[np.searchsorted(reached, before + share * total)]
            above = coordinate > coordinate[middle][part]
            upper = above[ends]
            crossing = upper[0] != upper[1]
            for half in (True, False):  # the vertices on either side of the cut separate the halves
                on_cut = np.zeros(len(part), dtype=bool)
                on_cut[ends[:, crossing][upper[:, crossing] == half]] = True
                held, beyond = (
                    np.bincount(part, weights=weight * where) for where in (on_cut, above & ~on_cut)
                )
                below = total - held - beyond
                # The weight of the separator, more for uneven halves, infinite for too uneven ones.
                cost = held * (1.0 + _IMBALANCE_WEIGHT * ((beyond - below) / total) ** 2)
                cost[np.maximum(beyond, below) > LARGEST_HALF * total] = np.inf
                better = cost < best
                best[better] = cost[better]
                chosen = better[part]
                separator[chosen], side[chosen] = on_cut[chosen], above[chosen]
    return separator, side, np.isfinite(best)


def _coordinates(part: IntArray, ends: IntArray) -> list[FloatArray]:
    """Distances (n,) from two far ends of each part, and their difference."""
    size = len(part)
    graph = sparse.coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(size, size)).tocsr()

    def distance(sources: IntArray) -> FloatArray:
        found = csgraph.dijkstra(graph, directed=False, unweighted=True, indices=sources, min_only=True)
        reached = np.isfinite(found)
        # a piece that does not hang together with the rest is the farthest of all
        return np.asarray(np.where(reached, found, found[reached].max() + 1.0))

    def farthest(values: FloatArray) -> IntArray:
        order = np.lexsort((-values, part))
        return np.asarray(order[np.concatenate(([True], np.diff(part[order]) != 0))])

    first = distance(farthest(distance(farthest(np.zeros(size)))))
    second = distance(farthest(first))
    return [first - second, first, second]


def elimination_blocks(graph: sparse.csr_array, weight: FloatArray, leaf_weight: float) -> IntArray:
    """Dissect a graph until its parts are light: first place (n,) of each vertex's leaf or separator.

    The leaves and separators follow one another in the order of elimination: of a part first one half, then
    the other, last its separator.

    Parameters
    ----------
    graph : csr (n, n)
        Symmetric pattern; values and diagonal do not count.
    weight : (n,)
        Weight of the vertices.
    leaf_weight : float
        Parts up to this weight are not cut.
    """
    size = graph.shape[0]
    edges = graph.tocoo()
    once = edges.row < edges.col
    ends = np.stack((edges.row[once], edges.col[once])).astype(np.int64)
    place = np.zeros(size, dtype=np.int64)
    # what is still to be cut: the first places of the parts, the vertices and their parts
    first, vertices, part = np.zeros(1, dtype=np.int64), np.arange(size), np.zeros(size, dtype=np.int64)
    while True:
        heavy = np.bincount(part, weights=weight[vertices], minlength=len(first)) > leaf_weight
        first, kept = first[heavy], heavy[part]
        vertices, part = vertices[kept], (np.cumsum(heavy) - 1)[part[kept]]
        if not len(vertices):
            return place
        index = np.full(size, -1)
        index[vertices] = np.arange(len(vertices))
        ends = ends[:, (index[ends] >= 0).all(axis=0) & (place[ends[0]] == place[ends[1]])]
        separator, side, done = best_cut(part, weight[vertices], index[ends])
        kept = done[part]
        vertices = vertices[kept]
        block = (3 * (np.cumsum(done) - 1)[part] + np.where(separator, 2, side))[kept]
        count = np.bincount(block, minlength=3 * int(done.sum())).reshape(-1, 3)
        starts = first[done, None] + np.cumsum(count, axis=1) - count
        place[vertices] = starts.ravel()[block]
        half = block % 3 < 2
        vertices, part, first = vertices[half], (block // 3 * 2 + block % 3)[half], starts[:, :2].ravel()
