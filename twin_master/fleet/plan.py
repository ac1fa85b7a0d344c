"""The plan of a fleet: its file, its groups, and the seed of every twin."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from reporting.files import hash_file, hash_record
from reporting.formats.former_names import with_present_names
from reporting.formats.toml_file import Check, read_toml, validate
from reporting.json_file import JsonObject
from twin_master.assets.resolution import Overrides, OverridesOrMapping, resolve_scenario
from twin_master.errors import FleetError, TwinMasterError
from twin_master.feeds.broker_address import is_broker
from twin_master.fleet.members import (
    CountedMembers,
    ListedMembers,
    Member,
    Members,
    SeededMembers,
    Spread,
    seeded_member,
)
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.parts import NO_PARTS, TwinParts
from twin_master.mission.planning import encode_policy
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import (
    Count,
    Flag,
    Name,
    Probability,
    Section,
    Seed,
    repeated_name_check,
)

SHARD = 256
"""Twins that are flown in one piece, unless the fleet file says otherwise."""
LARGEST = 1_000_000
"""Largest number of twins of a group, or of an ensemble."""


Text = Annotated[str, Field(min_length=1)]


PRESENT_NAMES = {"group.inspections_a_turn": "inspections_per_step"}
"""The present name of each key of a fleet file, by its former location."""


class GroupSection(Section):
    """Assets that share a scenario, as a fleet file describes them."""

    name: Name
    """Name of the group."""
    scenario: Text
    """A scenario file beside the fleet file, or the name of a shipped scenario."""
    count: Annotated[int, Field(strict=True, ge=1, le=LARGEST)] | None = None
    """Number of assets."""
    fmus: Text | None = None
    """A pattern of files: one asset for each FMU."""
    calibrations: Text | None = None
    """A pattern of files: one asset for each calibration."""
    observations: Text | None = None
    """A pattern of recordings, or `mqtt://HOST/TOPIC/+`: one real asset for each file or topic."""
    fmu: str | None = None
    """An FMU that all assets fly in the place of the scenario's."""
    binding: str | None = None
    """A binding that all assets use in the place of the scenario's."""
    calibration: str | None = None
    """A calibration file that all twins use in the place of the scenario's."""
    in_process: Flag = False
    """Whether FMUs run in the process that flies the shard, without a worker of their own. This is
    faster, but a crash ends that process."""
    learnt: str | None = None
    """A file of `uav-twin fleet learn`."""
    steps: Count | None = None
    """Number of steps of each mission, in the place of the scenario's."""
    parameters: dict[str, Spread] = Field(default_factory=dict)
    """Distributions of true parameters of the assets, by the names of the binding."""
    inspections_per_step: Count | None = None
    """The value of `planner.inspections_per_step` in this group, which then flies in one shard."""
    true_probability: dict[str, Probability | dict[str, Probability]] = Field(default_factory=dict)
    """The value of `truth.probability` in this group [1]."""

    def checks(self) -> Iterator[Check]:
        """Yield the fault that the group has no kind of members, or several."""
        kinds = (self.count, self.fmus, self.calibrations, self.observations)
        given_kinds = [kind for kind in kinds if kind is not None]
        yield (
            len(given_kinds) != 1,
            f"the group `{self.name}` needs one of `count`, `fmus`, `calibrations` and "
            "`observations`, which say how many assets it has",
        )

    @property
    def pattern_key(self) -> str:
        """The field of `Overrides` that differs by asset: "fmu", "calibration" or empty."""
        if self.fmus:
            return "fmu"
        return "calibration" if self.calibrations else ""


class FleetSection(Section):
    """The fleet as a whole, as a fleet file describes it."""

    name: Name
    """Name of the fleet."""
    title: str = ""
    """Title in the report; by default the name."""
    seed: Seed = 0
    """Seed from which the seed of each mission follows."""
    shard: Annotated[int, Field(strict=True, ge=1, le=4096)] = SHARD
    """Number of twins that are flown in one piece."""


