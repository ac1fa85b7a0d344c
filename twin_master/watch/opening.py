"""A watch from its sources to its report, begun or taken up again, and as it stood after a step."""

import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from reporting.progress import Progress, SilentProgress
from twin_master import run_folder
from twin_master.assets.resolution import (
    Overrides,
    as_overrides,
    believed_source,
    resolve_scenario,
)
from twin_master.errors import MissionInputError, NotResumableError, said
from twin_master.mission.journal import JOURNAL_NAME, last_step
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.store.writing import SUMMARY_NAME
from twin_master.store.writing import open_run as stored_run
from twin_master.watch.feeds import Broker, Observations, RecordedFeed, feed_of
from twin_master.watch.folder import STORED_STEPS, Watch
from twin_master.watch.intake import Counts
from twin_master.watch.mqtt import BEGIN_ANEW, CLIENT_SUFFIX, MqttFeed
from twin_master.watch.teaching import check_teachable
from twin_master.watch.tutor import Tutor

if TYPE_CHECKING:
    import xarray as xr


@contextmanager
def begun_watch(
    resolved: Scenario, file: Mapping[str, str], folder: Path, progress: Progress, *,
    replace_run: bool = False, like: Watch | None = None,
) -> Iterator[Watch]:  # fmt: skip
    """Make the folder of a watch of a resolved scenario, and hold it; see `new_run_folder` and `Watch`."""
    # A watch that takes the place of another ends its session at the broker: it comes under the same name.
    files = {
        path.name: path.read_bytes().partition(b"\n")[0] + f"\n{BEGIN_ANEW}\n".encode()
        for path in folder.glob(f"*{CLIENT_SUFFIX}")
    }
    source = believed_source(resolved)
    source.check()
    files = source.files() | files
    opened = run_folder.new_run_folder(resolved, file, folder, files, replace=replace_run, watched=True)
    with opened as (config, located):
        yield Watch(folder, config, located, progress, like)


@contextmanager
def resumed_watch(
    folder: Path, loaded: LoadedScenario | None, progress: Progress, like: Watch | None = None
) -> Iterator[Watch]:
    """Take up the watch in a folder, and hold it.

    Raises
    ------
    NotResumableError
        The folder holds no watch, or one of another scenario or version.
    """
    if not run_folder.read_config(folder).get("watched"):
        raise NotResumableError(said("watch.run", folder=folder))
    with run_folder.hold_run_folder(folder, loaded) as (config, scenario):
        try:
            run_folder.check_versions(folder, config, scenario.mission.seed)
            watched = Watch(folder, config, scenario, progress, like)
        except NotResumableError as error:
            error.add_note(said("watch.another", folder=folder))
            raise
        yield watched


@contextmanager
def flown(folder: Path, first: int | None, last: int | None, progress: Progress) -> Iterator[Path]:
    """Give the run folder of a flight up to a step: of a watch, which may go on, a copy that ended there.

    Parameters
    ----------
    folder : Path
        Of a run, which is given as it is, or of a watch, which is only read.
    first, last : int or None
        The first step that is wanted, and the last one; None for all that are in the journal.
    progress : Progress
        Shows stages.

    Raises
    ------
    NotResumableError
        The journal was changed or is damaged.
    MissionInputError
        There is no step from the first one on.
    """
    config = _config(folder)
    if config is None:
        yield folder
        return
    step, end = last_step(folder / JOURNAL_NAME, math.inf if last is None else last)
    if first is not None and step < first:
        known = f"the steps 0 to {step}" if step >= 0 else "no step"
        limit = "" if last is None else f" up to step {last}"
        raise MissionInputError(f"{folder} has {known}{limit}, and none from {first} on.")
    with TemporaryDirectory(prefix="uav_twin_") as place:
        copy = Path(place) / folder.resolve().name
        copy.mkdir()
        shutil.copy(folder / run_folder.CONFIG_NAME, copy)
        shutil.copytree(folder / "asset", copy / "asset")
        with (folder / JOURNAL_NAME).open("rb") as journal:
            (copy / JOURNAL_NAME).write_bytes(journal.read(end))
        Watch(copy, config, run_folder.read_scenario(folder).with_paths_from(copy), progress).store(
            Counts(), report=False
        )
        yield copy


def open_run(folder: Path | str) -> "xr.DataTree":
    """Return everything that a run or a watch left, `run.nc`, as labelled arrays in memory.

    A watch that goes on, or was killed, is read as it would be had it ended after the last step of its
    journal, and is not touched.

    Returns
    -------
    xarray.DataTree
        The groups `observed`, `filtered`, `smoothed`, `predicted`, `policy`, `calibration` and `truth`; each
        variable has its unit in `.attrs["units"]`. See `docs/run_folder.md`.

    Raises
    ------
    RunFolderError
        There is no ``run.nc``, or it is damaged; or nothing was observed yet.
    NotResumableError
        The journal of a watch was changed or is damaged.
    """
    if _config(Path(folder)) is None or stored(Path(folder)):
        return stored_run(folder)
    with flown(Path(folder), None, None, SilentProgress()) as ended:
        return stored_run(ended)


