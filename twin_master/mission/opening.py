"""The folder of a run or a watch, made or taken up again, with its scenario located in it."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from reporting.folders import restore_folder
from reporting.progress import Progress
from reporting.provenance import collect_provenance
from twin_master.assets.asset_source import AssetSource
from twin_master.errors import NotResumableError
from twin_master.run_folder import CONFIG_NAME, KIND, create_run_folder, lock_run_folder, read_config
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.sentences import said

Held = Iterator[tuple[dict[str, Any], Scenario]]
"""Configuration of a folder that this process holds, and its scenario located in it."""


def file_record(loaded: LoadedScenario) -> dict[str, str]:
    """Return name and hash of the file of a scenario, by which its folders are known."""
    return {"name": loaded.path.name, "sha256": loaded.content_hash}


def kept_scenario(folder: Path, config: Mapping[str, Any]) -> Scenario:
    """Return the scenario in the configuration of a folder."""
    return parse_scenario(config["scenario"], str(folder / CONFIG_NAME))


@contextmanager
def begun_folder(
    resolved: Scenario,
    file: Mapping[str, str],
    folder: Path,
    source: AssetSource,
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
        See `file_record`.
    folder
        Where.
    source
        Of what is believed or flown; what is not there costs the user no folder.
    files
        Further files: path inside the folder, content.
    replace
        Take the place of an existing run folder.
    watched
        Whether a real asset is watched.

    Raises
    ------
    RunFolderExistsError
        The folder exists.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        Something that the scenario names is not there.
    """
    source.check()
    config = {
        "kind": KIND,
        "format": 1,
        **({"watched": True} if watched else {}),
        "scenario": resolved.portable().to_dict(),
        "scenario_file": dict(file),
        "provenance": collect_provenance(resolved.mission.seed).as_dict(),
    }
    with create_run_folder(folder, config, {**source.files(), **files}, replace=replace):
        yield config, resolved.portable().moved(folder)


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
    scenario, file = kept_scenario(folder, config), config["scenario_file"]
    if loaded is not None and file.get("sha256") != loaded.content_hash:
        does = "watches" if config.get("watched") else "flies"
        raise NotResumableError(
            said(
                "mission.another",
                folder=folder,
                does=does,
                name=scenario.mission.name,
                scenario_name=file.get("name"),
                path=loaded.path,
            )
        )
    with held(lock_run_folder(folder)):
        yield config, scenario.moved(folder)


@contextmanager
def held(lock: int) -> Iterator[None]:
    """Let go of a folder at the end."""
    try:
        yield
    finally:
        os.close(lock)


def restore(folder: Path, progress: Progress) -> None:
    """Put back a run that a killed --replace had moved aside."""
    if restore_folder(folder):
        progress.note(f"A replacement of {folder} was interrupted: the run that was there is back.")
