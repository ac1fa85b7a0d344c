"""Compiled loops: transitions of a belief, the forward and the backward pass, and value iteration.

A belief is kept both as probabilities and as their logarithms. A transition is a product of blocks,
each applied along its own axis of the joint state. A sum over predecessors is formed of the
probabilities if the sum is at least `SAFE`: terms that underflowed are then less than one part in
1e27 of it, far below rounding. Otherwise the sum is formed of the logarithms. Logarithms of other
sums, which only the result needs, are computed side by side after the last block.

Numbers are copied one by one, because numba takes two seconds to compile the copy of an array.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index, Unsigned
from twin_master.network.gaussian_kernels import (
    LEAST_EXPONENT,
    fill_exponentials,
    fill_logarithms,
)

SAFE = 1e-280
"""A sum of probabilities that is larger has lost nothing by underflow."""
NEGLIGIBLE = 1e-292
"""Smoothed probabilities that are smaller count as zero in earlier steps."""
NEGLIGIBLE_LOG = -45.0
"""Terms of a sum that are smaller than its largest by this many nats are rounding errors."""
UNDERFLOW_LOG = -746.0
"""The exponential function is zero in double precision below this."""
FAR_BELOW_LOG = UNDERFLOW_LOG + float(np.log(SAFE))
"""A number of smaller logarithm is still zero if it is divided by `SAFE`."""


class PredecessorLists(NamedTuple):
    """The predecessors of each level of the blocks of a transition, one block after the other.

    A row lists the predecessors of one level under one control. Row `first_row[block] + control *
    levels[block] + level` has the entries from `start[row]` up to `start[row + 1]`.

    Attributes
    ----------
    levels : (blocks,) array
        The number of levels of each block.
    first_row : (blocks,) array
        The first row of each block.
    start : (rows + 1,) array
        The first entry of each row.
    predecessor : (entries,) array
        The level within its block from which the transition starts.
    probability, log_probability : (entries,) array
        The probability of the transition, and its logarithm.
    """

    levels: Index
    first_row: Index
    start: Unsigned
    predecessor: Unsigned
    probability: Float
    log_probability: Float


_makes_no_arrays = partial(callable_when_compiled, makes_arrays=False, inline=True)
"""Decorator of short functions that only read and fill arrays: numba does not count references."""


@_makes_no_arrays
def _exp(value: float) -> float:
    """Return exp(value), without the slow path of the library for values that underflow."""
    return float(np.exp(value)) if value > UNDERFLOW_LOG else 0.0


@_makes_no_arrays
def _log(probability: Float, log_if_small: Float, index: int) -> float:
    """Return the logarithm of an entry of `probability`, which is known if it is below `SAFE`."""
    value = probability[index]
    return float(np.log(value)) if value >= SAFE else float(log_if_small[index])


@_makes_no_arrays
def _sum_over_predecessors(
    lists: PredecessorLists, block: int, control: int, source: Float, sums: Float
) -> None:
    """Fill `sums` (S,) with the numbers `source` (S,) after one block of a transition.

    The block is applied along the first axis of the joint state.
    """
    levels, first_row, start, predecessor, probability, _ = lists
    level_count = levels[block]
    inner_count = np.int64(len(source)) // level_count  # joint levels of the other blocks
    row = first_row[block] + control * level_count
    if inner_count == 1:  # a single block: a shorter loop, because each state has few predecessors
        end_entry = start[row]
        for level in range(level_count):
            first_entry = end_entry
            end_entry = start[row + level + 1]
            total = 0.0
            for k in range(first_entry, end_entry):
                total += source[predecessor[k]] * probability[k]
            sums[level] = total
        return
    for level in range(level_count):
        sums_of_level = sums[level * inner_count : (level + 1) * inner_count]
        for i in range(inner_count):
            sums_of_level[i] = 0.0
        for k in range(start[row + level], start[row + level + 1]):
            first = np.int64(predecessor[k]) * inner_count
            before = source[first : first + inner_count]
            for i in range(inner_count):
                sums_of_level[i] += before[i] * probability[k]


@_makes_no_arrays
def _rotate_axes(level_count: int, numbers: Float, rotated: Float) -> None:
    """Fill `rotated` (S,) with `numbers` (S,), whose first axis becomes the last one."""
    inner_count = len(numbers) // level_count
    if inner_count == 1:
        for level in range(level_count):
            rotated[level] = numbers[level]
        return
    for level in range(level_count):
        for i in range(inner_count):
            rotated[i * level_count + level] = numbers[level * inner_count + i]


@_makes_no_arrays
def apply_blocks(
    lists: PredecessorLists, control: int, before: Float, after: Float, work: Float
) -> None:
    """Apply all blocks of a transition to the numbers `before` (S,), and fill `after` (S,).

    Each block is applied along the first axis of the joint state, which then becomes the last one.
    So after all blocks the axes are in their first order again. `work` (S,) is work space.
    """
    source = before
    for block in range(len(lists.levels)):
        _sum_over_predecessors(lists, block, control, source, work)
        _rotate_axes(lists.levels[block], work, after)
        source = after


@_makes_no_arrays
def _move_belief(
    lists: PredecessorLists,
    control: int,
    before: Float,
    log_before: Float,
    after: Float,
    log_after: Float,
    work: Float,
    bits: Index,
) -> None:
    """Move a belief by one transition: fill `after` (S,), and `log_after` with its logarithm.

    The axes are treated as in `apply_blocks`. `work` (2, S) and `bits` (S,) are work space.
    """
    levels, first_row, start, predecessor, _, log_probability = lists
    source = before
    log_source = log_before
    for block in range(len(levels)):
        level_count = levels[block]
        inner_count = np.int64(len(before)) // level_count
        _sum_over_predecessors(lists, block, control, source, work[0])
        for target in range(len(before)):
            if work[0, target] >= SAFE:
                continue
            # Terms may have underflowed. Log of the sum, from the logarithms of its terms,
            # relative to the largest.
            level = target // inner_count
            other_levels = np.uint64(target - level * inner_count)
            row = first_row[block] + control * level_count + level
            largest = -np.inf
            for k in range(start[row], start[row + 1]):
                log_term = log_probability[k] + _log(
                    source, log_source, predecessor[k] * np.uint64(inner_count) + other_levels
                )
                largest = max(largest, log_term)
            total = 0.0
            for k in range(start[row], start[row + 1]):
                log_term = log_probability[k] + _log(
                    source, log_source, predecessor[k] * np.uint64(inner_count) + other_levels
                )
                difference = log_term - largest
                if difference == 0.0:
                    total += 1.0
                elif difference > NEGLIGIBLE_LOG:
                    total += np.exp(difference)
            if total > 1.0:
                largest += np.log(total)
            work[0, target] = _exp(largest)
            work[1, target] = largest
        _rotate_axes(level_count, work[0], after)
        _rotate_axes(level_count, work[1], log_after)
        source = after
        log_source = log_after
    # The logarithms of the other sums, which only the result needs.
    for i in range(len(before)):
        work[0, i] = max(after[i], SAFE)
    fill_logarithms(work[0], work[1], bits)
    for i in range(len(before)):
        log_after[i] = work[1, i] if after[i] >= SAFE else log_after[i]


@compiled
def forward_pass(
    lists: PredecessorLists,
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
    """Filter the beliefs of B twins over T steps, forward in time.

    Parameters
    ----------
    control : (B, T) array
        The control in force in each step.
    log_first : (B, S) array
        The log belief in the step before the first one; or the log prior.
    control_before : (B,) array
        The control in force in that step; or -1 if `log_first` is the prior.
    log_likelihood : (B, T, S) array
        log p(o_t | D_t, u_t).
    forecast, filtered, log_filtered : (B, T, S) array
        To be filled: the belief before and after each observation, and the logarithm of the latter.
    log_evidence : (B, T) array
        To be filled: log p(o_t | o_0..o_{t-1}).
    failed : (B,) array
        To be filled: the first step whose observation is impossible, or -1. Later steps of such a
        twin are not filled.
    """
    twins, steps, state_count = log_likelihood.shape
    first = np.empty(state_count)
    work = np.empty((2, state_count))
    bits = np.empty(state_count, np.int64)
    power = bits.view(np.float64)
    for twin in range(twins):
        failed[twin] = -1
        for state in range(state_count):
            first[state] = _exp(log_first[twin, state])
        before = first
        log_before = log_first[twin]
        for t in range(steps):
            forecast_now = forecast[twin, t]
            log_now = log_filtered[twin, t]
            # Forecast.
            control_in_force = control[twin, t - 1] if t > 0 else control_before[twin]
            if control_in_force < 0:
                for state in range(state_count):
                    forecast_now[state] = before[state]
                    log_now[state] = log_before[state]
            else:
                _move_belief(
                    lists, control_in_force, before, log_before, forecast_now, log_now, work, bits
                )
            # Times the likelihood.
            largest = -np.inf
            for state in range(state_count):
                log_now[state] += log_likelihood[twin, t, state]
                largest = max(largest, log_now[state])
            if largest == -np.inf:
                failed[twin] = t
                log_evidence[twin, t] = largest
                break
            # Normalisation.
            before = filtered[twin, t]
            log_before = log_now
            for state in range(state_count):
                work[0, state] = largest
            fill_exponentials(log_now, work[0], work[1], bits)
            total = 0.0
            for state in range(state_count):
                is_possible = log_now[state] - largest > LEAST_EXPONENT
                before[state] = work[1, state] * power[state] if is_possible else 0.0
                total += before[state]
            evidence = largest + np.log(total)
            log_evidence[twin, t] = evidence
            for state in range(state_count):
                before[state] /= total
                log_now[state] -= evidence


@compiled
def backward_pass(
    forward: PredecessorLists,
    backward: PredecessorLists,
    control: Index,
    filtered: Float,
    log_filtered: Float,
    smoothed: Float,
) -> None:
    """Smooth the beliefs of B twins over T steps, backward in time.

    With the transition T from a step to the next one, the smoothed belief `later` of the next step,
    and the forecast of the next step from the filtered belief of this one,

        smoothed(i) = filtered(i) sum_j T(i, j) later(j) / forecast(j).

    A smoothed probability below `NEGLIGIBLE` never matters again: every entry of an earlier step is
    a weighted mean of entries of the later one. So only the weights need care: if the forecast of
    another state underflows, the step is taken in logarithms.

    Parameters
    ----------
    control : (B, T) array
        The control in force in each step.
    filtered, log_filtered : (B, T, S) array
        The filtered beliefs and their logarithms.
    smoothed : (B, T, S) array
        To be filled: p(D_t | o_0..o_{T-1}).
    """
    twins, steps, state_count = log_filtered.shape
    forecast = np.empty(state_count)
    ratio = np.empty(state_count)
    work = np.empty((2, state_count))
    bits = np.empty(state_count, np.int64)
    log_forecast = np.empty(state_count)
    log_ratio = np.empty(state_count)
    log_back = np.empty(state_count)
    for twin in range(twins):
        for state in range(state_count if steps else 0):
            smoothed[twin, steps - 1, state] = filtered[twin, steps - 1, state]
        for t in range(steps - 2, -1, -1):
            now = smoothed[twin, t]
            later = smoothed[twin, t + 1]
            control_in_force = control[twin, t]
            before = filtered[twin, t]
            log_now = log_filtered[twin, t]
            # Ratio of the smoothed belief of the later step to its forecast.
            underflows = False
            apply_blocks(forward, control_in_force, before, forecast, work[0])
            for state in range(state_count):
                is_relevant = later[state] > NEGLIGIBLE
                underflows |= is_relevant and forecast[state] < SAFE
                ratio[state] = later[state] / max(forecast[state], SAFE) if is_relevant else 0.0
            # The ratio, carried back through the transition.
            largest = -np.inf
            if underflows:
                _move_belief(
                    forward, control_in_force, before, log_now, forecast, log_forecast, work, bits
                )
                for state in range(state_count):
                    log_of_ratio = np.log(later[state]) - log_forecast[state]
                    log_ratio[state] = log_of_ratio if later[state] > NEGLIGIBLE else -np.inf
                    largest = max(largest, log_ratio[state])
                for state in range(state_count):
                    log_ratio[state] -= largest  # because the ratios themselves may overflow
                    ratio[state] = _exp(log_ratio[state])
                _move_belief(
                    backward, control_in_force, ratio, log_ratio, now, log_back, work, bits
                )
            else:
                apply_blocks(backward, control_in_force, ratio, now, work[0])
            # Times the filtered belief, and normalisation.
            total = 0.0
            for state in range(state_count):
                if underflows:
                    now[state] = _exp(log_now[state] + (log_back[state] + largest))
                elif before[state] >= SAFE:
                    now[state] *= before[state]
                elif log_now[state] < FAR_BELOW_LOG:
                    now[state] = 0.0
                elif now[state] > 0.0:
                    now[state] = _exp(log_now[state] + np.log(now[state]))
                total += now[state]
            for state in range(state_count):
                now[state] /= total


@compiled
def sweep_bellman(
    backward: PredecessorLists,
    reward: Float,
    discount: Float,
    policy: Float,
    tolerance: float,
    most_sweeps: int,
    value: Float,
    action_value: Float,
) -> tuple[int, float]:
    """Iterate the Bellman equation until the value changes by `tolerance` at most.

    Parameters
    ----------
    reward : (S, U) array
        The expected reward of one step.
    discount : (U,) array
        The discount factor of each control.
    policy : (S, U) or (0, U) array
        The policy whose value is computed. If it has no rows, the best control is taken instead.
    tolerance : float
        The largest change of the value at the end.
    most_sweeps : int
        The number of sweeps after which the iteration stops.
    value : (S,) array
        The value to begin with; updated in place.
    action_value : (S, U) array
        To be filled: the value of each control if it is taken first.

    Returns
    -------
    sweeps : int
        The number of sweeps.
    change : float
        The last change of the value.
    """
    expected_value = np.empty(len(value))
    work = np.empty(len(value))
    change = np.inf
    sweeps = 0
    while True:
        for control in range(len(discount)):
            apply_blocks(backward, control, value, expected_value, work)
            for state in range(len(value)):
                action_value[state, control] = (
                    reward[state, control] + discount[control] * expected_value[state]
                )
        if change <= tolerance or sweeps == most_sweeps:
            return sweeps, change
        change = 0.0
        for state in range(len(value)):
            # In loops: sums and maxima of NumPy take seconds to compile, and their machine code
            # needs numba's compiler whenever it is read.
            if len(policy):
                new_value = 0.0
                for control in range(len(discount)):
                    new_value += policy[state, control] * action_value[state, control]
            else:
                new_value = action_value[state, 0]
                for control in range(1, len(discount)):
                    new_value = max(new_value, action_value[state, control])
            change = max(change, abs(new_value - value[state]))
            value[state] = new_value
        sweeps += 1
