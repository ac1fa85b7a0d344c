"""A watch as it stood after a turn: a copy of its folder, ended there, while the watch itself goes on."""

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from reporting.errors import DamagedFileError
from reporting.json_file import read_json
from reporting.progress import Progress, SilentProgress
from twin_master.assets.resolution import located_scenario
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.mission.journal import JOURNAL_NAME, last_turn
from twin_master.report import reading
from twin_master.run_folder import CONFIG_NAME
from twin_master.scenario.reading import parse_scenario
from twin_master.store.writing import SUMMARY_NAME
from twin_master.watch.folder import Watch
from twin_master.watch.intake import Counts

if TYPE_CHECKING:
    import xarray as xr


@contextmanager
def flown(folder: Path, first: int | None, last: int | None, progress: Progress) -> Iterator[Path]:
    """Give the run folder of a flight up to a turn: of a watch, which may go on, a copy that ended there.

    Parameters
    ----------
    folder : Path
        Of a run, which is given as it is, or of a watch, which is only read.
    first, last : int or None
        The first turn that is wanted, and the last one; None for all that are in the journal.
    progress : Progress
        Shows stages.

    Raises
    ------
    NotResumableError
        The journal was changed or is damaged.
    MissionInputError
        There is no turn from the first one on.
    """
    config = _config(folder)
    if config is None:
        yield folder
        return
    turn, end = last_turn(folder / JOURNAL_NAME, math.inf if last is None else last)
    if first is not None and turn < first:
        known = f"the turns 0 to {turn}" if turn >= 0 else "no turn"
        limit = "" if last is None else f" up to turn {last}"
        raise MissionInputError(f"{folder} has {known}{limit}, and none from {first} on.")
    with TemporaryDirectory(prefix="uav_twin_") as place:
        copy = Path(place) / folder.resolve().name
        copy.mkdir()
        shutil.copy(folder / CONFIG_NAME, copy)
        shutil.copytree(folder / "asset", copy / "asset")
        with (folder / JOURNAL_NAME).open("rb") as journal:
            (copy / JOURNAL_NAME).write_bytes(journal.read(end))
        scenario = parse_scenario(config["scenario"], str(folder / CONFIG_NAME))
        Watch(copy, config, located_scenario(scenario, copy), progress).store(Counts(), report=False)
        yield copy


def open_run(folder: Path | str) -> "xr.DataTree":
    """Return everything that a run or a watch left, `run.nc`, as labelled arrays in memory.

    A watch that goes on, or was killed, is read as it would be had it ended after the last turn of its
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
        return reading.open_run(folder)
    with flown(Path(folder), None, None, SilentProgress()) as ended:
        return reading.open_run(ended)


def stored(folder: Path) -> bool:
    """Return whether the files of a watch have the last turn of its journal."""
    try:
        ended = read_json(folder / SUMMARY_NAME, DamagedFileError)["steps"]
    except (DamagedFileError, KeyError, TypeError):
        return False
    return bool(ended == last_turn(folder / JOURNAL_NAME)[0] + 1)


def _config(folder: Path) -> dict[str, Any] | None:
    """Return the configuration of a watch; None where the folder holds something else."""
    config = read_json(folder / CONFIG_NAME, NotResumableError) if (folder / CONFIG_NAME).is_file() else None
    return config if isinstance(config, dict) and config.get("watched") else None
