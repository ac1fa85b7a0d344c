"""The files of a run: NetCDF for programs, CSV for people, a summary; each complete or absent."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.files import atomic_file, atomic_write_text, hash_record
from reporting.folders import restore_folder
from reporting.formats.netcdf import NetcdfGroup, read_groups, write_groups
from reporting.json_file import JsonObject, read_json
from reporting.pages.notebook import html_table
from reporting.words import brief, number, rounded
from twin_master.assets.asset_source import AssetAndModel
from twin_master.errors import NotResumableError, RunFolderError
from twin_master.pictures import plot_belief
from twin_master.run_folder import FIELD_NAME, REPORT_NAME, read_config, to_json
from twin_master.store.mission_result import MissionResult, learnt_record
from twin_master.store.results import csv_tables, run_groups
from twin_master.store.summary import (
    EntryValue,
    SummaryEntry,
    SummaryGroup,
    control_changes,
    notice_record,
    summarise,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from xarray import DataTree


RUN_NAME = "run.nc"
SUMMARY_NAME = "summary.json"
TIMING_NAME = "timing.json"
CSV_FOLDER = "csv"
_MEAN = "_mean"
_STANDARD_DEVIATION = "_standard_deviation"


def write_run(
    folder: Path, groups: Mapping[str, NetcdfGroup], attributes: Mapping[str, object]
) -> Path:
    """Write `run.nc`; its bytes depend on nothing but the arguments.

    Parameters
    ----------
    groups : mapping of str to NetcdfGroup
        The groups by name.
    attributes : mapping of str to object
        The attributes of the root: seed, versions, hashes.

    Raises
    ------
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    with atomic_file(folder / RUN_NAME) as temporary:
        write_groups(temporary, groups, attributes)
    return folder / RUN_NAME


def open_run(folder: Path | str) -> "DataTree":
    """Read the groups of `run.nc` in a run folder into memory.

    If a process was killed while it replaced the folder, the former folder is restored first.

    Raises
    ------
    RunFolderError
        If there is no ``run.nc``, or it is damaged. Then the run did not end: the message advises
        to resume it or to fly it again.
    """
    restore_folder(Path(folder))
    path = Path(folder) / RUN_NAME
    if not path.is_file():
        raise RunFolderError(
            f"{folder} holds no run.nc, so there is no run to report: fly or resume the run first."
        )
    advice = ": it is not a whole run, resume the run or fly it again."
    with RunFolderError.instead_of(DamagedFileError, after=advice):
        return read_groups(path)


def store_flight(
    folder: Path,
    config: JsonObject,
    result: MissionResult,
    origin: AssetAndModel,
    *,
    steps: int,
    figures: Sequence[SummaryGroup] = (),
    attributes: Mapping[str, object] | None = None,
    misfit: Float | None = None,
    write_field: Callable[[Path], object] | None = None,
) -> None:
    """Write the results of a run or a watch: `run.nc`, the CSV files, and the summary.

    The summary is written last. The report is not written here.

    Parameters
    ----------
    origin : AssetAndModel
        The asset and the believed model, in words.
    steps : int
        The number of steps that were flown or planned.
    figures : sequence of SummaryGroup
        Groups of the summary that come before those of every mission.
    attributes : mapping of str to object, optional
        Further attributes of the root of `run.nc`.
    misfit : (states, controls, sensors) array, optional
        The relative difference of the twin's model to the asset, see `summarise`.
    write_field : callable, optional
        Writes the VTU file of the last estimated field to a path.
    """
    groups = run_groups(result)
    root_attributes = _root_attributes(config, result, origin)
    root_attributes |= attributes or {}
    write_run(folder, groups, root_attributes)
    for name, text in csv_tables(groups, result.scenario.observation).items():
        atomic_write_text(folder / CSV_FOLDER / f"{name}.csv", text)
    if write_field is not None:
        write_field(folder / FIELD_NAME)
    rewards = groups["filtered"]["reward_mean"].values
    summary = _summary_heading(result, origin, steps)
    summary["figures"] = [asdict(figure) for figure in summarise(result, rewards, misfit, figures)]
    atomic_write_text(folder / SUMMARY_NAME, to_json(summary))


def _root_attributes(
    config: JsonObject, result: MissionResult, origin: AssetAndModel
) -> dict[str, object]:
    """Return the attributes of the root of `run.nc`.

    They state the origin of the results: seed, hashes of inputs and source code, versions,
    calibrated parameter, and asset and model in words.
    """
    provenance = config["provenance"]
    mission = result.scenario.mission
    draws = result.knowledge.draws  # of the calibrated parameter
    return {
        "title": mission.title or mission.name,
        "scenario": mission.name,
        "seed": mission.seed,
        "config_hash": hash_record(config),
        "versions": json.dumps(provenance["versions"], sort_keys=True),
        "source_hashes": json.dumps(provenance["source_hashes"], sort_keys=True),
        "input_hashes": json.dumps(config["inputs"], sort_keys=True),
        "observed_quantity": result.scenario.observation.role,
        "parameter": draws.name,
        "parameter_source": draws.source,
        "asset": origin.asset,
        "twin_model": origin.model,
    }


