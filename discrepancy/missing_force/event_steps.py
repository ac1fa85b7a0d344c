"""A record whose force is on or off, as the filter takes it; evidence from what two parts of it tell.

Shapes of the compiled loops: n states, c channels, N samples, W columns that are filtered alike, S different
steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.campaign.sampling import IntArray
from fe.compilation import compiled

from .kalman_kernels import is_steady


@compiled
def heads(
    moves: FloatArray, noises: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray,
    columns: FloatArray, first: int, cover: FloatArray, mean: FloatArray, places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return what the readings of samples `first` to `places` (B,), these left out, tell of the state.

    Parameters
    ----------
    moves, noises : (S, n, n) ndarray
        Transitions and noises.
    which : (N,) ndarray
        Step that leads to each sample.
    rows, used, columns : (c, n), (N, c), (N, c, W) ndarray
        Of the readings over their noise, which count, and what is filtered.
    first : int
        First sample that is read.
    cover, mean : (n, n), (n, W) ndarray
        State after the sample before it; at the first of the record, there.
    places : (B,) ndarray
        In order.

    Returns
    -------
    covers, means, products, halves : (B, n, n), (B, n, W), (B, W, W), (B,) ndarray
        State after the last sample read, products of the columns as independent numbers of variance one,
        half the logarithm of the readings' variances.
    """
    n, width = mean.shape
    covers, means = np.zeros((len(places), n, n)), np.zeros((len(places), n, width))
    products, halves = np.zeros((len(places), width, width)), np.zeros(len(places))
    product, half = np.zeros((width, width)), 0.0
    gains, sizes = np.zeros((len(rows), n)), np.ones(len(rows))
    b, steady = 0, False
    for k in range(first, places[-1] + 1):
        while b < len(places) and places[b] == k:
            covers[b], means[b], products[b], halves[b] = cover, mean, product, half
            b += 1
        if b == len(places):
            break
        alike = k > first + 1 and which[k] == which[k - 1] and bool(np.all(used[k] == used[k - 1]))
        steady = steady and alike
        before = cover
        if k > 0:
            mean = moves[which[k]] @ mean
            if not steady:
                cover = moves[which[k]] @ cover @ moves[which[k]].T + noises[which[k]]
        for c in range(len(rows)):
            if used[k, c]:
                if not steady:
                    weight = cover @ rows[c]
                    sizes[c] = rows[c] @ weight + 1.0
                    gains[c] = weight / sizes[c]
                    keep = np.eye(n) - np.outer(gains[c], rows[c])
                    cover = keep @ cover @ keep.T + np.outer(gains[c], gains[c])
                left = columns[k, c] - rows[c] @ mean
                mean = mean + np.outer(gains[c], left)
                product += np.outer(left, left) / sizes[c]
                half += 0.5 * np.log(sizes[c])
        steady = steady or (alike and is_steady(cover, before))
    return covers, means, products, halves


@compiled
def tails(
    moves: FloatArray, roots: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray,
    columns: FloatArray, places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return what the readings from samples `places` (B,) on tell of the state there.

    `roots` (S, n, n) are those of the noises. Of a state z their logarithm is, for columns in the weights
    w (W,): w h' z - z J z / 2 - w c w / 2 - half.

    Returns
    -------
    J, h, c, half : (B, n, n), (B, n, W), (B, W, W), (B,) ndarray
        Zero from N on.
    """
    count, n, width = len(which), rows.shape[1], columns.shape[2]
    known, along = np.zeros((len(places), n, n)), np.zeros((len(places), n, width))
    products, halves = np.zeros((len(places), width, width)), np.zeros(len(places))
    J, h, c, half = np.zeros((n, n)), np.zeros((n, width)), np.zeros((width, width)), 0.0
    root, inverse, way, more = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), 0.0
    b = np.searchsorted(places, count) - 1
    last, steady = -1, False
    for k in range(count - 1, -1, -1):
        alike = k < count - 1 and bool(np.all(used[k] == used[k + 1]))
        for channel in range(len(rows)):
            if used[k, channel]:
                h += np.outer(rows[channel], columns[k, channel])
                c += np.outer(columns[k, channel], columns[k, channel])
        before = J
        if not (steady and alike):
            read = J.copy()
            for channel in range(len(rows)):
                if used[k, channel]:
                    read += np.outer(rows[channel], rows[channel])
        if b >= 0 and places[b] == k:
            known[b], along[b], products[b], halves[b] = read, h, c, half
            b -= 1
        if b < 0:
            break
        at = which[k]
        if not (steady and alike and at == last):
            root = roots[at]
            inner = np.eye(n) + root.T @ read @ root
            more = 0.5 * np.log(np.linalg.det(inner))
            inverse = np.ascontiguousarray(np.linalg.inv(inner))
            gain = read @ root @ inverse
            keep = np.eye(n) - gain @ root.T  # Joseph's form, of the information
            J = moves[at].T @ (keep @ read @ keep.T + gain @ gain.T) @ moves[at]
            J = 0.5 * (J + J.T)
            way = np.ascontiguousarray(moves[at].T @ keep)
            steady = alike and at == last and is_steady(J, before)
        along_root = root.T @ h
        c -= along_root.T @ inverse @ along_root
        half += more
        h = way @ h
        last = at
    return known, along, products, halves


States = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Steps:
    """A record as the kernels take it, in steps that are `parts` times smaller than its own."""

    moves: FloatArray
    noises: FloatArray
    length: IntArray
    rows: FloatArray
    used: BoolArray
    columns: FloatArray
    begun: FloatArray

    @cached_property
    def roots(self) -> FloatArray:
        """Roots of the noises."""
        return _roots(self.noises)

    def which(self, on: BoolArray) -> IntArray:
        """Return the step (N,) that leads to each sample, the force acting from some on."""
        kind = 2 * np.r_[False, on[:-1]] + on
        return np.asarray(kind * (len(self.moves) // 4) + self.length)

    def before(self, on: BoolArray, first: int, state: Sequence[FloatArray], places: IntArray) -> States:
        """Return the states before steps to some samples, from that before the step to the first on."""
        given = self.moves, self.noises, self.which(on), self.rows, self.used, self.columns
        cover, mean, products, halves = heads(*given, first, state[0], state[1], places)
        return cover, mean, products + state[2], halves + state[3]

    def after(self, on: BoolArray, places: IntArray) -> States:
        """Return what the readings from some samples on tell of the states there."""
        return tails(self.moves, self.roots, self.which(on), self.rows, self.used, self.columns, places)

    def begin(self, on: bool) -> States:
        """Return the state at the first sample."""
        n, width = self.rows.shape[1], self.columns.shape[2]
        return self.begun[int(on)], np.zeros((n, width)), np.zeros((width, width)), np.zeros(())


def _roots(covers: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances."""
    values, vectors = np.linalg.eigh(covers)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def _turned(items: FloatArray) -> FloatArray:
    return np.swapaxes(items, -1, -2)


def joined(before: Sequence[FloatArray], after: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) of whole records from both their parts."""
    cover, mean, products, halves = before
    known, along, later, more = after
    root = _roots(cover)
    inner = np.linalg.cholesky(np.eye(cover.shape[-1]) + _turned(root) @ known @ root)
    seen = np.asarray(np.linalg.solve(inner, _turned(root) @ (along - known @ mean)))
    cross = _turned(mean) @ along
    whole = products + later - cross - _turned(cross) + _turned(mean) @ known @ mean - _turned(seen) @ seen
    return whole, halves + more + np.log(np.diagonal(inner, axis1=-2, axis2=-1)).sum(-1)
