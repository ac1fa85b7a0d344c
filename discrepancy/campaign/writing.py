"""Writing a campaign as a folder that `campaign.reading.read_campaign` reads back."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from discrepancy.campaign import records, schema
from discrepancy.campaign.reading import CAMPAIGN_FILE, complete_events
from discrepancy.campaign.trial_reading import no_reference_temperature_message
from discrepancy.campaign.units import (
    NEVER_CONVERTED,
    UNITS,
    conversion_factor,
    factor_to_si,
    quantities_of,
    usual_name,
)
from discrepancy.errors import CampaignFileError
from reporting.files import atomic_write_text
from reporting.formats.table_file import table_text
from reporting.formats.toml_file import toml_text

NOISE_FILE = "noise.csv"
"""Name of the table of samples at rest."""


_EXACT_DIGITS = 17
"""Significant digits from which a float is read again without a change."""
_SHOWN_DIGITS = 15
"""Significant digits that hide rounding errors: 4.387 stays 4.387 after a change of units."""


@dataclass(frozen=True)
class _FileUnits:
    """Units and digits of the numbers in the files of a campaign.

    Attributes
    ----------
    units : mapping of str to str
        The units of channels, inputs and `force` by name.
    digits : int
        The significant digits of values in these units.
    left_out_as_empty : bool
        True if readings that are left out become empty cells.
    """

    units: Mapping[str, str]
    digits: int
    left_out_as_empty: bool

    def in_unit(self, values: records.FloatArray, name: str, to_si: float) -> records.FloatArray:
        """Return values (N,) [SI] of a channel or input in its unit.

        The values are rounded to the digits of the files if `units` has the unit of this channel or
        input.

        Parameters
        ----------
        values : (N,) ndarray
            The values to convert [SI].
        name : str
            The name of the channel or input; "force" for the column of that name.
        to_si : float
            The factor from its unit to SI.
        """
        in_unit = values / to_si
        return self.rounded(in_unit) if name in self.units else in_unit

    def rounded(self, values: records.FloatArray) -> records.FloatArray:
        """Return values (N,) rounded to the digits of the files; with 17 digits, unchanged."""
        if self.digits == _EXACT_DIGITS:
            return values
        return np.array([float(f"{value:.{self.digits}g}") for value in values.tolist()])

    @property
    def force_unit(self) -> str:
        """Unit of the column `force`: the stated one if it is a unit of force, else N.

        A channel of another quantity, with a unit of its own, may also be called `force`.
        """
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
    """Write a campaign to a folder from which `read_campaign` reads it again.

    The campaign that is read again is equal up to rounding, except for its hash. Strain is written
    in microstrain, displacement in mm, and everything else in SI. `campaign.toml` is written last,
    so that an incomplete folder is not a campaign.

    Parameters
    ----------
    campaign : Campaign
        The campaign, with its remarks and the readings that are left out.
    folder : path
        The folder, made if it is missing; files of the same names are replaced.
    si : bool
        Whether strain and displacement are written in SI, too.
    units : mapping of str to str, optional
        Other units of channels and inputs by name, and of the force of static and forced trials by
        "force"; their values have 15 significant digits then.
    left_out_as_empty : bool
        Whether the cells of left-out readings are empty, instead of their being listed in
        `left_out`.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignFileError
        If the format cannot express the campaign: noise records have several intervals, or
        `parse_campaign` refuses it, as a channel with the name of an input.
    FileNotWrittenError, DiskFullError
        For the causes of `reporting.files.atomic_file`.
    """
    folder = Path(folder)
    channel_units = {
        name: _default_unit(channel, si) for name, channel in campaign.channels.items()
    }
    file_units = _FileUnits(
        units=channel_units | dict(units or {}),
        digits=_EXACT_DIGITS if units is None else _SHOWN_DIGITS,
        left_out_as_empty=left_out_as_empty,
    )
    files = [_file_name(number, trial) for number, trial in enumerate(campaign.trials, start=1)]
    texts = {}
    for file, trial in zip(files, campaign.trials, strict=True):
        texts[file] = _trial_table(campaign, trial, file_units)
    noise_interval = _noise_interval(campaign)
    if noise_interval is not None:
        texts[NOISE_FILE] = _noise_table(campaign, noise_interval, file_units)
    texts[CAMPAIGN_FILE] = _campaign_text(campaign, files, noise_interval, file_units)
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return folder


def _file_name(number: int, trial: records.Trial) -> str:
    """Return the name of a trial's file: its number and the letters and digits of its name."""
    slug = re.sub(r"[^a-z0-9]+", "_", trial.name.lower()).strip("_")[:40]
    return f"{number:02d}_{slug or 'trial'}.csv"


