"""The Kalman filter of a record, forwards and backwards in time, and how both are joined.

The forward filter gives the state at a moment by the readings before it, the backward filter the
information on that state by the readings after it (Fraser and Potter 1969, IEEE Transactions on
Automatic Control 14, 387-390). Together they give the evidence of all readings, and the state at
that moment. Readings are processed one at a time, so that the forward filter inverts no matrix.
Covariance and information are updated in Joseph form; once they have converged they are kept.

Shapes: n states, c channels, N samples, W columns that are filtered together (the residual and the
derivatives by unknowns), S different steps, B queried samples (samples whose state is asked for).
Readings are divided by the deviation of the white part of their noise, which therefore has variance
one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled

from .backward import filter_backward
from .covariances import is_steady

SERIES_NORM, SERIES_TERMS = 0.25, 12
"""Norm of the rate matrix times the time up to which its exponential is summed as a series, and the
number of terms: the remainder is 1e-16."""
LEAST_INNOVATION_VARIANCE = 0.5
"""Least variance of an innovation over that of the noise. The exact variance is at least one; with
a missing force that is far too large, rounding errors make the computed one smaller."""


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


@callable_when_compiled
def update_covariance(covariance: FloatArray, row: FloatArray, gain: FloatArray) -> float:
    """Update a covariance (n, n) in place by one reading, and return the innovation's variance.

    `row` (n,) is the reading for a unit of each state; its noise has variance one. `gain` (n,) is
    filled with the Kalman gain.
    """
    covariance_row = covariance @ row
    variance = row @ covariance_row + 1.0
    gain[:] = covariance_row / variance
    # Joseph form (I - g h^T) C (I - g h^T)^T + g g^T, one factor after the other: a rounding error
    # of the first one is reduced by the second
    for i in range(len(row)):
        for j in range(len(row)):
            covariance[i, j] -= gain[i] * covariance_row[j]
    covariance_row = covariance @ row
    for i in range(len(row)):
        for j in range(len(row)):
            covariance[i, j] += (gain[i] - covariance_row[i]) * gain[j]
    return float(variance)


@callable_when_compiled
def predict_mean(transition: FloatArray, mean: FloatArray, predicted_mean: FloatArray) -> None:
    """Fill the means (n, W) after a step. Zeros of the transition, which has many, are skipped."""
    predicted_mean[:] = 0.0
    for i in range(len(transition)):
        for j in range(len(transition)):
            coefficient = transition[i, j]
            if coefficient != 0.0:
                for w in range(mean.shape[1]):
                    predicted_mean[i, w] += coefficient * mean[j, w]


@callable_when_compiled
def subtract_prediction(row: FloatArray, mean: FloatArray, innovation: FloatArray) -> None:
    """Subtract the prediction of a reading from its columns (W,), which become innovations."""
    for j in range(len(row)):
        coefficient = row[j]
        if coefficient != 0.0:
            for w in range(len(innovation)):
                innovation[w] -= coefficient * mean[j, w]


@callable_when_compiled
def update_mean(gain: FloatArray, innovation: FloatArray, mean: FloatArray) -> None:
    """Correct the means (n, W) by the innovations (W,) of a reading."""
    for j in range(len(gain)):
        coefficient = gain[j]
        for w in range(len(innovation)):
            mean[j, w] += coefficient * innovation[w]


@compiled
def filter_forward(
    transitions: FloatArray,
    noises: FloatArray,
    step_of_sample: IntArray,
    output_rows: FloatArray,
    is_used: BoolArray,
    columns: FloatArray,
    first_sample: int,
    covariance: FloatArray,
    mean: FloatArray,
    query_samples: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the filtered state before some samples, from the readings since sample `first_sample`.

    The state at a queried sample contains the readings up to the sample before it.

    Parameters
    ----------
    transitions, noises : (S, n, n) ndarray
        The transitions of the different steps, and the covariances of their process noise.
    step_of_sample : (N,) ndarray
        The step that leads to each sample.
    output_rows, is_used, columns : (c, n), (N, c), (N, c, W) ndarray
        The readings for a unit of each state; whether each reading counts; the columns.
    first_sample : int
        The first sample whose readings are processed.
    covariance, mean : (n, n), (n, W) ndarray
        The state after the sample before `first_sample`; for the first sample of a record, the
        state at that sample before its readings.
    query_samples : (B,) ndarray
        The samples before which the state is asked for, ascending.

    Returns
    -------
    covariances, means : (B, n, n), (B, n, W) ndarray
        The state after the last sample before each queried one.
    whitened_innovations : (query_samples[-1] - first, c, W) ndarray
        The innovations of the columns, divided by their standard deviations.
    half_log_determinants : (B,) ndarray
        Half the sum of the logarithms of the variances of the innovations; infinite if a
        variance has been lost to rounding.
    gains, variances : (B, c, n), (B, c) ndarray
        The gains and the variances of the innovations of that last sample.
    """
    n, column_count = mean.shape
    channel_count = len(output_rows)
    query_count = len(query_samples)
    covariances = np.zeros((query_count, n, n))
    means = np.zeros((query_count, n, column_count))
    whitened_innovations = np.zeros((query_samples[-1] - first_sample, channel_count, column_count))
    half_log_determinants = np.full(query_count, np.inf)
    all_gains = np.zeros((query_count, channel_count, n))
    all_variances = np.ones((query_count, channel_count))

    covariance = covariance.copy()
    mean = mean.copy()
    predicted_mean = np.zeros((n, column_count))
    gains = np.zeros((channel_count, n))
    variances = np.ones(channel_count)
    half_log_determinant = 0.0
    query = 0
    steady = False
    for k in range(first_sample, query_samples[-1] + 1):
        # store the state before a queried sample
        while query < query_count and query_samples[query] == k:
            covariances[query] = covariance
            means[query] = mean
            half_log_determinants[query] = half_log_determinant
            all_gains[query] = gains
            all_variances[query] = variances
            query += 1
        if query == query_count:
            break
        # a steady covariance stays so while the step and the used readings are the same
        same_step = k > first_sample + 1 and step_of_sample[k] == step_of_sample[k - 1]
        is_like_previous = same_step and bool(np.all(is_used[k] == is_used[k - 1]))
        steady = steady and is_like_previous
        previous_covariance = covariance
        # predict
        if k > 0:
            transition = transitions[step_of_sample[k]]
            predict_mean(transition, mean, predicted_mean)
            mean, predicted_mean = predicted_mean, mean
            if not steady:
                covariance = transition @ covariance @ transition.T + noises[step_of_sample[k]]
                covariance = 0.5 * (covariance + covariance.T)
        # update by the readings of the sample, one at a time
        for c in range(channel_count):
            if not is_used[k, c]:
                continue
            if not steady:
                variances[c] = update_covariance(covariance, output_rows[c], gains[c])
                # this query and later ones keep their infinite half log determinant
                if not variances[c] > LEAST_INNOVATION_VARIANCE:
                    return (
                        covariances,
                        means,
                        whitened_innovations,
                        half_log_determinants,
                        all_gains,
                        all_variances,
                    )
            innovation = whitened_innovations[k - first_sample, c]
            innovation[:] = columns[k, c]
            subtract_prediction(output_rows[c], mean, innovation)
            update_mean(gains[c], innovation, mean)
            innovation /= np.sqrt(variances[c])
            half_log_determinant += 0.5 * np.log(variances[c])
        steady = steady or (is_like_previous and is_steady(covariance, previous_covariance))
    return covariances, means, whitened_innovations, half_log_determinants, all_gains, all_variances


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


