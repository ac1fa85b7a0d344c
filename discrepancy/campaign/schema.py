"""The schema of `campaign.toml`, checked strictly.

Units are still those of the file.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import pydantic

from discrepancy.campaign import records
from discrepancy.campaign.protocol import IN_FILES, LIST, Accepted, Event, Release
from discrepancy.campaign.units import (
    FAHRENHEIT,
    amount_in_si,
    conversion_factor,
    factor_to_si,
    usual_name,
)
from discrepancy.errors import CampaignFileError
from fe.runtime.patch import EVERY_CHANNEL
from reporting.formats.toml_file import (
    Check,
    Name,
    NotNegative,
    Number,
    Positive,
    Section,
    validate,
)
from reporting.json_file import JsonRecord
from reporting.words import comma_list

FORMAT = 1
"""Version of the format."""
INPUT_COLUMNS = (
    "time",
    "force",
    "load_factor",
    "temperature",
    "z1",
    "z2",
    "z1_deviation",
    "z2_deviation",
)
"""Columns of the tables that are not channels."""
FORCE_UNIT = "N"
"""Unit of the column `force` if the file does not state another."""
OF_REGION = "health."
"""Prefix of the columns with the losses of a damage region, before the region's name."""


class StatedPriorSection(Section):
    """`[parameters.NAME]`: mean and standard deviation that replace the model's own prior [SI]."""

    mean: Number
    """Mean of the parameter [SI]."""
    deviation: NotNegative
    """Standard deviation of the parameter [SI]."""


class NoiseFileSection(Section):
    """`[noise]`: the table of samples at rest; `interval` [s] replaces its column `time`."""

    file: Name
    """Table of samples at rest."""
    interval: Positive | None = None
    """Sampling interval, in place of the column `time` [s]."""


def _unit_in_si(record: records.InTables) -> float:
    """Return the factor from the unit of a channel or input to SI.

    Raises `ValueError` if the unit does not fit the quantity, or is degF, which a factor alone does
    not convert.
    """
    if usual_name(record.unit) == FAHRENHEIT:
        raise ValueError(
            f"the unit of {record.name!r} is {record.unit}: convert its readings to degC or K, or "
            "import the table with `discrepancy import`"
        )
    try:
        return factor_to_si(record.quantity, record.unit)
    except ValueError as cause:
        raise ValueError(f"the unit of {record.name!r}: {cause}") from None


def _with_scaled_deviations(channel: records.Channel, scale: float) -> records.Channel:
    """Return a channel with the standard deviations of its noise and offset times a scale."""
    noise = channel.noise
    if noise is not None:
        noise = replace(noise, standard_deviation=amount_in_si(noise.standard_deviation, scale))
    offset_deviation = amount_in_si(channel.offset_deviation, scale)
    return replace(channel, noise=noise, offset_deviation=offset_deviation)


def _channel_in_si(channel: records.Channel) -> records.Channel:
    """Return a channel of a file with its standard deviations in SI.

    Raises
    ------
    ValueError
        If the name cannot be that of a channel, or the unit does not fit the quantity.
    """
    if channel.name == EVERY_CHANNEL or channel.name.startswith("#"):
        raise ValueError(f"a channel cannot be called {channel.name!r}")
    return _with_scaled_deviations(channel, _unit_in_si(channel))


def _dump_channel_in_unit(
    channel: records.Channel, dump: pydantic.SerializerFunctionWrapHandler
) -> object:
    """Return the content of a channel's table in a file, with standard deviations in its unit."""
    return dump(_with_scaled_deviations(channel, 1.0 / _unit_in_si(channel)))


ChannelInFile = Annotated[
    records.Channel,
    pydantic.AfterValidator(_channel_in_si),
    pydantic.WrapSerializer(_dump_channel_in_unit),
]
"""A channel in a file, where its standard deviations are in its own unit instead of SI."""


