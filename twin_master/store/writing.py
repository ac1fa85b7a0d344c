"""The run store: NetCDF for programs, CSV for people, a summary; every file whole or not there."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reporting.errors import DamagedFileError
from reporting.files import atomic_file, atomic_write_text
from reporting.groups import Group, write_groups
from reporting.netcdf import read_groups
from twin_master.run_folder import FIELD_NAME, to_json
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import groups_of
from twin_master.store.summary import Figure, to_record
from twin_master.store.tables import tables_of

if TYPE_CHECKING:
    from xarray import DataTree

RUN_NAME = "run.nc"
SUMMARY_NAME = "summary.json"
TIMING_NAME = "timing.json"
CSV_FOLDER = "csv"


def write_run(folder: Path, groups: Mapping[str, Group], attributes: Mapping[str, Any]) -> Path:
    """Write `run.nc`; the bytes depend on nothing but what is given.

    Parameters
    ----------
    folder
        The run folder.
    groups
        By name.
    attributes
        Of the root: seed, versions, hashes.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    with atomic_file(folder / RUN_NAME) as temporary:
        write_groups(temporary, groups, attributes)
    return folder / RUN_NAME


def read_run(folder: Path) -> "DataTree":
    """Return the groups of a run, loaded into memory.

    Raises
    ------
    DamagedFileError
        There is no whole `run.nc`.
    """
    try:
        return read_groups(folder / RUN_NAME)
    except DamagedFileError as error:
        raise DamagedFileError(f"{error}: it is not a whole run, resume the run or fly it again.") from error


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
    write_field: Callable[[Path], object] | None = None,
) -> dict[str, Group]:
    """Write `run.nc`, the CSV files and, where the asset has a mesh, `wing.vtu`; return the groups.

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
    groups = groups_of(result)
    write_run(folder, groups, attributes)
    for name, text in tables_of(groups, result.scenario.observation.role).items():
        atomic_write_text(folder / CSV_FOLDER / f"{name}.csv", text)
    if write_field is not None:
        write_field(folder / FIELD_NAME)
    return groups
