"""Tests of what noise alone would leave: size against a record, whiteness, lines; and rules for many of them.

The one statistics of residuals: noise records, gates, location and proof all judge by it.
"""

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy import stats
from scipy.special import chdtr, chdtrc, fdtr, fdtrc, gammaincc

from discrepancy.campaign.records import BoolArray, FloatArray

SHORTEST_SERIES = 32
"""Fewest samples of a series whose whiteness is tested."""
LAGS = 20
"""Largest number of autocorrelations in the Ljung-Box test."""
LOOKED_AT = 0.25
"""Share of a record up to which its autocorrelation is looked at."""
LEAST_DRAWS = 8_000
"""Series that the distribution of its statistic is taken from."""


def variance_p_value(
    mean_square: float, freedom: float, noise_freedom: float, *, small: bool = False
) -> float:
    """Return P(mean square this large, or this small) against a noise record: F, or chi^2 if it is exact."""
    if np.isinf(noise_freedom):
        return float((chdtr if small else chdtrc)(freedom, mean_square * freedom))
    return float((fdtr if small else fdtrc)(freedom, noise_freedom, mean_square))


def pooled_variance_p_value(p_values: FloatArray, freedom: FloatArray, noise_freedom: FloatArray) -> float:
    """Return one p-value of the mean squares of several channels, for a gap that raises all alike.

    Stouffer's sum of normal scores, each weighted by how many of its standard deviations such a gap is: a
    mean square over its noise has the variance 2 / freedom + 2 / noise_freedom. Exact, while the sum of
    squares itself has a heavy tail where a noise record is short.

    Parameters
    ----------
    p_values, freedom, noise_freedom : (C,) ndarray
        Of each channel: what `variance_p_value` returned, and what it was given.
    """
    weights = np.sqrt(freedom / (1.0 + freedom / noise_freedom))
    scores = stats.norm.isf(np.clip(p_values, 1e-300, 1.0 - 1e-16))
    return float(stats.norm.sf(weights @ scores / np.sqrt(weights @ weights)))