def _checked_input(recorded_input: records.RecordedInput) -> records.RecordedInput:
    """Check an input of a file; return it with the deviation of its offset in SI.

    `hold` of a motion is set to smooth, unless it is a reference that a controller follows.

    Raises
    ------
    ValueError
        If the unit does not fit the quantity or is degF, if the column is reserved, or if `hold` is
        given for a motion other than a reference and is not smooth.
    """
    deviation = amount_in_si(recorded_input.offset_deviation, _unit_in_si(recorded_input))
    column = recorded_input.table_column
    # a driven trial has no force but its inputs, one of which may be in the column `force`
    if column in INPUT_COLUMNS and column != "force":
        raise ValueError(
            f"the column {column!r} is reserved: give the input {recorded_input.name!r} another "
            "column"
        )
    hold = recorded_input.hold
    if recorded_input.quantity.motion_chain and not recorded_input.reference:
        if hold not in (None, records.Hold.SMOOTH):
            raise ValueError(
                f"the input {recorded_input.name!r} is a motion, and no drive moves in steps or "
                "with corners: leave `hold` out, set it to smooth, or set reference = true if a "
                "controller follows the motion"
            )
        hold = records.Hold.SMOOTH
    return replace(recorded_input, offset_deviation=deviation, hold=hold)


def _checked_force_unit(unit: str) -> str:
    """Return a unit of force; raise ValueError if it is a unit of something else."""
    factor_to_si(records.Quantity.FORCE, unit)
    return unit


def _release_in_si(release: Release) -> Release:
    """Return a release in metres, volts or as a plain number."""
    unit: Literal["m", "V", "1"] = "1"
    if release.unit.endswith("m"):
        unit = "m"
    elif release.unit.endswith("V"):
        unit = "V"
    displacement = amount_in_si(release.displacement, conversion_factor(release.unit, unit))
    return replace(release, displacement=displacement, unit=unit)


@dataclass(frozen=True, kw_only=True)
class TrialSection(records.TrialKeys):
    """`[[trial]]`; `health` has losses by damage region, and `deviation`."""

    __pydantic_config__ = IN_FILES

    start: NotNegative | None = None
    """Time since the start of the campaign; by default 0, or the first time of the table [s]."""
    temperature: Number | None = None
    """Temperature of the trial; by default the reference temperature, else unknown [degC]."""
    health: dict[Name, NotNegative] = field(default_factory=dict)
    """Stiffness loss of each damage region, by its name, and `deviation`, their standard deviation
    [1]; by default the structure is healthy and exactly known."""
    release: Annotated[Release, pydantic.AfterValidator(_release_in_si)] | None = None
    """How a ring-down began; every ring-down needs it."""
    channels: Annotated[tuple[Name, ...], LIST] | None = None
    """Names of the channels that count, in this order; by default all that have a column."""
    left_out: dict[
        str, Annotated[tuple[Annotated[int, pydantic.Field(strict=True, ge=1)], ...], LIST]
    ] = field(default_factory=dict)
    """Rows that do not count, counted from 1, by the name of the channel, as in `{ g17 = [12, 40]
    }`."""
    begins: records.Start | None = None
    """How a forced or driven trial began: "settled", at rest under what acts first (the default);
    "still", with displacements, speeds and states zero; or "unknown", so that the initial state is
    fitted."""

    @pydantic.model_validator(mode="before")
    @classmethod
    def _ringdowns_have_releases(cls, content: object) -> object:
        """Add an empty `release` to a ring-down without one, so that its keys are reported."""
        if isinstance(content, dict) and content.get("kind") == records.TrialKind.RINGDOWN:
            return {"release": {}, **content}
        return content

    @pydantic.field_validator("load_place", mode="before")
    @classmethod
    def _load_position(cls, value: object) -> object:
        """Return a position [y, x] as a tuple, and a name as it is."""
        if not isinstance(value, list):
            return value
        if len(value) != 2:
            raise ValueError(
                "`load_place` must be a name or [y, x] (m from the root, fraction of the chord), "
                f"but {comma_list(map(str, value))} was given"
            )
        return tuple(value)

    def __post_init__(self) -> None:
        kind = self.kind
        if self.release is not None and kind is not records.TrialKind.RINGDOWN:
            raise ValueError(
                f"the trial {self.name!r} is not a ring-down and cannot have a `release`"
            )
        recorded_in_time = (records.TrialKind.FORCED, records.TrialKind.DRIVEN)
        if self.begins is not None and kind not in recorded_in_time:
            raise ValueError(
                f"the trial {self.name!r} is {kind.value}, but `begins` is for forced and driven "
                "trials; a ring-down states it by its `release`"
            )
        if self.hold is not None and kind is not records.TrialKind.FORCED:
            raise ValueError(
                f"the trial {self.name!r} is {kind.value}, but its `hold` is for the force of a "
                "forced trial: for a driven trial, set it in its [[input]]"
            )
        for region, loss in self.health.items():
            if region != "deviation" and loss > 1.0:
                raise ValueError(
                    f"the loss of {region!r} is a fraction from 0 to 1, but {loss:g} was given"
                )


