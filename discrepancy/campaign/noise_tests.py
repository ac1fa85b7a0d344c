"""Statistical tests of residuals and noise: variance, whiteness, lines; corrections for many tests.

Noise records, gates, location and proof all use these tests.
"""

from collections.abc import Sequence
from functools import cache
from math import ceil
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.special import chdtr, chdtrc, fdtr, fdtrc, gammaincc

from discrepancy.campaign.records import BoolArray, FloatArray
from reporting.arrays import LEAST_DIVISOR

SHORTEST_SERIES = 32
"""Fewest samples of a series whose whiteness is tested."""
LAGS = 20
"""Largest number of autocorrelations in the Ljung-Box test."""
LARGEST_LAG_SHARE = 0.25
"""Largest lag of an autocorrelation, as a fraction of the record."""
LEAST_P_VALUE, LARGEST_P_VALUE = 1e-300, 1.0 - 1e-16
"""Limits of a p-value whose logarithm or normal score is taken, so that these are finite."""
LEAST_DRAWS = 8_000
"""Fewest series from which the distribution of the Ljung-Box statistic is taken."""


def variance_p_value(
    mean_square: float, freedom: float, noise_freedom: float, *, small: bool = False
) -> float:
    """Return the p-value of a mean square of residuals under the hypothesis of noise alone.

    The mean square, divided by the estimated variance of the noise, then has an F distribution. If
    the variance of the noise is known exactly, the sum of squares has a chi-squared distribution.

    Parameters
    ----------
    mean_square : float
        The mean square of residuals over the variance of the noise [1].
    freedom : float
        The degrees of freedom of the residuals.
    noise_freedom : float
        The degrees of freedom of the noise record; infinite if its variance is exact.
    small : bool
        True for the probability of a smaller mean square; by default it is that of a larger one.
    """
    if np.isinf(noise_freedom):
        distribution = chdtr if small else chdtrc
        return float(distribution(freedom, mean_square * freedom))
    distribution = fdtr if small else fdtrc
    return float(distribution(freedom, noise_freedom, mean_square))


def pooled_variance_p_value(
    p_values: FloatArray, freedom: FloatArray, noise_freedom: FloatArray
) -> float:
    """Combine the p-values of several channels' mean squares into one by Stouffer's method.

    Each p-value becomes a standard normal score. The combined score is the weighted sum of the
    scores over the root of the sum of the squared weights; if the channels are independent, it is
    standard normal as well, and the combined p-value is exact. (The sum of the mean squares
    themselves would have a heavy tail where a noise record is short.)

    The weight of a channel is the inverse standard deviation of its mean square, whose variance is
    2 / freedom + 2 / noise_freedom. These weights find a model error best that raises all mean
    squares by the same amount. A common factor of the weights cancels.

    Parameters
    ----------
    p_values : (C,) ndarray
        p-value of each channel, from `variance_p_value`.
    freedom : (C,) ndarray
        The degrees of freedom of each channel's residuals.
    noise_freedom : (C,) ndarray
        The degrees of freedom of each channel's noise record.
    """
    weights = np.sqrt(freedom / (1.0 + freedom / noise_freedom))
    scores = stats.norm.isf(np.clip(p_values, LEAST_P_VALUE, LARGEST_P_VALUE))
    return float(stats.norm.sf(weights @ scores / np.sqrt(weights @ weights)))


class SeriesTest(NamedTuple):
    """The outcome of a test whether a series is white.

    Attributes
    ----------
    statistic : float
        The statistic of the test.
    p_value : float
        The probability of a larger statistic if the series is white.
    """

    statistic: float
    p_value: float


