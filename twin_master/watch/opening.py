"""A watch begun, or taken up again: its folder, and what holds it."""

from collections.abc import Mapping
from pathlib import Path

from reporting.progress import Progress
from twin_master.assets.resolution import Overrides, believed_source, resolve_scenario
from twin_master.errors import NotResumableError
from twin_master.mission.opening import begin_folder, file_record, released, resume_folder
from twin_master.run_folder import check_versions, read_config
from twin_master.scenario.reading import LoadedScenario
from twin_master.scenario.schema import Scenario
from twin_master.watch.folder import Watch
from twin_master.watch.mqtt import BEGIN_ANEW, CLIENT_SUFFIX


def begin_watch(
    loaded: LoadedScenario, folder: Path, overrides: Overrides, progress: Progress, *, replace_run: bool
) -> tuple[Watch, int]:
    """Make the folder of a watch; return it and the file descriptor that holds the folder.

    Raises
    ------
    RunFolderExistsError
        The folder exists.
    TwinMasterError, FiniteElementError, CalibrationError
        With one clear sentence.
    """
    resolved = resolve_scenario(loaded, overrides)
    if loaded.remark:
        progress.note(loaded.remark)
    return begin_resolved(resolved, file_record(loaded), folder, progress, replace_run=replace_run)


def begin_resolved(
    resolved: Scenario, file: Mapping[str, str], folder: Path, progress: Progress, *,
    replace_run: bool = False, like: Watch | None = None,
) -> tuple[Watch, int]:  # fmt: skip
    """Make the folder of a watch of a resolved scenario, see `begin_watch` and `Watch`."""
    # A watch that takes the place of another ends its session at the broker: it comes under the same name.
    files = {
        path.name: path.read_bytes().partition(b"\n")[0] + f"\n{BEGIN_ANEW}\n".encode()
        for path in folder.glob(f"*{CLIENT_SUFFIX}")
    }
    config, located, lock = begin_folder(
        resolved, file, folder, believed_source(resolved), files, replace=replace_run, watched=True
    )
    with released(lock):
        return Watch(folder, config, located, progress, like), lock


def resume_watch(
    folder: Path, loaded: LoadedScenario | None, progress: Progress, like: Watch | None = None
) -> tuple[Watch, int]:
    """Take up the watch in a folder; return it and the file descriptor that holds the folder.

    Raises
    ------
    NotResumableError
        The folder holds no watch, or one of another scenario or version.
    """
    if not read_config(folder).get("watched"):
        raise NotResumableError(
            f"{folder} holds a run, no watch: continue it with `uav-twin run --resume {folder}`."
        )
    config, scenario, lock = resume_folder(folder, loaded)
    with released(lock):
        try:
            check_versions(folder, config, scenario.mission.seed)
            return Watch(folder, config, scenario, progress, like), lock
        except NotResumableError as error:
            error.add_note(
                "--replace would remove what was observed; another watch, in another folder, takes it in "
                f"with `--observations {folder}`."
            )
            raise
