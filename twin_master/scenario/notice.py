"""The table `[notice]` of a scenario: what the twin raises an alarm for, beside its belief."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import BeforeValidator, Field

from twin_master.scenario.section import Positive, Section

__all__ = ["GAINS", "MOST_DRAWS", "NUMBERS_BY_DEFAULT", "Noticing", "NoticingOrNot"]

GAINS = 4
"""Gain errors that are compared for each sensor."""
MOST_DRAWS = 15
"""Draws of the parameter that are kept apart: evidence is compared, and no fine posterior is needed."""
NUMBERS_BY_DEFAULT = 1_000_000
"""Numbers of the beliefs about sensors up to which a scenario gives notices by itself: 0.1 s a turn."""
_LARGEST_GAIN = 0.4
"""The largest gain errors that are compared are two and a half times as large."""


class Noticing(Section):
    """When an alarm is raised; the belief is not touched, but by readings that are left out."""

    units: ClassVar[Mapping[str, str]] = {"gauge_gain": "percent", "all_gain": "percent"}
    threshold: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=1.0)] = 100.0
    """Evidence from which an alarm is raised: a false one is at most so improbable, for each of two kinds."""
    gauge_gain: Annotated[float, Field(strict=True, gt=0.0, le=_LARGEST_GAIN)] = 0.2
    """Gain error of a single sensor that is to be found; less than half of it raises no alarm."""
    all_gain: Annotated[float, Field(strict=True, gt=0.0, le=1.0)] = 0.1
    """Prior standard deviation of the gains of sensors that have one, where no state explains all of them."""
    memory_turns: Positive = 20.0
    """Turns after which what was learnt of these gains has faded to 1 / e."""
    onset_turns: Positive = 50.0
    """Turns within which half of the faults begin that were not there from the start."""
    absurd_deviations: Annotated[float, Field(strict=True, allow_inf_nan=False, ge=3.0)] = 8.0
    """A reading so many assumed standard deviations beyond what any state can show is left out."""
    prior: Annotated[float, Field(strict=True, gt=0.0, lt=0.5)] = 0.01
    """Prior probability of each of the two kinds of fault, for their posterior."""
    noise_degrees: Annotated[float, Field(strict=True, allow_inf_nan=False, gt=2.0)] = 10.0
    """How sure the assumed noise is: as if it came from so many observations, more than two."""


NoticingOrNot = Annotated[Noticing | None, BeforeValidator(lambda given: None if given is False else given)]
"""The table, or `notice = false`."""
