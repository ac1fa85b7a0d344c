"""The whole chain: design -> reduced model -> FMU -> calibration -> mission -> store -> report.

A scenario can be checked before: only it and the small files beside it are read, so that it takes no time.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from reporting.files import atomic_write_text, hash_file, hash_record
from reporting.progress import Progress, SilentProgress
from twin_master import run_folder
from twin_master.assets.asset_source import AssetSource, calibration_sentence, noise_free_observations
from twin_master.assets.resolution import (
    Overrides,
    asset_source,
    believed_source,
    resolve_scenario,
    scenario_bytes,
)
from twin_master.errors import NotResumableError, said
from twin_master.mission import loop
from twin_master.mission.journal import JOURNAL_NAME, JournalFile
from twin_master.mission.planning import policy_file, read_policy
from twin_master.mission.preparation import Knowledge, keep_knowledge, prepare_knowledge
from twin_master.mission.steps import History
from twin_master.network.planner import BeliefPolicy
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.consistency import WATCHED_KIND
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import another_truth
from twin_master.store.writing import TIMING_NAME, RunOutcome, finished_run, read_outcome, store_flight

POLICY_NAME = "policy.npy"
"""In the run folder: the policy that was given in the place of a plan, (S, U) or on the belief."""


Begun = Callable[[Path], None]
"""Told the run folder once it is there and held, before anything is modelled."""


def fly(
    scenario: LoadedScenario | str | Path,
    folder: Path | str | None = None,
    overrides: Overrides | Mapping[str, Any] | None = None,
    *,
    policy: ArrayLike | BeliefPolicy | Path | None = None,
    replace: bool = False,
    report: bool = True,
    progress: Progress | None = None,
    begun: Begun | None = None,
) -> RunOutcome:
    """Fly a scenario into a new run folder.

    Parameters
    ----------
    scenario
        The scenario, its shipped name, or its file.
    folder
        The run folder to make; ``runs/NAME`` by default.
    overrides
        What differs from the file: the fields of `Overrides`, such as ``{"seed": 3, "fmu": "wing.fmu"}``.
    policy : (S, U), BeliefPolicy or Path
        To fly instead of planning: p(U | D), row-stochastic, states in the order of `Knowledge.model.states`,
        controls in that of the scenario; or a policy on the belief, or its file. The run folder keeps it.
    replace
        Take the place of an existing run folder.
    report
        Draw the report.
    progress
        Shows the stages.
    begun
        Called with the run folder before the first stage.

    Raises
    ------
    RunFolderError
        The folder exists.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError, ReportingError
        With one clear sentence; the run folder stays resumable.
    """
    loaded = load_scenario(scenario)
    resolved = resolve_scenario(loaded, overrides)
    folder = Path("runs") / resolved.mission.name if folder is None else Path(folder)
    progress = progress or SilentProgress()
    files = {}
    if policy is not None:
        model = build_graphical_model(resolved)
        given = read_policy(policy, model) if isinstance(policy, Path) else policy
        files[POLICY_NAME] = policy_file(given, model)
    if loaded.remark:
        progress.note(loaded.remark)
    run_folder.restore(folder, progress)
    source = asset_source(resolved)
    source.check()  # what is not there costs the user no folder
    opened = run_folder.begun_folder(resolved, loaded.file, folder, source.files() | files, replace=replace)
    with opened as (config, located):
        return _run(folder, config, located, progress, begun, report=report)


def resume(
    folder: Path | str,
    loaded: LoadedScenario | None = None,
    *,
    report: bool = True,
    progress: Progress | None = None,
    begun: Begun | None = None,
) -> RunOutcome:
    """Continue an interrupted run; the results are those of an uninterrupted one, bit for bit.

    Parameters
    ----------
    folder
        The run folder.
    loaded
        The scenario that the user believes to be flown; checked against the folder.
    report
        Draw the report.
    progress
        Shows the stages.
    begun
        Called with the run folder before the first stage.

    Raises
    ------
    NotResumableError
        The folder holds no run, or one of another scenario or another version.
    """
    folder, progress = Path(folder), progress or SilentProgress()
    run_folder.restore(folder, progress)
    with run_folder.resumed_folder(folder, loaded) as (config, scenario):
        finished = finished_run(folder)
        if finished is not None and (finished.report or not report):
            progress.note(f"The run in {folder} is finished: nothing is flown again.")
            return finished
        run_folder.check_versions(folder, config, scenario.mission.seed)
        return _run(folder, config, scenario, progress, begun, report=report)


def _run(
    folder: Path,
    config: dict[str, Any],
    scenario: Scenario,
    progress: Progress,
    begun: Begun | None,
    *,
    report: bool,
) -> RunOutcome:
    run_folder.tidy(folder)
    if begun is not None:
        begun(folder)
    start, stages = time.perf_counter(), dict[str, float]()

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        begin = time.perf_counter()
        with _noted(folder):
            yield
        stages[name] = time.perf_counter() - begin

    source = asset_source(scenario)
    with timed("asset"):
        hashes, policy, given = dict(source.prepare(folder, progress)), None, folder / POLICY_NAME
        if given.is_file():
            hashes["policy"] = hash_file(given)
            policy = read_policy(given, build_graphical_model(scenario))
    config = run_folder.with_inputs(folder, config, hashes)
    with timed("calibration"), progress.stage("Calibrating and planning"):
        knowledge = _known(folder, config, scenario, source, policy, progress)
    with timed("mission"):
        result = _fly(folder, config, knowledge, source, progress)
    with timed("store"), progress.stage("Storing"):
        store_flight(
            folder, config, result, source.origin, steps=scenario.mission.steps,
            misfit=_misfit(knowledge, source), write_field=_field_writer(source, result),
        )  # fmt: skip
    timing = _timing(result.flight)
    del knowledge, result  # before the report is drawn
    if report:
        with timed("report"), progress.stage("Writing the report"):
            _report(folder)
    timing |= {"stages_seconds": stages, "total_seconds": time.perf_counter() - start}
    # The only file with figures of a clock.
    atomic_write_text(folder / TIMING_NAME, run_folder.to_json(timing))
    return read_outcome(folder)


def _known(
    folder: Path,
    config: Mapping[str, Any],
    scenario: Scenario,
    source: AssetSource,
    policy: Float | BeliefPolicy | None,
    progress: Progress,
) -> Knowledge:
    """Return what the twin knows before its flight, and keep it."""
    knowledge = prepare_knowledge(scenario, source, scenario.mission.seed, policy)
    draws, origin = knowledge.draws, source.origin
    truth = scenario.asset.true_parameters.get(draws.name)
    # The true asset of the scenario may not be the one that the calibration file describes.
    if scenario.calibration.source == "file" and truth is not None:
        sentence = another_truth(draws.name, truth, draws.mean, draws.standard_deviation)
        if sentence is not None:
            progress.note(said("mission.truth", sentence=sentence, name=draws.name))
    told = calibration_sentence(draws.record or {}, origin.asset, origin.model, config["inputs"])
    if told is not None:
        progress.note(told)
    keep_knowledge(folder, knowledge)
    # Steps without observations on a twin of its own compile the inner loops before the flight.
    compiling = knowledge.twin()
    for _ in range(2):
        compiling.step(np.full(scenario.observation.count, np.nan), 0)
    compiling.smoothed()
    return knowledge


@contextmanager
def _noted(folder: Path) -> Iterator[None]:
    """Add to any error how the run can be continued, or begun anew before its first step."""
    try:
        yield
    except NotResumableError:
        raise
    except Exception as error:
        error.add_note(
            said("mission.flown", folder=folder)
            if (folder / JOURNAL_NAME).exists()
            else said("mission.begun")
        )
        raise


def _fly(
    folder: Path, config: Mapping[str, Any], knowledge: Knowledge, source: AssetSource, progress: Progress
) -> MissionResult:
    scenario = knowledge.scenario
    truth = knowledge.truth(scenario.mission.seed)
    with closing(source.open()) as asset, JournalFile(folder, hash_record(config)) as journal:
        plant = knowledge.plant(truth, asset)
        flown = loop.taken_up(journal, knowledge, plant)
        keep = loop.kept_in(journal, plant)
        flight = loop.fly(scenario, flown.twin, plant, keep, history=flown, progress=progress)
        return MissionResult(scenario, knowledge, flight, truth, asset.units)


def _misfit(knowledge: Knowledge, source: AssetSource) -> Float | None:
    """Return by which shares (S, U, G) predictions and asset differ, where their models are known to."""
    # An asset with damage of its own cannot be asked at a state of the twin's choice.
    if not source.origin.differ or knowledge.scenario.truth.kind == "asset":
        return None
    with closing(source.open()) as asset:
        shown = noise_free_observations(knowledge.scenario, knowledge.model.states.coordinates, asset)
    shown[shown == 0.0] = np.nan
    return np.asarray((knowledge.sensor_model.mean - shown) / shown)


def _field_writer(source: AssetSource, result: MissionResult) -> Callable[[Path], object]:
    """Return what writes the field under the last estimate and the last control."""
    last, scenario = result.flight.steps[-1].concluded, result.scenario
    estimate = result.knowledge.model.states.mean(last.filtered).tolist()
    # A belief that is sure of the last level may round to a little beyond it, where no model holds.
    state = {
        factor.name: min(max(value, factor.levels[0]), factor.levels[-1])
        for factor, value in zip(scenario.state, estimate, strict=True)
    }
    control = scenario.control[last.control_index].values
    return lambda path: source.write_field(path, state, control)


def _timing(flight: History) -> dict[str, Any]:
    """Return the seconds of the steps flown by this process."""
    seconds = flight.seconds[flight.resumed_at :]
    record: dict[str, Any] = {"resumed_at": flight.resumed_at, "steps": len(seconds)}
    for name, values in zip(("asset", "twin", "checkpoint"), seconds.T if len(seconds) else (), strict=False):
        record[f"{name}_seconds"] = {
            "total": float(values.sum()),
            "median": float(np.median(values)),
            "largest": float(values.max()),
            "last": float(values[-1]),
        }
    return record


def _report(folder: Path) -> None:
    from twin_master.report.page import write_report

    write_report(folder)


def check_scenario(
    loaded: LoadedScenario, overrides: Overrides | Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return what a scenario is with the overrides, once everything that it names was looked at.

    Beside what it flies and believes, in words, these are the sizes of the twin: `levels` of each factor,
    joint `states`, `controls`, `sensors`, and the `memory` of all its arrays [bytes].

    Raises
    ------
    MissionInputError
        A file is missing, or a name of the scenario is none of its binding's.
    InvalidModelError
        The twin does not fit in memory.
    BindingError, InvalidDesignError, DesignFileError
        The binding or the design is wrong.
    """
    scenario = resolve_scenario(loaded, overrides)
    watched = scenario.asset.kind == WATCHED_KIND
    source = believed_source(scenario) if watched else asset_source(scenario)
    source.check()
    origin, mission, (drawn, draws) = source.origin, scenario.mission, source.draw_summary()
    levels = {factor.name: len(factor.levels) for factor in scenario.state}
    return {
        "name": mission.name,
        "title": mission.title,
        "flown": "nothing, a real asset is watched" if watched else origin.asset,
        "believed": origin.model,
        "uncertain": f"{scenario.calibration.parameter}, from {drawn}",
        "draws": draws,
        "levels": levels,
        "states": prod(levels.values()),
        "controls": scenario.control_names,
        "sensors": scenario.observation.count,
        "steps": mission.steps,
        "prediction_steps": mission.prediction_steps,
        "step_name": mission.step_name,
        "memory": sum(scenario_bytes(scenario).values()),
    }