class FilterState(NamedTuple):
    """The state given the readings before a moment, and the contribution of these to the evidence.

    Attributes
    ----------
    covariance : (..., n, n) ndarray
        The covariance of the state.
    mean : (..., n, W) ndarray
        The mean of the state for a unit of each column.
    products : (..., W, W) ndarray
        The inner products of the whitened columns of these readings.
    half_log_determinants : (...) ndarray
        Half the log determinant of the covariance of these readings [nat].
    """

    covariance: FloatArray
    mean: FloatArray
    products: FloatArray
    half_log_determinants: FloatArray


class StateInformation(NamedTuple):
    """The information on the state at a moment from the readings since then.

    `filter_backward` gives the density.

    Attributes
    ----------
    matrix : (..., n, n) ndarray
        The information matrix J on the n states.
    vectors : (..., n, W) ndarray
        The information vectors h, one for each column.
    products : (..., W, W) ndarray
        The inner products c of the whitened columns of these readings.
    half_log_determinants : (...) ndarray
        Half a log determinant [nat].
    """

    matrix: FloatArray
    vectors: FloatArray
    products: FloatArray
    half_log_determinants: FloatArray


@dataclass(frozen=True, eq=False)
class RecordFilter:
    """A Kalman filter of a record, forwards and backwards in time.

    The kind of the step that leads to each sample is given to its methods, so that one filter can
    be used for several paths of a switched force.

    Attributes
    ----------
    transitions, noises : (S, n, n) ndarray
        The transitions of the different steps, and the covariances of their process noise.
    output_rows, used, columns : (c, n), (N, c), (N, c, W) ndarray
        The readings for a unit of each state; whether each reading counts; the columns.
    """

    transitions: FloatArray
    noises: FloatArray
    output_rows: FloatArray
    used: BoolArray
    columns: FloatArray

    @cached_property
    def noise_roots(self) -> FloatArray:
        """The roots (S, n, n) of the process noises: root @ root.T is the covariance."""
        return _covariance_roots(self.noises)

    def initial_state(self, covariance: FloatArray) -> FilterState:
        """Return the state of the filter before the first sample, with a covariance (n, n)."""
        n, column_count = self.output_rows.shape[1], self.columns.shape[2]
        return FilterState(
            covariance=covariance,
            mean=np.zeros((n, column_count)),
            products=np.zeros((column_count, column_count)),
            half_log_determinants=np.zeros(()),
        )

    def filter_before(
        self,
        step_of_sample: IntArray,
        first_sample: int,
        state: FilterState,
        query_samples: IntArray,
    ) -> FilterState:
        """Return the states (B, ...) of the filter before the steps that lead to some samples.

        Parameters
        ----------
        step_of_sample : (N,) array
            The step that leads to each sample.
        first_sample : int
            The first sample whose readings are processed.
        state : FilterState
            The state of the filter before that sample.
        query_samples : (B,) array
            The samples before which the state is asked for, ascending.
        """
        covariances, means, whitened, half_log_determinants, *_ = filter_forward(
            self.transitions,
            self.noises,
            step_of_sample,
            self.output_rows,
            self.used,
            self.columns,
            first_sample,
            state.covariance,
            state.mean,
            query_samples,
        )
        # products of the readings since `first`: between two queried samples, then summed up
        whitened_rows = whitened.reshape(-1, whitened.shape[-1])
        row_of_query = len(self.output_rows) * (query_samples[:-1] - first_sample)
        products_between = [rows.T @ rows for rows in np.split(whitened_rows, row_of_query)]
        products = np.cumsum(products_between, axis=0)
        return FilterState(
            covariance=covariances,
            mean=means,
            products=products + state.products,
            half_log_determinants=half_log_determinants + state.half_log_determinants,
        )

    def information_after(
        self, step_of_sample: IntArray, query_samples: IntArray
    ) -> StateInformation:
        """Return the information (B, ...) on the state at some samples, from readings since then.

        Parameters
        ----------
        step_of_sample : (N,) array
            The step that leads to each sample.
        query_samples : (B,) array
            The samples, ascending.
        """
        matrix, vectors, products, half_log_determinants = filter_backward(
            self.transitions,
            self.noise_roots,
            step_of_sample,
            self.output_rows,
            self.used,
            self.columns,
            query_samples,
        )
        return StateInformation(matrix, vectors, products, half_log_determinants)


