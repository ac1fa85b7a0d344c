"""Sampling an FMU over a grid into an observation library: in several processes, resumable after a kill."""

import io
import itertools
import json
import os
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.instance_host import warn_without_sandbox
from fmu_asset.client.session import FmiAsset
from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text, explained_write_errors, hash_file
from reporting.folders import closing_lock, lock_folder
from reporting.json_file import parse_json
from reporting.progress import Stage, stage
from twin_master.assets.library_source import (
    FORMAT,
    KIND,
    RESERVED,
    ObservationLibrary,
    write_observation_library,
)
from twin_master.errors import MissionInputError, check_names, said
from twin_master.library.grid import GridSampler, SamplingGrid
from twin_master.network.transition import NUMBER, check_fits

PLAN_NAME, ROWS_NAME = "grid.json", "observations.npy"
_COPIES = 3  # of what was sampled: the blocks, all of them, and the library


@dataclass(frozen=True)
class SamplingOutcome:
    """A library that was sampled.

    Attributes
    ----------
    path : Path
        The file.
    library : ObservationLibrary
        Its content.
    kept_blocks, block_count : int
        Blocks that an interrupted sampling had finished, and all blocks.
    workers : int
        Processes.
    seconds : float
        Wall clock of the sampling itself.
    """

    path: Path
    library: ObservationLibrary
    kept_blocks: int
    block_count: int
    workers: int
    seconds: float


def blocks_folder(out: Path) -> Path:
    """Return where the finished blocks of a library that is being sampled are kept."""
    return out.with_name(f"{out.name}.blocks")


