"""Compiled loops that advance the beliefs of all hypotheses about gauges, and average them.

Notation is that of `fault_kernels`. A pair that has no probability under any fault has a row of
zeros among the beliefs of the faults. Most rows are such rows, which are neither read nor written.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fe.compilation import compiled, compiled_with_reordered_sums
from reporting.arrays import Float, Index, Single
from twin_master.gauges.fault_kernels import NEGLIGIBLE_UNDER_FAULT, Beliefs
from twin_master.network.kernels import PredecessorLists


class Onsets(NamedTuple):
    """The probability that each fault of B twins began before this step, if it has begun at all.

    Attributes
    ----------
    gauge : (B, R) array
        The probability for each fault of a gauge.
    free_gains : (B,) array
        The probability for free gains.
    """

    gauge: Float
    free_gains: Float


class Recoveries(NamedTuple):
    """The probability that passes from ended or hidden faults to "recovered" in a step.

    Attributes
    ----------
    new_fraction : (B,) array
        The fraction of the probability of "recovered" that was added in this step.
    gauge_weight : (B, R) array
        The fraction of it that comes from each fault of a gauge.
    free_gains_weight : (B,) array
        The fraction that comes from free gains.
    """

    new_fraction: Float
    gauge_weight: Float
    free_gains_weight: Float


@compiled
def advance_belief(
    lists: PredecessorLists,
    control: int,
    draws: int,
    belief: Float | Single,
    work: Float | Single,
) -> None:
    """Advance a belief by one transition of the states, in place.

    The blocks are applied one after the other, each along its own axis of the joint state.

    Parameters
    ----------
    control : int
        The control before the transition.
    draws : int
        The number E of draws.
    belief, work : (S E,) array
        The belief, in the order of the states, and work space.
    """
    levels, first_row, start, predecessor, probability, _ = lists
    outer = 1
    inner = len(belief)
    is_nonzero = np.empty(len(belief) // draws, np.bool_)
    for block in range(len(levels)):
        level_count = levels[block]
        inner //= level_count  # states of later blocks, times the draws
        for row in range(outer * level_count):
            believing = np.int64(0)
            for i in range(row * inner, (row + 1) * inner):
                believing += belief[i] > 0.0
            is_nonzero[row] = believing > 0
        for row in range(outer * level_count):
            o, level = divmod(row, level_count)
            target = work[row * inner : (row + 1) * inner]
            for i in range(inner):
                target[i] = 0.0
            list_row = first_row[block] + control * level_count + level
            for k in range(start[list_row], start[list_row + 1]):
                before = o * level_count + np.int64(predecessor[k])
                if is_nonzero[before]:
                    source = belief[before * inner : (before + 1) * inner]
                    weight = work.dtype.type(probability[k])
                    for i in range(inner):
                        target[i] += weight * source[i]
        for i in range(len(belief)):
            belief[i] = work[i]
        outer *= level_count


@compiled
def advance_rows(
    lists: PredecessorLists,
    control: int,
    is_nonzero: NDArray[np.bool_],
    rows: Single,
    work_is_nonzero: NDArray[np.bool_],
    work: Single,
) -> None:
    """Advance the beliefs of all R faults of a twin by one transition, in place.

    Parameters
    ----------
    control : int
        The control before the transition.
    is_nonzero, work_is_nonzero : (N,) array of bool
        Whether a row has entries that are not zero, and work space.
    rows, work : (N, R) array
        The beliefs, and work space, which may hold any numbers.
    """
    levels, first_row, start, predecessor, probability, _ = lists
    pairs, faults = rows.shape
    is_touched = is_nonzero.copy()
    # A transition is the product of blocks, each of one or more factors of the state. Pair number
    # (o * levels + level) * inner + i has this level of the block; the blocks are applied in turn,
    # from `rows` to `work` and back.
    outer = 1
    inner = pairs
    source = rows
    target = work
    source_is_nonzero = is_nonzero
    target_is_nonzero = work_is_nonzero
    for block in range(len(levels)):
        level_count = levels[block]
        inner //= level_count
        for outer_level in range(outer * level_count):
            o, level = divmod(outer_level, level_count)
            list_row = first_row[block] + control * level_count + level
            for i in range(inner):
                to = outer_level * inner + i
                # the sum over the levels before, without rows that are zero
                has_sum = False
                for k in range(start[list_row], start[list_row + 1]):
                    before = (o * level_count + np.int64(predecessor[k])) * inner + i
                    if not source_is_nonzero[before]:
                        continue
                    weight = np.float32(probability[k])
                    if has_sum:
                        for r in range(faults):
                            target[to, r] += weight * source[before, r]
                    else:
                        for r in range(faults):
                            target[to, r] = weight * source[before, r]
                        has_sum = True
                target_is_nonzero[to] = has_sum
                is_touched[to] |= has_sum
        outer *= level_count
        source, target = target, source
        source_is_nonzero, target_is_nonzero = target_is_nonzero, source_is_nonzero
    # After an odd number of blocks the result is in `work`. Rows that became zero are cleared.
    is_in_work = len(levels) % 2 == 1
    for i in range(pairs):
        if is_in_work:
            is_nonzero[i] = work_is_nonzero[i]
        if is_nonzero[i] and is_in_work:
            for r in range(faults):
                rows[i, r] = work[i, r]
        elif is_touched[i] and not is_nonzero[i]:
            for r in range(faults):
                rows[i, r] = 0.0


@compiled_with_reordered_sums
def begin_gauge_faults(
    model_belief: Float,
    earlier_weight: Float,
    recovered_weight: Float,
    is_nonzero: NDArray[np.bool_],
    rows: Single,
    recovering: Float,
) -> None:
    """Let faults of gauges begin, and average their beliefs for the hypothesis "recovered".

    A fault that begins now has the belief of the model. It is mixed with the belief of the fault
    that began earlier, so that one belief stands for all first steps.

    Parameters
    ----------
    model_belief : (N,) array
        The belief of the model.
    earlier_weight : (R,) array
        The probability that each fault began before this step, if it has begun at all.
    recovered_weight : (R,) array
        The weights of the average.
    is_nonzero : (N,) array of bool
        Whether a row has entries that are not zero; updated in place.
    rows : (N, R) array
        The beliefs of the faults; updated in place. Afterwards each row is filled.
    recovering : (N,) array
        To be filled: the average of the beliefs over the faults.
    """
    pairs, faults = rows.shape
    earlier = np.empty(faults, np.float32)  # single precision, as the beliefs
    new = np.empty(faults, np.float32)
    weight = np.empty(faults, np.float32)
    zero = np.float32(0.0)
    new_weight = zero
    for r in range(faults):
        earlier[r] = np.float32(earlier_weight[r])
        new[r] = np.float32(1.0) - earlier[r]
        weight[r] = np.float32(recovered_weight[r])
        new_weight += weight[r] * new[r]
    for i in range(pairs):
        model = np.float32(model_belief[i])
        if not is_nonzero[i] and model < NEGLIGIBLE_UNDER_FAULT:
            recovering[i] = new_weight * model_belief[i]
            continue
        if is_nonzero[i]:
            for r in range(faults):
                rows[i, r] = earlier[r] * rows[i, r] + new[r] * model
        else:
            for r in range(faults):
                rows[i, r] = new[r] * model
            is_nonzero[i] = True
        average = zero
        for r in range(faults):
            average += weight[r] * rows[i, r]
        recovering[i] = average


@compiled
def advance_beliefs(
    lists: PredecessorLists,
    control: Index,
    draws: int,
    onsets: Onsets,
    recoveries: Recoveries,
    beliefs: Beliefs,
) -> None:
    """Advance all beliefs of B twins by one transition, and let faults begin and end, in place.

    Parameters
    ----------
    control : (B,) array
        The control of the step before.
    draws : int
        The number E of draws.
    onsets : Onsets
        How probable it is that each fault began before this step.
    recoveries : Recoveries
        The faults that end or are hidden in this step.
    beliefs : Beliefs
        The beliefs; updated in place.
    """
    twins, pairs, faults = beliefs.gauge.shape
    work = np.empty(pairs)
    single_work = np.empty(pairs, np.float32)
    row_work = np.empty((pairs, faults), np.float32)
    row_is_nonzero = np.empty(pairs, np.bool_)
    recovering = np.empty(pairs)
    for twin in range(twins):
        now = control[twin]
        model = beliefs.model[twin]
        recovered = beliefs.recovered[twin]
        free_gains = beliefs.free_gains[twin]
        gauge = beliefs.gauge[twin]
        is_nonzero = beliefs.gauge_is_nonzero[twin]
        advance_belief(lists, now, draws, model, work)
        advance_belief(lists, now, draws, recovered, work)
        advance_belief(lists, now, draws, free_gains, single_work)
        advance_rows(lists, now, is_nonzero, gauge, row_is_nonzero, row_work)

        # faults begin: their beliefs are mixed with that of the model
        begin_gauge_faults(
            model,
            onsets.gauge[twin],
            recoveries.gauge_weight[twin],
            is_nonzero,
            gauge,
            recovering,
        )
        earlier = np.float32(onsets.free_gains[twin])
        new = np.float32(1.0) - earlier
        total = 0.0
        for i in range(pairs):
            free_gains[i] = earlier * free_gains[i] + new * np.float32(model[i])
            recovering[i] += recoveries.free_gains_weight[twin] * free_gains[i]
            total += recovering[i]
        # faults end: "recovered" is mixed with the average belief under the faults that have ended
        if total > 0.0:
            fraction = recoveries.new_fraction[twin]
            for i in range(pairs):
                recovered[i] += fraction * (recovering[i] / total - recovered[i])


@compiled_with_reordered_sums
def add_gauge_beliefs(weight: Float, beliefs: Beliefs, twin: int, average: Float) -> None:
    """Add the weighted beliefs about the state under a twin's faults to `average` (S,)."""
    pairs, faults = beliefs.gauge.shape[1:]
    draws = pairs // len(average)
    single_weight = np.empty(faults, np.float32)
    for r in range(faults):
        single_weight[r] = np.float32(weight[r])
    for i in range(pairs):
        if beliefs.gauge_is_nonzero[twin, i]:
            total = np.float32(0.0)
            for r in range(faults):
                total += single_weight[r] * beliefs.gauge[twin, i, r]
            average[i // draws] += total


@compiled
def average_competing_beliefs(
    recovered_weight: Float, gauge_weight: Float, beliefs: Beliefs, average: Float
) -> None:
    """Fill `average` with the weighted sum of the beliefs under "recovered" and faults of gauges.

    Parameters
    ----------
    recovered_weight : (B,) array
        The weight of "recovered".
    gauge_weight : (B, R) array
        The weight of each fault of a gauge.
    average : (B, S) array
        To be filled.
    """
    twins, states = average.shape
    pairs = beliefs.recovered.shape[1]
    draws = pairs // states
    for twin in range(twins):
        for s in range(states):
            total = 0.0
            for i in range(s * draws, (s + 1) * draws):
                total += beliefs.recovered[twin, i]
            average[twin, s] = recovered_weight[twin] * total
        add_gauge_beliefs(gauge_weight[twin], beliefs, twin, average[twin])
