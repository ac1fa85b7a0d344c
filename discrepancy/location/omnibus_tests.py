"""Few omnibus tests of residuals: size against the noise records, whiteness, spectrum, lines.

Each yields one p-value for the whole set; Holm's rule over them keeps the rate of false alarms.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign import noise_tests
from discrepancy.campaign.records import FloatArray
from discrepancy.errors import said

from .residuals import ResidualSet, quadratic_moments

SERIAL = (noise_tests.ljung_box, noise_tests.cumulative_periodogram)
"""Tests of whiteness."""
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
                found.append(noise_tests.variance_p_value(square, freedom, noise_freedom))
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
                of_places.append(noise_tests.variance_p_value(square, freedom, noise_freedom))
                worst = min(worst, (f"{item.trial.name}, {name}", of_places[-1]), key=lambda pair: pair[1])
    if not of_groups:
        return OmnibusTest("variance", np.nan, np.nan, "")
    p = noise_tests.combine(of_groups)
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
    for item, name, series in residuals.series(white):
        if name in coloured:
            continue
        where = f"{item.trial.name}, {name}"
        found["Ljung-Box"].append((*noise_tests.ljung_box(series), where))
        found["cumulative periodogram"].append((*noise_tests.cumulative_periodogram(series), where))
        share, p, place = noise_tests.fisher_g(series)
        frequency = place / (len(series) * item.trial.interval)
        found["Fisher g"].append((share, p, f"{where}, {frequency:.4g} Hz"))
    tests = []
    for name, rows in found.items():
        if not rows:
            tests.append(OmnibusTest(name, np.nan, np.nan, ""))
            continue
        worst = min(rows, key=lambda row: row[1])
        tests.append(OmnibusTest(name, noise_tests.combine([row[1] for row in rows]), worst[0], worst[2]))
    return tuple(tests)


def coloured_noise(residuals: ResidualSet) -> dict[str, str]:
    """Return channels whose noise record itself is not white, with one sentence each."""
    remarks = {}
    for name, channel in residuals.channels.items():
        samples = None if channel.noise is None else channel.noise.samples
        if samples is None or samples.size < noise_tests.SHORTEST_SERIES or channel.noise is None:
            continue
        series = samples - samples.mean()
        share, line, place = noise_tests.fisher_g(series)
        if line < NOISE_RECORD_LEVEL:
            interval = channel.noise.interval
            at = f" at {place / (series.size * interval):.4g} Hz" if interval else ""
            remarks[name] = said("location.line_in_noise", name=name, at=at, percent=100.0 * share)
        elif min(test(series)[1] for test in SERIAL) < NOISE_RECORD_LEVEL:
            remarks[name] = said("location.coloured_noise", name=name)
    return remarks
