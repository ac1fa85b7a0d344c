"""`residuals.nc`: measured, predicted and residual values of every trial, with units (NetCDF-4).

One group for each trial (`trial_001` ..) with its name as an attribute, and a group `noise` for what was
recorded of the noise.
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
from discrepancy.campaign.records import USUAL_REGIONS, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.campaign.units import UNITS
from discrepancy.errors import DiscrepancyError, VerdictFileError, said
from discrepancy.location.residuals import FittedTrial, ResidualSet
from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes
from reporting.netcdf import read_groups
from reporting.words import one_line

RESIDUALS_NAME = "residuals.nc"

SCHEMA = "uav-twin residuals 1"
"""Value of the attribute `schema` of the root."""

_DAMAGED = (
    DamagedFileError, KeyError, TypeError, ValueError, AttributeError, RecursionError, DiscrepancyError,
)  # fmt: skip
_PLAIN = ("name", "output", "gain_deviation", "offset_deviation", "station", "chord")
"""What the file has of a channel as it is."""
_NOTE = "unit of each channel: see the coordinate `unit`"
_ARRAYS: dict[str, dict[str, dict[str, Any]]] = tomllib.loads(
    Path(__file__).with_suffix(".toml").read_text("utf-8")
)
"""Dimensions, unit and words of the arrays of a trial and of its fit, by name."""


def write_residuals(path: Path, residuals: ResidualSet, attributes: Mapping[str, str] | None = None) -> Path:
    """Write a set of residuals, whole or not at all.

    Parameters
    ----------
    path : Path
        Destination.
    residuals : ResidualSet
        All trials; sensitivities are not stored.
    attributes : mapping of str to str, optional
        Further attributes of the root, such as the hypothesis, the data hash and the command.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    root = {
        **(attributes or {}),
        "schema": SCHEMA,
        "channels": json.dumps([_channel_row(channel) for channel in residuals.channels.values()]),
    }
    groups: dict[str, xr.Dataset] = {"/": xr.Dataset(attrs=root)}
    for number, item in enumerate(residuals.trials, start=1):
        groups[f"trial_{number:03d}"] = _dataset(item, residuals.channels)
    for number, (name, channel) in enumerate(residuals.channels.items(), start=1):
        if channel.noise is not None and channel.noise.samples is not None:
            groups[f"noise/channel_{number:03d}"] = xr.Dataset(
                {"noise": ("sample", channel.noise.samples, {"units": UNITS[channel.quantity].si})},
                attrs={"channel": name, "interval": channel.noise.interval or float("nan")},
            )
    return atomic_write_bytes(path, bytes(xr.DataTree.from_dict(groups).to_netcdf(engine="h5netcdf")))


def read_residuals(path: Path) -> ResidualSet:
    """Read what `write_residuals` wrote; values are equal to the last bit, sensitivities are not there.

    Raises
    ------
    VerdictFileError
        If the file is missing, damaged or of another schema.
    """
    path = Path(path)
    if not path.is_file():
        raise VerdictFileError(f"There is no file {path}; give the one that the discrepancy workflow left.")
    try:
        tree = read_groups(path)
        schema = tree.attrs.get("schema")
        if schema == SCHEMA:
            groups = {name: group.to_dataset() for name, group in tree.children.items()}
            noise = {
                str(group.attrs["channel"]): group.to_dataset()
                for group in (
                    tree["noise"].children.values() if groups.pop("noise", None) is not None else ()
                )
            }
            channels = {row["name"]: _channel(row, noise) for row in json.loads(tree.attrs["channels"])}
            return ResidualSet(channels, tuple(_trial(groups[name]) for name in sorted(groups)))
    except _DAMAGED as error:
        reason = f"{type(error).__name__}: {one_line(error)}"
        raise VerdictFileError(said("models.residuals_file", path=path, reason=reason)) from error
    raise VerdictFileError(f"{path} has the schema {schema!r}, but {SCHEMA!r} is needed.")


def _channel_row(channel: Channel) -> dict[str, Any]:
    noise = channel.noise
    recorded = noise and [noise.standard_deviation, noise.degrees_of_freedom, noise.interval, noise.source]
    # JSON as Python writes it knows Infinity; this text is read by Python only.
    return {"quantity": channel.quantity, **{key: getattr(channel, key) for key in _PLAIN}, "noise": recorded}


def _channel(row: Mapping[str, Any], samples: Mapping[str, xr.Dataset]) -> Channel:
    noise = None
    if row["noise"] is not None:
        deviation, freedom, interval, source = row["noise"]
        recorded = samples[row["name"]]["noise"].values if row["name"] in samples else None
        noise = NoiseRecord(deviation, freedom, recorded, interval, source)
    return Channel(quantity=Quantity(row["quantity"]), noise=noise, **{key: row[key] for key in _PLAIN})


def _dataset(item: FittedTrial, channels: Mapping[str, Channel]) -> xr.Dataset:
    trial = item.trial
    variables: dict[str, Any] = {
        "measured": (("row", "channel"), trial.values, {"long_name": "measured value", "comment": _NOTE}),
        "used": (("row", "channel"), item.used.astype(np.int8), {"long_name": "1 where the sample counts"}),
    }
    for record, part in ((trial, "trial"), (item, "fit")):
        for name, known in _ARRAYS[part].items():
            if (values := getattr(record, name)) is not None:
                words = {key: text for key, text in known.items() if key != "dimensions"}
                variables[name] = (known["dimensions"], values, words)
    said: dict[str, Any] = {
        "name": trial.name, "kind": trial.kind.value, "run": trial.run, "start": trial.start,
        "held_out": int(trial.held_out), "load_place": json.dumps(trial.load_place),
        "regions": json.dumps(trial.regions),
    }  # fmt: skip
    if trial.release is not None:
        said["release"] = json.dumps(astuple(trial.release))
    coordinates = {
        "channel": ("channel", list(trial.channels)),
        "unit": ("channel", [UNITS[channels[name].quantity].si for name in trial.channels]),
    }
    return xr.Dataset(variables, coords=coordinates, attrs=said).set_coords("time")


def _trial(group: xr.Dataset) -> FittedTrial:
    attributes = group.attrs
    rows: dict[str, Any] = {name: group[name].values for name in _ARRAYS["trial"]}
    for name, values in rows.items():
        if not np.all(np.isfinite(values)):
            raise ValueError(f"{name} is not finite")
    place = json.loads(attributes["load_place"])
    trial = Trial(
        name=str(attributes["name"]),
        kind=TrialKind(attributes["kind"]),
        channels=tuple(str(name) for name in group["channel"].values),
        values=group["measured"].values,
        used=group["used"].values.astype(bool),
        load_place=place if isinstance(place, str) else (float(place[0]), float(place[1])),
        start=float(attributes["start"]),
        run=str(attributes["run"]),
        release=Release(*json.loads(attributes["release"])) if "release" in attributes else None,
        held_out=bool(attributes["held_out"]),
        regions=tuple(json.loads(attributes["regions"])) if "regions" in attributes else USUAL_REGIONS,
        **rows,
    )
    found = {name: group[name].values for name in _ARRAYS["fit"].keys() - {"standardised"} if name in group}
    return FittedTrial(trial, **found)