# ---------------------------------------------------------------- tables


def _trial_table(campaign: records.Campaign, trial: records.Trial, file_units: _FileUnits) -> str:
    """Return the table of a trial as text: its times, loads, temperatures, inputs and channels.

    Raises
    ------
    CampaignFileError
        If the trial has temperatures other than the reference temperature, but the campaign has no
        reference temperature.
    """
    columns: dict[str, records.FloatArray] = {}
    # rows of a static or flight trial need times only if they were not all taken at its start
    if trial.is_dynamic or np.any(trial.time != trial.start):
        columns["time"] = trial.time
    if trial.kind in (records.TrialKind.STATIC, records.TrialKind.FORCED):
        to_newton = conversion_factor(file_units.force_unit, "N")
        columns["force"] = file_units.in_unit(trial.force, "force", to_newton)
    if trial.kind is records.TrialKind.FLIGHT:
        columns["load_factor"] = trial.load_factor
    # the trial holds temperatures minus the reference temperature, the table the temperatures
    if np.any(trial.temperature != 0.0):
        if campaign.reference_temperature is None:
            raise CampaignFileError(no_reference_temperature_message(trial.name))
        columns["temperature"] = file_units.rounded(
            trial.temperature + campaign.reference_temperature
        )
    columns |= _loss_columns(trial)
    for recorded_input in trial.inputs:
        to_si = factor_to_si(recorded_input.quantity, _input_unit(recorded_input, file_units))
        columns[recorded_input.name] = file_units.in_unit(
            recorded_input.values, recorded_input.name, to_si
        )
    for index, name in enumerate(trial.channels):
        to_si = factor_to_si(campaign.channels[name].quantity, file_units.units[name])
        values = trial.values[:, index]
        if file_units.left_out_as_empty:
            values = np.where(trial.used[:, index], values, np.nan)
        columns[name] = file_units.in_unit(values, name, to_si)
    return table_text(columns)


def _loss_columns(trial: records.Trial) -> dict[str, records.FloatArray]:
    """Return a trial's stiffness losses and their standard deviations as columns (N,), by name.

    Columns of zeros are left out.
    """
    columns = {}
    for index, region in enumerate(trial.regions):
        name = region if region in records.USUAL_REGIONS else f"{schema.OF_REGION}{region}"
        if np.any(trial.health[:, index] != 0.0):
            columns[name] = trial.health[:, index]
        if np.any(trial.health_deviation[:, index] != 0.0):
            columns[f"{name}_deviation"] = trial.health_deviation[:, index]
    return columns


def _default_unit(record: records.InTables, in_si: bool) -> str:
    """Return the unit in which a channel or input is written if the user states none."""
    if usual_name(record.unit) in NEVER_CONVERTED:
        return usual_name(record.unit)
    units = UNITS[record.quantity]
    return units.si if in_si else units.written


def _input_unit(recorded_input: records.RecordedInput, file_units: _FileUnits) -> str:
    """Return the unit in which an input is written."""
    return file_units.units.get(recorded_input.name) or _default_unit(recorded_input, in_si=True)


def _noise_interval(campaign: records.Campaign) -> float | None:
    """Return the sampling interval of the samples at rest [s]; None if there are none.

    Raises
    ------
    CampaignFileError
        If they have several intervals, or uneven ones.
    """
    intervals = set()
    for channel in campaign.channels.values():
        if channel.noise is not None and channel.noise.samples is not None:
            intervals.add(channel.noise.interval)
    if not intervals:
        return None
    if len(intervals) > 1 or None in intervals:
        raise CampaignFileError(
            "Noise records can be written only if all have the same sampling interval: resample "
            "them, or keep their standard deviations."
        )
    return intervals.pop()


def _noise_table(campaign: records.Campaign, interval: float, file_units: _FileUnits) -> str:
    """Return the table of samples at rest as text; shorter records end with empty cells."""
    samples_of_channels = {
        name: channel.noise.samples
        for name, channel in campaign.channels.items()
        if channel.noise is not None and channel.noise.samples is not None
    }
    longest = max(len(samples) for samples in samples_of_channels.values())
    columns: dict[str, records.FloatArray] = {"time": interval * np.arange(float(longest))}
    for name, samples in samples_of_channels.items():
        to_si = factor_to_si(campaign.channels[name].quantity, file_units.units[name])
        columns[name] = np.full(longest, np.nan)
        columns[name][: len(samples)] = file_units.in_unit(samples, name, to_si)
    return table_text(columns)


