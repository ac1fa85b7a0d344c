"""Compiled loops of inference: one transition of a belief, the forward pass and the backward pass.

Beliefs are kept as logarithms. A transition is a product of blocks, each applied along its own axis. Where
most states are all but impossible, most of its sums underflow, and to form them in the log domain would take
the product of all predecessors. So within a transition numbers are carried as value * 2^(512 power): they
never underflow. The powers are whole numbers in floating point, so that the loops are vectorised.
"""

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

__all__ = ["Lists", "backward_pass", "forward_pass", "move"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]
Lists = tuple[Index, Index, Index, Index, Float, Float]
"""Levels, first row, start, source, probability and power of `TransitionLists`."""

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
def _move_one(lists: Lists, control: int, before: Float, after: Float) -> None:
    """Apply every block to one belief (S,), both as logarithms.

    The first axis is applied and becomes the last, so that after all blocks the order is as before.
    """
    levels, first_row, start, source, probability, probability_power = lists
    from_value, from_power = np.empty(len(before)), np.empty(len(before))
    to_value, to_power = np.empty(len(before)), np.empty(len(before))
    _split(before, to_value, to_power)
    for block in range(len(levels)):
        from_value[:] = to_value
        from_power[:] = to_power
        count = levels[block]
        rest = len(before) // count
        total, power = np.empty(rest), np.empty(rest)
        for level in range(count):
            row = first_row[block] + control * count + level
            total[:] = 0.0
            power[:] = NOTHING
            for k in range(start[row], start[row + 1]):
                share, share_power = probability[k], probability_power[k]
                first = source[k] * rest
                for i in range(rest):
                    # What is two steps below the other is 2^-512 of it at most.
                    its = from_power[first + i] + share_power
                    largest = max(power[i], its)
                    below, its_below = largest - power[i], largest - its
                    weight = 1.0 if below == 0.0 else (STEP if below == 1.0 else 0.0)
                    its_weight = 1.0 if its_below == 0.0 else (STEP if its_below == 1.0 else 0.0)
                    total[i] = total[i] * weight + from_value[first + i] * its_weight * share
                    power[i] = largest
            for i in range(rest):
                if 0.0 < total[i] < LEAST:
                    total[i], power[i] = total[i] / STEP, power[i] - 1.0
                to_value[i * count + level] = total[i]
                to_power[i * count + level] = power[i]
    for i in range(len(before)):
        after[i] = np.log(to_value[i]) + to_power[i] * LOG_STEP if to_value[i] > 0.0 else -np.inf


@compiled
def move(lists: Lists, control: Index, before: Float, after: Float) -> None:
    """Fill after (B, S) with the logarithms of beliefs one transition later, each under its control (B,)."""
    for row in range(len(control)):
        _move_one(lists, control[row], before[row], after[row])


@compiled
def forward_pass(
    lists: Lists,
    control: Index,
    log_likelihood: Float,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
    failed: Index,
) -> None:
    """Filter B twins over T turns; `failed` (B,) becomes -1, or the row whose observation is impossible.

    The first rows of `log_filtered` (B, T, S) hold the logarithms of the first forecasts.
    """
    for twin in range(len(control)):
        failed[twin] = -1
        for t in range(log_likelihood.shape[1]):
            now = log_filtered[twin, t]
            if t > 0:
                _move_one(lists, control[twin, t - 1], log_filtered[twin, t - 1], now)
            best = -np.inf
            for state in range(len(now)):
                forecast[twin, t, state] = np.exp(now[state])
                now[state] += log_likelihood[twin, t, state]
                best = max(best, now[state])
            if best == -np.inf:
                failed[twin] = t
                break
            filtered[twin, t] = np.exp(now - best)
            total = filtered[twin, t].sum()
            filtered[twin, t] /= total
            log_evidence[twin, t] = best + np.log(total)
            now -= log_evidence[twin, t]


@compiled
def backward_pass(
    forward: Lists, backward: Lists, control: Index, log_filtered: Float, smoothed: Float
) -> None:
    """Fill the smoothed rows (B, T, S) from the last to the first with p(D_t | D_{t+1}, o_0..o_t).

    p(i) = filtered(i) sum_j T(i, j) later(j) / forecast(j). A smoothed probability that underflows never
    matters again: every entry of an earlier step is a weighted mean of entries of the later one.
    """
    twins, steps, size = log_filtered.shape
    forecast, ratio = np.empty(size), np.empty(size)
    for twin in range(twins):
        for t in range(steps - 1, -1, -1):
            ratio[:] = 0.0
            if t < steps - 1:
                _move_one(forward, control[twin, t], log_filtered[twin, t], forecast)
                for state in range(size):
                    later = smoothed[twin, t + 1, state]
                    forecast[state] = np.log(later) - forecast[state] if later > 0.0 else -np.inf
                _move_one(backward, control[twin, t], forecast, ratio)
            smoothed[twin, t] = np.exp(log_filtered[twin, t] + ratio)
            smoothed[twin, t] /= smoothed[twin, t].sum()