class FleetFile(Section):
    """A fleet file."""

    format: Literal[1]
    """Version of the format."""
    fleet: FleetSection
    """The fleet as a whole."""
    group: Annotated[tuple[GroupSection, ...], Field(min_length=1)]
    """The groups of assets."""

    def checks(self) -> Iterator[Check]:
        """Yield the fault that two groups have one name."""
        yield repeated_name_check("group", [group.name for group in self.group])


@dataclass(frozen=True)
class Group:
    """Assets that share a scenario, or that each fly it with their own FMU or calibration.

    Attributes
    ----------
    scenarios : tuple of Scenario
        The resolved scenarios: one for all assets, or one for each.
    parameter_spreads : dict of str to Spread
        The distributions of the parameters that differ from asset to asset.
    members : Members
        The assets; empty if they become known by their messages to a broker.
    observations : str
        The source of real assets' observations, a pattern of files or an address; empty for
        simulated assets.
    scenario_file : dict of str to str
        Name and hash of the scenario file.
    """

    name: str
    scenarios: tuple[Scenario, ...]
    parameter_spreads: Mapping[str, Spread]
    members: Members
    observations: str = ""
    scenario_file: Mapping[str, str] = field(default_factory=dict)

    def record(self) -> JsonObject:
        """Return the record of the group for `config.json`."""
        record: JsonObject = {
            "name": self.name,
            "scenarios": [scenario.portable().to_dict() for scenario in self.scenarios],
            "parameters": {
                name: spread.model_dump() for name, spread in self.parameter_spreads.items()
            },
            "members": self.members.record(),
        }
        if self.observations:
            # A recording is a file, or the folder of a run with its journal.
            recordings = [member.file for member in self.members if member.file is not None]
            record["recordings"] = [
                hash_file(path / JOURNAL_NAME if path.is_dir() else path) for path in recordings
            ]
        return record


@dataclass(frozen=True)
class Fleet:
    """The plan of a fleet.

    Attributes
    ----------
    head : FleetSection
        Name, title, seed and size of shards.
    parts : TwinParts
        The user's parts of all twins, which replace those of the scenarios.
    store : str
        The address of the store, such as "s3://bucket/winter.zarr"; empty for the folder of the
        fleet.
    """

    head: FleetSection
    groups: tuple[Group, ...]
    parts: TwinParts = NO_PARTS
    store: str = ""

    @property
    def size(self) -> int:
        """The number of twins."""
        return sum(len(group.members) for group in self.groups)

    def record(self) -> JsonObject:
        """Return the record of the fleet for `config.json`."""
        record = self.head.model_dump() | {"groups": [group.record() for group in self.groups]}
        parts = self.parts.record()
        if self.parts.policy is not None:
            # The policy for the states and controls of each group.
            hashes = []
            for group in self.groups:
                model = build_graphical_model(group.scenarios[0])
                policy = self.parts.policy_for(model)
                assert policy is not None
                hashes.append(sha256(encode_policy(policy, model)).hexdigest())
            parts["policy"] = hash_record(hashes)
        if parts:
            record["parts"] = parts
        if self.store:
            record["store"] = self.store
        return record

    def with_parts(self, parts: TwinParts) -> "Fleet":
        """Return the fleet with the user's parts.

        Raises
        ------
        MissionInputError
            If the name of a part is not that of an object.
        """
        groups = []
        other_parts = parts
        for group in self.groups:
            scenarios = []
            for scenario in group.scenarios:
                changed_scenario, other_parts = parts.in_scenario(scenario)
                scenarios.append(changed_scenario)
            groups.append(replace(group, scenarios=tuple(scenarios)))
        other_parts.with_objects()  # refuses a wrong name before anything is written
        return replace(self, groups=tuple(groups), parts=other_parts)

    def with_store(self, address: str) -> "Fleet":
        """Return the fleet with a store at an address, or in its folder if that is empty."""
        return replace(self, store=address)


