"""Sampling an FMU over a grid into an observation library.

Several processes share the grid, and an interrupted sampling can be continued.
"""

import io
import itertools
import json
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import xarray as xr

from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.instance_host import warn_without_sandbox
from fmu_asset.client.session import FmiAsset
from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text, explained_write_errors, hash_file
from reporting.folders import closing_lock
from reporting.json_file import JsonObject, JsonRecord, parse_json
from reporting.progress import Stage, stage
from reporting.system.operating_system import lock_folder, usable_processors
from twin_master.assets.library_source import (
    FORMAT,
    KIND,
    RESERVED,
    ObservationLibrary,
    write_observation_library,
)
from twin_master.errors import MissionInputError, check_names
from twin_master.library.grid import SamplingGrid
from twin_master.library.sampler import GridSampler
from twin_master.network.transition import BYTES_OF_NUMBER, check_fits

PLAN_NAME = "grid.json"
"""File in the folder of blocks: the grid and the hashes on which the library depends."""
ROWS_NAME = "observations.npy"
"""File in the folder of blocks: the observations, NaN for blocks that are not finished."""
_COPIES_IN_MEMORY = 3  # the blocks, all observations, and the library


@dataclass(frozen=True)
class SamplingOutcome:
    """A library that was sampled.

    Attributes
    ----------
    path : Path
        The path of the file.
    library : ObservationLibrary
        The content of the library.
    kept_blocks, block_count : int
        The number of blocks that an interrupted sampling had finished, and of all blocks.
    workers : int
        The number of processes.
    seconds : float
        The wall-clock time of the sampling itself [s].
    """

    path: Path
    library: ObservationLibrary
    kept_blocks: int
    block_count: int
    workers: int
    seconds: float


def blocks_folder(out: Path) -> Path:
    """Return the folder that holds the finished blocks while a library is sampled."""
    return out.with_name(f"{out.name}.blocks")


