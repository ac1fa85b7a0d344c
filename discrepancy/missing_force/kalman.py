"""The Kalman filter of a record, forwards, and its counterpart backwards: what both tell together.

What is known before a moment and what the readings after it say (Fraser and Potter 1969, IEEE
Transactions on Automatic Control 14, 387-390) give the evidence of all readings and the state at
that moment. Readings come one at a time, so nothing is inverted forwards; covariance and
information are updated in Joseph form. Where they have become steady they are kept.

Shapes: n states, c channels, N samples, W columns that are filtered alike, S different steps, B
places.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from discrepancy.campaign.records import BoolArray, FloatArray, IntArray
from fe.compilation import callable_when_compiled, compiled

from .backward import backward
from .covariances import is_steady

SMALL_PART, ORDERS = 0.25, 12
"""Norm of what is summed as a series, and its orders: 1e-16 is left out."""
LEAST_SIZE = 0.5
"""Variance of a reading, over its noise, below which rounding has taken what a force too large left
of it."""


@compiled
def discretised(
    generator: FloatArray, intensity: FloatArray, lengths: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return transitions and noises (J, n, n) of steps of given lengths (J,) [s].

    Series for a small part of a step, which is then doubled: what decays within a step would grow
    beyond all numbers in an exponential of both signs.
    """
    n = len(generator)
    norm = np.max(np.sum(np.abs(generator), axis=1)) if n else 0.0
    transitions = np.empty((len(lengths), n, n))
    noises = np.empty((len(lengths), n, n))
    for k in range(len(lengths)):
        doublings = 0
        part = lengths[k]
        while norm * part > SMALL_PART:
            doublings += 1
            part = 0.5 * part
        # Taylor series of both for the part
        transition = np.eye(n)
        transition_term = np.eye(n)
        noise = intensity * part
        noise_term = intensity * part
        for order in range(1, ORDERS):
            transition_term = (generator @ transition_term) * (part / order)
            transition = transition + transition_term
            noise_term = (generator @ noise_term + noise_term @ generator.T) * (part / (order + 1))
            noise = noise + noise_term
        # two parts in a row make one of twice the length
        for _ in range(doublings):
            noise = transition @ noise @ transition.T + noise
            transition = transition @ transition
        transitions[k] = transition
        noises[k] = 0.5 * (noise + noise.T)
    return transitions, noises


@callable_when_compiled
def update_covariance(covariance: FloatArray, row: FloatArray, gain: FloatArray) -> float:
    """Return the variance of a reading.

    Take it into a covariance (n, n), and fill its gain (n,).
    """
    along = covariance @ row
    variance = row @ along + 1.0
    gain[:] = along / variance
    # Joseph form, from both sides in turn: what the first leaves by rounding the second takes
    for i in range(len(row)):
        for j in range(len(row)):
            covariance[i, j] -= gain[i] * along[j]
    along = covariance @ row
    for i in range(len(row)):
        for j in range(len(row)):
            covariance[i, j] += (gain[i] - along[i]) * gain[j]
    return float(variance)


@callable_when_compiled
def predict_mean(transition: FloatArray, mean: FloatArray, predicted: FloatArray) -> None:
    """Fill the mean (n, W) after a step; transitions are mostly zeros."""
    predicted[:] = 0.0
    for i in range(len(transition)):
        for j in range(len(transition)):
            factor = transition[i, j]
            if factor != 0.0:
                for w in range(mean.shape[1]):
                    predicted[i, w] += factor * mean[j, w]


@callable_when_compiled
def subtract_prediction(row: FloatArray, mean: FloatArray, innovation: FloatArray) -> None:
    """Take the prediction of a reading from its columns (W,), which leaves their innovation."""
    for j in range(len(row)):
        factor = row[j]
        if factor != 0.0:
            for w in range(len(innovation)):
                innovation[w] -= factor * mean[j, w]