def stored(folder: Path) -> bool:
    """Return whether the files of a watch have the last step of its journal."""
    try:
        ended = read_json(folder / SUMMARY_NAME, DamagedFileError)["steps"]
    except (DamagedFileError, KeyError, TypeError):
        return False
    return bool(ended == last_step(folder / JOURNAL_NAME)[0] + 1)


def _config(folder: Path) -> dict[str, Any] | None:
    """Return the configuration of a watch; None where the folder holds something else."""
    config = run_folder.find_config(folder)
    return config if config is not None and config.get("watched") else None


Decide = Callable[[Mapping[str, Any]], object]


def watch(
    scenario: LoadedScenario | str | Path | None = None,
    observations: Observations | None = None,
    folder: Path | str | None = None,
    overrides: Overrides | Mapping[str, Any] | None = None,
    *,
    decide: Decide = lambda _decision: None,
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
        Told the decision of each step, once the step is written down; first the last one again where a kill
        may have left it untold.
    resume
        Take up the watch in the folder.
    follow
        Wait at the end of a CSV file for more.
    steps
        Steps in all after which to end.
    model_patch, from_step
        A patch, such as `patch.json` of `discrepancy run`, and the step from which on it is believed; with
        `resume`.
    teach
        Look for the cause of an alarm, and believe what is named and proved on later steps.
    allow_unknown
        Pass over keys and columns that are no sensor.
    ca_file
        Certificate of the authority of an ``mqtts://`` broker.
    replace
        Take the place of an existing folder.
    last
        Steps, the last ones, in `run.nc` and report.
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
    RunFolderError, NotResumableError
        The folder exists, or holds no such watch.
    MissionInputError
        There are no observations, they cannot be read, what is asked does not go together, or `teach` is
        asked of an asset that cannot be taught.
    TwinMasterError, FiniteElementError, CalibrationError
        With one clear sentence; what was observed is kept.
    """
    loaded = None if scenario is None else load_scenario(scenario)
    given, progress = as_overrides(overrides), progress or SilentProgress()
    patch = None if model_patch is None or from_step is None else (Path(model_patch), from_step)
    if (model_patch, from_step) != (None, None) and (patch is None or not resume):
        raise MissionInputError("--model-patch and --from-step go together, with --resume.")
    if loaded is None and (folder is None or not resume):
        raise MissionInputError("a scenario is needed, or --resume with the folder of a watch.")
    folder, known = _read(loaded, folder, allow_unknown=allow_unknown)
    if teach:
        check_teachable(known)
    # Slips of the pen are found before a model is built and a folder made.
    feed = feed_of(observations, known, follow, None if ca_file is None else Path(ca_file), otherwise)
    if replace and isinstance(feed, RecordedFeed) and folder.resolve() in feed.path.resolve().parents:
        raise MissionInputError(said("watch.replace", path=feed.path))
    if resume and (replace or given != Overrides()):
        raise MissionInputError(said("watch.resume"))
    if resume or loaded is None:
        opened = resumed_watch(folder, loaded, progress)
    else:
        resolved = resolve_scenario(loaded, given)
        opened = begun_watch(resolved, loaded.file, folder, progress, replace_run=replace)
        if loaded.remark:
            progress.note(loaded.remark)
    with opened as watched:
        try:
            begun(watched)
            if isinstance(feed, Broker):
                feed = MqttFeed(feed, watched, progress.note, known)
            # A kill may have left the last decision untold.
            untold = None if stored(watched.folder) else watched.last_decision()
            with closing(feed), closing(Tutor(watched, wait=feed.replayable)) as tutor:
                between = tutor.act if teach else lambda: None
                counts = watched.run(feed, decide, between, steps=steps, patched=patch, untold=untold)
            watched.store(counts, last=last, report=report)
        except Exception as error:
            kept = watched.teaching.step >= 0
            error.add_note(said("watch.kept", folder=watched.folder) if kept else said("watch.begun"))
            raise
    return watched.folder


def _read(
    loaded: LoadedScenario | None, folder: Path | str | None, *, allow_unknown: bool
) -> tuple[Path, Scenario]:
    """Return the folder of a watch, and the scenario by which observations are read."""
    if loaded is None:
        folder = Path(str(folder))
        scenario = run_folder.read_scenario(folder).with_paths_from(folder)
    else:
        folder = Path("runs", loaded.scenario.mission.name) if folder is None else Path(folder)
        scenario = loaded.scenario.with_paths_from(loaded.path.parent)
    if allow_unknown:
        scenario = scenario.with_changes("watch", allow_unknown=True)
    return folder, scenario
