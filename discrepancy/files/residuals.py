"""`residuals.nc`: measured, predicted and residual values of every trial, with units (NetCDF-4).

There is one group for each trial (`trial_001` and so on) with its name as an attribute, and a group
`noise` for the noise records of the channels.
"""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import (
    USUAL_REGIONS,
    Channel,
    FloatArray,
    NoiseRecord,
    Quantity,
    Trial,
    TrialKind,
)
from discrepancy.campaign.units import UNITS
from discrepancy.errors import DiscrepancyError, VerdictFileError
from discrepancy.location.residuals import FittedTrial, ResidualSet
from discrepancy.system.load_change import DEFAULT_PLACE
from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes
from reporting.formats.netcdf import read_groups
from reporting.json_file import JsonRecord
from reporting.words import one_line

RESIDUALS_NAME = "residuals.nc"

SCHEMA = "uav-twin residuals 1"
"""Value of the attribute `schema` of the root."""

_DAMAGED = (
    DamagedFileError,
    KeyError,
    TypeError,
    ValueError,
    AttributeError,
    RecursionError,
    DiscrepancyError,
)
_PLAIN_FIELDS = ("name", "output", "gain_deviation", "offset_deviation", "station", "chord")
"""Fields of a channel that are written unchanged."""
_NOTE = "unit of each channel: see the coordinate `unit`"
_ARRAYS: dict[str, dict[str, dict[str, object]]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
"""Dimensions and attributes of the arrays of a trial and of its fit, by name."""


def write_residuals(
    path: Path, residuals: ResidualSet, attributes: Mapping[str, str] | None = None
) -> Path:
    """Write a set of residuals to a NetCDF file, completely or not at all.

    Parameters
    ----------
    path : Path
        Destination.
    residuals : ResidualSet
        All trials; sensitivities are not stored.
    attributes : mapping of str to str, optional
        Further attributes of the root, such as the hypothesis, the data hash and the command.

    Returns
    -------
    Path
        The destination.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    channel_rows = [_channel_row(channel) for channel in residuals.channels.values()]
    root = {**(attributes or {}), "schema": SCHEMA, "channels": json.dumps(channel_rows)}
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(attrs=root)}
    for number, fitted_trial in enumerate(residuals.trials, start=1):
        groups[f"trial_{number:03d}"] = _dataset(fitted_trial, residuals.channels)
    for number, (name, channel) in enumerate(residuals.channels.items(), start=1):
        if channel.noise is not None and channel.noise.samples is not None:
            unit = UNITS[channel.quantity].si
            groups[f"noise/channel_{number:03d}"] = xr.Dataset(
                {"noise": ("sample", channel.noise.samples, {"units": unit})},
                attrs={"channel": name, "interval": channel.noise.interval or float("nan")},
            )
    content = xr.DataTree.from_dict(groups).to_netcdf(engine="h5netcdf")
    return atomic_write_bytes(path, bytes(content))


def read_residuals(path: Path) -> ResidualSet:
    """Read the residuals that `write_residuals` wrote; they are equal to the last bit.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged or of another schema.
    """
    path = Path(path)
    if not path.is_file():
        raise VerdictFileError(
            f"There is no file {path}; give the one that the discrepancy workflow left."
        )
    try:
        tree = read_groups(path)
        schema = tree.attrs.get("schema")
        if schema == SCHEMA:
            return _residual_set(tree)
    except _DAMAGED as error:
        raise VerdictFileError(
            f"{path} is damaged or is not a file of residuals ({type(error).__name__}: "
            f"{one_line(error)}); write it again."
        ) from error
    raise VerdictFileError(f"{path} has the schema {schema!r}, but {SCHEMA!r} is needed.")


def _residual_set(tree: xr.DataTree) -> ResidualSet:
    """Return the residuals in the groups of a file."""
    samples_at_rest = _samples_at_rest(tree)
    channels = {}
    for row in json.loads(tree.attrs["channels"]):
        name = row["name"]
        channels[name] = _channel_from_row(row, samples_at_rest.get(name))
    # every other group is a trial, and its name ends with its number
    groups_of_trials = sorted(set(tree.children) - {"noise"})
    trials = [_fitted_trial(tree[group].to_dataset()) for group in groups_of_trials]
    return ResidualSet(channels, tuple(trials))


def _samples_at_rest(tree: xr.DataTree) -> dict[str, FloatArray]:
    """Return the samples (n,) of the noise records in a file [channel's unit], by channel.

    The dictionary is empty if the file has no noise records.
    """
    samples: dict[str, FloatArray] = {}
    if "noise" in tree.children:
        for group in tree["noise"].children.values():
            channel = str(group.attrs["channel"])
            samples[channel] = group.to_dataset()["noise"].values
    return samples


def _channel_row(channel: Channel) -> dict[str, object]:
    """Return the entries of a channel in the file's attribute `channels`, without its samples.

    Deviations may be infinite, which Python's module `json` writes as `Infinity` and reads again.
    """
    noise_row = None
    if channel.noise is not None:
        noise = channel.noise
        noise_row = [
            noise.standard_deviation,
            noise.degrees_of_freedom,
            noise.interval,
            noise.source,
        ]
    plain_fields = {name: getattr(channel, name) for name in _PLAIN_FIELDS}
    return {"quantity": channel.quantity, **plain_fields, "noise": noise_row}


def _channel_from_row(row: JsonRecord, samples: FloatArray | None) -> Channel:
    """Return the channel that `_channel_row` wrote, with the samples (n,) of its noise record."""
    noise = None
    if row["noise"] is not None:
        deviation, freedom, interval, source = row["noise"]
        noise = NoiseRecord(
            standard_deviation=deviation,
            degrees_of_freedom=freedom,
            samples=samples,
            interval=interval,
            source=source,
        )
    plain_fields = {name: row[name] for name in _PLAIN_FIELDS}
    return Channel(quantity=Quantity(row["quantity"]), noise=noise, **plain_fields)


def _dataset(fitted_trial: FittedTrial, channels: Mapping[str, Channel]) -> xr.Dataset:
    """Return a trial as a group of a residual file: readings, prediction, residuals, attributes.

    Arrays that are None or empty are left out, and so is the load place of a trial without force.
    """
    trial = fitted_trial.trial
    by_row_and_channel = ("row", "channel")
    variables: dict[str, object] = {
        "measured": (
            by_row_and_channel,
            trial.values,
            {"long_name": "measured value", "comment": _NOTE},
        ),
        "used": (
            by_row_and_channel,
            fitted_trial.used.astype(np.int8),
            {"long_name": "1 where the sample counts"},
        ),
    }
    records: dict[str, Trial | FittedTrial] = {"trial": trial, "fit": fitted_trial}
    for table, record in records.items():
        for name, description in _ARRAYS[table].items():
            values = getattr(record, name)
            if values is not None and values.size:  # without regions there is no health
                attributes = {key: text for key, text in description.items() if key != "dimensions"}
                variables[name] = (description["dimensions"], values, attributes)
    attributes_of_trial: dict[str, object] = {
        "name": trial.name,
        "kind": trial.kind.value,
        "run": trial.run,
        "start": trial.start,
        "held_out": int(trial.held_out),
        "regions": json.dumps(trial.regions),
    }
    if trial.load_place != DEFAULT_PLACE or trial.release is not None or np.any(trial.force != 0.0):
        attributes_of_trial["load_place"] = json.dumps(trial.load_place)
    if trial.release is not None:
        attributes_of_trial["release"] = json.dumps(astuple(trial.release))
    units = [UNITS[channels[name].quantity].si for name in trial.channels]
    coordinates = {"channel": ("channel", list(trial.channels)), "unit": ("channel", units)}
    if trial.regions:
        coordinates["region"] = ("region", list(trial.regions))
    dataset = xr.Dataset(variables, coords=coordinates, attrs=attributes_of_trial)
    return dataset.set_coords("time")


def _fitted_trial(group: xr.Dataset) -> FittedTrial:
    """Read a trial with its prediction and residuals from the group that `_dataset` wrote.

    Raises `ValueError` if an array of the trial is not finite.
    """
    attributes = group.attrs
    arrays: dict[str, Any] = {
        name: group[name].values for name in _ARRAYS["trial"] if name in group
    }
    for name in ("health", "health_deviation"):
        arrays.setdefault(name, np.zeros((len(arrays["time"]), 0)))
    for name, values in arrays.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{name} is not finite")
    load_place = json.loads(attributes.get("load_place", json.dumps(DEFAULT_PLACE)))
    if not isinstance(load_place, str):
        load_place = (float(load_place[0]), float(load_place[1]))
    release = None
    if "release" in attributes:
        release = Release(*json.loads(attributes["release"]))
    regions = USUAL_REGIONS
    if "regions" in attributes:
        regions = tuple(json.loads(attributes["regions"]))
    trial = Trial(
        name=str(attributes["name"]),
        kind=TrialKind(attributes["kind"]),
        channels=tuple(str(name) for name in group["channel"].values),
        values=group["measured"].values,
        used=group["used"].values.astype(bool),
        load_place=load_place,
        start=float(attributes["start"]),
        run=str(attributes["run"]),
        release=release,
        held_out=bool(attributes["held_out"]),
        regions=regions,
        **arrays,
    )
    arrays_of_fit = {
        name: group[name].values
        for name in _ARRAYS["fit"]
        if name != "standardised" and name in group  # computed from the residuals
    }
    return FittedTrial(trial, **arrays_of_fit)
