"""Compiled inner loops of inference over transitions that are products of blocks.

Each block is applied along its own axis. Where most states are all but impossible, most sums underflow, and
to form them again in the log domain, as `kernels` does, would take the product of all predecessors. So
numbers are carried as value * 2^(512 power): they never underflow, and need neither logarithm nor
exponential. The powers are whole numbers in floating point, so that the loops are vectorised.
"""

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

__all__ = ["product_backward_pass", "product_forward_pass"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]

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
def _joined(value: float, power: float) -> float:
    """Return a number that is one at most, zero where it underflows."""
    if power < -4.0:
        return 0.0
    while power < 0.0:
        value, power = value * STEP, power + 1.0
    while power > 0.0:
        value, power = value / STEP, power - 1.0
    return value


@compiled
def _apply(
    levels: Index,
    first_row: Index,
    start: Index,
    source: Index,
    probability: Float,
    probability_power: Float,
    control: int,
    from_value: Float,
    from_power: Float,
    to_value: Float,
    to_power: Float,
) -> None:
    """Apply every block to numbers (S,); the result is in the last two arrays, the first two are lost.

    The first axis is applied and becomes the last, so that after all blocks the order is as before.
    """
    for block in range(len(levels)):
        count = levels[block]
        rest = len(from_value) // count
        total, power = np.empty(rest), np.empty(rest)
        for level in range(count):
            row = first_row[block] + control * count + level
            total[:] = 0.0
            power[:] = NOTHING
            for k in range(start[row], start[row + 1]):
                share, share_power = probability[k], probability_power[k]
                value = from_value[source[k] * rest : (source[k] + 1) * rest]
                value_power = from_power[source[k] * rest : (source[k] + 1) * rest]
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
        if block + 1 < len(levels):
            from_value[:] = to_value
            from_power[:] = to_power


@compiled
def product_forward_pass(
    log_prior: Float,
    levels: Index,
    first_row: Index,
    start: Index,
    source: Index,
    probability: Float,
    probability_power: Float,
    control: Index,
    log_likelihood: Float,
    first: int,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
) -> int:
    """Fill the rows from `first` on; return -1, or the row whose observation is impossible.

    Rows before `first` of `log_filtered` hold what came before.
    """
    steps, size = log_likelihood.shape
    before, before_power, after, after_power = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for t in range(first, steps):
        if t == 0:
            _split(log_prior, after, after_power)
        else:
            _split(log_filtered[t - 1], before, before_power)
            _apply(
                levels, first_row, start, source, probability, probability_power, control[t - 1],
                before, before_power, after, after_power,
            )  # fmt: skip
        best = -np.inf
        for state in range(size):
            forecast[t, state] = _joined(after[state], after_power[state])
            log_value = -np.inf
            if after[state] > 0.0:
                log_value = np.log(after[state]) + after_power[state] * LOG_STEP + log_likelihood[t, state]
            log_filtered[t, state] = log_value
            best = max(best, log_value)
        if best == -np.inf:
            return t
        total = 0.0
        for state in range(size):
            difference = log_filtered[t, state] - best
            filtered[t, state] = np.exp(difference) if difference > -746.0 else 0.0
            total += filtered[t, state]
        evidence = best + np.log(total)
        log_evidence[t] = evidence
        for state in range(size):
            filtered[t, state] /= total
            log_filtered[t, state] -= evidence
    return -1


@compiled
def product_backward_pass(
    levels: Index,
    forward_row: Index,
    forward_start: Index,
    forward_source: Index,
    forward_probability: Float,
    forward_power: Float,
    backward_row: Index,
    backward_start: Index,
    backward_source: Index,
    backward_probability: Float,
    backward_power: Float,
    control: Index,
    filtered: Float,
    log_filtered: Float,
    smoothed: Float,
) -> None:
    """Fill the smoothed rows from the last to the first with p(D_t | D_{t+1}, o_0..o_t).

    p(i) = filtered(i) sum_j T(i, j) later(j) / forecast(j).
    """
    steps, size = filtered.shape
    if steps:
        smoothed[steps - 1] = filtered[steps - 1]
    now, now_power, work, work_power = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    after, after_power = np.empty(size), np.empty(size)
    for t in range(steps - 2, -1, -1):
        _split(log_filtered[t], now, now_power)
        work[:] = now
        work_power[:] = now_power
        _apply(
            levels, forward_row, forward_start, forward_source, forward_probability, forward_power,
            control[t], work, work_power, after, after_power,
        )  # fmt: skip
        for state in range(size):
            later = smoothed[t + 1, state]
            work[state], work_power[state] = 0.0, NOTHING
            if later > 0.0:
                power = -after_power[state]
                while later < LEAST:
                    later, power = later / STEP, power - 1.0
                ratio = later / after[state]
                if ratio < LEAST:
                    ratio, power = ratio / STEP, power - 1.0
                work[state], work_power[state] = ratio, power
        _apply(
            levels, backward_row, backward_start, backward_source, backward_probability, backward_power,
            control[t], work, work_power, after, after_power,
        )  # fmt: skip
        total = 0.0
        for state in range(size):
            smoothed[t, state] = _joined(now[state] * after[state], now_power[state] + after_power[state])
            total += smoothed[t, state]
        for state in range(size):
            smoothed[t, state] /= total
