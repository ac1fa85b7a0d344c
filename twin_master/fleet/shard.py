"""What a worker does: it flies some twins of one group, and hands back arrays.

A piece of work carries all that it needs, so that it can be done on any machine, by any process, any number
of times: the result is the same to the last bit.

Who flies: this process, worker processes of this machine, or a Dask cluster at an address. Results come back
in any order.
"""

import logging
import pickle
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from tempfile import mkdtemp
from types import ModuleType
from typing import TYPE_CHECKING, Any
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from reporting.files import hash_record, write_members
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance
from twin_master.assets.asset_source import Asset, AssetSource, StatelessAsset
from twin_master.assets.fmu_source import FmuSource
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import FleetError, said
from twin_master.fleet.plan import Member
from twin_master.fleet.store import FAILED, outcomes_of
from twin_master.mission.loop import operate
from twin_master.mission.preparation import Knowledge, load_knowledge
from twin_master.mission.replay import BelievedModel, refilter
from twin_master.mission.side_by_side import FLIGHT_ERRORS, Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.steps import History, Reading
from twin_master.network.estimator import Notice
from twin_master.scenario.schema import Scenario
from twin_master.watch.intake import Feed, Intake
from twin_master.watch.message import Fed

if TYPE_CHECKING:
    from distributed import Client


def assimilated(knowledge: Knowledge, recordings: Sequence[Sequence[Fed]]) -> Flights:
    """Return what B twins conclude of B recordings: beliefs and controls are those of a watch of each."""
    flights, most = Flights.empty(knowledge, len(recordings)), knowledge.scenario.mission.steps
    for number, messages in enumerate(recordings):
        try:
            history = _history(knowledge, messages)
        except FLIGHT_ERRORS as error:
            flights.failure[number] = str(error)
            continue
        steps = len(history.steps)
        if not steps:
            flights.failure[number] = "its recording has no step yet."
        elif steps > most:
            flights.failure[number] = (
                f"it has {steps} steps, and {most} at most are flown: set `steps` of the group."
            )
        else:
            flights.store_history(number, history)
    return flights


def _history(knowledge: Knowledge, messages: Sequence[Fed]) -> History:
    scenario = knowledge.scenario
    twin = knowledge.twin(lag=scenario.watch.lag)
    history = History(twin, scenario.observation.count)
    intake, seen, late = Intake(scenario, Feed(messages)), {}, False
    lost: list[tuple[int, Notice]] = []
    for step in operate(twin, intake, history.add):
        at = intake.observation_step
        seen[at] = Reading(step.reading.observed, twin.control_of(at))
        late |= step.reading.revises is not None
        lost += [(at, notice) for notice in intake.notices]
    if late:
        history = refilter(seen, [BelievedModel(0, knowledge)])
    history.notices += lost
    return history


ShardResult = tuple[Mapping[str, NDArray[Any]], dict[str, dict[str, str]]]
"""Variables of the store with B rows; and by the names of twins what ended their flights, `failures`, and how
assets ended their simulations early, `ended`."""


def unflown(member: Member, sentence: str) -> ShardResult:
    """Return what is kept of a twin that could not fly, and why."""
    status = {"status": np.array([FAILED]), "seed": np.array([member.seed])}
    return status, {"failures": {member.name: sentence}, "ended": {}}


@cache
def program_version() -> str:
    """Return a hash of this program and the packages that its numbers depend on."""
    found = collect_provenance().as_dict()
    return hash_record([found["versions"], found["source_hashes"], list(sys.version_info[:2])])


class Kit:
    """All that the twins of a scenario need, on any machine, ready to fly.

    Parameters
    ----------
    packed : bytes
        Pickled: the scenario, portable; the prepared folder, files by their paths: what the twin knows, and
        the FMU; and the model that is flown in the place of an FMU, or None.
    """

    def __init__(self, packed: bytes) -> None:
        scenario, files, self.wing = pickle.loads(packed)
        self._folder = folder = Path(mkdtemp(prefix="uav_twin_fleet_"))
        finalize(self, shutil.rmtree, folder, ignore_errors=True)
        write_members(folder, files)
        self.scenario = Scenario.model_validate(scenario).moved(folder)
        self.knowledge: Knowledge = load_knowledge(folder, self.scenario)

    def told(self, sentence: str) -> str:
        """Return a sentence without the folder of this process, which nobody else knows."""
        return sentence.replace(f"{self._folder}/", "")

    def opened(self, parameters: Mapping[str, float], seed: int | None = None) -> Asset:
        """Return what is flown: the model, or an FMU."""
        scenario = with_parameters(self.scenario, parameters)
        if self.wing is not None:
            return ReducedModelSource(scenario, self.wing).open()
        if seed is not None:
            scenario = scenario.under(seed)
        source: AssetSource = scenario.asset.source(scenario)
        if isinstance(source, FmuSource):
            source.use(self._folder)  # packed already
        else:
            source.prepare(self._folder, SilentProgress())
        return source.open()


