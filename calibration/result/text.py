"""The figures of a calibration in words, for console and page."""

from math import isfinite

import numpy as np

from calibration.result.record import Calibration
from reporting.page import Words
from reporting.words import between, plus_minus

WORDS = Words("calibration.result")
NOTICEABLE_CORRELATION = 0.3
"""From which a correlation is told, and printed in colour."""

PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
    "joint": "of all experiments together, by importance sampling",
    "paper": "by the paper's procedure, step after step",
}

Rows = list[tuple[str, ...]]


def parameter_rows(result: Calibration) -> Rows:
    """Return a row for each parameter."""
    rows: Rows = []
    for prior in result.priors:
        deviation, kept = result.standard_deviation(prior.name), 100.0 * result.kept_share(prior.name)
        rows.append(
            (
                prior.name, prior.figure.shown_unit,
                plus_minus(*result.prior_moments(prior.name)), plus_minus(result.mean(prior.name), deviation),
                between(*result.interval(prior.name), deviation), f"{kept:.{0 if kept > 9.5 else 1}f} %",
            )
        )  # fmt: skip
    return rows


def reading_rows(result: Calibration) -> Rows:
    """Return a row for each reading."""
    units = {figure.name: figure.shown_unit for figure in result.figures}
    return [
        (
            item.experiment, item.name, units[item.name], plus_minus(item.value, item.deviation),
            plus_minus(*result.prior_moments(item.name)),
            plus_minus(result.mean(item.name), result.standard_deviation(item.name)),
            f"{result.score(item):+.1f}",
        )
        for item in result.readings
    ]  # fmt: skip


def channel_rows(result: Calibration) -> Rows:
    """Return a row for each channel."""
    return [
        (
            item.name, item.trials, str(item.readings),
            *(f"{size:.2f}" if isfinite(size) else "noise unknown" for size in (item.before, item.after)),
        )
        for item in result.channels
    ]  # fmt: skip


def correlation_lines(result: Calibration) -> list[str]:
    """Return the correlations that are worth a word, the largest first."""
    names = [prior.name for prior in result.priors]
    matrix = result.correlation
    pairs = [
        (abs(matrix[i, j]), f"Correlation of {names[i]} and {names[j]}: {matrix[i, j]:+.2f}")
        for i, j in zip(*np.triu_indices(len(names), 1), strict=True)
        if abs(matrix[i, j]) >= NOTICEABLE_CORRELATION
    ]
    return [text for _, text in sorted(pairs, key=lambda pair: -pair[0])]


def headline(result: Calibration) -> str:
    """Return what was calibrated, and how."""
    return WORDS.say("headline", result=result, procedure=PROCEDURES[result.procedure])
