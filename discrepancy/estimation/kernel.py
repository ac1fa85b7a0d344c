"""Compiled loops of the estimator.

Step matrices with laws in them, a Kalman filter, and its smoother.

The system of a trial is linear along a trajectory and changes in time:

    z[j + 1] = transition[j] z[j] + drift[j] weights + process noise,
    columns weights = rows z + noise of variance one.

`weights` is (1, w): a one for what is known, and the W - 1 unknowns of the hypothesis; `columns` is
what each leaves of a reading. The filter carries what each weight does to the state beside the
state itself (de Jong 1991, Annals of Statistics 19, 1073-1083), so that unknowns that are constant
in time are estimated by one regression after one pass, without being states.

Shapes: F fine stamps, N samples, n states, C channels, W weights, P ports with a law.
"""

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled


@callable_when_compiled
def multiply(left: FloatArray, right: FloatArray, product: FloatArray) -> None:
    """Fill the product of two small matrices.

    A loop is several times faster than a call of BLAS.
    """
    for i in range(left.shape[0]):
        for k in range(right.shape[1]):
            total = 0.0
            for j in range(left.shape[1]):
                total += left[i, j] * right[j, k]
            product[i, k] = total


@callable_when_compiled
def carry(
    transition: FloatArray, covariance: FloatArray, room: FloatArray, carried: FloatArray
) -> None:
    """Fill transition covariance transition^T, symmetric to the bit.

    `room` (n, n) is used meanwhile.
    """
    size = len(transition)
    multiply(transition, covariance, room)
    for i in range(size):
        for k in range(i + 1):
            total = 0.0
            for j in range(size):
                total += room[i, j] * transition[k, j]
            carried[i, k] = total
            carried[k, i] = total


