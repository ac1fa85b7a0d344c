"""What a fleet flies: its file, its groups, and the seed of every twin."""

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from reporting.files import hash_file
from reporting.former_names import with_present_names
from reporting.toml_file import Fault, NotNegative, Number, read_toml, validate
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import FleetError, TwinMasterError, said
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Count, Flag, Name, Probability, Section, Seed, repeated_name_fault
from twin_master.seeds import generator
from twin_master.watch.feeds import is_broker
from twin_master.watch.message import Fed

SHARD = 256
"""Twins that are flown in one piece, unless the file says otherwise."""


LARGEST = 1_000_000
"""Twins of a group, or of an ensemble."""


Text = Annotated[str, Field(min_length=1)]


class Spread(Section):
    """A parameter of the true assets: normally distributed over the group."""

    mean: Number
    standard_deviation: NotNegative = 0.0


PRESENT_NAMES = {"group.inspections_a_turn": "inspections_per_step"}
"""The present name of each key of a fleet file, by the location that it had before."""


class GroupSection(Section):
    """Assets that share a scenario."""

    name: Name
    scenario: Text
    count: Annotated[int, Field(strict=True, ge=1, le=LARGEST)] | None = None
    fmus: Text | None = None
    """A pattern of files: one asset for each FMU."""
    calibrations: Text | None = None
    """A pattern of files: one asset for each calibration."""
    observations: Text | None = None
    """A pattern of recordings, or `mqtt://HOST/TOPIC/+`: one real asset for each file, or for each topic."""
    fmu: str | None = None
    binding: str | None = None
    calibration: str | None = None
    in_process: Flag = False
    """FMUs run in the process that flies the shard, without a worker of their own: faster, and a crash ends
    that process."""
    learnt: str | None = None
    """A file of `uav-twin fleet learn`."""
    steps: Count | None = None
    parameters: dict[str, Spread] = Field(default_factory=dict)
    inspections_per_step: Count | None = None
    """What `planner.inspections_per_step` is in this group, which then flies in one shard."""
    true_probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """What `truth.probability` is in this group."""

    def faults(self) -> Iterator[Fault]:
        """Yield other than one kind of members."""
        kinds = self.count, self.fmus, self.calibrations, self.observations
        yield sum(given is not None for given in kinds) != 1, said("fleet.members", name=self.name)


class FleetSection(Section):
    """The fleet as a whole."""

    name: Name
    title: str = ""
    seed: Seed = 0
    shard: Annotated[int, Field(strict=True, ge=1, le=4096)] = SHARD


class FleetFile(Section):
    """A fleet file."""

    format: Literal[1]
    fleet: FleetSection
    group: Annotated[tuple[GroupSection, ...], Field(min_length=1)]

    def faults(self) -> Iterator[Fault]:
        """Yield names that come twice."""
        yield repeated_name_fault("group", [group.name for group in self.group])


@dataclass(frozen=True)
class Member:
    """One asset with its twin.

    Attributes
    ----------
    row : int
        Its number in the group.
    name : str
    seed : int
        What happens to it; the same mission flies with ``uav-twin run --seed``.
    parameters : dict of str to float
        Its true parameters, where the group spreads them, SI.
    place : int
        Of its scenario in the group.
    file : Path or None
        That sets it apart: its FMU, its calibration, or the recording of a real asset.
    recording : tuple or None
        What was observed of a real asset, as it goes to a worker.
    """

    row: int
    name: str
    seed: int
    parameters: Mapping[str, float]
    place: int = 0
    file: Path | None = None
    recording: tuple[Fed, ...] | None = None


@dataclass(frozen=True)
class Group:
    """Assets that share a scenario, or that fly it each with a file of its own.

    Attributes
    ----------
    name : str
    scenarios : tuple of Scenario
        Resolved; one for all assets, or one for each.
    spreads : dict of str to Spread
        Parameters that differ from asset to asset.
    members : tuple of Member
    observations : str
        Where those of real assets come from, a pattern of files or an address; empty where assets are flown.
    file : dict of str to str
        Name and hash of the file of the scenario of real assets.
    """

    name: str
    scenarios: tuple[Scenario, ...]
    spreads: Mapping[str, Spread]
    members: tuple[Member, ...]
    observations: str = ""
    file: Mapping[str, str] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """Return the group for `config.json`."""
        found = {
            "name": self.name,
            "scenarios": [scenario.portable().to_dict() for scenario in self.scenarios],
            "parameters": {name: spread.model_dump() for name, spread in self.spreads.items()},
            "members": [[member.name, member.seed, member.place] for member in self.members],
        }
        if self.observations:
            files = (member.file for member in self.members if member.file is not None)
            whole = (path / JOURNAL_NAME if path.is_dir() else path for path in files)
            found["recordings"] = [hash_file(path) for path in whole]
        return found


@dataclass(frozen=True)
class Fleet:
    """What is to be flown."""

    head: FleetSection
    groups: tuple[Group, ...]

    @property
    def size(self) -> int:
        """Number of twins."""
        return sum(len(group.members) for group in self.groups)

    def record(self) -> dict[str, Any]:
        """Return the fleet for `config.json`."""
        return self.head.model_dump() | {"groups": [group.record() for group in self.groups]}


