"""Compiled loops of inference: one transition of a belief, the forward pass and the backward pass.

Beliefs are kept as logarithms and as they are. A transition is a product of blocks, each applied along its
own axis. Sums over predecessors are formed of the beliefs as they are wherever the sum is at least `SAFE`:
what underflowed then weighs less than one part in 1e27 of it, far below rounding. Elsewhere a single block
sums logarithms. Of a product that would take the product of all predecessors, and where most states are all
but impossible most of its sums underflow: there numbers are carried as value * 2^(512 power). The powers are
whole numbers in floating point, so that the loops are vectorised. Numbers are copied one by one: numba takes
two seconds to compile the copy of an array.
"""

from functools import partial

import numpy as np
from numpy.typing import NDArray

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
STEP = 2.0**-512
LEAST = 2.0**-256
"""Smallest value of a number; the largest is 2^256 times the terms of a sum."""
LOG_STEP = 512.0 * float(np.log(2.0))
LOG_STEP_HIGH = 512.0 * float(np.float32(np.log(2.0)))
"""Of 24 bits, so that its product with a whole number below 2^29 is exact."""
LOG_STEP_LOW = 512.0 * -1.904654299957768e-09
"""The rest of it."""
NOTHING = -(2.0**40)
"""Power of zero."""


_inlined = partial(callable_when_compiled, inline=True)
_counting_nothing = partial(callable_when_compiled, makes_arrays=False, inline=True)


@_counting_nothing
def _exp(value: float) -> float:
    """Return exp(value), without the slow path of the library for values that underflow."""
    return float(np.exp(value)) if value > UNDERFLOW else 0.0


