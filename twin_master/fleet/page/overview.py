"""What the page of a fleet shows of a flown group, collected block by block."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonRecord
from twin_master.errors import TwinMasterError
from twin_master.fleet.outcomes import Fraction
from twin_master.fleet.page.asset_states import AssetStates, states_of_flown_assets
from twin_master.fleet.reading import ControlForecast, believed_means
from twin_master.fleet.storage.store import ENDED, FAILED, WITHIN, flown_rows
from twin_master.fleet.storage.store_layout import (
    NOTICE_KINDS,
    TWIN_AXIS,
    row_blocks,
    stored_values,
)

if TYPE_CHECKING:
    import xarray as xr

DRAWN_ASSETS = 10_000
"""Largest number of assets of a group that figures show one by one."""


@dataclass
class DrawnAssets:
    """The assets that are drawn in figures.

    Attributes
    ----------
    distance : int
        Every so many-th asset is drawn, from the first one on.
    last_mean : list of (B, F) array
        The mean states after the last steps, block by block, in SI units; NaN if no state of the
        model explains the observations.
    mean, state : list of (B, T, F) array
        The believed mean states and the true states in all steps.
    failed_count : int
        The number of drawn assets that failed in flight.
    """

    distance: int
    last_mean: list[Float] = field(default_factory=list)
    mean: list[Float] = field(default_factory=list)
    state: list[Float] = field(default_factory=list)
    failed_count: int = 0

    def add(self, group: "xr.DataTree", rows: slice, states: AssetStates) -> None:
        """Add the flown assets of a block that are to be drawn."""
        status = stored_values(group, "status", rows)
        is_drawn = (np.arange(rows.start, rows.stop) % self.distance) == 0
        flown = flown_rows(status)
        drawn = flown[is_drawn[flown]]
        self.last_mean.append(states.mean[is_drawn[flown]])
        self.mean.append(believed_means(group, rows)[drawn])
        self.state.append(stored_values(group, "truth/state", rows)[drawn])
        self.failed_count += int(np.sum(status[is_drawn] == FAILED))


@dataclass
class GroupOverview:
    """Numbers of assets of a flown group, those that need attention, and those that are drawn.

    Attributes
    ----------
    record : dict
        The record of the group in `config.json`.
    twin_count, flown_count, failed_count, ended_count : int
        The number of assets; of those that have flown; that failed in flight; and whose simulation
        ended early.
    alarmed_count : int
        The number of assets that raised an alarm.
    first_alarm : int or None
        The first step of an alarm.
    prompt_fallbacks : Fraction
        Fallbacks within `WITHIN` steps, of those that the damage called for.
    urgent : AssetStates
        The assets that need attention first, in order.
    most_damaged : AssetStates or None
        The most severely damaged asset; None if no asset has an estimated state.
    drawn : DrawnAssets
        The assets in figures.
    leaving_unknown_because : str
        Why it is not known which assets will soon change their control; empty if it is.
    """

    record: JsonRecord
    twin_count: int
    urgent: AssetStates
    drawn: DrawnAssets
    flown_count: int = 0
    failed_count: int = 0
    ended_count: int = 0
    alarmed_count: int = 0
    first_alarm: int | None = None
    prompt_fallbacks: Fraction = field(default_factory=Fraction)
    most_damaged: AssetStates | None = None
    leaving_unknown_because: str = ""

    def add_counts(self, group: "xr.DataTree", rows: slice) -> None:
        """Count the assets of a block by how their flights ended, their alarms and fallbacks."""
        status = stored_values(group, "status", rows)
        self.flown_count += len(flown_rows(status))
        self.failed_count += int(np.sum(status == FAILED))
        self.ended_count += int(np.sum(status == ENDED))
        first_steps = stored_values(group, "notice/first_step", rows)
        alarm_steps = first_steps[:, NOTICE_KINDS.index("alarm")]
        alarm_steps = alarm_steps[alarm_steps >= 0]  # -1: the twin gave no alarm
        self.alarmed_count += len(alarm_steps)
        if len(alarm_steps):
            earlier_alarms = [] if self.first_alarm is None else [self.first_alarm]
            self.first_alarm = min([int(alarm_steps.min()), *earlier_alarms])
        delay = stored_values(group, "delay", rows)
        delays_when_called_for = delay[~np.isnan(delay)]  # NaN: the damage called for no fallback
        self.prompt_fallbacks.add(delays_when_called_for <= WITHIN)

    def add_states(self, states: AssetStates, most_assets: int) -> None:
        """Keep the assets of a block that need attention first, and the most damaged one."""
        candidates = self.urgent.followed_by(states)
        self.urgent = candidates.of_assets(candidates.attention_order[:most_assets])
        number = states.most_damaged
        if number is None:
            return
        block_worst = states.of_assets(np.array([number]))
        if self.most_damaged is None or block_worst.severity > self.most_damaged.severity:
            self.most_damaged = block_worst


def overview_of_group(
    folder: Path, record: JsonRecord, group: "xr.DataTree", most_assets: int
) -> GroupOverview:
    """Return what the page of a fleet shows of a group.

    Parameters
    ----------
    record : mapping
        The record of the group in `config.json`.
    most_assets : int
        The largest number of assets that need attention.
    """
    twin_count = group.sizes[TWIN_AXIS]
    no_rows = slice(0, 0)
    overview = GroupOverview(
        record=record,
        twin_count=twin_count,
        urgent=states_of_flown_assets(record, group, no_rows),
        drawn=DrawnAssets(distance=-(-twin_count // DRAWN_ASSETS)),
    )
    forecast = ControlForecast(folder, record)
    for rows in row_blocks(group):
        overview.add_counts(group, rows)
        leaving = None
        if not overview.leaving_unknown_because:
            try:
                leaving = forecast.probabilities(group, rows)
            except TwinMasterError as error:
                overview.leaving_unknown_because = str(error)
        states = states_of_flown_assets(record, group, rows, leaving)
        overview.add_states(states, most_assets)
        overview.drawn.add(group, rows, states)
    if overview.leaving_unknown_because:
        urgent = overview.urgent
        overview.urgent = replace(urgent, leaving_probability=np.full(len(urgent.names), np.nan))
    return overview
