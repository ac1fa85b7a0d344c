"""The figures of a calibration in words, for console and page."""

from math import isfinite

import numpy as np

from calibration.result.record import Calibration
from reporting.page import Words

WORDS = Words("calibration.result", isfinite=isfinite)
NOTICEABLE_CORRELATION = 0.3
"""From which a correlation is told, and printed in colour."""

PROCEDURES = {
    "quadrature": "by quadrature",
    "Gaussian": "a Gaussian, checked along its axes",
    "several optima": "several optima, each a Gaussian",
    "joint": "of all experiments together, by importance sampling",
    "paper": "by the paper's procedure, step after step",
}


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
