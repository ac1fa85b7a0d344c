"""One watched asset of a fleet, and the file with the last decisions of all assets."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from reporting.formats.former_names import with_present_names
from reporting.json_file import JsonObject, JsonRecord, read_json
from twin_master.errors import FleetError
from twin_master.feeds.feed import Feed
from twin_master.fleet.reading import probability_of_leaving, severity
from twin_master.watch.folder import Watch
from twin_master.watch.result import notices_since

STATE_NAME = "watched.json"
"""The file in the folder of a watched fleet with the state of its assets, for its view."""
_KEPT_OF_DECISION = ("step", "control", "next_control", "probability", "health")
"""The entries of an asset's last decision that are kept."""


def read_watched_state(folder: Path) -> JsonObject:
    """Read the last decisions and alarms of the assets of a watched fleet.

    Returns
    -------
    dict
        `assets` and `failures`, both empty if nothing was watched. `failures` has the reason for
        each asset that is not watched. `assets` has for each watched asset

        - `last`: its last decision; None before the first one;
        - `alarms` and `refused`: the numbers of alarms and of refused messages;
        - `leaving`: the probability that its control changes within the scenario's
          `prediction_steps`, and `severity`, that of its damage; both are None if no state of the
          model explains the observations.

    Raises
    ------
    FleetError
        If the file is damaged.
    """
    path = folder / STATE_NAME
    if not path.is_file():
        return {"assets": {}, "failures": {}}
    state = dict(read_json(path, FleetError))
    return with_present_names(state, {"assets.*.last.turn": "step"}, str(path), FleetError)


def watched_fleet_counts(state: JsonRecord) -> dict[str, int]:
    """Return the numbers of a watched fleet by their titles: assets, steps, alarms and others.

    Parameters
    ----------
    state : mapping
        The records of all assets, from `read_watched_state`.
    """
    asset_records = state["assets"].values()
    steps = 0
    for asset_record in asset_records:
        last_decision = asset_record["last"]
        if last_decision is not None:  # else the asset is before its first step
            steps += last_decision["step"] + 1  # steps are counted from 0
    return {
        "assets": len(asset_records),
        "steps": steps,
        "alarms": sum(asset_record["alarms"] for asset_record in asset_records),
        "messages refused": sum(asset_record["refused"] for asset_record in asset_records),
        "not watched": len(state["failures"]),
    }


class WatchedAsset:
    """A watched asset.

    Parameters
    ----------
    name : str
        The names of group and asset, GROUP/NAME, which also is the path of its folder.
    previous_record : mapping or None
        The record of the asset from the last time; None if it is new.
    keeps_file_open : bool
        Whether the file of its observations, if any, stays open between two polls.

    Attributes
    ----------
    decision : dict or None
        The last decision.
    alarms : set of str
        The sentences of the alarms since this process began or resumed the watch.
    first_new_step : int
        The first step whose decision no earlier process has recorded.
    close : callable
        Releases its folder.
    """

    close: Callable[[], None]

    def __init__(
        self,
        name: str,
        watch: Watch,
        feed: Feed,
        previous_record: JsonRecord | None,
        *,
        keeps_file_open: bool = True,
    ) -> None:
        self.name = name
        self.keeps_file_open = keeps_file_open
        self.watch = watch
        self.feed = feed
        self._knowledge = watch.models[-1].knowledge
        self.decision = watch.last_decision()
        self.first_new_step = 0
        self._previous_alarms = 0
        if previous_record is not None and previous_record["last"] is not None:
            self.first_new_step = previous_record["last"]["step"] + 1
            self._previous_alarms = previous_record["alarms"]
        self.alarms: set[str] = set()
        if self.decision is not None:
            for _step, notice in notices_since(watch, self.first_new_step):
                if notice.kind == "alarm":
                    self.alarms.add(notice.sentence)
            # A resumed watch has no filtered belief yet. The smoothed belief of its last step alone
            # is the filtered one.
            last_carried = watch.twin.carried[-1:]
            watch.filtered = watch.twin.estimator.smoothed(last_carried)[0]

    def record(self) -> JsonObject:
        """Return the last decision and the alarms of the asset; see `read_watched_state`."""
        record: JsonObject = {
            "last": None,
            "alarms": self._previous_alarms + len(self.alarms),
            "refused": self.watch.intake.counts.rejected,
            "leaving": None,
            "severity": None,
        }
        if self.decision is None or self.watch.filtered is None:
            return record
        record["last"] = {key: self.decision[key] for key in _KEPT_OF_DECISION}
        if self.decision.get("state_believed", True):
            scenario = self.watch.scenario
            control = scenario.control_names.index(self.decision["control"])
            belief = self.watch.filtered
            probability = probability_of_leaving(self._knowledge, belief, control)
            mean = np.array([state["mean"] for state in self.decision["health"].values()])
            record["leaving"] = float(probability)
            record["severity"] = float(severity(scenario, mean))
        return record
