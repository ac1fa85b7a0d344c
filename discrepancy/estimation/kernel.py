"""Compiled loops of the estimator: substeps with laws, a Kalman filter, and its smoother.

The system of a trial is linear along a trajectory. Its state is the sum of two parts. The first one
is known but for W weights: the first weight is one, and the others are the unknowns of the
hypothesis. `respond_to_drift` computes it. The second part is random:

    z[j + 1] = transition z[j] + process noise,
    columns weights = rows z + noise of variance one,

where the columns are the readings minus the first part, for a unit of each weight. The filter
whitens all columns in one pass. Unknowns that are constant in time then follow from one regression,
and need not be states.

Each fine stamp has the kind of the step that leads to it, which is an index of the transitions:
in a system that does not change in time, steps of one length are of one kind.

Shapes: F fine stamps, N samples, n states, C channels, W weights, S kinds of steps, P ports with a
law.
"""

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.trials_in_motion.steps import multiply, weight_moved_to_end
from fe.compilation import callable_when_compiled, compiled

STEADY = 1e-9
"""Largest change of an entry of a converged covariance, over the standard deviations of its row and
column."""


@callable_when_compiled
def propagate_covariance(
    transition: FloatArray, covariance: FloatArray, work: FloatArray, propagated: FloatArray
) -> None:
    """Fill `propagated` (n, n) with transition @ covariance @ transition.T, exactly symmetric.

    `work` (n, n) is overwritten as working memory.
    """
    size = len(transition)
    multiply(transition, covariance, propagated)
    for i in range(size):
        for k in range(size):
            work[k, i] = propagated[i, k]
    multiply(transition, work, propagated)
    for i in range(size):
        for k in range(i):
            propagated[i, k] = propagated[k, i]


