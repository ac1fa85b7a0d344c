"""A worker, the scheduler or the process that flies is killed: nothing is lost, nothing is twice."""

import json
import os
import pkgutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import Client

from reporting.progress import Progress, Stage
from tests.own_process import HANGS, ended_by
from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import wait_until
from twin_master.assets.resolution import Overrides
from twin_master.errors import FleetError
from twin_master.fleet.engine import Engine
from twin_master.fleet.flight import fly_fleet
from twin_master.fleet.plan import Fleet, ensemble
from uav_twin import open_fleet

TWINS = 12
ROOT = Path(__file__).parents[3]


def growing(library_file: Path) -> Fleet:
    """Return a fleet of twelve twins in six shards."""
    options = Overrides(strain_library=library_file)
    return ensemble("growing_damage", range(TWINS), options, shard=2)


@pytest.fixture(scope="module")
def whole(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the fleet, flown without a kill."""
    return fly_fleet(growing(library_file), tmp_path_factory.mktemp("whole") / "fleet").folder


def check_complete(folder: Path, whole: Path) -> None:
    """Check that a store has the files of a flight without a kill, and that each row was noted once."""
    stores = (folder / "fleet.zarr", whole / "fleet.zarr")
    contents = [
        {path.relative_to(store): path.read_bytes() for path in store.rglob("*") if path.is_file()}
        for store in stores
    ]
    noted = [row for line in journal(folder) if "rows" in line for row in range(*line["rows"])]
    assert contents[0] == contents[1]
    assert sorted(noted) == list(range(TWINS))


def fly_and_die(library_file: Path, folder: Path, place: str, name: str, calls: int) -> None:
    """Fly a fleet in this process, which kills itself after so many calls of a function of a place."""
    owner = pkgutil.resolve_name(place)
    function = getattr(owner, name)
    count = 0

    def killing(*arguments: Any) -> Any:
        nonlocal count
        result = function(*arguments)
        count += 1
        if count == calls:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, killing)
    fly_fleet(growing(library_file), folder)


@pytest.fixture(
    params=[
        # A chunk that the index does not have yet
        ("twin_master.fleet.storage.chunk_file", "_write_all", 45),
        # A shard of which some variables are stored
        ("twin_master.fleet.storage.chunk_file", "_write_all", 46),
        # A shard that has just been noted
        ("twin_master.mission.journal:JournalFile", "append", 4),
        # Some files are in order, others not
        ("twin_master.fleet.storage.chunk_file:ChunkFile", "finish", 3),
    ],
    ids=["in a chunk", "in a shard", "after a shard", "at the end of files"],
)
def killed_client(request: pytest.FixtureRequest, library_file: Path, tmp_path: Path) -> Path:
    """The folder of the fleet, whose process was killed while it wrote."""
    folder = tmp_path / "cut"
    assert ended_by(partial(fly_and_die, library_file, folder, *request.param)) == -signal.SIGKILL
    return folder


def test_a_fleet_whose_process_was_killed_is_readable_and_goes_on(killed_client, library_file, whole):
    complete = open_fleet(whole)["growing_damage"]
    cut = open_fleet(killed_client)["growing_damage"]
    flown = cut["status"].values == 1
    assert (cut["seed"].values[flown] == complete["seed"].values[flown]).all()
    fly_fleet(growing(library_file), killed_client)
    check_complete(killed_client, whole)


class KillingProgress(Progress):
    """Kills processes when the first shard is in the store, after a pause [s]."""

    def __init__(self, victims: Callable[[], list[psutil.Process]], pause: float = 0.0) -> None:
        self._victims = victims
        self._pause = pause
        self.killed: list[int] = []

    @contextmanager
    def stage(self, description: str, total: int | None = None, unit: str = "") -> Iterator[Stage]:
        yield _KillingStage(self)

    def kill_once(self) -> None:
        if self.killed:
            return
        time.sleep(self._pause)
        for process in self._victims():
            process.kill()
            self.killed.append(process.pid)


class _KillingStage(Stage):
    def __init__(self, progress: KillingProgress) -> None:
        self._progress = progress

    def advance(self, amount: float = 1) -> None:
        if amount:
            self._progress.kill_once()


def local_workers() -> list[psutil.Process]:
    """Return the worker processes that Dask started for this process."""
    children = psutil.Process().children(recursive=True)
    return [child for child in children if "spawn_main" in " ".join(child.cmdline())]


def test_a_killed_worker_loses_nothing(library_file, tmp_path, whole):
    progress = KillingProgress(local_workers)
    outcome = fly_fleet(growing(library_file), tmp_path / "fleet", Engine(1), progress=progress)
    assert progress.killed
    assert outcome.failures == {}
    check_complete(outcome.folder, whole)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, psutil.Process]]:
    """The address of a Dask scheduler with a worker, and the process of the scheduler."""
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    port_file = tmp_path / "scheduler.json"
    common = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    options = ["--scheduler-file", str(port_file)]
    scheduler = subprocess.Popen(
        [*dask, "scheduler", *options, "--host", "127.0.0.1", "--port", "0", "--no-dashboard"], **common
    )
    worker = subprocess.Popen(
        [*dask, "worker", *options, "--nthreads", "1", "--no-dashboard", "--no-nanny"], **common
    )
    try:
        yield address_with_worker(port_file), psutil.Process(scheduler.pid)
    finally:
        for process in (worker, scheduler):
            process.kill()
            process.wait()


def address_with_worker(port_file: Path) -> str:
    """Wait until a scheduler has a worker, and return its address."""
    wait_until(lambda: port_file.is_file() and port_file.stat().st_size > 0)  # created, then written
    address: str = json.loads(port_file.read_text(encoding="utf-8"))["address"]
    with Client(address, timeout=HANGS) as client:
        client.wait_for_workers(1, timeout=HANGS)
    return address


@pytest.mark.parametrize("pause", [0.0, 1.5], ids=["while twins fly", "while results wait"])
def test_a_fleet_whose_scheduler_was_killed_goes_on_without_it(library_file, tmp_path, whole, cluster, pause):
    address, scheduler = cluster
    progress = KillingProgress(lambda: [scheduler], pause)
    folder = tmp_path / "fleet"
    with pytest.raises(FleetError, match="the scheduler was lost: what was flown is kept"):
        fly_fleet(growing(library_file), folder, Engine(cluster=address), progress=progress)
    kept = open_fleet(folder)["growing_damage"]["status"].values
    outcome = fly_fleet(growing(library_file), folder)
    assert 0 < (kept == 1).sum() < TWINS
    assert outcome.shards_kept > 0
    check_complete(folder, whole)
