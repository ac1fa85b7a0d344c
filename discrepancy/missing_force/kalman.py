"""The Kalman filter of a record, forwards, and its counterpart backwards: what both tell together.

What is known before a moment and what the readings after it say (Fraser and Potter 1969, IEEE Transactions on
Automatic Control 14, 387-390) give the evidence of all readings and the state at that moment. Readings come
one at a time, so nothing is inverted forwards; covariance and information are updated in Joseph form. Where
they have become steady they are kept.

Shapes: n states, c channels, N samples, W columns that are filtered alike, S different steps, B places.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled

SMALL_PART, ORDERS = 0.25, 12
"""Norm of what is summed as a series, and its orders: 1e-16 is left out."""
STEADY = 1e-9
"""A covariance that moves less than this, over the deviations that it holds, is steady."""
LEAST_SIZE = 0.5
"""Variance of a reading, over its noise, below which rounding has taken what a force too large left of it."""


@callable_when_compiled
def is_steady(one: FloatArray, other: FloatArray) -> bool:
    """Return whether two covariances (n, n) are the same within `STEADY`."""
    squares = np.diag(one)
    return not np.any(np.abs(one - other) > STEADY * np.sqrt(np.outer(squares, squares)))


@compiled
def discretised(
    generator: FloatArray, intensity: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and noises (J, n, n) of steps of given lengths (J,) [s].

    Series for a small part of a step, which is then doubled: what decays within a step would grow beyond all
    numbers in an exponential of both signs.
    """
    n = len(generator)
    largest = np.max(np.sum(np.abs(generator), axis=1)) if n else 0.0
    moves, noises = np.empty((len(lengths), n, n)), np.empty((len(lengths), n, n))
    for k in range(len(lengths)):
        doublings, part = 0, lengths[k]
        while largest * part > SMALL_PART:
            doublings, part = doublings + 1, 0.5 * part
        move, term = np.eye(n), np.eye(n)
        noise, grown = intensity * part, intensity * part
        for order in range(1, ORDERS):
            term = (generator @ term) * (part / order)
            move = move + term
            grown = (generator @ grown + grown @ generator.T) * (part / (order + 1))
            noise = noise + grown
        for _ in range(doublings):
            noise = move @ noise @ move.T + noise
            move = move @ move
        moves[k], noises[k] = move, 0.5 * (noise + noise.T)
    return moves, noises


@callable_when_compiled
def read(cover: FloatArray, row: FloatArray, gain: FloatArray) -> float:
    """Return the variance of a reading; take it into a covariance (n, n), and fill its gain (n,)."""
    weight = cover @ row
    size = row @ weight + 1.0
    gain[:] = weight / size
    for i in range(len(row)):  # from both sides in turn: what the first leaves by rounding the second takes
        for j in range(len(row)):
            cover[i, j] -= gain[i] * weight[j]
    weight = cover @ row
    for i in range(len(row)):
        for j in range(len(row)):
            cover[i, j] += (gain[i] - weight[i]) * gain[j]
    return float(size)


