"""Compiled loops of inference: one transition of a belief, the forward pass and the backward pass.

Beliefs are kept as logarithms and as they are. A transition is a product of blocks, each applied along its
own axis. Sums over predecessors are formed of the beliefs as they are wherever the sum is at least `SAFE`:
what underflowed then weighs less than one part in 1e27 of it, far below rounding. Elsewhere logarithms are
summed. Numbers are copied one by one: numba takes two seconds to compile the copy of an array.
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
    """Filter B twins over T turns; `failed` (B,) becomes -1, or the row whose observation is impossible.

    log_first (B, S) is the belief in the turn before the first, and control_before (B,) its control; or the
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
    weights need care: where the forecast underflows of what is smoothed, the turn is taken in logarithms.
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
