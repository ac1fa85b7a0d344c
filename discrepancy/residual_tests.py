"""Few omnibus tests of residuals: size against the noise records, whiteness, spectrum, lines.

Each yields one p-value for the whole set; Holm's rule over them keeps the rate of false alarms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.special import chdtrc, fdtrc

from discrepancy.residuals import ResidualSet, quadratic_moments

FloatArray = NDArray[np.float64]

SHORTEST_SERIES = 32
"""Fewest samples of a series whose whiteness is tested."""

NOISE_RECORD_LEVEL = 1e-3
"""p-value below which a noise record itself counts as not white, or as holding a line."""


@dataclass(frozen=True)
class OmnibusTest:
    """One test of the whole set.

    Attributes
    ----------
    name : str
        "variance", "Ljung-Box", "cumulative periodogram" or "Fisher g".
    p_value : float
        Over all trials and channels; nan if it could not be applied.
    statistic : float
        Variance: mean square over its expectation; else the statistic of the place with the least p-value.
    where : str
        That place.
    rejected : bool
        By Holm's rule over all tests.
    """

    name: str
    p_value: float
    statistic: float
    where: str
    rejected: bool = False


def ljung_box(series: FloatArray, lags: int | None = None) -> tuple[float, float]:
    """Return Q and its p-value for a series that is white with mean zero under the null.

    Ljung and Box 1978, Biometrika 65, eq. (1.3): Q = n (n + 2) sum_k rho_k^2 / (n - k) over `lags` lags
    (default min(20, n / 5)). Beyond its 99 % point chi^2 is exceeded up to four times too often at n = 64:
    the p-value is that of a gamma distribution with the mean, variance and skewness of Q at this n.
    """
    count = series.size
    lags = min(20, count // 5) if lags is None else lags
    if not np.any(series):
        return 0.0, 1.0
    statistic = float(_portmanteau(series[np.newaxis], lags)[0])
    mean, deviation, skewness = _portmanteau_moments(count, lags)
    return statistic, float(stats.pearson3.sf((statistic - mean) / deviation, skewness))


def _portmanteau(series: FloatArray, lags: int) -> FloatArray:
    """Return Q of each row."""
    count = series.shape[1]
    spectrum = np.abs(np.fft.rfft(series, 2 * count, axis=1)) ** 2
    covariance = np.fft.irfft(spectrum, axis=1)[:, : lags + 1]
    rho = covariance[:, 1:] / covariance[:, :1]
    return np.asarray(count * (count + 2) * np.sum(rho**2 / (count - np.arange(1, lags + 1)), axis=1))


@cache
def _portmanteau_moments(count: int, lags: int) -> tuple[float, float, float]:
    """Return mean, standard deviation and skewness of Q under white noise, from draws with a fixed seed."""
    generator = np.random.default_rng(20260101)
    draws = max(20, 400_000 // count)
    values = np.concatenate(
        [_portmanteau(generator.standard_normal((draws, count)), lags) for _ in range(-(-8_000 // draws))]
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


def variance_p_value(mean_square: float, freedom: float, noise_freedom: float) -> float:
    """Return P(mean square this large) against a noise record: F, or chi^2 if the noise is exact."""
    if np.isinf(noise_freedom):
        return float(chdtrc(freedom, mean_square * freedom))
    return float(fdtrc(freedom, noise_freedom, mean_square))


def noise_groups(residuals: ResidualSet) -> dict[str, tuple[str, ...]]:
    """Return channels by noise record: those whose stated records are equal share one.

    Channels without a noise record are left out.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in dict.fromkeys(n for item in residuals.trials for n in item.trial.channels):
        channel = residuals.channels[name]
        noise = channel.noise
        if noise is None or noise.degrees_of_freedom <= 0.0:
            continue
        own = () if noise.source == "stated" else (name,)
        key = (channel.quantity, noise.standard_deviation, noise.degrees_of_freedom, *own)
        groups.setdefault(key, []).append(name)
    return {names[0]: tuple(names) for names in groups.values()}


def mean_square(residuals: ResidualSet, channels: Sequence[str]) -> tuple[float, float]:
    """Return the sum of squares of channels over its expectation, and its effective degrees of freedom.

    The trials of the set are all fitted, or all held out.
    """
    total, parts, held_out = 0.0, [], residuals.trials[0].trial.held_out
    for item in residuals.trials:
        for name in channels:
            if name not in item.trial.channels:
                continue
            column = item.column(name)
            used = item.used[:, column]
            total += float(np.sum(item.standardised[used, column] ** 2))
            sensitive = None if item.sensitivity is None else item.sensitivity[used, column]
            parts.append((item.expected_variance[used, column], sensitive))
    mean, freedom = quadratic_moments(parts, held_out=held_out)
    return (total / mean if mean > 0.0 else np.nan), freedom


