"""Distributes the work on a fleet: to this process, to local workers, or to a Dask cluster."""

import logging
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from reporting.files import hash_record
from reporting.progress import Progress
from reporting.provenance import collect_provenance
from twin_master.errors import FleetError
from twin_master.fleet.members import Member
from twin_master.fleet.shard import ShardResult, fly_shard, result_of_unflown

if TYPE_CHECKING:
    from distributed import Client, Future

WAITING_PER_CORE = 2
"""Number of shards that wait at each core of the workers; the others wait in this process."""
CONNECTING = 10.0
"""Longest time that a scheduler may take to answer [s]."""
_WORKER_ENVIRONMENT = {"OMP_NUM_THREADS": 1, "MKL_NUM_THREADS": 1, "OPENBLAS_NUM_THREADS": 1}
"""Environment variables of local workers: one thread for each.

Dask would also set MALLOC_TRIM_THRESHOLD_, with which glibc takes fresh memory from the system for
every array above 128 kB: a quarter of the processor time of a fleet.
"""
ALLOWED_DEATHS = 2
"""Number of workers that may die while they fly a shard before its twins are flown one by one."""

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Engine:
    """The processes that fly the shards of a fleet and compute lessons.

    Attributes
    ----------
    workers : int
        The number of worker processes of this machine; with 0 this process does all the work.
    cluster : str or None
        The address of a Dask scheduler, whose workers replace those of this machine.
    """

    workers: int = 0
    cluster: str | None = None

    @property
    def needs_dask(self) -> bool:
        """Whether other processes do the work, which Dask manages."""
        return self.workers > 0 or self.cluster is not None


class Piece(NamedTuple):
    """The twins that are sent to a worker together: a shard, or one twin of it.

    The twins of a shard are sent one by one if workers died while flying the shard.

    Attributes
    ----------
    group_number : int
        The number of the group in the fleet.
    kit : bytes
        The packed `Kit` of the twins.
    members : tuple of Member
        The twins.
    """

    group_number: int
    kit: bytes
    members: tuple[Member, ...]


def fly_pieces(
    engine: Engine, pieces: Iterator[Piece], progress: Progress
) -> Iterator[tuple[Piece, ShardResult]]:
    """Fly pieces with the processes of an engine, and yield each with its result once it is done.

    Parameters
    ----------
    pieces : iterator of Piece
        The next one is taken from the iterator when a worker is free for it.
    progress : Progress
        Shows the address of the dashboard of workers.

    Raises
    ------
    FleetError
        If the scheduler does not answer, or if workers run another version of the program.
    """
    if not engine.needs_dask:
        for piece in pieces:
            yield piece, _fly_piece(piece)
        return
    with _connected_client(engine, progress) as client:
        yield from _fly_by_workers(client, pieces)


def _fly_by_workers(
    client: "Client", pieces: Iterator[Piece]
) -> Iterator[tuple[Piece, ShardResult]]:
    """Fly the pieces of a fleet by Dask workers; yield each with its result when it has flown.

    If more than `ALLOWED_DEATHS` workers died while flying a piece, its twins are flown one by one.
    A single twin with as many deaths is returned as failed.
    """
    from distributed import CancelledError, as_completed
    from distributed.comm import CommClosedError
    from distributed.scheduler import KilledWorker

    piece_of_key: dict[str, Piece] = {}

    def submit(some_pieces: Iterable[Piece]) -> "list[Future]":
        futures = []
        for piece in some_pieces:
            future = client.submit(
                _call_on_worker, _fly_piece, piece, program_version(), pure=False
            )
            piece_of_key[future.key] = piece
            futures.append(future)
        return futures

    cores = max(1, sum(client.nthreads().values()))
    running_flights = as_completed(submit(islice(pieces, cores * (1 + WAITING_PER_CORE))))
    for future in running_flights:
        piece = piece_of_key.pop(future.key)
        try:
            # The scheduler flies a piece again, on another worker, if its worker died.
            result: ShardResult = future.result()
        except KilledWorker:
            if len(piece.members) > 1:
                single_twins = [piece._replace(members=(member,)) for member in piece.members]
                running_flights.update(submit(single_twins))
                continue
            reason = "its flight ended the worker process: fly an FMU that crashes isolated."
            result = result_of_unflown(piece.members[0], reason)
        except (CancelledError, CommClosedError):  # while it flew, or while its result was fetched
            raise FleetError(
                "the scheduler was lost: what was flown is kept, "
                "repeat the command to go on from there."
            ) from None
        yield piece, result
        del future  # lets the workers forget the result
        running_flights.update(submit(islice(pieces, 1)))


