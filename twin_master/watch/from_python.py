"""A watch from Python, from the first observation to the report."""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from reporting.progress import Progress, SilentProgress
from twin_master.assets.resolution import Overrides, given_overrides
from twin_master.errors import MissionInputError
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.watch.feeds import MappingFeed, check_file, file_feed
from twin_master.watch.intake import Feed
from twin_master.watch.opening import begin_watch
from twin_master.watch.teaching import Search, check_teachable


def watch(
    scenario: LoadedScenario | str | Path,
    observations: Iterable[Mapping[str, Any]] | str | Path | None = None,
    folder: Path | str | None = None,
    overrides: Overrides | Mapping[str, Any] | None = None,
    *,
    decide: Callable[[Mapping[str, Any]], None] | None = None,
    teach: bool = False,
    replace: bool = False,
    report: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Watch a real asset until its observations end; return the folder, which `open_run` reads.

    Parameters
    ----------
    scenario
        The scenario, its shipped name, or its file.
    observations
        Messages as they come, mappings of the keys that `docs/watch.md` lists, or a recording: a CSV or
        NetCDF file, or the folder of another watch or run. That of the scenario if left out.
    folder
        The folder to make; ``runs/NAME`` by default.
    overrides
        What differs from the file: ``seed``, ``calibration``, ``library``, ``learnt``.
    decide
        Told the decision of each turn, once the turn is written down.
    teach
        Look for the cause of an alarm, and believe what is named and proved on later turns.
    replace
        Take the place of an existing folder.
    report
        Draw the report.
    progress
        Shows the stages.

    Raises
    ------
    RunFolderExistsError
        The folder exists.
    MissionInputError
        There are no observations, they cannot be read, or `teach` is asked of an asset that cannot be taught.
    TwinMasterError, FiniteElementError, CalibrationError
        With one clear sentence; what was observed is kept.
    """
    loaded = scenario if isinstance(scenario, LoadedScenario) else load_scenario(scenario)
    if observations is None:
        observations = loaded.scenario.moved(loaded.path.parent).watch.recording
    if observations is None:
        raise MissionInputError(f"{loaded.path} names no recording: give the observations to watch.")
    if teach:
        check_teachable(loaded.scenario)
    if isinstance(observations, str | Path):
        check_file(Path(observations))
    place = Path("runs") / loaded.scenario.mission.name if folder is None else Path(folder)
    progress = progress or SilentProgress()
    watched, lock = begin_watch(loaded, place, given_overrides(overrides), progress, replace_run=replace)
    try:
        feed: Feed
        if isinstance(observations, str | Path):
            feed = file_feed(Path(observations), watched.scenario)
        else:
            feed = MappingFeed(observations, watched.scenario)
        search = Search(watched.folder, watched.scenario.mission.seed) if teach else None
        counts = watched.run(feed, decide or (lambda _: None), search=search)
        watched.store(counts, report=report)
    finally:
        os.close(lock)
    return watched.folder