@compiled
def step_matrices(
    parts: int,
    step_kind: IntArray,
    free_transition: FloatArray,
    free_noise: FloatArray,
    push_at_begin: FloatArray,
    push_at_end: FloatArray,
    tangents: FloatArray,
    pushes: FloatArray,
    drift: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return transition and process noise of each fine step with the laws' tangents in them.

    Fill its drift.

    The force of a law is linear between two stamps. That at the end of a step depends on the state
    there, so each step is implicit; its small system is solved by the Woodbury identity.

    Parameters
    ----------
    parts : int
        Fine steps between two samples.
    step_kind : (N,) ndarray of int
        Kind of step that leads to each sample; steps of one kind have one length.
    free_transition, free_noise : (K, n, n) ndarray
        Transition and process noise of a fine step without laws, by kind.
    push_at_begin, push_at_end : (K, n, P) ndarray
        State that a unit force at a port adds over a fine step, from its value at the begin and at
        the end.
    tangents : (F, P, n) ndarray
        Change of the force of the laws at a port by the state.
    pushes : (F, P, W) ndarray
        Force of the laws at a port at state zero, by weight.
    drift : (F - 1, n, W) ndarray
        State that each weight adds in a fine step besides; filled with all that it adds.

    Returns
    -------
    transition, noise : (F - 1, n, n) ndarray
        Of each fine step.
    """
    steps, ports, states = len(tangents) - 1, tangents.shape[1], tangents.shape[2]
    transition = np.empty((steps, states, states))
    noise = np.empty((steps, states, states))
    implicit, explicit, room = np.empty((3, states, states))
    coupling = np.empty((ports, ports))
    drifted = np.empty((states, drift.shape[2]))
    for j in range(steps):
        kind = step_kind[j // parts + 1]
        begin, end = push_at_begin[kind], push_at_end[kind]
        # explicit part: the laws' force at the begin of the step
        multiply(begin, tangents[j], explicit)
        explicit += free_transition[kind]
        for i in range(states):
            for w in range(drift.shape[2]):
                total = drift[j, i, w]
                for p in range(ports):
                    total += begin[i, p] * pushes[j, p, w] + end[i, p] * pushes[j + 1, p, w]
                drifted[i, w] = total
        # implicit part: (I - end tangent)^-1 = I + end (I - tangent end)^-1 tangent
        tangent = tangents[j + 1]
        multiply(tangent, end, coupling)
        if ports == 1:
            inner = tangent / (1.0 - coupling[0, 0])
        else:
            inner = np.linalg.solve(np.eye(ports) - coupling, tangent)
        multiply(end, inner, implicit)
        for i in range(states):
            implicit[i, i] += 1.0
        multiply(implicit, explicit, transition[j])
        multiply(implicit, drifted, drift[j])
        carry(implicit, free_noise[kind], room, noise[j])
    return transition, noise


@callable_when_compiled
def take_reading(
    covariance: FloatArray,
    mean: FloatArray,
    row: FloatArray,
    innovation: FloatArray,
    gain: FloatArray,
) -> float:
    """Take one reading into covariance (n, n) and mean (n, W).

    Fill its gain (n,), return its variance.
    """
    states = len(row)
    weight = np.empty(states)
    variance = 1.0
    for i in range(states):
        weight[i] = 0.0
        for j in range(states):
            weight[i] += covariance[i, j] * row[j]
        variance += row[i] * weight[i]
    for i in range(states):
        gain[i] = weight[i] / variance
    # Joseph form: from both sides in turn, so that the second takes what rounding left of the
    # first
    for i in range(states):
        for j in range(states):
            covariance[i, j] -= gain[i] * weight[j]
    for i in range(states):
        weight[i] = 0.0
        for j in range(states):
            weight[i] += covariance[i, j] * row[j]
    for i in range(states):
        for j in range(states):
            covariance[i, j] += (gain[i] - weight[i]) * gain[j]
    for i in range(states):
        for w in range(mean.shape[1]):
            mean[i, w] += gain[i] * innovation[w]
    return float(variance)


@compiled
def filter_record(
    parts: int,
    transition: FloatArray,
    noise: FloatArray,
    drift: FloatArray,
    rows: FloatArray,
    columns: FloatArray,
    used: BoolArray,
    covariance: FloatArray,
    mean: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what the filter predicts at each fine stamp, and the innovations of all readings.

    Parameters
    ----------
    parts : int
        Fine steps between two samples.
    transition, noise, drift : (F - 1, n, n), (F - 1, n, n), (F - 1, n, W) ndarray
        The matrices that `step_matrices` returns.
    rows, columns : (N, C, n), (N, C, W) ndarray
        What a reading shows of the state, and what each weight leaves of it, over the deviation of
        its noise.
    used : (N, C) ndarray of bool
        Readings that count.
    covariance, mean : (n, n), (n, W) ndarray
        State before the first reading.

    Returns
    -------
    means, covariances : (F, n, W), (F, n, n) ndarray
        State at each fine stamp before the readings there.
    innovations : (N, C, W) ndarray
        Readings minus their prediction; zero where one does not count.
    gains, variances : (N, C, n), (N, C) ndarray
        Of each reading.
    """
    stamps, states, width = len(transition) + 1, mean.shape[0], mean.shape[1]
    samples, channels = columns.shape[0], columns.shape[1]
    means = np.empty((stamps, states, width))
    covariances = np.empty((stamps, states, states))
    innovations = np.zeros((samples, channels, width))
    gains = np.zeros((samples, channels, states))
    variances = np.ones((samples, channels))
    mean, covariance = mean.copy(), covariance.copy()
    room = np.empty((states, states))
    for j in range(stamps):
        means[j] = mean
        covariances[j] = covariance
        if j % parts == 0:
            k = j // parts
            for c in range(channels):
                if used[k, c]:
                    for w in range(width):
                        innovations[k, c, w] = columns[k, c, w]
                        for i in range(states):
                            innovations[k, c, w] -= rows[k, c, i] * mean[i, w]
                    variances[k, c] = take_reading(
                        covariance, mean, rows[k, c], innovations[k, c], gains[k, c]
                    )
        if j < stamps - 1:
            before = mean.copy()
            multiply(transition[j], before, mean)
            mean += drift[j]
            before_covariance = covariance.copy()
            carry(transition[j], before_covariance, room, covariance)
            covariance += noise[j]
    return means, covariances, innovations, gains, variances


@compiled
def smooth_record(
    parts: int,
    transition: FloatArray,
    rows: FloatArray,
    used: BoolArray,
    states: FloatArray,
    covariances: FloatArray,
    innovations: FloatArray,
    gains: FloatArray,
    variances: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the smoothed state at each fine stamp, and its variances.

    The fixed-interval smoother of de Jong (1989, J. American Statistical Association 84,
    1085-1088), which inverts no covariance.

    Parameters
    ----------
    parts, transition, rows, used
        The arguments of `filter_record`.
    states : (F, n) ndarray
        Predicted states at the values of all weights.
    covariances, gains, variances
        The arrays that `filter_record` returns.
    innovations : (N, C) ndarray
        Innovations at the values of all weights.

    Returns
    -------
    smoothed, variance : (F, n), (F, n) ndarray
        State, and variance of each of its entries, given all readings.
    """
    stamps, size = states.shape
    channels = rows.shape[1]
    smoothed = np.empty((stamps, size))
    variance = np.empty((stamps, size))
    adjoint = np.zeros(size)
    information = np.zeros((size, size))
    room, carried = np.empty((2, size, size))
    along = np.empty(size)
    for j in range(stamps - 1, -1, -1):
        if j < stamps - 1:
            backward = np.ascontiguousarray(transition[j].T)
            adjoint = backward @ adjoint
            carry(backward, information, room, carried)
            information[:] = carried
        if j % parts == 0:
            k = j // parts
            for c in range(channels - 1, -1, -1):
                if not used[k, c]:
                    continue
                row, gain = rows[k, c], gains[k, c]
                scale, explained = 1.0 / variances[k, c], 0.0
                for i in range(size):
                    along[i] = 0.0
                    for m in range(size):
                        along[i] += information[i, m] * gain[m]
                    scale += gain[i] * along[i]
                    explained += gain[i] * adjoint[i]
                surprise = innovations[k, c] / variances[k, c] - explained
                for i in range(size):
                    adjoint[i] += row[i] * surprise
                    for m in range(size):
                        information[i, m] += (
                            scale * row[i] * row[m] - row[i] * along[m] - along[i] * row[m]
                        )
        multiply(covariances[j], information, room)
        for i in range(size):
            reduction = 0.0
            smoothed[j, i] = states[j, i]
            for m in range(size):
                smoothed[j, i] += covariances[j, i, m] * adjoint[m]
                reduction += room[i, m] * covariances[j, m, i]
            variance[j, i] = max(covariances[j, i, i] - reduction, 0.0)
    return smoothed, variance
