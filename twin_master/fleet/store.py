"""The store of a fleet: zarr, a group for each group of assets, a chunk for each shard.

It can be read while it grows: ``xarray.open_zarr(DIR / "fleet.zarr", group=NAME)``. A shard that is in the
journal `done.jsonl` is in the store, whole; one that is not is flown again, to the same bytes.
"""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reporting.files import write_error
from twin_master.errors import FleetError
from twin_master.fleet.outcome import VARIABLES, Variable, sizes_of
from twin_master.fleet.plan import Fleet, Group

if TYPE_CHECKING:
    import xarray as xr
    import zarr

STORE_NAME = "fleet.zarr"
DONE_NAME = "done.jsonl"


def check_installed(*packages: str) -> None:
    """Refuse to begin without what the extra `fleet` brings.

    Raises
    ------
    FleetError
        One of the packages is not installed.
    """
    missing = [name for name in packages if util.find_spec(name) is None]
    if missing:
        raise FleetError(f"a fleet needs {' and '.join(missing)}: pip install 'uav-twin[fleet]'.")


class FleetStore:
    """The store, open to be written by this process alone.

    Attributes
    ----------
    done : dict of int to dict
        What the journal says of each shard: failures and seconds.
    """

    def __init__(self, folder: Path, fleet: Fleet) -> None:
        self._path, self._journal = folder / STORE_NAME, folder / DONE_NAME
        with written(self._path):
            if not self._journal.exists():
                _create(self._path, fleet)
                self._journal.touch()
            self.done = _read_done(self._journal)
        self._arrays: dict[str, dict[str, zarr.Array[Any]]] = {}

    def write(self, group: str, rows: slice, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Write some twins of a group.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written; the shards before are still there.
        """
        import zarr

        with written(self._path):
            if group not in self._arrays:
                opened = zarr.open_group(self._path, mode="r+", path=group, use_consolidated=False)
                self._arrays[group] = dict(opened.arrays())
            for name, values in arrays.items():
                self._arrays[group][name][rows] = values

    def finish(self, shard: int, told: Mapping[str, Any]) -> None:
        """Note that a shard is in the store; see `write` for errors."""
        with written(self._journal), self._journal.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"shard": shard, **told}, sort_keys=True) + "\n")
            file.flush()
            os.fsync(file.fileno())
        self.done[shard] = dict(told)


@contextmanager
def written(path: Path) -> Iterator[None]:
    """Turn what the system refuses into one sentence."""
    try:
        yield
    except OSError as error:
        raise write_error(error, path) from error


def open_group(folder: Path, group: str) -> "xr.Dataset":
    """Return a group of the store, whose arrays are read as they are asked for.

    Raises
    ------
    FleetError
        There is none, or zarr is not installed.
    """
    check_installed("zarr")
    import xarray as xr

    try:
        found: xr.Dataset = xr.open_zarr(folder / STORE_NAME, group=group, chunks=None, consolidated=False)
        return found
    except (OSError, KeyError, ValueError) as error:
        raise FleetError(f"{folder} holds no group {group} of a fleet ({error}).") from error


def _create(path: Path, fleet: Fleet) -> None:
    import zarr

    root = zarr.open_group(path, mode="a", zarr_format=3)
    for group in fleet.groups:
        _create_group(root.require_group(group.name), group, fleet)


def _create_group(made: "zarr.Group", group: Group, fleet: Fleet) -> None:
    scenario, count = group.scenarios[0], len(group.members)
    sizes = sizes_of(scenario)
    variables = {**VARIABLES, **{name: Variable((), "f8", "true parameter", "SI") for name in group.spreads}}
    for name, variable in variables.items():
        shape = (count, *(sizes[dimension] for dimension in variable.dimensions))
        made.create_array(
            name,
            shape=shape,
            chunks=(min(fleet.shard, count), *shape[1:]),
            dtype=variable.type,
            fill_value=np.nan
            if variable.type.startswith("f")
            else -int(name in ("control_index", "first_notice")),
            dimension_names=("twin", *variable.dimensions),
            attributes={"title": variable.title, "units": variable.unit},
            overwrite=True,
        )
    made.attrs.update(
        {
            "scenario": scenario.mission.name,
            "fleet": fleet.name,
            "fleet_seed": fleet.seed,
            "factors": list(scenario.state_names),
            "controls": list(scenario.control_names),
            "step_name": scenario.mission.step_name,
            "gives_notice": scenario.notice is not None,
        }
    )


def _read_done(path: Path) -> dict[int, dict[str, Any]]:
    """Return the shards of a journal; a line that a kill cut off is dropped."""
    if not path.exists():
        return {}
    content = path.read_bytes()
    whole = content[: content.rfind(b"\n") + 1]
    if len(whole) < len(content):
        os.truncate(path, len(whole))
    try:
        records = [json.loads(line) for line in whole.splitlines()]
        return {int(record.pop("shard")): record for record in records}
    except (ValueError, KeyError, TypeError) as error:
        raise FleetError(f"{path} is damaged ({error}): fly the fleet again with --replace.") from error
