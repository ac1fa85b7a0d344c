"""A watch from its sources to its report: what `uav_twin.watch` and `uav-twin watch` do."""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from reporting.progress import Progress, SilentProgress
from twin_master.assets.resolution import Overrides, given_overrides
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.watch.broker import broker_of, is_broker
from twin_master.watch.feeds import JsonLinesFeed, MappingFeed, check_file, file_feed
from twin_master.watch.folder import STORED_TURNS, Patched, Watch
from twin_master.watch.intake import Feed
from twin_master.watch.mqtt import MqttFeed
from twin_master.watch.opening import begin_watch, resume_watch
from twin_master.watch.snapshot import stored
from twin_master.watch.teaching import Search, check_teachable

Decide = Callable[[Mapping[str, Any]], object]
Observations = Iterable[Mapping[str, Any]] | str | Path
STANDARD_INPUT = "-"


def watch(
    scenario: LoadedScenario | str | Path | None = None,
    observations: Observations | None = None,
    folder: Path | str | None = None,
    overrides: Overrides | Mapping[str, Any] | None = None,
    *,
    decide: Decide = lambda _decision: None,
    resume: bool = False,
    follow: bool = False,
    turns: int | None = None,
    model_patch: Path | str | None = None,
    from_turn: int | None = None,
    teach: bool = False,
    allow_unknown: bool = False,
    ca_file: Path | str | None = None,
    replace: bool = False,
    last: int = STORED_TURNS,
    report: bool = True,
    otherwise: str | None = None,
    begun: Callable[[Watch], object] = lambda _watch: None,
    progress: Progress | None = None,
) -> Path:
    """Watch a real asset until its observations end; return the folder, which `open_run` reads.

    Parameters
    ----------
    scenario
        The scenario, its shipped name, or its file; it may be left out where a watch is resumed.
    observations
        Messages as they come, mappings of the keys that `docs/watch.md` lists; a recording: a CSV or NetCDF
        file, or the folder of another watch or run; ``mqtt://[USER@]HOST[:PORT]/TOPIC`` or ``mqtts://``,
        where the decisions are published, too; ``-``: JSON lines on standard input. The recording of the
        scenario if left out.
    folder
        The folder to make; ``runs/NAME`` by default.
    overrides
        What differs from the file: ``seed``, ``calibration``, ``library``, ``learnt``.
    decide
        Told the decision of each turn, once the turn is written down; first the last one again where a kill
        may have left it untold.
    resume
        Take up the watch in the folder.
    follow
        Wait at the end of a CSV file for more.
    turns
        Turns in all after which to end.
    model_patch, from_turn
        A patch, such as `patch.json` of `discrepancy run`, and the turn from which on it is believed; with
        `resume`.
    teach
        Look for the cause of an alarm, and believe what is named and proved on later turns.
    allow_unknown
        Pass over keys and columns that are no sensor.
    ca_file
        Certificate of the authority of an ``mqtts://`` broker.
    replace
        Take the place of an existing folder.
    last
        Turns, the last ones, in `run.nc` and report.
    report
        Draw the report.
    otherwise
        Observations where neither they nor a scenario with a recording are given.
    begun
        Told the watch once its folder is held, before anything is read.
    progress
        Shows the stages, and tells of brokers.

    Raises
    ------
    RunFolderExistsError, NotResumableError
        The folder exists, or holds no such watch.
    MissionInputError
        There are no observations, they cannot be read, what is asked does not go together, or `teach` is
        asked of an asset that cannot be taught.
    TwinMasterError, FiniteElementError, CalibrationError
        With one clear sentence; what was observed is kept.
    """
    loaded = scenario if isinstance(scenario, LoadedScenario | None) else load_scenario(scenario)
    given, progress = given_overrides(overrides), progress or SilentProgress()
    authority = None if ca_file is None else Path(ca_file)
    patch = None if model_patch is None or from_turn is None else Patched(Path(model_patch), from_turn)
    if (model_patch, from_turn) != (None, None) and (patch is None or not resume):
        raise MissionInputError("--model-patch and --from-turn go together, with --resume.")
    if loaded is not None:
        if teach:
            check_teachable(loaded.scenario)
        observations = _source(observations, loaded.scenario.moved(loaded.path.parent), otherwise)
    if isinstance(observations, str | Path):
        own = None if loaded is None else _allowing(loaded.scenario, allow_unknown)
        _check_source(str(observations), own, follow, authority)
    watched, lock = _opened(loaded, observations, folder, given, progress, resume=resume, replace=replace)
    try:
        begun(watched)
        known = _allowing(watched.scenario, allow_unknown)
        source = _source(observations, known, otherwise)
        feed, publish, close = _feed(source, watched, known, follow, authority, progress)

        def tell(decision: Mapping[str, Any]) -> None:
            decide(decision)
            publish(decision)

        try:
            # A kill may have left the last decision untold.
            untold = None if stored(watched.folder) else watched.last_decision()
            search = Search(watched.folder, watched.scenario.mission.seed) if teach else None
            counts = watched.run(feed, tell, turns=turns, patched=patch, search=search, untold=untold)
        finally:
            close()
        watched.store(counts, last=last, report=report)
    except Exception as error:
        error.add_note(
            f"What was observed is kept: go on with `uav-twin watch --resume --out {watched.folder}`."
        )
        raise
    finally:
        os.close(lock)
    return watched.folder


