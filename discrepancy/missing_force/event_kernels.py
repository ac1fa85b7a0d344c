"""Loops of the filter with a force that acts at times only, compiled: what was before, and what comes after.

A step leads to a sample by one of four kinds: the force is off at both ends, begins, ends, is on (twice
whether it was on, and whether it is). Where it is off its state is zero; where it begins, that of a process
of which nothing was seen.

Shapes: n states, c channels, N samples, W columns that are filtered alike, J different steps.
"""

import numpy as np
from numpy.typing import NDArray

from .kalman_kernels import is_steady

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


def passed(
    at: int, moves: FloatArray, noises: FloatArray, rows: FloatArray, used: BoolArray, columns: FloatArray,
    cover: FloatArray, mean: FloatArray, products: FloatArray, gains: FloatArray, sizes: FloatArray,
    known: bool,
) -> tuple[FloatArray, FloatArray, float, bool]:  # fmt: skip
    """Return covariance, mean and half the logarithm of the readings' variances after a step and a sample.

    `at` is the step, below zero: none. `products` (W, W), `gains` (c, n) and `sizes` (c,) are brought up to
    date in place; where they are `known`, the covariance is steady, and whether it has become so comes last.
    """
    before, half = cover, 0.0
    if at >= 0:
        mean = moves[at] @ mean
        if not known:
            cover = moves[at] @ cover @ moves[at].T + noises[at]
    for c in range(len(rows)):
        if used[c]:
            if not known:
                weight = cover @ rows[c]
                sizes[c] = rows[c] @ weight + 1.0
                gains[c] = weight / sizes[c]
                keep = np.eye(len(cover)) - np.outer(gains[c], rows[c])
                cover = keep @ cover @ keep.T + np.outer(gains[c], gains[c])
            left = columns[c] - rows[c] @ mean
            mean = mean + np.outer(gains[c], left)
            products += np.outer(left, left) / sizes[c]
            half += 0.5 * np.log(sizes[c])
    return cover, mean, half, known or is_steady(cover, before)


def toggled(
    moves: FloatArray, noises: FloatArray, length: IntArray, on: BoolArray, rows: FloatArray,
    used: BoolArray, columns: FloatArray, begun: FloatArray, starts: IntArray, ends: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return what is known before sample b of `ends`, had the force been the other way since a of `starts`.

    Parameters
    ----------
    moves, noises : (4 J, n, n) ndarray
        Transitions and noises by kind, then by step.
    length : (N,) ndarray
        Which step leads to each sample.
    on : (N,) ndarray
        Whether the force acts from each sample to the next one.
    rows, used, columns : (c, n), (N, c), (N, c, W) ndarray
        Of the readings over their noise, which count, and what is filtered.
    begun : (2, n, n) ndarray
        Covariance at the first sample: the force off, on.
    starts, ends : (A,), (B,) ndarray
        In order; ends reach from 0 to N.

    Returns
    -------
    covers, means, products, halves : (A, B, n, n), (A, B, n, W), (A, B, W, W), (A, B) ndarray
        Covariance and mean before that sample, products of the columns before it as independent numbers of
        variance one, half the logarithm of their variances. Not a number where b is not after a.
    """
    steps, count, n, width = len(moves) // 4, len(on), rows.shape[1], columns.shape[2]
    covers = np.full((len(starts), len(ends), n, n), np.nan)
    means = np.zeros((len(starts), len(ends), n, width))
    products = np.zeros((len(starts), len(ends), width, width))
    halves = np.full((len(starts), len(ends)), np.nan)
    gains, sizes = np.zeros((2, len(rows), n)), np.ones((2, len(rows)))
    cover, mean, product, half = begun[int(on[0])].copy(), np.zeros((n, width)), np.zeros((width, width)), 0.0
    now, last, steady = 0, -1, False  # the sample whose readings are the next along the way as it is
    for a in range(len(starts)):
        while now < starts[a]:
            at = -1 if now == 0 else (2 * int(on[now - 1]) + int(on[now])) * steps + length[now]
            alike = now > 0 and at == last and np.all(used[now] == used[now - 1])
            cover, mean, more, steady = passed(
                at, moves, noises, rows, used[now], columns[now], cover, mean, product, gains[0], sizes[0],
                steady and alike,
            )  # fmt: skip
            half, last, now = half + more, at, now + 1
        own, own_mean, own_product, own_half = cover.copy(), mean.copy(), product.copy(), half
        own_last, own_steady = -1, False
        b = np.searchsorted(ends, starts[a], "right")
        for k in range(starts[a], count + 1):
            was = k > 0 and (on[k - 1] if k == starts[a] else not on[k - 1])
            if b == len(ends):
                break
            if ends[b] == k:
                covers[a, b], means[a, b] = own, own_mean
                if k < count:
                    at = (2 * int(was) + int(on[k])) * steps + length[k]
                    covers[a, b] = moves[at] @ own @ moves[at].T + noises[at]
                    means[a, b] = moves[at] @ own_mean
                products[a, b], halves[a, b] = own_product, own_half
                b += 1
            if k == count:
                break
            at = -1 if k == 0 else (2 * int(was) + int(not on[k])) * steps + length[k]
            if k == 0:
                own = begun[int(not on[0])].copy()
            alike = k > 0 and at == own_last and np.all(used[k] == used[k - 1])
            own, own_mean, more, own_steady = passed(
                at, moves, noises, rows, used[k], columns[k], own, own_mean, own_product, gains[1], sizes[1],
                own_steady and alike,
            )  # fmt: skip
            own_half, own_last = own_half + more, at
    return covers, means, products, halves


def tails(
    moves: FloatArray, roots: FloatArray, length: IntArray, on: BoolArray, rows: FloatArray,
    used: BoolArray, columns: FloatArray, places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return what the readings from samples `places` (B,) on tell of the state there.

    `roots` (4 J, n, n) are those of the noises. Of a state z their logarithm is, for columns in the weights
    w (W,): w h' z - z J z / 2 - w c w / 2 - half.

    Returns
    -------
    J, h, c, half : (B, n, n), (B, n, W), (B, W, W), (B,) ndarray
        Zero from N on.
    """
    steps, count, n, width = len(moves) // 4, len(on), rows.shape[1], columns.shape[2]
    known, along = np.zeros((len(places), n, n)), np.zeros((len(places), n, width))
    products, halves = np.zeros((len(places), width, width)), np.zeros(len(places))
    J, h, c, half = np.zeros((n, n)), np.zeros((n, width)), np.zeros((width, width)), 0.0
    root, inverse, way, more = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n)), 0.0
    b = np.searchsorted(places, count) - 1
    last, steady = -1, False
    for k in range(count - 1, -1, -1):
        alike = k < count - 1 and np.all(used[k] == used[k + 1])
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
        at = (2 * int(on[k - 1]) + int(on[k])) * steps + length[k]
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