_unpacked = lru_cache(maxsize=1)(Kit)
"""Gives the last kit of this process again: shards of a group follow each other."""


def with_parameters(scenario: Scenario, parameters: Mapping[str, float]) -> Scenario:
    """Return a scenario whose asset has these true parameters, beside those that it has."""
    if not parameters:
        return scenario
    return scenario.having("asset", parameters={**scenario.asset.true_parameters, **parameters})


def fly_shard(packed: bytes, members: Sequence[Member]) -> ShardResult:
    """Fly some twins of one group.

    Parameters
    ----------
    packed : bytes
        Of a `Kit`, pickled.
    members : sequence of Member
        B of them.
    """
    kit = _unpacked(packed)
    recorded = [member.recording for member in members if member.recording is not None]
    flights = assimilated(kit.knowledge, recorded) if recorded else _flown(kit, members)
    told = {
        what: {m.name: kit.told(text) for m, text in zip(members, texts, strict=True) if text}
        for what, texts in (("failures", flights.failure), ("ended", flights.ended))
    }
    return outcomes_of(kit.knowledge, flights, members), told


def _flown(kit: Kit, members: Sequence[Member]) -> Flights:
    """Fly twins with their assets."""
    truths = [kit.knowledge.truth(member.seed) for member in members]
    with _Hangar(kit, members) as hangar:
        if kit.scenario.learning is None and kit.scenario.notice is None:
            with suppress(*FLIGHT_ERRORS):  # which then happens to each of them
                if assets := hangar.together():
                    return fly_side_by_side(kit.knowledge, truths, assets)
        return fly_one_by_one(kit.knowledge, truths, hangar.asset)


class _Hangar(ExitStack):
    """Assets that may have a memory, one open at a time; what failed is opened anew for the next twin."""

    def __init__(self, kit: Kit, members: Sequence[Member]) -> None:
        super().__init__()
        seeds = bool(getattr(kit.scenario.asset, "seeds", ()))  # where assets have seeds of their own
        self._kit = kit
        self._wanted = [(member.parameters, member.seed if seeds else None) for member in members]
        self._asset: Asset | None = None
        self._start, self._opened = b"", self._wanted[0]

    def together(self) -> list[Asset]:
        """Return the assets of all twins where none has a memory, and one stands for all that are alike."""
        if self._kit.wing is not None:
            keys = [tuple(sorted(parameters.items())) for parameters, _ in self._wanted]
            models = {key: self._kit.opened(dict(key)) for key in {*keys}}
            return [models[key] for key in keys]
        alike = all(wanted == self._wanted[0] for wanted in self._wanted)
        asset = self._at_start(0, False) if alike else None
        return [asset] * len(self._wanted) if isinstance(asset, StatelessAsset) else []

    def asset(self, twin: int, sound: bool) -> Asset:
        """Return the asset of a twin, which flies alone, at its start."""
        if self._kit.scenario.planner.inspections_per_step is not None:
            raise FleetError("`inspections_per_step` needs assets without memory, which fly side by side")
        return self._at_start(twin, sound)

    def _at_start(self, twin: int, sound: bool) -> Asset:
        wanted = self._wanted[twin]
        if self._asset is not None and sound and wanted == self._opened:
            self._asset.restore_state(self._start)
        else:
            self._asset = None
            self.close()
            self._asset = self._kit.opened(*wanted)
            self.callback(self._asset.close)
            self._start, self._opened = self._asset.save_state(), wanted
        return self._asset


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


def flown(engine: Engine, pieces: Iterator[Piece], progress: Progress) -> Iterator[tuple[Piece, ShardResult]]:
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


def _by_workers(client: "Client", pieces: Iterator[Piece]) -> Iterator[tuple[Piece, ShardResult]]:
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
            result: ShardResult = future.result()  # flown again where its worker died with it
        except KilledWorker:
            if len(piece.members) > 1:
                waiting.update(submit(replace(piece, members=(one,)) for one in piece.members))
                continue
            sentence = "its flight ended the worker process: fly an FMU that crashes isolated."
            result = unflown(piece.members[0], sentence)
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
