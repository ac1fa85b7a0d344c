"""How well one stiffness explains the measured pairs, run by run."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors_in_variables import residual_variance
from .experiments import LoadDisplacementData

NOTICEABLE_SCORE = 2.0
"""Standard deviations from which a difference between runs, or a pair, is pointed out."""


class FitQuality(NamedTuple):
    """Residuals of the measured pairs at one stiffness.

    Attributes
    ----------
    standardised_residual : (N,) array
        (k x - f) / sqrt(R_f + k^2 R_x) [1]; positive where the wing bends more than the model.
    remarks : tuple of str
        Sentences on what disagrees; empty if nothing does.
    """

    standardised_residual: NDArray[np.float64]
    remarks: tuple[str, ...]


def assess_fit(data: LoadDisplacementData, stiffness: float) -> FitQuality:
    """Judge the measured pairs, run by run, at one stiffness [N/m]."""
    scatter = math.sqrt(float(residual_variance(data, stiffness)))
    residual = data.displacement - data.load / stiffness
    standardised = residual * stiffness / scatter
    runs = []
    for index in data.run_indices:
        of_run = residual[data.run == index]
        runs.append((index + 1, float(of_run.mean()), scatter / stiffness / math.sqrt(of_run.size)))
    remarks = []
    for (first, offset, error), (second, other, other_error) in pairwise(runs):
        difference, deviation = abs(offset - other), math.hypot(error, other_error)
        if difference > NOTICEABLE_SCORE * deviation:
            remarks.append(
                f"Loading runs {first} and {second} differ by {difference * 1e3:.2f} mm "
                f"({difference / deviation:.1f} standard deviations): their offsets are "
                f"{_signed(offset * 1e3)} mm and {_signed(other * 1e3)} mm, as if the zero of "
                "the displacement had moved between them."
            )
    remarks.extend(
        f"Pair {pair + 1} ({data.load[pair]:.3g} N, {data.displacement[pair] * 1e3:.3g} mm) lies "
        f"{abs(standardised[pair]):.1f} standard deviations from the calibrated line."
        for pair in np.flatnonzero(np.abs(standardised) > NOTICEABLE_SCORE)
    )
    return FitQuality(standardised, tuple(remarks))


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")
