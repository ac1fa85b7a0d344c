"""How trials began and what happened in them, as files and models have it: one record each."""

from dataclasses import field
from keyword import iskeyword
from math import inf, isinf
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, PlainSerializer, WrapValidator
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticKnownError

from discrepancy.errors import CampaignFileError, said
from fe.runtime.expression import RESERVED
from reporting.toml_file import Name, NotNegative, Number, Positive

MOST_MODES = 100
IN_FILES = ConfigDict(extra="forbid", strict=False)
"""How a table of a file becomes a record: unknown keys are refused; fields say how strict they are."""
LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
"""What a list of the file becomes before it is checked."""


def _refused(value: object) -> object:
    raise PydanticKnownError("unexpected_keyword_argument")


def _needed(value: str) -> str:
    if not value:
        raise PydanticKnownError("missing")
    return value


NOT_IN_FILES = BeforeValidator(_refused)
"""Of a key that the tables of samples at rest say, and a file cannot."""
InFiles = Annotated[str, AfterValidator(_needed), Field(max_length=200, validate_default=True)]
"""What all have that are in files."""
Deviation = Annotated[
    NotNegative,
    WrapValidator(lambda value, check: inf if value == "free" else check(value)),
    PlainSerializer(lambda value: "free" if isinf(value) else value, when_used="json"),
]
"""In files an infinite one is "free"."""

ACCEPTABLE = (
    "clipped",
    "dead",
    "held",
    "copied",
    "outliers",
    "too short",
    "undersampled",
    "unit slip",
    "input slip",
    "sign",
    "swapped",
)
"""Faults of data that a campaign may accept, as `discrepancy.checks.fault.FaultKind` calls them."""


def _is_acceptable(word: str) -> str:
    if word not in ACCEPTABLE:
        raise ValueError(f"{word!r} is no fault that can be accepted; these are {', '.join(ACCEPTABLE)}")
    return word


Accepted = Annotated[tuple[Annotated[str, AfterValidator(_is_acceptable)], ...], LIST]
"""Faults of data that a campaign, a channel or a trial accepts: words of `ACCEPTABLE`."""


@dataclass(frozen=True)
class Release:
    """How a ring-down began.

    Attributes
    ----------
    displacement : float
        Nominal displacement of the release point before the release [`unit`], not zero.
    deviation : float
        Prior relative standard deviation of it [1].
    at_rest : bool
        True: the first sample is at the release, from the static shape under the holding force, and higher
        modes start as that shape says, within `deviation`; False: the record starts later, and displacement
        and velocity of each of `mode_count` modes are free.
    mode_count : int
        Modes whose initial state is free, at least 1: the first entry is the amplitude, within `deviation`.
    time_zero_deviation : float
        Prior standard deviation of the time between release and first sample [s].
    unit : str
        m or V, or 1 of another signal; of a file any that is known, until it is read.

    Raises
    ------
    ValueError
        A value is out of its range, such as a displacement of zero.
    """

    displacement: Number
    deviation: Positive = 0.05
    at_rest: Annotated[bool, Field(strict=True)] = True
    mode_count: Annotated[int, Field(strict=True, ge=1, le=MOST_MODES)] = 3
    time_zero_deviation: NotNegative = 0.0
    unit: Literal["m", "mm", "um", "V", "mV", "1"] = field(default="m", compare=False)

    __pydantic_config__ = IN_FILES

    def __post_init__(self) -> None:
        if self.displacement == 0.0:
            raise CampaignFileError(said("campaign.no_side"))


@dataclass(frozen=True)
class Event:
    """Something that happened in trials, known from a protocol.

    Attributes
    ----------
    name : str
        As expressions use it; `name_until` is its end.
    trials : tuple of str
        Trials in which it happened.
    time : float
        Since each trial's start [s].
    until : float or None
        When it was over [s]; None where nothing is said.
    trial : str or None
        Of a file, in the place of `trials`; without both it happened in all that are samples in time.

    Raises
    ------
    ValueError
        The name cannot be used in expressions, or trials or end are none.
    """

    name: Name
    trials: Annotated[tuple[Name, ...], Field(min_length=1), LIST] = ()
    time: NotNegative = field(kw_only=True)
    until: Number | None = field(default=None, kw_only=True)
    trial: Name | None = field(default=None, kw_only=True)

    __pydantic_config__ = IN_FILES

    def __post_init__(self) -> None:
        for wrong, sentence in (
            (not self.name.isidentifier(), "event_name"),
            (self.name in RESERVED or iskeyword(self.name), "event_reserved"),
            (self.trial is not None and self.trials != (), "event_trials"),
            (self.until is not None and self.until <= self.time, "event_end"),
        ):
            if wrong:
                raise CampaignFileError(said(f"campaign.{sentence}", event=self))

    @property
    def moments(self) -> dict[str, float]:
        """Begin and end, where it has one, by the names that expressions use [s]."""
        begin = {self.name: self.time}
        return begin if self.until is None else {**begin, f"{self.name}_until": self.until}
