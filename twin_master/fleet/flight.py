"""The flight of a fleet, whose results are stored shard by shard."""

from __future__ import annotations

import pickle
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from reporting.files import (
    atomic_write_text,
    explained_write_errors,
    hash_record,
    read_members,
    write_members,
)
from reporting.json_file import read_json
from reporting.pages.notebook import html_table
from reporting.progress import Progress, SilentProgress, note
from reporting.words import listing
from twin_master import run_folder
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import FleetError
from twin_master.feeds.feed_choice import file_feed
from twin_master.fleet.checks import check_fleet, flies_model, source_of
from twin_master.fleet.comparison import group_statistics, statistic_rows
from twin_master.fleet.configuration import knowledge_folder, locked_fleet_folder
from twin_master.fleet.engine import Engine, Piece, fly_pieces
from twin_master.fleet.learning.evidence import reason_transitions_are_fixed
from twin_master.fleet.members import Member
from twin_master.fleet.plan import Fleet, Group, load_fleet
from twin_master.fleet.reading import open_fleet, open_groups
from twin_master.fleet.shard import ShardResult, reason_flown_one_by_one, result_of_unflown
from twin_master.fleet.storage.store import check_installed
from twin_master.fleet.storage.store_address import STORE_NAME, StoreAddress
from twin_master.fleet.storage.store_writing import GroupWriter, create_store
from twin_master.mission.journal import JOURNAL_NAME, JournalFile, records
from twin_master.mission.knowledge_file import KNOWLEDGE_NAME, save_knowledge
from twin_master.mission.parts import (
    NO_PARTS,
    GivenEstimator,
    GivenPolicy,
    GivenSensorModel,
    TwinParts,
)
from twin_master.mission.plant import FLIGHT_ERRORS
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network.graphical_model import build_graphical_model
from twin_master.pictures import plot_courses
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RESULT_NAME = "fleet.json"
"""The file in the folder of a fleet that says how its flight ended."""
_PACKED_KITS = 2
"""Number of packed kits (scenario, prepared folder and model) that are kept in memory."""


@dataclass(frozen=True)
class FleetOutcome:
    """The outcome of a fleet's flight: numbers of twins and shards, and why flights ended early.

    Attributes
    ----------
    twins : int
        The number of twins.
    failures : dict of str to str
        The error that ended the flight of each twin that failed, by GROUP/NAME.
    ended : dict of str to str
        The reason of each asset that ended its simulation early, by GROUP/NAME; its flown steps are
        stored.
    seconds : float
        The wall-clock time of this call [s].
    shards_flown, shards_kept : int
        The numbers of shards that this call and earlier calls have flown.
    """

    folder: Path
    twins: int
    failures: Mapping[str, str]
    ended: Mapping[str, str]
    seconds: float
    shards_flown: int
    shards_kept: int

    def _repr_html_(self) -> str:
        """Return how the twins of each group fared, for a notebook."""
        groups = open_groups(self.folder)
        statistics = {name: group_statistics(group) for name, group in groups.items()}
        title = f"Fleet of {self.twins} twins in {self.folder}"
        return html_table(title, ("result", *statistics), statistic_rows(statistics))

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> list[Axes]:
        """Draw the believed states of all twins over the steps, with the median of the truth.

        Parameters
        ----------
        axes : Axes or sequence of Axes, optional
            A panel for each factor of the state of each group; new ones of pyplot by default.

        Returns
        -------
        list of Axes
            The panels.
        """
        return plot_courses(open_fleet(self.folder), axes)


