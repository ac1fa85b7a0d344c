"""The assets of a group with their twins: computed from their rows, or listed by file."""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from reporting.arrays import Index
from reporting.formats.toml_file import NotNegative, Number
from reporting.json_file import JsonObject, JsonRecord
from twin_master.feeds.message import FeedItem
from twin_master.scenario.section import Section
from twin_master.seeds import generator


class Spread(Section):
    """The normal distribution of a true parameter over the assets of a group."""

    mean: Number
    """Mean of the parameter [unit of the binding]."""
    standard_deviation: NotNegative = 0.0
    """Standard deviation of the parameter over the group [unit of the binding]."""


@dataclass(frozen=True)
class Member:
    """An asset of a group with its twin.

    Attributes
    ----------
    row : int
        Its index in the group, and its row in the store.
    seed : int
        The seed of its mission; ``uav-twin run --seed`` flies the same mission.
    parameters : dict of str to float
        The true parameters in SI units that differ between the assets.
    scenario_number : int
        The index of its scenario in the group.
    file : Path or None
        The asset's own file: its FMU, its calibration, or its recording.
    recording : tuple of FeedItem or None
        The observations of a real asset, as they are sent to a worker.
    """

    row: int
    name: str
    seed: int
    parameters: Mapping[str, float]
    scenario_number: int = 0
    file: Path | None = None
    recording: tuple[FeedItem, ...] | None = None


class Members(Sequence[Member], ABC):
    """The assets of a group by row; a slice gives a tuple."""

    @abstractmethod
    def member(self, row: int) -> Member:
        """Return the asset of a row, which is between 0 and the number of assets."""

    @abstractmethod
    def name(self, row: int) -> str:
        """Return the name of the asset of a row."""

    @abstractmethod
    def record(self) -> object:
        """Return the record of the assets in `config.json`; `RecordedMembers` reads it."""

    @overload
    def __getitem__(self, rows: int) -> Member: ...

    @overload
    def __getitem__(self, rows: slice) -> tuple[Member, ...]: ...

    def __getitem__(self, rows: int | slice) -> Member | tuple[Member, ...]:
        """Return the asset of a row, or the assets of several rows."""
        all_rows = range(len(self))
        if isinstance(rows, slice):
            return tuple(self.member(row) for row in all_rows[rows])
        return self.member(all_rows[rows])


@dataclass(frozen=True)
class ListedMembers(Members):
    """Assets with a file each."""

    members: tuple[Member, ...]

    def __len__(self) -> int:
        """Return the number of assets."""
        return len(self.members)

    def member(self, row: int) -> Member:
        """Return the asset of a row."""
        return self.members[row]

    def name(self, row: int) -> str:
        """Return the name of the asset of a row."""
        return self.members[row].name

    def record(self) -> list[list[object]]:
        """Return name, seed and scenario number of each asset."""
        return [[member.name, member.seed, member.scenario_number] for member in self.members]


@dataclass(frozen=True)
class SeededMembers(Members):
    """Equal assets that fly under a range of seeds."""

    seeds: range

    def __len__(self) -> int:
        """Return the number of assets."""
        return len(self.seeds)

    def member(self, row: int) -> Member:
        """Return the asset of a row."""
        return Member(row, self.name(row), self.seeds[row], {})

    def name(self, row: int) -> str:
        """Return the name of the asset of a row."""
        return f"seed-{self.seeds[row]}"

    def record(self) -> JsonObject:
        """Return the range of the seeds: first, end and step."""
        return {"seeds": [self.seeds.start, self.seeds.stop, self.seeds.step]}


@dataclass(frozen=True)
class CountedMembers(Members):
    """A number of assets whose seeds and true parameters are computed from their rows.

    They depend only on the seed of the fleet, the name of the group and the row, so that the
    mission of a twin does not change if other assets or groups are added.

    Attributes
    ----------
    group : str
        The name of the group.
    fleet_seed : int
        The seed of the fleet.
    twin_count : int
        The number of assets.
    spreads : dict of str to Spread
        The normal distributions of the true parameters.
    """

    group: str
    fleet_seed: int
    twin_count: int
    spreads: Mapping[str, Spread]

    def __len__(self) -> int:
        """Return the number of assets."""
        return self.twin_count

    def member(self, row: int) -> Member:
        """Return the asset of a row."""
        return seeded_member(self.group, self.fleet_seed, row, self.spreads, self.name(row))

    def name(self, row: int) -> str:
        """Return the name of the asset of a row."""
        return f"{self.group}-{row}"

    def record(self) -> JsonObject:
        """Return the number of assets and the seed of the fleet."""
        return {"count": self.twin_count, "fleet_seed": self.fleet_seed}


def seeded_member(
    group: str, fleet_seed: int, row: int, spreads: Mapping[str, Spread], name: str
) -> Member:
    """Return an asset with a seed of its own and normally distributed true parameters.

    Parameters
    ----------
    row : int
        The index of the asset in the group.
    spreads : dict of str to Spread
        The distributions of the true parameters.
    """
    key = (zlib.crc32(group.encode()), row)
    sequence = np.random.SeedSequence(fleet_seed, spawn_key=key)
    # 63 of the 64 random bits, so that the seed fits into a signed 64-bit integer of the store.
    member_seed = int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))
    parameters = {}
    if spreads:
        deviates = generator(member_seed, "population").standard_normal(len(spreads))
        for parameter, deviate in zip(sorted(spreads), deviates.tolist(), strict=True):
            spread = spreads[parameter]
            parameters[parameter] = spread.mean + spread.standard_deviation * deviate
    return Member(row, name, member_seed, parameters)


class RecordedMembers:
    """The assets of a flown group, as `config.json` records them.

    Earlier versions recorded a list of all assets.
    """

    def __init__(self, record: JsonRecord) -> None:
        self._content = record["members"]
        self._group: str = record["name"]
        self._seeds: range | None = None
        if not isinstance(self._content, list) and "seeds" in self._content:
            self._seeds = range(*self._content["seeds"])

    def __len__(self) -> int:
        """Return the number of assets."""
        if isinstance(self._content, list):
            return len(self._content)
        return int(self._content["count"]) if self._seeds is None else len(self._seeds)

    def name(self, row: int) -> str:
        """Return the name of the asset of a row."""
        if isinstance(self._content, list):
            name: str = self._content[row][0]
            return name
        return f"{self._group}-{row}" if self._seeds is None else f"seed-{self._seeds[row]}"

    def scenario_numbers(self, rows: Index) -> Index:
        """Return the scenario number (B,) of each row."""
        if not isinstance(self._content, list):
            return np.zeros(len(rows), dtype=np.int64)
        return np.array([self._content[row][2] for row in rows.tolist()], dtype=np.int64)