@compiled
def substep_matrices_with_laws(
    substeps: int,
    interval_of_sample: IntArray,
    free_transition: FloatArray,
    free_noise: FloatArray,
    by_force_at_begin: FloatArray,
    by_force_at_end: FloatArray,
    force_by_state: FloatArray,
    force_by_weight: FloatArray,
    drift: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and process noises of substeps with laws, and fill `drift`.

    The force of the laws is linear in time over a substep. As it depends on the state at the end,
    the substep is implicit. With b and e for `by_force_at_begin` and `by_force_at_end`, T for
    `force_by_state` and u for `force_by_weight`,

        (I - e T[j + 1]) z[j + 1] = (Phi + b T[j]) z[j] + d weights + noise,
        d = b u[j] + e u[j + 1] + drift[j].

    The matrix on the left is inverted by the Woodbury identity, with a system of P equations.

    Where a law is stiff, as dry friction is while a body sticks, this scheme would let the speed
    change its sign in each substep. A part of b is then added to e, so that the force counts more
    at the end of the substep (see `weight_moved_to_end`).

    Parameters
    ----------
    substeps : int
        The number of substeps between two samples.
    interval_of_sample : (N,) ndarray of int
        The index of the length of the interval that ends at each sample.
    free_transition, free_noise : (K, n, n) ndarray
        The transition Phi and the process noise of a substep without laws, for each length.
    by_force_at_begin, by_force_at_end : (K, n, P) ndarray
        The change of the state over a substep for a unit force at a port, at the start and at the
        end of the step.
    force_by_state : (F, P, n) ndarray
        The derivative of the laws' force at a port by the state.
    force_by_weight : (F, P, W) ndarray
        The laws' force at a port at state zero, for a unit of each weight.
    drift : (F - 1, n, W) ndarray
        The state that each weight adds in a substep without laws; filled with that with laws.

    Returns
    -------
    transition, noise : (F - 1, n, n) ndarray
        The transition and the covariance of the process noise of each substep.
    """
    steps, ports, states = len(force_by_state) - 1, force_by_state.shape[1], force_by_state.shape[2]
    transition = np.empty((steps, states, states))
    noise = np.empty((steps, states, states))
    # Each array is made by itself: numba knows its layout, and compiles `multiply` for one alone.
    inverse = np.empty((states, states))
    explicit = np.empty((states, states))
    work = np.empty((states, states))
    coupling = np.empty((ports, ports))
    explicit_drift = np.empty((states, drift.shape[2]))
    begin = np.empty((states, ports))
    end = np.empty((states, ports))
    for j in range(steps):
        interval = interval_of_sample[j // substeps + 1]
        tangent = force_by_state[j + 1]
        moved = weight_moved_to_end(
            by_force_at_begin[interval], by_force_at_end[interval], force_by_state[j], tangent
        )
        for i in range(states):
            for p in range(ports):
                begin[i, p] = (1.0 - moved) * by_force_at_begin[interval, i, p]
                end[i, p] = (
                    by_force_at_end[interval, i, p] + moved * by_force_at_begin[interval, i, p]
                )
        # right side: the laws' force at the start of the step, and all drift
        multiply(begin, force_by_state[j], explicit)
        explicit += free_transition[interval]
        for i in range(states):
            for w in range(drift.shape[2]):
                element = drift[j, i, w]
                for p in range(ports):
                    element += (
                        begin[i, p] * force_by_weight[j, p, w]
                        + end[i, p] * force_by_weight[j + 1, p, w]
                    )
                explicit_drift[i, w] = element
        # inverse of the left side: (I - end tangent)^-1 = I + end (I - tangent end)^-1 tangent
        multiply(tangent, end, coupling)
        if ports == 1:
            inverse_tangent = tangent / (1.0 - coupling[0, 0])
        else:
            inverse_tangent = np.ascontiguousarray(
                np.linalg.solve(np.eye(ports) - coupling, tangent)
            )
        multiply(end, inverse_tangent, inverse)
        for i in range(states):
            inverse[i, i] += 1.0
        multiply(inverse, explicit, transition[j])
        multiply(inverse, explicit_drift, drift[j])
        propagate_covariance(inverse, free_noise[interval], work, noise[j])
    return transition, noise


@compiled
def respond_to_drift(
    step_kinds: IntArray, transitions: FloatArray, drifts: FloatArray, start: FloatArray
) -> FloatArray:
    """Return the state (F, n, W) that each weight adds, without process noise.

    Parameters
    ----------
    step_kinds : (F,) ndarray of int
        The kind of the step that leads to each fine stamp; that of the first stamp is not used.
    transitions : (S, n, n) ndarray
        The transitions of the different steps.
    drifts : (F - 1, n, W) ndarray
        The state that a unit of each weight adds in each step.
    start : (n, W) ndarray
        The state at the first stamp.
    """
    states = np.empty((len(step_kinds), *start.shape))
    states[0] = start
    for j in range(1, len(step_kinds)):
        multiply(transitions[step_kinds[j]], states[j - 1], states[j])
        states[j] += drifts[j - 1]
    return states


@callable_when_compiled
def is_steady(covariance: FloatArray, previous_covariance: FloatArray) -> bool:
    """Return whether two covariances (n, n) differ by no more than `STEADY`, entry by entry."""
    for i in range(len(covariance)):
        for j in range(len(covariance)):
            scale = STEADY * np.sqrt(covariance[i, i] * covariance[j, j])
            if np.abs(covariance[i, j] - previous_covariance[i, j]) > scale:
                return False
    return True


@callable_when_compiled
def update_covariance(covariance: FloatArray, output_row: FloatArray, gain: FloatArray) -> float:
    """Update a covariance (n, n) in place by one reading, and return the innovation's variance.

    `output_row` (n,) is the reading for a unit of each state; its noise has variance one. `gain`
    (n,) is filled with the Kalman gain.
    """
    states = len(output_row)
    covariance_row = np.empty(states)
    variance = 1.0
    for i in range(states):
        covariance_row[i] = 0.0
        for j in range(states):
            covariance_row[i] += covariance[i, j] * output_row[j]
        variance += output_row[i] * covariance_row[i]
    for i in range(states):
        gain[i] = covariance_row[i] / variance
    # Joseph form (I - g h^T) C (I - g h^T)^T + g g^T, one factor after the other: a rounding error
    # of the first one is reduced by the second
    for i in range(states):
        for j in range(states):
            covariance[i, j] -= gain[i] * covariance_row[j]
    for i in range(states):
        covariance_row[i] = 0.0
        for j in range(states):
            covariance_row[i] += covariance[i, j] * output_row[j]
    for i in range(states):
        for j in range(states):
            covariance[i, j] += (gain[i] - covariance_row[i]) * gain[j]
    return float(variance)


@callable_when_compiled
def update_mean(
    output_row: FloatArray, gain: FloatArray, innovation: FloatArray, mean: FloatArray
) -> None:
    """Turn the columns (W,) of a reading into its innovations, and correct the means (n, W)."""
    for i in range(len(output_row)):
        coefficient = output_row[i]
        if coefficient != 0.0:
            for w in range(len(innovation)):
                innovation[w] -= coefficient * mean[i, w]
    for i in range(len(output_row)):
        coefficient = gain[i]
        for w in range(len(innovation)):
            mean[i, w] += coefficient * innovation[w]


@compiled
def filter_record(
    substeps: int,
    step_kinds: IntArray,
    transitions: FloatArray,
    noises: FloatArray,
    output_rows: FloatArray,
    columns: FloatArray,
    is_used: BoolArray,
    covariance: FloatArray,
    mean: FloatArray,
    keeps_states: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the innovations of all readings and, if asked for, the filtered state at each stamp.

    Where nothing changes from one sample to the next, the covariance converges; from there on it is
    not computed anew.

    Parameters
    ----------
    substeps : int
        The number of substeps between two samples.
    step_kinds : (F,) ndarray of int
        The kind of the step that leads to each fine stamp; negative if no step does, as at the
        first stamp of a record.
    transitions, noises : (S, n, n) ndarray
        The transition of each kind of step, and the covariance of its process noise.
    output_rows : (1, C, n) or (N, C, n) ndarray
        The readings for a unit of each state, divided by the deviation of the white noise: for all
        samples, or for each one.
    columns : (N, C, W) ndarray
        The readings minus the part that is known but for the weights, divided by the same.
    is_used : (N, C) ndarray of bool
        Whether each reading is compared with the model.
    covariance, mean : (n, n), (n, W) ndarray
        The state before the first step or reading.
    keeps_states : bool
        Whether the state at each stamp is returned.

    Returns
    -------
    innovations : (N, C, W) ndarray
        The readings minus their predictions, for a unit of each weight; zero if a reading does not
        count.
    gains, variances : (N, C, n), (N, C) ndarray
        The gain of each reading, and the variance of its innovation. The gains have no rows if the
        states are not kept.
    means, covariances : (F, n, W), (F, n, n) ndarray
        The state at each fine stamp, after the readings there; no rows if it is not kept.
    """
    sample_count, channel_count, weight_count = columns.shape
    state_count = len(covariance)
    stamp_count = len(step_kinds)
    innovations = np.zeros((sample_count, channel_count, weight_count))
    variances = np.ones((sample_count, channel_count))
    kept_samples, kept_stamps = (sample_count, stamp_count) if keeps_states else (0, 0)
    all_gains = np.zeros((kept_samples, channel_count, state_count))
    means = np.empty((kept_stamps, state_count, weight_count))
    covariances = np.empty((kept_stamps, state_count, state_count))

    mean, covariance = mean.copy(), covariance.copy()
    predicted_mean = np.empty((state_count, weight_count))
    predicted_covariance = np.empty((state_count, state_count))
    work = np.empty((state_count, state_count))
    covariance_at_sample = np.empty((state_count, state_count))
    gains = np.zeros((channel_count, state_count))
    has_one_row = len(output_rows) == 1
    steady = False
    for j in range(stamp_count):
        # a converged covariance stays so while the steps and the used readings are the same
        if steady and (j - 1) % substeps == 0:
            next_sample = (j - 1) // substeps + 1
            steady = step_kinds[j] == step_kinds[j - substeps] and bool(
                np.all(is_used[next_sample] == is_used[next_sample - 1])
            )
        # predict over the step
        kind = step_kinds[j]
        if kind >= 0:
            multiply(transitions[kind], mean, predicted_mean)
            mean, predicted_mean = predicted_mean, mean
            if not steady:
                propagate_covariance(transitions[kind], covariance, work, predicted_covariance)
                covariance, predicted_covariance = predicted_covariance, covariance
                covariance += noises[kind]
        # update by the readings of a sample, one at a time
        if j % substeps == 0:
            k = j // substeps
            rows = output_rows[0] if has_one_row else output_rows[k]
            for c in range(channel_count):
                if not is_used[k, c]:
                    continue
                if steady:
                    variances[k, c] = variances[k - 1, c]
                else:
                    variances[k, c] = update_covariance(covariance, rows[c], gains[c])
                innovations[k, c] = columns[k, c]
                update_mean(rows[c], gains[c], innovations[k, c], mean)
                if keeps_states:
                    all_gains[k, c] = gains[c]
            if has_one_row and j > 0 and not steady:
                steady = is_steady(covariance, covariance_at_sample)
            covariance_at_sample[:] = covariance
        if keeps_states:
            means[j] = mean
            # between samples a steady covariance is not computed: take that of the last interval
            is_skipped = steady and j % substeps != 0
            covariances[j] = covariances[j - substeps] if is_skipped else covariance
    return innovations, all_gains, variances, means, covariances


@compiled
def smooth_record(
    substeps: int,
    step_kinds: IntArray,
    transitions: FloatArray,
    output_rows: FloatArray,
    is_used: BoolArray,
    innovations: FloatArray,
    gains: FloatArray,
    variances: FloatArray,
    states: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return the state (F, n) at each fine stamp, given all readings.

    This is the fixed-interval smoother of de Jong (1989, J. American Statistical Association 84,
    1085-1088), which inverts no covariance. In his letters `adjoint` is r.

    Parameters
    ----------
    substeps, step_kinds, transitions, output_rows, is_used
        The arguments of `filter_record`.
    innovations : (N, C) ndarray
        The innovations at the values of all weights.
    gains, variances, covariances
        The arrays that `filter_record` returns.
    states : (F, n) ndarray
        The filtered states at the values of all weights.
    """
    stamp_count, state_count = states.shape
    channel_count = is_used.shape[1]
    has_one_row = len(output_rows) == 1
    smoothed_states = np.empty((stamp_count, state_count))
    adjoint = np.zeros(state_count)
    carried = np.empty(state_count)
    for j in range(stamp_count - 1, -1, -1):
        # smoothed state: filtered state + C r, by the later readings
        for i in range(state_count):
            smoothed_states[j, i] = states[j, i]
            for m in range(state_count):
                smoothed_states[j, i] += covariances[j, i, m] * adjoint[m]
        # update by the readings of a sample, in reverse order
        if j % substeps == 0:
            k = j // substeps
            rows = output_rows[0] if has_one_row else output_rows[k]
            for c in range(channel_count - 1, -1, -1):
                if not is_used[k, c]:
                    continue
                correction = innovations[k, c] / variances[k, c]
                for i in range(state_count):
                    correction -= gains[k, c, i] * adjoint[i]
                for i in range(state_count):
                    adjoint[i] += rows[c, i] * correction
        # carry back over the substep
        if j > 0:
            transition = transitions[step_kinds[j]]
            carried[:] = 0.0
            for i in range(state_count):
                for m in range(state_count):
                    carried[m] += transition[i, m] * adjoint[i]
            adjoint[:] = carried
    return smoothed_states


@compiled
def smoothed_variances(
    substeps: int,
    step_kinds: IntArray,
    transitions: FloatArray,
    output_rows: FloatArray,
    is_used: BoolArray,
    gains: FloatArray,
    variances: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return the variance (F, n) of each entry of the state at each fine stamp, given all readings.

    It does not depend on the readings themselves. The smoother is that of `smooth_record`; in its
    author's letters `information` is N. The arguments are those of `smooth_record`.
    """
    stamp_count, state_count = covariances.shape[:2]
    channel_count = is_used.shape[1]
    has_one_row = len(output_rows) == 1
    smoothed = np.empty((stamp_count, state_count))
    information = np.zeros((state_count, state_count))
    work = np.empty((state_count, state_count))
    carried = np.empty((state_count, state_count))
    information_gain = np.empty(state_count)
    for j in range(stamp_count - 1, -1, -1):
        # the smoothed covariance is C - C N C
        multiply(covariances[j], information, work)
        for i in range(state_count):
            reduction = 0.0
            for m in range(state_count):
                reduction += work[i, m] * covariances[j, m, i]
            smoothed[j, i] = max(covariances[j, i, i] - reduction, 0.0)
        # update by the readings of a sample, in reverse order
        if j % substeps == 0:
            k = j // substeps
            rows = output_rows[0] if has_one_row else output_rows[k]
            for c in range(channel_count - 1, -1, -1):
                if not is_used[k, c]:
                    continue
                row, gain = rows[c], gains[k, c]
                row_information = 1.0 / variances[k, c]
                for i in range(state_count):
                    information_gain[i] = 0.0
                    for m in range(state_count):
                        information_gain[i] += information[i, m] * gain[m]
                    row_information += gain[i] * information_gain[i]
                for i in range(state_count):
                    for m in range(state_count):
                        information[i, m] += (
                            row_information * row[i] * row[m]
                            - row[i] * information_gain[m]
                            - information_gain[i] * row[m]
                        )
        # carry back over the substep
        if j > 0:
            backward = np.ascontiguousarray(transitions[step_kinds[j]].T)
            propagate_covariance(backward, information, work, carried)
            information[:] = carried
    return smoothed