def _summary_heading(result: MissionResult, origin: AssetAndModel, steps: int) -> JsonObject:
    """Return the entries of the summary file before the results.

    They are the mission, its control changes, asset and believed model, learnt quantities, and
    notices.
    """
    scenario = result.scenario
    mission = scenario.mission
    flight = result.flight
    return {
        "scenario": mission.name,
        "title": mission.title,
        "seed": mission.seed,
        "steps": steps,
        "control": control_changes(
            scenario.control_names, flight.control_index, mission.step_name, flight.first_step
        ),
        "asset": origin.asset,
        "twin_model": origin.model,
        "asset_and_model_differ": origin.differ,
        **learnt_record(result.learnt, scenario.observation.sensor_units),
        **notice_record(result),
    }


def printed_values(entries: Sequence[SummaryEntry]) -> list[tuple[str, str]]:
    """Return value and reference of each entry as texts; a missing reference is empty.

    A number has three significant digits. If the standard deviation of a mean is another entry, the
    mean has as many decimals as it, so that both can be compared.
    """
    values = {entry.key: entry.value for entry in entries}
    texts = []
    for entry in entries:
        deviation = None
        if entry.key.endswith(_MEAN):
            deviation = values.get(entry.key.removesuffix(_MEAN) + _STANDARD_DEVIATION)
        reference = ""
        if entry.reference is not None:
            reference = _printed_number(entry.reference, deviation)
        texts.append((_printed_number(entry.value, deviation), reference))
    return texts


def _printed_number(value: EntryValue, deviation: EntryValue) -> str:
    """Return a value with the decimals of its standard deviation, if that is known."""
    if isinstance(value, float) and isinstance(deviation, float) and deviation > 0.0:
        return rounded(value, deviation)
    return number(value)


@dataclass(frozen=True, repr=False)
class RunOutcome:
    """A finished run.

    Attributes
    ----------
    folder : Path
        The path of the run folder.
    report : Path or None
        The report in it; None if there is none.
    figures : tuple of SummaryEntry
        The summary.
    timing : dict
        The content of `timing.json`.
    origin : AssetAndModel
        What was flown and what the twin believed, in words.
    step_name : str
        What a step is called.
    control : str
        When the control changed, in words.
    notices : tuple of str
        What the operator should know, one sentence each.
    """

    folder: Path
    report: Path | None
    figures: tuple[SummaryEntry, ...]
    timing: JsonObject
    origin: AssetAndModel
    step_name: str
    control: str
    notices: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return brief(self, folder=str(self.folder), control=self.control, notices=len(self.notices))

    @cached_property
    def tree(self) -> "DataTree":
        """Everything that the run has stored, see `open_run`."""
        return open_run(self.folder)

    def _repr_html_(self) -> str:
        """Return the results of the run with their reference values, for a notebook."""
        rows = []
        texts = printed_values(self.figures)
        for figure, (value, reference) in zip(self.figures, texts, strict=True):
            rows.append([figure.title, value, figure.unit, reference])
        headings = ("result", "this run", "unit", "reference")
        return html_table(f"Run in {self.folder}", headings, rows, self.notices)

    def plot(self, axes: "Axes | Sequence[Axes] | None" = None) -> "list[Axes]":
        """Draw the believed state over the steps, see `plot_belief`."""
        return plot_belief(self, axes)


def read_outcome(folder: Path) -> RunOutcome:
    """Return the outcome of the run in a folder.

    Raises
    ------
    KeyError, TypeError, DamagedFileError, NotResumableError
        If a result is missing or damaged.
    """
    timing = read_json(folder / TIMING_NAME, DamagedFileError)
    summary = read_json(folder / SUMMARY_NAME, DamagedFileError)
    report = folder / REPORT_NAME
    return RunOutcome(
        folder,
        report=report if report.is_file() else None,
        figures=tuple(SummaryEntry(**figure) for figure in summary["figures"]),
        timing=timing,
        origin=AssetAndModel(
            str(summary["asset"]),
            str(summary["twin_model"]),
            bool(summary["asset_and_model_differ"]),
        ),
        step_name=str(read_config(folder)["scenario"]["mission"]["step_name"]),
        control=str(summary["control"]),
        notices=tuple(str(notice["sentence"]) for notice in summary.get("notices", ())),
    )


def finished_run(folder: Path) -> RunOutcome | None:
    """Return the outcome of a run; None if the run has not ended, or its results are damaged."""
    try:
        open_run(folder)
        return read_outcome(folder)
    except (KeyError, TypeError, DamagedFileError, NotResumableError, RunFolderError):
        return None