class TaskPool:
    """Computes a function of many tasks with the processes of an engine.

    Parameters
    ----------
    client : Client or None
        None if this process computes.
    """

    def __init__(self, client: "Client | None") -> None:
        self._client = client

    def results(
        self, function: Callable[[_Task], _Result], tasks: Iterable[_Task]
    ) -> Iterator[_Result]:
        """Yield the results of tasks in the order of the tasks, however many workers there are.

        Parameters
        ----------
        function : callable
            A function of one task, at the top level of a module.
        tasks : iterable
            The next one is taken from the iterable when a worker is free for it.

        Raises
        ------
        FleetError
            If the scheduler is lost, if workers die over the same task again and again, or if they
            run another version of the program.
        """
        if self._client is None:
            yield from map(function, tasks)
            return
        from distributed import CancelledError
        from distributed.comm import CommClosedError
        from distributed.scheduler import KilledWorker

        remaining_tasks = iter(tasks)
        running: deque[Future] = deque()
        most_running = max(1, sum(self._client.nthreads().values())) * (1 + WAITING_PER_CORE)
        while True:
            for task in islice(remaining_tasks, most_running - len(running)):
                running.append(
                    self._client.submit(
                        _call_on_worker, function, task, program_version(), pure=False
                    )
                )
            if not running:
                return
            try:
                # The scheduler gives a task to another worker if its worker died.
                result: _Result = running.popleft().result()
            except KilledWorker:
                raise FleetError(
                    f"{ALLOWED_DEATHS + 1} workers died over the same twins, most likely because "
                    "memory was short: repeat the command with fewer workers."
                ) from None
            except (CancelledError, CommClosedError):
                raise FleetError("the scheduler was lost: repeat the command.") from None
            yield result


@contextmanager
def open_task_pool(engine: Engine, progress: Progress) -> Iterator[TaskPool]:
    """Provide a pool of the processes of an engine.

    Raises
    ------
    FleetError
        If the scheduler does not answer.
    """
    if not engine.needs_dask:
        yield TaskPool(None)
        return
    with _connected_client(engine, progress) as client:
        yield TaskPool(client)


@cache
def program_version() -> str:
    """Return a hash of this program, Python and all packages that can change results."""
    provenance = collect_provenance().as_dict()
    python = list(sys.version_info[:2])
    parts = [provenance[name] for name in ("versions", "source_hashes", "plug_ins")]
    return hash_record([*parts, python])


def _call_on_worker(function: Callable[[_Task], _Result], task: _Task, version: str) -> _Result:
    """Return the result of a task; raise an error if the worker runs another program version."""
    if version != program_version():
        raise FleetError(
            "a worker of the cluster runs another version of this program, of Python or of a "
            "package that numbers depend on: install the same lock file there. "
            "What was flown before is kept."
        )
    return function(task)


def _fly_piece(piece: Piece) -> ShardResult:
    """Fly a piece."""
    return fly_shard(piece.kit, piece.members)


@contextmanager
def _connected_client(engine: Engine, progress: Progress) -> "Iterator[Client]":
    """Provide a client of the cluster, or of local workers that end with the context."""
    import dask

    # Importing `distributed` adds its defaults to the configuration. That must happen before the
    # settings below, which are undone at the end together with all that was added meanwhile.
    import distributed  # noqa: F401

    quiet_settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_DEATHS,
        "distributed.comm.timeouts.connect": CONNECTING,
        "distributed.worker.memory.terminate": False,
        "distributed.admin.large-graph-warning-threshold": "1 GiB",
        # Dask would keep the last 1,000 messages to each worker: hundreds of megabytes of tasks.
        "distributed.admin.low-level-log-length": 10,
        "distributed.nanny.pre-spawn-environ": _WORKER_ENVIRONMENT,
        "logging.distributed": "critical",
    }
    with dask.config.set(quiet_settings):
        logging.getLogger("distributed").setLevel(logging.CRITICAL)
        if engine.cluster is not None:
            connection = _cluster_client(engine.cluster)
        else:
            connection = _local_client(engine.workers)
        with connection as client:
            progress.note(f"Dask dashboard: {client.dashboard_link}")
            yield client


@contextmanager
def _cluster_client(address: str) -> "Iterator[Client]":
    """Provide a client of the scheduler at an address; raise an error if it has no workers."""
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECTING)
    except (OSError, TimeoutError, ValueError) as error:
        raise FleetError(
            f"no Dask scheduler answers at {address}: start one with `dask scheduler` and give "
            "the address that it prints."
        ) from error
    with client:
        if not client.nthreads():
            raise FleetError(
                f"the scheduler at {address} has no workers: "
                f"start some with `dask worker {address}`."
            )
        yield client


@contextmanager
def _local_client(workers: int) -> "Iterator[Client]":
    """Provide a client of worker processes of this machine."""
    from distributed import Client, LocalCluster

    with (
        _hidden_main_module(),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextmanager
def _hidden_main_module() -> Iterator[None]:
    """Provide a context in which new processes do not run the caller's script again.

    `multiprocessing` imports the main module of its parent in each new process, both at the start
    and when it replaces a dead worker. An empty module in its place prevents this.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
