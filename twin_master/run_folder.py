"""The run folder: made whole or not at all, never overwritten by mistake, resumable at any moment.

Layout: see `docs/run_folder.md`.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from reporting.files import atomic_write_text, remove_leftovers, write_members
from reporting.folders import closing_lock, lock_folder, restore_folder, whole_folder
from reporting.json_file import read_json
from reporting.progress import Progress
from reporting.provenance import collect_provenance
from twin_master.errors import NotResumableError, RunFolderError, said
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario

CONFIG_NAME = "config.json"
FIELD_NAME = "wing.vtu"
TEACHING = "teaching"
"""Folder of the verdicts of a watch."""
VERDICT, PATCH, PICTURE = "verdict.json", "patch.json", "figures/missing_force.svg"
"""In the folder of a verdict: what it says, the patch where it names one, and the force that the model lacks
where motion was observed."""
KIND = "uav-twin run"
"""Value of `kind` in `config.json`, by which a run folder is known."""
HARMLESS_PACKAGES = frozenset({"discrepancy", "reporting", "scenarios", "uav_twin", "matplotlib"})
"""A run may be resumed after a change of these: no stored figure depends on them."""


def to_json(record: Mapping[str, Any]) -> str:
    """Return a record as JSON text that is the same for the same record."""
    return json.dumps(record, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def folder_config(folder: Path, *kinds: str) -> dict[str, Any] | None:
    """Return the configuration of a folder of one of some kinds, by default a run; None where it is none."""
    try:
        record = read_json(folder / CONFIG_NAME, NotResumableError)
    except NotResumableError:
        return None
    return record if isinstance(record, dict) and record.get("kind") in (kinds or (KIND,)) else None


@contextmanager
def create_run_folder(
    folder: Path,
    config: Mapping[str, Any],
    files: Mapping[str, bytes] | None = None,
    *,
    replace: bool = False,
) -> Iterator[None]:
    """Make a folder that holds its configuration and copies of what is flown, in one step, and hold it.

    Parameters
    ----------
    folder
        Where; an empty folder is as good as none.
    config
        Content of `config.json`.
    files
        Further files: path inside the folder, content.
    replace
        Put the new folder in the place of an existing one of its kind. Anything else is never replaced.

    Raises
    ------
    RunFolderError
        The folder exists and is not to be replaced, or is no run folder; or another process is flying in the
        folder that is to be replaced.
    FileNotWrittenError
        The disk is full or the place is not writable.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise RunFolderError(f"{folder} exists and is no folder: choose another --out.")
    occupied = folder.is_dir() and any(folder.iterdir())
    if occupied and folder_config(folder, config["kind"]) is None:
        raise RunFolderError(said("run_folder.foreign", folder=folder))
    if occupied and not replace:
        raise RunFolderError(said("run_folder.there", folder=folder))
    with ExitStack() as holding:
        with whole_folder(folder, lock_run_folder, holding) as fresh:
            write_members(fresh, files or {})
            atomic_write_text(fresh / CONFIG_NAME, to_json(config))
        yield


def read_config(folder: Path) -> dict[str, Any]:
    """Return the configuration of a run folder.

    Raises
    ------
    NotResumableError
        There is none, or it is damaged.
    """
    if not folder.is_dir():
        raise NotResumableError(said("run_folder.none", folder=folder))
    config = folder_config(folder)
    if config is None:
        raise NotResumableError(f"{folder} is no run folder: it holds no {CONFIG_NAME} of a run.")
    for name in ("scenario", "scenario_file", "provenance", "inputs"):
        if not isinstance(config.get(name, {} if name == "inputs" else None), dict):
            raise NotResumableError(said("run_folder.damaged", path=folder / CONFIG_NAME, name=name))
    return config


def lock_run_folder(folder: Path) -> int:
    """Take the folder for this process; return a file descriptor to close at the end.

    Raises
    ------
    RunFolderError
        Another process is flying in the folder.
    """
    descriptor = lock_folder(folder)
    if descriptor is None:
        raise RunFolderError(f"another process is flying in {folder}: wait for it to end.")
    if not folder.is_dir() or not os.path.samestat(os.fstat(descriptor), folder.stat()):
        os.close(descriptor)
        raise RunFolderError(f"another process has just put another run into {folder}: look at that one.")
    return descriptor


