"""What the ring-down says of the two flapwise modes, with all that makes it uncertain."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..errors import ExperimentDataError
from ..ringdown_trials import PUBLISHED_DAMPING_RATIOS, PUBLISHED_FREQUENCIES, RingDownTrials


@dataclass(frozen=True)
class ModalMeasurement:
    """Measured frequencies and damping ratios of the first two flapwise modes.

    Attributes
    ----------
    frequency : (float, float)
        Natural frequencies [Hz].
    frequency_standard_deviation : (float, float)
        Their standard deviations, statistical and systematic parts together [Hz].
    damping_ratio : (float, float)
        Damping ratios [1].
    damping_ratio_standard_deviation : (float, float)
        Their standard deviations, statistical and systematic parts together [1].
    source : str
        Where the figures come from.

    Raises
    ------
    ExperimentDataError
        If a frequency, a damping ratio or a standard deviation is not positive and finite, or the first
        frequency is not the lower one.
    """

    frequency: tuple[float, float]
    frequency_standard_deviation: tuple[float, float]
    damping_ratio: tuple[float, float]
    damping_ratio_standard_deviation: tuple[float, float]
    source: str

    def __post_init__(self) -> None:
        for name, unit in (
            ("frequency", " Hz"),
            ("frequency_standard_deviation", " Hz"),
            ("damping_ratio", ""),
            ("damping_ratio_standard_deviation", ""),
        ):
            values = getattr(self, name)
            if len(values) != 2 or not all(math.isfinite(value) and value > 0.0 for value in values):
                raise ExperimentDataError(
                    f"{self.source}: {name} must hold two positive finite numbers, one for each flapwise "
                    f"mode, but {', '.join(f'{value:g}{unit}' for value in values)} came."
                )
            object.__setattr__(self, name, tuple(float(value) for value in values))
        if not self.frequency[0] < self.frequency[1]:
            raise ExperimentDataError(
                f"{self.source}: the first flapwise frequency, {self.frequency[0]:.4g} Hz, must lie below "
                f"the second, {self.frequency[1]:.4g} Hz."
            )


def modal_measurement(trials: RingDownTrials) -> ModalMeasurement:
    """Return mean modal data of fitted trials with statistical and systematic uncertainty."""
    raise NotImplementedError


def published_modal_measurement() -> ModalMeasurement:
    """Return the published means of the five trials, with the uncertainty that our records of them show."""
    return ModalMeasurement(
        frequency=PUBLISHED_FREQUENCIES,
        frequency_standard_deviation=(0.055, 0.25),
        damping_ratio=PUBLISHED_DAMPING_RATIOS,
        damping_ratio_standard_deviation=(0.0035, 0.0146),
        source="published targets (Kapteyn et al. 2021, step 3)",
    )
