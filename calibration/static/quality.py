"""How well one stiffness explains the measured pairs, run by run."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .errors_in_variables import residual_variance
from .experiments import LoadDisplacementData

NOTICEABLE_SCORE = 2.0
"""Standard deviations from which a difference between runs, or a pair, is pointed out."""


@dataclass(frozen=True)
class RunFit:
    """One loading run against the calibrated stiffness.

    Attributes
    ----------
    run : int
        Index of the run.
    count : int
        Number of its pairs.
    offset, offset_standard_deviation : float
        Mean of x - f / k over the run at the calibrated stiffness k, and its standard deviation [m].
    """

    run: int
    count: int
    offset: float
    offset_standard_deviation: float


@dataclass(frozen=True, eq=False)
class FitQuality:
    """Residuals of the measured pairs at one stiffness.

    Attributes
    ----------
    stiffness : float
        The stiffness judged: k at the exact posterior's mean of e [N/m].
    displacement_residual : (N,) array
        x - f / k [m].
    standardised_residual : (N,) array
        (k x - f) / sqrt(R_f + k^2 R_x) [1]; positive where the wing bends more than the model.
    runs : tuple of RunFit
        The loading runs.
    remarks : tuple of str
        Sentences on what disagrees; empty if nothing does.
    """

    stiffness: float
    displacement_residual: NDArray[np.float64]
    standardised_residual: NDArray[np.float64]
    runs: tuple[RunFit, ...]
    remarks: tuple[str, ...]


def assess_fit(data: LoadDisplacementData, stiffness: float) -> FitQuality:
    """Judge the measured pairs at one stiffness [N/m].

    Parameters
    ----------
    data : LoadDisplacementData
        The measured pairs.
    stiffness : float
        The calibrated tip stiffness [N/m].
    """
    scatter = math.sqrt(float(residual_variance(data, stiffness)))
    residual = data.displacement - data.load / stiffness
    standardised = residual * stiffness / scatter
    runs = []
    for index in data.run_indices:
        of_run = residual[data.run == index]
        error = scatter / stiffness / math.sqrt(of_run.size)
        runs.append(RunFit(index, of_run.size, float(of_run.mean()), error))
    remarks = tuple(_remarks(data, standardised, runs))
    return FitQuality(stiffness, residual, standardised, tuple(runs), remarks)


def _remarks(
    data: LoadDisplacementData, standardised: NDArray[np.float64], runs: Sequence[RunFit]
) -> list[str]:
    remarks = []
    for first, second in pairwise(runs):
        difference = first.offset - second.offset
        deviation = math.hypot(first.offset_standard_deviation, second.offset_standard_deviation)
        if abs(difference) > NOTICEABLE_SCORE * deviation:
            remarks.append(
                f"Loading runs {first.run + 1} and {second.run + 1} differ by {abs(difference) * 1e3:.2f} mm "
                f"({abs(difference) / deviation:.1f} standard deviations): their offsets are "
                f"{_signed(first.offset * 1e3)} mm and {_signed(second.offset * 1e3)} mm, as if the zero of "
                "the displacement had moved between them."
            )
    large = np.flatnonzero(np.abs(standardised) > NOTICEABLE_SCORE)
    remarks.extend(
        f"Pair {pair + 1} ({data.load[pair]:.3g} N, {data.displacement[pair] * 1e3:.3g} mm) lies "
        f"{abs(standardised[pair]):.1f} standard deviations from the calibrated line."
        for pair in large
    )
    return remarks


def _signed(value: float) -> str:
    return f"{value:+.2f}".replace("-", "−")
