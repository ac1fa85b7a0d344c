"""The folder of a fleet and its configuration, which one process uses at a time."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from reporting.folders import closing_lock
from reporting.formats.former_names import with_present_names
from reporting.json_file import JsonObject, JsonRecord
from reporting.provenance import collect_provenance
from twin_master import run_folder
from twin_master.errors import RunFolderError
from twin_master.scenario import reading as scenario_reading

GROUPS = "groups"
"""The folder with the prepared knowledge of the twins of each group: model, policy and draws."""
_SCENARIOS = "fleet.groups.scenarios"
PRESENT_NAMES = {
    f"{_SCENARIOS}.{location}": name for location, name in scenario_reading.PRESENT_NAMES.items()
}
"""The present name of each key of a fleet's configuration, by its former location."""


@contextmanager
def locked_fleet_folder(
    folder: Path,
    kind: str,
    record: JsonRecord,
    *,
    replace_old: bool = False,
    check: Callable[[], None] | None = None,
) -> Iterator[JsonObject]:
    """Provide the folder of a fleet, which only this process uses, and its configuration.

    The folder is made, or a folder that holds the same fleet is used again.

    Parameters
    ----------
    kind : str
        `run_folder.FLEET_KIND` or `run_folder.WATCHED_FLEET_KIND`.
    record : mapping
        The record of the fleet for `config.json`.
    replace_old : bool
        Whether another fleet in the folder is removed.
    check : callable, optional
        Called before anything is written; it raises an error if the fleet cannot fly.

    Yields
    ------
    dict
        The configuration.

    Raises
    ------
    RunFolderError
        If the folder holds something else, or if another process uses it.
    NotResumableError
        If the fleet was begun with another version of the program.
    """
    config = {"kind": kind, "format": 1, "fleet": record}
    former_config = None if replace_old else run_folder.find_config(folder, kind)
    if former_config is not None:
        same_keys = {key: former_config.get(key) for key in config}
        if same_keys != json.loads(run_folder.to_json(config)):
            otherwise = ", or give --replace" if kind == run_folder.FLEET_KIND else ""
            raise RunFolderError(
                f"{folder} holds another fleet, or the same with other files: "
                f"choose another --out{otherwise}."
            )
        run_folder.check_versions(folder, former_config, record["seed"])
    if check is not None:
        check()
    if former_config is None:
        provenance = collect_provenance(record["seed"]).as_dict()
        content = {**config, "provenance": provenance}
        with run_folder.create_run_folder(folder, content, replace=replace_old):
            yield config
        return
    with closing_lock(run_folder.lock_run_folder(folder)):
        yield config


def fleet_config(folder: Path, *kinds: str) -> JsonObject:
    """Return the content of `config.json` in the folder of a fleet, with the present names of keys.

    Parameters
    ----------
    *kinds : str
        The accepted kinds of fleets; by default one that is flown.

    Raises
    ------
    RunFolderError
        If the folder does not hold such a fleet.
    """
    config = run_folder.find_config(folder, *(kinds or (run_folder.FLEET_KIND,)))
    if config is None or "fleet" not in config:
        if folder.exists():
            raise RunFolderError(f"{folder} is not the folder of a fleet.")
        raise RunFolderError(f"there is no folder {folder}.")
    file = str(folder / run_folder.CONFIG_NAME)
    return with_present_names(config, PRESENT_NAMES, file, RunFolderError)


def knowledge_folder(folder: Path, group_name: str, scenario_number: int) -> Path:
    """Return the folder with the prepared knowledge of a group's twins for one of its scenarios."""
    return folder / GROUPS / group_name / str(scenario_number)