def _source(observations: Observations | None, scenario: Scenario, otherwise: str | None) -> Observations:
    """Return where observations come from: what is given, else the recording of the scenario."""
    for source in (observations, scenario.watch.recording, otherwise):
        if source is not None:
            return source
    raise MissionInputError(
        f"{scenario.mission.name} names no recording: give the observations that are to be watched."
    )


def _allowing(scenario: Scenario, unknown: bool) -> Scenario:
    """Return a scenario that passes over keys and columns that are no sensor, if that is asked."""
    section = scenario.watch.model_copy(update={"allow_unknown": scenario.watch.allow_unknown or unknown})
    return scenario.model_copy(update={"watch": section})


def _check_source(observations: str, scenario: Scenario | None, follow: bool, authority: Path | None) -> None:
    """Find slips of the pen before a model is built and a folder made."""
    if is_broker(observations):
        broker_of(observations, authority)
    elif observations != STANDARD_INPUT and scenario is not None:
        file_feed(Path(observations), scenario, follow=follow)
    elif observations != STANDARD_INPUT:
        check_file(Path(observations), follow=follow)
    elif follow:
        raise MissionInputError("--follow belongs to a CSV file; standard input is read to its end anyway.")


def _opened(
    loaded: LoadedScenario | None, observations: Observations | None, out: Path | str | None,
    overrides: Overrides, progress: Progress, *, resume: bool, replace: bool,
) -> tuple[Watch, int]:  # fmt: skip
    """Return the watch, begun or taken up, and what holds its folder."""
    if resume and (replace or overrides != Overrides()):
        raise MissionInputError(
            "a watch is taken up with what its folder holds: give nothing beside --resume that changes it."
        )
    if out is None and loaded is not None:
        out = Path("runs") / loaded.scenario.mission.name
    if out is None or (loaded is None and not resume):
        raise MissionInputError("a scenario is needed, or --resume with the folder of a watch.")
    folder = Path(out)
    if resume or loaded is None:
        return resume_watch(folder, loaded, progress)
    source = Path(observations).resolve() if isinstance(observations, str | Path) else None
    if replace and source is not None and folder.resolve() in (source, *source.parents):
        raise MissionInputError(
            f"--replace would remove the observations in {observations} before they are read: choose another "
            "--out."
        )
    return begin_watch(loaded, folder, overrides, progress, replace_run=replace)


def _feed(
    observations: Observations, watched: Watch, scenario: Scenario, follow: bool, authority: Path | None,
    progress: Progress,
) -> tuple[Feed, Decide, Callable[[], None]]:  # fmt: skip
    """Return where observations come from, who else is told the decisions, and what ends both."""
    if isinstance(observations, str) and is_broker(observations):
        mqtt = MqttFeed(broker_of(observations, authority), watched, progress.note, scenario)
        return mqtt, mqtt.decide, mqtt.close
    feed: Feed
    if not isinstance(observations, str | Path):
        feed = MappingFeed(observations, scenario)
    elif str(observations) == STANDARD_INPUT:
        feed = JsonLinesFeed(scenario)
    else:
        feed = file_feed(Path(observations), scenario, follow=follow)
    return feed, lambda _decision: None, lambda: None
