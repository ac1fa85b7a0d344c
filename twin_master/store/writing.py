"""The run store: NetCDF for programs, CSV for people, a summary; every file whole or not there."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.files import atomic_file, atomic_write_text, hash_record
from reporting.folders import restore_folder
from reporting.json_file import read_json
from reporting.netcdf import NetcdfGroup, read_groups, write_groups
from twin_master.assets.asset_source import FlownAndBelieved
from twin_master.errors import NotResumableError, RunFolderError, said
from twin_master.run_folder import FIELD_NAME, read_config, to_json
from twin_master.store.mission_result import MissionResult, learnt_record
from twin_master.store.results import groups_of, tables_of
from twin_master.store.summary import Figure, Told, control_changes, noticed, summarise

if TYPE_CHECKING:
    from xarray import DataTree


RUN_NAME = "run.nc"
SUMMARY_NAME = "summary.json"
TIMING_NAME = "timing.json"
CSV_FOLDER = "csv"


def write_run(folder: Path, groups: Mapping[str, NetcdfGroup], attributes: Mapping[str, Any]) -> Path:
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


def open_run(folder: Path | str) -> "DataTree":
    """Return everything that a run has stored, `run.nc`, loaded into memory.

    Raises
    ------
    RunFolderError
        There is no ``run.nc``, or it is damaged.
    """
    restore_folder(Path(folder))
    path = Path(folder) / RUN_NAME
    if not path.is_file():
        raise RunFolderError(said("run_folder.no_run", folder=folder))
    after = ": it is not a whole run, resume the run or fly it again."
    with RunFolderError.instead_of(DamagedFileError, after=after):
        return read_groups(path)


def store_flight(
    folder: Path,
    config: Mapping[str, Any],
    result: MissionResult,
    origin: FlownAndBelieved,
    *,
    steps: int,
    figures: Sequence[Told] = (),
    attributes: Mapping[str, Any] | None = None,
    misfit: Float | None = None,
    write_field: Callable[[Path], object] | None = None,
) -> None:
    """Write all that a run or a watch leaves beside its report.

    Parameters
    ----------
    folder
        The run folder.
    result
        The mission.
    config
        Content of `config.json`.
    origin
        What was flown, and what the twin believed.
    steps
        Steps flown in all, or planned.
    figures
        Of the summary, before those of every mission.
    attributes
        Further ones of the root of `run.nc`.
    misfit
        Of the twin's model, where the asset is known to be another one.
    write_field
        Writes the VTU file to the path that it is given.
    """
    provenance, mission, draws = config["provenance"], result.scenario.mission, result.knowledge.draws
    flown = {"asset": origin.asset, "twin_model": origin.model}
    told = {
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
        **flown,
        **(attributes or {}),
    }
    groups = groups_of(result)
    write_run(folder, groups, told)
    for name, text in tables_of(groups, result.scenario.observation).items():
        atomic_write_text(folder / CSV_FOLDER / f"{name}.csv", text)
    if write_field is not None:
        write_field(folder / FIELD_NAME)
    flight, controls = result.flight, result.scenario.control_names
    heading = {
        "scenario": mission.name,
        "title": mission.title,
        "seed": mission.seed,
        "steps": steps,
        "control": control_changes(controls, flight.control_index, mission.step_name, flight.first_step),
        **flown,
        "asset_and_model_differ": origin.differ,
        **learnt_record(result.learnt, result.scenario.observation.sensor_units),
        **noticed(result),
    }
    rewards = groups["filtered"]["reward_mean"].values
    shown = [asdict(figure) for figure in summarise(result, rewards, misfit, figures)]
    atomic_write_text(folder / SUMMARY_NAME, to_json({**heading, "figures": shown}))


REPORT_NAME = "report.html"
"""In the run folder: the report."""


@dataclass(frozen=True)
class RunOutcome:
    """A finished run.

    Attributes
    ----------
    folder : Path
        The run folder.
    report : Path or None
        The report in it; None where none was asked for.
    figures : tuple of Figure
        The summary.
    timing : dict
        Content of `timing.json`.
    origin : FlownAndBelieved
        What was flown and what the twin believed, in words.
    step_name : str
        What a step is called.
    control : str
        When which control was left for which, in words.
    notices : tuple of str
        What the operator should know, a sentence each.
    """

    folder: Path
    report: Path | None
    figures: tuple[Figure, ...]
    timing: Mapping[str, Any]
    origin: FlownAndBelieved
    step_name: str
    control: str
    notices: tuple[str, ...] = ()

    @cached_property
    def tree(self) -> "DataTree":
        """All that the run has stored, as of `open_run`."""
        return open_run(self.folder)


def read_outcome(folder: Path) -> RunOutcome:
    """Return what came of the run in a folder.

    Raises
    ------
    KeyError, TypeError, DamagedFileError, NotResumableError
        A result is missing or damaged.
    """
    report = folder / REPORT_NAME
    timing, summary = (read_json(folder / name, DamagedFileError) for name in (TIMING_NAME, SUMMARY_NAME))
    return RunOutcome(
        folder,
        report if report.is_file() else None,
        tuple(Figure(**figure) for figure in summary["figures"]),
        timing,
        FlownAndBelieved(
            str(summary["asset"]), str(summary["twin_model"]), bool(summary["asset_and_model_differ"])
        ),
        str(read_config(folder)["scenario"]["mission"]["step_name"]),
        str(summary["control"]),
        tuple(str(notice["sentence"]) for notice in summary.get("notices", ())),
    )


def finished_run(folder: Path) -> RunOutcome | None:
    """Return the outcome of a run that is finished; None where its results are missing or damaged."""
    try:
        open_run(folder)
        return read_outcome(folder)
    except (KeyError, TypeError, DamagedFileError, NotResumableError, RunFolderError):
        return None
