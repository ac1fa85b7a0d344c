"""The schema of `campaign.toml`: what it may say, checked strictly; units are still those of the file."""

from collections.abc import Mapping, Sequence
from keyword import iskeyword
from math import inf, isinf
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    WrapValidator,
    field_validator,
    model_validator,
)

from discrepancy.campaign.records import Hold, Quantity, Start, TrialKind
from discrepancy.campaign.units import conversion_of
from discrepancy.errors import CampaignFileError
from fe.runtime.expression import RESERVED
from fe.runtime.patch import EVERY_CHANNEL
from reporting.section import Name, NotNegative, Number, Positive, Section, checked

FORMAT = 1
"""Version of the format."""
INPUT_COLUMNS = (
    "time", "force", "load_factor", "temperature", "z1", "z2", "z1_deviation", "z2_deviation",
)  # fmt: skip
"""Columns of the tables that are no channels."""
OF_REGION = "health."
"""Begins the column of the losses of a damage region by its name."""

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Deviation = Annotated[
    NotNegative,
    WrapValidator(lambda value, check: inf if value == "free" else check(value)),
    PlainSerializer(lambda value: "free" if isinf(value) else value, when_used="json"),
]
MOST_MODES = 100
_LIST = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
"""What a list of the file becomes before it is checked."""


class ParameterSection(Section):
    """`[parameters.NAME]`: what replaces the model's own prior [SI]."""

    mean: Number
    deviation: NotNegative


class NoiseFileSection(Section):
    """`[noise]`: the table of samples at rest; `interval` [s] replaces its column `time`."""

    file: Name
    interval: Positive | None = None


class StatedNoise(Section):
    """`noise` of a channel [its unit]; exact without degrees of freedom."""

    standard_deviation: Positive
    degrees_of_freedom: Positive = inf
    source: Literal["stated", "repeats", "pre-trigger"] = "stated"


class ColumnSection(Section):
    """What a channel and an input have in common: a column of the tables."""

    name: Name
    quantity: Quantity = Field(strict=False)
    unit: Name
    column: Name | None = None

    @property
    def table_column(self) -> str:
        """Column of the tables."""
        return self.column or self.name

    @model_validator(mode="after")
    def _check_unit(self) -> Self:
        try:
            conversion_of(self.quantity, self.unit)
        except ValueError as cause:
            raise ValueError(f"the unit of {self.name!r}: {cause}") from None
        return self


class ChannelSection(ColumnSection):
    """`[[channel]]`."""

    output: Name
    station: Number | None = None
    chord: Number | None = None
    gain_deviation: Deviation = 0.0
    offset_deviation: Deviation = 0.0
    noise: StatedNoise | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.name == EVERY_CHANNEL or self.name.startswith("#"):
            raise ValueError(f"a channel cannot be called {self.name!r}")
        return self


class InputSection(ColumnSection):
    """`[[input]]`: a recorded input of driven trials, or what is held in each row of a static one."""

    hold: Hold | None = Field(default=None, strict=False)
    reference: bool = False
    offset_deviation: NotNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.table_column in INPUT_COLUMNS and self.table_column != "force":
            raise ValueError(
                f"the column {self.table_column!r} is reserved: give the input {self.name!r} another column"
            )
        if self.quantity.moving and not self.reference and self.hold not in (None, Hold.SMOOTH):
            raise ValueError(
                f"the input {self.name!r} is a motion, which no drive makes in steps or corners: leave "
                "`hold` out, or say smooth, or reference = true where it is what a controller shall follow"
            )
        return self

    @property
    def holds(self) -> Hold | None:
        """What it does between its samples: a motion is smooth, of the rest it is said or not."""
        return Hold.SMOOTH if self.quantity.moving and not self.reference else self.hold


class ReleaseSection(Section):
    """`release` of a ring-down."""

    displacement: Number
    unit: Literal["m", "mm", "um", "V", "mV", "1"] = "m"
    deviation: Positive = 0.05
    at_rest: bool = True
    mode_count: Annotated[int, Field(ge=1, le=MOST_MODES)] = 3
    time_zero_deviation: NotNegative = 0.0

    @field_validator("displacement")
    @classmethod
    def _somewhere(cls, displacement: float) -> float:
        if displacement == 0.0:
            raise ValueError("must not be zero: its sign is the side to which the structure is held")
        return displacement


