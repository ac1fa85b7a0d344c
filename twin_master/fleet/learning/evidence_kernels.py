"""Compiled loops for the log evidence of twins: in lanes, and on grids.

Both are forward passes of a hidden Markov model with S joint states, for many *lanes* side by side,
each as it would be alone: points of a grid, or draws of a parameter. `evidence_in_lanes` divides
the belief when its sum becomes small. `evidence_on_grid` leaves it as it is, so that a forward and
a backward pass can meet, each with a lane for those axes alone on which its transitions depend. Its
likelihood of a step is at most 1, so that all that underflows adds less than T S 1e-307 to the
evidence in T steps. The evidence is therefore exact to rounding wherever it is above
`LEAST_EVIDENCE`; the caller computes others by `evidence_in_lanes`.
"""

from functools import partial
from typing import NamedTuple

import numpy as np

from fe.compilation import callable_when_compiled, compiled
from reporting.arrays import Float, Index
from twin_master.network.gaussian_kernels import LEAST_EXPONENT, fill_exponentials
from twin_master.network.kernels import PredecessorLists

LEAST_EVIDENCE = -575.0
"""Log evidence below which underflow may matter: exp(-575) is 1e-250."""
LEAST_SUM = 1e-20
"""A belief with a smaller sum is divided by it: terms that underflow are 1e-287 of the sum."""
LANES_TOGETHER = 8
"""The number of lanes of a grid is a multiple of this, so that loops leave no remainder."""

_makes_no_arrays = partial(callable_when_compiled, makes_arrays=False, inline=True)
"""Decorator of functions that only read and fill arrays: numba does not count references."""