# ---------------------------------------------------------------- TOML


def _campaign_text(
    campaign: records.Campaign,
    files: list[str],
    noise_interval: float | None,
    file_units: _FileUnits,
) -> str:
    """Return the text of `campaign.toml`, after a check that the reader would accept it.

    Parameters
    ----------
    campaign : Campaign
        The campaign: its trials, channels and noise records.
    files : list of str
        The names of the tables, one for each trial.
    noise_interval : float or None
        The sampling interval of the samples at rest [s]; None if there are none.
    file_units : _FileUnits
        The units in which the files are written.
    """
    source = f"The campaign {campaign.name!r}"
    inputs = {
        recorded_input.name: recorded_input
        for trial in campaign.trials
        for recorded_input in trial.inputs
    }
    priors = {}
    for name, (mean, deviation) in campaign.parameters.items():
        priors[name] = schema.StatedPriorSection.model_construct(mean=mean, deviation=deviation)
    noise = None
    if noise_interval is not None:
        noise = schema.NoiseFileSection(file=NOISE_FILE, interval=noise_interval)
    trials = []
    for trial, file in zip(campaign.trials, files, strict=True):
        trials.append(_trial_section(campaign, trial, file, file_units))
    section = schema.CampaignSection.model_construct(
        format=schema.FORMAT,
        name=campaign.name,
        force_unit=file_units.force_unit,
        reference_temperature=campaign.reference_temperature,
        remarks=campaign.remarks,
        provenance=campaign.provenance,
        parameters=priors,
        noise=noise,
        loggers=dict(campaign.loggers),
        accept=campaign.accept,
        channel=tuple(
            _channel_table(channel, file_units) for channel in campaign.channels.values()
        ),
        input=tuple(_input_table(recorded_input, file_units) for recorded_input in inputs.values()),
        trial=tuple(trials),
        event=tuple(complete_events(campaign.events, campaign.trials, source)),
    )
    content = section.model_dump(mode="json", exclude_defaults=True)
    schema.parse_campaign(content, source)  # raises for what the format cannot express
    return toml_text(content)


def _channel_table(channel: records.Channel, file_units: _FileUnits) -> records.Channel:
    """Return a channel as `campaign.toml` states it.

    A noise record with samples is left out: its samples are written to a table of their own.
    """
    noise = channel.noise
    if noise is not None and noise.samples is not None:
        noise = None
    if noise is not None:
        noise = replace(noise, interval=None, file="")
    return replace(channel, unit=file_units.units[channel.name], column="", noise=noise)


def _input_table(
    recorded_input: records.RecordedInput, file_units: _FileUnits
) -> records.RecordedInput:
    """Return an input as `campaign.toml` states it, with its `offset_deviation` in its unit there.

    A prescribed motion that is not smooth between its samples is written as a `reference`.
    """
    is_reference = (
        bool(recorded_input.quantity.motion_chain)
        and recorded_input.hold is not records.Hold.SMOOTH
    )
    unit = _input_unit(recorded_input, file_units)
    deviation = recorded_input.offset_deviation / factor_to_si(recorded_input.quantity, unit)
    return replace(
        recorded_input, unit=unit, offset_deviation=deviation, column="", reference=is_reference
    )


def _trial_section(
    campaign: records.Campaign, trial: records.Trial, file: str, file_units: _FileUnits
) -> schema.TrialSection:
    """Return the section [[trial]] of `campaign.toml` for a trial; default values are left out."""
    left_out: dict[str, tuple[int, ...]] = {}
    if not file_units.left_out_as_empty:
        for index, name in enumerate(trial.channels):
            rows = np.flatnonzero(~trial.used[:, index]) + 1  # files count rows from 1
            if rows.size:
                left_out[name] = tuple(rows.tolist())
    begins_as_stated = (
        trial.kind in (records.TrialKind.FORCED, records.TrialKind.DRIVEN)
        and not trial.begin_assumed
    )
    states_begin = begins_as_stated or trial.begins is not records.Start.SETTLED
    keys = {**trial.keys_in_file, "file": file}
    return schema.TrialSection(
        **keys,
        left_out=left_out,
        start=trial.start if trial.start or not trial.is_dynamic else None,
        begins=trial.begins if states_begin else None,
        channels=None if trial.channels == tuple(campaign.channels) else trial.channels,
    )