@compiled
def forward(
    moves: FloatArray, noises: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray,
    columns: FloatArray, first: int, cover: FloatArray, mean: FloatArray, places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
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
    covers, means, white, halves : (B, n, n), (B, n, W), (places[-1] - first, c, W), (B,) ndarray
        State after the last sample read, columns as independent numbers of variance one, half the logarithm
        of the readings' variances; infinite where one has been lost to rounding.
    gains, sizes : (B, c, n), (B, c) ndarray
        Of the readings of that sample; their variances.
    """
    n, width = mean.shape
    channels = len(rows)
    covers, means = np.zeros((len(places), n, n)), np.zeros((len(places), n, width))
    white, halves = np.zeros((places[-1] - first, channels, width)), np.full(len(places), np.inf)
    all_gains, all_sizes = np.zeros((len(places), channels, n)), np.ones((len(places), channels))
    gains, sizes = np.zeros((channels, n)), np.ones(channels)
    cover, mean, room, half = cover.copy(), mean.copy(), np.zeros((n, width)), 0.0
    b, steady = 0, False
    for k in range(first, places[-1] + 1):
        while b < len(places) and places[b] == k:
            covers[b], means[b], halves[b] = cover, mean, half
            all_gains[b], all_sizes[b] = gains, sizes
            b += 1
        if b == len(places):
            break
        alike = k > first + 1 and which[k] == which[k - 1] and bool(np.all(used[k] == used[k - 1]))
        steady = steady and alike
        before = cover
        if k > 0:
            move = moves[which[k]]
            room[:] = 0.0
            for i in range(n):
                for j in range(n):
                    factor = move[i, j]
                    if factor != 0.0:
                        for w in range(width):
                            room[i, w] += factor * mean[j, w]
            mean, room = room, mean
            if not steady:
                cover = move @ cover @ move.T + noises[which[k]]
                cover = 0.5 * (cover + cover.T)
        for c in range(channels):
            if not used[k, c]:
                continue
            row, left = rows[c], white[k - first, c]
            if not steady:
                sizes[c] = read(cover, row, gains[c])
                if not sizes[c] > LEAST_SIZE:
                    return covers, means, white, halves, all_gains, all_sizes
            left[:] = columns[k, c]
            for j in range(n):
                factor = row[j]
                if factor != 0.0:
                    for w in range(width):
                        left[w] -= factor * mean[j, w]
            for j in range(n):
                gain = gains[c, j]
                for w in range(width):
                    mean[j, w] += gain * left[w]
            left /= np.sqrt(sizes[c])
            half += 0.5 * np.log(sizes[c])
        steady = steady or (alike and is_steady(cover, before))
    return covers, means, white, halves, all_gains, all_sizes


@compiled
def later(
    moves: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray, white: FloatArray,
    gains: FloatArray, sizes: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return what readings from a sample on add to the state there, and how well later ones know the next.

    By de Jong (1989, J. American Statistical Association 84, 1085-1088), without an inverse, from what
    `forward` makes of all samples of one column.

    Returns
    -------
    add, know : (N, n), (N, n, n) ndarray
        The smoothed state is the prediction and its covariance C times the first; after the sample's own
        readings its covariance is C - C know C.
    """
    count, n = len(which), rows.shape[1]
    adds, knows = np.zeros((count, n)), np.zeros((count, n, n))
    add, know = np.zeros(n), np.zeros((n, n))
    for k in range(count - 1, -1, -1):
        knows[k] = know
        for c in range(len(rows) - 1, -1, -1):
            if used[k, c]:
                row, gain = rows[c], gains[k, c]
                add = add + row * (white[k, c, 0] / np.sqrt(sizes[k, c]) - gain @ add)
                along = know @ gain
                size = gain @ along + 1.0 / sizes[k, c]
                know = know - np.outer(row, along) - np.outer(along, row) + size * np.outer(row, row)
        adds[k] = add
        move = moves[which[k]]
        add, know = move.T @ add, move.T @ know @ move
    return adds, knows


@compiled
def backward(
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


@compiled
def driven(
    parts: int, fine: FloatArray, begin: FloatArray, end: FloatArray, which: IntArray, start: FloatArray,
    course: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the state (F, n) at the fine stamps under pushes (F, d), straight between them.

    `begin` and `end` (J, n, d): what the pushes at both ends of a fine step do to the state.
    """
    n, width = begin.shape[1], course.shape[1]
    found = np.zeros((len(course), n))
    found[0] = start
    for k in range(len(course) - 1):
        step = which[k // parts + 1]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += fine[step, i, j] * found[k, j]
            for d in range(width):
                total += begin[step, i, d] * course[k, d] + end[step, i, d] * course[k + 1, d]
            found[k + 1, i] = total
    return found


State = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Covariance or information (.., n, n), means or what lies along it (.., n, W), products of columns (.., W,
W), and half a logarithm (..)."""


@dataclass(frozen=True, eq=False)
class Steps:
    """A record as `forward` takes it, but for which of its steps leads to each sample."""

    moves: FloatArray
    noises: FloatArray
    rows: FloatArray
    used: BoolArray
    columns: FloatArray

    @cached_property
    def roots(self) -> FloatArray:
        """Roots of the noises."""
        return _roots(self.noises)

    def begin(self, cover: FloatArray) -> State:
        """Return the state at the first sample, of a covariance."""
        n, width = self.rows.shape[1], self.columns.shape[2]
        return cover, np.zeros((n, width)), np.zeros((width, width)), np.zeros(())

    def before(self, which: IntArray, first: int, state: Sequence[FloatArray], places: IntArray) -> State:
        """Return the states before steps to some samples, from that before the step to the first on."""
        given = self.moves, self.noises, which, self.rows, self.used, self.columns
        covers, means, white, halves, *_ = forward(*given, first, state[0], state[1], places)
        parts = np.split(white.reshape(-1, white.shape[-1]), len(self.rows) * (places[:-1] - first))
        products = np.cumsum([part.T @ part for part in parts], axis=0)
        return covers, means, products + state[2], halves + state[3]

    def after(self, which: IntArray, places: IntArray) -> State:
        """Return what the readings from some samples on tell of the states there."""
        return backward(self.moves, self.roots, which, self.rows, self.used, self.columns, places)


def _roots(covers: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances."""
    values, vectors = np.linalg.eigh(covers)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def joined(before: Sequence[FloatArray], after: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) of whole records from both their parts."""
    cover, mean, products, halves = before
    known, along, later_products, more = after
    root = _roots(cover)
    inner = np.linalg.cholesky(np.eye(cover.shape[-1]) + root.mT @ known @ root)
    seen = np.asarray(np.linalg.solve(inner, root.mT @ (along - known @ mean)))
    cross = mean.mT @ along
    whole = products + later_products - cross - cross.mT + mean.mT @ known @ mean - seen.mT @ seen
    return whole, halves + more + np.log(np.diagonal(inner, axis1=-2, axis2=-1)).sum(-1)