def load_fleet(path: Path | str, seed: int | None = None) -> Fleet:
    """Read a fleet file; relative paths start at its folder.

    Parameters
    ----------
    path : Path or str
        TOML.
    seed : int, optional
        In the place of that of the file.

    Raises
    ------
    FleetError
        The file cannot be read or breaks the schema, or a scenario of it does; all groups that are wrong are
        in one list.
    """
    path = Path(path)
    table = read_toml(path, FleetError, what="fleet")
    table = with_present_names(table, PRESENT_NAMES, str(path), FleetError)
    found = validate(FleetFile, table, str(path), FleetError, what="a fleet")
    head = found.fleet if seed is None else found.fleet.model_copy(update={"seed": seed})
    groups, wrong = [], []
    for section in found.group:
        try:
            groups.append(_group(section, path.resolve().parent, head.seed))
            rationed = groups[-1].scenarios[0].planner.inspections_per_step is not None
            if rationed and (len(groups[-1].members) > head.shard or len(groups[-1].scenarios) > 1):
                raise FleetError(said("fleet.shared", members=len(groups[-1].members)))
        except TwinMasterError as error:
            wrong.append(f"group {section.name}: {error}")
    if wrong:
        raise FleetError("\n".join([f"{path}: nothing was begun, for", *wrong]))
    return Fleet(head, tuple(groups))


def ensemble(scenario: str, seeds: range, overrides: Overrides | None = None, *, shard: int = SHARD) -> Fleet:
    """Return one asset under many seeds, as a fleet of one group.

    The calibration is drawn once, under the seed of the scenario or of the overrides, for all of them.
    """
    resolved = resolve_scenario(load_scenario(scenario), overrides)
    members = tuple(Member(row, f"seed-{seed}", seed, {}) for row, seed in enumerate(seeds))
    group = Group(resolved.mission.name, (resolved,), {}, members)
    mission = resolved.mission
    head = FleetSection(name=mission.name, title=mission.title, seed=mission.seed, shard=shard)
    return Fleet(head, (group,))


def seed_range(text: str) -> range:
    """Return the seeds that ``FIRST:END`` stands for, END left out.

    Raises
    ------
    FleetError
        It is none.
    """
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise FleetError(f"--seeds is FIRST:END, as in 0:1000 for the seeds 0 to 999, and `{text}` came.")
    found = range(int(first), int(end))
    if len(found) > LARGEST:
        raise FleetError(f"--seeds has {len(found)} seeds, and a fleet {LARGEST} twins at most: fly several.")
    return found


def _group(section: GroupSection, folder: Path, seed: int) -> Group:
    local = folder / section.scenario
    loaded = load_scenario(local if local.is_file() else section.scenario)
    given = {key: getattr(section, key) for key in ("fmu", "binding", "calibration", "learnt")}
    files: dict[str, Any] = {key: folder / name for key, name in given.items() if name is not None}
    common = replace(Overrides(seed=seed, in_process=section.in_process, learnt_group=section.name), **files)
    observed = section.observations or ""
    where = str(folder / observed) if observed and not is_broker(observed) else observed
    key, pattern = ("fmu", section.fmus) if section.fmus else ("calibration", section.calibrations)
    found = sorted(folder.glob(pattern)) if pattern else []
    if pattern and not found:
        raise FleetError(f'no file fits `{key}s = "{pattern}"` in {folder}.')
    scenarios, wrong = [], []
    own: list[dict[str, Any]] = [{key: file} for file in found] or [{}]
    for files in own:
        try:
            resolved = resolve_scenario(loaded, replace(common, **files))
        except TwinMasterError as error:
            if not found:
                raise
            wrong.append(f"{files[key].name}: {error}")
        else:
            scenarios.append(_of_group(section, resolved))
    if wrong:
        raise FleetError("\n".join(["assets that cannot fly:", *wrong]))
    members = [_member(section, seed, row, file) for row, file in enumerate(found)]
    members += [_member(section, seed, row) for row in range(section.count or 0)]
    if where and not is_broker(where):
        paths = enumerate(recordings(where))
        members = [Member(row, asset_name(path), seed, {}, file=path) for row, path in paths]
    spreads = {} if where else section.parameters
    return Group(section.name, tuple(scenarios), spreads, tuple(members), where, loaded.file)


def recordings(pattern: str) -> list[Path]:
    """Return the files of real assets that fit a pattern, in their order."""
    found = sorted(Path(pattern).parent.glob(Path(pattern).name))
    return [path for path in found if not path.name.startswith(".")]


def asset_name(path: Path) -> str:
    """Return the name of the asset of a recording."""
    return path.name if path.is_dir() else path.stem


def _of_group(section: GroupSection, scenario: Scenario) -> Scenario:
    """Return a scenario with what the group says otherwise."""
    table = scenario.to_dict()
    if section.steps is not None:
        table["mission"]["steps"] = section.steps
    if section.inspections_per_step is not None:
        table["planner"]["inspections_per_step"] = section.inspections_per_step
    if section.true_probability:
        table["truth"]["probability"] = section.true_probability
    return parse_scenario(table, f"group {section.name}")


def _member(section: GroupSection, seed: int, row: int, file: Path | None = None) -> Member:
    # Keyed by group and number: a twin meets the same fate whatever else flies.
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(section.name.encode()), row))
    own = int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))
    normal = generator(own, "population").standard_normal(len(section.parameters))
    drawn = {
        key: spread.mean + spread.standard_deviation * float(value)
        for (key, spread), value in zip(sorted(section.parameters.items()), normal, strict=True)
    }
    name, place = (f"{section.name}-{row}", 0) if file is None else (file.stem, row)
    return Member(row, name, own, drawn, place, file)
