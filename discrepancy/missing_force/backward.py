"""What readings tell of the state before them: the passes of a record from its end to its begin.

Shapes: n states, c channels, N samples, W columns that are filtered alike, S different steps, B
places.
"""

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import compiled

from .covariances import is_steady


@compiled
def later(
    transitions: FloatArray,
    step_of_sample: IntArray,
    rows: FloatArray,
    used: BoolArray,
    white: FloatArray,
    gains: FloatArray,
    variances: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the smoothing additions and informations of all samples, in a backward pass.

    By de Jong (1989, J. American Statistical Association 84, 1085-1088), without an inverse, from
    what `forward` makes of all samples of one column. In his letters: r (n,) is the addition, N (n,
    n) the information.

    Returns
    -------
    additions, informations : (N, n), (N, n, n) ndarray
        The smoothed state is the prediction and its covariance C times the addition; after the
        sample's own readings its covariance is C - C information C.
    """
    count = len(step_of_sample)
    n = rows.shape[1]
    additions = np.zeros((count, n))
    informations = np.zeros((count, n, n))
    addition = np.zeros(n)
    information = np.zeros((n, n))
    for k in range(count - 1, -1, -1):
        informations[k] = information
        # take in the readings of the sample, in reverse order
        for c in range(len(rows) - 1, -1, -1):
            if used[k, c]:
                row = rows[c]
                gain = gains[k, c]
                innovation = white[k, c, 0] / np.sqrt(variances[k, c])
                addition = addition + row * (innovation - gain @ addition)
                along = information @ gain
                size = gain @ along + 1.0 / variances[k, c]
                information = (
                    information
                    - np.outer(row, along)
                    - np.outer(along, row)
                    + size * np.outer(row, row)
                )
        additions[k] = addition
        # carry both back over the step
        transition = transitions[step_of_sample[k]]
        addition = transition.T @ addition
        information = transition.T @ information @ transition
    return additions, informations


@compiled
def backward(
    transitions: FloatArray,
    noise_roots: FloatArray,
    step_of_sample: IntArray,
    rows: FloatArray,
    used: BoolArray,
    columns: FloatArray,
    places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the information on the state from all readings after some samples.

    This is an information filter, run backwards from the end of the record.

    `noise_roots` (S, n, n) are roots of the noises. Given a state z (n,), the logarithm of the
    density of these readings is, for columns in the weights w (W,):

        w^T h^T z - z^T J z / 2 - w^T c w / 2 - half.

    Returns
    -------
    J, h, c, half : (B, n, n), (B, n, W), (B, W, W), (B,) ndarray
        The information, its vector, the products of columns, and half a log determinant; all
        zero from sample N on.
    """
    count = len(step_of_sample)
    n = rows.shape[1]
    width = columns.shape[2]
    all_J = np.zeros((len(places), n, n))
    all_h = np.zeros((len(places), n, width))
    all_c = np.zeros((len(places), width, width))
    halves = np.zeros(len(places))

    J = np.zeros((n, n))
    h = np.zeros((n, width))
    c = np.zeros((width, width))
    half = 0.0
    # what a step of one kind does, kept where information and step are those of the sample before
    root = np.zeros((n, n))
    inverse = np.zeros((n, n))
    carry_back = np.zeros((n, n))
    half_of_step = 0.0

    place = np.searchsorted(places, count) - 1
    last_step = -1
    steady = False
    for k in range(count - 1, -1, -1):
        reads_like_last = k < count - 1 and bool(np.all(used[k] == used[k + 1]))
        # take in the readings of the sample
        for channel in range(len(rows)):
            if used[k, channel]:
                h += np.outer(rows[channel], columns[k, channel])
                c += np.outer(columns[k, channel], columns[k, channel])
        last_J = J
        if not (steady and reads_like_last):
            J_with_readings = J.copy()
            for channel in range(len(rows)):
                if used[k, channel]:
                    J_with_readings += np.outer(rows[channel], rows[channel])
        # hand out what is known where it is asked for
        if place >= 0 and places[place] == k:
            all_J[place] = J_with_readings
            all_h[place] = h
            all_c[place] = c
            halves[place] = half
            place -= 1
        if place < 0:
            break
        # carry it back over the step with its noise integrated out (Joseph form of the information)
        step = step_of_sample[k]
        if not (steady and reads_like_last and step == last_step):
            root = noise_roots[step]
            inner = np.eye(n) + root.T @ J_with_readings @ root
            half_of_step = 0.5 * np.log(np.linalg.det(inner))
            inverse = np.ascontiguousarray(np.linalg.inv(inner))
            gain = J_with_readings @ root @ inverse
            keep = np.eye(n) - gain @ root.T
            J = (
                transitions[step].T
                @ (keep @ J_with_readings @ keep.T + gain @ gain.T)
                @ transitions[step]
            )
            J = 0.5 * (J + J.T)
            carry_back = np.ascontiguousarray(transitions[step].T @ keep)
            steady = reads_like_last and step == last_step and is_steady(J, last_J)
        h_along_root = root.T @ h
        c -= h_along_root.T @ inverse @ h_along_root
        half += half_of_step
        h = carry_back @ h
        last_step = step
    return all_J, all_h, all_c, halves