class HealthSection(Section):
    """`health` of a trial: fractions by damage region."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Fraction]

    deviation: NotNegative = 0.0

    @property
    def losses(self) -> dict[str, float]:
        """Losses by region."""
        return dict(self.__pydantic_extra__)


class TrialSection(Section):
    """`[[trial]]`."""

    name: Name
    kind: TrialKind = Field(strict=False)
    file: Name
    run: str = ""
    held_out: bool = False
    noise_factor: Positive = 1.0
    start: NotNegative | None = None
    temperature: Number | None = None
    load_place: Name | tuple[Number, Number] = Field(default="tip_load", union_mode="left_to_right")
    health: HealthSection | None = None
    release: ReleaseSection | None = None
    channels: Annotated[tuple[Name, ...], _LIST] | None = None
    left_out: dict[str, Annotated[tuple[Annotated[int, Field(ge=1)], ...], _LIST]] = Field(
        default_factory=dict
    )
    begins: Start | None = Field(default=None, strict=False)
    hold: Hold | None = Field(default=None, strict=False)

    @model_validator(mode="before")
    @classmethod
    def _ringdowns_have_releases(cls, content: object) -> object:
        """Let a ring-down's release be among all that is missing."""
        if isinstance(content, dict) and content.get("kind") == TrialKind.RINGDOWN:
            return {"release": {}, **content}
        return content

    @field_validator("load_place", mode="before")
    @classmethod
    def _place(cls, value: object) -> object:
        if isinstance(value, list):
            if len(value) != 2:
                raise ValueError(
                    "`load_place` must be a name or [y, x] (m from the root, fraction of the chord), "
                    f"and {value} "
                    "came"
                )
            return tuple(value)
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.kind is not TrialKind.RINGDOWN and self.release is not None:
            raise ValueError(f"the trial {self.name!r} is no ring-down and cannot have a `release`")
        if self.begins is not None and self.kind not in (TrialKind.FORCED, TrialKind.DRIVEN):
            raise ValueError(
                f"the trial {self.name!r} is {self.kind.value}, and `begins` is for forced and driven ones; "
                "a ring-down says it by its `release`"
            )
        if self.hold is not None and self.kind is not TrialKind.FORCED:
            raise ValueError(
                f"the trial {self.name!r} is {self.kind.value}, and its `hold` is for the force of a forced "
                "one: say that of a driven one in its [[input]]"
            )
        return self


class EventSection(Section):
    """`[[event]]`."""

    name: Name
    time: NotNegative
    trial: Name | None = None
    trials: Annotated[tuple[Name, ...], Field(min_length=1), _LIST] | None = None
    until: Number | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.name.isidentifier():
            raise ValueError(
                f"the event {self.name!r} is used in expressions, so its name must be of letters, digits and "
                "underscores, a letter first"
            )
        if self.name in RESERVED or iskeyword(self.name):
            raise ValueError(
                f"the event {self.name!r} has a name that means something else in an expression: rename it"
            )
        if self.trial is not None and self.trials is not None:
            raise ValueError(f"the event {self.name!r} has `trial` and `trials`: give one of the two")
        if self.until is not None and self.until <= self.time:
            raise ValueError(
                f"the event {self.name!r} begins at {self.time:g} s and must end later, but `until` is "
                f"{self.until:g} s"
            )
        return self

    def among(self, trials: Sequence[TrialSection]) -> tuple[str, ...]:
        """Return the trials in which it happened: those named, or all that are samples in time."""
        if self.trial is not None:
            return (self.trial,)
        if self.trials is not None:
            return self.trials
        still = (TrialKind.STATIC, TrialKind.FLIGHT)
        return tuple(item.name for item in trials if item.kind not in still)


