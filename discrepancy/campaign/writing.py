"""Writing a campaign as a folder that `campaign.reading.read_campaign` reads back to the last bit."""

from __future__ import annotations

import json
import re
from math import isinf
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from discrepancy.campaign.reading import CAMPAIGN_FILE
from discrepancy.campaign.records import (
    Campaign,
    Channel,
    Hold,
    RecordedInput,
    Release,
    Start,
    Trial,
    TrialKind,
)
from discrepancy.campaign.schema import FORMAT, input_columns
from discrepancy.campaign.units import UNITS, in_unit, sum_text
from discrepancy.errors import CampaignFileError
from reporting.files import atomic_write_text
from reporting.table_file import table_text

FloatArray = NDArray[np.float64]
NOISE_FILE = "noise.csv"
"""Name of the table of samples at rest."""


def write_campaign(campaign: Campaign, folder: str | Path) -> Path:
    """Write a campaign; `read_campaign` gives it back, equal to the last bit but for its hash.

    Strain is written in microstrain, displacement in mm, the rest in SI. `campaign.toml` comes last, so that
    a folder that was not finished is no campaign.

    Parameters
    ----------
    campaign : Campaign
        With remarks and readings left out.
    folder : path
        Made if it is missing; files of the same names are replaced.

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
    files = [f"{number:02d}_{_slug(trial.name)}.csv" for number, trial in enumerate(campaign.trials, start=1)]
    texts = {file: _trial_table(campaign, trial) for file, trial in zip(files, campaign.trials, strict=True)}
    noise = _noise_table(campaign)
    if noise:
        texts[NOISE_FILE] = noise[0]
    texts[CAMPAIGN_FILE] = _campaign_text(campaign, files, noise[1] if noise else None)
    for name, text in texts.items():
        atomic_write_text(folder / name, text)
    return folder


def _slug(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40] or "trial"


# ---------------------------------------------------------------- tables


def _trial_table(campaign: Campaign, trial: Trial) -> str:
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
                "temperature to write "
                "them with."
            )
        reference = campaign.reference_temperature
        columns["temperature"] = [sum_text(reference, value) for value in trial.temperature.tolist()]
    for index, name in enumerate(("z1", "z2")):
        if np.any(trial.health[:, index] != 0.0):
            columns[name] = _plain(trial.health[:, index])
        if np.any(trial.health_deviation[:, index] != 0.0):
            columns[f"{name}_deviation"] = _plain(trial.health_deviation[:, index])
    for item in trial.inputs:
        columns[item.name] = _plain(item.values)
    for index, name in enumerate(trial.channels):
        columns[name] = _in_unit(trial.values[:, index], campaign.channels[name])
    return table_text(list(columns), list(columns.values()))


def _plain(values: FloatArray) -> list[str]:
    return [repr(value) for value in values.tolist()]


def _in_unit(values: FloatArray, channel: Channel) -> list[str]:
    unit = UNITS[channel.quantity].written
    return [in_unit(value, channel.quantity, unit) for value in values.tolist()]


def _noise_table(campaign: Campaign) -> tuple[str, float] | None:
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
            "their "
            "standard deviations."
        )
    longest = max(len(samples) for samples, _ in recorded.values())
    columns = {"time": [repr(interval * number) for number in range(longest)]}
    for name, (samples, _) in recorded.items():
        cells = _in_unit(samples, campaign.channels[name])
        columns[name] = cells + [""] * (longest - len(cells))
    return table_text(list(columns), list(columns.values())), interval


# ---------------------------------------------------------------- TOML


def _campaign_text(campaign: Campaign, files: list[str], noise_interval: float | None) -> str:
    lines = [f"format = {FORMAT}", f"name = {_quoted(campaign.name)}"]
    if campaign.reference_temperature is not None:
        lines.append(f"reference_temperature = {_number(campaign.reference_temperature)}  # degC")
    if campaign.remarks:
        lines += ["remarks = [", *(f"    {_quoted(remark)}," for remark in campaign.remarks), "]"]
    for name, (mean, deviation) in campaign.parameters.items():
        lines += ["", f"[parameters.{_quoted(name)}]"]
        lines += [f"mean = {_number(mean)}", f"deviation = {_number(deviation)}"]
    if noise_interval is not None:
        lines += [
            "",
            "[noise]",
            f"file = {_quoted(NOISE_FILE)}",
            f"interval = {_number(noise_interval)}  # s",
        ]
    if campaign.loggers:
        lines += ["", "[loggers]"]
        for name, members in campaign.loggers.items():
            lines.append(f"{_quoted(name)} = {_list([_quoted(member) for member in members])}")
    for channel in campaign.channels.values():
        lines += ["", "[[channel]]", *_channel_lines(channel)]
    inputs = {item.name: item for trial in campaign.trials for item in trial.inputs}
    for item in inputs.values():
        lines += ["", "[[input]]", *_input_lines(item)]
    order = list(campaign.channels)
    for trial, file in zip(campaign.trials, files, strict=True):
        lines += ["", "[[trial]]", *_trial_lines(trial, file, order)]
    for event in campaign.events:
        trials = _list([_quoted(name) for name in event.trials])
        lines += ["", "[[event]]", f"name = {_quoted(event.name)}", f"trials = {trials}"]
        lines += [f"time = {_number(event.time)}"]
        lines += [] if event.until is None else [f"until = {_number(event.until)}"]
    return "\n".join(lines) + "\n"


def _channel_lines(channel: Channel) -> list[str]:
    unit = UNITS[channel.quantity].written
    values: dict[str, str] = {
        "name": _quoted(channel.name),
        "quantity": _quoted(channel.quantity.value),
        "unit": _quoted(unit),
        "output": _quoted(channel.output),
    }
    for name in ("station", "chord"):
        place = getattr(channel, name)
        if place is not None:
            values[name] = _number(place)
    if channel.gain_deviation:
        values["gain_deviation"] = (
            '"free"' if isinf(channel.gain_deviation) else _number(channel.gain_deviation)
        )
    if channel.offset_deviation:
        values["offset_deviation"] = (
            '"free"'
            if isinf(channel.offset_deviation)
            else _toml_float(in_unit(channel.offset_deviation, channel.quantity, unit))
        )
    record = channel.noise
    if record is not None and record.samples is None:
        deviation = _toml_float(in_unit(record.standard_deviation, channel.quantity, unit))
        freedom = (
            ""
            if isinf(record.degrees_of_freedom)
            else (f", degrees_of_freedom = {_number(record.degrees_of_freedom)}")
        )
        source = "" if record.source == "stated" else f", source = {_quoted(record.source)}"
        values["noise"] = f"{{ standard_deviation = {deviation}{freedom}{source} }}"
    return [f"{key} = {value}" for key, value in values.items()]


def _input_lines(item: RecordedInput) -> list[str]:
    lines = [
        f"name = {_quoted(item.name)}",
        f"quantity = {_quoted(item.quantity.value)}",
        f"unit = {_quoted(UNITS[item.quantity].si)}",
    ]
    if item.hold is not None:
        lines.append(f"hold = {_quoted(item.hold.value)}")
    if item.quantity.moving and item.hold is not Hold.SMOOTH:
        lines.append("reference = true")
    return [
        *lines,
        *([f"offset_deviation = {_number(item.offset_deviation)}"] if item.offset_deviation else []),
    ]


def _trial_lines(trial: Trial, file: str, order: list[str]) -> list[str]:
    values: dict[str, str] = {
        "name": _quoted(trial.name),
        "kind": _quoted(trial.kind.value),
        "file": _quoted(file),
    }
    if trial.run:
        values["run"] = _quoted(trial.run)
    if trial.held_out:
        values["held_out"] = "true"
    if trial.noise_factor != 1.0:
        values["noise_factor"] = _number(trial.noise_factor)
    if trial.start or not trial.is_dynamic:
        values["start"] = _number(trial.start)
    if trial.kind is TrialKind.DRIVEN or trial.begins is not Start.SETTLED:
        values["begins"] = _quoted(trial.begins.value)
    if trial.hold is not None:
        values["hold"] = _quoted(trial.hold.value)
    place = trial.load_place
    if place != "tip_load":
        values["load_place"] = (
            _quoted(place) if isinstance(place, str) else f"[{_number(place[0])}, {_number(place[1])}]"
        )
    if list(trial.channels) != [name for name in order if name in trial.channels]:
        values["channels"] = _list([_quoted(name) for name in trial.channels])
    left_out = {
        name: (np.flatnonzero(~trial.used[:, index]) + 1).tolist()
        for index, name in enumerate(trial.channels)
    }
    rows = [
        f"{_quoted(name)} = {_list([str(n) for n in numbers])}"
        for name, numbers in left_out.items()
        if numbers
    ]
    if rows:
        values["left_out"] = f"{{ {', '.join(rows)} }}"
    if trial.release is not None:
        values["release"] = _release_text(trial.release)
    return [f"{key} = {value}" for key, value in values.items()]


def _release_text(release: Release) -> str:
    return (
        f"{{ displacement = {_number(release.displacement)}, deviation = {_number(release.deviation)}, "
        f"at_rest = {'true' if release.at_rest else 'false'}, mode_count = {release.mode_count}, "
        f"time_zero_deviation = {_number(release.time_zero_deviation)} }}"
    )


def _list(items: list[str]) -> str:
    return f"[{', '.join(items)}]"


def _number(value: float) -> str:
    return _toml_float(repr(float(value)))


def _toml_float(text: str) -> str:
    """Return the text of a float as TOML has it: `E+5` is not one of its exponents after a bare point."""
    mantissa, letter, exponent = text.lower().partition("e")
    if mantissa.endswith("."):
        mantissa += "0"
    return f"{mantissa}e{int(exponent)}" if letter else mantissa


def _quoted(text: str) -> str:
    """Return a TOML string; JSON's escapes are TOML's but for DEL, which JSON leaves bare."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
