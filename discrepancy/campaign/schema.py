"""The schema of `campaign.toml`: what it may say, checked strictly; units are still those of the file."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import pydantic

from discrepancy.campaign import records
from discrepancy.campaign.protocol import IN_FILES, LIST, Accepted, Event, Release
from discrepancy.campaign.units import conversion, conversion_of
from discrepancy.errors import CampaignFileError, said
from fe.runtime.patch import EVERY_CHANNEL
from reporting.toml_file import Fault, Name, NotNegative, Number, Positive, Section, validate

FORMAT = 1
"""Version of the format."""
INPUT_COLUMNS = (
    "time", "force", "load_factor", "temperature", "z1", "z2", "z1_deviation", "z2_deviation",
)  # fmt: skip
"""Columns of the tables that are no channels."""
FORCE_UNIT = "N"
"""Unit of the column `force` where the file says no other."""
OF_REGION = "health."
"""Begins the column of the losses of a damage region by its name."""


class ParameterSection(Section):
    """`[parameters.NAME]`: what replaces the model's own prior [SI]."""

    mean: Number
    deviation: NotNegative


class NoiseFileSection(Section):
    """`[noise]`: the table of samples at rest; `interval` [s] replaces its column `time`."""

    file: Name
    interval: Positive | None = None


def _factor(item: records.InTables) -> float:
    try:
        return conversion_of(item.quantity, item.unit)
    except ValueError as cause:
        raise ValueError(f"the unit of {item.name!r}: {cause}") from None


def _scaled(channel: records.Channel, scale: float) -> records.Channel:
    """Return a channel with its deviations in another unit."""
    noise = channel.noise
    noise = noise and replace(noise, standard_deviation=scale * noise.standard_deviation)
    return replace(channel, noise=noise, offset_deviation=scale * channel.offset_deviation)


def _read(channel: records.Channel) -> records.Channel:
    if channel.name == EVERY_CHANNEL or channel.name.startswith("#"):
        raise ValueError(f"a channel cannot be called {channel.name!r}")
    return _scaled(channel, _factor(channel))


def _written(channel: records.Channel, dump: pydantic.SerializerFunctionWrapHandler) -> object:
    return dump(_scaled(channel, 1.0 / _factor(channel)))


ChannelInFile = Annotated[records.Channel, pydantic.AfterValidator(_read), pydantic.WrapSerializer(_written)]
"""Its deviations are in its unit there."""


def _read_input(item: records.RecordedInput) -> records.RecordedInput:
    held = _factor(item) * item.offset_deviation
    if item.table_column in INPUT_COLUMNS and item.table_column != "force":
        raise ValueError(said("campaign.reserved", item=item))
    smooth = item.quantity.moving and not item.reference
    if smooth and item.hold not in (None, records.Hold.SMOOTH):
        raise ValueError(said("campaign.motion", item=item))
    return replace(item, offset_deviation=held, hold=records.Hold.SMOOTH if smooth else item.hold)


def _force_unit(unit: str) -> str:
    conversion_of(records.Quantity.FORCE, unit)
    return unit


def _in_si(release: Release) -> Release:
    """Return a release in metres, volts or as a plain number."""
    unit: Literal["m", "V", "1"]
    unit = "m" if release.unit.endswith("m") else "V" if release.unit.endswith("V") else "1"
    return replace(release, displacement=conversion(release.unit, unit) * release.displacement, unit=unit)


@dataclass(frozen=True, kw_only=True)
class TrialSection(records.TrialKeys):
    """`[[trial]]`; `health` has losses by damage region, and `deviation`."""

    __pydantic_config__ = IN_FILES

    start: NotNegative | None = None
    temperature: Number | None = None
    health: dict[Name, NotNegative] = field(default_factory=dict)
    release: Annotated[Release, pydantic.AfterValidator(_in_si)] | None = None
    channels: Annotated[tuple[Name, ...], LIST] | None = None
    left_out: dict[str, Annotated[tuple[Annotated[int, pydantic.Field(strict=True, ge=1)], ...], LIST]] = (
        field(default_factory=dict)
    )
    begins: records.Start | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _ringdowns_have_releases(cls, content: object) -> object:
        """Let a ring-down's release be among all that is missing."""
        if isinstance(content, dict) and content.get("kind") == records.TrialKind.RINGDOWN:
            return {"release": {}, **content}
        return content

    @pydantic.field_validator("load_place", mode="before")
    @classmethod
    def _place(cls, value: object) -> object:
        if isinstance(value, list):
            if len(value) != 2:
                raise ValueError(said("campaign.load_place", value=value))
            return tuple(value)
        return value

    def __post_init__(self) -> None:
        kinds = {
            "release": {records.TrialKind.RINGDOWN},
            "begins": {records.TrialKind.FORCED, records.TrialKind.DRIVEN},
        }
        for key, allowed in {**kinds, "hold": {records.TrialKind.FORCED}}.items():
            if getattr(self, key) is not None and self.kind not in allowed:
                raise ValueError(said(f"campaign.no_{key}", trial=self))
        for region, loss in self.health.items():
            if region != "deviation" and loss > 1.0:
                raise ValueError(f"the loss of {region!r} is a fraction from 0 to 1, and {loss:g} came")


