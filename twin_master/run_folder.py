"""The run folder, which is complete or absent, never overwritten by mistake, and resumable.

`docs/reference/run_folder.md` describes its layout.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from reporting.files import atomic_write_text, remove_leftovers, write_members
from reporting.folders import closing_lock, restore_folder, whole_folder
from reporting.json_file import JsonObject, read_json
from reporting.progress import Progress
from reporting.provenance import collect_provenance, plug_in_versions
from reporting.system.operating_system import is_lock_of, lock_folder
from twin_master.errors import NotResumableError, RunFolderError
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario

CONFIG_NAME = "config.json"
"""The file of a run folder with its configuration."""
FIELD_NAME = "wing.vtu"
"""The file of a run folder with the last estimated field."""
REPORT_NAME = "report.html"
"""The page in the folder of a run, a watch or a fleet."""
TEACHING = "teaching"
"""The folder of a watch with its verdicts."""
VERDICT, PATCH, PICTURE = "verdict.json", "patch.json", "figures/missing_force.svg"
"""Files in the folder of a verdict: the verdict, its patch, if it names one, and the picture of the
missing force, if motion was observed."""
KIND = "uav-twin run"
"""The value of `kind` in the `config.json` of a run folder."""
FLEET_KIND = "uav-twin fleet"
"""The value of `kind` in the `config.json` of a fleet that is flown."""
WATCHED_FLEET_KIND = "uav-twin fleet watch"
"""The value of `kind` in the `config.json` of a watched fleet; its assets have folders in it."""
HARMLESS_PACKAGES = frozenset({"discrepancy", "reporting", "scenarios", "uav_twin", "matplotlib"})
"""Packages that may change before a run is resumed, because no stored figure depends on them."""


def to_json(record: Mapping[str, object]) -> str:
    """Return a record as JSON text; equal records give equal texts."""
    text = json.dumps(record, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return text + "\n"


def find_config(folder: Path, *kinds: str) -> JsonObject | None:
    """Return the configuration of a folder of one of the given kinds; None for any other folder.

    Without `kinds` only the folder of a run counts.
    """
    try:
        record = read_json(folder / CONFIG_NAME, NotResumableError)
    except NotResumableError:
        return None
    if isinstance(record, dict) and record.get("kind") in (kinds or (KIND,)):
        return record
    return None


@contextmanager
def create_run_folder(
    folder: Path,
    config: JsonObject,
    files: Mapping[str, bytes] | None = None,
    *,
    replace: bool = False,
    fleet_is_locked: bool = False,
) -> Iterator[None]:
    """Create a run folder with its configuration and copies of all files, in one step; lock it.

    The folder is locked until the context ends.

    Parameters
    ----------
    folder : Path
        The folder; it must be absent or empty unless `replace` is given.
    files : mapping of str to bytes, optional
        The contents of further files, by their paths in the folder.
    replace : bool
        Whether to replace an existing folder of the same kind. Any other folder is never replaced.
    fleet_is_locked : bool
        Whether this process watches the fleet that the folder belongs to, and has locked the
        fleet's folder. No lock is kept on the folder itself then, so that a fleet has any number of
        assets.

    Raises
    ------
    RunFolderError
        If the folder exists and is not to be replaced, or is not a run folder, or if another
        process is flying in the folder that is to be replaced.
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise RunFolderError(f"{folder} exists and is not a folder: choose another --out.")
    is_occupied = folder.is_dir() and any(folder.iterdir())
    if is_occupied and find_config(folder, config["kind"]) is None:
        raise RunFolderError(
            f"{folder} exists and holds something else, so that it was left unchanged: choose "
            "another --out."
        )
    if is_occupied and not replace:
        raise RunFolderError(
            f"{folder} holds a run already: choose another --out, go on with it by --resume, or "
            "give --replace."
        )
    lock = partial(lock_run_folder, fleet_is_locked=fleet_is_locked)
    with ExitStack() as locks:
        with whole_folder(folder, lock, locks) as new_folder:
            write_members(new_folder, files or {})
            atomic_write_text(new_folder / CONFIG_NAME, to_json(config))
        if fleet_is_locked:
            locks.close()
        yield


def read_config(folder: Path) -> JsonObject:
    """Return the configuration of a run folder.

    Raises
    ------
    NotResumableError
        If there is no configuration, or it is damaged.
    """
    if not folder.is_dir():
        raise NotResumableError(
            f"there is no run folder {folder}: nothing was begun there, fly the mission with --out."
        )
    config = find_config(folder)
    if config is None:
        raise NotResumableError(
            f"{folder} is not a run folder: it holds no {CONFIG_NAME} of a run."
        )
    required_tables = ["scenario", "scenario_file", "provenance"]
    if "inputs" in config:  # they are written once the asset is prepared
        required_tables.append("inputs")
    for table in required_tables:
        if not isinstance(config.get(table), dict):
            raise NotResumableError(
                f"{folder / CONFIG_NAME} is damaged, its table `{table}` is missing: "
                "fly the mission again with --replace."
            )
    return config


