"""Writing a campaign as a folder that `campaign.reading.read_campaign` reads back."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from discrepancy.campaign import records, schema
from discrepancy.campaign.reading import CAMPAIGN_FILE, placed_events
from discrepancy.campaign.units import NEVER_CONVERTED, UNITS, conversion, conversion_of, quantities_of
from discrepancy.errors import CampaignFileError, said
from reporting.files import atomic_write_text
from reporting.table_file import table_text
from reporting.toml_file import toml_text

NOISE_FILE = "noise.csv"
"""Name of the table of samples at rest."""


_EXACT_DIGITS, _SHOWN_DIGITS = 17, 15
"""Digits that keep a float as it is, and that show 4.387 as such after it was in another unit."""


@dataclass(frozen=True)
class _Layout:
    """Units of channels, inputs and `force` in the files by name, and significant digits of their values."""

    units: Mapping[str, str]
    digits: int
    left_out_as_empty: bool

    def in_unit(self, values: records.FloatArray, name: str, to_si: float) -> records.FloatArray:
        """Return values [SI] of a channel or an input in its unit, of which one is `to_si`."""
        in_unit = values / to_si
        if self.digits == _EXACT_DIGITS or name not in self.units:
            return in_unit
        return np.array([float(f"{value:.{self.digits}g}") for value in in_unit.tolist()])

    @property
    def force_unit(self) -> str:
        """Unit of the column `force`; a channel of another quantity may be called so."""
        unit = self.units.get("force", schema.FORCE_UNIT)
        return unit if records.Quantity.FORCE in quantities_of(unit) else schema.FORCE_UNIT


def write_campaign(
    campaign: records.Campaign,
    folder: str | Path,
    *,
    si: bool = False,
    units: Mapping[str, str] | None = None,
    left_out_as_empty: bool = False,
) -> Path:
    """Write a campaign; `read_campaign` gives it back, equal to rounding but for its hash.

    Strain is written in microstrain, displacement in mm, the rest in SI (all, if asked for). `campaign.toml`
    comes last, so that a folder that was not finished is no campaign.

    Parameters
    ----------
    campaign : Campaign
        With remarks and readings left out.
    folder : path
        Made if it is missing; files of the same names are replaced.
    si : bool
        Write strain and displacement in SI, too.
    units : mapping of str to str, optional
        Unit of each channel and input in the files, by its name, in the place of these, and of the force of
        static and forced trials by "force"; their values have 15 significant digits then.
    left_out_as_empty : bool
        Leave the cells of readings empty that are left out, in the place of `left_out` of the trial.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignFileError
        The campaign cannot be told in the format: noise records with several intervals, or what
        `parse_campaign` refuses, such as a channel that is called like an input.
    FileNotWrittenError, DiskFullError
        As `reporting.files.atomic_file`.
    """
    folder = Path(folder)
    usual = {name: _unit(channel, si) for name, channel in campaign.channels.items()}
    layout = _Layout(
        units=usual | dict(units or {}),
        digits=_EXACT_DIGITS if units is None else _SHOWN_DIGITS,
        left_out_as_empty=left_out_as_empty,
    )
    slugs = (re.sub(r"[^a-z0-9]+", "_", trial.name.lower()).strip("_")[:40] for trial in campaign.trials)
    files = [f"{number:02d}_{slug or 'trial'}.csv" for number, slug in enumerate(slugs, start=1)]
    texts = {
        file: _trial_table(campaign, trial, layout)
        for file, trial in zip(files, campaign.trials, strict=True)
    }
    noise = _noise_table(campaign, layout)
    if noise:
        texts[NOISE_FILE] = noise[0]
    texts[CAMPAIGN_FILE] = _campaign_text(campaign, files, noise[1] if noise else None, layout)
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return folder


# ---------------------------------------------------------------- tables


def _trial_table(campaign: records.Campaign, trial: records.Trial, layout: _Layout) -> str:
    columns: dict[str, records.FloatArray] = {}
    if trial.is_dynamic or np.any(trial.time != trial.start):
        columns["time"] = trial.time
    if trial.kind in (records.TrialKind.STATIC, records.TrialKind.FORCED):
        columns["force"] = layout.in_unit(trial.force, "force", conversion(layout.force_unit, "N"))
    if trial.kind is records.TrialKind.FLIGHT:
        columns["load_factor"] = trial.load_factor
    if np.any(trial.temperature != 0.0):
        if campaign.reference_temperature is None:
            raise CampaignFileError(said("campaign.no_reference", trial=trial))
        columns["temperature"] = trial.temperature + campaign.reference_temperature
    for index, region in enumerate(trial.regions):
        name = region if region in records.USUAL_REGIONS else f"{schema.OF_REGION}{region}"
        for key, values in ((name, trial.health), (f"{name}_deviation", trial.health_deviation)):
            if np.any(values[:, index] != 0.0):
                columns[key] = values[:, index]
    for item in trial.inputs:
        to_si = conversion_of(item.quantity, _input_unit(item, layout))
        columns[item.name] = layout.in_unit(item.values, item.name, to_si)
    for index, name in enumerate(trial.channels):
        to_si = conversion_of(campaign.channels[name].quantity, layout.units[name])
        values = trial.values[:, index]
        if layout.left_out_as_empty:
            values = np.where(trial.used[:, index], values, np.nan)
        columns[name] = layout.in_unit(values, name, to_si)
    return table_text(columns)


def _unit(item: records.InTables, si: bool) -> str:
    if item.unit in NEVER_CONVERTED:
        return item.unit
    return UNITS[item.quantity].si if si else UNITS[item.quantity].written


def _input_unit(item: records.RecordedInput, layout: _Layout) -> str:
    return layout.units.get(item.name) or _unit(item, True)


def _noise_table(campaign: records.Campaign, layout: _Layout) -> tuple[str, float] | None:
    """Return the table of samples at rest and their interval, None without any."""
    recorded = {
        name: (channel.noise.samples, channel.noise.interval)
        for name, channel in campaign.channels.items()
        if channel.noise is not None and channel.noise.samples is not None
    }
    intervals = {interval for _, interval in recorded.values()}
    if not recorded:
        return None
    interval = intervals.pop()
    if intervals or interval is None:
        raise CampaignFileError(said("campaign.several_intervals"))
    longest = max(len(samples) for samples, _ in recorded.values())
    columns: dict[str, records.FloatArray] = {"time": interval * np.arange(float(longest))}
    for name, (samples, _) in recorded.items():
        columns[name] = np.full(longest, np.nan)
        to_si = conversion_of(campaign.channels[name].quantity, layout.units[name])
        columns[name][: len(samples)] = layout.in_unit(samples, name, to_si)
    return table_text(columns), interval


# ---------------------------------------------------------------- TOML


def _campaign_text(
    campaign: records.Campaign, files: list[str], noise_interval: float | None, layout: _Layout
) -> str:
    source = f"The campaign {campaign.name!r}"
    inputs = {item.name: item for trial in campaign.trials for item in trial.inputs}
    section = schema.CampaignSection.model_construct(
        format=schema.FORMAT,
        name=campaign.name,
        force_unit=layout.force_unit,
        reference_temperature=campaign.reference_temperature,
        remarks=campaign.remarks,
        parameters={
            name: schema.ParameterSection.model_construct(mean=mean, deviation=deviation)
            for name, (mean, deviation) in campaign.parameters.items()
        },
        noise=noise_interval and schema.NoiseFileSection(file=NOISE_FILE, interval=noise_interval),
        loggers=dict(campaign.loggers),
        accept=campaign.accept,
        channel=tuple(_channel(channel, layout) for channel in campaign.channels.values()),
        input=tuple(_input(item, layout) for item in inputs.values()),
        trial=tuple(_trial(campaign, *pair, layout) for pair in zip(campaign.trials, files, strict=True)),
        event=tuple(placed_events(campaign.events, campaign.trials, source)),
    )
    content = section.model_dump(mode="json", exclude_defaults=True)
    schema.parse_campaign(content, source)
    return toml_text(content)


def _channel(channel: records.Channel, layout: _Layout) -> records.Channel:
    """Return a channel as a file has it; samples at rest are in a table of their own."""
    noise = channel.noise
    if noise is not None:
        noise = None if noise.samples is not None else replace(noise, interval=None, file="")
    return replace(channel, unit=layout.units[channel.name], column="", noise=noise)


def _input(item: records.RecordedInput, layout: _Layout) -> records.RecordedInput:
    reference = bool(item.quantity.moving) and item.hold is not records.Hold.SMOOTH
    unit = _input_unit(item, layout)
    deviation = item.offset_deviation / conversion_of(item.quantity, unit)
    return replace(item, unit=unit, offset_deviation=deviation, column="", reference=reference)


def _trial(
    campaign: records.Campaign, trial: records.Trial, file: str, layout: _Layout
) -> schema.TrialSection:
    left_out = (
        {}
        if layout.left_out_as_empty
        else {
            name: tuple((np.flatnonzero(~trial.used[:, index]) + 1).tolist())
            for index, name in enumerate(trial.channels)
            if not trial.used[:, index].all()
        }
    )
    driven = trial.kind is records.TrialKind.DRIVEN and not trial.begin_assumed
    said = driven or trial.begins is not records.Start.SETTLED
    in_order = list(trial.channels) == [name for name in campaign.channels if name in trial.channels]
    return schema.TrialSection(
        **{**trial.said, "file": file}, left_out=left_out,
        start=trial.start if trial.start or not trial.is_dynamic else None,
        begins=trial.begins if said else None, channels=None if in_order else trial.channels,
    )  # fmt: skip
