"""Backward passes over a record: the information on a state from later readings.

Shapes: n states, c channels, N samples, W columns that are filtered together (the residual and the
derivatives by unknowns), S different steps, B queried samples (samples whose state is asked for).
Readings are divided by the deviation of the white part of their noise.
"""

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import compiled

from .covariances import is_steady


@compiled
def smoother_corrections(
    transitions: FloatArray,
    step_of_sample: IntArray,
    output_rows: FloatArray,
    is_used: BoolArray,
    whitened_innovations: FloatArray,
    gains: FloatArray,
    variances: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the vector and the matrix that correct the state at each sample by later readings.

    This is the fixed-interval smoother of de Jong (1989, J. American Statistical Association 84,
    1085-1088), which inverts no covariance. In his letters the correction is r, the information N,
    the innovation divided by its variance v / F, and the gain K.

    Parameters
    ----------
    transitions : (S, n, n) ndarray
        The transitions of the different steps.
    step_of_sample : (N,) ndarray
        The step that leads to each sample.
    output_rows : (c, n) ndarray
        The readings for a unit of each state.
    is_used : (N, c) ndarray of bool
        Whether each reading is compared with the model.
    whitened_innovations, gains, variances : (N, c, 1), (N, c, n), (N, c) ndarray
        The results of `filter_forward` for all samples of one column: innovations divided by their
        deviations, gains, and variances of the innovations.

    Returns
    -------
    corrections, informations : (N, n), (N, n, n) ndarray
        The vector r of each sample, from the readings at and after it: the smoothed state is the
        state predicted before the readings of the sample, plus its covariance times r. The matrix N
        of each sample, from the readings after it: with C the covariance of the state after the
        readings of the sample, the covariance given all readings is C - C N C.
    """
    sample_count = len(step_of_sample)
    n = output_rows.shape[1]
    corrections = np.zeros((sample_count, n))
    informations = np.zeros((sample_count, n, n))
    correction = np.zeros(n)
    information = np.zeros((n, n))
    for k in range(sample_count - 1, -1, -1):
        informations[k] = information
        # readings of the sample, in reverse order
        for c in range(len(output_rows) - 1, -1, -1):
            if is_used[k, c]:
                row = output_rows[c]
                gain = gains[k, c]
                scaled_innovation = whitened_innovations[k, c, 0] / np.sqrt(variances[k, c])
                correction = correction + row * (scaled_innovation - gain @ correction)
                information_gain = information @ gain
                innovation_information = gain @ information_gain + 1.0 / variances[k, c]
                information = (
                    information
                    - np.outer(row, information_gain)
                    - np.outer(information_gain, row)
                    + innovation_information * np.outer(row, row)
                )
        corrections[k] = correction
        # propagate both back over the step that leads to the sample
        transition = transitions[step_of_sample[k]]
        correction = transition.T @ correction
        information = transition.T @ information @ transition
    return corrections, informations


@compiled
def filter_backward(
    transitions: FloatArray,
    noise_roots: FloatArray,
    step_of_sample: IntArray,
    output_rows: FloatArray,
    is_used: BoolArray,
    columns: FloatArray,
    query_samples: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the information on the state from all readings at and after some samples.

    This is an information filter that runs backwards from the end of the record. Given the state z
    (n,), and the readings as the combination of the W columns with weights w (W,), the log density
    of these readings is

        w^T h^T z - z^T J z / 2 - w^T c w / 2 - half.

    Parameters
    ----------
    transitions : (S, n, n) ndarray
        The transitions of the different steps.
    noise_roots : (S, n, n) ndarray
        The roots of the covariances of their process noise: root @ root.T is the covariance.
    step_of_sample : (N,) ndarray
        The step that leads to each sample.
    output_rows, is_used, columns : (c, n), (N, c), (N, c, W) ndarray
        The readings for a unit of each state; whether each reading counts; the columns.
    query_samples : (B,) ndarray
        The samples whose information is asked for, ascending.

    Returns
    -------
    J, h, c, half : (B, n, n), (B, n, W), (B, W, W), (B,) ndarray
        The information matrix, the information vectors of the columns, the products of the columns,
        and half a log determinant. All are zero for the queried sample N, after the last reading.
    """
    sample_count = len(step_of_sample)
    n = output_rows.shape[1]
    column_count = columns.shape[2]
    all_J = np.zeros((len(query_samples), n, n))
    all_h = np.zeros((len(query_samples), n, column_count))
    all_c = np.zeros((len(query_samples), column_count, column_count))
    half_log_determinants = np.zeros(len(query_samples))

    J = np.zeros((n, n))
    h = np.zeros((n, column_count))
    c = np.zeros((column_count, column_count))
    half_log_determinant = 0.0
    # the matrices of a step, which are kept as long as J is steady and the step is the same
    root = np.zeros((n, n))
    inverse = np.zeros((n, n))
    carry_back = np.zeros((n, n))
    half_of_step = 0.0

    query = np.searchsorted(query_samples, sample_count) - 1
    next_step = -1
    steady = False
    for k in range(sample_count - 1, -1, -1):
        reads_like_next = k < sample_count - 1 and bool(np.all(is_used[k] == is_used[k + 1]))
        # add the information of the readings of the sample
        for channel in range(len(output_rows)):
            if is_used[k, channel]:
                h += np.outer(output_rows[channel], columns[k, channel])
                c += np.outer(columns[k, channel], columns[k, channel])
        next_J = J
        if not (steady and reads_like_next):
            J_with_readings = J.copy()
            for channel in range(len(output_rows)):
                if is_used[k, channel]:
                    J_with_readings += np.outer(output_rows[channel], output_rows[channel])
        # store the results at a queried sample
        if query >= 0 and query_samples[query] == k:
            all_J[query] = J_with_readings
            all_h[query] = h
            all_c[query] = c
            half_log_determinants[query] = half_log_determinant
            query -= 1
        if query < 0:
            break
        # carry the information back over the step, with the process noise integrated out: with
        # noise G G^T and D = I + G^T J G, J - J G D^-1 G^T J in Joseph form, and half log det D
        step = step_of_sample[k]
        if not (steady and reads_like_next and step == next_step):
            root = noise_roots[step]
            whitened_information = np.eye(n) + root.T @ J_with_readings @ root
            half_of_step = 0.5 * np.log(np.linalg.det(whitened_information))
            inverse = np.ascontiguousarray(np.linalg.inv(whitened_information))
            gain = J_with_readings @ root @ inverse
            complement = np.eye(n) - gain @ root.T
            J = (
                transitions[step].T
                @ (complement @ J_with_readings @ complement.T + gain @ gain.T)
                @ transitions[step]
            )
            J = 0.5 * (J + J.T)
            carry_back = np.ascontiguousarray(transitions[step].T @ complement)
            steady = reads_like_next and step == next_step and is_steady(J, next_J)
        h_along_root = root.T @ h
        c -= h_along_root.T @ inverse @ h_along_root
        half_log_determinant += half_of_step
        h = carry_back @ h
        next_step = step
    return all_J, all_h, all_c, half_log_determinants
