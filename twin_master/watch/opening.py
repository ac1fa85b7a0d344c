"""A watch begun, or taken up again: its folder, and what holds it."""

import os
from collections.abc import Mapping
from pathlib import Path

from reporting.progress import Progress
from reporting.provenance import collect_provenance
from twin_master.assets.resolution import (
    Overrides,
    believed_source,
    located_scenario,
    portable_scenario,
    resolve_scenario,
)
from twin_master.errors import NotResumableError
from twin_master.run_folder import (
    CONFIG_NAME,
    KIND,
    check_versions,
    create_run_folder,
    lock_run_folder,
    read_config,
)
from twin_master.scenario.reading import LoadedScenario, parse_scenario
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


def file_record(loaded: LoadedScenario) -> dict[str, str]:
    """Return name and hash of the file of a scenario, by which a watch of it is known."""
    return {"name": loaded.path.name, "sha256": loaded.content_hash}


def begin_resolved(
    resolved: Scenario, file: Mapping[str, str], folder: Path, progress: Progress, *,
    replace_run: bool = False, like: Watch | None = None,
) -> tuple[Watch, int]:  # fmt: skip
    """Make the folder of a watch of a resolved scenario, see `begin_watch` and `Watch`."""
    source = believed_source(resolved)
    source.check()
    config = {
        "kind": KIND,
        "format": 1,
        "watched": True,
        "scenario": portable_scenario(resolved).to_dict(),
        "scenario_file": dict(file),
        "provenance": collect_provenance(resolved.mission.seed).as_dict(),
    }
    # A watch that takes the place of another ends its session at the broker: it comes under the same name.
    files = dict(source.files())
    for path in folder.glob(f"*{CLIENT_SUFFIX}"):
        files[path.name] = path.read_bytes().partition(b"\n")[0] + f"\n{BEGIN_ANEW}\n".encode()
    lock = create_run_folder(folder, config, files, replace=replace_run)
    try:
        located = located_scenario(portable_scenario(resolved), folder)
        return Watch(folder, config, located, progress, like), lock
    except BaseException:
        os.close(lock)
        raise


def resume_watch(
    folder: Path, loaded: LoadedScenario | None, progress: Progress, like: Watch | None = None
) -> tuple[Watch, int]:
    """Take up the watch in a folder; return it and the file descriptor that holds the folder.

    Raises
    ------
    NotResumableError
        The folder holds no watch, or one of another scenario or version.
    """
    config = read_config(folder)
    if not config.get("watched"):
        raise NotResumableError(
            f"{folder} holds a run, no watch: continue it with `uav-twin run --resume {folder}`."
        )
    file = config["scenario_file"]
    if loaded is not None and file.get("sha256") != loaded.content_hash:
        raise NotResumableError(f"{folder} watches another scenario ({file.get('name')}) than {loaded.path}.")
    scenario = parse_scenario(config["scenario"], str(folder / CONFIG_NAME))
    lock = lock_run_folder(folder)
    try:
        check_versions(folder, config, scenario.mission.seed)
        return Watch(folder, config, located_scenario(scenario, folder), progress, like), lock
    except NotResumableError as error:
        os.close(lock)
        error.add_note(
            "--replace would remove what was observed; another watch, in another folder, takes it in with "
            f"`--observations {folder}`."
        )
        raise
    except BaseException:
        os.close(lock)
        raise