def fly_fleet(
    fleet: Fleet | str | Path,
    folder: Path | str,
    engine: Engine | None = None,
    *,
    policy: GivenPolicy | None = None,
    sensor_model: GivenSensorModel | None = None,
    estimator: GivenEstimator | None = None,
    store: str = "",
    replace_old: bool = False,
    progress: Progress | None = None,
) -> FleetOutcome:
    """Fly all twins of a fleet that are not in its store yet.

    Parameters
    ----------
    fleet : Fleet or path
        The plan of the fleet, or its file.
    folder : Path or str
        The folder of the store; a fleet that was begun there with the same plan and program is
        continued.
    engine : Engine, optional
        The processes that fly; by default this one.
    policy, sensor_model, estimator : optional
        Parts of all twins that replace those of the scenarios, see `fly`. Worker processes must be
        able to import the modules of objects.
    store : str
        The address of the store, such as "s3://bucket/winter.zarr"; by default it is in the folder.
    replace_old : bool
        Whether another fleet in the folder is removed.

    Returns
    -------
    FleetOutcome
        The flown fleet.

    Raises
    ------
    FleetError
        If an asset cannot fly: the message lists all such assets, and no twin has flown. If the
        store cannot be at its address. If the cluster cannot be used: shards that were flown stay
        in the store. If the extra `fleet` is not installed.
    RunFolderError
        If the folder holds something else.
    NotResumableError
        If the fleet was begun with another version of the program.
    FileNotWrittenError
        If the disk is full or the folder cannot be written; shards that were flown stay in the
        store.
    """
    start = time.perf_counter()
    fleet = fleet if isinstance(fleet, Fleet) else load_fleet(fleet)
    folder = Path(folder)
    given_parts = TwinParts(policy, sensor_model, estimator)
    if given_parts.is_any_given:
        fleet = fleet.with_parts(given_parts)
    progress = progress or SilentProgress()
    engine = engine or Engine()
    if store:
        fleet = fleet.with_store(store)
    address = StoreAddress(folder, fleet.store)
    address.check()
    check_installed("zarr", *(["distributed"] if engine.needs_dask else []))

    def check() -> None:
        """Check what may keep the fleet from flying, before anything is written."""
        check_fleet(fleet)
        if replace_old or run_folder.find_config(folder, run_folder.FLEET_KIND) is None:
            address.check_new(replace_old=replace_old)

    with locked_fleet_folder(
        folder,
        run_folder.FLEET_KIND,
        fleet.record(),
        replace_old=replace_old,
        check=check,
    ) as config:
        if not (folder / JOURNAL_NAME).is_file():
            create_store(folder, fleet)
        _note_limits(fleet, progress)
        with JournalFile(folder, hash_record(config)) as journal:
            flight = _FleetFlight(fleet, folder, journal)
            flight.fly(engine, progress)
        failures, early_ends = endings_of(folder)
        result = fleet.head.model_dump(exclude={"shard"})
        result |= {"twins": fleet.size, "failures": failures, "ended": early_ends}
        atomic_write_text(folder / RESULT_NAME, run_folder.to_json(result))
    return FleetOutcome(
        folder=folder,
        twins=fleet.size,
        failures=failures,
        ended=early_ends,
        seconds=time.perf_counter() - start,
        shards_flown=len(flight.remaining_shards),
        shards_kept=flight.shards_kept,
    )


def _note_limits(fleet: Fleet, progress: Progress) -> None:
    """Notify the user of groups that learn no transitions, and of those that fly slowly."""
    for group in fleet.groups:
        scenario = group.scenarios[0]
        reason = reason_transitions_are_fixed(scenario)
        if reason:
            progress.note(
                f"{group.name}: `fleet learn` leaves the transitions as assumed: {reason}."
            )
        reason = reason_flown_one_by_one(scenario, fleet.parts)
        if reason and not group.observations and len(group.members) > 1:
            progress.note(
                f"{group.name}: the {len(group.members)} twins fly one after the other because "
                f"{reason}, which takes many times as long as side by side."
            )


