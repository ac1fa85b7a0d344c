"""A fleet from its plan to its store: checked whole, prepared, flown in shards, resumed where it stopped."""

import json
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reporting.files import (
    atomic_write_text,
    explained_write_errors,
    hash_record,
    read_members,
    write_members,
)
from reporting.folders import closing_lock
from reporting.former_names import with_present_names
from reporting.json_file import read_json
from reporting.progress import Progress, SilentProgress
from reporting.provenance import collect_provenance
from twin_master import run_folder
from twin_master.assets.asset_source import AssetSource
from twin_master.assets.resolution import asset_source, believed_source
from twin_master.errors import FleetError, RunFolderError, said
from twin_master.fleet.evidence import why_transitions_are_kept
from twin_master.fleet.plan import Fleet, Group, Member, load_fleet
from twin_master.fleet.shard import Engine, Piece, ShardResult, flown, unflown, with_parameters
from twin_master.fleet.store import STORE_NAME, check_installed, create_store, sizes_of
from twin_master.mission.journal import JOURNAL_NAME, JournalFile, records
from twin_master.mission.preparation import KNOWLEDGE_NAME, prepare_knowledge, save_knowledge
from twin_master.mission.side_by_side import FLIGHT_ERRORS
from twin_master.scenario import reading as scenario_reading
from twin_master.scenario.schema import Scenario
from twin_master.watch.feeds import file_feed

if TYPE_CHECKING:
    import zarr

KIND, WATCHED_KIND = "uav-twin fleet", "uav-twin fleet watch"
"""In the configuration of a fleet that is flown, and of one that is watched."""
RESULT_NAME = "fleet.json"
GROUPS = "groups"


@dataclass(frozen=True)
class FleetOutcome:
    """A flown fleet.

    Attributes
    ----------
    folder : Path
    twins : int
        How many there are.
    failures : dict of str to str
        What ended the flight of each that failed, by group and name.
    ended : dict of str to str
        How each asset that ended its simulation early has done so; what it has flown counts.
    seconds : float
        Wall clock of this call.
    shards_flown, shards_kept : int
        How many shards this call flew, and how many were there already.
    """

    folder: Path
    twins: int
    failures: Mapping[str, str]
    ended: Mapping[str, str]
    seconds: float
    shards_flown: int
    shards_kept: int


def fly_fleet(
    fleet: Fleet | str | Path,
    folder: Path | str,
    engine: Engine | None = None,
    *,
    replace_old: bool = False,
    progress: Progress | None = None,
) -> FleetOutcome:
    """Fly a fleet, or the rest of one.

    Parameters
    ----------
    fleet : Fleet or path
        The fleet, or its file.
    folder : Path
        Of the store; a fleet that was begun there with the same plan and program is gone on with.
    engine : Engine, optional
        Who flies; this process by default.
    replace_old : bool
        Begin anew where another fleet was flown.
    progress : Progress, optional

    Raises
    ------
    FleetError
        An asset cannot fly: all such assets are in one list, and nothing was begun. Or the cluster cannot be
        used; what was flown is kept. Or the extra `fleet` is not installed.
    RunFolderError
        The folder holds something else.
    NotResumableError
        The fleet there was begun with another version of the program.
    FileNotWrittenError
        The disk is full or the folder cannot be written; what was flown is kept.
    """
    begin = time.perf_counter()
    fleet = fleet if isinstance(fleet, Fleet) else load_fleet(fleet)
    folder, progress = Path(folder), progress or SilentProgress()
    engine = engine or Engine()
    check_installed("zarr", *(["distributed"] if engine.workers or engine.cluster else []))
    ready = partial(_check, fleet)
    with held_fleet(folder, KIND, fleet.record(), replace_old=replace_old, ready=ready) as config:
        if not (folder / JOURNAL_NAME).is_file():
            create_store(folder, fleet)
        for group in fleet.groups:
            if reason := why_transitions_are_kept(group.scenarios[0]):
                progress.note(f"{group.name}: `fleet learn` leaves the transitions as assumed: {reason}.")
        with JournalFile(folder, hash_record(config)) as journal:
            shards, flown = _fly(fleet, folder, engine, journal, progress)
        told = told_of(folder)
        result = fleet.head.model_dump(exclude={"shard"}) | {"twins": fleet.size}
        atomic_write_text(folder / RESULT_NAME, run_folder.to_json(result | told))
    seconds = time.perf_counter() - begin
    return FleetOutcome(folder, fleet.size, told["failures"], told["ended"], seconds, flown, shards - flown)


