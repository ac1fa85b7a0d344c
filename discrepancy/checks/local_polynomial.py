"""Local polynomials that predict each sample of a record from its neighbours."""

from collections.abc import Callable
from functools import cache, lru_cache, partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import savgol_coeffs

from discrepancy.campaign.records import FloatArray
from discrepancy.campaign.sampling import is_even

LOW_DEGREE = 5
"""Lowest degree of the local polynomials, and the only degree for unevenly spaced samples."""
Weights = Callable[[int, int], FloatArray]
"""Function that returns the weights of a residual for a half width and degree of the polynomial.

The residual of a sample is the weighted sum of the sample and its neighbours. Evenly spaced samples
have the same weights (2 width + 1,), unevenly spaced ones a row each (N - 2 width, 2 width + 1)."""


@lru_cache(maxsize=32)
def event_patterns(width: int, degree: int) -> FloatArray:
    """Return the residuals that a local polynomial leaves of four typical signals.

    Parameters
    ----------
    width, degree : int
        The half width of the neighbourhood in samples, and the degree of the polynomial.

    Returns
    -------
    (4, 2 width + 1) ndarray
        Residuals around the middle sample for a single wrong reading there, a kink there, a step at
        it, and a step after it.
    """
    offsets = np.arange(-2 * width, 2 * width + 1)
    wrong_reading = offsets == 0
    kink = np.abs(offsets)
    step_at_sample = offsets >= 0
    step_after_sample = offsets > 0
    weights = even_weights(width, degree)
    patterns = []
    for signal in (wrong_reading, kink, step_at_sample, step_after_sample):
        patterns.append(np.convolve(np.asarray(signal, dtype=float), weights, "valid"))
    return np.stack(patterns)


class LocalPolynomial:
    """A polynomial through the neighbours of each sample of a record, without the sample itself.

    Near the ends of the record narrower neighbourhoods replace the full one.

    Parameters
    ----------
    weights : callable
        The weights of residuals; see `Weights`.
    width : int
        The half width of the neighbourhood in samples.
    degree : int
        The degree of the polynomial.
    """

    def __init__(self, weights: Weights, width: int, degree: int) -> None:
        self.width = width
        self.degree = degree
        narrower = [half_width for half_width in (3, 4, 6, 9, 13) if half_width < width]
        # in order of width: where neighbourhoods of several widths fit, the widest counts
        self._weights = {half_width: weights(half_width, LOW_DEGREE) for half_width in narrower}
        self._weights[width] = weights(width, degree)

    def residual(self, values: FloatArray) -> FloatArray:
        """Return the residuals (N,) of a record (N,): each sample minus its prediction.

        For unevenly spaced samples the residuals are scaled so that white noise has the same
        scatter in all of them. The first and last samples, which have no full neighbourhood of any
        width, have the residual zero.
        """
        residual = np.zeros(len(values))
        # narrow windows first: the wider ones overwrite all but the ends
        for width, weights in self._weights.items():
            if weights.ndim == 1:  # evenly spaced: the same symmetric weights for all samples
                inner_residuals = np.convolve(values, weights, mode="valid")
            else:
                windows = sliding_window_view(values, 2 * width + 1)  # (N - 2 width, 2 width + 1)
                inner_residuals = np.einsum("nw,nw->n", windows, weights)
            residual[width : len(values) - width] = inner_residuals
        return residual

    def weight_of_sample(self, count: int) -> FloatArray:
        """Return the weight of each of `count` samples in its own residual."""
        weight = np.ones(count)
        for width, weights in self._weights.items():
            weight[width : count - width] = weights[..., width]
        return weight


@lru_cache(maxsize=32)
def even_weights(width: int, degree: int) -> FloatArray:
    """Return the weights (2 width + 1,) of a sample's neighbourhood in the residual of the sample.

    The residual is the sample minus a polynomial of least squares through its neighbours, without
    the sample itself. This residual equals that of the Savitzky-Golay filter, whose polynomial also
    fits the sample, divided by the weight of the sample in that residual (one minus its leverage).
    """
    weights = -savgol_coeffs(2 * width + 1, degree)
    weights[width] += 1.0
    return np.asarray(weights / weights[width])


def weights_for_times(time: FloatArray) -> Weights:
    """Return the function of weights for records at times (N,); it keeps what it has computed.

    For evenly spaced times it is `even_weights`.
    """
    return even_weights if is_even(time) else cache(partial(uneven_weights, time))


def uneven_weights(time: FloatArray, width: int, degree: int) -> FloatArray:
    """Return the weights that give each sample's residual, for unevenly spaced samples.

    As in `even_weights`, the polynomial is fitted to the neighbours alone. The weights are scaled
    so that white noise gives the same scatter of residuals as with evenly spaced samples.

    Parameters
    ----------
    time : (N,) ndarray
        The times of the samples [s].
    width, degree : int
        The half width of the neighbourhood in samples, and degree of the polynomial.

    Returns
    -------
    (N - 2 width, 2 width + 1) ndarray
        The weights of each sample that has all its neighbours.
    """
    # times of each neighbourhood, from -1 to 1 about the sample itself (samples, 2 width + 1)
    inner_times = time[width : len(time) - width, np.newaxis]
    relative_times = sliding_window_view(time, 2 * width + 1) - inner_times
    relative_times /= np.max(np.abs(relative_times), axis=1, keepdims=True)
    times_of_neighbours = np.delete(relative_times, width, axis=1)
    # least squares by the normal equations; basis (samples, 2 width, degree + 1)
    basis = np.polynomial.polynomial.polyvander(times_of_neighbours, degree)
    # a ridge, because next to a wide gap the samples may not determine the whole polynomial
    ridge = 1e-10 * np.eye(degree + 1)
    gram = basis.transpose(0, 2, 1) @ basis
    inverse_gram = np.linalg.inv(gram + ridge)
    # the sample itself is at time zero, where the polynomial equals its constant coefficient
    constant_columns = inverse_gram[..., :1]
    prediction_weights = (basis @ constant_columns).squeeze(axis=-1)
    weights = np.insert(-prediction_weights, width, 1.0, axis=1)
    norm = np.linalg.norm(weights, axis=1, keepdims=True)
    even_norm = np.linalg.norm(even_weights(width, degree))
    return np.asarray(weights * (even_norm / norm))
