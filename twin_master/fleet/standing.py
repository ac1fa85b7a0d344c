"""How a watched asset stands, and all of a fleet: what its view reads."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reporting.json_file import read_json
from twin_master.errors import FleetError
from twin_master.fleet.reading import attention
from twin_master.watch.folder import Watch

STATE_NAME = "watched.json"
"""In the folder of a fleet that is watched: its assets as they stood a moment ago, for its view."""


_OF_A_DECISION = ("turn", "control", "next_control", "probability", "health")
"""What of its last decision is kept of each asset."""


def read_standing(folder: Path) -> dict[str, Any]:
    """Return `assets` and `failures` of a watched fleet, both empty where nothing was watched.

    Of each asset `last` is what its last decision said, None before the first; `alarms` and `refused` are
    numbers; `leaving` is the probability that its control is left within the steps that are predicted.
    """
    path = folder / STATE_NAME
    return dict(read_json(path, FleetError)) if path.is_file() else {"assets": {}, "failures": {}}


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
    first_untold : int
        The first turn that the operator was not told before.
    """

    def __init__(self, name: str, watch: Watch, before: Mapping[str, Any] | None = None) -> None:
        self.name, self.watch, self.keep = name, watch, watch.keep
        self.tell: Callable[[Mapping[str, Any]], None] = lambda _decision: None
        self.close: Callable[[], None] = lambda: None
        self._knowledge = watch.models[-1].knowledge
        self.decision = watch.last_decision()
        known = before if before is not None and before["last"] is not None else None
        self.first_untold = 0 if known is None else known["last"]["turn"] + 1
        self.alarms_before = 0 if known is None else known["alarms"]
        told = [notice for _, notice in watch.told(self.first_untold)] if self.decision else []
        self.alarms = {notice.sentence for notice in told if notice.kind == "alarm"}
        if self.decision is not None:
            twin = self.keep.twin
            self.keep.filtered = twin.estimator.smoothed(twin.carried[-1:])[0]

    @property
    def alarm_count(self) -> int:
        """How many alarms the operator was told."""
        return self.alarms_before + len(self.alarms)

    def record(self) -> dict[str, Any]:
        """Return how it stands, for the view."""
        last = leaving = None
        if self.decision is not None and self.keep.filtered is not None:
            last = {key: self.decision[key] for key in _OF_A_DECISION}
            control = self.watch.scenario.control_names.index(last["control"])
            leaving = float(attention(self._knowledge, self.keep.filtered, control))
        refused = self.keep.intake.counts.rejected
        return {"last": last, "alarms": self.alarm_count, "refused": refused, "leaving": leaving}
