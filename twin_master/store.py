"""The run store: NetCDF for programs, CSV for people, a summary; every file whole or not there."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes, atomic_write_text
from twin_master.results import MissionResult, to_datatree
from twin_master.run_folder import SUMMARY_NAME, to_json
from twin_master.summary import Figure, to_record

Float = NDArray[np.float64]

RUN_NAME = "run.nc"
TIMING_NAME = "timing.json"
CSV_FOLDER = "csv"
MICROSTRAIN = 1.0e6
PERCENT = 100.0


def write_run(folder: Path, tree: xr.DataTree) -> Path:
    """Write `run.nc`; the bytes depend on nothing but the tree.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    return atomic_write_bytes(folder / RUN_NAME, bytes(tree.to_netcdf(engine="h5netcdf")))


def read_run(folder: Path) -> xr.DataTree:
    """Return the groups of a run, loaded into memory.

    Raises
    ------
    DamagedFileError
        There is no whole `run.nc`.
    """
    path = folder / RUN_NAME
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load()
    except (OSError, ValueError) as error:
        raise DamagedFileError(
            f"{path} is not a whole run ({error}): resume the run or fly it again."
        ) from error


def write_tables(folder: Path, tree: xr.DataTree, role: str) -> list[Path]:
    """Write the CSV files: strains in microstrain, stiffness losses in percent, units in the header.

    Parameters
    ----------
    folder
        The run folder.
    tree
        Groups of the run.
    role
        Name of the observed quantity, such as `strain`.
    """
    steps = tree["observed"]["step"].values
    regions = [str(name) for name in tree["truth"]["region"].values]
    controls = [str(name) for name in tree["policy"]["control"].values]
    flown = tree["observed"]["control_index"].values
    sensors = tree["observed"]["sensor"].values
    strain_header = ["step", *(f"{role}_{sensor}_microstrain" for sensor in sensors)]

    def strains(values: Float) -> list[list[str]]:
        return [
            [str(step), *map(_number, row)] for step, row in zip(steps, values * MICROSTRAIN, strict=True)
        ]

    health = ["step"]
    for name in regions:
        health += [
            f"{name}_true_percent",
            *(
                f"{name}_{kind}_{figure}_percent"
                for kind in ("filtered", "smoothed")
                for figure in ("mean", "sd")
            ),
        ]
    columns = [tree["truth"]["state"].values]
    for kind in ("filtered", "smoothed"):
        columns += [tree[kind]["mean"].values, tree[kind]["standard_deviation"].values]
    stacked = np.stack(columns, axis=-1).reshape(len(steps), -1) * PERCENT
    rewards = [str(name) for name in tree["filtered"]["reward"].values]
    decision = [
        [
            str(step),
            controls[flown[index]],
            *(_number(v) for v in tree["filtered"]["reward_mean"].values[index]),
        ]
        for index, step in enumerate(steps)
    ]
    levels = [tree["policy"][name].values * PERCENT for name in regions]
    policy = [
        [*(_number(level[state]) for level in levels), controls[tree["policy"]["control_index"].values[state]],
         *(_number(v) for v in tree["policy"]["action_value"].values[state])]
        for state in range(len(levels[0]))
    ]  # fmt: skip
    tables: dict[str, tuple[list[str], list[list[str]]]] = {
        "observed": (strain_header, strains(tree["observed"][role].values)),
        "estimated": (strain_header, strains(tree["filtered"]["quantity_mean"].values)),
        "true": (strain_header, strains(tree["truth"][role].values)),
        "health": (health, [[str(s), *map(_number, row)] for s, row in zip(steps, stacked, strict=True)]),
        "decisions": (["step", "control", *(f"{name}_reward" for name in rewards)], decision),
        "policy": (
            [
                *(f"{name}_percent" for name in regions),
                "control",
                *(f"action_value_{name}" for name in controls),
            ],
            policy,
        ),
    }
    return [
        atomic_write_text(folder / CSV_FOLDER / f"{name}.csv", _csv(header, rows))
        for name, (header, rows) in tables.items()
    ]


def _number(value: float) -> str:
    """Return a number for people; empty where nothing was received."""
    return "" if np.isnan(value) else f"{value:.6g}"


def _csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()


def write_summary(folder: Path, figures: Sequence[Figure], heading: Mapping[str, Any]) -> Path:
    """Write `summary.json`: each figure beside its reference."""
    return atomic_write_text(folder / SUMMARY_NAME, to_json(to_record(figures, heading)))


def write_timing(folder: Path, timing: Mapping[str, Any]) -> Path:
    """Write `timing.json`, the only file with wall-clock figures."""
    return atomic_write_text(folder / TIMING_NAME, to_json(timing))


def store_mission(
    folder: Path,
    result: MissionResult,
    attributes: Mapping[str, Any],
    write_field: Callable[[Path], None] | None = None,
) -> xr.DataTree:
    """Write `run.nc`, the CSV files and, where a finite element model flew, `wing.vtu`.

    Parameters
    ----------
    folder
        The run folder.
    result
        The mission.
    attributes
        Attributes of the root of `run.nc`.
    write_field
        Writes the VTU file to the path that it is given.
    """
    tree = to_datatree(result, attributes)
    write_run(folder, tree)
    write_tables(folder, tree, result.scenario.observation.role)
    if write_field is not None:
        write_field(folder / "wing.vtu")
    return tree