def _first_repeated(names: Iterable[str]) -> str | None:
    """Return the alphabetically first name that occurs more than once; None if there is none."""
    repeated_names = [name for name, count in Counter(names).items() if count > 1]
    return min(repeated_names, default=None)


class CampaignSection(Section):
    """The whole file."""

    model_config = pydantic.ConfigDict(strict=False)

    format: Literal[1]
    """Version of the format."""
    name: str
    """Title of the campaign."""
    force_unit: Annotated[Name, pydantic.AfterValidator(_checked_force_unit)] = FORCE_UNIT
    """Unit of the column `force` of all tables."""
    reference_temperature: Annotated[Number, pydantic.Field(ge=-273.15)] | None = None
    """Temperature at which the model holds [degC]."""
    parameters: dict[Name, StatedPriorSection] = pydantic.Field(default_factory=dict)
    """Prior of parameters of the model, by their names, in place of the model's own."""
    noise: NoiseFileSection | None = None
    """The noise record: a table of samples at rest."""
    channel: Annotated[tuple[ChannelInFile, ...], pydantic.Field(min_length=1), LIST]
    """What is measured."""
    input: Annotated[
        tuple[Annotated[records.RecordedInput, pydantic.AfterValidator(_checked_input)], ...], LIST
    ] = ()
    """Inputs of a driven trial, or of a static trial of an FMU."""
    trial: Annotated[tuple[TrialSection, ...], pydantic.Field(min_length=1), LIST]
    """The records."""
    event: Annotated[tuple[Event, ...], LIST] = ()
    """What happened at known times."""
    remarks: Annotated[tuple[str, ...], LIST] = ()
    """Sentences that are kept with the campaign, and that commands and reports repeat."""
    provenance: Annotated[tuple[str, ...], LIST] = ()
    """Sentences on the files that the campaign was imported from, which no command prints."""
    loggers: dict[Name, Annotated[tuple[Name, ...], LIST]] = pydantic.Field(default_factory=dict)
    """Channels and inputs that share a clock, by the name of their logger; "force" is the force of
    forced trials."""
    accept: Accepted = ()
    """Faults of the data that are accepted in all channels and trials."""

    @property
    def columns(self) -> tuple[records.InTables, ...]:
        """Channels and inputs."""
        return (*self.channel, *self.input)

    def checks(self) -> Iterator[Check]:
        """Yield the checks that concern several tables of the file, see `Section.checks`."""
        for table in ("channel", "input", "trial"):
            repeated = _first_repeated(section.name for section in getattr(self, table))
            yield repeated, f"there is more than one {table} called {repeated!r}: rename one"
        yield from self._column_checks()
        yield from self._logger_checks()
        yield from self._unknown_channels()

    def _has_trial_of(self, *kinds: records.TrialKind) -> bool:
        """Return whether there is a trial of any of these kinds."""
        return any(trial.kind in kinds for trial in self.trial)

    def _column_checks(self) -> Iterator[Check]:
        """Yield the checks of inputs and channels: which columns they read, and in which units.

        Inputs need a trial that uses them. No two inputs or channels may read the same column, and
        a channel none in which trials have their loads. All temperatures must have one unit.
        """
        kinds_with_inputs = (records.TrialKind.DRIVEN, records.TrialKind.STATIC)
        no_trial_has_inputs = bool(self.input) and not self._has_trial_of(*kinds_with_inputs)
        yield (
            no_trial_has_inputs,
            '[[input]] is for trials of the kind "driven" or "static", but there is none',
        )
        repeated = _first_repeated(recorded_input.table_column for recorded_input in self.columns)
        readers = "channel or input" if self.input else "channel"
        yield (
            repeated,
            f"more than one {readers} reads the column {repeated!r}: give each its own `column`",
        )
        # only static and forced trials read the column `force`; in a driven trial, a channel may
        # have it for a load cell
        reads_force = self._has_trial_of(records.TrialKind.STATIC, records.TrialKind.FORCED)
        reserved = {name for name in INPUT_COLUMNS if name != "force" or reads_force}
        for channel in self.channel:
            yield (
                channel.table_column in reserved,
                f"the column {channel.table_column!r} holds an input of the trial: "
                f"give the channel {channel.name!r} another column",
            )
        temperatures = [
            reader for reader in self.columns if reader.quantity is records.Quantity.TEMPERATURE
        ]
        count_in_kelvin = sum(usual_name(reader.unit) == "K" for reader in temperatures)
        yield (
            0 < count_in_kelvin < len(temperatures),
            "temperatures are given in degC and in K: use one of the two units for all of them",
        )

    def _unknown_channels(self) -> Iterator[Check]:
        """Yield the names in `channels` and `left_out` of trials that are not names of channels."""
        channel_names = {channel.name for channel in self.channel}
        for trial in self.trial:
            for name in (*(trial.channels or ()), *trial.left_out):
                yield (
                    name not in channel_names,
                    f"the trial {trial.name!r} names the channel {name!r}, "
                    f"which is not among the channels {', '.join(sorted(channel_names))}",
                )

    def _logger_checks(self) -> Iterator[Check]:
        """Yield the checks on the key `loggers`: each channel and input must be on one logger."""
        if not self.loggers:
            return
        inputs = {recorded_input.name for recorded_input in self.input}
        if self._has_trial_of(records.TrialKind.FORCED):
            inputs.add("force")
        expected_names = [*(channel.name for channel in self.channel), *sorted(inputs)]
        logged = [name for names in self.loggers.values() for name in names]
        for name in logged:
            yield (
                name not in expected_names,
                f"`loggers` names {name!r}, but the channels and inputs are "
                f"{', '.join(expected_names)}",
            )
        for name in expected_names:
            logger_count = "more than one" if name in logged else "none"
            yield (
                logged.count(name) != 1,
                f"{name!r} must be on one of the `loggers`, but it is on {logger_count}",
            )
        loggers_of_inputs = [names for names in self.loggers.values() if inputs.intersection(names)]
        yield (
            len(loggers_of_inputs) > 1,
            "all inputs must be on one of the `loggers`, but they are on several",
        )


def parse_campaign(table: JsonRecord, source: str) -> CampaignSection:
    """Check the content of a campaign's TOML file, and return it as a record.

    Parameters
    ----------
    table : mapping
        The content, as the TOML reader gives it.
    source : str
        Name of the file, for messages.

    Raises
    ------
    CampaignFileError
        If the content breaks the schema; the sentence names file and key.
    """
    version = table.get("format", FORMAT)
    if version != FORMAT or isinstance(version, bool):
        raise CampaignFileError(
            f"{source}: `format` is {version!r}; this version reads campaigns with `format = "
            f"{FORMAT}`."
        )
    return validate(CampaignSection, dict(table), source, CampaignFileError, what="a campaign")