def _twice(names: Iterable[str]) -> str | None:
    """Return the first name in the alphabet that comes more than once."""
    return min((name for name, count in Counter(names).items() if count > 1), default=None)


class CampaignSection(Section):
    """The whole file."""

    model_config = pydantic.ConfigDict(strict=False)

    format: Literal[1]
    name: str
    force_unit: Annotated[Name, pydantic.AfterValidator(_force_unit)] = FORCE_UNIT
    reference_temperature: Annotated[Number, pydantic.Field(ge=-273.15)] | None = None
    parameters: dict[Name, ParameterSection] = pydantic.Field(default_factory=dict)
    noise: NoiseFileSection | None = None
    channel: Annotated[tuple[ChannelInFile, ...], pydantic.Field(min_length=1), LIST]
    input: Annotated[
        tuple[Annotated[records.RecordedInput, pydantic.AfterValidator(_read_input)], ...], LIST
    ] = ()
    trial: Annotated[tuple[TrialSection, ...], pydantic.Field(min_length=1), LIST]
    event: Annotated[tuple[Event, ...], LIST] = ()
    remarks: Annotated[tuple[str, ...], LIST] = ()
    loggers: dict[Name, Annotated[tuple[Name, ...], LIST]] = pydantic.Field(default_factory=dict)
    accept: Accepted = ()

    @property
    def columns(self) -> tuple[records.InTables, ...]:
        """Channels and inputs."""
        return (*self.channel, *self.input)

    def faults(self) -> Iterator[Fault]:
        """Yield what does not fit together."""
        for kind in ("channel", "input", "trial"):
            twice = _twice(item.name for item in getattr(self, kind))
            yield twice, f"there is more than one {kind} called {twice!r}: rename one"
        lost = self.input and not any(
            item.kind in (records.TrialKind.DRIVEN, records.TrialKind.STATIC) for item in self.trial
        )
        yield lost, '[[input]] is for trials of the kind "driven" or "static", and there is none'
        twice, what = (
            _twice(item.table_column for item in self.columns),
            "channel or input" if self.input else "channel",
        )
        yield twice, f"more than one {what} reads the column {twice!r}: give each its own `column`"
        # the force is one of static and forced trials only: a load cell may be called so in a driven one
        forced = any(item.kind in (records.TrialKind.STATIC, records.TrialKind.FORCED) for item in self.trial)
        taken = {name for name in INPUT_COLUMNS if name != "force" or forced}
        for channel in self.channel:
            yield channel.table_column in taken, said("campaign.taken", item=channel)
        scales = {item.unit == "K" for item in self.columns if item.quantity is records.Quantity.TEMPERATURE}
        yield len(scales) > 1, "temperatures are given in degC and in K: give all of them in one of the two"
        yield from self._wrong_loggers()
        known = {item.name for item in self.channel}
        names = ", ".join(sorted(known))
        for item in self.trial:
            for name in (*(item.channels or ()), *item.left_out):
                yield name not in known, said("campaign.unknown_channel", trial=item, name=name, known=names)

    def _wrong_loggers(self) -> Iterator[Fault]:
        """Yield loggers of nothing, names that none or two of them record, and inputs on two of them."""
        inputs = {item.name for item in self.input}
        inputs |= {"force"} if any(item.kind is records.TrialKind.FORCED for item in self.trial) else set()
        wanted = [*(item.name for item in self.channel), *sorted(inputs)] if self.loggers else []
        recorded = [name for names in self.loggers.values() for name in names]
        for name in recorded:
            yield name not in wanted, said("campaign.no_such_record", name=name, wanted=", ".join(wanted))
        for name in wanted:
            came = "more than one" if name in recorded else "none"
            yield recorded.count(name) != 1, f"{name!r} must be on one of the `loggers`, and it is on {came}"
        several = sum(bool(inputs & {*names}) for names in self.loggers.values()) > 1
        yield several, "all inputs must be on one of the `loggers`, and they are on several"


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
    return validate(CampaignSection, dict(table), source, CampaignFileError, what="a campaign")