def sample_library(
    grid: SamplingGrid,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    replace_existing: bool = False,
) -> SamplingOutcome:
    """Ask an FMU for its observation at every point of a grid and write the library.

    The bytes of the file do not depend on the number of processes nor on interruptions.

    Parameters
    ----------
    grid : SamplingGrid
        What is sampled.
    out : Path
        The NetCDF file. Finished blocks are kept in the folder `blocks_folder(out)` until it is written.
    workers : int, optional
        Number of FMUs, each in a process; by default one for each processor.
    resume : bool
        Go on with the finished blocks of an interrupted sampling of the same grid.
    replace_existing : bool
        Take the place of an existing library, and forget the blocks of an interrupted sampling.

    Raises
    ------
    MissionInputError
        The file exists, an interrupted sampling is there or is of another grid, the FMU has a memory or does
        not settle.
    InvalidModelError
        What is asked for does not fit in memory.
    FmuError
        The FMU fails, or binding or grid do not fit it.
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = own if workers is None else workers
    if count < 1:
        raise MissionInputError(f"the number of workers must be at least 1, and {count} came.")
    binding = load_binding(grid.binding)
    sensors = _check_grid(grid, binding)
    record = _record(grid)
    folder = _prepare_folder(out, record, resume=resume, replace_existing=replace_existing)
    lock = lock_folder(folder)
    if lock is None:
        raise MissionInputError(said("library.locked", folder=folder))
    with closing_lock(lock):
        rows = _kept_rows(folder, (grid.size, sensors))
        todo = [(first, last) for first, last in grid.blocks if np.isnan(rows[first:last]).any()]
        kept, begin = len(grid.blocks) - len(todo), time.perf_counter()
        with stage("Sampling the FMU", total=len(grid.blocks), unit="blocks") as shown:
            shown.advance(kept)
            _sample(grid, rows, todo, count, shown)
        seconds = time.perf_counter() - begin
        library = ObservationLibrary(sampled_dataset(grid, binding, record, np.array(rows)))
        write_observation_library(out, library)
        shutil.rmtree(folder, ignore_errors=True)
    return SamplingOutcome(out, library, kept, len(grid.blocks), count, seconds)


def _sample(grid: SamplingGrid, rows: Float, todo: list[tuple[int, int]], count: int, shown: Stage) -> None:
    """Fill the rows of blocks, each thread by an FMU of its own; what is finished stays, whatever comes."""
    samplers, blocks = list[GridSampler](), iter(todo)

    def work() -> None:
        with closing(GridSampler(grid)) as sampler:
            samplers.append(sampler)
            for first, last in blocks:
                rows[first:last] = sampler.block(first, last)
                shown.advance(1)

    with ThreadPoolExecutor(count) as pool:
        try:
            for done in as_completed([pool.submit(work) for _ in range(min(count, len(todo)))]):
                done.result()
        finally:
            todo.clear()
            for sampler in samplers:
                sampler.close()


def _check_grid(grid: SamplingGrid, binding: Binding) -> int:
    """Check the grid against binding and FMU, before anything is started; return the number of sensors."""
    parameters = [*grid.parameters, *([grid.parameter] if grid.parameter else [])]
    rows = (
        ("state", grid.states, binding.health),
        ("control input", next(iter(grid.controls.values()), {}), binding.control),
        ("load", grid.load, binding.load),
        ("parameter", parameters, binding.parameter),
    )
    check_names("the grid has the", f"the binding {binding.name}", rows)
    binding.observation_slice(grid.role)
    if not grid.states or not grid.controls or not grid.draws:
        raise MissionInputError(said("library.bare"))
    taken = sorted({*grid.states} & {*RESERVED})
    if taken:
        raise MissionInputError(said("library.reserved", name=taken[0]))
    for name, levels in grid.states.items():
        if any(b <= a for a, b in itertools.pairwise(levels)):
            raise MissionInputError(f"the levels of {name} must increase, and {levels} came.")
    fmu = FmiAsset(grid.fmu, binding)
    warn_without_sandbox(grid.fmu, binding.limits.grants)
    sensors = fmu.binding.observation_slice(grid.role)
    count: int = sensors.stop - sensors.start
    check_fits(
        {f"{count} sensors at {grid.size} points": _COPIES * NUMBER * count * grid.size},
        "take fewer levels, draws or controls",
    )
    return count


def _record(grid: SamplingGrid) -> dict[str, Any]:
    """Return what a library is a function of: the grid with hashes in the place of files."""
    record: dict[str, Any] = json.loads(json.dumps(asdict(grid)))
    del record["step_timeout"]
    hashes = {"fmu": hash_file(Path(grid.fmu)), "binding": hash_file(Path(grid.binding))}
    return record | hashes | {"version": version("uav-twin")}


def _prepare_folder(out: Path, record: dict[str, Any], *, resume: bool, replace_existing: bool) -> Path:
    if out.suffix != ".nc":
        raise MissionInputError(said("library.suffix", out=out))
    folder = blocks_folder(out)
    plan = folder / PLAN_NAME
    if replace_existing:
        shutil.rmtree(folder, ignore_errors=True)
    elif out.exists():
        raise MissionInputError(f"{out} exists: choose another --out or give --replace.")
    text = json.dumps(record, indent=1) + "\n"  # the order of the states matters
    if folder.exists():
        if not resume:
            raise MissionInputError(said("library.interrupted", folder=folder))
        kept = plan.read_bytes() if plan.is_file() else b""
        if kept and kept != text.encode("utf-8"):
            what = _difference(kept, record)
            raise MissionInputError(said("library.another", folder=folder, what=what))
        if kept:
            return folder
    atomic_write_text(plan, text)
    return folder


def _difference(kept: bytes, record: dict[str, Any]) -> str:
    try:
        before = parse_json(kept, PLAN_NAME, MissionInputError)
        return ", ".join(key for key in record if before.get(key) != record[key]).replace("_", " ")
    except (MissionInputError, AttributeError):
        return "damaged"


def _kept_rows(folder: Path, shape: tuple[int, int]) -> Float:
    """Return the observations (N, G) on disk, NaN where there is none yet; whoever fills them keeps them."""
    path, sound = folder / ROWS_NAME, False
    with suppress(OSError, EOFError, ValueError):  # there are none, or they are damaged
        sound = np.load(path, mmap_mode="r").shape == shape  # a short file would grow
    if not sound:
        content = io.BytesIO()
        np.save(content, np.full(shape, np.nan))
        atomic_write_bytes(path, content.getvalue())
    with explained_write_errors(path):
        rows: Float = np.load(path, mmap_mode="r+")
    return rows


def sampled_dataset(
    grid: SamplingGrid, binding: Binding, record: Mapping[str, Any], rows: Float
) -> xr.Dataset:
    """Return observations (N, G) of a grid as a labelled dataset; each state factor is a dimension."""
    vector, inputs = binding.observation[grid.role], list(next(iter(grid.controls.values())))
    units = {name: binding.control[name].unit for name in inputs}
    of_parameter = {
        "long_name": grid.parameter or "none",
        "units": binding.parameter[grid.parameter].unit if grid.parameter else "1",
    }
    sensor = {"long_name": f"FMU variable of each value of {grid.role}"}
    draws = np.array(grid.draws) if grid.parameter else np.array([np.nan])
    coordinates = {
        "sensor": xr.Variable("sensor", np.array(vector.variables), sensor),
        "sensor_unit": xr.Variable("sensor", np.array(vector.units), {"long_name": "unit"}),
        "control": xr.Variable("control", np.array(list(grid.controls)), {"long_name": "control"}),
        "parameter_value": xr.Variable("draw", draws, of_parameter),
    }
    for name, levels in grid.states.items():
        about = {"long_name": "state", "units": binding.health[name].unit}
        coordinates[name] = xr.Variable(name, np.array(levels), about)
    for name in inputs:
        about = {"long_name": f"control input {name}", "units": units[name]}
        values = np.array([control[name] for control in grid.controls.values()])
        coordinates[f"control_{name}"] = xr.Variable("control", values, about)
    dimensions = ("draw", *grid.states, "control", "sensor")
    shown = {"long_name": f"{grid.role} without noise", "units": "see sensor_unit"}
    attributes: dict[str, Any] = {
        "kind": KIND,
        "format": FORMAT,
        "role": grid.role,
        "parameter": grid.parameter,
        "states": json.dumps(list(grid.states)),
        "settling_steps": grid.settling_steps,
        "fmu_sha256": record["fmu"],
        "binding_sha256": record["binding"],
        "uav_twin_version": record["version"],
        "load": json.dumps(dict(grid.load), sort_keys=True),
        "parameters": json.dumps(dict(grid.parameters), sort_keys=True),
        "control_units": json.dumps(units, sort_keys=True),
    }
    return xr.Dataset(
        {"observation": (dimensions, rows.reshape(*grid.shape, -1), shown)}, coordinates, attributes
    )
