"""The whole chain: design -> reduced model -> FMU -> calibration -> mission -> store -> report.

`check_scenario` checks a scenario in advance, from the scenario and the small files beside it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from math import prod
from pathlib import Path

import numpy as np

from reporting.arrays import Float
from reporting.files import atomic_write_text, hash_file, hash_record
from reporting.json_file import JsonObject
from reporting.progress import Progress, SilentProgress
from twin_master import run_folder
from twin_master.assets.asset_source import (
    AssetSource,
    calibration_sentence,
    noise_free_observations,
)
from twin_master.assets.resolution import (
    OverridesOrMapping,
    asset_source,
    believed_source,
    memory_of_scenario,
    resolve_scenario,
)
from twin_master.errors import NotResumableError
from twin_master.mission import flights
from twin_master.mission.journal import JOURNAL_NAME, JournalFile
from twin_master.mission.knowledge_file import save_knowledge
from twin_master.mission.parts import GivenEstimator, GivenPolicy, GivenSensorModel, TwinParts
from twin_master.mission.planning import encode_policy, read_policy
from twin_master.mission.preparation import Knowledge, prepare_knowledge
from twin_master.mission.replay import journal_sink, restore_flight
from twin_master.mission.steps import History
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.kinds import WATCHED_KIND
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.summary import truth_mismatch
from twin_master.store.writing import (
    TIMING_NAME,
    RunOutcome,
    finished_run,
    read_outcome,
    store_flight,
)

POLICY_NAME = "policy.npy"
"""The file of a run folder with the policy that is flown instead of a plan."""


Begun = Callable[[Path], None]
"""A function that is called with the run folder once it is made and locked, before modelling."""


def fly(
    scenario: LoadedScenario | str | Path,
    folder: Path | str | None = None,
    overrides: OverridesOrMapping | None = None,
    *,
    policy: GivenPolicy | None = None,
    sensor_model: GivenSensorModel | None = None,
    estimator: GivenEstimator | None = None,
    replace: bool = False,
    report: bool = True,
    progress: Progress | None = None,
    begun: Begun | None = None,
) -> RunOutcome:
    """Fly a scenario into a new run folder.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    folder : Path or str, optional
        The run folder to make; ``runs/NAME`` by default.
    overrides : Overrides or mapping, optional
        What differs from the file: the fields of `Overrides`, such as ``{"seed": 3, "fmu":
        "wing.fmu"}``.
    policy : (S, U) array, BeliefPolicy, callable, Path or str, optional
        The policy that is flown instead of a plan: p(U | D), row-stochastic, states in the order of
        `Knowledge.model.states`, controls in that of the scenario; or a policy on the belief; or a
        function that returns a policy for a `GraphicalModel`; or the file or the name of any of
        these. The run folder keeps the policy.
    sensor_model : GaussianSensorModel, callable or str, optional
        The sensor model in the place of the scenario's: an object, a function that makes it of what
        the twin knows (see `prepare_twin`), or the name of either.
    estimator : Estimator, callable or str, optional
        The estimator of the belief in the place of the scenario's: an object, a function that makes
        it of what the twin knows, or the name of either. A name is ``MODULE:NAME``,
        ``FILE.py:NAME``, or that of an entry point.
    replace : bool
        Whether to replace an existing run folder.
    report : bool
        Whether to write the report.
    progress : Progress, optional
        The display of the progress in stages.
    begun : callable, optional
        Called with the run folder before the first stage.

    Returns
    -------
    RunOutcome
        The figures of the run, and its files.

    Raises
    ------
    RunFolderError
        If the folder exists.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError, ReportingError
        If the mission cannot be flown; the error is one clear sentence, and the run folder stays
        resumable.
    """
    loaded_scenario = load_scenario(scenario)
    resolved_scenario = resolve_scenario(loaded_scenario, overrides)
    folder = Path("runs") / resolved_scenario.mission.name if folder is None else Path(folder)
    progress = progress or SilentProgress()
    resolved_scenario, parts = TwinParts(policy, sensor_model, estimator).in_scenario(
        resolved_scenario
    )
    parts.with_objects()  # so that a wrong name is refused before the folder is made
    policy_files = {}
    model = build_graphical_model(resolved_scenario)
    policy_on_states = parts.policy_for(model)
    if policy_on_states is not None:
        policy_files[POLICY_NAME] = encode_policy(policy_on_states, model)
    if loaded_scenario.remark:
        progress.note(loaded_scenario.remark)
    run_folder.restore(folder, progress)
    source = asset_source(resolved_scenario)
    source.check()  # before the folder is made, so that missing input leaves none behind
    new_folder = run_folder.new_run_folder(
        resolved_scenario,
        loaded_scenario.file,
        folder,
        source.files() | policy_files,
        replace=replace,
        parts=parts.record(),
    )
    with new_folder as locked:
        return _run(folder, locked, parts, progress, begun, report=report)


def resume(
    folder: Path | str,
    loaded_scenario: LoadedScenario | None = None,
    *,
    sensor_model: GivenSensorModel | None = None,
    estimator: GivenEstimator | None = None,
    report: bool = True,
    progress: Progress | None = None,
    begun: Begun | None = None,
) -> RunOutcome:
    """Continue an interrupted run; the results are those of an uninterrupted one, to the bit.

    Parameters
    ----------
    folder : Path or str
        The path of the run folder.
    loaded_scenario : LoadedScenario, optional
        The scenario that the user expects to be flown; it is compared with that of the folder.
    sensor_model, estimator : optional
        The same as for `fly`, if the run was begun with any.
    report : bool
        Whether to write the report.
    progress : Progress, optional
        The display of the progress in stages.
    begun : callable, optional
        Called with the run folder before the first stage.

    Raises
    ------
    NotResumableError
        If the folder holds no run, or one of another scenario, other parts or another version.
    """
    folder = Path(folder)
    parts = TwinParts(None, sensor_model, estimator)
    progress = progress or SilentProgress()
    run_folder.restore(folder, progress)
    with run_folder.hold_run_folder(folder, loaded_scenario) as locked:
        finished = finished_run(folder)
        if finished is not None and (finished.report or not report):
            progress.note(f"The run in {folder} is finished: nothing is flown again.")
            return finished
        run_folder.check_versions(folder, locked.config, locked.scenario.mission.seed)
        parts.check_same(locked.config.get("parts", {}), folder)
        return _run(folder, locked, parts, progress, begun, report=report)


def _run(
    folder: Path,
    locked: run_folder.LockedRun,
    parts: TwinParts,
    progress: Progress,
    begun: Begun | None,
    *,
    report: bool,
) -> RunOutcome:
    """Go through all stages of a run; an interrupted run continues where it stopped."""
    scenario = locked.scenario
    run_folder.remove_half_written_files(folder)
    if begun is not None:
        begun(folder)
    start = time.perf_counter()
    seconds_of_stages: dict[str, float] = {}

    @contextmanager
    def timed(stage: str) -> Iterator[None]:
        begin = time.perf_counter()
        with _advice_on_error(folder):
            yield
        seconds_of_stages[stage] = time.perf_counter() - begin

    source = asset_source(scenario)
    with timed("asset"):
        hashes = dict(source.prepare(folder, progress))
        policy = None
        policy_path = folder / POLICY_NAME
        if policy_path.is_file():
            hashes["policy"] = hash_file(policy_path)
            policy = read_policy(policy_path, build_graphical_model(scenario))
    config = run_folder.record_inputs(folder, locked.config, hashes)
    with timed("calibration"), progress.stage("Calibrating and planning"):
        knowledge = prepare_knowledge(scenario, source, scenario.mission.seed, policy, parts)
        _note_mismatches(config, knowledge, source, progress)
        save_knowledge(folder, knowledge)
        _compile_twin(knowledge)
    with timed("mission"):
        result = _fly(folder, config, knowledge, source, progress)
    with timed("store"), progress.stage("Storing"):
        store_flight(
            folder,
            config,
            result,
            source.origin,
            steps=scenario.mission.steps,
            misfit=_model_misfit(knowledge, source),
            write_field=_field_writer(source, result),
        )
    timing = _timing_record(result.flight)
    del knowledge, result  # their memory is needed for the report
    if report:
        with timed("report"), progress.stage("Writing the report"):
            _write_report(folder)
    timing["stages_seconds"] = seconds_of_stages
    timing["total_seconds"] = time.perf_counter() - start
    # Times stand in a file of their own, so that all other files of a run can be compared by bytes.
    atomic_write_text(folder / TIMING_NAME, run_folder.to_json(timing))
    return read_outcome(folder)


def _note_mismatches(
    config: JsonObject, knowledge: Knowledge, source: AssetSource, progress: Progress
) -> None:
    """Tell the user if the asset or the believed model is not the one that was calibrated."""
    scenario = knowledge.scenario
    draws = knowledge.draws
    truth = scenario.asset.true_parameters.get(draws.name)
    # The scenario may give the flown asset another parameter than the calibrated one has.
    if scenario.calibration.source == "file" and truth is not None:
        mismatch = truth_mismatch(draws.name, truth, draws.mean, draws.standard_deviation)
        if mismatch is not None:
            progress.note(
                f"{mismatch} To fly the calibrated asset, leave {draws.name} out of `parameters` "
                "in the scenario's table `asset`."
            )
    calibrated = calibration_sentence(
        draws.record or {}, source.origin.asset, source.origin.model, config["inputs"]
    )
    if calibrated is not None:
        progress.note(calibrated)


def _compile_twin(knowledge: Knowledge) -> None:
    """Let a twin assimilate two steps without observations, so that its inner loops are compiled.

    Otherwise the first steps of the flight would take seconds longer than the others.
    """
    twin = knowledge.twin()
    nothing_observed = np.full(knowledge.scenario.observation.count, np.nan)
    for _ in range(2):
        twin.step(nothing_observed, 0)
    twin.smoothed()


@contextmanager
def _advice_on_error(folder: Path) -> Iterator[None]:
    """Add to any error how to continue the run, or how to begin again before its first step."""
    try:
        yield
    except NotResumableError:
        raise
    except Exception as error:
        if (folder / JOURNAL_NAME).exists():
            error.add_note(
                f"What was flown is kept: continue with `uav-twin run --resume {folder}`, or, "
                "where the scenario itself is to be changed, fly the changed one with --replace."
            )
        else:
            error.add_note(
                "Nothing was flown yet: correct the cause, and fly again with --replace."
            )
        raise


def _fly(
    folder: Path,
    config: JsonObject,
    knowledge: Knowledge,
    source: AssetSource,
    progress: Progress,
) -> MissionResult:
    """Fly the mission, or the remaining steps of an interrupted one, with a journal."""
    scenario = knowledge.scenario
    truth = knowledge.truth(scenario.mission.seed)
    with (
        closing(source.open()) as asset,
        JournalFile(folder, hash_record(config)) as journal,
    ):
        plant = knowledge.plant(truth, asset)
        earlier_steps = restore_flight(journal, knowledge, plant)
        flight = flights.fly(
            scenario,
            earlier_steps.twin,
            plant,
            journal_sink(journal, plant),
            history=earlier_steps,
            progress=progress,
        )
        return MissionResult(scenario, knowledge, flight, truth, asset.units)


def _model_misfit(knowledge: Knowledge, source: AssetSource) -> Float | None:
    """Return the relative difference of predicted to true observations (S, U, G).

    None is returned if asset and model are not known to differ.
    """
    # An asset with damage of its own cannot be put into a state that the twin chooses.
    if not source.origin.differ or knowledge.scenario.truth.kind == "asset":
        return None
    states = knowledge.model.states.coordinates
    with closing(source.open()) as asset:
        observation = noise_free_observations(knowledge.scenario, states, asset)
    observation[observation == 0.0] = np.nan
    return np.asarray((knowledge.sensor_model.mean - observation) / observation)


def _field_writer(source: AssetSource, result: MissionResult) -> Callable[[Path], object]:
    """Return a function that writes the field for the last estimate and the last control."""
    scenario = result.scenario
    last_step = result.flight.steps[-1].twin_step
    estimate = result.knowledge.model.states.mean(last_step.filtered).tolist()
    state = {}
    for factor, value in zip(scenario.state, estimate, strict=True):
        # Rounding may put the mean a little beyond the last level, where no model holds.
        state[factor.name] = min(max(value, factor.levels[0]), factor.levels[-1])
    control = scenario.control[last_step.control_index].values
    return lambda path: source.write_field(path, state, control)


def _timing_record(flight: History) -> JsonObject:
    """Return the times of the steps that this process flew, in seconds."""
    seconds = flight.seconds[flight.resumed_at :]
    record: JsonObject = {"resumed_at": flight.resumed_at, "steps": len(seconds)}
    if len(seconds) == 0:
        return record
    for name, seconds_of_part in zip(("asset", "twin", "checkpoint"), seconds.T, strict=True):
        record[f"{name}_seconds"] = {
            "total": float(seconds_of_part.sum()),
            "median": float(np.median(seconds_of_part)),
            "largest": float(seconds_of_part.max()),
            "last": float(seconds_of_part[-1]),
        }
    return record


def _write_report(folder: Path) -> None:
    """Write the report of a run."""
    from twin_master.report.page import write_report  # it loads matplotlib

    write_report(folder)


def check_scenario(
    loaded_scenario: LoadedScenario, overrides: OverridesOrMapping | None = None
) -> JsonObject:
    """Check a scenario and its files; return the asset that flies and the model of the twin.

    Parameters
    ----------
    overrides : Overrides or mapping, optional
        What differs from the file, as for `fly`.

    Returns
    -------
    dict
        What is flown and believed, in words, and the size of the twin: the number of `levels` of
        each factor, of joint `states` and of `sensors`, the `controls`, and the `memory` of all
        arrays in bytes.

    Raises
    ------
    MissionInputError
        If a file is missing, or the binding does not know a name of the scenario.
    InvalidModelError
        If the twin does not fit in memory.
    BindingError, InvalidDesignError, DesignFileError
        If the binding or the design is wrong.
    """
    scenario = resolve_scenario(loaded_scenario, overrides)
    is_watched = scenario.asset.kind == WATCHED_KIND
    source = believed_source(scenario) if is_watched else asset_source(scenario)
    source.check()
    mission = scenario.mission
    origin_of_draws, draws = source.draw_summary()
    levels = {factor.name: len(factor.levels) for factor in scenario.state}
    return {
        "name": mission.name,
        "title": mission.title,
        "flown": "nothing, a real asset is watched" if is_watched else source.origin.asset,
        "believed": source.origin.model,
        "uncertain": f"{scenario.calibration.parameter}, from {origin_of_draws}",
        "draws": draws,
        "levels": levels,
        "states": prod(levels.values()),
        "controls": scenario.control_names,
        "sensors": scenario.observation.count,
        "steps": mission.steps,
        "prediction_steps": mission.prediction_steps,
        "step_name": mission.step_name,
        "memory": sum(memory_of_scenario(scenario).values()),
    }