def ljung_box(series: FloatArray, used: BoolArray | None = None) -> tuple[float, float]:
    """Return Q and its p-value for a series that is white with mean zero under the null.

    Ljung and Box 1978, Biometrika 65, eq. (1.3): Q = n (n + 2) sum_k rho_k^2 / (n - k) over
    min(20, n / 5) lags. Beyond its 99 % point chi^2 is exceeded up to four times too often at n = 64:
    the p-value is that of a gamma distribution with the mean, variance and skewness of Q at this n. What a
    model that was fitted to the series has absorbed makes the test stricter on itself, never laxer.

    Parameters
    ----------
    series : (N,) ndarray
        Residuals.
    used : (N,) ndarray of bool, optional
        Samples that count: n is their number, and the pairs k apart that are left stand for n - k, so that
        the mean of Q stays exact.
    """
    count = series.size if used is None else int(used.sum())
    lags = min(LAGS, count // 5)
    kept = series if used is None else np.where(used, series, 0.0)
    if lags < 1 or not np.any(kept):
        return 0.0, 1.0
    pairs = (
        count - np.arange(1.0, lags + 1) if used is None else lag_products(used.astype(float), lags)[0, 1:]
    )
    statistic = float(_portmanteau(kept[np.newaxis], count, pairs)[0])
    mean, deviation, skewness = _portmanteau_moments(count, lags)
    # the standardised gamma distribution of this skewness (Pearson's type III)
    rate = 2.0 / skewness
    shape = rate**2
    return statistic, float(gammaincc(shape, rate * ((statistic - mean) / deviation + shape / rate)))


def lag_products(rows: FloatArray, lags: int) -> FloatArray:
    """Return the sums of products of samples 0 .. lags apart of each row, (M, lags + 1)."""
    rows = np.atleast_2d(rows)
    size = 2 * rows.shape[1]
    power = np.abs(np.fft.rfft(rows, size, axis=1)) ** 2
    return np.asarray(np.fft.irfft(power, axis=1)[:, : lags + 1])


def autocorrelation(series: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return the autocorrelation (K,) of records together from one sample on, and its variance for noise."""
    lags = max(int(LOOKED_AT * max(len(item) for item in series)), 2)
    products, pairs = np.zeros(lags + 1), np.zeros(lags + 1)
    for item in series:
        own = lag_products(item, min(lags, len(item) - 1))[0]
        products[: len(own)] += own
        pairs[: len(own)] += len(item) - np.arange(len(own))
    return products[1:] / max(products[0], 1e-300), pairs[1:] / pairs[0] ** 2


def times_fewer(rho: FloatArray, chance: FloatArray, ratio: float = 1.0) -> float:
    """Return how many times fewer independent samples there are, of an `autocorrelation`.

    Chance takes as many times more of the squares (Bartlett 1946, Suppl. J. R. Stat. Soc. 8, 27-41). With a
    `ratio`, of a part whose correlation is so many times that of the whole.
    """
    squares, by_chance = float(np.sum(rho**2)), float(np.sum(chance))
    by_chance *= (1.0 + 2.0 * squares) / (1.0 + 2.0 * by_chance)
    return max(1.0 + 2.0 * ratio**2 * (squares - by_chance), 1.0)


def _portmanteau(rows: FloatArray, count: int, pairs: FloatArray) -> FloatArray:
    """Return Q of each row, of which `count` samples count in so many pairs of each lag (lags,)."""
    products = lag_products(rows, len(pairs))
    rho = products[:, 1:] / products[:, :1]
    return np.asarray(count * (count + 2) * np.sum(rho**2 / np.maximum(pairs, 1.0), axis=1))


@cache
def _portmanteau_moments(count: int, lags: int) -> tuple[float, float, float]:
    """Return mean, standard deviation and skewness of Q under white noise, from draws with a fixed seed."""
    generator = np.random.default_rng(20260101)
    draws = max(20, 400_000 // count)
    pairs = count - np.arange(1.0, lags + 1)
    values = np.concatenate(
        [
            _portmanteau(generator.standard_normal((draws, count)), count, pairs)
            for _ in range(-(-LEAST_DRAWS // draws))
        ]
    )
    # The mean is known: E rho_k^2 = (n - k) / (n (n + 2)) for a series whose mean is known to be zero.
    deviation = float(np.sqrt(np.mean((values - lags) ** 2)))
    return float(lags), deviation, float(stats.skew(values))


def periodogram(series: FloatArray) -> FloatArray:
    """Return the ordinates |FFT|^2 / n at the frequencies j / n, 0 < j < n / 2; the mean is the variance."""
    count = series.size
    return np.asarray(np.abs(np.fft.rfft(series)[1 : (count - 1) // 2 + 1]) ** 2 / count)


def cumulative_periodogram(series: FloatArray) -> tuple[float, float]:
    """Return the largest deviation of the cumulative periodogram from the line and its p-value.

    Under Gaussian white noise the normalised sums are order statistics of M - 1 uniform variables, so that
    Kolmogorov's distribution holds exactly (Bartlett 1955; Durbin 1969, Biometrika 56, 1-15).
    """
    ordinates = periodogram(series)
    total = float(ordinates.sum())
    if total == 0.0 or ordinates.size < 3:
        return 0.0, 1.0
    shares = np.cumsum(ordinates)[:-1] / total
    found = stats.kstest(np.clip(shares, 0.0, 1.0), "uniform")
    return float(found.statistic), float(found.pvalue)


def fisher_g(series: FloatArray) -> tuple[float, float, int]:
    """Return the share of the largest ordinate, its p-value and its index j (frequency j / n).

    Fisher 1929, Proc. R. Soc. A 125, 54-59. The first term of his sum is used, M (1 - g)^(M - 1), passed
    through 1 - exp(-.): it is exact to first order where p is small and never above one.
    """
    ordinates = periodogram(series)
    total = float(ordinates.sum())
    if total == 0.0:
        return 0.0, 1.0, 0
    place = int(np.argmax(ordinates))
    share = float(ordinates[place]) / total
    first = ordinates.size * (1.0 - share) ** (ordinates.size - 1)
    return share, float(-np.expm1(-first)), place + 1


def combine(p_values: Sequence[float]) -> float:
    """Return one p-value of several independent ones: twice the better of Fisher's sum and Bonferroni.

    Fisher's sum sees much that is a little wrong, the least p-value one place that is very wrong.
    """
    values = np.clip(np.asarray(p_values, dtype=float), 1e-300, 1.0)
    if values.size == 1:
        return float(values[0])
    fisher = float(stats.chi2.sf(-2.0 * np.log(values).sum(), 2 * values.size))
    return float(min(1.0, 2.0 * min(fisher, values.size * float(values.min()))))


def holm(p_values: Sequence[float], level: float) -> tuple[bool, ...]:
    """Return which hypotheses Holm's rule rejects (Holm 1979, Scand. J. Statist. 6, 65-70); nan never."""
    values = np.asarray(p_values, dtype=float)
    applied = np.flatnonzero(np.isfinite(values))
    rejected = np.zeros(values.size, dtype=bool)
    for rank, index in enumerate(applied[np.argsort(values[applied])]):
        if values[index] > level / (applied.size - rank):
            break
        rejected[index] = True
    return tuple(bool(value) for value in rejected)


def benjamini_yekutieli(p_values: FloatArray, rate: float) -> BoolArray:
    """Return which hypotheses are discoveries at a false discovery rate, under any dependence.

    Benjamini and Yekutieli 2001, Annals of Statistics 29, 1165-1188, theorem 1.3.
    """
    if not p_values.size:
        return np.zeros(0, dtype=bool)
    return np.asarray(stats.false_discovery_control(p_values, method="by") <= rate)
