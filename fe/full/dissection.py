"""Nested dissection: an order of elimination for sparse Cholesky factors, from the graph alone.

A graph is cut in two by a small set of vertices, the separator, which is eliminated after both halves; the
halves are cut in the same way. All parts of one depth are cut together, so that the work is a few passes
over arrays. Cuts follow the distances, in edges, from two vertices at far ends of a part: for a slender body
these are sections across it, whatever the shape of its cells.

References
----------
A. George, "Nested dissection of a regular finite element mesh", SIAM Journal on Numerical Analysis 10 (1973).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

CUT_PLACES = (0.4, 0.5, 0.6)
"""Shares of a part's weight at which a cut is tried."""
LARGEST_HALF = 0.8
"""A cut may leave at most this share of a part on one side."""
_IMBALANCE_WEIGHT = 1.2


@dataclass(frozen=True)
class SeparatorTree:
    """Tree of separators and leaves; a child's number is greater than its parent's.

    Attributes
    ----------
    place : (n,)
        Number of the separator or leaf that holds each vertex.
    parent : (t,)
        Number of the separator that cut each part from another, -1 for the first.
    """

    place: IntArray
    parent: IntArray

    def postorder(self) -> IntArray:
        """Numbers (t,) of separators and leaves, each after all that hang on it."""
        children: list[list[int]] = [[] for _ in self.parent]
        for number, above in enumerate(self.parent.tolist()):
            if above >= 0:
                children[above].append(number)
        order: list[int] = []
        waiting = [0]
        while waiting:  # parents first and last child first; read backwards, it is a postorder
            number = waiting.pop()
            order.append(number)
            waiting += children[number]
        return np.array(order[::-1], dtype=np.int64)


class _Parts:
    """The parts of one depth that are still to be cut.

    Parameters
    ----------
    part : (n,)
        Number of the part of each vertex.
    weight : (n,)
        Weight of each vertex.
    ends : (2, m)
        Vertices at the ends of each edge, both in one part.
    """

    def __init__(self, part: IntArray, weight: FloatArray, ends: IntArray) -> None:
        self._part, self._weight, self._ends = part, weight, ends
        self._count = int(part.max()) + 1
        self._total = np.bincount(part, weights=weight, minlength=self._count)

    def cut(self) -> tuple[BoolArray, BoolArray, BoolArray]:
        """Find the best cut of each part.

        Returns
        -------
        separator, side : (n,) bool
            Whether a vertex belongs to the separator, and on which side of it the others lie.
        done : (parts,) bool
            Whether a part was cut; the others hang together too closely.
        """
        best = np.full(self._count, np.inf)
        separator, side = np.zeros((2, len(self._part)), dtype=bool)
        before = np.cumsum(self._total) - self._total
        for coordinate in self._coordinates():
            order = np.lexsort((coordinate, self._part))
            reached = np.cumsum(self._weight[order])
            for share in CUT_PLACES:
                middle = order[np.searchsorted(reached, before + share * self._total)]
                above = coordinate > coordinate[middle][self._part]
                upper = above[self._ends]
                crossing = upper[0] != upper[1]
                for half in (True, False):  # the vertices on either side of the cut separate the halves
                    on_cut = np.zeros(len(self._part), dtype=bool)
                    on_cut[self._ends[:, crossing][upper[:, crossing] == half]] = True
                    cost = self._cost(on_cut, above)
                    better = cost < best
                    best[better] = cost[better]
                    chosen = better[self._part]
                    separator[chosen], side[chosen] = on_cut[chosen], above[chosen]
        return separator, side, np.isfinite(best)

    def _cost(self, separator: BoolArray, side: BoolArray) -> FloatArray:
        """Weight of each part's separator, more for uneven halves, infinite for too uneven ones."""
        held, above = (
            np.bincount(self._part, weights=self._weight * where, minlength=self._count)
            for where in (separator, side & ~separator)
        )
        below = self._total - held - above
        too_uneven = np.maximum(above, below) > LARGEST_HALF * self._total
        cost = held * (1.0 + _IMBALANCE_WEIGHT * ((above - below) / self._total) ** 2)
        return np.where(too_uneven, np.inf, cost)

    def _coordinates(self) -> list[FloatArray]:
        """Distances (n,) from two far ends of each part, and their difference."""
        size = len(self._part)
        graph = sparse.coo_array(
            (np.ones(self._ends.shape[1]), tuple(self._ends)), shape=(size, size)
        ).tocsr()

        def distance(sources: IntArray) -> FloatArray:
            found = csgraph.dijkstra(graph, directed=False, unweighted=True, indices=sources, min_only=True)
            reached = np.isfinite(found)
            # a piece that does not hang together with the rest is the farthest of all
            return np.asarray(np.where(reached, found, found[reached].max() + 1.0))

        def farthest(values: FloatArray) -> IntArray:
            order = np.lexsort((-values, self._part))
            part = self._part[order]
            return np.asarray(order[np.concatenate(([True], part[1:] != part[:-1]))])

        first = distance(farthest(distance(farthest(np.zeros(size)))))
        second = distance(farthest(first))
        return [first - second, first, second]


def separator_tree(graph: sparse.csr_array, weight: FloatArray, leaf_weight: float) -> SeparatorTree:
    """Dissect a graph until its parts are light.

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
    place, parent = np.zeros(size, dtype=np.int64), [-1]
    # what is still to be cut: the numbers of the parts in the tree, the vertices and their parts
    names, vertices, part = np.zeros(1, dtype=np.int64), np.arange(size), np.zeros(size, dtype=np.int64)
    while True:
        heavy = np.bincount(part, weights=weight[vertices], minlength=len(names)) > leaf_weight
        names, kept = names[heavy], heavy[part]
        vertices, part = vertices[kept], (np.cumsum(heavy) - 1)[part[kept]]
        if not len(vertices):
            return SeparatorTree(place, np.array(parent, dtype=np.int64))
        index = np.full(size, -1)
        index[vertices] = np.arange(len(vertices))
        ends = ends[:, (index[ends] >= 0).all(axis=0) & (place[ends[0]] == place[ends[1]])]
        separator, side, done = _Parts(part, weight[vertices], index[ends]).cut()
        halves = 2 * (np.cumsum(done) - 1)[part] + side
        kept = done[part] & ~separator
        vertices, part = vertices[kept], halves[kept]
        place[vertices] = len(parent) + part
        parents = np.repeat(names[done], 2).tolist()
        names = len(parent) + np.arange(len(parents))
        parent += parents