def told_of(folder: Path) -> dict[str, dict[str, str]]:
    """Return `failures` and `ended` of a flown fleet by group and name: of its journal, else as it ended."""
    path, result = folder / JOURNAL_NAME, folder / RESULT_NAME
    done = [record for record, *_ in records(path)]
    if not path.is_file() and result.is_file():
        done = [read_json(result, FleetError)]
    return {
        key: dict(sorted(item for record in done for item in record[key].items()))
        for key in ("failures", "ended")
    }


@contextmanager
def held_fleet(
    folder: Path, kind: str, record: Mapping[str, Any], *, replace_old: bool = False,
    ready: Callable[[], None] = lambda: None,
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Make the folder of a fleet, or see that it holds the same; hold it, and give its configuration.

    Parameters
    ----------
    folder : Path
    kind, record
        Of the configuration.
    replace_old : bool
        Begin anew where another fleet is.
    ready : callable
        Called before anything is written; may refuse.

    Raises
    ------
    RunFolderError
        It holds something else, or another process holds it.
    NotResumableError
        It was begun by another version.
    """
    config = {"kind": kind, "format": 1, "fleet": record}
    found = None if replace_old else run_folder.find_config(folder, kind)
    if found is None:
        ready()
        provenance = collect_provenance(record["seed"]).as_dict()
        with run_folder.create_run_folder(folder, {**config, "provenance": provenance}, replace=replace_old):
            yield config
        return
    if {key: found.get(key) for key in config} != json.loads(run_folder.to_json(config)):
        otherwise = ", or give --replace" if kind == KIND else ""
        raise RunFolderError(said("fleet.another", folder=folder, otherwise=otherwise))
    run_folder.check_versions(folder, found, record["seed"])
    ready()
    with closing_lock(run_folder.lock_run_folder(folder)):
        yield config


PRESENT_NAMES = {
    f"fleet.groups.scenarios.{location}": name for location, name in scenario_reading.PRESENT_NAMES.items()
}
"""The present name of each key of the configuration of a fleet, by the location that it had before."""


def fleet_config(folder: Path, *kinds: str) -> dict[str, Any]:
    """Return the configuration of a folder that holds a fleet, by default one that is flown.

    Raises
    ------
    RunFolderError
        It holds no fleet.
    """
    found = run_folder.find_config(folder, *(kinds or (KIND,)))
    if found is None or "fleet" not in found:
        raise RunFolderError(
            f"{folder} is not the folder of a fleet." if folder.exists() else f"there is no folder {folder}."
        )
    return with_present_names(found, PRESENT_NAMES, str(folder / run_folder.CONFIG_NAME), RunFolderError)


def flies_model(scenario: Scenario) -> bool:
    """Return whether the reduced model itself is flown, in the place of the FMU that is packed of it."""
    asset, belief = scenario.asset, scenario.belief
    same = (asset.kind, belief.kind) == ("design", "design") and not scenario.another_model
    return same and getattr(asset, "design", None) == getattr(belief, "design", None)


def source_of(scenario: Scenario, *, real: bool = False) -> AssetSource:
    """Return what flies in a fleet, and what its twin believes; the latter alone where assets are real."""
    return believed_source(scenario) if real or flies_model(scenario) else asset_source(scenario)


def _check(fleet: Fleet) -> None:
    """Check every asset before the first one flies.

    Raises
    ------
    FleetError
        With all that cannot fly, and why.
    """
    wrong = []
    for group in fleet.groups:
        means = {name: spread.mean for name, spread in group.spreads.items()}
        several = len(group.scenarios) > 1
        for place, scenario in enumerate(group.scenarios):
            try:
                _check_group(group, scenario)
                source_of(with_parameters(scenario, means), real=bool(group.observations)).check()
            except FLIGHT_ERRORS as error:
                asset = f" {group.members[place].name}" if several else ""
                wrong.append(f"{group.name}{asset}: {error}")
        for path in [member.file for member in group.members if group.observations]:
            try:
                file_feed(path or Path(), group.scenarios[0])
            except FLIGHT_ERRORS as error:
                wrong.append(f"{group.name}: {error}")
    if wrong:
        raise FleetError("\n".join([f"{len(wrong)} of the assets cannot fly, so none did:", *wrong]))


def _check_group(group: Group, scenario: Scenario) -> None:
    if scenario.observation.role == "modes":
        raise FleetError(said("fleet.modes"))
    if group.observations:
        names = {member.name for member in group.members}
        if not names:
            raise FleetError(said("fleet.recording", observations=group.observations))
        if len(names) < len(group.members):
            raise FleetError("two recordings have the same name, and it names the asset.")
        return
    one_life = scenario.truth.kind == "asset" and not getattr(scenario.asset, "seeds", ())
    if one_life and len(group.scenarios) < len(group.members):
        raise FleetError(said("fleet.one_life"))
    unknown = sorted({*group.spreads} - {"young_modulus_factor"})
    if flies_model(scenario) and unknown:
        raise FleetError(said("fleet.parameters", names=", ".join(unknown)))
    if flies_model(scenario):
        _check_truth(group, scenario)
    if sizes_of(scenario) != sizes_of(group.scenarios[0]):
        raise FleetError("it has other states or sensors than the first asset of its group.")


def _check_truth(group: Group, scenario: Scenario) -> None:
    """Check that the model holds where the true assets are."""
    from fe.wing.design import wing_structure

    name, asset = "young_modulus_factor", scenario.asset.true_parameters
    values = [member.parameters.get(name, asset.get(name, 1.0)) for member in group.members]
    low, high = wing_structure(scenario.state_names, 0).ranges[name]
    if outside := [value for value in values if not low - 1e-12 <= value <= high + 1e-12]:
        told = {"what": name, "count": len(outside), "number": len(values)}
        raise FleetError(said("fleet.outside", low=low, high=high, example=outside[0], **told))


def prepared(scenario: Scenario, folder: Path, *, real: bool = False) -> bytes:
    """Return what `fly_shard` wants of a scenario, what belongs to it made in a folder."""
    located = scenario.portable().moved(folder)
    write_members(folder, source_of(scenario, real=real).files())
    source = source_of(located, real=real)
    source.prepare(folder, SilentProgress())
    if not (folder / KNOWLEDGE_NAME).is_file():
        save_knowledge(folder, prepare_knowledge(located, source, scenario.mission.seed))
    wing = getattr(source, "wing", None) if flies_model(scenario) and not real else None
    packed = scenario.portable().to_dict(), read_members(folder), wing
    return pickle.dumps(packed, pickle.HIGHEST_PROTOCOL)


def group_folder(folder: Path, group: Group, place: int) -> Path:
    """Return where what the twins of a group know is kept, those of one of its scenarios."""
    return folder / GROUPS / group.name / str(place)


def _fly(
    fleet: Fleet, folder: Path, engine: Engine, journal: JournalFile, progress: Progress
) -> tuple[int, int]:
    """Fly what is not in the store yet; return how many shards there are, and how many of them it flew."""
    import zarr

    @cache
    def arrays(group: str) -> "dict[str, zarr.Array[Any]]":
        opened = zarr.open_group(folder / STORE_NAME, mode="r+", path=group, use_consolidated=False)
        return dict(opened.arrays())

    @lru_cache(maxsize=2)
    def kit(number: int, place: int) -> bytes:
        group = fleet.groups[number]
        own = group_folder(folder, group, place)
        return prepared(group.scenarios[place], own, real=bool(group.observations))

    def pieces() -> Iterator[Piece]:
        for number, members in left:
            group = fleet.groups[number]
            try:
                packed = kit(number, members[0].place)
                ready = tuple(_recorded(group, member) for member in members)
            except FLIGHT_ERRORS as error:
                if len(group.scenarios) == 1:
                    raise
                keep(number, members, unflown(members[0], str(error)))  # of one asset with a file of its own
            else:
                yield Piece(number, packed, ready)

    def keep(number: int, members: Sequence[Member], result: ShardResult) -> None:
        group, first, end = fleet.groups[number], members[0].row, members[-1].row + 1
        with explained_write_errors(folder / STORE_NAME):
            for name, values in result[0].items():
                arrays(group.name)[name][first:end] = values
        told = {
            what: {f"{group.name}/{name}": text for name, text in texts.items()}
            for what, texts in result[1].items()
        }
        journal.append({"group": number, "rows": [first, end], **told})

    there = {
        (record["group"], row)
        for record, *_ in records(journal.path)
        for row in range(*record["rows"])  # workers may cut a shard
    }
    whole = list(_shards(fleet))
    left = [(number, own) for number, own in whole if not there.issuperset((number, m.row) for m in own)]
    with progress.stage("Flying", total=fleet.size, unit="twins") as stage:
        stage.advance(fleet.size - sum(len(members) for _, members in left))
        for piece, result in flown(engine, pieces(), progress) if left else ():
            keep(piece.group, piece.members, result)
            stage.advance(len(piece.members))
    return len(whole), len(left)


def _recorded(group: Group, member: Member) -> Member:
    """Return a member with what its real asset has shown: workers need no files."""
    if not group.observations or member.file is None:
        return member
    return replace(member, recording=tuple(file_feed(member.file, group.scenarios[0]).messages(None)))


def _shards(fleet: Fleet) -> Iterator[tuple[int, Sequence[Member]]]:
    """Yield all shards in their order: twins that share a scenario, no more of them than a shard holds."""
    for number, group in enumerate(fleet.groups):
        size = fleet.head.shard if len(group.scenarios) == 1 else 1
        for first in range(0, len(group.members), size):
            yield number, group.members[first : first + size]