def sample_library(
    grid: SamplingGrid,
    out: Path,
    *,
    workers: int | None = None,
    resume: bool = False,
    replace_existing: bool = False,
) -> SamplingOutcome:
    """Sample an FMU at every point of a grid and write the library.

    The bytes of the file depend neither on the number of processes nor on interruptions.

    Parameters
    ----------
    out : Path
        The NetCDF file. Until it is written, finished blocks are in the folder
        `blocks_folder(out)`.
    workers : int, optional
        The number of FMUs, each in a process; by default one for each processor.
    resume : bool
        Whether to continue an interrupted sampling of the same grid.
    replace_existing : bool
        Whether to replace an existing library, and to remove the blocks of an interrupted sampling.

    Raises
    ------
    MissionInputError
        If the file exists; an interrupted sampling exists and is not continued, or is of another
        grid; or the FMU has a memory or does not settle.
    InvalidModelError
        If the library does not fit in memory.
    FmuError
        If the FMU fails, or the binding or the grid does not fit it.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    worker_count = usable_processors() if workers is None else workers
    if worker_count < 1:
        raise MissionInputError(
            f"the number of workers must be at least 1, but {worker_count} was given."
        )
    binding = load_binding(grid.binding)
    _check_grid(grid, binding)
    # A binding may name a whole array, whose length only the FMU declares.
    fmu = FmiAsset(grid.fmu, binding)
    warn_without_sandbox(grid.fmu, binding.limits.grants)
    sensors = fmu.binding.observation_slice(grid.role)
    sensor_count = sensors.stop - sensors.start
    size = _COPIES_IN_MEMORY * BYTES_OF_NUMBER * sensor_count * grid.size
    check_fits(
        {f"{sensor_count} sensors at {grid.size} points": size},
        "take fewer levels, draws or controls",
    )
    # What determines the library: the grid, but for the time limit, the files and the version.
    record: JsonObject = json.loads(json.dumps(asdict(grid)))
    del record["step_timeout"]
    record["fmu"] = hash_file(Path(grid.fmu))
    record["binding"] = hash_file(Path(grid.binding))
    record["version"] = version("uav-twin")
    folder = _prepare_folder(out, record, resume=resume, replace_existing=replace_existing)
    lock = lock_folder(folder)
    if lock is None:
        raise MissionInputError(f"another process is sampling into {folder}: wait for it to end.")
    with closing_lock(lock):
        rows = _rows_on_disk(folder, (grid.size, sensor_count))
        pending_blocks = [
            (first, last) for first, last in grid.blocks if np.isnan(rows[first:last]).any()
        ]
        block_count = len(grid.blocks)
        kept_blocks = block_count - len(pending_blocks)
        start_time = time.perf_counter()
        with stage("Sampling the FMU", total=block_count, unit="blocks") as progress_stage:
            progress_stage.advance(kept_blocks)
            _sample_blocks(grid, rows, pending_blocks, worker_count, progress_stage)
        seconds = time.perf_counter() - start_time
        library = ObservationLibrary(sampled_dataset(grid, binding, record, np.array(rows)))
        write_observation_library(out, library)
        shutil.rmtree(folder, ignore_errors=True)
    return SamplingOutcome(out, library, kept_blocks, block_count, worker_count, seconds)


def _sample_blocks(
    grid: SamplingGrid,
    rows: Float,
    blocks: list[tuple[int, int]],
    worker_count: int,
    progress_stage: Stage,
) -> None:
    """Sample blocks of points in several threads, each with an FMU in a process of its own.

    If a thread fails, the others end too; finished blocks stay in `rows`.

    Parameters
    ----------
    rows : (N, G) array
        The observations of the G sensors at all points; the rows of the blocks are filled in.
    blocks : list of (int, int)
        The first point of each block, and the point after its last; emptied at the end.
    """
    samplers: list[GridSampler] = []
    next_blocks = iter(blocks)  # shared: each block goes to the next free thread

    def sample_next_blocks() -> None:
        with closing(GridSampler(grid)) as sampler:
            samplers.append(sampler)
            for first, last in next_blocks:
                rows[first:last] = sampler.observe_block(first, last)
                progress_stage.advance(1)

    with ThreadPoolExecutor(worker_count) as pool:
        thread_count = min(worker_count, len(blocks))
        futures = [pool.submit(sample_next_blocks) for _ in range(thread_count)]
        try:
            for future in as_completed(futures):
                future.result()
        finally:
            blocks.clear()  # ends the shared iterator, and with it the other threads
            for sampler in samplers:
                sampler.close()


def _check_grid(grid: SamplingGrid, binding: Binding) -> None:
    """Refuse a grid with names that the binding does not have, or with unusable values."""
    # the parameters with one value at all points, and the uncertain one, which varies
    parameter_names = list(grid.parameters)
    if grid.parameter:
        parameter_names.append(grid.parameter)
    # all controls set the same inputs, so that the names of the first one are enough
    first_control = next(iter(grid.controls.values()), {})
    names_by_kind = (
        ("state", grid.states, binding.health),
        ("control input", first_control, binding.control),
        ("load", grid.load, binding.load),
        ("parameter", parameter_names, binding.parameter),
    )
    check_names(
        owner="the grid has the",
        reference=f"the binding {binding.name}",
        rows=names_by_kind,
    )
    binding.observation_slice(grid.role)  # raises an error for an unknown role
    if not grid.states or not grid.controls or not grid.draws:
        raise MissionInputError(
            "a grid needs at least one state and one control with values: give --grid NAME=VALUES "
            "for them."
        )
    reserved_names = sorted(set(grid.states) & set(RESERVED))
    if reserved_names:
        raise MissionInputError(
            f"a state cannot be called {reserved_names[0]} in an observation library: give it "
            "another name in the binding."
        )
    for name, levels in grid.states.items():
        if any(second <= first for first, second in itertools.pairwise(levels)):
            raise MissionInputError(f"the levels of {name} must increase, but {levels} was given.")


def _prepare_folder(out: Path, record: JsonObject, *, resume: bool, replace_existing: bool) -> Path:
    """Prepare the folder for finished blocks of a sampling, and return it.

    It may hold blocks of an interrupted sampling, which are kept only if `resume` is set and if the
    record of that sampling is the same.
    """
    if out.suffix != ".nc":
        raise MissionInputError(
            f"an observation library must have the suffix .nc, but {out} was given."
        )
    folder = blocks_folder(out)
    plan_file = folder / PLAN_NAME
    if replace_existing:
        shutil.rmtree(folder, ignore_errors=True)
    elif out.exists():
        raise MissionInputError(f"{out} exists: choose another --out or give --replace.")
    plan = json.dumps(record, indent=1) + "\n"  # not sorted: the order of the states matters
    if folder.exists():
        if not resume:
            raise MissionInputError(
                f"{folder} holds the finished blocks of an interrupted sampling: give --resume to "
                "go on with them, or --replace to begin again."
            )
        former_plan = plan_file.read_bytes() if plan_file.is_file() else b""
        if former_plan and former_plan != plan.encode("utf-8"):
            difference = _differing_keys(former_plan, record)
            raise MissionInputError(
                f"{folder} holds blocks of another FMU, binding, grid or version ({difference}): "
                "give --replace to begin again."
            )
        if former_plan:
            return folder
    atomic_write_text(plan_file, plan)
    return folder


def _differing_keys(former_plan: bytes, record: JsonObject) -> str:
    """Return the keys in which the plan of an earlier sampling differs from the present one."""
    try:
        former_record = parse_json(former_plan, PLAN_NAME, MissionInputError)
        keys = [key for key in record if former_record.get(key) != record[key]]
    except (MissionInputError, AttributeError):
        return "damaged"
    return ", ".join(keys).replace("_", " ")


def _rows_on_disk(folder: Path, shape: tuple[int, int]) -> Float:
    """Return the observations (N, G) as an array that is mapped to a file.

    Assigned values are written to the file, so that they survive an interruption. Points that were
    not sampled yet are NaN. A missing or damaged file is made anew.
    """
    path = folder / ROWS_NAME
    is_sound = False
    with suppress(OSError, EOFError, ValueError):  # there is no file, or it is damaged
        # Open it for reading, since NumPy would lengthen a truncated file opened for writing.
        is_sound = np.load(path, mmap_mode="r").shape == shape
    if not is_sound:
        content = io.BytesIO()
        np.save(content, np.full(shape, np.nan))
        atomic_write_bytes(path, content.getvalue())
    with explained_write_errors(path):
        rows: Float = np.load(path, mmap_mode="r+")
    return rows


def sampled_dataset(
    grid: SamplingGrid, binding: Binding, record: JsonRecord, rows: Float
) -> xr.Dataset:
    """Return the observations of a grid as a labelled dataset.

    Its dimensions are the draw, each state factor, the control and the sensor.

    Parameters
    ----------
    record : mapping
        The hashes of the files, and the version.
    rows : (N, G) array
        The observation at each point, in the units of the sensors.
    """
    dimensions = ("draw", *grid.states, "control", "sensor")
    description = {"long_name": f"{grid.role} without noise", "units": "see sensor_unit"}
    observation = (dimensions, rows.reshape(*grid.shape, -1), description)
    control_inputs = next(iter(grid.controls.values()))
    control_units = {name: binding.control[name].unit for name in control_inputs}
    attributes = {
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
        "control_units": json.dumps(control_units, sort_keys=True),
    }
    coordinates = _library_coordinates(grid, binding, control_units)
    return xr.Dataset({"observation": observation}, coordinates, attributes)


def _library_coordinates(
    grid: SamplingGrid, binding: Binding, control_units: Mapping[str, str]
) -> dict[str, xr.Variable]:
    """Return the coordinates of a library: sensors, controls, draws, and levels of the states."""
    vector = binding.observation[grid.role]
    sensor_attributes = {"long_name": f"FMU variable of each value of {grid.role}"}
    controls = np.array(list(grid.controls))
    draws = np.array(grid.draws) if grid.parameter else np.array([np.nan])
    draw_attributes = {"long_name": "none", "units": "1"}
    if grid.parameter:
        draw_attributes["long_name"] = grid.parameter
        draw_attributes["units"] = binding.parameter[grid.parameter].unit
    coordinates = {
        "sensor": xr.Variable("sensor", np.array(vector.variables), sensor_attributes),
        "sensor_unit": xr.Variable("sensor", np.array(vector.units), {"long_name": "unit"}),
        "control": xr.Variable("control", controls, {"long_name": "control"}),
        "parameter_value": xr.Variable("draw", draws, draw_attributes),
    }
    for name, levels in grid.states.items():
        attributes = {"long_name": "state", "units": binding.health[name].unit}
        coordinates[name] = xr.Variable(name, np.array(levels), attributes)
    for name, unit in control_units.items():
        attributes = {"long_name": f"control input {name}", "units": unit}
        values = np.array([control[name] for control in grid.controls.values()])
        coordinates[f"control_{name}"] = xr.Variable("control", values, attributes)
    return coordinates
