"""Who flies the shards: this process, worker processes of this machine, or a Dask cluster at an address.

Results come back in any order, and are the same to the last bit whoever flew them.
"""

import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from types import ModuleType
from typing import TYPE_CHECKING, Any

from reporting.progress import Progress
from twin_master.errors import FleetError
from twin_master.fleet.plan import Member
from twin_master.fleet.shard import ShardResult, fly_shard, program_version
from twin_master.sentences import said

if TYPE_CHECKING:
    from distributed import Client


WAITING = 2
"""Shards that are handed out for each core beside the one that it flies; the others wait here."""
CONNECTING = 10.0
"""Seconds in which a scheduler must answer."""
LAUNCHES = 2
"""Times that workers may die over a shard before its twins fly one by one."""


@dataclass(frozen=True)
class Engine:
    """Who flies.

    Attributes
    ----------
    workers : int
        Worker processes of this machine; 0 flies in this process.
    cluster : str or None
        Address of a Dask scheduler, in the place of workers of this machine.
    """

    workers: int = 0
    cluster: str | None = None


@dataclass(frozen=True)
class Piece:
    """A shard, or a part of one that has cost a worker its life.

    Attributes
    ----------
    group : int
        Number of its group in the fleet.
    kit : bytes
        The pickled `Kit` of its twins.
    members : tuple of Member
        Its twins.
    """

    group: int
    kit: bytes
    members: tuple[Member, ...]


Flown = tuple[Piece, ShardResult | str]
"""A piece with its result, or with a sentence where its one twin ended the process that flew it."""


def flown(engine: Engine, pieces: Iterator[Piece], progress: Progress) -> Iterator[Flown]:
    """Yield what becomes of each piece, as it is done.

    Raises
    ------
    FleetError
        The scheduler does not answer, or workers run another version of the program.
    """
    if engine.cluster is None and not engine.workers:
        for piece in pieces:
            yield piece, fly_shard(piece.kit, piece.members)
        return
    with _client(engine) as client:
        progress.note(f"Dask dashboard: {client.dashboard_link}")
        yield from _by_workers(client, pieces)


def _by_workers(client: "Client", pieces: Iterator[Piece]) -> Iterator[Flown]:
    from distributed import CancelledError, as_completed
    from distributed.scheduler import KilledWorker

    def submit(some: Iterable[Piece]) -> list[Any]:
        futures = []
        for piece in some:
            future = client.submit(_fly_there, piece.kit, piece.members, program_version(), pure=False)
            given[future.key] = piece
            futures.append(future)
        return futures

    given: dict[Any, Piece] = {}
    cores = max(1, sum(client.nthreads().values()))
    waiting = as_completed(submit(islice(pieces, cores * (1 + WAITING))))
    for future in waiting:
        piece = given.pop(future.key)
        try:
            result: ShardResult | str = future.result()  # flown again where its worker died with it
        except KilledWorker:
            if len(piece.members) > 1:
                waiting.update(submit(replace(piece, members=(one,)) for one in piece.members))
                continue
            result = "its flight ended the worker process: fly an FMU that crashes isolated."
        except CancelledError:
            raise FleetError(said("fleet.lost")) from None
        yield piece, result
        del future
        waiting.update(submit(islice(pieces, 1)))


def _fly_there(kit: bytes, members: Sequence[Member], version: str) -> ShardResult:
    if version != program_version():
        raise FleetError(said("fleet.version"))
    return fly_shard(kit, members)


@contextmanager
def _client(engine: Engine) -> "Iterator[Client]":
    """Give a client of the cluster, or of one that is made for the time being."""
    import dask
    from distributed import Client, LocalCluster

    quiet = {
        "distributed.scheduler.allowed-failures": LAUNCHES,
        "distributed.comm.timeouts.connect": CONNECTING,
        "distributed.worker.memory.terminate": False,
        "distributed.admin.large-graph-warning-threshold": "1 GiB",
        "logging.distributed": "critical",
    }
    with dask.config.set(quiet):
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        if engine.cluster is not None:
            try:
                client = Client(engine.cluster, timeout=CONNECTING)
            except (OSError, TimeoutError, ValueError) as error:
                raise FleetError(said("fleet.scheduler", cluster=engine.cluster)) from error
            with client:
                if not client.nthreads():
                    raise FleetError(said("fleet.workers", cluster=engine.cluster))
                yield client
            return
        with (
            _nothing_of_the_caller(),
            LocalCluster(
                n_workers=engine.workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=":0",
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client


@contextmanager
def _nothing_of_the_caller() -> Iterator[None]:
    """Keep worker processes from running the caller's script again, as `multiprocessing` has them do.

    That holds for those, too, that take the place of one that died.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
