"""A record filtered forwards and backwards in time, and both filters joined at one time.

The forward filter gives the state at that time from the readings before it, the backward filter the
information on the state from the readings after it (Fraser and Potter 1969, IEEE Transactions on
Automatic Control 14, 387-390). Together they give the evidence of all readings.

Shapes: n states, c channels, N samples, W columns that are filtered together (the residual and the
derivatives by unknowns), S different steps, B queried samples (for which results are returned).
Readings are divided by the deviation of the white part of their noise.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from discrepancy.estimation.filtered import LEAST_INNOVATION_VARIANCE
from discrepancy.estimation.kernel import filter_record, is_steady
from fe.compilation import compiled

NO_STEP = -1
"""Kind of step that stands for none, before the first sample of a record."""


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
        The queried samples, ascending.

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


class FilterState(NamedTuple):
    """The state given the readings before a time, and their contribution to the evidence.

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
    """The information on the state at a time from the readings since then.

    The docstring of `filter_backward` has the log density of which these are the coefficients.

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
            The queried samples, ascending.
        """
        last_query = int(query_samples[-1])
        kinds = step_of_sample[first_sample:last_query].copy()
        if first_sample == 0 and len(kinds):
            kinds[0] = NO_STEP
        samples = slice(first_sample, last_query)
        innovations, _, variances, means, covariances = filter_record(
            1,
            kinds,
            self.transitions,
            self.noises,
            self.output_rows[None],
            self.columns[samples],
            self.used[samples],
            state.covariance,
            state.mean,
            True,
        )
        # the state before the step to a queried sample is that after the sample before it
        samples_before = query_samples - first_sample
        covariances = np.concatenate((state.covariance[None], covariances))[samples_before]
        means = np.concatenate((state.mean[None], means))[samples_before]
        # products and determinants of the readings since `first_sample`, up to each queried sample
        whitened = innovations / np.sqrt(np.abs(variances))[:, :, None]
        products_of_samples = np.split(whitened, samples_before[:-1])
        products_between = [_products_of_rows(rows) for rows in products_of_samples]
        products = np.cumsum(products_between, axis=0)
        # rounding loses the readings if a force is far too large: the evidence is then zero
        is_lost = ~(variances > LEAST_INNOVATION_VARIANCE)
        log_variances = np.where(is_lost, np.inf, np.log(np.where(is_lost, 1.0, variances)))
        half_logs = 0.5 * np.cumsum(np.concatenate(([0.0], log_variances.sum(axis=1))))
        return FilterState(
            covariance=covariances,
            mean=means,
            products=products + state.products,
            half_log_determinants=half_logs[samples_before] + state.half_log_determinants,
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


def _products_of_rows(whitened: FloatArray) -> FloatArray:
    """Return the inner products (W, W) of whitened readings (N, C, W)."""
    rows = whitened.reshape(-1, whitened.shape[-1])
    return np.asarray(rows.T @ rows)


def _covariance_roots(covariances: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances: root @ root.T is the covariance."""
    eigenvalues, eigenvectors = np.linalg.eigh(covariances)
    return np.ascontiguousarray(eigenvectors * np.sqrt(np.maximum(eigenvalues, 0.0))[..., None, :])


def join_filters(before: FilterState, after: StateInformation) -> tuple[FloatArray, FloatArray]:
    """Return the products and half log determinants of a record that was filtered in two parts.

    The state z between both parts is integrated out. Given the readings before, it is Gaussian; the
    readings after have the log density that `filter_backward` gives.

    Parameters
    ----------
    before : FilterState
        The state z given the readings of the first part.
    after : StateInformation
        The information on z from the readings of the second part.

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