def ljung_box(series: FloatArray, is_used: BoolArray | None = None) -> SeriesTest:
    """Test whether a series of residuals is white by the statistic Q of Ljung and Box.

    Q = n (n + 2) sum_k rho_k^2 / (n - k) over the lags k = 1 .. min(20, n / 5), where rho_k are the
    autocorrelations of a series of n samples whose mean is known to be zero (Ljung and Box 1978,
    Biometrika 65, eq. (1.3)). The chi-squared distribution is too light in its tail for Q: at
    n = 64, Q exceeds its 99 % point up to four times too often. The p-value is therefore taken from
    a gamma distribution with the mean, variance and skewness of Q at this n. If a model was fitted
    to the series, a false rejection becomes less probable, never more. A series that is zero, or
    too short for one lag, has the p-value 1.

    Parameters
    ----------
    series : (N,) ndarray
        Residuals, with a mean of zero.
    is_used : (N,) ndarray of bool, optional
        False for samples that are left out. Then n is the number of used samples, and n - k is
        replaced by the number of pairs of used samples at lag k, which keeps the mean of Q exact.
    """
    if is_used is None:
        count = series.size
        values = series
    else:
        count = int(is_used.sum())
        values = np.where(is_used, series, 0.0)
    lags = min(LAGS, count // 5)
    if lags < 1 or not np.any(values):
        return SeriesTest(0.0, 1.0)
    if is_used is None:
        pairs = count - np.arange(1.0, lags + 1)
    else:
        pairs = lag_products(is_used.astype(float), lags)[0, 1:]
    statistic = float(_portmanteau(values[np.newaxis], count, pairs)[0])
    mean, deviation, skewness = _portmanteau_moments(count, lags)
    # the standardised gamma distribution of this skewness (Pearson's type III)
    rate = 2.0 / skewness
    shape = rate**2
    p_value = gammaincc(shape, rate * ((statistic - mean) / deviation + shape / rate))
    return SeriesTest(statistic, float(p_value))


def lag_products(rows: FloatArray, lags: int) -> FloatArray:
    """Return the sums of lagged products of samples, the unnormalised autocovariance.

    The sums are computed by the fast Fourier transform (Wiener-Khinchin).

    Parameters
    ----------
    rows : (M, N) or (N,) ndarray
        One series of N samples, or M of them.
    lags : int
        The largest lag, in samples.

    Returns
    -------
    (M, lags + 1) ndarray
        sum_t x_t x_(t+k) of each series.
    """
    rows = np.atleast_2d(rows)
    padded_size = 2 * rows.shape[1]  # so that the transform does not wrap around
    power = np.abs(np.fft.rfft(rows, padded_size, axis=1)) ** 2
    return np.asarray(np.fft.irfft(power, axis=1)[:, : lags + 1])


def autocorrelation(series: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Estimate one autocorrelation from several records, and its variance for white noise.

    Parameters
    ----------
    series : sequence of (N,) ndarray
        The records, of any lengths.

    Returns
    -------
    rho : (K,) ndarray
        Autocorrelation at lags 1 .. K, with K a quarter of the longest record.
    white_variance : (K,) ndarray
        The variance of `rho` if the records are white.
    """
    longest = max(len(record) for record in series)
    lags = max(int(LARGEST_LAG_SHARE * longest), 2)
    products = np.zeros(lags + 1)
    pair_counts = np.zeros(lags + 1)
    for record in series:
        record_products = lag_products(record, min(lags, len(record) - 1))[0]
        lag_count = len(record_products)
        products[:lag_count] += record_products
        pair_counts[:lag_count] += len(record) - np.arange(lag_count)
    rho = products[1:] / max(products[0], LEAST_DIVISOR)
    # for white noise: (number of pairs) sigma^4 over (sum of squares = n sigma^2)^2
    white_variance = pair_counts[1:] / pair_counts[0] ** 2
    return rho, white_variance


def statistical_inefficiency(
    rho: FloatArray, white_variance: FloatArray, ratio: float = 1.0
) -> float:
    """Return how many samples of a correlated record count as one independent sample.

    For a variance estimate this factor is 1 + 2 sum_k rho_k^2. Estimated autocorrelations are not
    zero even for white noise, so the expected sum of their squares by chance is subtracted. For a
    correlated series this expected sum is larger than for white noise, and is scaled by the
    formula of Bartlett (1946, Suppl. J. R. Stat. Soc. 8, 27-41).

    Parameters
    ----------
    rho, white_variance : (K,) ndarray
        The autocorrelation and its variance for white noise, from `autocorrelation`.
    ratio : float
        The factor on the autocorrelation `rho`, if the correlation of the samples in question is
        weaker or stronger than that of the whole series.

    Returns
    -------
    float
        The factor, at least 1.
    """
    squares = float(np.sum(rho**2))
    squares_by_chance = float(np.sum(white_variance))
    squares_by_chance *= (1.0 + 2.0 * squares) / (1.0 + 2.0 * squares_by_chance)
    return max(1.0 + 2.0 * ratio**2 * (squares - squares_by_chance), 1.0)


def _portmanteau(rows: FloatArray, count: int, pairs: FloatArray) -> FloatArray:
    """Return the Ljung-Box statistic Q of each of M series, an (M,) array.

    Parameters
    ----------
    rows : (M, N) ndarray
        Series; samples that are left out are zero.
    count : int
        The number n of used samples of each series.
    pairs : (lags,) ndarray
        The number of pairs of used samples at each lag.
    """
    products = lag_products(rows, len(pairs))  # (M, 1 + lags)
    rho = products[:, 1:] / products[:, :1]  # autocorrelations
    return np.asarray(count * (count + 2) * np.sum(rho**2 / np.maximum(pairs, 1.0), axis=1))


@cache
def _portmanteau_moments(count: int, lags: int) -> tuple[float, float, float]:
    """Return mean, standard deviation and skewness of the Ljung-Box Q for white noise.

    The mean is known; the other two are found by a simulation with a fixed seed.

    Parameters
    ----------
    count : int
        The number n of samples of the series.
    lags : int
        The number of lags in the statistic.
    """
    generator = np.random.default_rng(20260101)
    draws_at_once = max(20, 400_000 // count)  # limits the memory
    batches = ceil(LEAST_DRAWS / draws_at_once)
    pairs = count - np.arange(1.0, lags + 1)  # pairs of samples at each lag
    statistics = []
    for _ in range(batches):
        noise = generator.standard_normal((draws_at_once, count))
        statistics.append(_portmanteau(noise, count, pairs))
    values = np.concatenate(statistics)  # (draws,)
    # the mean of Q is known and equals the number of lags, because the squared autocorrelation at
    # lag k has the mean (n - k) / (n (n + 2)) if the mean of the series is known to be zero
    deviation = float(np.sqrt(np.mean((values - lags) ** 2)))
    return float(lags), deviation, float(stats.skew(values))


def periodogram(series: FloatArray) -> FloatArray:
    """Return the ordinates |FFT|^2 / n of a series (n,) at the frequencies j / n, 0 < j < n / 2.

    The mean of the ordinates is the variance of the series.
    """
    count = series.size
    return np.asarray(np.abs(np.fft.rfft(series)[1 : (count - 1) // 2 + 1]) ** 2 / count)


def cumulative_periodogram(series: FloatArray) -> SeriesTest:
    """Test whether a series (n,) is white by its cumulative periodogram.

    For Gaussian white noise the cumulative sums of the M ordinates, divided by the total, are
    distributed as the order statistics of M - 1 uniform variables. Kolmogorov's distribution of
    their largest departure from a straight line thus holds exactly (Bartlett 1955; Durbin 1969,
    Biometrika 56, 1-15).
    """
    ordinates = periodogram(series)
    total_power = float(ordinates.sum())
    if total_power == 0.0 or ordinates.size < 3:
        return SeriesTest(0.0, 1.0)
    fractions = np.cumsum(ordinates)[:-1] / total_power
    test = stats.kstest(np.clip(fractions, 0.0, 1.0), "uniform")
    return SeriesTest(float(test.statistic), float(test.pvalue))


class LineTest(NamedTuple):
    """The outcome of a test for a spectral line.

    Attributes
    ----------
    statistic : float
        Fisher's g: the largest ordinate of the periodogram over the sum of all.
    p_value : float
        The probability of a larger g for white noise.
    frequency_index : int
        The index j of the largest ordinate; the frequency is j / n per sample.
    """

    statistic: float
    p_value: float
    frequency_index: int


def fisher_g(series: FloatArray) -> LineTest:
    """Test a series (n,) for a spectral line by Fisher's g (1929, Proc. R. Soc. A 125, 54-59).

    Of the sum for the p-value only the first term t = M (1 - g)^(M - 1) is used, for M ordinates,
    as 1 - exp(-t). The p-value is exact to first order where it is small, and never above one.
    """
    return largest_ordinate_test(periodogram(series))


def largest_ordinate_test(ordinates: FloatArray) -> LineTest:
    """Test the ordinates (M,) of a periodogram by Fisher's g; the first has the frequency index 1.

    The test holds if all ordinates have the same expected value without a line. If all are zero,
    the p-value is 1 and the frequency index 0.
    """
    total_power = float(ordinates.sum())
    if total_power == 0.0:
        return LineTest(0.0, 1.0, 0)
    largest = int(np.argmax(ordinates))
    g = float(ordinates[largest]) / total_power
    first_term = ordinates.size * (1.0 - g) ** (ordinates.size - 1)
    return LineTest(g, float(-np.expm1(-first_term)), largest + 1)


def combine_p_values(p_values: Sequence[float]) -> float:
    """Combine independent p-values into one: twice the lesser of Fisher's and Bonferroni's.

    Fisher's sum -2 sum log p detects many small departures, and Bonferroni's least p-value a single
    large one. The factor two allows for the choice between them.
    """
    values = np.clip(np.asarray(p_values, dtype=float), LEAST_P_VALUE, 1.0)
    if values.size == 1:
        return float(values[0])
    fisher = float(stats.chi2.sf(-2.0 * np.log(values).sum(), 2 * values.size))
    bonferroni = values.size * float(values.min())
    return float(min(1.0, 2.0 * min(fisher, bonferroni)))


def holm_rejections(p_values: Sequence[float], level: float) -> tuple[bool, ...]:
    """Return which null hypotheses Holm's rule rejects (Holm 1979, Scand. J. Statist. 6, 65-70).

    A p-value of nan stands for a test that was not made, and is never rejected.
    """
    values = np.asarray(p_values, dtype=float)
    tested = np.flatnonzero(np.isfinite(values))
    is_rejected = np.zeros(values.size, dtype=bool)
    # from the least p-value on, until the first one that is not rejected
    for rank, index in enumerate(tested[np.argsort(values[tested])]):
        if values[index] > level / (tested.size - rank):
            break
        is_rejected[index] = True
    return tuple(bool(value) for value in is_rejected)


def benjamini_yekutieli(p_values: FloatArray, rate: float) -> BoolArray:
    """Return which hypotheses (M,) are discoveries at a false discovery rate, under any dependence.

    Benjamini and Yekutieli 2001, Annals of Statistics 29, 1165-1188, theorem 1.3.
    """
    if not p_values.size:
        return np.zeros(0, dtype=bool)
    return np.asarray(stats.false_discovery_control(p_values, method="by") <= rate)
