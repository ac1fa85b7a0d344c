"""Compiled inner loops of inference over the non-zero transitions.

Beliefs are kept in the log domain. Sums over predecessors are formed in the linear domain wherever the sum is
at least `SAFE`: what underflowed then weighs less than one part in 1e27 of it, far below rounding. Elsewhere
the sum is formed in the log domain. The result is that of the log domain at a third of its cost.
"""

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled

__all__ = ["backward_pass", "forward_pass", "smooth_many", "step_many"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]
Unsigned = NDArray[np.uint64]

SAFE = 1e-280
NEGLIGIBLE = -45.0
"""Terms of a sum smaller than the largest by this many nats lie below its rounding error."""
UNDERFLOW = -746.0
"""The exponential function is zero in double precision below this."""


@compiled
def _exp(value: float) -> float:
    """Return exp(value), without the slow path of the library for values that underflow."""
    return float(np.exp(value)) if value > UNDERFLOW else 0.0


@compiled
def _log_forecast(
    begin: int, end: int, source: Unsigned, log_probability: Float, log_filtered: Float
) -> float:
    """Return the log of the sum over the predecessors begin..end of one state."""
    largest = -np.inf
    for k in range(begin, end):
        largest = max(largest, log_filtered[source[k]] + log_probability[k])
    if largest == -np.inf or end - begin == 1:
        return largest
    total = 0.0
    for k in range(begin, end):
        difference = log_filtered[source[k]] + log_probability[k] - largest
        if difference > NEGLIGIBLE:
            total += np.exp(difference)
    return float(largest + np.log(total)) if total > 1.0 else largest


@compiled
def forward_pass(
    log_prior: Float,
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    log_probability: Float,
    control: Index,
    log_likelihood: Float,
    first: int,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
) -> int:
    """Fill the rows from `first` on; return -1, or the row whose observation is impossible.

    Rows before `first` of `filtered` and `log_filtered` hold what came before.
    """
    steps, size = log_likelihood.shape
    for t in range(first, steps):
        best = -np.inf
        for state in range(size):
            if t == 0:
                log_value = log_prior[state]
                forecast[t, state] = _exp(log_value)
            else:
                row = control[t - 1] * size + state
                total = 0.0
                for k in range(start[row], start[row + 1]):
                    total += filtered[t - 1, source[k]] * probability[k]
                if total >= SAFE:
                    log_value = np.log(total)
                    forecast[t, state] = total
                else:
                    log_value = _log_forecast(
                        start[row], start[row + 1], source, log_probability, log_filtered[t - 1]
                    )
                    forecast[t, state] = _exp(log_value)
            log_value += log_likelihood[t, state]
            log_filtered[t, state] = log_value
            best = max(best, log_value)
        if best == -np.inf:
            return t
        total = 0.0
        for state in range(size):
            filtered[t, state] = _exp(log_filtered[t, state] - best)
            total += filtered[t, state]
        evidence = best + np.log(total)
        log_evidence[t] = evidence
        for state in range(size):
            filtered[t, state] /= total
            log_filtered[t, state] -= evidence
    return -1


@compiled
def backward_pass(
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    log_probability: Float,
    control: Index,
    filtered: Float,
    log_filtered: Float,
    smoothed: Float,
) -> None:
    """Fill the smoothed rows from the last to the first with p(D_t | D_{t+1}, o_0..o_t).

    A smoothed probability that underflows never matters again: every entry of an earlier step is a weighted
    mean of entries of the later one. So only the weights need care, where what they are made of underflows.
    """
    steps, size = filtered.shape
    if steps:
        smoothed[steps - 1] = filtered[steps - 1]
    for t in range(steps - 2, -1, -1):
        for state in range(size):
            smoothed[t, state] = 0.0
        for state in range(size):
            later = smoothed[t + 1, state]
            if later > 0.0:
                row = control[t] * size + state
                begin, end = start[row], start[row + 1]
                forecast = 0.0
                for k in range(begin, end):
                    forecast += filtered[t, source[k]] * probability[k]
                linear = forecast >= SAFE
                if linear:
                    scale = later / forecast
                    log_forecast = np.nan  # formed when the first predecessor needs it
                else:
                    scale = 0.0
                    log_forecast = _log_forecast(begin, end, source, log_probability, log_filtered[t])
                for k in range(begin, end):
                    before = filtered[t, source[k]]
                    if linear and before >= SAFE:
                        smoothed[t, source[k]] += before * probability[k] * scale
                    else:
                        if np.isnan(log_forecast):
                            log_forecast = np.log(forecast)
                        weight = _exp(log_filtered[t, source[k]] + log_probability[k] - log_forecast)
                        smoothed[t, source[k]] += weight * later
        total = 0.0
        for state in range(size):
            total += smoothed[t, state]
        for state in range(size):
            smoothed[t, state] /= total


@compiled
def step_many(
    log_prior: Float,
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    log_probability: Float,
    control: Index,
    first: int,
    log_likelihood: Float,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
    failed: Index,
) -> None:
    """Filter the rows from `first` on of each twin of a batch, as `forward_pass` those of one."""
    for twin in range(len(control)):
        failed[twin] = forward_pass(
            log_prior, start, source, probability, log_probability, control[twin], log_likelihood[twin],
            first, forecast[twin], filtered[twin], log_filtered[twin], log_evidence[twin],
        )  # fmt: skip


@compiled
def smooth_many(
    log_prior: Float,
    start: Unsigned,
    source: Unsigned,
    probability: Float,
    log_probability: Float,
    control: Index,
    log_likelihood: Float,
    forecast: Float,
    filtered: Float,
    log_filtered: Float,
    log_evidence: Float,
    smoothed: Float,
    failed: Index,
) -> None:
    """Filter and smooth each twin of a batch; `failed` gets -1 or the row of an impossible observation."""
    for twin in range(len(control)):
        failed[twin] = forward_pass(
            log_prior, start, source, probability, log_probability, control[twin], log_likelihood[twin], 0,
            forecast[twin], filtered[twin], log_filtered[twin], log_evidence[twin],
        )  # fmt: skip
        if failed[twin] < 0:
            backward_pass(
                start, source, probability, log_probability, control[twin], filtered[twin],
                log_filtered[twin], smoothed[twin],
            )  # fmt: skip
