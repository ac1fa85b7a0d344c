"""A calibration in words, for console and page."""

from collections.abc import Iterator

import numpy as np

from calibration.result import tables
from calibration.result.record import Calibration
from reporting.pages.table import Table
from reporting.words import counted

NOTICEABLE_CORRELATION = 0.3
"""Correlation from which it is reported, and printed in colour."""


def correlation_lines(result: Calibration) -> list[str]:
    """Return a text for each noticeable correlation of two parameters, the largest first."""
    names = [prior.name for prior in result.priors]
    matrix = result.correlation
    rows, columns = np.triu_indices(len(names), 1)
    largest_first = np.argsort(-np.abs(matrix[rows, columns]), kind="stable")
    lines = []
    for i, j in zip(rows[largest_first], columns[largest_first], strict=True):
        if abs(matrix[i, j]) >= NOTICEABLE_CORRELATION:
            lines.append(f"Correlation of {names[i]} and {names[j]}: {matrix[i, j]:+.2f}")
    return lines


def headline(result: Calibration) -> str:
    """Return the sentence on the calibrated asset and the procedure."""
    asset = "" if result.asset == result.source else f"{result.asset}: "
    campaign = f", campaign {result.source}" if result.design is None else ""
    information = ""
    if result.information is not None:
        information = f", {result.information:.1f} nat gained"
    return (
        f"{asset}{result.model}{campaign}; posterior {tables.PROCEDURES[result.procedure]}, "
        f"{len(result.samples)} samples{information}"
    )


def outcome_sentences(result: Calibration) -> str:
    """Return how far the data narrow the parameters, and whether data, priors and model agree."""
    ratios = sorted(100 * result.posterior_over_prior(prior.name) for prior in result.priors)
    narrowed = (
        f"The data narrow the parameter to {ratios[0]:.0f} % of its prior standard deviation."
    )
    if len(ratios) > 1:
        narrowed = (
            f"The data narrow {len(ratios)} parameters to between {ratios[0]:.0f} and "
            f"{ratios[-1]:.0f} % of their prior standard deviations."
        )
    agreement = "The residuals agree with noise and priors."
    if result.findings:
        say = "says" if len(result.findings) == 1 else "say"
        agreement = (
            f"{counted(len(result.findings), 'finding')} below {say} where data and model disagree."
        )
    return f"{narrowed} {agreement}"


def printed_calibration(result: Calibration) -> Iterator[str | Table]:
    """Yield the printed lines and tables of a calibration: first the outcome, then the tables."""
    yield headline(result)
    for finding in result.findings:
        yield f"- {finding}"
    yield tables.parameters_table(result)
    yield from correlation_lines(result)
    yield tables.readings_table(result)
    yield tables.channels_table(result)
    yield tables.printed_sensors_table(result)