def load_fleet(path: Path | str, seed: int | None = None) -> Fleet:
    """Read the plan of a fleet from its TOML file.

    Relative paths in the file are relative to the folder of the file.

    Parameters
    ----------
    path : Path or str
        The path of the TOML file.
    seed : int, optional
        A seed that replaces the one of the file.

    Raises
    ------
    FleetError
        If the file cannot be read or does not fit the schema `FleetFile`, or if groups cannot be
        flown: the message of the error lists all such groups and the reasons.
    """
    path = Path(path)
    table = read_toml(path, FleetError, what="fleet")
    # Files of earlier versions may have former names of keys.
    table = with_present_names(table, PRESENT_NAMES, str(path), FleetError)
    fleet_file = validate(FleetFile, table, str(path), FleetError, what="a fleet")
    fleet_section = fleet_file.fleet
    if seed is not None:
        fleet_section = fleet_section.model_copy(update={"seed": seed})
    groups = []
    faults = []
    for group_section in fleet_file.group:
        try:
            group = _group(group_section, path.resolve().parent, fleet_section.seed)
            _check_shared_inspections(group, fleet_section)
            groups.append(group)
        except TwinMasterError as error:
            faults.append(f"group {group_section.name}: {error}")
    if faults:
        raise FleetError("\n".join([f"{path}: nothing was begun, for", *faults]))
    return Fleet(fleet_section, tuple(groups))


def _check_shared_inspections(group: Group, head: FleetSection) -> None:
    """Raise an error unless the assets of a group that share inspections fly in one shard."""
    shares_inspections = group.scenarios[0].planner.inspections_per_step is not None
    flies_in_one_shard = len(group.members) <= head.shard and len(group.scenarios) == 1
    if shares_inspections and not flies_in_one_shard:
        raise FleetError(
            "`inspections_per_step` is shared by assets of one scenario in one shard: "
            f"let `shard` be {len(group.members)} or more, and give no pattern of files"
        )


def ensemble(
    scenario: LoadedScenario | str | Path,
    seeds: range,
    overrides: OverridesOrMapping | None = None,
    *,
    shard: int = SHARD,
) -> Fleet:
    """Return a fleet of one group in which one scenario is flown once for each of many seeds.

    The draws of the calibration are the same for all of them; their seed is that of the scenario or
    of the overrides. `fly_fleet` flies the fleet.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    seeds : range
        The seeds.
    overrides : Overrides or mapping, optional
        Values that replace those of the scenario.
    shard : int
        The number of twins that fly in one shard.
    """
    resolved_scenario = resolve_scenario(load_scenario(scenario), overrides)
    mission = resolved_scenario.mission
    group = Group(mission.name, (resolved_scenario,), {}, SeededMembers(seeds))
    head = FleetSection(name=mission.name, title=mission.title, seed=mission.seed, shard=shard)
    return Fleet(head, (group,))


def seed_range(text: str) -> range:
    """Return the range of seeds in a text ``FIRST:END``, without END itself.

    Raises
    ------
    FleetError
        If the text is not a range of seeds, or if the range has more than `LARGEST` seeds.
    """
    first, colon, end = text.partition(":")
    if not (colon and first.isdecimal() and end.isdecimal() and int(first) < int(end)):
        raise FleetError(
            f"--seeds is FIRST:END, as in 0:1000 for the seeds 0 to 999, but `{text}` was given."
        )
    seeds = range(int(first), int(end))
    if len(seeds) > LARGEST:
        raise FleetError(
            f"--seeds has {len(seeds)} seeds, and a fleet {LARGEST} twins at most: fly several."
        )
    return seeds


def _group(section: GroupSection, folder: Path, seed: int) -> Group:
    """Return the group that a section of a fleet file describes.

    `folder` is that of the file, and `seed` that of the fleet.
    """
    # The scenario is a file beside the fleet file, or the name of a shipped scenario.
    local_file = folder / section.scenario
    loaded_scenario = load_scenario(local_file if local_file.is_file() else section.scenario)
    observations = section.observations or ""
    if observations and not is_broker(observations):
        observations = str(folder / observations)
    files = _files_of_assets(section, folder)
    return Group(
        name=section.name,
        scenarios=_scenarios(section, folder, seed, loaded_scenario, files),
        parameter_spreads={} if observations else section.parameters,
        members=_members(section, seed, observations, files),
        observations=observations,
        scenario_file=loaded_scenario.file,
    )


