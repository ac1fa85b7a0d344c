"""The whole chain: design -> reduced model -> FMU -> calibration -> mission -> store -> report."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import atomic_write_text
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance, hash_file, hash_record
from scenarios import binding_files
from twin_master.asset_source import AssetSource, StrainLibrarySource
from twin_master.checkpoint import read_checkpoint, write_checkpoint
from twin_master.crew import Knowledge, prepare_knowledge
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.mission import Flight, fly
from twin_master.results import MissionResult
from twin_master.run_folder import (
    KIND,
    create_run_folder,
    lock_run_folder,
    read_config,
    tidy,
    write_config,
)
from twin_master.scenario import Scenario
from twin_master.scenario_file import LoadedScenario, parse_scenario
from twin_master.store import store_mission, values_of, write_summary, write_timing
from twin_master.strain_library import FILE_NAME, load_strain_library
from twin_master.summary import Figure, summarise

REPORT_NAME = "report.html"
CALIBRATION_NAME = "calibration.json"
SHIPPED_DESIGN_NAME = "uav_wing"
HARMLESS_PACKAGES = frozenset({"discrepancy", "reporting", "scenarios", "uav_twin", "matplotlib"})
"""A run may be resumed after a change of these: no stored figure depends on them."""


@dataclass(frozen=True)
class Overrides:
    """What the command line says otherwise than the scenario file.

    Attributes
    ----------
    seed : int or None
        Seed of the run.
    fmu, binding : Path or None
        FMU to fly, and its binding.
    strain_library : Path or None
        Fly the library instead of an FMU.
    in_process : bool
        Fly the FMU in this process instead of a worker.
    """

    seed: int | None = None
    fmu: Path | None = None
    binding: Path | None = None
    strain_library: Path | None = None
    in_process: bool = False


@dataclass(frozen=True)
class RunOutcome:
    """A finished run.

    Attributes
    ----------
    folder : Path
        The run folder.
    report : Path
        The report in it.
    figures : tuple of Figure
        The summary.
    timing : dict
        Content of `timing.json`.
    """

    folder: Path
    report: Path
    figures: tuple[Figure, ...]
    timing: Mapping[str, Any]


@dataclass
class _Clock:
    """Wall-clock seconds of the stages."""

    begin: float = field(default_factory=time.perf_counter)
    stages: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.stages[name] = time.perf_counter() - begin


def resolve_scenario(loaded: LoadedScenario, overrides: Overrides) -> Scenario:
    """Return the scenario with the overrides, its paths absolute.

    Relative paths of a scenario file start at the folder of that file.

    Raises
    ------
    MissionInputError
        The overrides contradict each other.
    ScenarioError
        The scenario does not hold with them.
    """
    table = loaded.scenario.to_dict()
    asset, folder = table["asset"], loaded.path.resolve().parent
    if overrides.strain_library and (overrides.fmu or overrides.binding):
        raise MissionInputError("--strain-library flies no FMU: give either it or --fmu and --binding.")
    if asset["design"] and asset["design"] != SHIPPED_DESIGN_NAME:
        asset["design"] = str(folder / asset["design"])
    if asset["file"]:
        asset["file"] = str(folder / asset["file"])
    if asset["binding"] and asset["binding"] not in binding_files():
        asset["binding"] = str(folder / asset["binding"])
    if overrides.fmu:
        asset |= {"kind": "fmu", "file": str(overrides.fmu.resolve())}
    if overrides.binding:
        asset["binding"] = str(overrides.binding.resolve())
    if overrides.strain_library:
        asset |= {"kind": "strain_library", "file": str(_library_file(overrides.strain_library))}
        asset |= {"design": None, "binding": None, "observation_model": None}
    if overrides.in_process:
        asset["isolated"] = False
    if overrides.seed is not None:
        table["mission"]["seed"] = overrides.seed
    return parse_scenario(table, str(loaded.path))


def _library_file(path: Path) -> Path:
    return (path / FILE_NAME if path.is_dir() else path).resolve()


def asset_source(scenario: Scenario) -> AssetSource:
    """Return where the asset of a resolved scenario comes from.

    Raises
    ------
    InvalidStrainLibraryError, MissingObservationModelError
        The strain library is missing, damaged or does not fit the scenario.
    """
    asset = scenario.asset
    if asset.kind == "strain_library":
        path = Path(asset.file or "")
        library = load_strain_library(path)
        return StrainLibrarySource(scenario, library, hash_file(path))
    from fe.design import SHIPPED_DESIGN
    from twin_master.fmu_source import FmuSource

    design = SHIPPED_DESIGN if asset.design == SHIPPED_DESIGN_NAME else asset.design
    binding = binding_files().get(asset.binding or "", Path(asset.binding or ""))
    return FmuSource(
        scenario, binding, Path(design) if design else None, Path(asset.file) if asset.file else None
    )


def new_run(
    loaded: LoadedScenario,
    folder: Path,
    overrides: Overrides | None = None,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> RunOutcome:
    """Fly a scenario into a new run folder.

    Parameters
    ----------
    loaded
        The scenario.
    folder
        The run folder to make.
    overrides
        What differs from the file.
    replace
        Take the place of an existing run folder.
    progress
        Shows the stages.

    Raises
    ------
    RunFolderExistsError
        The folder exists.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError, ReportingError
        With one clear sentence; the run folder stays resumable.
    """
    scenario = resolve_scenario(loaded, overrides or Overrides())
    config = {
        "kind": KIND,
        "format": 1,
        "scenario": scenario.to_dict(),
        "scenario_file": {"name": loaded.path.name, "sha256": loaded.content_hash},
        "provenance": collect_provenance(scenario.mission.seed).as_dict(),
    }
    asset_source(scenario).check()  # what is not there should not cost the user a folder
    create_run_folder(folder, config, replace=replace)
    return _run(folder, config, scenario, progress or SilentProgress())


def resume_run(
    folder: Path, loaded: LoadedScenario | None = None, *, progress: Progress | None = None
) -> RunOutcome:
    """Continue an interrupted run; the results are those of an uninterrupted one, bit for bit.

    Parameters
    ----------
    folder
        The run folder.
    loaded
        The scenario that the user believes to be flown; checked against the folder.
    progress
        Shows the stages.

    Raises
    ------
    NotResumableError
        The folder holds no run, or one of another scenario or another version.
    """
    config = read_config(folder)
    try:
        scenario = parse_scenario(config["scenario"], str(folder / "config.json"))
        recorded = config["provenance"]
    except KeyError as error:
        raise NotResumableError(
            f"{folder}/config.json lacks {error}: fly the mission again with --replace."
        ) from error
    if loaded is not None and config["scenario_file"]["sha256"] != loaded.content_hash:
        raise NotResumableError(
            f"{folder} flies another scenario ({scenario.mission.name}, {config['scenario_file']['name']}) "
            f"than {loaded.path}: resume it without naming a scenario."
        )
    now = collect_provenance(scenario.mission.seed).as_dict()
    for what in ("versions", "source_hashes"):
        changed = sorted(
            name
            for name, value in now[what].items()
            if name not in HARMLESS_PACKAGES and recorded.get(what, {}).get(name) != value
        )
        if changed:
            raise NotResumableError(
                f"{folder} was begun with another version of {', '.join(changed)}, so its results could not "
                "be the same: fly the mission again with --replace."
            )
    return _run(folder, config, scenario, progress or SilentProgress())


def _run(folder: Path, config: dict[str, Any], scenario: Scenario, progress: Progress) -> RunOutcome:
    lock = lock_run_folder(folder)
    try:
        tidy(folder)
        clock = _Clock()
        source = asset_source(scenario)
        with clock.stage("asset"):
            hashes = source.prepare(folder, progress)
        config = _with_inputs(folder, config, hashes)
        with clock.stage("calibration"), progress.stage("Calibrating and planning"):
            knowledge = prepare_knowledge(scenario, source, scenario.mission.seed)
            if knowledge.draws.record is not None:
                text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
                atomic_write_text(folder / CALIBRATION_NAME, text + "\n")
        with clock.stage("mission"), _kept(folder):
            result = _fly(folder, config, knowledge, source, progress)
        with clock.stage("store"), progress.stage("Storing"), _kept(folder):
            figures = _store(folder, config, knowledge, source, result)
        with clock.stage("report"), progress.stage("Writing the report"), _kept(folder):
            report = _report(folder)
        timing = _timing(result.flight, clock)
        write_timing(folder, timing)
        return RunOutcome(folder, report, figures, timing)
    finally:
        os.close(lock)


@contextmanager
def _kept(folder: Path) -> Iterator[None]:
    """Add to any error how the run can be continued."""
    try:
        yield
    except NotResumableError:
        raise
    except Exception as error:
        error.add_note(
            f"What was flown is kept: once mended, continue with `uav-twin run --resume {folder}`."
        )
        raise


def _with_inputs(folder: Path, config: dict[str, Any], hashes: Mapping[str, str]) -> dict[str, Any]:
    """Note the hashes of what is flown; refuse to go on with something else."""
    recorded = config.get("inputs")
    if recorded is not None and recorded != dict(hashes):
        changed = sorted(name for name in {*recorded, *hashes} if recorded.get(name) != hashes.get(name))
        raise NotResumableError(
            f"the {', '.join(changed).replace('_', ' ')} changed since the run in {folder} was begun: "
            "fly the mission again with --replace."
        )
    if recorded is None:
        config = {**config, "inputs": dict(hashes)}
        write_config(folder, config)
    return config


def _fly(
    folder: Path, config: Mapping[str, Any], knowledge: Knowledge, source: AssetSource, progress: Progress
) -> MissionResult:
    config_hash = hash_record(config)
    scenario = knowledge.scenario
    truth = knowledge.truth(scenario.mission.seed)
    asset = source.open()
    try:
        flight = fly(
            scenario,
            knowledge.twin(),
            knowledge.plant(truth, asset),
            config_hash=config_hash,
            checkpoint=read_checkpoint(folder, config_hash),
            keep=lambda checkpoint: write_checkpoint(folder, checkpoint),
            progress=progress,
        )
        units = asset.units
    finally:
        asset.close()
    return MissionResult(
        scenario=scenario,
        model=knowledge.model,
        sensor_model=knowledge.sensor_model,
        draws=knowledge.draws.values,
        rewards=knowledge.rewards,
        plan=knowledge.plan,
        truth=truth,
        flight=flight,
        units=units,
    )


def _store(
    folder: Path, config: Mapping[str, Any], knowledge: Knowledge, source: AssetSource, result: MissionResult
) -> tuple[Figure, ...]:
    provenance, mission = config["provenance"], knowledge.scenario.mission
    attributes = {
        "title": mission.title or mission.name,
        "scenario": mission.name,
        "seed": mission.seed,
        "config_hash": hash_record(config),
        "versions": json.dumps(provenance["versions"], sort_keys=True),
        "source_hashes": json.dumps(provenance["source_hashes"], sort_keys=True),
        "input_hashes": json.dumps(config["inputs"], sort_keys=True),
        "observed_quantity": knowledge.scenario.observation.role,
        "parameter": knowledge.draws.name,
        "parameter_source": knowledge.draws.source,
    }
    tree = store_mission(folder, result, attributes, _field_writer(knowledge, source, result))
    figures = summarise(result, knowledge.draws, values_of(tree, "filtered", "reward_mean"))
    write_summary(
        folder,
        figures,
        {"scenario": mission.name, "title": mission.title, "seed": mission.seed, "steps": mission.steps},
    )
    return figures


def _field_writer(
    knowledge: Knowledge, source: AssetSource, result: MissionResult
) -> Callable[[Path], object]:
    """Return what writes the field under the last estimate and the last control."""
    flight, scenario = result.flight, knowledge.scenario
    estimate = knowledge.model.states.mean(flight.filtered[-1]).tolist()
    state = dict(zip(scenario.state_names, estimate, strict=True))
    control = scenario.control[int(flight.control_index[-1])].values
    return lambda path: source.write_field(path, state, control)


def _timing(flight: Flight, clock: _Clock) -> dict[str, Any]:
    """Return the content of `timing.json`: seconds of the stages, and of the turns flown by this process."""
    record: dict[str, Any] = {
        "stages_seconds": dict(clock.stages),
        "total_seconds": time.perf_counter() - clock.begin,
        "resumed_at": flight.resumed_at,
        "turns": len(flight.timing),
    }
    for name in ("asset", "twin", "checkpoint"):
        values = np.array([getattr(turn, name) for turn in flight.timing])
        if len(values):
            record[f"{name}_seconds"] = {
                "total": float(values.sum()),
                "median": float(np.median(values)),
                "largest": float(values.max()),
                "last": float(values[-1]),
            }
    return record


def _report(folder: Path) -> Path:
    from twin_master.report.page import write_report

    return write_report(folder)
