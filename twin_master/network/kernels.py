"""Compiled loops: one transition of a belief, the forward pass and the backward pass, and Gaussian sensors.

Beliefs are kept as logarithms and as they are. A transition is a product of blocks, each applied along its
own axis. Sums over predecessors are formed of the beliefs as they are wherever the sum is at least `SAFE`:
what underflowed then weighs less than one part in 1e27 of it, far below rounding. Elsewhere logarithms are
summed. Numbers are copied one by one: numba takes two seconds to compile the copy of an array.

Observations by sensors are taken by blocks: the innermost loop of each sum runs over those of the block,
which are computed side by side, each as it would be alone.
"""

from functools import partial

import numpy as np

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index, Unsigned

Lists = tuple[Index, Index, Unsigned, Unsigned, Float, Float]
"""The predecessors of levels, block after block, which the loops never write to.

Number of joint levels of each block, and where its rows begin: row `first row + control * levels + level`.
Where each row begins (rows + 1,); the predecessor of a level within its block, the probability of the
transition from it, and the logarithm of that, (non-zeros,) each.
"""

SAFE = 1e-280
NEGLIGIBLE = -45.0
"""Terms of a sum smaller than the largest by this many nats lie below its rounding error."""
UNDERFLOW = -746.0
"""The exponential function is zero in double precision below this."""


_counting_nothing = partial(callable_when_compiled, makes_arrays=False, inline=True)


@_counting_nothing
def _exp(value: float) -> float:
    """Return exp(value), without the slow path of the library for values that underflow."""
    return float(np.exp(value)) if value > UNDERFLOW else 0.0


