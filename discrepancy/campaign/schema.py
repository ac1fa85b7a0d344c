"""The schema of `campaign.toml`: what it may say, checked strictly; units are still those of the file."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    WrapSerializer,
    field_validator,
    model_validator,
)

from discrepancy.campaign.protocol import LIST, Event, Release
from discrepancy.campaign.records import Channel, Hold, Quantity, Start, TrialKind
from discrepancy.campaign.units import conversion, conversion_of
from discrepancy.errors import CampaignFileError
from discrepancy.sentences import said
from fe.runtime.patch import EVERY_CHANNEL
from reporting.toml_file import Name, NotNegative, Number, Positive, Section, checked

FORMAT = 1
"""Version of the format."""
INPUT_COLUMNS = (
    "time", "force", "load_factor", "temperature", "z1", "z2", "z1_deviation", "z2_deviation",
)  # fmt: skip
"""Columns of the tables that are no channels."""
OF_REGION = "health."
"""Begins the column of the losses of a damage region by its name."""

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]


class ParameterSection(Section):
    """`[parameters.NAME]`: what replaces the model's own prior [SI]."""

    mean: Number
    deviation: NotNegative


class NoiseFileSection(Section):
    """`[noise]`: the table of samples at rest; `interval` [s] replaces its column `time`."""

    file: Name
    interval: Positive | None = None


class InputSection(Section):
    """`[[input]]`: a recorded input of driven trials, or what is held in each row of a static one."""

    name: Name
    quantity: Quantity = Field(strict=False)
    unit: Name
    column: Name = ""
    hold: Hold | None = Field(default=None, strict=False)
    reference: bool = False
    offset_deviation: NotNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_unit(self)
        if self.table_column in INPUT_COLUMNS and self.table_column != "force":
            raise ValueError(said("campaign.reserved", item=self))
        if self.quantity.moving and not self.reference and self.hold not in (None, Hold.SMOOTH):
            raise ValueError(said("campaign.motion", item=self))
        return self

    @property
    def table_column(self) -> str:
        """Column of the tables."""
        return self.column or self.name

    @property
    def holds(self) -> Hold | None:
        """What it does between its samples: a motion is smooth, of the rest it is said or not."""
        return Hold.SMOOTH if self.quantity.moving and not self.reference else self.hold


Column = Channel | InputSection
"""What has a column of the tables."""


def _check_unit(item: Column) -> None:
    try:
        conversion_of(item.quantity, item.unit)
    except ValueError as cause:
        raise ValueError(f"the unit of {item.name!r}: {cause}") from None


def _scaled(channel: Channel, scale: Callable[[float], float]) -> Channel:
    """Return a channel with its deviations in another unit."""
    noise = channel.noise
    noise = noise and replace(noise, standard_deviation=scale(noise.standard_deviation))
    return replace(channel, noise=noise, offset_deviation=scale(channel.offset_deviation))


def _read(channel: Channel) -> Channel:
    if channel.name == EVERY_CHANNEL or channel.name.startswith("#"):
        raise ValueError(f"a channel cannot be called {channel.name!r}")
    _check_unit(channel)
    return _scaled(channel, conversion_of(channel.quantity, channel.unit).to_si)


def _written(channel: Channel, dump: SerializerFunctionWrapHandler) -> object:
    return dump(_scaled(channel, conversion_of(channel.quantity, channel.unit).from_si))


ChannelInFile = Annotated[Channel, AfterValidator(_read), WrapSerializer(_written)]
"""Its deviations are in its unit there."""


