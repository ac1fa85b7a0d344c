"""Where model and data disagree: a global verdict, a map, patterns, and findings in words.

Patterns are singular vectors over the channels: a single channel means a sensor, the shape of a
mode means dynamics or load, all channels alike mean hum or temperature.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from discrepancy.campaign.noise_tests import holm_rejections, variance_p_value
from discrepancy.campaign.records import BoolArray, FloatArray
from discrepancy.errors import FitError
from discrepancy.location.dependence import (
    Dependence,
    excess_over_noise,
    explained_dependences,
    mode_shares,
    predicted_frequencies,
)
from discrepancy.location.map import Cell, residual_map
from discrepancy.location.omnibus_tests import (
    OmnibusTest,
    coloured_noise_remarks,
    noise_groups,
    serial_tests,
    variance_test,
)
from discrepancy.location.patterns import (
    Disagreement,
    TrialsOfKind,
    group_by_kind,
    singular_patterns,
)
from discrepancy.location.residuals import (
    ResidualSet,
    mean_square_ratio,
    without_coloured_records,
)
from reporting.words import comma_list, rows_of_table

GLOBAL_LEVEL = 0.01
"""Rate of false alarms of the global verdict."""

MAP_RATE = 0.05
"""False discovery rate of the map."""

_SMALL_RESIDUALS_P_VALUE = 1e-3
"""p-value below which residuals count as smaller than the noise record allows."""
_LEAST_OUTLIER = 6.0
"""Least size of an outlier, in standard deviations; 2e-9 of Gaussian samples exceed it."""
_MEDIAN_OF_ABSOLUTE_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""
_LEAST_SHARE = 0.05
"""Least fraction of the excess variance for which a dependence is reported."""
_EQUAL_SHARES = 0.02
"""Largest difference of two fractions of the excess variance that count as equal."""


@dataclass(frozen=True)
class Location:
    """Where a fitted hypothesis disagrees with the data.

    Attributes
    ----------
    disagrees : bool
        Global verdict, by Holm's rule at `GLOBAL_LEVEL` over the omnibus tests.
    tests : tuple of OmnibusTest
        The tests of variance, Ljung-Box, cumulative periodogram and Fisher g.
    cells : tuple of Cell
        The map; cells are significant at the false discovery rate `MAP_RATE`.
    disagreements : tuple of Disagreement
        The findings in words, largest first; empty if nothing disagrees.
    remarks : tuple of str
        The limits of these statements: a missing noise record, noise that is not white, residuals
        smaller than the noise, a model so far off that no cell can be judged.
    """

    disagrees: bool
    tests: tuple[OmnibusTest, ...]
    cells: tuple[Cell, ...]
    disagreements: tuple[Disagreement, ...]
    remarks: tuple[str, ...]


def locate(residuals: ResidualSet, *, seed: int = 0) -> Location:
    """Find where model and data disagree in the fitted trials of a set.

    Omnibus tests decide whether they disagree at all. Only then dependences and patterns are
    searched. The map of cells is computed in any case.

    Parameters
    ----------
    residuals : ResidualSet
        Residuals of one hypothesis; held-out trials are left out.
    seed : int
        The seed of the random draw that makes the residuals white; see
        `ResidualSet.whitened_residuals`.

    Returns
    -------
    Location
        Tests, map, findings and remarks; reproducible to the last bit for the same seed.

    Raises
    ------
    FitError
        If no trial was fitted.
    """
    fitted_residuals = residuals.fitted
    if fitted_residuals is None:
        raise FitError(
            "Nothing can be located: every trial is held out, and at least one fitted is needed."
        )
    fitted_residuals = without_coloured_records(fitted_residuals)
    white_residuals = fitted_residuals.whitened_residuals(np.random.default_rng(seed))
    coloured_remarks = coloured_noise_remarks(fitted_residuals)
    tests = (
        variance_test(fitted_residuals),
        *serial_tests(fitted_residuals, white_residuals, tuple(coloured_remarks)),
    )
    rejections = holm_rejections([test.p_value for test in tests], GLOBAL_LEVEL)
    tests = tuple(
        replace(test, rejected=is_rejected)
        for test, is_rejected in zip(tests, rejections, strict=True)
    )
    findings = _disagreements(fitted_residuals, white_residuals) if any(rejections) else []
    cells = residual_map(fitted_residuals, white_residuals, MAP_RATE)
    remarks = [*coloured_remarks.values(), *_noise_remarks(fitted_residuals)]
    has_samples = any(trial.used.any() for trial in fitted_residuals.trials)
    if has_samples and all(cell.axis == "frequency" for cell in cells):
        remarks.append(
            "The errors of the model are so much larger than the noise that no single cell of the "
            "map can be judged."
        )
    return Location(any(rejections), tests, cells, tuple(findings), tuple(remarks))


def _disagreements(
    residuals: ResidualSet, white_residuals: Sequence[FloatArray]
) -> list[Disagreement]:
    """Return the findings in all kinds of trials, sorted by the excess variance that they explain.

    `white_residuals` are those of each trial (N, C). For each kind of trial, the findings are its
    main dependence, if one is significant, and its patterns over the channels.
    """
    findings: list[tuple[float, Disagreement]] = []
    for kind in group_by_kind(residuals, white_residuals):
        # the share of a finding is a fraction of the excess in its own kind of trial
        excess_of_kind = sum(
            max(excess_over_noise([fitted_trial]), 0.0) for fitted_trial in kind.trials
        )
        patterns = singular_patterns(residuals, kind)
        dependence = _main_dependence(kind, patterns)
        findings_of_kind = patterns if dependence is None else [dependence, *patterns]
        for finding in findings_of_kind:
            findings.append((excess_of_kind * finding.share, finding))
    findings.sort(key=lambda pair: -pair[0])
    return [finding for _, finding in findings]


def _noise_remarks(residuals: ResidualSet) -> tuple[str, ...]:
    """Return the remarks on missing noise records, and on residuals smaller than the noise.

    Residuals are smaller if a test of their mean square rejects at `_SMALL_RESIDUALS_P_VALUE`.
    """
    remarks = []
    unrecorded_channels = sorted({*residuals.channel_names} - {*residuals.recorded_channels})
    if unrecorded_channels:
        remarks.append(
            f"No noise record for {', '.join(unrecorded_channels)}: nothing absolute can be said "
            "about the size of these residuals; give pre-trigger samples, repeats or a standard "
            "deviation with its degrees of freedom."
        )
    for names in noise_groups(residuals).values():
        mean_square, freedom = mean_square_ratio(residuals, names)
        if freedom < 1.0:
            continue
        noise_freedom = residuals.degrees_of_freedom(names[0])
        p_value = variance_p_value(mean_square, freedom, noise_freedom, small=True)
        if p_value < _SMALL_RESIDUALS_P_VALUE:
            first_names = f"{', '.join(names[:4])}{' ..' if len(names) > 4 else ''}"
            remarks.append(
                f"Residuals of {first_names} are smaller than their noise record allows (mean "
                f"square {mean_square:.2g} of its expectation, p = {p_value:.1g}): the stated "
                "noise is too large, or not that of these channels."
            )
    return tuple(remarks)


def outlier_remarks(residuals: ResidualSet) -> tuple[str, ...]:
    """Return the remark on isolated outliers among the residuals, which may be errors of the data.

    An outlier exceeds six standard deviations of the noise and of the residuals themselves, because
    the residuals of a wrong model are large at many samples. An outlier is isolated if both
    neighbours are less than half as large. Samples next to a gap are not judged.

    Returns
    -------
    tuple of str
        The remark, or nothing if there is no outlier.
    """
    phrases = []
    for fitted_trial in residuals.trials:
        if not fitted_trial.trial.is_dynamic:
            continue
        for column, name in enumerate(fitted_trial.trial.channels):
            is_outlier = _isolated_outliers(np.abs(fitted_trial.standardised[:, column]))
            rows = np.flatnonzero(is_outlier).tolist()
            if rows:
                phrases.append(
                    f"{rows_of_table(rows)} of {name!r} in the trial {fitted_trial.trial.name!r}"
                )
    if not phrases:
        return ()
    return (
        f"Single samples lie beyond {_LEAST_OUTLIER:g} standard deviations of both the noise and "
        f"the other residuals, but their neighbours do not: {comma_list(phrases)}; if they are "
        "errors of the data, leave them out by `left_out` of the trial.",
    )


def _isolated_outliers(absolute_residuals: FloatArray) -> BoolArray:
    """Return which samples (N,) of a record are isolated outliers.

    `absolute_residuals` (N,) are in units of the noise, and nan in gaps. The rules are those of
    `outlier_remarks`.
    """
    finite = absolute_residuals[np.isfinite(absolute_residuals)]
    if not finite.size:
        return np.zeros(len(absolute_residuals), dtype=bool)
    # the standard deviation of the residuals, estimated by their median
    limit = _LEAST_OUTLIER * max(1.0, float(np.median(finite)) / _MEDIAN_OF_ABSOLUTE_NORMAL)
    neighbours = np.full((2, len(absolute_residuals)), np.nan)  # the previous and the next sample
    neighbours[0, 1:] = absolute_residuals[:-1]
    neighbours[1, :-1] = absolute_residuals[1:]
    # next to a gap a neighbour is nan, and the comparison with it is false
    is_isolated: BoolArray = neighbours.max(axis=0) < 0.5 * absolute_residuals
    return is_isolated & (absolute_residuals > limit)


def _main_dependence(kind: TrialsOfKind, patterns: Sequence[Disagreement]) -> Disagreement | None:
    """Return the finding on the dependence that best explains the residuals of a kind of trial.

    A dependence is significant if it explains at least `_LEAST_SHARE` of the excess variance with a
    p-value below 1e-3. Of several that explain nearly the same fraction, the one with the fewest
    coefficients is taken. The result is None if none is significant. The patterns of these trials
    over the channels may show that the finding concerns a single channel.
    """
    candidates = list(explained_dependences(kind.trials))
    significant = [
        candidate
        for candidate in candidates
        if candidate.share >= _LEAST_SHARE and candidate.p_value < 1e-3
    ]
    if not significant:
        return None
    largest_share = max(candidate.share for candidate in significant)
    nearly_as_good = [
        candidate for candidate in significant if candidate.share >= largest_share - _EQUAL_SHARES
    ]
    simplest = min(
        nearly_as_good, key=lambda candidate: (candidate.coefficient_count, -candidate.share)
    )
    subject = simplest.subject or _disagreeing_subject(kind, patterns)
    phrase = f"by {simplest.name}"
    if _amplitude_and_time_look_alike(simplest, candidates):
        phrase = "by amplitude or time (these releases do not tell the two apart)"
    if simplest.name.startswith("a "):  # a line or a drift
        phrase = simplest.name
        # a line with its own frequency, or a drift, is not a mode of the model
        if subject.startswith("mode"):
            subject = "all channels"
    capitalised = f"{subject[0].upper()}{subject[1:]}"
    return kind.disagreement(
        subject, simplest.name, f"{capitalised}, {phrase},", simplest.share, simplest.p_value
    )


def _amplitude_and_time_look_alike(
    dependence: Dependence, candidates: Sequence[Dependence]
) -> bool:
    """Return whether amplitude and time explain about as much of the same subject's residuals.

    `dependence` is the one of the two that was chosen. For any other the answer is no.
    """
    other_name = {"amplitude": "time", "time": "amplitude"}.get(dependence.name)
    return any(
        candidate.subject == dependence.subject
        and candidate.name == other_name
        and candidate.share >= dependence.share - _EQUAL_SHARES
        for candidate in candidates
    )


def _disagreeing_subject(kind: TrialsOfKind, patterns: Sequence[Disagreement]) -> str:
    """Return the subject of a disagreement: a channel, the mode with most excess, or all channels.

    A channel is named if it is the only one, or if its pattern over the channels explains more than
    half of the excess variance. Otherwise a mode is named if its band of frequencies has more than
    half of it.
    """
    channels = kind.trials[0].trial.channels
    for pattern in patterns:
        if pattern.subject == "sensor" and pattern.share > 0.5:
            return f"channel {pattern.channel}"
    if len(channels) == 1:
        return f"channel {channels[0]}"
    if not kind.trials[0].trial.is_dynamic:
        return "all channels"
    frequencies = predicted_frequencies(kind.trials)
    if not frequencies:
        return "all channels"
    shares = mode_shares(kind.trials, kind.white, frequencies)
    return f"mode {int(np.argmax(shares)) + 1}" if shares.max() > 0.5 else "all channels"