def lock_run_folder(folder: Path, *, fleet_is_locked: bool = False) -> int:
    """Lock a folder for this process; return a file descriptor, whose closing ends the lock.

    The folder of an asset of a watched fleet, `FLEET/GROUP/NAME`, is also locked while a process
    watches the fleet.

    Parameters
    ----------
    fleet_is_locked : bool
        Whether it is this process that watches the fleet.

    Raises
    ------
    RunFolderError
        If another process is flying in the folder, or watches the fleet that it belongs to.
    """
    descriptor = lock_folder(folder)
    if descriptor is None:
        raise RunFolderError(f"another process is flying in {folder}: wait for it to end.")
    # Another process may have replaced the folder after it was opened for the lock.
    if not is_lock_of(descriptor, folder):
        os.close(descriptor)
        raise RunFolderError(
            f"another process has just put another run into {folder}: look at that one."
        )
    # Asked after the folder was locked: a watch of the fleet that begins later finds that lock
    fleet_folder = folder.resolve().parent.parent
    if not fleet_is_locked and _is_watched_fleet(fleet_folder):
        os.close(descriptor)
        raise RunFolderError(
            f"another process watches the fleet in {fleet_folder}, to which {folder} belongs: wait "
            "for it to end."
        )
    return descriptor


def _is_watched_fleet(folder: Path) -> bool:
    """Return whether another process is watching a fleet in this folder."""
    if find_config(folder, WATCHED_FLEET_KIND) is None:
        return False
    lock = lock_folder(folder, shared=True)
    if lock is None:
        return True
    os.close(lock)
    return False


def remove_half_written_files(folder: Path) -> None:
    """Remove the files that killed processes left half-written in a folder and its subfolders."""
    for path in list(folder.glob(f".{FIELD_NAME}.*")):
        if path.is_dir():  # the field is written in a folder of its own
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    subfolders = [path for path in folder.rglob("*") if path.is_dir()]
    for directory in [folder, *subfolders]:
        remove_leftovers(directory)


def check_versions(folder: Path, config: JsonObject, seed: int) -> None:
    """Refuse to continue a run with other code than it was begun with.

    Parameters
    ----------
    seed : int
        The seed of the run.

    Raises
    ------
    NotResumableError
        If packages have changed; the sentence names them.
    """
    recorded_provenance = config["provenance"]
    _check_plug_ins(folder, recorded_provenance.get("plug_ins", {}))
    current = collect_provenance(seed)
    current_tables = {"versions": current.versions, "source_hashes": current.source_hashes}
    for table, current_values in current_tables.items():
        recorded_values = recorded_provenance.get(table)
        if not isinstance(recorded_values, dict):
            recorded_values = {}
        changed_packages = set()
        for name, value in current_values.items():
            if recorded_values.get(name) != value:
                changed_packages.add(name)
        names = sorted(changed_packages - HARMLESS_PACKAGES)
        if names:
            raise NotResumableError(
                f"{folder} was begun with another version of {', '.join(names)}, so its results "
                "could not be the same: fly the mission again with --replace."
            )


def _check_plug_ins(folder: Path, recorded: JsonObject) -> None:
    """Refuse to continue a run if a plug-in has changed since the run was begun.

    Plug-ins that were installed since do not matter, and runs of earlier versions record none.
    """
    current = plug_in_versions()
    changes = []
    for name, version in recorded.items():
        if current.get(name) != version:
            changes.append(f"{name} ({version}, now {current.get(name, 'not installed')})")
    if changes:
        raise NotResumableError(
            f"{folder} was begun with other plug-ins: {', '.join(changes)}. Install what it was "
            "begun with, or fly the mission again with --replace."
        )


def record_inputs(folder: Path, config: JsonObject, hashes: Mapping[str, str]) -> JsonObject:
    """Record the hashes of all input files in the configuration, or compare them with the recorded.

    Parameters
    ----------
    hashes : mapping of str to str
        The SHA-256 hash of each input.

    Returns
    -------
    dict
        The configuration with the hashes.

    Raises
    ------
    NotResumableError
        If inputs have changed since the run was begun; the sentence names them.
    """
    recorded_hashes = config.get("inputs")
    if recorded_hashes is None:
        config = {**config, "inputs": dict(hashes)}
        atomic_write_text(folder / CONFIG_NAME, to_json(config))
        return config
    if recorded_hashes != dict(hashes):
        changed_names = sorted(
            name
            for name in {*recorded_hashes, *hashes}
            if recorded_hashes.get(name) != hashes.get(name)
        )
        names = ", ".join(changed_names).replace("_", " ")
        raise NotResumableError(
            f"the {names} changed since the run in {folder} was begun: fly the mission again with "
            "--replace."
        )
    return config


