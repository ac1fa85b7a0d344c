"""The figures of a calibration in words, for console and page."""

from math import isfinite

import numpy as np

from calibration.result.record import Calibration
from reporting.page import Words

WORDS = Words("calibration.result", isfinite=isfinite)
NOTICEABLE_CORRELATION = 0.3
"""Correlation from which it is reported, and printed in colour."""

PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
    "joint": "of all experiments together, by importance sampling",
    "paper": "by the paper's procedure, step after step",
}


def correlation_lines(result: Calibration) -> list[str]:
    """Return a text for each noticeable correlation of two parameters, the largest first."""
    names = [prior.name for prior in result.priors]
    matrix = result.correlation
    rows, columns = np.triu_indices(len(names), 1)
    by_size = np.argsort(-np.abs(matrix[rows, columns]), kind="stable")
    lines = []
    for i, j in zip(rows[by_size], columns[by_size], strict=True):
        if abs(matrix[i, j]) >= NOTICEABLE_CORRELATION:
            lines.append(f"Correlation of {names[i]} and {names[j]}: {matrix[i, j]:+.2f}")
    return lines


def headline(result: Calibration) -> str:
    """Return the sentence on the calibrated asset and the procedure."""
    return WORDS.say("headline", result=result, procedure=PROCEDURES[result.procedure])