@callable_when_compiled
def update_mean(gain: FloatArray, innovation: FloatArray, mean: FloatArray) -> None:
    """Take the innovation (W,) of a reading into a mean (n, W)."""
    for j in range(len(gain)):
        factor = gain[j]
        for w in range(len(innovation)):
            mean[j, w] += factor * innovation[w]


@compiled
def forward(
    transitions: FloatArray,
    noises: FloatArray,
    step_of_sample: IntArray,
    rows: FloatArray,
    used: BoolArray,
    columns: FloatArray,
    first: int,
    covariance: FloatArray,
    mean: FloatArray,
    places: IntArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the state given the readings of samples `first` to `places` (B,), without the last.

    Parameters
    ----------
    transitions, noises : (S, n, n) ndarray
        Transitions of the different steps, and the covariances of the noise that they add.
    step_of_sample : (N,) ndarray
        The step that leads to each sample.
    rows, used, columns : (c, n), (N, c), (N, c, W) ndarray
        What the readings show of the state, over their noise; which readings count; what is
        filtered.
    first : int
        The first sample that is read.
    covariance, mean : (n, n), (n, W) ndarray
        State after the sample before it; at the first of the record, there.
    places : (B,) ndarray
        Samples before which the state is asked for, in order.

    Returns ------- covariances, means, white, halves : (B, n, n), (B, n, W), (places[-1] - first,
    c, W), (B,) ndarray
        State after the last sample read, columns as independent numbers of variance one, half the
        logarithm of the readings' variances; infinite where one has been lost to rounding.
    gains, variances : (B, c, n), (B, c) ndarray
        Of the readings of that sample.
    """
    n, width = mean.shape
    channels = len(rows)
    count = len(places)
    covariances = np.zeros((count, n, n))
    means = np.zeros((count, n, width))
    white = np.zeros((places[-1] - first, channels, width))
    halves = np.full(count, np.inf)
    all_gains = np.zeros((count, channels, n))
    all_variances = np.ones((count, channels))

    covariance = covariance.copy()
    mean = mean.copy()
    predicted = np.zeros((n, width))
    gains = np.zeros((channels, n))
    variances = np.ones(channels)
    half = 0.0
    place = 0
    steady = False
    for k in range(first, places[-1] + 1):
        # hand out the state where it is asked for
        while place < count and places[place] == k:
            covariances[place] = covariance
            means[place] = mean
            halves[place] = half
            all_gains[place] = gains
            all_variances[place] = variances
            place += 1
        if place == count:
            break
        same_step = k > first + 1 and step_of_sample[k] == step_of_sample[k - 1]
        is_like_last = same_step and bool(np.all(used[k] == used[k - 1]))
        steady = steady and is_like_last
        last_covariance = covariance
        # predict
        if k > 0:
            transition = transitions[step_of_sample[k]]
            predict_mean(transition, mean, predicted)
            mean, predicted = predicted, mean
            if not steady:
                covariance = transition @ covariance @ transition.T + noises[step_of_sample[k]]
                covariance = 0.5 * (covariance + covariance.T)
        # take in the readings one at a time
        for c in range(channels):
            if not used[k, c]:
                continue
            if not steady:
                variances[c] = update_covariance(covariance, rows[c], gains[c])
                if not variances[c] > LEAST_SIZE:
                    return covariances, means, white, halves, all_gains, all_variances
            innovation = white[k - first, c]
            innovation[:] = columns[k, c]
            subtract_prediction(rows[c], mean, innovation)
            update_mean(gains[c], innovation, mean)
            innovation /= np.sqrt(variances[c])
            half += 0.5 * np.log(variances[c])
        steady = steady or (is_like_last and is_steady(covariance, last_covariance))
    return covariances, means, white, halves, all_gains, all_variances


@compiled
def driven(
    parts: int,
    transitions: FloatArray,
    push_at_begin: FloatArray,
    push_at_end: FloatArray,
    step_of_sample: IntArray,
    start: FloatArray,
    pushes: FloatArray,
) -> FloatArray:
    """Return the state (F, n) at the fine stamps under pushes (F, d), straight between them.

    Parameters
    ----------
    parts : int
        Fine steps between two samples.
    transitions : (J, n, n) ndarray
        Transitions of the different fine steps.
    push_at_begin, push_at_end : (J, n, d) ndarray
        The change of the state by a unit push at the begin and the end of a fine step.
    step_of_sample : (N,) ndarray
        The step that leads to each sample.
    start : (n,) ndarray
        State at the first stamp.
    pushes : (F, d) ndarray
        Pushes at the fine stamps.
    """
    n, push_count = push_at_begin.shape[1], pushes.shape[1]
    states = np.zeros((len(pushes), n))
    states[0] = start
    for k in range(len(pushes) - 1):
        step = step_of_sample[k // parts + 1]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += transitions[step, i, j] * states[k, j]
            for d in range(push_count):
                total += (
                    push_at_begin[step, i, d] * pushes[k, d]
                    + push_at_end[step, i, d] * pushes[k + 1, d]
                )
            states[k + 1, i] = total
    return states


FilterState = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Covariance or information (.., n, n), means or what lies along it (.., n, W), products of columns
(.., W, W), and half a logarithm (..)."""


@dataclass(frozen=True, eq=False)
class FilterSteps:
    """A record as `forward` takes it, but for which of its steps leads to each sample."""

    moves: FloatArray
    noises: FloatArray
    rows: FloatArray
    used: BoolArray
    columns: FloatArray

    @cached_property
    def noise_roots(self) -> FloatArray:
        """Roots of the noises."""
        return _roots(self.noises)

    def begin(self, covariance: FloatArray) -> FilterState:
        """Return the state at the first sample, of a covariance."""
        n, width = self.rows.shape[1], self.columns.shape[2]
        return covariance, np.zeros((n, width)), np.zeros((width, width)), np.zeros(())

    def before(
        self, step_of_sample: IntArray, first: int, state: Sequence[FloatArray], places: IntArray
    ) -> FilterState:
        """Return the states before the steps to some samples, filtered from a first one on."""
        covariance, mean, known_products, known_halves = state
        covariances, means, white, halves, *_ = forward(
            self.moves,
            self.noises,
            step_of_sample,
            self.rows,
            self.used,
            self.columns,
            first,
            covariance,
            mean,
            places,
        )
        # products of the whitened columns up to each place
        by_place = np.split(
            white.reshape(-1, white.shape[-1]), len(self.rows) * (places[:-1] - first)
        )
        products = np.cumsum([columns.T @ columns for columns in by_place], axis=0)
        return covariances, means, products + known_products, halves + known_halves

    def after(self, step_of_sample: IntArray, places: IntArray) -> FilterState:
        """Return what the readings from some samples on tell of the states there."""
        return backward(
            self.moves, self.noise_roots, step_of_sample, self.rows, self.used, self.columns, places
        )


def _roots(covariances: FloatArray) -> FloatArray:
    """Return roots (..., n, n) of covariances."""
    values, vectors = np.linalg.eigh(covariances)
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def joined(
    before: Sequence[FloatArray], after: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return products (..., W, W) and half log determinants (...) of records from both parts.

    The state between both parts is integrated out: Gaussian before, with the information of what
    came after.
    """
    covariance, mean, products, half = before
    J, h, later_products, later_half = after
    root = _roots(covariance)
    inner = np.linalg.cholesky(np.eye(covariance.shape[-1]) + root.mT @ J @ root)
    explained = np.asarray(np.linalg.solve(inner, root.mT @ (h - J @ mean)))
    cross = mean.mT @ h
    whole = (
        products + later_products - cross - cross.mT + mean.mT @ J @ mean - explained.mT @ explained
    )
    half_log_determinant = np.log(np.diagonal(inner, axis1=-2, axis2=-1)).sum(-1)
    return whole, half + later_half + half_log_determinant
