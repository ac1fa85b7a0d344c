"""The table `[learning]` of a scenario: what the twin learns of what does not change in time."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, ClassVar, Self

from pydantic import Field, model_validator

from twin_master.scenario.section import Flag, NotNegative, Positive, Section, check_one_or_each, short

__all__ = ["Learning"]


class Learning(Section):
    """What is learnt, each with its prior; everything else stays as the scenario says it."""

    units: ClassVar[Mapping[str, str]] = {"gauge_gain": "percent", "gauge_offset": "microstrain"}
    parameter: Flag = True
    """The draws of the calibrated parameter keep their weights from turn to turn."""
    noise: Flag = True
    """The noise scale of each sensor, about the standard deviation that is assumed."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """How sure the assumed noise is: as if it came from so many observations, more than two."""
    gauge_gain: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the relative gain error of each sensor; 0 is not learnt."""
    gauge_offset: NotNegative | tuple[NotNegative, ...] = 0.0
    """Prior standard deviation of the offset of each sensor, in the unit of the sensors; 0 is not learnt."""
    transition_factors: tuple[Positive, ...] = ()
    """Factors on the probabilities to leave a state, equally probable at first; none is not learnt."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        factors = self.transition_factors
        if any(b <= a for a, b in pairwise(factors)):
            raise ValueError(f"`learning.transition_factors` must increase, and {short(factors)} came")
        if len(factors) == 1:
            raise ValueError("`learning.transition_factors` needs two or more factors to choose from")
        return self

    @property
    def figure_names(self) -> tuple[str, ...]:
        """Names of the figures of the summary on what is learnt beside the parameter."""
        names = [f"transition_factor_{moment}" for moment in ("mean", "standard_deviation")]
        names = names if self.transition_factors else []
        for name, learnt in (
            ("noise_scale", self.noise),
            ("gauge_offset", _any(self.gauge_offset)),
            ("gauge_gain", _any(self.gauge_gain)),
        ):
            if learnt:
                names += [f"{name}_{figure}" for figure in ("mean", "most", "most_standard_deviation")]
        return tuple(names)

    def check_sensors(self, count: int) -> None:
        """Check that what is given for each sensor is given once, or once for each of `count`."""
        check_one_or_each("learning.gauge_gain", self.gauge_gain, count)
        check_one_or_each("learning.gauge_offset", self.gauge_offset, count)


def _any(value: float | tuple[float, ...]) -> bool:
    return any(number > 0.0 for number in (value if isinstance(value, tuple) else (value,)))