class LockedRun(NamedTuple):
    """A run or a watch whose folder this process has locked.

    Attributes
    ----------
    config : dict
        The content of `config.json`.
    scenario : Scenario
        The scenario, with the paths of its files in the folder.
    """

    config: JsonObject
    scenario: Scenario


def read_scenario(folder: Path) -> Scenario:
    """Return the scenario in the configuration of a folder."""
    return parse_scenario(read_config(folder)["scenario"], str(folder / CONFIG_NAME))


@contextmanager
def new_run_folder(
    resolved_scenario: Scenario,
    file: Mapping[str, str],
    folder: Path,
    files: Mapping[str, bytes],
    *,
    replace: bool,
    watched: bool = False,
    parts: Mapping[str, str] | None = None,
    inputs: Mapping[str, str] | None = None,
    fleet_is_locked: bool = False,
) -> Iterator[LockedRun]:
    """Create and lock the folder of a run or a watch.

    Parameters
    ----------
    resolved_scenario : Scenario
        The scenario with all overrides.
    file : mapping of str to str
        The name and the hash of its file, see `LoadedScenario.file`.
    folder : Path
        The folder to create.
    files : mapping of str to bytes
        The contents of the files that belong to asset and belief, and of further ones, by their
        paths in the folder.
    watched : bool
        Whether a real asset is watched.
    parts : mapping of str to str, optional
        How the parts of the twin are called that a user has given in the place of the scenario's.
    inputs : mapping of str to str, optional
        The SHA-256 hash of each input, if asset and belief are prepared already; see
        `record_inputs`.
    fleet_is_locked : bool
        See `create_run_folder`.

    Raises
    ------
    RunFolderError
        If the folder exists.
    """
    config: JsonObject = {"kind": KIND, "format": 1}
    if watched:
        config["watched"] = True
    if parts:
        config["parts"] = dict(parts)
    config["scenario"] = resolved_scenario.portable().to_dict()
    config["scenario_file"] = dict(file)
    config["provenance"] = collect_provenance(resolved_scenario.mission.seed).as_dict()
    if inputs is not None:
        config["inputs"] = dict(inputs)
    with create_run_folder(folder, config, files, replace=replace, fleet_is_locked=fleet_is_locked):
        yield LockedRun(config, resolved_scenario.portable().with_paths_from(folder))


@contextmanager
def hold_run_folder(
    folder: Path, loaded_scenario: LoadedScenario | None, *, fleet_is_locked: bool = False
) -> Iterator[LockedRun]:
    """Lock the folder of an earlier run or watch, to continue it.

    The folder is locked until the context ends.

    Parameters
    ----------
    loaded_scenario : LoadedScenario or None
        The scenario that the user expects there; it is compared with that of the folder.
    fleet_is_locked : bool
        Whether this process watches the fleet that the folder belongs to, and has locked the
        fleet's folder. The folder itself is then locked only for a moment.

    Raises
    ------
    NotResumableError
        If the folder holds no run, or one of another scenario.
    RunFolderError
        If another process holds the folder.
    """
    config = read_config(folder)
    scenario = read_scenario(folder)
    file = config["scenario_file"]
    if loaded_scenario is not None and file.get("sha256") != loaded_scenario.content_hash:
        verb = "watches" if config.get("watched") else "flies"
        raise NotResumableError(
            f"{folder} {verb} another scenario ({scenario.mission.name}, {file.get('name')}) than "
            f"{loaded_scenario.path}: resume it without naming a scenario."
        )
    with ExitStack() as locks:
        locks.enter_context(closing_lock(lock_run_folder(folder, fleet_is_locked=fleet_is_locked)))
        if fleet_is_locked:
            # No other process had the lock, and none can take it while the fleet is locked. A lock
            # kept for each asset would limit their number by the files that may be open.
            locks.close()
        yield LockedRun(config, scenario.with_paths_from(folder))


def restore(folder: Path, progress: Progress) -> None:
    """Restore a run that was moved aside by a replacement that was then killed."""
    if restore_folder(folder):
        progress.note(f"A replacement of {folder} was interrupted: the previous run was restored.")
