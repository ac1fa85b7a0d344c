"""Steps of a linear system in time: transitions, process noise, and responses to inputs."""

import numpy as np

from discrepancy.campaign.records import FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled

SERIES_NORM, SERIES_TERMS = 0.25, 12
"""Norm of the rate matrix times the time up to which its exponential is summed as a series, and the
number of terms: the remainder is 1e-16."""


@compiled
def discretise(
    generator: FloatArray, intensity: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and process noises (J, n, n) of steps of given lengths.

    The series is summed for a small part of a step, which is then doubled. The usual exponential of
    a block matrix (Van Loan) contains exp(-A t) too, which overflows if a state decays within a
    step.

    Parameters
    ----------
    generator : (n, n) array
        The rate matrix A [1/s].
    intensity : (n, n) array
        The spectral density of the white noise that drives the state.
    lengths : (J,) array
        The lengths of the steps [s].
    """
    n = len(generator)
    norm = np.max(np.sum(np.abs(generator), axis=1)) if n else 0.0
    transitions = np.empty((len(lengths), n, n))
    noises = np.empty((len(lengths), n, n))
    for k in range(len(lengths)):
        doublings = 0
        part_length = lengths[k]
        while norm * part_length > SERIES_NORM:
            doublings += 1
            part_length = 0.5 * part_length
        # Taylor series of both for the part
        transition = np.eye(n)
        transition_term = np.eye(n)
        noise = intensity * part_length
        noise_term = intensity * part_length
        for order in range(1, SERIES_TERMS):
            transition_term = (generator @ transition_term) * (part_length / order)
            transition = transition + transition_term
            noise_term = (generator @ noise_term + noise_term @ generator.T) * (
                part_length / (order + 1)
            )
            noise = noise + noise_term
        # two parts in a row make one of twice the length
        for _ in range(doublings):
            noise = transition @ noise @ transition.T + noise
            transition = transition @ transition
        transitions[k] = transition
        noises[k] = 0.5 * (noise + noise.T)
    return transitions, noises


@compiled
def respond_to_inputs(
    generator: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return transitions of steps, and how much a unit input at either end changes the state.

    The input is added to the rate of the state, and is linear over the step (first-order hold). As
    in `discretise` a series is summed for a small part of a step, which is then doubled: over two
    parts, an input that rises from zero to one rises to a half in each.

    Parameters
    ----------
    generator : (n, n) array
        The rate matrix A [1/s].
    lengths : (J,) array
        The lengths of the steps [s].

    Returns
    -------
    transitions : (J, n, n) array
        The transitions of the state.
    by_begin, by_end : (J, n, n) array
        The changes for an input of one at the start of the step, falling to zero, and for an input
        of one at its end, rising from zero.
    """
    n = len(generator)
    norm = np.max(np.sum(np.abs(generator), axis=1)) if n else 0.0
    transitions = np.empty((len(lengths), n, n))
    by_begin = np.empty((len(lengths), n, n))
    by_end = np.empty((len(lengths), n, n))
    for k in range(len(lengths)):
        doublings = 0
        part_length = lengths[k]
        while norm * part_length > SERIES_NORM:
            doublings += 1
            part_length = 0.5 * part_length
        # the terms (A h)^j h / (j + 1)! and (A h)^j h / (j + 2)! of the integrals of exp(A s)
        term = np.eye(n)
        transition = np.eye(n)
        by_constant = np.eye(n)
        by_rise = 0.5 * np.eye(n)
        for order in range(1, SERIES_TERMS):
            term = (generator @ term) * (part_length / order)
            transition = transition + term
            by_constant = by_constant + term / (order + 1)
            by_rise = by_rise + term / ((order + 1) * (order + 2))
        by_constant = by_constant * part_length
        by_rise = by_rise * part_length
        for _ in range(doublings):
            by_rise = 0.5 * (transition @ by_rise + by_constant + by_rise)
            by_constant = transition @ by_constant + by_constant
            transition = transition @ transition
        transitions[k] = transition
        by_begin[k] = by_constant - by_rise
        by_end[k] = by_rise
    return transitions, by_begin, by_end


@compiled
def state_under_inputs(
    substeps: int,
    transitions: FloatArray,
    by_input_at_begin: FloatArray,
    by_input_at_end: FloatArray,
    step_of_sample: IntArray,
    start: FloatArray,
    inputs: FloatArray,
) -> FloatArray:
    """Return the state (F, n) at the F fine stamps under inputs that are linear between these.

    The loops over states and inputs are plain ones, as they are compiled.

    Parameters
    ----------
    substeps : int
        The number of fine steps between two samples.
    transitions : (J, n, n) ndarray
        The transitions of the fine steps of different lengths.
    by_input_at_begin, by_input_at_end : (J, n, d) ndarray
        The change of the state over a fine step for a unit of an input at its start, or at its end.
    step_of_sample : (N,) ndarray
        For each sample the index, among the J lengths, of the interval that ends at it.
    start : (n,) ndarray
        The state at the first fine stamp.
    inputs : (F, d) ndarray
        The d inputs at the fine stamps.
    """
    n, input_count = by_input_at_begin.shape[1], inputs.shape[1]
    states = np.zeros((len(inputs), n))
    states[0] = start
    for stamp in range(len(inputs) - 1):
        length = step_of_sample[stamp // substeps + 1]
        for i in range(n):
            next_value = 0.0
            for j in range(n):
                next_value += transitions[length, i, j] * states[stamp, j]
            for k in range(input_count):
                next_value += (
                    by_input_at_begin[length, i, k] * inputs[stamp, k]
                    + by_input_at_end[length, i, k] * inputs[stamp + 1, k]
                )
            states[stamp + 1, i] = next_value
    return states


@callable_when_compiled
def multiply(left_matrix: FloatArray, right_matrix: FloatArray, product: FloatArray) -> None:
    """Fill `product` with the product of two small matrices.

    For these, a loop is several times faster than a call of BLAS. The innermost loop runs along
    rows, so that the compiler computes several entries at once. Zeros on the left are skipped:
    transitions of modes have many.
    """
    product[:] = 0.0
    for i in range(left_matrix.shape[0]):
        for j in range(left_matrix.shape[1]):
            coefficient = left_matrix[i, j]
            if coefficient != 0.0:
                for k in range(right_matrix.shape[1]):
                    product[i, k] += coefficient * right_matrix[j, k]


@callable_when_compiled
def weight_moved_to_end(
    response_at_begin: FloatArray,
    response_at_end: FloatArray,
    tangent_at_begin: FloatArray,
    tangent_at_end: FloatArray,
) -> float:
    """Return the fraction w of a force's weight at the start of a substep that moves to its end.

    This prevents errors of stiff laws that alternate in sign from substep to substep. Let a unit
    force over the whole substep move its port such that the force of the law there changes by -s,
    with the dimensionless stiffness s > 0. In the theta scheme an error e of the force becomes

        e (1 - (1 - theta) s) / (1 + theta s),

    which has the sign of e if theta >= 1 - 1 / s. Equal weights at start and end are theta = 1/2.
    With a fraction w moved, theta = (1 + w) / 2. Hence w = 1 - 2 / s if s > 2, and 0 otherwise.

    Parameters
    ----------
    response_at_begin, response_at_end : (n, P) ndarray
        The change of the n states due to a unit force at each of P ports, at the start and at the
        end of the substep.
    tangent_at_begin, tangent_at_end : (P, n) ndarray
        The derivatives of the laws' forces at the ports with respect to the states, evaluated at
        the start and at the end of the substep.
    """
    # s = -tangent . (response to a unit force at the start + at the end). The tangent may be that
    # of either end: the larger s counts, and that of the stiffest port.
    largest_stiffness = 0.0
    for p in range(len(tangent_at_begin)):
        stiffness_at_begin, stiffness_at_end = 0.0, 0.0
        for i in range(len(response_at_begin)):
            change = response_at_begin[i, p] + response_at_end[i, p]
            stiffness_at_begin -= tangent_at_begin[p, i] * change
            stiffness_at_end -= tangent_at_end[p, i] * change
        largest_stiffness = max(largest_stiffness, stiffness_at_begin, stiffness_at_end)
    return 1.0 - 2.0 / largest_stiffness if largest_stiffness > 2.0 else 0.0