def endings_of(folder: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return why flights of a fleet ended before the end of the mission, by GROUP/NAME of the twin.

    The reasons are read from the journal or, if the folder has no journal, from `fleet.json`.

    Returns
    -------
    failures : dict of str to str
        The errors of flights that failed.
    ended : dict of str to str
        The reasons of assets that ended their simulations early.
    """
    journal = folder / JOURNAL_NAME
    result = folder / RESULT_NAME
    if not journal.is_file() and result.is_file():
        content = [read_json(result, FleetError)]
    else:
        content = [record for record, *_ in records(journal)]
    failures: dict[str, str] = {}
    early_ends: dict[str, str] = {}
    for record in content:
        failures |= record["failures"]
        early_ends |= record["ended"]
    return dict(sorted(failures.items())), dict(sorted(early_ends.items()))


def prepare_kit(
    scenario: Scenario, folder: Path, *, is_real: bool = False, parts: TwinParts = NO_PARTS
) -> bytes:
    """Prepare the twins' knowledge of a scenario in a folder, and pack everything a flight needs.

    Knowledge that the folder holds already is not computed again.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the mission, checked.
    folder : Path
        The folder of the prepared knowledge. Knowledge in it is not computed again.
    is_real : bool
        Whether the assets are real, so that no asset is simulated.
    parts : TwinParts
        The user's parts, which replace those of the scenario.

    Returns
    -------
    bytes
        The pickled content of a `Kit`: the scenario, the files of the folder, the reduced model if
        it simulates the asset, else None, and the given sensor model and estimator.

    Raises
    ------
    FleetError
        If a given part cannot be sent to other processes.
    """
    located = scenario.portable().with_paths_from(folder)
    write_members(folder, source_of(scenario, is_real=is_real).files())
    source = source_of(located, is_real=is_real)
    source.prepare(folder, SilentProgress())
    if not (folder / KNOWLEDGE_NAME).is_file():
        policy = parts.policy_for(build_graphical_model(located))
        knowledge = prepare_knowledge(located, source, scenario.mission.seed, policy, parts)
        save_knowledge(folder, knowledge)
        sensor_model = knowledge.sensor_model
        is_slow = sensor_model.takes_observations_one_by_one
        if is_slow and not is_real and not reason_flown_one_by_one(scenario, parts):
            _note_once(
                f"The sensor model {type(sensor_model).__qualname__} has only `log_likelihood`, "
                "which is asked for one twin after the other: to be as fast as that of the "
                "scenario, implement `log_likelihood_sequence(observations, control_index)` in "
                "its place, (rows, sensors) and (rows,) -> (rows, states)."
            )
    model = None
    if flies_model(scenario) and not is_real and isinstance(source, ReducedModelSource):
        model = source.prepared_model
    # The policy is among the files of the folder.
    given_parts = replace(parts, policy=None)
    content = (scenario.portable().to_dict(), read_members(folder), model, given_parts)
    try:
        return pickle.dumps(content, pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        if not parts.replace_filter:
            raise
        raise FleetError(
            f"the given {listing(given_parts.record().values())} cannot be sent to the processes "
            f"that fly ({error}): define the class or function at the top of a module, or give "
            "its name FILE.py:NAME."
        ) from error


@cache
def _note_once(message: str) -> None:
    """Print a line once in a process, even if several scenarios produce it."""
    note(message)


class Shard(NamedTuple):
    """Twins of one group in successive rows, which one process flies together.

    Attributes
    ----------
    rows : range
        The twins, which share a scenario.
    """

    group_number: int
    rows: range


def _shards(fleet: Fleet) -> Iterator[Shard]:
    """Yield the shards of a fleet, group by group, each with its twins in order.

    Members with different scenarios are in different shards.
    """
    for number, group in enumerate(fleet.groups):
        size = fleet.head.shard if len(group.scenarios) == 1 else 1
        twin_count = len(group.members)
        for first in range(0, twin_count, size):
            yield Shard(number, range(first, min(first + size, twin_count)))


class _StoredRows:
    """The rows of a fleet's groups that are in its store.

    Single rows are recorded, because the twins of a shard are stored one by one if workers died
    while flying it. The journal names the rows that were stored before.
    """

    def __init__(self, fleet: Fleet, journal: Path) -> None:
        self._is_stored = [np.zeros(len(group.members), dtype=bool) for group in fleet.groups]
        for record, *_ in records(journal):
            self.note(record["group"], range(*record["rows"]))

    def note(self, group_number: int, rows: range) -> None:
        """Record that rows of a group are in the store."""
        self._is_stored[group_number][rows.start : rows.stop] = True

    def has_all(self, group_number: int, rows: range) -> bool:
        """Return whether the store has all of some rows of a group."""
        return bool(self._is_stored[group_number][rows.start : rows.stop].all())


class _FleetFlight:
    """The flight of a fleet into its store.

    Parameters
    ----------
    journal : JournalFile
        The journal, in which a shard is recorded after it is in the store.

    Attributes
    ----------
    remaining_shards : list of Shard
        The shards that were not in the store at the beginning.
    shards_kept : int
        The number of shards that an earlier call had flown.
    """

    def __init__(self, fleet: Fleet, folder: Path, journal: JournalFile) -> None:
        self._fleet = fleet
        self._folder = folder
        self._journal = journal
        self._stored_rows = _StoredRows(fleet, journal.path)
        address = StoreAddress(folder, fleet.store)
        self._writers = [GroupWriter(address, fleet, group) for group in fleet.groups]
        self._packed_kit = lru_cache(maxsize=_PACKED_KITS)(self._pack_kit)
        shards = list(_shards(fleet))
        self.remaining_shards = [shard for shard in shards if not self._stored_rows.has_all(*shard)]
        self.shards_kept = len(shards) - len(self.remaining_shards)

    def fly(self, engine: Engine, progress: Progress) -> None:
        """Fly the shards that are not in the store yet."""
        remaining = self.remaining_shards
        remaining_twins = sum(len(shard.rows) for shard in remaining)
        # A kill may have come between the last twin of a file and the end of the file.
        for number in range(len(self._fleet.groups)):
            self._finish_files(number)
        with progress.stage("Flying", total=self._fleet.size, unit="twins") as stage:
            stage.advance(self._fleet.size - remaining_twins)
            if remaining:
                for piece, result in fly_pieces(engine, self._pieces(remaining), progress):
                    self._store(piece.group_number, piece.members, result)
                    stage.advance(len(piece.members))

    def _pieces(self, shards: Sequence[Shard]) -> Iterator[Piece]:
        """Yield the shards, each with the knowledge and the recordings that a worker needs.

        If the scenario of a single asset, with its own FMU or calibration, cannot be prepared, the
        asset is stored as failed and the other shards are flown.
        """
        for number, rows in shards:
            group = self._fleet.groups[number]
            members = [*group.members[rows.start : rows.stop]]
            try:
                kit = self._packed_kit(number, members[0].scenario_number)
                if group.observations:
                    # Each member gets its recorded messages, so that workers read no files.
                    for index, member in enumerate(members):
                        if member.file is not None:
                            messages = file_feed(member.file, group.scenarios[0]).messages(None)
                            members[index] = replace(member, recording=tuple(messages))
            except FLIGHT_ERRORS as error:
                if len(group.scenarios) == 1:
                    raise
                self._store(number, members, result_of_unflown(members[0], str(error)))
            else:
                yield Piece(number, kit, tuple(members))

    def _pack_kit(self, group_number: int, scenario_number: int) -> bytes:
        """Prepare a scenario of a group and return its packed kit."""
        group = self._fleet.groups[group_number]
        return prepare_kit(
            group.scenarios[scenario_number],
            knowledge_folder(self._folder, group.name, scenario_number),
            is_real=bool(group.observations),
            parts=self._fleet.parts,
        )

    def _store(self, group_number: int, members: Sequence[Member], result: ShardResult) -> None:
        """Write the result of successive members into the store, and then into the journal."""
        group = self._fleet.groups[group_number]
        rows = range(members[0].row, members[-1].row + 1)
        with explained_write_errors(self._folder / STORE_NAME):
            self._writers[group_number].write(result.variables, rows.start)
        self._journal.append(
            {
                "group": group_number,
                "rows": [rows.start, rows.stop],
                "failures": _with_group_name(group, result.failures),
                "ended": _with_group_name(group, result.ended),
            }
        )
        self._stored_rows.note(group_number, rows)
        self._finish_files(group_number, rows)

    def _finish_files(self, group_number: int, rows: range | None = None) -> None:
        """Finish the files of a group whose twins are all stored, or only those with some rows."""
        writer = self._writers[group_number]
        for number, rows_of_file in enumerate(writer.file_rows):
            is_touched = rows is None or (
                rows.start < rows_of_file.stop and rows_of_file.start < rows.stop
            )
            if is_touched and self._stored_rows.has_all(group_number, rows_of_file):
                with explained_write_errors(self._folder / STORE_NAME):
                    writer.finish_file(number)


def _with_group_name(group: Group, sentences: Mapping[str, str]) -> dict[str, str]:
    """Return sentences by GROUP/NAME, given sentences by the name of the twin."""
    return {f"{group.name}/{name}": sentence for name, sentence in sentences.items()}
