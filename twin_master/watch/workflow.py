"""A watch from its observations to its report, new or resumed, and its run up to a step."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from reporting.errors import DamagedFileError
from reporting.json_file import JsonObject, read_json
from reporting.progress import Progress, SilentProgress
from twin_master import run_folder
from twin_master.assets.resolution import (
    Overrides,
    OverridesOrMapping,
    as_overrides,
    believed_source,
    resolve_scenario,
)
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.feeds.broker_address import Broker
from twin_master.feeds.feed import Decision, DecisionSink, Feed, RecordedFeed
from twin_master.feeds.feed_choice import Observations, choose_feed
from twin_master.feeds.intake import Counts
from twin_master.feeds.mqtt_session import CLIENT_SUFFIX, DISCARD_SESSION
from twin_master.mission.journal import JOURNAL_NAME, last_step
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.writing import SUMMARY_NAME
from twin_master.store.writing import open_run as open_stored_run
from twin_master.watch.cause_search import CauseSearch
from twin_master.watch.decision_points import DecisionLines
from twin_master.watch.folder import GivenPatch, Watch
from twin_master.watch.mqtt import MqttFeed
from twin_master.watch.result import STORED_STEPS, store_watch
from twin_master.watch.teaching import check_teachable
from twin_master.watch.tutor import Tutor

if TYPE_CHECKING:
    import xarray as xr

    from twin_master.watch.metrics import MetricsServer


@contextmanager
def begin_watch(
    resolved_scenario: Scenario,
    file: Mapping[str, str],
    folder: Path,
    progress: Progress,
    *,
    replace_run: bool = False,
    sibling: Watch | None = None,
    fleet_is_locked: bool = False,
) -> Iterator[Watch]:
    """Create the folder of a new watch, and provide the watch while its folder is locked.

    Parameters
    ----------
    file : mapping of str to str
        Name and hash of the scenario file.
    folder : Path
        The folder to make.
    replace_run : bool
        Whether to replace an existing folder.
    sibling : Watch, optional
        A watch of the same scenario, with which model and plan are shared.
    fleet_is_locked : bool
        Whether the folder belongs to a fleet that this process has locked; see
        `run_folder.create_run_folder`.

    Raises
    ------
    RunFolderError
        If the folder exists and is not to be replaced.
    """
    source = believed_source(resolved_scenario)
    if sibling is None:  # else the same source was checked and prepared before
        source.check()
    files = source.files() | _client_files_to_discard(folder)
    opened = run_folder.new_run_folder(
        resolved_scenario,
        file,
        folder,
        files,
        replace=replace_run,
        watched=True,
        inputs=None if sibling is None else sibling.inputs,
        fleet_is_locked=fleet_is_locked,
    )
    with opened as (config, located_scenario):
        yield Watch(folder, config, located_scenario, progress, sibling)


def _client_files_to_discard(folder: Path) -> dict[str, bytes]:
    """Return files by which a new watch ends the session of the replaced one at a broker.

    They are the files of client names, each with a second line that asks for the end of the
    session. The client name is kept, because a broker ends a session only for a client of the same
    name.
    """
    files = {}
    for path in folder.glob(f"*{CLIENT_SUFFIX}"):
        client_name = path.read_bytes().partition(b"\n")[0]
        files[path.name] = client_name + f"\n{DISCARD_SESSION}\n".encode()
    return files


@contextmanager
def resume_watch(
    folder: Path,
    loaded_scenario: LoadedScenario | None,
    progress: Progress,
    sibling: Watch | None = None,
    *,
    fleet_is_locked: bool = False,
) -> Iterator[Watch]:
    """Provide the watch that is to be continued in a folder, and lock the folder meanwhile.

    Parameters
    ----------
    loaded_scenario : LoadedScenario or None
        The scenario that the folder must have; None accepts any.
    sibling : Watch, optional
        A watch of the same scenario, with which model and plan are shared.
    fleet_is_locked : bool
        Whether the folder belongs to a fleet that this process has locked; see
        `run_folder.create_run_folder`.

    Raises
    ------
    NotResumableError
        If the folder holds no watch, or one of another scenario or version.
    """
    if not run_folder.read_config(folder).get("watched"):
        raise NotResumableError(
            f"{folder} holds a run, no watch: continue it with `uav-twin run --resume {folder}`."
        )
    held = run_folder.hold_run_folder(folder, loaded_scenario, fleet_is_locked=fleet_is_locked)
    with held as (config, scenario):
        try:
            run_folder.check_versions(folder, config, scenario.mission.seed)
            resumed = Watch(folder, config, scenario, progress, sibling)
        except NotResumableError as error:
            error.add_note(
                "--replace would remove what was observed; another watch, in another folder, takes "
                f"it in with `--observations {folder}`."
            )
            raise
        yield resumed


@contextmanager
def copy_of_run_until(
    folder: Path, first: int | None, last: int | None, progress: Progress
) -> Iterator[Path]:
    """Provide a folder with the results of a run or a watch up to a step.

    The folder of a run is provided as it is. A watch may still go on and have no results yet:
    instead of its folder, a temporary copy is provided, with the journal up to the last step and
    the results of these steps. The copy is removed at the end of the context.

    Parameters
    ----------
    folder : Path
        The folder of a run or a watch, which is only read.
    first, last : int or None
        The first and the last step; None for the ends of the journal.

    Raises
    ------
    NotResumableError
        If the journal was changed or is damaged.
    MissionInputError
        If there is no step from the first one on.
    """
    config = _watch_config(folder)
    if config is None:
        yield folder
        return
    journal = folder / JOURNAL_NAME
    step, journal_end = last_step(journal, math.inf if last is None else last)
    if first is not None and step < first:
        available = f"the steps 0 to {step}" if step >= 0 else "no step"
        limit = "" if last is None else f" up to step {last}"
        raise MissionInputError(f"{folder} has {available}{limit}, and none from {first} on.")
    with TemporaryDirectory(prefix="uav_twin_") as parent:
        copy = Path(parent) / folder.resolve().name
        copy.mkdir()
        shutil.copy(folder / run_folder.CONFIG_NAME, copy)
        shutil.copytree(folder / "asset", copy / "asset")
        with journal.open("rb") as file:
            (copy / JOURNAL_NAME).write_bytes(file.read(journal_end))
        scenario = run_folder.read_scenario(folder).with_paths_from(copy)
        store_watch(Watch(copy, config, scenario, progress), Counts(), report=False)
        yield copy


def open_run(folder: Path | str) -> xr.DataTree:
    """Read all results of a run or a watch (`run.nc`) as labelled arrays in memory.

    A watch that still goes on, or was killed, is read as if it had ended after the last step of its
    journal. Its folder is not changed.

    Parameters
    ----------
    folder : Path or str
        The folder of the run or of the watch.

    Returns
    -------
    xarray.DataTree
        The groups `observed`, `filtered`, `smoothed`, `predicted`, `policy`, `calibration` and
        `truth`; each variable has its unit in `.attrs["units"]`. The layout is in
        `docs/reference/run_folder.md`.

    Raises
    ------
    RunFolderError
        If there is no ``run.nc``, if it is damaged, or if nothing was observed yet.
    NotResumableError
        If the journal of a watch was changed or is damaged.
    """
    folder = Path(folder)
    if _watch_config(folder) is None or is_stored(folder):
        return open_stored_run(folder)
    with copy_of_run_until(folder, None, None, SilentProgress()) as stored_copy:
        return open_stored_run(stored_copy)


def is_stored(folder: Path) -> bool:
    """Return whether `run.nc` and the summary of a watch have the last step of its journal."""
    try:
        stored_steps = read_json(folder / SUMMARY_NAME, DamagedFileError)["steps"]
    except (DamagedFileError, KeyError, TypeError):
        return False
    step, _ = last_step(folder / JOURNAL_NAME)
    return bool(stored_steps == step + 1)


def _watch_config(folder: Path) -> JsonObject | None:
    """Return the configuration of a watch; None if the folder has something else."""
    config = run_folder.find_config(folder)
    return config if config is not None and config.get("watched") else None


def watch(
    scenario: LoadedScenario | str | Path | None = None,
    observations: Observations | None = None,
    folder: Path | str | None = None,
    overrides: OverridesOrMapping | None = None,
    *,
    decide: DecisionSink | None = None,
    resume: bool = False,
    follow: bool = False,
    steps: int | None = None,
    model_patch: Path | str | None = None,
    from_step: int | None = None,
    teach: bool = False,
    allow_unknown: bool = False,
    ca_file: Path | str | None = None,
    replace: bool = False,
    last: int = STORED_STEPS,
    report: bool = True,
    otherwise: str | None = None,
    begun: Callable[[Watch], object] | None = None,
    metrics: str | int | None = None,
    line_protocol: Path | str | None = None,
    cause_search: CauseSearch | None = None,
    progress: Progress | None = None,
) -> Path:
    """Watch a real asset until its observations end; return the folder, which `open_run` reads.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path, optional
        The scenario, its shipped name, or its file; it may be left out if a watch is resumed.
    observations : iterable of mapping, str or Path, optional
        Messages as they come, mappings with the keys that `docs/how_to/watch.md` lists; or a
        recording: a
        CSV or NetCDF file, or the folder of another watch or run; or the address of a broker,
        ``mqtt://[USER@]HOST[:PORT]/TOPIC`` or ``mqtts://``, where the decisions are published, too;
        or ``-`` for JSON lines on standard input. The recording of the scenario if left out.
    folder : Path or str, optional
        The folder to make; ``runs/NAME`` by default.
    overrides : Overrides or mapping, optional
        What differs from the file of the scenario: ``seed``, ``calibration``, ``library``,
        ``learnt``.
    decide : callable, optional
        Called with the decision of each step, once the step is in the journal. If a kill may have
        kept the last decision of a resumed watch from being sent, it is called with that one first.
    resume : bool
        Whether to take up the watch in the folder.
    follow : bool
        Whether to wait at the end of a file of text for more.
    steps : int, optional
        The number of steps, with those of earlier processes, after which to end.
    model_patch : Path or str, optional
        A patch of the model to believe, such as `patch.json` of `discrepancy run`; with `resume`
        and `from_step`.
    from_step : int, optional
        The first step in which the patch is believed.
    teach : bool
        Whether to look for the cause of an alarm, and to believe an effect that is named and proved
        in later steps.
    allow_unknown : bool
        Whether to ignore keys and columns that are not sensors.
    ca_file : Path or str, optional
        The certificate of the authority of an ``mqtts://`` broker.
    replace : bool
        Whether to take the place of an existing folder.
    last : int
        The number of last steps in `run.nc` and report.
    report : bool
        Whether to write the report.
    otherwise : str, optional
        The observations if neither `observations` nor the scenario names any.
    begun : callable, optional
        Called with the watch once its folder is locked, before anything is read.
    metrics : str or int, optional
        The port at which the figures of the watch are served for Prometheus while it goes on, or
        ``HOST:PORT``; without a host, only this machine can read them.
    line_protocol : Path or str, optional
        The file to which each decision is appended in the line protocol of InfluxDB.
    cause_search : CauseSearch, optional
        What looks for the cause of an alarm. `uav_twin.watch` gives `uav-twin discrepancy run` in a
        process of its own; only a watch with `teach` needs it.
    progress : Progress, optional
        Shows the stages, and notes about brokers.

    Raises
    ------
    RunFolderError, NotResumableError
        If the folder exists, or holds no such watch.
    MissionInputError
        If there are no observations, if they cannot be read, if the arguments do not go together,
        or if `teach` is asked of an asset that cannot be taught.
    TwinMasterError, FiniteElementError, CalibrationError
        If the watch cannot go on, with one clear sentence; what was observed is kept.
    """
    from twin_master.watch.metrics import serve_metrics  # slow to import, as its server is

    loaded_scenario = None if scenario is None else load_scenario(scenario)
    progress = progress or SilentProgress()
    patch = _given_patch(model_patch, from_step, resume=resume)
    folder = _folder_of_watch(loaded_scenario, folder, resume=resume)
    reading_scenario = _scenario_for_reading(loaded_scenario, folder, allow_unknown=allow_unknown)
    if teach:
        _check_teaching(reading_scenario, cause_search)

    # Mistakes in the arguments are found before a model is built and a folder made
    feed = choose_feed(
        observations,
        reading_scenario,
        follow=follow,
        authority=None if ca_file is None else Path(ca_file),
        default=otherwise,
    )
    if replace:
        _check_recording_is_kept(feed, folder)
    opened = _open_watch(
        loaded_scenario, folder, as_overrides(overrides), progress, resume=resume, replace=replace
    )
    with serve_metrics(metrics) as metrics_server, opened as watched:
        try:
            if begun is not None:
                begun(watched)
            send = _sender(decide, metrics_server, line_protocol, watched)
            if isinstance(feed, Broker):
                feed = MqttFeed(feed, watched, progress.note, reading_scenario)
            teacher = cause_search if teach else None
            counts = _run(watched, feed, send, teacher, step_limit=steps, patch=patch)
            store_watch(watched, counts, last=last, report=report)
        except Exception as error:
            error.add_note(_advice_after_error(watched))
            raise
    return watched.folder


def _sender(
    decide: DecisionSink | None,
    server: MetricsServer | None,
    line_protocol: Path | str | None,
    watched: Watch,
) -> DecisionSink:
    """Return a function that sends a decision to the file, the metrics and the caller of a watch.

    `line_protocol`, `server` and `decide` are None if this is not wanted.
    """
    name = watched.scenario.mission.name
    sinks: list[DecisionSink] = []
    if line_protocol is not None:
        sinks.append(DecisionLines(Path(line_protocol), name).write)
    if server is not None:
        watched.progress.note(f"Metrics: {server.address}")
        sinks.append(server.attach(name, watched).note_decision)
    if decide is not None:
        sinks.append(decide)

    def send(decision: Decision) -> None:
        for sink in sinks:
            sink(decision)

    return send


def _given_patch(
    model_patch: Path | str | None, from_step: int | None, *, resume: bool
) -> GivenPatch | None:
    """Return the patch that the user gives for a resumed watch; None if none is given."""
    if model_patch is None and from_step is None:
        return None
    if model_patch is None or from_step is None or not resume:
        raise MissionInputError("--model-patch and --from-step go together, with --resume.")
    return GivenPatch(Path(model_patch), from_step)


def _folder_of_watch(
    loaded_scenario: LoadedScenario | None, folder: Path | str | None, *, resume: bool
) -> Path:
    """Return the folder that the user names, or the default one of the scenario.

    Only a watch that is resumed in a named folder can do without a scenario.
    """
    if folder is None and loaded_scenario is not None:
        return Path("runs", loaded_scenario.scenario.mission.name)
    if folder is None or (loaded_scenario is None and not resume):
        raise MissionInputError("a scenario is needed, or --resume with the folder of a watch.")
    return Path(folder)


def _scenario_for_reading(
    loaded_scenario: LoadedScenario | None, folder: Path, *, allow_unknown: bool
) -> Scenario:
    """Return the scenario whose sensors the observations name, with absolute paths.

    It is the loaded scenario, or, for a resumed watch without one, that of the folder.
    """
    if loaded_scenario is None:
        scenario = run_folder.read_scenario(folder).with_paths_from(folder)
    else:
        scenario = loaded_scenario.scenario.with_paths_from(loaded_scenario.path.parent)
    if allow_unknown:
        scenario = scenario.with_changes("watch", allow_unknown=True)
    return scenario


def _check_teaching(scenario: Scenario, cause_search: CauseSearch | None) -> None:
    """Raise an error if no search is given, or if none can find causes in this scenario."""
    check_teachable(scenario)
    if cause_search is None:
        raise MissionInputError("`teach` needs a `cause_search`, as `uav_twin.watch` has it.")


def _check_recording_is_kept(feed: Feed | Broker, folder: Path) -> None:
    """Raise an error if the folder to be replaced contains the observations to be read."""
    if isinstance(feed, RecordedFeed) and folder.resolve() in feed.path.resolve().parents:
        raise MissionInputError(
            f"--replace would remove the observations in {feed.path} before they are read: choose "
            "another --out."
        )


def _open_watch(
    loaded_scenario: LoadedScenario | None,
    folder: Path,
    overrides: Overrides,
    progress: Progress,
    *,
    resume: bool,
    replace: bool,
) -> AbstractContextManager[Watch]:
    """Return a context manager that provides the new or resumed watch in its locked folder."""
    if resume and (replace or overrides != Overrides()):
        raise MissionInputError(
            "a watch is resumed with the inputs in its folder: leave out options that would change "
            "them."
        )
    if resume or loaded_scenario is None:
        return resume_watch(folder, loaded_scenario, progress)
    resolved_scenario = resolve_scenario(loaded_scenario, overrides)
    opened = begin_watch(
        resolved_scenario, loaded_scenario.file, folder, progress, replace_run=replace
    )
    if loaded_scenario.remark:
        progress.note(loaded_scenario.remark)
    return opened


def _run(
    watched: Watch,
    feed: Feed,
    decide: DecisionSink,
    cause_search: CauseSearch | None,
    *,
    step_limit: int | None,
    patch: GivenPatch | None,
) -> Counts:
    """Run a watch until its feed ends, and return the counts of its messages.

    If a search for causes is given, a tutor searches, tests and adopts between the steps.
    """
    # If the earlier process was killed, its last decision may not have been sent
    unconfirmed = None if is_stored(watched.folder) else watched.last_decision()
    with ExitStack() as open_parts:
        open_parts.enter_context(closing(feed))
        between_steps = None
        if cause_search is not None:
            tutor = Tutor(watched, cause_search, wait=feed.replayable)
            open_parts.enter_context(closing(tutor))
            between_steps = tutor.teach
        return watched.run(
            feed,
            decide,
            between_steps,
            step_limit=step_limit,
            patch=patch,
            unconfirmed=unconfirmed,
        )


def _advice_after_error(watched: Watch) -> str:
    """Return a sentence that says how to continue after an error has ended a watch."""
    has_steps = watched.teaching.step >= 0
    if has_steps:
        return (
            "What was observed is kept: go on with "
            f"`uav-twin watch --resume --out {watched.folder}`."
        )
    return "Nothing was observed yet: correct the cause, and watch again with --replace."
