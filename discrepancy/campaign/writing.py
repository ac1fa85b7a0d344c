"""Writing a campaign as a folder that `campaign.reading.read_campaign` reads back."""

import re
from dataclasses import asdict
from math import isinf
from pathlib import Path
from typing import Any

import numpy as np

from discrepancy.campaign.reading import CAMPAIGN_FILE
from discrepancy.campaign.records import (
    USUAL_REGIONS,
    Campaign,
    Channel,
    FloatArray,
    Hold,
    RecordedInput,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.schema import FORMAT, OF_REGION, input_columns
from discrepancy.campaign.units import UNITS, conversion_of
from discrepancy.errors import CampaignFileError
from reporting.files import atomic_write_text
from reporting.table_file import table_text
from reporting.toml_file import toml_text

NOISE_FILE = "noise.csv"
"""Name of the table of samples at rest."""


def write_campaign(campaign: Campaign, folder: str | Path, *, si: bool = False) -> Path:
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

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignFileError
        The campaign cannot be told in the format: temperatures without a reference, noise records with
        several intervals, or a channel that is called like an input.
    FileNotWrittenError, DiskFullError
        As `reporting.files.atomic_file`.
    """
    folder = Path(folder)
    for name in campaign.channels:
        if name in input_columns(trial.kind for trial in campaign.trials):
            raise CampaignFileError(
                f"A channel cannot be called {name!r} in a file, which is an input: rename it."
            )
    slugs = (re.sub(r"[^a-z0-9]+", "_", trial.name.lower()).strip("_")[:40] for trial in campaign.trials)
    files = [f"{number:02d}_{slug or 'trial'}.csv" for number, slug in enumerate(slugs, start=1)]
    texts = {
        file: _trial_table(campaign, trial, si) for file, trial in zip(files, campaign.trials, strict=True)
    }
    noise = _noise_table(campaign, si)
    if noise:
        texts[NOISE_FILE] = noise[0]
    texts[CAMPAIGN_FILE] = _campaign_text(campaign, files, noise[1] if noise else None, si)
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return folder


# ---------------------------------------------------------------- tables


def _trial_table(campaign: Campaign, trial: Trial, si: bool) -> str:
    columns: dict[str, list[str]] = {}
    if trial.is_dynamic or np.any(trial.time != trial.start):
        columns["time"] = _plain(trial.time)
    if trial.kind in (TrialKind.STATIC, TrialKind.FORCED):
        columns["force"] = _plain(trial.force)
    if trial.kind is TrialKind.FLIGHT:
        columns["load_factor"] = _plain(trial.load_factor)
    if np.any(trial.temperature != 0.0):
        if campaign.reference_temperature is None:
            raise CampaignFileError(
                f"The trial {trial.name!r} has temperatures, but the campaign has no reference "
                "temperature to write them with."
            )
        reference = campaign.reference_temperature
        columns["temperature"] = _plain(reference + trial.temperature)
    for index, region in enumerate(trial.regions):
        name = region if region in USUAL_REGIONS else f"{OF_REGION}{region}"
        if np.any(trial.health[:, index] != 0.0):
            columns[name] = _plain(trial.health[:, index])
        if np.any(trial.health_deviation[:, index] != 0.0):
            columns[f"{name}_deviation"] = _plain(trial.health_deviation[:, index])
    for item in trial.inputs:
        columns[item.name] = _plain(item.values)
    for index, name in enumerate(trial.channels):
        columns[name] = _in_unit(trial.values[:, index], campaign.channels[name], si)
    return table_text(list(columns), list(columns.values()))


def _plain(values: FloatArray) -> list[str]:
    return [repr(value) for value in values.tolist()]


def _unit(channel: Channel, si: bool) -> str:
    return UNITS[channel.quantity].si if si else UNITS[channel.quantity].written


def _in_unit(values: FloatArray, channel: Channel, si: bool) -> list[str]:
    return _plain(conversion_of(channel.quantity, _unit(channel, si)).from_si(values))


def _noise_table(campaign: Campaign, si: bool) -> tuple[str, float] | None:
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
        raise CampaignFileError(
            "Noise records can be written only if all have one sampling interval: resample them, or keep "
            "their standard deviations."
        )
    longest = max(len(samples) for samples, _ in recorded.values())
    columns = {"time": [repr(interval * number) for number in range(longest)]}
    for name, (samples, _) in recorded.items():
        cells = _in_unit(samples, campaign.channels[name], si)
        columns[name] = cells + [""] * (longest - len(cells))
    return table_text(list(columns), list(columns.values())), interval


# ---------------------------------------------------------------- TOML


def _campaign_text(campaign: Campaign, files: list[str], noise_interval: float | None, si: bool) -> str:
    inputs = {item.name: item for trial in campaign.trials for item in trial.inputs}
    noise = None if noise_interval is None else {"file": NOISE_FILE, "interval": noise_interval}
    order = list(campaign.channels)
    return toml_text(
        {
            "format": FORMAT,
            "name": campaign.name,
            "reference_temperature": campaign.reference_temperature,
            "remarks": campaign.remarks or None,
            "parameters": {
                name: {"mean": mean, "deviation": deviation}
                for name, (mean, deviation) in campaign.parameters.items()
            } or None,
            "noise": noise,
            "loggers": dict(campaign.loggers) or None,
            "channel": [_channel(channel, si) for channel in campaign.channels.values()],
            "input": [_input(item) for item in inputs.values()] or None,
            "trial": [
                _trial(trial, file, order) for trial, file in zip(campaign.trials, files, strict=True)
            ],
            "event": [
                {"name": event.name, "trials": event.trials, "time": event.time, "until": event.until}
                for event in campaign.events
            ] or None,
        }
    )  # fmt: skip


def _channel(channel: Channel, si: bool) -> dict[str, Any]:
    unit, record, noise = _unit(channel, si), channel.noise, None

    def printed(deviation: float) -> float | str:
        return "free" if isinf(deviation) else conversion_of(channel.quantity, unit).from_si(deviation)

    if record is not None and record.samples is None:
        freedom, source = record.degrees_of_freedom, record.source
        noise = {
            "standard_deviation": printed(record.standard_deviation),
            "degrees_of_freedom": None if isinf(freedom) else freedom,
            "source": None if source == "stated" else source,
        }
    gain = "free" if isinf(channel.gain_deviation) else channel.gain_deviation
    return {
        "name": channel.name, "quantity": channel.quantity, "unit": unit, "output": channel.output,
        "station": channel.station, "chord": channel.chord, "gain_deviation": gain or None,
        "offset_deviation": printed(channel.offset_deviation) if channel.offset_deviation else None,
        "noise": noise,
    }  # fmt: skip


def _input(item: RecordedInput) -> dict[str, Any]:
    return {
        "name": item.name, "quantity": item.quantity, "unit": UNITS[item.quantity].si, "hold": item.hold,
        "reference": True if item.quantity.moving and item.hold is not Hold.SMOOTH else None,
        "offset_deviation": item.offset_deviation or None,
    }  # fmt: skip


def _trial(trial: Trial, file: str, order: list[str]) -> dict[str, Any]:
    left_out = {
        name: (np.flatnonzero(~trial.used[:, index]) + 1).tolist() or None
        for index, name in enumerate(trial.channels)
    }
    driven = trial.kind is TrialKind.DRIVEN and not trial.begin_assumed
    said = driven or trial.begins is not Start.SETTLED
    in_order = list(trial.channels) == [name for name in order if name in trial.channels]
    return {
        "name": trial.name, "kind": trial.kind, "file": file, "run": trial.run or None,
        "held_out": trial.held_out or None,
        "noise_factor": None if trial.noise_factor == 1.0 else trial.noise_factor,
        "start": trial.start if trial.start or not trial.is_dynamic else None,
        "begins": trial.begins if said else None, "hold": trial.hold,
        "load_place": None if trial.load_place == "tip_load" else trial.load_place,
        "channels": None if in_order else trial.channels,
        "left_out": left_out if any(left_out.values()) else None,
        "release": None if trial.release is None else asdict(trial.release),
    }  # fmt: skip