@_counting_nothing
def _apply(lists: Lists, control: int, before: Float, after: Float, work: Float) -> None:
    """Apply every block to numbers (S,) as they are; `work` (S,) is lost.

    The first axis is applied and becomes the last, so that after all blocks the order is as before.
    """
    levels, first_row, start, source, probability, _ = lists
    given = before
    for block in range(len(levels)):
        count = levels[block]
        rest = np.uint64(len(before) // count)
        for level in range(count):
            row, out = first_row[block] + control * count + level, np.uint64(level) * rest
            if len(levels) == 1:
                total = 0.0
                for k in range(start[row], start[row + 1]):
                    total += given[source[k]] * probability[k]
                after[level] = total
                continue
            for i in range(rest):
                after[out + i] = 0.0
            for k in range(start[row], start[row + 1]):
                first, share = source[k] * rest, probability[k]
                for i in range(rest):
                    after[out + i] += given[first + i] * share
        if len(levels) > 1:
            for level in range(count):
                for i in range(rest):
                    work[i * np.uint64(count) + np.uint64(level)] = after[np.uint64(level) * rest + i]
            given = work
    if len(levels) > 1:
        for i in range(len(work)):
            after[i] = work[i]


@_counting_nothing
def _log_sum(begin: int, end: int, source: Unsigned, log_probability: Float, before: Float) -> float:
    """Return the logarithm of the sum over the predecessors begin..end of one level of a single block."""
    largest = -np.inf
    for k in range(begin, end):
        largest = max(largest, before[source[k]] + log_probability[k])
    if largest == -np.inf or end - begin == 1:
        return largest
    total = 0.0
    for k in range(begin, end):
        difference = before[source[k]] + log_probability[k] - largest
        if difference > NEGLIGIBLE:
            total += np.exp(difference)
    return float(largest + np.log(total)) if total > 1.0 else largest


@compiled
def _split(logarithm: Float, value: Float, power: Float) -> None:
    """Fill value, in [2^-256, 2^256], and power of the exponential of each number."""
    for i in range(len(logarithm)):
        if logarithm[i] == -np.inf:
            value[i], power[i] = 0.0, NOTHING
        else:
            steps = np.floor(logarithm[i] / LOG_STEP + 0.5)
            value[i] = np.exp((logarithm[i] - steps * LOG_STEP_HIGH) - steps * LOG_STEP_LOW)
            power[i] = steps


@compiled
def _move_scaled(lists: Lists, control: int, before: Float, after: Float, log_after: Float) -> None:
    """Apply every block to one belief (S,) given as logarithms; nothing underflows on the way."""
    levels, first_row, start, source, probability, _ = lists
    from_value, from_power = np.empty(len(before)), np.empty(len(before))
    to_value, to_power = np.empty(len(before)), np.empty(len(before))
    _split(before, to_value, to_power)
    for block in range(len(levels)):
        from_value, to_value, from_power, to_power = to_value, from_value, to_power, from_power
        count = levels[block]
        rest = len(before) // count
        total, power = np.empty(rest), np.empty(rest)
        for level in range(count):
            row = first_row[block] + control * count + level
            total[:] = 0.0
            power[:] = NOTHING
            for k in range(start[row], start[row + 1]):
                share, share_power = probability[k], 0.0
                while share < LEAST:
                    share, share_power = share / STEP, share_power - 1.0
                first = source[k] * np.uint64(rest)
                value, value_power = (
                    from_value[first : first + np.uint64(rest)],
                    from_power[first : first + np.uint64(rest)],
                )
                for i in range(rest):
                    # What is two steps below the other is 2^-512 of it at most.
                    its = value_power[i] + share_power
                    largest = max(power[i], its)
                    below, its_below = largest - power[i], largest - its
                    weight = 1.0 if below == 0.0 else (STEP if below == 1.0 else 0.0)
                    its_weight = 1.0 if its_below == 0.0 else (STEP if its_below == 1.0 else 0.0)
                    total[i] = total[i] * weight + value[i] * its_weight * share
                    power[i] = largest
            for i in range(rest):
                if 0.0 < total[i] < LEAST:
                    total[i], power[i] = total[i] / STEP, power[i] - 1.0
                to_value[i * count + level] = total[i]
                to_power[i * count + level] = power[i]
    for i in range(len(before)):
        power_of_it = to_power[i]
        scale = 1.0 if power_of_it == 0.0 else (STEP if power_of_it == -1.0 else STEP * STEP)
        after[i] = to_value[i] * scale if power_of_it > -3.0 else 0.0
        log_after[i] = np.log(to_value[i]) + power_of_it * LOG_STEP if to_value[i] > 0.0 else -np.inf


@_inlined
def _move_one(
    lists: Lists, control: int, before: Float, log_before: Float, after: Float, log_after: Float
) -> None:
    """Apply every block to one belief (S,), as it is and as logarithms."""
    levels, _, start, source, _, log_probability = lists
    if len(levels) > 1:
        _move_scaled(lists, control, log_before, after, log_after)
        return
    _apply(lists, control, before, after, after)
    for state in range(len(after)):
        if after[state] >= SAFE:
            log_after[state] = np.log(after[state])
        else:
            row = control * len(after) + state
            log_after[state] = _log_sum(start[row], start[row + 1], source, log_probability, log_before)
            after[state] = _exp(log_after[state])


@compiled
def move(lists: Lists, control: Index, log_before: Float, log_after: Float) -> None:
    """Fill after (B, S) with the logarithms of beliefs one transition later, each under its control (B,)."""
    before, after = np.empty(log_before.shape[1]), np.empty(log_before.shape[1])
    for row in range(len(control)):
        for state in range(len(before)):
            before[state] = _exp(log_before[row, state])
        _move_one(lists, control[row], before, log_before[row], after, log_after[row])


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
    first = np.empty(size)
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
                _move_one(lists, in_force, before, log_before, now, log_now)
            best = -np.inf
            for state in range(size):
                log_now[state] += log_likelihood[twin, t, state]
                best = max(best, log_now[state])
            if best == -np.inf:
                failed[twin] = t
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


@_counting_nothing
def _come_back(
    lists: Lists, control: int, before: Float, log_before: Float, later: Float, now: Float, added: Float
) -> float:
    """Fill now and added (S,) of a single block: p(i) = filtered(i) now(i) + added(i).

    `added` is from where the forecast underflows. Returned is the largest of the ratios later / forecast.
    """
    _, _, start, source, probability, log_probability = lists
    largest = 1.0
    for state in range(len(now)):
        now[state], added[state] = 0.0, 0.0
    for state in range(len(now)):
        if later[state] > 0.0:
            row = control * len(now) + state
            begin, end = start[row], start[row + 1]
            total = 0.0
            for k in range(begin, end):
                total += before[source[k]] * probability[k]
            if total >= SAFE:
                ratio = later[state] / total
                largest = max(largest, ratio)
                for k in range(begin, end):
                    now[source[k]] += probability[k] * ratio
            else:
                log_total = _log_sum(begin, end, source, log_probability, log_before)
                for k in range(begin, end):
                    weight = _exp(log_before[source[k]] + log_probability[k] - log_total)
                    added[source[k]] += weight * later[state]
    return largest


@compiled
def backward_pass(
    forward: Lists, backward: Lists, control: Index, filtered: Float, log_filtered: Float, smoothed: Float
) -> None:
    """Fill the smoothed rows (B, T, S) from the last to the first with p(D_t | D_{t+1}, o_0..o_t).

    p(i) = filtered(i) sum_j T(i, j) later(j) / forecast(j). A smoothed probability that underflows never
    matters again: every entry of an earlier step is a weighted mean of entries of the later one. So only the
    weights need care, where the forecast or the filtered belief underflows.
    """
    twins, steps, size = log_filtered.shape
    levels = forward[0]
    forecast, ratio, work, added = np.empty(size), np.empty(size), np.empty(size), np.zeros(size)
    for twin in range(twins):
        for state in range(size if steps else 0):
            smoothed[twin, steps - 1, state] = filtered[twin, steps - 1, state]
        for t in range(steps - 2, -1, -1):
            now, later, log_now = smoothed[twin, t], smoothed[twin, t + 1], log_filtered[twin, t]
            before, scaled, largest = filtered[twin, t], False, 1.0
            if len(levels) == 1:
                largest = _come_back(forward, control[twin, t], before, log_now, later, now, added)
            else:
                _apply(forward, control[twin, t], before, forecast, work)
                for state in range(size):
                    scaled |= later[state] > 0.0 and forecast[state] < SAFE
                    ratio[state] = later[state] / max(forecast[state], SAFE)
                    largest = max(largest, ratio[state])
                _apply(backward, control[twin, t], ratio, now, work)
            if scaled:
                _move_scaled(forward, control[twin, t], log_now, work, forecast)
                for state in range(size):
                    forecast[state] = (
                        np.log(later[state]) - forecast[state] if later[state] > 0.0 else -np.inf
                    )
                _move_scaled(backward, control[twin, t], forecast, work, ratio)
            least, total = UNDERFLOW - np.log(largest), 0.0
            for state in range(size):
                if scaled:
                    now[state] = _exp(log_now[state] + ratio[state])
                elif before[state] >= SAFE:
                    now[state] *= before[state]
                elif now[state] > 0.0 and log_now[state] > least:
                    now[state] = _exp(log_now[state] + np.log(now[state]))
                else:
                    now[state] = 0.0
                now[state] += added[state]
                total += now[state]
            for state in range(size):
                now[state] /= total


@compiled
def sweep(
    backward: Lists, reward: Float, discount: Float, limit: float, most: int, value: Float, first: Float
) -> tuple[int, float]:
    """Iterate the Bellman equation until the value (S,) changes by `limit` at most, or `most` times.

    Filled are the value and `first` (S, U), the same where a control is taken first; returned are the number
    of sweeps and the last change.
    """
    later, work, change, iterations = np.empty(len(value)), np.empty(len(value)), np.inf, 0
    while True:
        for control in range(len(discount)):
            _apply(backward, control, value, later, work)
            for state in range(len(value)):
                first[state, control] = reward[state, control] + discount[control] * later[state]
        if change <= limit or iterations == most:
            return iterations, change
        change = 0.0
        for state in range(len(value)):
            improved = np.max(first[state])
            change = max(change, abs(improved - value[state]))
            value[state] = improved
        iterations += 1


@compiled
def move_rows(lists: Lists, control: int, rows: NDArray[np.floating]) -> None:
    """Bring beliefs (N, S) as they are one transition further; those of zeros stay."""
    after, work = np.empty_like(rows[0]), np.empty_like(rows[0])
    for row in range(len(rows)):
        if np.any(rows[row]):
            _apply(lists, control, rows[row], after, work)
            for state in range(len(after)):
                rows[row, state] = after[state]
