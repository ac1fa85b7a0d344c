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
from reporting.provenance import collect_provenance, hash_record
from twin_master.asset_source import AssetSource, Origin
from twin_master.checkpoint import CHECKPOINT_NAME, read_checkpoint, write_checkpoint
from twin_master.crew import Knowledge, prepare_knowledge
from twin_master.errors import NotResumableError
from twin_master.mismatch import Misfit, find_misfit
from twin_master.mission import Flight, fly
from twin_master.resolution import (
    Overrides,
    asset_source,
    located_scenario,
    portable_scenario,
    resolve_scenario,
)
from twin_master.results import MissionResult
from twin_master.run_folder import (
    CONFIG_NAME,
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
from twin_master.summary import Figure, summarise

REPORT_NAME = "report.html"
CALIBRATION_NAME = "calibration.json"
HARMLESS_PACKAGES = frozenset({"discrepancy", "reporting", "scenarios", "uav_twin", "matplotlib"})
"""A run may be resumed after a change of these: no stored figure depends on them."""


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
    origin : Origin
        What was flown and what the twin believed, in words.
    step_name : str
        What a step is called.
    """

    folder: Path
    report: Path
    figures: tuple[Figure, ...]
    timing: Mapping[str, Any]
    origin: Origin
    step_name: str = "turn"


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
        "scenario": portable_scenario(scenario).to_dict(),
        "scenario_file": {"name": loaded.path.name, "sha256": loaded.content_hash},
        "provenance": collect_provenance(scenario.mission.seed).as_dict(),
    }
    source = asset_source(scenario)
    source.check()  # what is not there should not cost the user a folder
    create_run_folder(folder, config, source.files(), replace=replace)
    return _run(
        folder, config, located_scenario(portable_scenario(scenario), folder), progress or SilentProgress()
    )


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
    scenario = parse_scenario(config["scenario"], str(folder / CONFIG_NAME))
    recorded = config["provenance"]
    file = config["scenario_file"]
    if loaded is not None and file.get("sha256") != loaded.content_hash:
        raise NotResumableError(
            f"{folder} flies another scenario ({scenario.mission.name}, {file.get('name')}) "
            f"than {loaded.path}: resume it without naming a scenario."
        )
    now = collect_provenance(scenario.mission.seed).as_dict()
    for what in ("versions", "source_hashes"):
        changed = sorted(
            name
            for name, value in now[what].items()
            if name not in HARMLESS_PACKAGES and _entry(recorded, what, name) != value
        )
        if changed:
            raise NotResumableError(
                f"{folder} was begun with another version of {', '.join(changed)}, so its results could not "
                "be the same: fly the mission again with --replace."
            )
    return _run(folder, config, located_scenario(scenario, folder), progress or SilentProgress())


def _entry(record: Mapping[str, Any], table: str, name: str) -> object:
    entries = record.get(table)
    return entries.get(name) if isinstance(entries, dict) else None


def _run(folder: Path, config: dict[str, Any], scenario: Scenario, progress: Progress) -> RunOutcome:
    lock = lock_run_folder(folder)
    try:
        tidy(folder)
        clock = _Clock()
        source = asset_source(scenario)
        with _unflown(folder), clock.stage("asset"):
            hashes = source.prepare(folder, progress)
        config = _with_inputs(folder, config, hashes)
        with (
            _unflown(folder),
            clock.stage("calibration"),
            progress.stage("Calibrating and planning"),
        ):
            knowledge = prepare_knowledge(scenario, source, scenario.mission.seed)
            _tell_of_another_truth(knowledge, progress)
            if knowledge.draws.record is not None:
                text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
                atomic_write_text(folder / CALIBRATION_NAME, text + "\n")
            # A turn without observations on a twin of its own compiles the inner loops before the flight.
            knowledge.twin().turn(np.full(scenario.observation.count, np.nan), 0)
        with clock.stage("mission"), _kept(folder):
            result = _fly(folder, config, knowledge, source, progress)
        with clock.stage("store"), progress.stage("Storing"), _kept(folder):
            figures = _store(folder, config, knowledge, source, result)
        with clock.stage("report"), progress.stage("Writing the report"), _kept(folder):
            report = _report(folder)
        timing = _timing(result.flight, clock)
        write_timing(folder, timing)
        return RunOutcome(folder, report, figures, timing, source.origin, scenario.mission.step_name)
    finally:
        os.close(lock)


def _tell_of_another_truth(knowledge: Knowledge, progress: Progress) -> None:
    """Say so where the true wing of the scenario is not the one that the calibration file describes."""
    draws, scenario = knowledge.draws, knowledge.scenario
    truth = scenario.asset.parameters.get(draws.name)
    if scenario.calibration.source != "file" or truth is None:
        return
    off = abs(truth - draws.mean)
    if off > 3.0 * draws.standard_deviation:
        progress.note(
            f"The scenario's true {draws.name} is {truth:.5g}, but the calibration says {draws.mean:.5g} "
            f"± {draws.standard_deviation:.2g}: the twin flies with the model of another wing. To fly the "
            "calibrated wing, leave it out of `parameters` in the scenario's table `asset`."
        )


@contextmanager
def _kept(folder: Path) -> Iterator[None]:
    """Add to any error how the run can be continued."""
    try:
        yield
    except NotResumableError:
        raise
    except Exception as error:
        error.add_note(
            f"What was flown is kept: continue with `uav-twin run --resume {folder}`, or, where the scenario "
            "itself is to be changed, fly the changed one with --replace."
        )
        raise


@contextmanager
def _unflown(folder: Path) -> Iterator[None]:
    """Add to any error before the first turn how to begin anew."""
    try:
        yield
    except Exception as error:
        if not (folder / CHECKPOINT_NAME).exists():
            error.add_note("Nothing was flown yet: once this is mended, fly again with --replace.")
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
        "asset": source.origin.asset,
        "twin_model": source.origin.model,
    }
    tree = store_mission(folder, result, attributes, _field_writer(knowledge, source, result))
    figures = summarise(
        result, knowledge.draws, values_of(tree, "filtered", "reward_mean"), _misfit(knowledge, source)
    )
    heading = {"scenario": mission.name, "title": mission.title, "seed": mission.seed, "steps": mission.steps}
    origin = {"asset": source.origin.asset, "twin_model": source.origin.model}
    write_summary(folder, figures, heading | origin | {"asset_and_model_differ": source.origin.differ})
    return figures


def _misfit(knowledge: Knowledge, source: AssetSource) -> Misfit | None:
    """Return by how much the twin's model differs from the asset, where they are known to differ."""
    # An asset with damage of its own cannot be asked at a state of the twin's choice.
    if not source.origin.differ or knowledge.scenario.truth.kind == "asset":
        return None
    asset = source.open()
    try:
        return find_misfit(knowledge.scenario, knowledge.model, knowledge.sensor_model, asset)
    finally:
        asset.close()


def _field_writer(
    knowledge: Knowledge, source: AssetSource, result: MissionResult
) -> Callable[[Path], object]:
    """Return what writes the field under the last estimate and the last control."""
    flight, scenario = result.flight, knowledge.scenario
    estimate = knowledge.model.states.mean(flight.filtered[-1]).tolist()
    # A belief that is sure of the last level may round to a little beyond it, where no model holds.
    state = {
        factor.name: min(max(value, factor.levels[0]), factor.levels[-1])
        for factor, value in zip(scenario.state, estimate, strict=True)
    }
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
