"""What of the measurements the calibrated wing does not meet, and by how much."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibration.dynamics.trials import PUBLISHED_DAMPING_RATIOS, AmplitudePoint, amplitude_dependence
from calibration.static.experiments import published_measurements

from .steps import Update
from .table_1 import SHOWN, printed
from .three_steps import WingCalibration

NOTICEABLE = 2.0
"""Standard deviations from which a difference is pointed out."""

NOTICEABLE_FREQUENCY = 0.02
"""Relative difference from which that of a frequency is pointed out, whatever its standard deviation."""

AUTHORS_SECOND_FREQUENCY = 28.613
"""Mean of the authors' model's second flapwise frequency after their calibration [Hz] (step 3)."""


class Miss(NamedTuple):
    """A measured quantity of interest beside the calibrated model.

    Attributes
    ----------
    name : str
        Quantity of interest.
    measured, model : (float, float)
        Mean and standard deviation, SI.
    relative : float
        Model over measured, less one [1].
    score : float
        Difference over the standard deviations of both, added in quadrature [1].
    """

    name: str
    measured: tuple[float, float]
    model: tuple[float, float]
    relative: float
    score: float

    @property
    def noticeable(self) -> bool:
        """Whether the difference is more than chance, or that of a frequency more than two percent."""
        far = self.name.startswith("frequency") and abs(self.relative) > NOTICEABLE_FREQUENCY
        return abs(self.score) > NOTICEABLE or far


def misses(calibration: WingCalibration) -> tuple[Miss, ...]:
    """Return every measured quantity of interest beside the calibrated model."""
    result = calibration.result
    return tuple(
        _miss(update)
        for step in (result.step(2), result.step(3))
        for update in step.quantities
        if update.measured is not None
    )


def _miss(update: Update) -> Miss:
    measured, spread = update.measured or 0.0, update.measured_standard_deviation or 0.0
    difference = update.posterior_mean - measured
    return Miss(
        update.name,
        (measured, spread),
        (update.posterior_mean, update.posterior_standard_deviation),
        difference / measured,
        difference / math.hypot(spread, update.posterior_standard_deviation),
    )


def disagreements(calibration: WingCalibration) -> list[str]:
    """Return sentences on what disagrees with the data; empty where nothing does."""
    found = []
    for miss in misses(calibration):
        if miss.noticeable:
            shown = SHOWN[miss.name]
            authors = ""
            if miss.name == "frequency_2" and _is_the_papers_wing(calibration):
                authors = (
                    f" The authors' own model, too, has {AUTHORS_SECOND_FREQUENCY:.2f} Hz after its "
                    "calibration, 4.5 % below what they measured."
                )
            found.append(
                f"{shown.title}: measured {printed(miss.name, *miss.measured)} "
                f"{shown.unit}, calibrated model {printed(miss.name, *miss.model)} {shown.unit}, "
                f"{_percent(miss.relative)} off ({abs(miss.score):.1f} standard deviations).{authors}"
            )
    found += calibration.static.quality.remarks
    found += _of_the_ring_down(calibration)
    return found


def _of_the_ring_down(calibration: WingCalibration) -> list[str]:
    trials = calibration.lab.trials
    if trials is None:
        return []
    found = []
    second = trials.damping_ratio(1).mean
    published = PUBLISHED_DAMPING_RATIOS[1]
    if _is_the_papers_wing(calibration) and abs(second / published - 1.0) > 0.1:
        found.append(
            f"The damping ratio of the second mode is {100 * second:.2f} % in these records and "
            f"{100 * published:.2f} % in the paper ({_percent(second / published - 1.0)}); it depends on "
            "where a record begins, see the documentation."
        )
    points = sorted(
        (point for fit in trials.fits for point in amplitude_dependence(fit)),
        key=lambda point: point.amplitude,
    )
    if len(points) >= 6:
        third = len(points) // 3
        small, large = points[:third], points[-third:]
        low, high = (float(np.mean([point.frequency for point in part])) for part in (large, small))
        if abs(high / low - 1.0) > 0.003:
            damping = [
                100 * float(np.mean([point.damping_ratio for point in part])) for part in (large, small)
            ]
            found.append(
                f"The wing is not linear: in windows of 0.8 s the first mode has {low:.3f} Hz and "
                f"{damping[0]:.1f} % damping at {1e3 * _amplitude(large):.2g} mV, and {high:.3f} Hz and "
                f"{damping[1]:.1f} % at {1e3 * _amplitude(small):.2g} mV. The linear model has one frequency."
            )
    return found


def _is_the_papers_wing(calibration: WingCalibration) -> bool:
    return calibration.lab.pairs.sha256 == published_measurements().sha256


def _amplitude(points: Sequence[AmplitudePoint]) -> float:
    return float(np.mean([point.amplitude for point in points]))


def _percent(value: float) -> str:
    return f"{100.0 * value:+.1f} %".replace("-", "−")