def _in_si(release: Release) -> Release:
    """Return a release in metres, volts or as a plain number."""
    unit: Literal["m", "V", "1"]
    unit = "m" if release.unit.endswith("m") else "V" if release.unit.endswith("V") else "1"
    held = conversion(release.unit, unit).to_si(release.displacement)
    return replace(release, displacement=held, unit=unit)


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
    release: Annotated[Release, AfterValidator(_in_si)] | None = None
    channels: Annotated[tuple[Name, ...], LIST] | None = None
    left_out: dict[str, Annotated[tuple[Annotated[int, Field(ge=1)], ...], LIST]] = Field(
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
                raise ValueError(said("campaign.load_place", value=value))
            return tuple(value)
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        kinds = {"release": {TrialKind.RINGDOWN}, "begins": {TrialKind.FORCED, TrialKind.DRIVEN}}
        for key, allowed in {**kinds, "hold": {TrialKind.FORCED}}.items():
            if getattr(self, key) is not None and self.kind not in allowed:
                raise ValueError(said(f"campaign.no_{key}", trial=self))
        return self


def _twice(names: Iterable[str]) -> str | None:
    """Return the first name in the alphabet that comes more than once."""
    return min((name for name, count in Counter(names).items() if count > 1), default=None)


class CampaignSection(Section):
    """The whole file."""

    format: Literal[1]
    name: str
    reference_temperature: Annotated[float, Field(allow_inf_nan=False, ge=-273.15)] | None = None
    parameters: dict[Name, ParameterSection] = Field(default_factory=dict)
    noise: NoiseFileSection | None = None
    channel: Annotated[tuple[ChannelInFile, ...], Field(min_length=1), LIST]
    input: Annotated[tuple[InputSection, ...], LIST] = ()
    trial: Annotated[tuple[TrialSection, ...], Field(min_length=1), LIST]
    event: Annotated[tuple[Event, ...], LIST] = ()
    remarks: Annotated[tuple[str, ...], LIST] = ()
    loggers: dict[Name, Annotated[tuple[Name, ...], LIST]] = Field(default_factory=dict)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Channels and inputs."""
        return (*self.channel, *self.input)

    @model_validator(mode="after")
    def _check(self) -> Self:
        for kind in ("channel", "input", "trial"):
            if twice := _twice(item.name for item in getattr(self, kind)):
                raise ValueError(f"there is more than one {kind} called {twice!r}: rename one")
        if self.input and not any(item.kind in (TrialKind.DRIVEN, TrialKind.STATIC) for item in self.trial):
            raise ValueError('[[input]] is for trials of the kind "driven" or "static", and there is none')
        if twice := _twice(item.table_column for item in self.columns):
            what = "channel or input" if self.input else "channel"
            raise ValueError(f"more than one {what} reads the column {twice!r}: give each its own `column`")
        # the force is one of static and forced trials only: a load cell may be called so in a driven one
        forced = any(item.kind in (TrialKind.STATIC, TrialKind.FORCED) for item in self.trial)
        taken = {name for name in INPUT_COLUMNS if name != "force" or forced}
        for channel in self.channel:
            if channel.table_column in taken:
                raise ValueError(said("campaign.taken", item=channel))
        scales = {item.unit == "K" for item in self.columns if item.quantity is Quantity.TEMPERATURE}
        if len(scales) > 1:
            raise ValueError("temperatures are given in degC and in K: give all of them in one of the two")
        self._check_loggers()
        known = {item.name for item in self.channel}
        for item in self.trial:
            for name in (*(item.channels or ()), *item.left_out):
                if name not in known:
                    names = ", ".join(sorted(known))
                    raise ValueError(said("campaign.unknown_channel", trial=item, name=name, known=names))
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
                raise ValueError(said("campaign.no_such_record", name=name, wanted=", ".join(wanted)))
        for name in wanted:
            if recorded.count(name) != 1:
                came = "none" if name not in recorded else "more than one"
                raise ValueError(f"{name!r} must be on one of the `loggers`, and it is on {came}")
        if sum(bool(inputs & set(names)) for names in self.loggers.values()) > 1:
            raise ValueError("all inputs must be on one of the `loggers`, and they are on several")


def parse_campaign(table: Mapping[str, Any], source: str) -> CampaignSection:
    """Return the checked content of a campaign's TOML file.

    Raises
    ------
    CampaignFileError
        The table breaks the schema; one sentence with file and key.
    """
    came = table.get("format", FORMAT)
    if came != FORMAT or isinstance(came, bool):
        raise CampaignFileError(said("campaign.format", source=source, came=came, wanted=FORMAT))
    return checked(CampaignSection, dict(table), source, CampaignFileError, what="a campaign")