def tidy(folder: Path) -> None:
    """Remove what killed processes left half-written."""
    for path in list(folder.glob(f".{FIELD_NAME}.*")):  # the finite elements write in a folder of their own
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    for place in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
        remove_leftovers(place)


def check_versions(folder: Path, config: Mapping[str, Any], seed: int) -> None:
    """Refuse to go on with other code than the run was begun with.

    Raises
    ------
    NotResumableError
        With the packages that changed.
    """
    recorded = config["provenance"]
    now = collect_provenance(seed).as_dict()
    for what in ("versions", "source_hashes"):
        known = recorded.get(what)
        known = known if isinstance(known, dict) else {}
        another = {name for name, value in now[what].items() if known.get(name) != value}
        changed = sorted(another - HARMLESS_PACKAGES)
        if changed:
            raise NotResumableError(said("run_folder.version", folder=folder, names=", ".join(changed)))


def with_inputs(folder: Path, config: dict[str, Any], hashes: Mapping[str, str]) -> dict[str, Any]:
    """Note the hashes of what is flown; refuse to go on with something else.

    Raises
    ------
    NotResumableError
        With the inputs that changed.
    """
    recorded = config.get("inputs")
    if recorded is not None and recorded != dict(hashes):
        changed = sorted(name for name in {*recorded, *hashes} if recorded.get(name) != hashes.get(name))
        names = ", ".join(changed).replace("_", " ")
        raise NotResumableError(said("run_folder.changed", names=names, folder=folder))
    if recorded is None:
        config = {**config, "inputs": dict(hashes)}
        atomic_write_text(folder / CONFIG_NAME, to_json(config))
    return config


Held = Iterator[tuple[dict[str, Any], Scenario]]
"""Configuration of a folder that this process holds, and its scenario located in it."""


def kept_scenario(folder: Path) -> Scenario:
    """Return the scenario in the configuration of a folder."""
    return parse_scenario(read_config(folder)["scenario"], str(folder / CONFIG_NAME))


@contextmanager
def begun_folder(
    resolved: Scenario,
    file: Mapping[str, str],
    folder: Path,
    files: Mapping[str, bytes],
    *,
    replace: bool,
    watched: bool = False,
) -> Held:
    """Make the folder of a run or a watch.

    Parameters
    ----------
    resolved
        The scenario with all that was given beside its file.
    file
        Name and hash of its file, see `LoadedScenario.file`.
    folder
        Where.
    files
        Of what is believed or flown, and further ones: path inside the folder, content.
    replace
        Take the place of an existing run folder.
    watched
        Whether a real asset is watched.

    Raises
    ------
    RunFolderError
        The folder exists.
    """
    config = {
        "kind": KIND,
        "format": 1,
        **({"watched": True} if watched else {}),
        "scenario": resolved.portable().to_dict(),
        "scenario_file": dict(file),
        "provenance": collect_provenance(resolved.mission.seed).as_dict(),
    }
    with create_run_folder(folder, config, files, replace=replace):
        yield config, resolved.portable().with_paths_from(folder)


@contextmanager
def resumed_folder(folder: Path, loaded: LoadedScenario | None) -> Held:
    """Take up the folder of a run or a watch.

    Parameters
    ----------
    folder
        The folder.
    loaded
        The scenario that the user believes to be there; checked against the folder.

    Raises
    ------
    NotResumableError
        The folder holds no run, or one of another scenario.
    RunFolderError
        Another process holds it.
    """
    config = read_config(folder)
    scenario, file = kept_scenario(folder), config["scenario_file"]
    if loaded is not None and file.get("sha256") != loaded.content_hash:
        does = "watches" if config.get("watched") else "flies"
        other = f"{scenario.mission.name}, {file.get('name')}"
        there = {"folder": folder, "does": does, "other": other}
        raise NotResumableError(said("mission.another", **there, path=loaded.path))
    with closing_lock(lock_run_folder(folder)):
        yield config, scenario.with_paths_from(folder)


def restore(folder: Path, progress: Progress) -> None:
    """Put back a run that a killed --replace had moved aside."""
    if restore_folder(folder):
        progress.note(f"A replacement of {folder} was interrupted: the run that was there is back.")