@_makes_no_arrays
def _apply_block(
    lists: PredecessorLists,
    block: int,
    control: int,
    entries: Float,
    lanes: tuple[int, int],
    source: Float,
    target: Float,
) -> None:
    """Apply one block of a transition to `source` (S, L); the result is written to `target` (S, L).

    The block is the transition of one state factor: it is applied along the first axis of the joint
    state, which becomes the last one, as in `apply_blocks`. Each of L lanes has transitions with
    other probabilities: the columns `lanes[0]` to `lanes[1]` of `entries` (non-zeros, ...).
    """
    levels, first_row, start, predecessor, _, _ = lists
    level_count = levels[block]
    inner_count = np.uint64(len(source) // level_count)  # joint levels of the other blocks
    first_lane, end_lane = lanes
    lane_count = end_lane - first_lane
    for level in range(level_count):
        row = first_row[block] + control * level_count + level
        first_entry = start[row]
        for i in range(inner_count):
            after = target[i * np.uint64(level_count) + np.uint64(level)]
            if first_entry == start[row + 1]:
                for lane in range(lane_count):
                    after[lane] = 0.0
            for k in range(first_entry, start[row + 1]):
                before = source[predecessor[k] * inner_count + i]
                probability = entries[k][first_lane:end_lane]
                if k == first_entry:
                    for lane in range(lane_count):
                        after[lane] = before[lane] * probability[lane]
                else:
                    for lane in range(lane_count):
                        after[lane] += before[lane] * probability[lane]


@_makes_no_arrays
def _apply_block_backward(
    lists: PredecessorLists,
    block: int,
    control: int,
    entries: Float,
    lanes: tuple[int, int],
    source: Float,
    target: Float,
) -> None:
    """Apply the transpose of one block to `source` (S, L), for the backward pass.

    The result is written to `target` (S, L). The arguments are those of `_apply_block`.
    """
    levels, first_row, start, predecessor, _, _ = lists
    level_count = levels[block]
    inner_count = np.uint64(len(source) // level_count)
    first_lane, end_lane = lanes
    lane_count = end_lane - first_lane
    for state in range(len(target)):
        for lane in range(lane_count):
            target[state, lane] = 0.0
    for level in range(level_count):
        row = first_row[block] + control * level_count + level
        for i in range(inner_count):
            later = source[i * np.uint64(level_count) + np.uint64(level)]
            for k in range(start[row], start[row + 1]):
                earlier = target[predecessor[k] * inner_count + i]
                probability = entries[k][first_lane:end_lane]
                for lane in range(lane_count):
                    earlier[lane] += later[lane] * probability[lane]


class SubGrids(NamedTuple):
    """The points of a tensor grid of K axes, and of its projections on all sets of axes.

    A set of axes is a number whose bit k says whether it has axis k; there are 2^K sets. The points
    of a projection are lanes, the last axis varies fastest, and the last point is repeated until
    their number is a multiple of `LANES_TOGETHER`.

    Attributes
    ----------
    axes_of_control : (U,) array
        The set of axes on which the transition under each control depends.
    first : (2^K + 1,) array
        The first lane of each set among the lanes of all sets.
    stride : (2^K, K) array
        The distance, in lanes of a set, between two values of an axis; 0 if the set lacks the axis.
    index_on_axis : (lanes of all sets, K) array
        The index on each axis of each lane; 0 on axes that its set lacks.
    entries : (non-zeros, lanes of all sets) array
        The probabilities of the lists of predecessors.
    """

    axes_of_control: Index
    first: Index
    stride: Index
    index_on_axis: Index
    entries: Float


@_makes_no_arrays
def _lane_in(grids: SubGrids, axes: int, lane: int) -> int:
    """Return the lane, among those of a set of axes, that has the indices of a lane of any set."""
    result = 0
    for k in range(grids.stride.shape[1]):
        result += grids.stride[axes, k] * grids.index_on_axis[lane, k]
    return result


@_makes_no_arrays
def _spread_lanes(
    grids: SubGrids, axes: int, wider_axes: int, source: Float, target: Float
) -> None:
    """Fill `target` with the lanes of `source` (S, ...), repeated for a set of more axes."""
    first = grids.first[wider_axes]
    for lane in range(grids.first[wider_axes + 1] - first):
        lane_before = _lane_in(grids, axes, first + lane)
        for state in range(len(source)):
            target[state, lane] = source[state, lane_before]


@_makes_no_arrays
def _cheapest_meeting(grids: SubGrids, control: Index, backward_lanes: Index) -> int:
    """Return the step at which a forward and a backward pass meet with the least work.

    Each pass has a lane for each point of the grid whose axes are the probabilities that its own
    transitions depend on. If a twin changes once from one control to another, each of two passes
    has one axis, whereas a forward pass alone would have two axes after the change.
    `backward_lanes` (T,) is work space.
    """
    # `axes` has a bit for each axis of the grid; `grids.first` counts the lanes of each set of
    # axes. First the work of a backward pass from the end to each step:
    steps = len(control)
    axes = 0
    backward_lanes[steps - 1] = 0
    for t in range(steps - 1, 0, -1):
        axes |= grids.axes_of_control[control[t - 1]]
        backward_lanes[t - 1] = backward_lanes[t] + grids.first[axes + 1] - grids.first[axes]
    # then that of a forward pass up to each step, and the step with the least sum of both
    axes = 0
    forward_lanes = 0
    meeting = 0
    least_lanes = backward_lanes[0]
    for t in range(1, steps):
        axes |= grids.axes_of_control[control[t - 1]]
        forward_lanes += grids.first[axes + 1] - grids.first[axes]
        if forward_lanes + backward_lanes[t] <= least_lanes:
            least_lanes = forward_lanes + backward_lanes[t]
            meeting = t
    return meeting


@callable_when_compiled
def _backward_to(
    meeting: int,
    lists: PredecessorLists,
    grids: SubGrids,
    control: Index,
    likelihood: Float,
    current: Float,
    other: Float,
) -> tuple[int, Float, Float]:
    """Compute the backward sums of a twin, from its last step down to that after `meeting`.

    Returns the set of axes on which the sums depend, the array of the sums, and the other array.
    The arguments are those of `evidence_on_grid` for one twin; `current` and `other` (S, L) are
    work space.
    """
    state_count = likelihood.shape[1]
    axes = 0
    lanes = grids.first[1]
    for state in range(state_count):
        for lane in range(lanes):
            current[state, lane] = 1.0
    for t in range(len(control) - 1, meeting, -1):
        control_in_force = control[t - 1]
        axes_before = axes
        axes |= grids.axes_of_control[control_in_force]
        # a control with axes of its own: from here on the sums depend on these, too
        if axes != axes_before:
            _spread_lanes(grids, axes_before, axes, current, other)
            current, other = other, current
        lanes_of_axes = (grids.first[axes], grids.first[axes + 1])
        for state in range(state_count):
            for lane in range(lanes_of_axes[1] - lanes_of_axes[0]):
                current[state, lane] *= likelihood[t, state]
        for block in range(len(lists.levels) - 1, -1, -1):
            _apply_block_backward(
                lists, block, control_in_force, grids.entries, lanes_of_axes, current, other
            )
            current, other = other, current
    return axes, current, other


@callable_when_compiled
def _forward_to(
    meeting: int,
    prior: Float,
    lists: PredecessorLists,
    grids: SubGrids,
    control: Index,
    likelihood: Float,
    current: Float,
    other: Float,
) -> tuple[int, Float, Float]:
    """Compute the forward sums of a twin up to the step `meeting`; see `_backward_to`."""
    state_count = likelihood.shape[1]
    # before the first transition the sums depend on no axis
    axes = 0
    lanes = grids.first[1]
    for state in range(state_count):
        for lane in range(lanes):
            current[state, lane] = prior[state] * likelihood[0, state]
    for t in range(1, meeting + 1):
        control_in_force = control[t - 1]
        axes_before = axes
        axes |= grids.axes_of_control[control_in_force]
        if axes != axes_before:
            _spread_lanes(grids, axes_before, axes, current, other)
            current, other = other, current
        lanes_of_axes = (grids.first[axes], grids.first[axes + 1])
        for block in range(len(lists.levels)):
            _apply_block(
                lists, block, control_in_force, grids.entries, lanes_of_axes, current, other
            )
            current, other = other, current
        for state in range(state_count):
            for lane in range(lanes_of_axes[1] - lanes_of_axes[0]):
                current[state, lane] *= likelihood[t, state]
    return axes, current, other


@compiled
def evidence_on_grid(
    prior: Float,
    lists: PredecessorLists,
    grids: SubGrids,
    control: Index,
    likelihood: Float,
    result: Float,
) -> None:
    """Fill `result` with the log evidence of B twins in T steps at the P points of a tensor grid.

    With the forward sum a(s) over the courses of the state that end in state s of a step, and the
    backward sum b(s) over their continuations, the evidence is the sum of a(s) b(s) over s.

    Parameters
    ----------
    prior : (S,) array
        The belief before the first step.
    lists : PredecessorLists
        The predecessors of the levels of each factor; their probabilities are not used.
    grids : SubGrids
        The grid.
    control : (B, T) array
        The control in force in each step.
    likelihood : (B, T, S) array
        The likelihood of the states in each step, divided by its largest value.
    result : (B, P) array
        To be filled: the log evidence.
    """
    twins, steps, state_count = likelihood.shape
    all_axes = len(grids.first) - 2
    most_lanes = grids.first[all_axes + 1] - grids.first[all_axes]
    forward = np.empty((state_count, most_lanes))
    backward = np.empty((state_count, most_lanes))
    other = np.empty((state_count, most_lanes))
    lane_sums = np.empty(steps, np.int64)
    for twin in range(twins):
        meeting = _cheapest_meeting(grids, control[twin], lane_sums)
        backward_axes, backward, other = _backward_to(
            meeting, lists, grids, control[twin], likelihood[twin], backward, other
        )
        forward_axes, forward, other = _forward_to(
            meeting, prior, lists, grids, control[twin], likelihood[twin], forward, other
        )
        # at each point of the grid, its lane among those of the axes of either sum
        for point in range(result.shape[1]):
            lane = grids.first[all_axes] + point
            forward_lane = _lane_in(grids, forward_axes, lane)
            backward_lane = _lane_in(grids, backward_axes, lane)
            total = 0.0
            for state in range(state_count):
                total += forward[state, forward_lane] * backward[state, backward_lane]
            result[twin, point] = np.log(total) if total > 0.0 else -np.inf


class _LikelihoodWork(NamedTuple):
    """Work space of `_multiply_by_likelihood`, with an entry for each column of the densities."""

    largest: Float
    mantissa: Float
    power_bits: Index


@_makes_no_arrays
def _multiply_by_likelihood(
    log_density: Float, belief: Float, belief_sum: Float, log_evidence: Float, work: _LikelihoodWork
) -> None:
    """Multiply beliefs (S, L) in place by the likelihood of a step, scaled to a largest value of 1.

    `log_density` is (S, L), or (S, 1) if it is the same in all lanes. The sums of the multiplied
    beliefs are written to `belief_sum` (L,), and the log of the largest likelihood is added to
    `log_evidence` (L,).
    """
    largest, mantissa, power_bits = work
    power = power_bits.view(np.float64)
    state_count, density_count = log_density.shape
    lanes = len(belief_sum)
    # The largest density; where no state is possible, any number serves.
    for column in range(density_count):
        largest[column] = log_density[0, column]
    for state in range(1, state_count):
        for column in range(density_count):
            value = log_density[state, column]
            largest[column] = value if value > largest[column] else largest[column]
    for column in range(density_count):
        if largest[column] == -np.inf:
            largest[column] = 0.0
    for lane in range(lanes):
        log_evidence[lane] += largest[lane % density_count]
        belief_sum[lane] = 0.0
    # Times the likelihood, and the sum over the states.
    for state in range(state_count):
        density = log_density[state]
        fill_exponentials(density, largest, mantissa, power_bits)
        if density_count == 1:
            underflows = density[0] - largest[0] <= LEAST_EXPONENT
            likelihood = 0.0 if underflows else mantissa[0] * power[0]
            for lane in range(lanes):
                belief[state, lane] *= likelihood
                belief_sum[lane] += belief[state, lane]
        else:
            for lane in range(lanes):
                underflows = density[lane] - largest[lane] <= LEAST_EXPONENT
                likelihood = 0.0 if underflows else mantissa[lane] * power[lane]
                belief[state, lane] *= likelihood
                belief_sum[lane] += belief[state, lane]


@compiled
def evidence_in_lanes(
    prior: Float,
    lists: PredecessorLists,
    entries: Float,
    control: Index,
    log_density: Float,
    result: Float,
) -> None:
    """Fill `result` with the log evidence of B twins in T steps, in each of L lanes.

    A lane is a hidden Markov model of its own: it has transition probabilities of its own, as the
    points of a grid have, or a likelihood of its own, as the draws of a parameter have. In each
    step the belief is propagated through the transition and multiplied by the likelihood. Its sum
    is the evidence so far. The belief is divided by its sum when the sum becomes small.

    Parameters
    ----------
    prior : (S,) array
        The belief before the first step.
    lists : PredecessorLists
        The predecessors of the levels of each factor; their probabilities are not used.
    entries : (non-zeros, L) array
        The probabilities of the entries of the lists in each lane.
    control : (B, T) array
        The control in force in each step.
    log_density : (B, T, S, L) or (B, T, S, 1) array
        log p(o_t | D_t, u_t) in each lane, or the same in all lanes.
    result : (B, L) array
        To be filled: the log evidence; -inf if the observations are impossible. A likelihood that
        is exp(`LEAST_EXPONENT`) of the largest one of its step, or less, is taken as zero.
    """
    twins, steps, state_count, density_count = log_density.shape
    lanes = entries.shape[1]
    belief = np.empty((state_count, lanes))
    other = np.empty((state_count, lanes))
    belief_sum = np.empty(lanes)
    work = _LikelihoodWork(
        np.empty(density_count), np.empty(density_count), np.empty(density_count, np.int64)
    )
    for twin in range(twins):
        for lane in range(lanes):
            result[twin, lane] = 0.0
        for state in range(state_count):
            for lane in range(lanes):
                belief[state, lane] = prior[state]
        for t in range(steps):
            if t > 0:
                for block in range(len(lists.levels)):
                    _apply_block(
                        lists, block, control[twin, t - 1], entries, (0, lanes), belief, other
                    )
                    belief, other = other, belief
            _multiply_by_likelihood(log_density[twin, t], belief, belief_sum, result[twin], work)
            # Divide the beliefs whose sum is small, before their terms underflow.
            least_sum = belief_sum[0]
            for lane in range(1, lanes):
                least_sum = min(least_sum, belief_sum[lane])
            if least_sum < LEAST_SUM and t < steps - 1:
                for lane in range(lanes):
                    divisor = belief_sum[lane] if belief_sum[lane] < LEAST_SUM else 1.0
                    result[twin, lane] += np.log(divisor)
                    belief_sum[lane] = divisor if divisor > 0.0 else 1.0
                for state in range(state_count):
                    for lane in range(lanes):
                        belief[state, lane] /= belief_sum[lane]
        for lane in range(lanes):
            result[twin, lane] += np.log(belief_sum[lane])