def _covariance_roots(covariances: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances: root @ root.T is the covariance."""
    eigenvalues, eigenvectors = np.linalg.eigh(covariances)
    return np.ascontiguousarray(eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))[..., None, :])


def join_filters(before: FilterState, after: StateInformation) -> tuple[FloatArray, FloatArray]:
    """Return the products and half log determinants of records that were filtered in two parts.

    The state z at the moment between both parts is integrated out. Given the readings before, it is
    Gaussian; the readings after have the log density that `filter_backward` gives.

    Parameters
    ----------
    before : FilterState
        The state z by the readings before the moment.
    after : StateInformation
        The information on z by the readings after the moment.

    Returns
    -------
    products : (..., W, W) array
        The inner products of the whitened columns of the whole record.
    half_log_determinants : (...) array
        Half the log determinant of the covariance of all its readings [nat].
    """
    mean = before.mean
    J = after.matrix
    h = after.vectors
    # with covariance R R^T and residual information h - J m of the mean m, completing the square
    # in z leaves (h - J m)^T R (I + R^T J R)^-1 R^T (h - J m), and half log det (I + R^T J R)
    root = _covariance_roots(before.covariance)
    inner_root = np.linalg.cholesky(np.eye(before.covariance.shape[-1]) + root.mT @ J @ root)
    explained = np.asarray(np.linalg.solve(inner_root, root.mT @ (h - J @ mean)))
    mean_by_h = mean.mT @ h
    products = (
        before.products
        + after.products
        - mean_by_h
        - mean_by_h.mT
        + mean.mT @ J @ mean
        - explained.mT @ explained
    )
    half_log_determinant = np.log(np.diagonal(inner_root, axis1=-2, axis2=-1)).sum(-1)
    half_log_determinants = (
        before.half_log_determinants + after.half_log_determinants + half_log_determinant
    )
    return products, half_log_determinants