def _files_of_assets(section: GroupSection, folder: Path) -> list[Path]:
    """Return the FMUs or calibrations of a group's assets; empty without a pattern.

    An error is raised if no file matches the pattern.
    """
    pattern = section.fmus or section.calibrations
    if not pattern:
        return []
    files = sorted(folder.glob(pattern))
    if not files:
        raise FleetError(f'no file matches `{section.pattern_key}s = "{pattern}"` in {folder}.')
    return files


def _scenarios(
    section: GroupSection,
    folder: Path,
    seed: int,
    loaded_scenario: LoadedScenario,
    files: list[Path],
) -> tuple[Scenario, ...]:
    """Return the scenarios of a group: one for each FMU or calibration file, or a single one.

    The FMU or the calibration of the scenario is replaced by each of `files`. An error lists all
    files with which the scenario cannot be resolved.
    """
    common_overrides = _common_overrides(section, folder, seed)
    if not files:
        return (
            _with_values_of_group(section, resolve_scenario(loaded_scenario, common_overrides)),
        )
    scenarios = []
    faults = []
    for file in files:
        # the file replaces the FMU or the calibration of the scenario
        file_override: dict[str, Any] = {section.pattern_key: file}
        try:
            resolved_scenario = resolve_scenario(
                loaded_scenario, replace(common_overrides, **file_override)
            )
        except TwinMasterError as error:
            faults.append(f"{file.name}: {error}")
        else:
            scenarios.append(_with_values_of_group(section, resolved_scenario))
    if faults:
        raise FleetError("\n".join(["no scenario can be made with these files:", *faults]))
    return tuple(scenarios)


def _common_overrides(section: GroupSection, folder: Path, seed: int) -> Overrides:
    """Return the overrides of the scenario for all assets of a group."""
    overrides = Overrides(seed=seed, in_process=section.in_process, learnt_group=section.name)
    files: dict[str, Any] = {}
    for key in ("fmu", "binding", "calibration", "learnt"):
        name = getattr(section, key)
        if name is not None:
            files[key] = folder / name
    return replace(overrides, **files)


def _with_values_of_group(section: GroupSection, scenario: Scenario) -> Scenario:
    """Return a scenario with the values that the group's section sets."""
    table = scenario.to_dict()
    if section.steps is not None:
        table["mission"]["steps"] = section.steps
    if section.inspections_per_step is not None:
        table["planner"]["inspections_per_step"] = section.inspections_per_step
    if section.true_probability:
        table["truth"]["probability"] = section.true_probability
    return parse_scenario(table, f"group {section.name}")


def _members(section: GroupSection, seed: int, observations: str, files: list[Path]) -> Members:
    """Return the assets of a group.

    `observations` is the pattern of recordings or the address of a broker for real assets, and
    empty for simulated ones. `files` has the FMU or calibration of each asset; it is empty if the
    section gives the number of assets.
    """
    if observations:
        if is_broker(observations):
            return ListedMembers(())  # an asset of a broker joins the group with its first message
        return ListedMembers(
            tuple(
                Member(row, asset_name(path), seed, {}, file=path)
                for row, path in enumerate(recording_files(observations))
            )
        )
    if files:
        members = []
        for row, file in enumerate(files):  # each FMU or calibration makes a scenario of its own
            member = seeded_member(section.name, seed, row, section.parameters, file.stem)
            members.append(replace(member, scenario_number=row, file=file))
        return ListedMembers(tuple(members))
    return CountedMembers(section.name, seed, section.count or 0, section.parameters)


def recording_files(pattern: str) -> list[Path]:
    """Return the recordings of real assets that match a pattern, sorted; skip hidden files."""
    paths = sorted(Path(pattern).parent.glob(Path(pattern).name))
    return [path for path in paths if not path.name.startswith(".")]


def asset_name(path: Path) -> str:
    """Return the name of the asset of a recording, which is a file or a run folder."""
    return path.name if path.is_dir() else path.stem