@_counting_nothing
def apply_blocks(lists: Lists, control: int, before: Float, after: Float, work: Float) -> None:
    """Apply every block to numbers (S,) as they are; `work` (S,) is lost.

    The first axis is applied and becomes the last, so that after all blocks the order is as before.
    """
    levels, first_row, start, source, probability, _ = lists
    given = before
    for block in range(len(levels)):
        count = levels[block]
        rest = np.uint64(len(before) // count)
        for level in range(count):
            row = first_row[block] + control * count + level
            for i in range(rest):
                total = 0.0
                for k in range(start[row], start[row + 1]):
                    total += given[source[k] * rest + i] * probability[k]
                work[i * np.uint64(count) + np.uint64(level)] = total
        for i in range(len(work)):
            after[i] = work[i]
        given = after


@_counting_nothing
def _move(
    lists: Lists, control: int, before: Float, log_before: Float, after: Float, log_after: Float, work: Float
) -> None:
    """Apply every block to one belief (S,), as it is and as logarithms; `work` (2, S) is lost."""
    levels, first_row, start, source, probability, log_probability = lists
    given, log_given = before, log_before
    for block in range(len(levels)):
        count = levels[block]
        rest = np.uint64(len(before) // count)
        for level in range(count):
            row = first_row[block] + control * count + level
            begin, end = start[row], start[row + 1]
            for i in range(rest):
                total, out = 0.0, i * np.uint64(count) + np.uint64(level)
                for k in range(begin, end):
                    total += given[source[k] * rest + i] * probability[k]
                if total >= SAFE:
                    work[0, out], work[1, out] = total, np.log(total)
                    continue
                largest = -np.inf
                for k in range(begin, end):
                    largest = max(largest, log_given[source[k] * rest + i] + log_probability[k])
                total = 0.0
                for k in range(begin, end):
                    difference = log_given[source[k] * rest + i] + log_probability[k] - largest
                    if difference > NEGLIGIBLE:
                        total += np.exp(difference)
                if total > 1.0:
                    largest += np.log(total)
                work[0, out], work[1, out] = _exp(largest), largest
        for i in range(len(before)):
            after[i], log_after[i] = work[0, i], work[1, i]
        given, log_given = after, log_after


@compiled
def forward_pass(
    lists: Lists,
    control: Index,
    log_first: Float,
    control_before: Index,
    log_likelihood: Float,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
    failed: Index,
) -> None:
    """Filter B twins over T steps; `failed` (B,) becomes -1, or the row whose observation is impossible.

    log_first (B, S) is the belief in the step before the first, and control_before (B,) its control; or the
    prior, and -1.
    """
    twins, steps, size = log_likelihood.shape
    first, work = np.empty(size), np.empty((2, size))
    for twin in range(twins):
        failed[twin] = -1
        for state in range(size):
            first[state] = _exp(log_first[twin, state])
        before, log_before = first, log_first[twin]
        for t in range(steps):
            now, log_now = forecast[twin, t], log_filtered[twin, t]
            in_force = control[twin, t - 1] if t > 0 else control_before[twin]
            if in_force < 0:
                for state in range(size):
                    now[state], log_now[state] = before[state], log_before[state]
            else:
                _move(lists, in_force, before, log_before, now, log_now, work)
            best = -np.inf
            for state in range(size):
                log_now[state] += log_likelihood[twin, t, state]
                best = max(best, log_now[state])
            if best == -np.inf:
                failed[twin], log_evidence[twin, t] = t, best
                break
            before, log_before, total = filtered[twin, t], log_now, 0.0
            for state in range(size):
                before[state] = _exp(log_now[state] - best)
                total += before[state]
            evidence = best + np.log(total)
            log_evidence[twin, t] = evidence
            for state in range(size):
                before[state] /= total
                log_now[state] -= evidence


@compiled
def backward_pass(
    forward: Lists, backward: Lists, control: Index, filtered: Float, log_filtered: Float, smoothed: Float
) -> None:
    """Fill the smoothed rows (B, T, S) from the last to the first with p(D_t | D_{t+1}, o_0..o_t).

    p(i) = filtered(i) sum_j T(i, j) later(j) / forecast(j). A smoothed probability that underflows never
    matters again: every entry of an earlier step is a weighted mean of entries of the later one. So only the
    weights need care: where the forecast underflows of what is smoothed, the step is taken in logarithms.
    """
    twins, steps, size = log_filtered.shape
    forecast, ratio, work = np.empty(size), np.empty(size), np.empty((2, size))
    log_forecast, log_ratio, log_back = np.empty(size), np.empty(size), np.empty(size)
    for twin in range(twins):
        for state in range(size if steps else 0):
            smoothed[twin, steps - 1, state] = filtered[twin, steps - 1, state]
        for t in range(steps - 2, -1, -1):
            now, later, in_force = smoothed[twin, t], smoothed[twin, t + 1], control[twin, t]
            before, log_now, low = filtered[twin, t], log_filtered[twin, t], False
            apply_blocks(forward, in_force, before, forecast, work[0])
            for state in range(size):
                low |= later[state] > 0.0 and forecast[state] < SAFE
                ratio[state] = later[state] / max(forecast[state], SAFE)
            best, total = -np.inf, 0.0
            if low:
                _move(forward, in_force, before, log_now, forecast, log_forecast, work)
                for state in range(size):
                    log_ratio[state] = -np.inf
                    if later[state] > 0.0:
                        log_ratio[state] = np.log(later[state]) - log_forecast[state]
                    best = max(best, log_ratio[state])
                for state in range(size):
                    log_ratio[state] -= best  # for the ratios themselves may overflow
                    ratio[state] = _exp(log_ratio[state])
                _move(backward, in_force, ratio, log_ratio, now, log_back, work)
            else:
                apply_blocks(backward, in_force, ratio, now, work[0])
            for state in range(size):
                if low:
                    now[state] = _exp(log_now[state] + (log_back[state] + best))
                elif before[state] >= SAFE:
                    now[state] *= before[state]
                elif now[state] > 0.0:
                    now[state] = _exp(log_now[state] + np.log(now[state]))
                total += now[state]
            for state in range(size):
                now[state] /= total


@compiled
def sweep(
    backward: Lists, reward: Float, discount: Float, policy: Float, limit: float, most: int, value: Float,
    first: Float,
) -> tuple[int, float]:  # fmt: skip
    """Iterate the Bellman equation until the value (S,) changes by `limit` at most, or `most` times.

    The value is that of a policy (S, U), or where that has no rows (0, U) of the best control. Filled are the
    value and `first` (S, U), the same where a control is taken first; returned are the number of sweeps and
    the last change.
    """
    later, work, change, iterations = np.empty(len(value)), np.empty(len(value)), np.inf, 0
    while True:
        for control in range(len(discount)):
            apply_blocks(backward, control, value, later, work)
            for state in range(len(value)):
                first[state, control] = reward[state, control] + discount[control] * later[state]
        if change <= limit or iterations == most:
            return iterations, change
        change = 0.0
        for state in range(len(value)):
            improved = np.sum(policy[state] * first[state]) if len(policy) else np.max(first[state])
            change = max(change, abs(improved - value[state]))
            value[state] = improved
        iterations += 1


LOG_ROOT_TWO_PI = 0.5 * float(np.log(2.0 * np.pi))
BLOCK = 32
"""Observations whose densities of all draws stay in the fast memory of a processor."""
PER_LOG_TWO = 1.0 / float(np.log(2.0))
LOG_TWO_HIGH, LOG_TWO_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
"""Their sum is log 2; the product of the first with a whole number below 2^11 is exact."""
EVEN = 3.00198505138664455042e-6, 2.52448340349684104192e-3, 2.27265548208155028766e-1, 2.0
ODD = 1.26177193074810590878e-4, 3.02994407707441961300e-2, 1.0
"""Of the rational approximation of exp within log(2) / 2 of zero, good to 2e-16 (Moshier 1989, Cephes)."""
LEAST = -708.0
"""The exponential function of what is below is no number of full precision, and nothing beside one."""
ROUNDING = 1e-13
"""What is left of values that were taken apart, as a share of the largest."""


def separated(values: Float, size: float) -> tuple[Float, Float]:
    """Return (N, R) and (R, E) whose product is (N, E) to rounding of numbers of a size.

    A cross approximation with full pivoting: the largest entry that is left, its column and its row are taken
    out until none is left. Sums of products are left to the caller, so that the result does not depend on a
    library or its threads.
    """
    rest, columns, rows = values.copy(), list[Float](), list[Float]()
    while rest.size and len(rows) < min(rest.shape):
        row, column = np.unravel_index(np.argmax(np.abs(rest)), rest.shape)
        pivot = rest[row, column]
        if abs(pivot) <= ROUNDING * size:
            break
        columns.append(rest[:, column].copy())
        rows.append(rest[row] / pivot)
        rest -= columns[-1][:, None] * rows[-1]
    shape = (len(values), values.shape[1])
    return np.array(columns).reshape(-1, shape[0]).T, np.array(rows).reshape(-1, shape[1])


@callable_when_compiled
def _log_sum_exp(exponent: Float, largest: Float, total: Float, mantissa: Float, bits: Index) -> None:
    """Fill total (B,) with log sum exp over rows of exponent (E, B); the other arrays (B,) are for work.

    The exponential function is written out, as a number times a power of two, because a call of one is not
    computed side by side.
    """
    largest[:], total[:] = -np.inf, 0.0
    for e in range(len(exponent)):
        for b in range(len(total)):
            largest[b] = max(largest[b], exponent[e, b])
    power = bits.view(np.float64)
    for e in range(len(exponent)):
        for b in range(len(total)):
            value = max(exponent[e, b] - largest[b], LEAST)
            whole = np.floor(value * PER_LOG_TWO + 0.5)
            rest = (value - whole * LOG_TWO_HIGH) - whole * LOG_TWO_LOW
            square = rest * rest
            even = ((EVEN[0] * square + EVEN[1]) * square + EVEN[2]) * square + EVEN[3]
            odd = rest * ((ODD[0] * square + ODD[1]) * square + ODD[2])
            mantissa[b] = 1.0 + 2.0 * odd / (even - odd)
            bits[b] = (np.int64(whole) + 1023) << 52
        for b in range(len(total)):
            total[b] += mantissa[b] * power[b]
    for b in range(len(total)):
        total[b] = largest[b] + np.log(total[b]) if largest[b] > -np.inf else -np.inf


@compiled
def log_densities(
    shown: Float, mean: Float, inverse: Float, outward: Float, part: Float, function: Float, offset: Float,
    scale: Float, result: Float,
) -> None:  # fmt: skip
    """Fill result (T, S, E) with the log density of each draw, or (T, S, 1) with that of their sum.

    With d the distances in units of the noise it is (|outward d|² - |d|²) / 2 + d part function - offset
    + scale.

    Parameters
    ----------
    shown : (G, T)
    mean, inverse : (S, G)
        The latter is of the deviation, zero where a sensor is lost.
    outward, part : (S, F, G), (S, G, R)
    function, offset, scale : (R, E), (S, E), (S,)
    result : (T, S, E) or (T, S, 1)
        To be filled.
    """
    sensors, draws, parts, factors = len(shown), offset.shape[1], len(function), outward.shape[1]
    for first in range(0, shown.shape[1], BLOCK):
        size = min(BLOCK, shown.shape[1] - first)
        distance, slope = np.empty((sensors, size)), np.empty((parts, size))
        exponent, bits = np.empty((draws, size)), np.empty(size, np.int64)
        square, along, mantissa = np.empty(size), np.empty(size), np.empty(size)
        for s in range(len(mean)):
            square[:], slope[:] = 0.0, 0.0
            for g in range(sensors):
                for b in range(size):
                    distance[g, b] = (shown[g, first + b] - mean[s, g]) * inverse[s, g]
                    square[b] += distance[g, b] * distance[g, b]
                for r in range(parts):
                    for b in range(size):
                        slope[r, b] += distance[g, b] * part[s, g, r]
            for f in range(factors):
                along[:] = 0.0
                for g in range(sensors):
                    for b in range(size):
                        along[b] += outward[s, f, g] * distance[g, b]
                for b in range(size):
                    square[b] -= along[b] * along[b]
            for b in range(size):
                if not square[b] < np.inf:  # an absurd observation
                    square[b], slope[:, b] = np.inf, 0.0
            for e in range(draws):
                for b in range(size):
                    exponent[e, b] = -0.5 * square[b] - offset[s, e]
                for r in range(parts):
                    for b in range(size):
                        exponent[e, b] += slope[r, b] * function[r, e]
            if result.shape[2] == 1:
                _log_sum_exp(exponent, along, square, mantissa, bits)
                exponent[0] = square
            for b in range(size):
                for e in range(result.shape[2]):
                    result[first + b, s, e] = exponent[e, b] + scale[s]
