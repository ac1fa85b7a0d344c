"""A calibration in words, for console and page."""

from collections.abc import Iterator

import numpy as np

from calibration.result import tables
from calibration.result.record import Calibration
from reporting.page import Table

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


def printed_calibration(result: Calibration) -> Iterator[str | Table]:
    """Yield the printed lines and tables of a calibration."""
    yield headline(result)
    yield tables.parameters_table(result).table
    yield from correlation_lines(result)
    for titled in (
        tables.readings_table(result),
        tables.channels_table(result),
        tables.printed_sensors_table(result),
    ):
        if titled.table.rows:
            yield titled.table
    for finding in result.findings:
        yield f"- {finding}"
