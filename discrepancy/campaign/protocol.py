"""Releases and events: how ring-downs began, and what happened during trials.

The same records are read from files and used by models.
"""

from dataclasses import field
from keyword import iskeyword
from math import inf, isinf
from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    WrapValidator,
)
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticKnownError

from discrepancy.errors import CampaignFileError
from fe.runtime.expression import RESERVED
from reporting.formats.known_keys import TEXTS_ARE_READ
from reporting.formats.schema import MUST_BE_STATED, NeverInFile
from reporting.formats.toml_file import Name, NotNegative, Number, Positive

MOST_MODES = 100
IN_FILES = ConfigDict(extra="forbid", strict=False, use_attribute_docstrings=TEXTS_ARE_READ)
"""How a table of a file becomes a record: unknown keys are refused, and types are converted."""
LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
"""Turns a list of the file into a tuple before it is checked."""


def _refuse_key(value: object) -> object:
    """Raise the error of pydantic for an unknown key, whatever the value of the key."""
    raise PydanticKnownError("unexpected_keyword_argument")


def _refuse_empty_text(value: str) -> str:
    """Return a text; raise the error of pydantic for a missing key if it is empty."""
    if not value:
        raise PydanticKnownError("missing")
    return value


NOT_IN_FILES = BeforeValidator(_refuse_key, json_schema_input_type=NeverInFile)
"""Marks a field that is read from the tables, and that the TOML file must not state."""
InFiles = Annotated[
    str,
    AfterValidator(_refuse_empty_text),
    Field(max_length=200, validate_default=True, json_schema_extra={MUST_BE_STATED: True}),
]
"""A text that every file must state, although records in memory may leave it empty."""
Deviation = Annotated[
    NotNegative,
    WrapValidator(
        lambda value, check: inf if value == "free" else check(value),
        json_schema_input_type=NotNegative | Literal["free"],
    ),
    PlainSerializer(lambda value: "free" if isinf(value) else value, when_used="json"),
]
"""A standard deviation; an infinite one is written "free" in files."""

ACCEPTABLE = (
    "clipped",
    "dead",
    "held",
    "copied",
    "outliers",
    "too short",
    "undersampled",
    "frequency",
    "unit slip",
    "input slip",
    "sign",
    "swapped",
)
"""Faults of data that a campaign may accept, as `discrepancy.checks.fault.FaultKind` calls them."""


def _checked_fault(word: str) -> str:
    """Return the name of an acceptable fault; raise ValueError for any other word."""
    if word not in ACCEPTABLE:
        raise ValueError(
            f"{word!r} is not a fault that can be accepted; those that can are "
            f"{', '.join(ACCEPTABLE)}"
        )
    return word


Accepted = Annotated[tuple[Annotated[str, AfterValidator(_checked_fault)], ...], LIST]
"""Faults of data that a campaign, a channel or a trial accepts: words of `ACCEPTABLE`."""


@dataclass(frozen=True)
class Release:
    """How a ring-down began.

    Raises
    ------
    ValueError
        If a value is out of its range, such as a displacement of zero.
    """

    displacement: Number
    """Nominal displacement of the release point before the release [`unit`], not zero."""
    deviation: Positive = 0.05
    """Prior standard deviation of the displacement, as a fraction of it [1]."""
    at_rest: Annotated[bool, Field(strict=True)] = True
    """True if the first sample is at the release: the structure starts at rest from its static
    shape under the holding force, which also determines the higher modes, within `deviation`. False
    if the record starts later: displacement and velocity of each of `mode_count` modes are then
    unknown."""
    mode_count: Annotated[int, Field(strict=True, ge=1, le=MOST_MODES)] = 3
    """Number of modes with an unknown initial state, at least 1. The first unknown is the
    amplitude, within `deviation`."""
    time_zero_deviation: NotNegative = 0.0
    """Prior standard deviation of the time between release and first sample [s]."""
    unit: Literal["m", "mm", "um", "V", "mV", "1"] = field(default="m", compare=False)
    """Unit of the displacement: m, V, or 1 for another signal. A file may also say mm, um or mV."""

    __pydantic_config__ = IN_FILES

    def __post_init__(self) -> None:
        if self.displacement == 0.0:
            raise CampaignFileError(
                "The displacement of a release must not be zero: its sign is the side to which the "
                "structure is held."
            )


@dataclass(frozen=True)
class Event:
    """Something that happened during trials at a known time, such as a screw that was loosened.

    Raises
    ------
    ValueError
        If the name cannot be used in expressions, `trial` and `trials` are both stated, or the end
        is not after the start.
    """

    name: Name
    """Name in expressions, of letters, digits and underscores; `NAME` is its time and `NAME_until`
    its end. An event that happens several times in a trial has an entry for each time, with
    `until`; these intervals must not overlap."""
    trials: Annotated[tuple[Name, ...], Field(min_length=1), LIST] = ()
    """Names of the trials in which it happened."""
    time: NotNegative = field(kw_only=True)
    """Time since the start of each of these trials [s]."""
    until: Number | None = field(default=None, kw_only=True)
    """Its end [s]; None if it is that of the trial."""
    trial: Name | None = field(default=None, kw_only=True)
    """A single trial, which a file may state in place of `trials`. Without both the event happened
    in all trials that are records in time."""

    __pydantic_config__ = IN_FILES

    def __post_init__(self) -> None:
        subject = f"the event {self.name!r}"
        if not self.name.isidentifier():
            raise CampaignFileError(
                f"{subject} is used in expressions, so its name must consist of letters, digits "
                "and underscores, and begin with a letter"
            )
        if self.name in RESERVED or iskeyword(self.name):
            raise CampaignFileError(
                f"{subject} has a name that means something else in an expression: rename it"
            )
        if self.trial is not None and self.trials != ():
            raise CampaignFileError(f"{subject} has `trial` and `trials`: give one of the two")
        if self.until is not None and self.until <= self.time:
            raise CampaignFileError(
                f"{subject} begins at {self.time:g} s and must end later, but `until` is "
                f"{self.until:g} s"
            )

    @property
    def times_by_name(self) -> dict[str, float]:
        """Times of its start and, if it is stated, of its end [s], by the names in expressions."""
        times = {self.name: self.time}
        if self.until is not None:
            times[f"{self.name}_until"] = self.until
        return times
