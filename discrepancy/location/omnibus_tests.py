"""Omnibus tests of all residuals of a fit: their variance, whiteness and lines."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.noise import (
    NOISE_RECORD_LEVEL,
    find_line,
    record_at_rest,
    whiteness_is_tested,
)
from discrepancy.campaign.records import FloatArray
from discrepancy.location.residuals import ResidualSet, mean_square_ratio

LEAST_FREEDOM = 0.5
"""Fewest degrees of freedom of residuals whose variance is tested."""


@dataclass(frozen=True)
class OmnibusTest:
    """One test of the whole set.

    Attributes
    ----------
    name : str
        "variance", "Ljung-Box", "cumulative periodogram" or "Fisher g".
    p_value : float
        p-value over all trials and channels; nan if it could not be applied.
    statistic : float
        Variance: mean square over its expectation; else the statistic of the record with the least
        p-value.
    where : str
        The trial and channel of that record.
    rejected : bool
        True if Holm's rule over all tests rejects it.
    """

    name: str
    p_value: float
    statistic: float
    where: str
    rejected: bool = False


def noise_groups(residuals: ResidualSet) -> dict[str, tuple[str, ...]]:
    """Group the channels that share one noise record.

    Channels of one quantity with equal stated noise share one record, so that their variance tests
    are not independent. A recorded noise belongs to its own channel. Channels without a noise
    record are left out.

    Returns
    -------
    dict of str to tuple of str
        The names of the channels of each group, by the first of them.
    """
    groups: dict[tuple[object, ...], list[str]] = {}
    for name in residuals.recorded_channels:
        channel = residuals.channels[name]
        noise = channel.noise
        assert noise is not None
        owner = "" if noise.source == "stated" else name
        key = (channel.quantity, noise.standard_deviation, noise.degrees_of_freedom, owner)
        groups.setdefault(key, []).append(name)
    return {names[0]: tuple(names) for names in groups.values()}


def variance_test(residuals: ResidualSet) -> OmnibusTest:
    """Test whether the mean squares of the residuals agree with the noise records.

    For each noise record, the mean square is tested over all trials together and over each kind of
    trial, because a few static readings would be lost among thousands of samples of ring-downs. The
    least of these p-values counts, times their number (Bonferroni). The p-values of the noise
    records are combined. A gap in a single record is tested too: the least p-value of a channel in
    a trial, times the number of records. The result is the lesser of the two, times two.

    Returns
    -------
    OmnibusTest
        The test; its statistic is nan if no channel has a noise record.
    """
    subsets = [residuals, *_split_by_kind(residuals)]
    p_values_of_groups: list[float] = []  # of each noise record
    records: list[_RecordVariance] = []  # of each channel in each trial
    weighted_sum = 0.0
    total_freedom = 0.0
    for names in noise_groups(residuals).values():
        noise_freedom = residuals.degrees_of_freedom(names[0])
        p_values = []
        for subset in subsets:
            mean_square, freedom = mean_square_ratio(subset, names)
            if freedom < LEAST_FREEDOM:
                continue
            p_values.append(noise_tests.variance_p_value(mean_square, freedom, noise_freedom))
            if subset is residuals:
                weighted_sum = weighted_sum + mean_square * freedom
                total_freedom = total_freedom + freedom
        if p_values:
            p_values_of_groups.append(min(1.0, len(p_values) * min(p_values)))
        records += _variance_tests_of_records(residuals, names)
    if not p_values_of_groups:
        return OmnibusTest("variance", np.nan, np.nan, "")
    p_value = noise_tests.combine_p_values(p_values_of_groups)
    # without a tested record: a p-value that is never the least
    worst = min(records, key=lambda record: record.p_value, default=_RecordVariance("", 2.0))
    if len(records) > 1:
        p_value = min(1.0, 2.0 * min(p_value, len(records) * worst.p_value))
    # A very wrong model may leave no degree of freedom to all trials together, but some to a single
    # trial.
    statistic = weighted_sum / total_freedom if total_freedom > 0.0 else np.nan
    return OmnibusTest("variance", p_value, statistic, worst.where)


class _RecordVariance(NamedTuple):
    """The variance test of a single record: its trial and channel, and the p-value."""

    where: str
    p_value: float


def _variance_tests_of_records(
    residuals: ResidualSet, channels: Sequence[str]
) -> Iterator[_RecordVariance]:
    """Yield the variance test of each channel in each trial; the channels share a noise record.

    Records whose residuals have fewer than `LEAST_FREEDOM` degrees of freedom are left out.
    """
    noise_freedom = residuals.degrees_of_freedom(channels[0])
    for fitted_trial in residuals.trials:
        single_trial = replace(residuals, trials=(fitted_trial,))
        for name in channels:
            mean_square, freedom = mean_square_ratio(single_trial, (name,))
            if freedom >= LEAST_FREEDOM:
                p_value = noise_tests.variance_p_value(mean_square, freedom, noise_freedom)
                yield _RecordVariance(f"{fitted_trial.trial.name}, {name}", p_value)


def _split_by_kind(residuals: ResidualSet) -> tuple[ResidualSet, ...]:
    """Return the set split by the kind of its trials; nothing if there is only one kind."""
    kinds = list(dict.fromkeys(fitted_trial.trial.kind for fitted_trial in residuals.trials))
    if len(kinds) < 2:
        return ()
    subsets = []
    for kind in kinds:
        trials = tuple(
            fitted_trial for fitted_trial in residuals.trials if fitted_trial.trial.kind is kind
        )
        subsets.append(replace(residuals, trials=trials))
    return tuple(subsets)


def serial_tests(
    residuals: ResidualSet,
    white_residuals: Sequence[FloatArray],
    coloured_channels: Sequence[str] = (),
) -> tuple[OmnibusTest, ...]:
    """Test the residuals of all dynamic trials for correlation in time and for spectral lines.

    The tests are those of Ljung and Box, of the cumulative periodogram, and Fisher's g. Each is
    combined over all records.

    Parameters
    ----------
    residuals : ResidualSet
        The residuals of all trials, with the channels.
    white_residuals : sequence of (N, C) ndarray
        The white residuals of each trial, from its method `whitened_residuals`.
    coloured_channels : sequence of str
        Channels whose noise record is not white itself, and which are therefore left out.
    """
    portmanteau_tests: list[_RecordTest] = []
    periodogram_tests: list[_RecordTest] = []
    line_tests: list[_RecordTest] = []
    for series in residuals.dynamic_series(white_residuals):
        if series.channel in coloured_channels:
            continue
        trial = series.fitted_trial.trial
        record = f"{trial.name}, {series.channel}"
        portmanteau = noise_tests.ljung_box(series.values)
        portmanteau_tests.append(_RecordTest(portmanteau.statistic, portmanteau.p_value, record))
        cumulative = noise_tests.cumulative_periodogram(series.values)
        periodogram_tests.append(_RecordTest(cumulative.statistic, cumulative.p_value, record))
        line = noise_tests.fisher_g(series.values)
        frequency = line.frequency_index / (len(series.values) * trial.interval)
        record_and_line = f"{record}, {frequency:.4g} Hz"
        line_tests.append(_RecordTest(line.statistic, line.p_value, record_and_line))
    return (
        _combine_record_tests("Ljung-Box", portmanteau_tests),
        _combine_record_tests("cumulative periodogram", periodogram_tests),
        _combine_record_tests("Fisher g", line_tests),
    )


class _RecordTest(NamedTuple):
    """A test of one record: statistic, p-value, and its trial and channel in words."""

    statistic: float
    p_value: float
    where: str


def _combine_record_tests(name: str, tests: Sequence[_RecordTest]) -> OmnibusTest:
    """Return the tests of all records combined into one; its p-value is nan if there are none.

    The statistic, and the trial and channel, are those of the record with the least p-value.
    """
    if not tests:
        return OmnibusTest(name, np.nan, np.nan, "")
    worst = min(tests, key=lambda test: test.p_value)
    p_value = noise_tests.combine_p_values([test.p_value for test in tests])
    return OmnibusTest(name, p_value, worst.statistic, worst.where)


def coloured_noise_remarks(residuals: ResidualSet) -> dict[str, str]:
    """Return a remark on each channel whose noise record is not white itself, by its name.

    The remark names the spectral line of the record if there is a significant one.
    """
    remarks = {}
    for name, channel in residuals.channels.items():
        series = record_at_rest(channel)
        if series is None or channel.noise is None or whiteness_is_tested(channel):
            continue
        line = find_line(series)
        if line.p_value < NOISE_RECORD_LEVEL:
            frequency = ""
            if channel.noise.interval:
                hertz = line.frequency_index / (series.size * channel.noise.interval)
                frequency = f" at {hertz:.4g} Hz"
            percent = 100.0 * line.statistic
            remarks[name] = (
                f"The noise record of {name} holds a line{frequency} ({percent:.0f} % of "
                "its variance): the line is in the acquisition, and whiteness is not tested on "
                "this channel."
            )
        else:
            remarks[name] = (
                f"The noise record of {name} is not white: whiteness is not tested on this "
                "channel, and its degrees of freedom are fewer than its samples."
            )
    return remarks