class CampaignSection(Section):
    """The whole file."""

    format: Literal[1]
    name: str
    reference_temperature: Annotated[float, Field(allow_inf_nan=False, ge=-273.15)] | None = None
    parameters: dict[Name, ParameterSection] = Field(default_factory=dict)
    noise: NoiseFileSection | None = None
    channel: Annotated[tuple[ChannelSection, ...], Field(min_length=1), _LIST]
    input: Annotated[tuple[InputSection, ...], _LIST] = ()
    trial: Annotated[tuple[TrialSection, ...], Field(min_length=1), _LIST]
    event: Annotated[tuple[EventSection, ...], _LIST] = ()
    remarks: Annotated[tuple[str, ...], _LIST] = ()
    loggers: dict[Name, Annotated[tuple[Name, ...], _LIST]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check(self) -> Self:
        for kind, names in (
            ("channel", [item.name for item in self.channel]),
            ("input", [item.name for item in self.input]),
            ("trial", [item.name for item in self.trial]),
        ):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"there is more than one {kind} called {twice[0]!r}: rename one")
        if self.input and not any(item.kind in (TrialKind.DRIVEN, TrialKind.STATIC) for item in self.trial):
            raise ValueError('[[input]] is for trials of the kind "driven" or "static", and there is none')
        every: tuple[ColumnSection, ...] = (*self.channel, *self.input)
        columns = [item.table_column for item in every]
        twice = sorted({column for column in columns if columns.count(column) > 1})
        if twice:
            what = "channel or input" if self.input else "channel"
            raise ValueError(
                f"more than one {what} reads the column {twice[0]!r}: give each its own `column`"
            )
        # the force is one of static and forced trials only: a load cell may be called so in a driven one
        forced = any(item.kind in (TrialKind.STATIC, TrialKind.FORCED) for item in self.trial)
        taken = {name for name in INPUT_COLUMNS if name != "force" or forced}
        for channel in self.channel:
            if channel.table_column in taken:
                raise ValueError(
                    f"the column {channel.table_column!r} holds an input of the trial: give the channel "
                    f"{channel.name!r} another column"
                )
        scales = {item.unit == "K" for item in every if item.quantity is Quantity.TEMPERATURE}
        if len(scales) > 1:
            raise ValueError("temperatures are given in degC and in K: give all of them in one of the two")
        self._check_loggers()
        self._check_events()
        known = {item.name for item in self.channel}
        for item in self.trial:
            for name in (*(item.channels or ()), *item.left_out):
                if name not in known:
                    raise ValueError(
                        f"the trial {item.name!r} names the channel {name!r}, which is not among the "
                        "channels "
                        f"{', '.join(sorted(known))}"
                    )
        return self

    def _check_loggers(self) -> None:
        """Refuse a logger of nothing, a name that none or two of them record, and inputs on two of them."""
        if not self.loggers:
            return
        inputs = {item.name for item in self.input}
        inputs |= {"force"} if any(item.kind is TrialKind.FORCED for item in self.trial) else set()
        wanted = [*(item.name for item in self.channel), *sorted(inputs)]
        recorded = [name for names in self.loggers.values() for name in names]
        for name in recorded:
            if name not in wanted:
                raise ValueError(
                    f"`loggers` names {name!r}, but the channels and inputs are {', '.join(wanted)}"
                )
        for name in wanted:
            if recorded.count(name) != 1:
                came = "none" if name not in recorded else "more than one"
                raise ValueError(f"{name!r} must be on one of the `loggers`, and it is on {came}")
        if sum(bool(inputs & set(names)) for names in self.loggers.values()) > 1:
            raise ValueError("all inputs must be on one of the `loggers`, and they are on several")

    def _check_events(self) -> None:
        """Refuse an event in a trial that is not there or not in time, and two of a name in one trial."""
        kinds, seen = {item.name: item.kind for item in self.trial}, set[tuple[str, str]]()
        for event in self.event:
            for trial in event.among(self.trial):
                if trial not in kinds:
                    raise ValueError(
                        f"the event {event.name!r} names the trial {trial!r}, which is not among the trials "
                        f"{', '.join(kinds)}"
                    )
                if kinds[trial] in (TrialKind.STATIC, TrialKind.FLIGHT):
                    raise ValueError(
                        f"the event {event.name!r} is in the trial {trial!r}, which is {kinds[trial].value} "
                        "and has no course in time"
                    )
                # Its end has a name, too, by which expressions know it.
                for word in (event.name, f"{event.name}_until")[: 1 if event.until is None else 2]:
                    if (word, trial) in seen:
                        raise ValueError(
                            f"there is more than one moment {word!r} in the trial {trial!r}: rename one, or "
                            "name the trial once"
                        )
                    seen.add((word, trial))


def parse_campaign(table: Mapping[str, Any], source: str) -> CampaignSection:
    """Return the checked content of a campaign's TOML file.

    Raises
    ------
    CampaignFileError
        The table breaks the schema; one sentence with file and key.
    """
    came = table.get("format", FORMAT)
    if came != FORMAT or isinstance(came, bool):
        raise CampaignFileError(
            f"{source}: `format` is {came!r}; this version reads campaigns with `format = {FORMAT}`."
        )
    return checked(CampaignSection, dict(table), source, CampaignFileError, what="a campaign")
