"""Loops of the filter with a force that acts at times only, compiled: what was before, what comes after.

Shapes: n states, c channels, N samples, W columns that are filtered alike, S different steps.
"""

import numpy as np
from numpy.typing import NDArray

from .kalman_kernels import is_steady

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


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