def variance_test(residuals: ResidualSet) -> OmnibusTest:
    """Return the test of the mean squares against the noise records; nan without any record.

    Each noise record gives one p-value, Bonferroni's over all its trials and each kind of trial (few static
    readings would drown in thousands of samples of ring-downs); these are combined. Each channel in each
    trial gives one more, for a gap in one place only.
    """
    parts = [residuals, *_by_kind(residuals)]
    of_groups, of_places, worst = [], [], ("", 2.0)
    total, weight = 0.0, 0.0
    for names in noise_groups(residuals).values():
        noise_freedom = residuals.degrees_of_freedom(names[0])
        found = []
        for part in parts:
            square, freedom = mean_square(part, names)
            if freedom >= 0.5:
                found.append(variance_p_value(square, freedom, noise_freedom))
                if part is residuals:
                    total, weight = total + square * freedom, weight + freedom
        if found:
            of_groups.append(min(1.0, len(found) * min(found)))
        for item in residuals.trials:
            single = replace(residuals, trials=(item,))
            for name in names:
                square, freedom = mean_square(single, (name,))
                if freedom < 0.5:
                    continue
                of_places.append(variance_p_value(square, freedom, noise_freedom))
                worst = min(worst, (f"{item.trial.name}, {name}", of_places[-1]), key=lambda pair: pair[1])
    if not of_groups:
        return OmnibusTest("variance", np.nan, np.nan, "")
    p = combine(of_groups)
    if len(of_places) > 1:
        p = min(1.0, 2.0 * min(p, len(of_places) * min(of_places)))
    # Far from the truth the fit may leave no degree of freedom to the whole, but some to a trial.
    return OmnibusTest("variance", p, total / weight if weight > 0.0 else np.nan, worst[0])


def _by_kind(residuals: ResidualSet) -> tuple[ResidualSet, ...]:
    """Return the set split by the kind of its trials; nothing if there is one kind only."""
    kinds = list(dict.fromkeys(item.trial.kind for item in residuals.trials))
    if len(kinds) < 2:
        return ()
    return tuple(
        replace(residuals, trials=tuple(i for i in residuals.trials if i.trial.kind is kind))
        for kind in kinds
    )


def serial_tests(
    residuals: ResidualSet, white: Sequence[FloatArray], coloured: Sequence[str] = ()
) -> tuple[OmnibusTest, ...]:
    """Return Ljung-Box, cumulative periodogram and Fisher g over all series of dynamic trials.

    Parameters
    ----------
    residuals : ResidualSet
        The set.
    white : sequence of (N, C) ndarray
        What its `white` returned.
    coloured : sequence of str
        Channels whose noise record itself is not white: they are left out.
    """
    found: dict[str, list[tuple[float, float, str]]] = {
        "Ljung-Box": [], "cumulative periodogram": [], "Fisher g": [],
    }  # fmt: skip
    for item, values in zip(residuals.trials, white, strict=True):
        if not item.trial.is_dynamic or len(values) < SHORTEST_SERIES:
            continue
        for column, name in enumerate(item.trial.channels):
            if name in coloured or not item.used[:, column].any():
                continue
            series, where = values[:, column], f"{item.trial.name}, {name}"
            found["Ljung-Box"].append((*ljung_box(series), where))
            found["cumulative periodogram"].append((*cumulative_periodogram(series), where))
            share, p, place = fisher_g(series)
            frequency = place / (len(series) * item.trial.interval)
            found["Fisher g"].append((share, p, f"{where}, {frequency:.4g} Hz"))
    tests = []
    for name, rows in found.items():
        if not rows:
            tests.append(OmnibusTest(name, np.nan, np.nan, ""))
            continue
        worst = min(rows, key=lambda row: row[1])
        tests.append(OmnibusTest(name, combine([row[1] for row in rows]), worst[0], worst[2]))
    return tuple(tests)


def coloured_noise(residuals: ResidualSet) -> dict[str, str]:
    """Return channels whose noise record itself is not white, with one sentence each."""
    remarks = {}
    for name, channel in residuals.channels.items():
        samples = None if channel.noise is None else channel.noise.samples
        if samples is None or samples.size < SHORTEST_SERIES or channel.noise is None:
            continue
        series = samples - samples.mean()
        share, line, place = fisher_g(series)
        if line < NOISE_RECORD_LEVEL:
            interval = channel.noise.interval
            at = f" at {place / (series.size * interval):.4g} Hz" if interval else ""
            remarks[name] = (
                f"The noise record of {name} holds a line{at} ({100.0 * share:.0f} % of its variance): "
                "the line is in the acquisition, and whiteness is not tested on this channel."
            )
        elif min(ljung_box(series)[1], cumulative_periodogram(series)[1]) < NOISE_RECORD_LEVEL:
            remarks[name] = (
                f"The noise record of {name} is not white: whiteness is not tested on this channel, and its "
                "degrees of freedom are fewer than its samples."
            )
    return remarks


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


def benjamini_yekutieli(p_values: FloatArray, rate: float) -> NDArray[np.bool_]:
    """Return which hypotheses are discoveries at a false discovery rate, under any dependence.

    Benjamini and Yekutieli 2001, Annals of Statistics 29, 1165-1188, theorem 1.3.
    """
    count = p_values.size
    found = np.zeros(count, dtype=bool)
    if count == 0:
        return found
    order = np.argsort(p_values)
    harmonic = float(np.sum(1.0 / np.arange(1, count + 1)))
    below = np.flatnonzero(p_values[order] <= rate * np.arange(1, count + 1) / (count * harmonic))
    if below.size:
        found[order[: below[-1] + 1]] = True
    return found
