"""How a watched asset stands, and all of a fleet: what its view reads."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reporting.json_file import read_json
from reporting.section import Section, checked
from twin_master.errors import FleetError
from twin_master.fleet.reading import attention
from twin_master.watch.folder import Watch

STATE_NAME = "watched.json"
"""In the folder of a fleet that is watched: its assets as they stood a moment ago, for its view."""


class Moments(Section):
    """What is believed of a factor of the state."""

    mean: float
    standard_deviation: float
    unit: str


class TurnRecord(Section):
    """What a decision said."""

    turn: int
    control: str
    next_control: str
    probability: float | None
    health: dict[str, Moments]


class AssetRecord(Section):
    """How an asset stands: its last decision, None before the first, and what was told and refused.

    `leaving` is the probability that its control is left within the steps that are predicted.
    """

    last: TurnRecord | None
    alarms: int
    refused: int
    leaving: float | None = None


class FleetRecord(Section):
    """How a fleet stands."""

    assets: dict[str, AssetRecord]
    failures: dict[str, str]

    @classmethod
    def read(cls, folder: Path) -> "FleetRecord":
        """Return the record in a folder, an empty one where there is none; raises `FleetError`."""
        path = folder / STATE_NAME
        if not path.is_file():
            return cls(assets={}, failures={})
        return checked(cls, read_json(path, FleetError), str(path), FleetError, what="a watched fleet")


class WatchedAsset:
    """An asset under watch.

    Attributes
    ----------
    name : str
        Of its group and its own: GROUP/NAME, which is its folder, too.
    watch : Watch
    keep : Keeper
        Holds twin and intake.
    tell : callable
        Told each decision.
    close : callable
        Gives its folder free.
    decision : dict or None
        The last one.
    alarms : set of str
        The alarms that the operator was told since it was taken up, each sentence once.
    alarms_before : int
        How many there were before.
    """

    def __init__(self, name: str, watch: Watch, before: AssetRecord | None = None) -> None:
        self.name, self.watch, self.keep = name, watch, watch.keep
        self.tell: Callable[[Mapping[str, Any]], None] = lambda _decision: None
        self.close: Callable[[], None] = lambda: None
        self._knowledge = watch.models[-1].knowledge
        self.decision = watch.last_decision()
        first = before.last.turn + 1 if before is not None and before.last is not None else 0
        self.alarms_before = before.alarms if before is not None and first else 0
        told = [notice for _, notice in watch.told(first)] if self.decision else []
        self.alarms = {notice.sentence for notice in told if notice.kind == "alarm"}
        if self.decision is not None:
            twin = self.keep.twin
            self.keep.filtered = twin.estimator.smoothed(twin.carried[-1:])[0]

    @property
    def alarm_count(self) -> int:
        """How many alarms the operator was told."""
        return self.alarms_before + len(self.alarms)

    def record(self) -> AssetRecord:
        """Return how it stands, for the view."""
        last = leaving = None
        if self.decision is not None and self.keep.filtered is not None:
            last = TurnRecord.model_validate({key: self.decision.get(key) for key in TurnRecord.model_fields})
            control = self.watch.scenario.control_names.index(last.control)
            leaving = float(attention(self._knowledge, self.keep.filtered, control))
        refused = self.keep.intake.counts.rejected
        return AssetRecord(last=last, alarms=self.alarm_count, refused=refused, leaving=leaving)
