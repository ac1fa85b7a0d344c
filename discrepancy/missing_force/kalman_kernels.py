"""Loops of the Kalman filter and smoother, compiled.

Readings come one at a time, so nothing is inverted; the covariance is updated in Joseph form. It does not
depend on the readings: where it has become steady, steps share one `slot` of gains. The smoother is that of
de Jong (1989, J. American Statistical Association 84, 1085-1088), which needs no inverse either.

Shapes: n states, c channels, N samples, K columns that are filtered alike, J different steps.
"""

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.campaign.sampling import IntArray
from fe.compilation import callable_when_compiled, compiled

SMALL_PART, ORDERS = 0.25, 12
"""Norm of what is summed as a series, and its orders: 1e-16 is left out."""
STEADY = 1e-9
"""A covariance that moves less than this, over the deviations that it holds, is steady."""


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


@compiled
def covariances(
    transitions: FloatArray, noises: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray,
    start: FloatArray,
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Return slots (N,), and by slot gains (S, c, n), variances (S, c), predicted, filtered (S, n, n).

    Given are transitions and noises (J, n, n) of the steps, which (N,) of them leads to each sample, rows
    (c, n) over the noise's deviation, which readings are used (N, c), the covariance before the first sample.
    """
    count, channels, n = len(which), len(rows), len(start)
    slot = np.zeros(count, dtype=np.int64)
    gains, sizes = np.empty((count, channels, n)), np.empty((count, channels))
    predicted, filtered = np.empty((count, n, n)), np.empty((count, n, n))
    cover, last = start.copy(), -1
    for k in range(count):
        if k > 0:
            same = k > 1 and which[k] == which[k - 1] and slot[k - 1] == slot[k - 2]
            if same and np.all(used[k] == used[k - 1]):
                slot[k] = last
                continue
            cover = transitions[which[k]] @ cover @ transitions[which[k]].T + noises[which[k]]
            cover = 0.5 * (cover + cover.T)
            alike = which[k] == which[k - 1] and np.all(used[k] == used[k - 1])
            if alike and k > 1 and is_steady(cover, predicted[last]):
                slot[k] = last
                cover = filtered[last].copy()
                continue
        last += 1
        slot[k] = last
        predicted[last] = cover
        for c in range(channels):
            gains[last, c] = 0.0
            sizes[last, c] = 1.0
            if not used[k, c]:
                continue
            weight = cover @ rows[c]
            size = rows[c] @ weight + 1.0
            gain = weight / size
            for i in range(n):  # from both sides in turn: what the first leaves by rounding the second takes
                for j in range(n):
                    cover[i, j] -= gain[i] * weight[j]
            weight = cover @ rows[c]
            for i in range(n):
                for j in range(n):
                    cover[i, j] += (gain[i] - weight[i]) * gain[j]
            gains[last, c] = gain
            sizes[last, c] = size
        cover = 0.5 * (cover + cover.T)
        filtered[last] = cover
    last += 1
    return (
        slot, gains[:last].copy(), sizes[:last].copy(), predicted[:last].copy(), filtered[:last].copy(),
    )  # fmt: skip


@compiled
def whitened(
    transitions: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray, slot: IntArray,
    gains: FloatArray, sizes: FloatArray, columns: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return columns (N, c, K) as independent numbers of variance one; zero where a reading is not used."""
    count, channels, width = columns.shape
    n = rows.shape[1]
    found = np.zeros((count, channels, width))
    mean, room = np.zeros((n, width)), np.zeros((n, width))
    for k in range(count):
        if k > 0:
            move = transitions[which[k]]
            room[:] = 0.0
            for i in range(n):
                for j in range(n):
                    factor = move[i, j]
                    if factor != 0.0:
                        for w in range(width):
                            room[i, w] += factor * mean[j, w]
            mean, room = room, mean
        at = slot[k]
        for c in range(channels):
            if not used[k, c]:
                continue
            left = found[k, c]
            left[:] = columns[k, c]
            for j in range(n):
                factor = rows[c, j]
                if factor != 0.0:
                    for w in range(width):
                        left[w] -= factor * mean[j, w]
            for j in range(n):
                gain = gains[at, c, j]
                for w in range(width):
                    mean[j, w] += gain * left[w]
            root = np.sqrt(sizes[at, c])
            for w in range(width):
                left[w] /= root
    return found


@compiled
def smoothed(
    transitions: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray, slot: IntArray,
    gains: FloatArray, sizes: FloatArray, readings: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return filtered means (N, n), and what later readings add (N, n): in units of the predicted covariance.

    The smoothed state is the prediction and the predicted covariance times the second.
    """
    count, channels = readings.shape
    n = rows.shape[1]
    means, later, left = np.zeros((count, n)), np.zeros((count, n)), np.zeros((count, channels))
    mean = np.zeros(n)
    for k in range(count):
        if k > 0:
            mean = transitions[which[k]] @ mean
        at = slot[k]
        for c in range(channels):
            if used[k, c]:
                left[k, c] = readings[k, c] - rows[c] @ mean
                mean = mean + gains[at, c] * left[k, c]
        means[k] = mean
    add = np.zeros(n)
    for k in range(count - 1, -1, -1):
        at = slot[k]
        for c in range(channels - 1, -1, -1):
            if used[k, c]:
                add = add + rows[c] * (left[k, c] / sizes[at, c] - gains[at, c] @ add)
        later[k] = add
        if k > 0:
            add = transitions[which[k]].T @ add
    return means, later


@compiled
def between(
    parts: int, fine: FloatArray, fine_noise: FloatArray, which: IntArray, slot: IntArray,
    filtered: FloatArray, means: FloatArray, later: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the smoothed state ((N - 1) parts + 1, n) at and between the samples.

    `fine` and `fine_noise` (J, n, n) belong to a step that is `parts` times smaller.
    """
    count, n = means.shape
    found = np.zeros(((count - 1) * parts + 1, n))
    ways = np.zeros((parts, n, n))
    made, of_step = -1, -1
    for k in range(count - 1):
        step, at = which[k + 1], slot[k]
        if at != made or step != of_step:
            made, of_step = at, step
            cover = filtered[at]
            covers = np.zeros((parts, n, n))
            for p in range(parts):
                covers[p] = cover
                cover = fine[step] @ cover @ fine[step].T + fine_noise[step]
            back = np.eye(n)
            for p in range(parts - 1, -1, -1):
                back = fine[step].T @ back
                ways[p] = covers[p] @ back
        mean = means[k]
        for p in range(parts):
            found[k * parts + p] = mean + ways[p] @ later[k + 1]
            mean = fine[step] @ mean
    found[-1] = means[count - 1]
    return found


@compiled
def variances(
    transitions: FloatArray, which: IntArray, rows: FloatArray, used: BoolArray, slot: IntArray,
    gains: FloatArray, sizes: FloatArray, predicted: FloatArray, shown: FloatArray,
) -> FloatArray:  # fmt: skip
    """Return the smoothed variance (N,) of a row `shown` (n,) of the state."""
    count, channels, n = len(which), len(rows), rows.shape[1]
    found = np.zeros(count)
    know = np.zeros((n, n))
    for k in range(count - 1, -1, -1):
        at = slot[k]
        for c in range(channels - 1, -1, -1):
            if used[k, c]:
                along = know @ gains[at, c]
                size = gains[at, c] @ along + 1.0 / sizes[at, c]
                know = know - np.outer(rows[c], along) - np.outer(along, rows[c])
                know = know + size * np.outer(rows[c], rows[c])
        cover = predicted[at] - predicted[at] @ know @ predicted[at]
        found[k] = max(shown @ cover @ shown, 0.0)
        if k > 0:
            know = transitions[which[k]].T @ know @ transitions[which[k]]
    return found


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
