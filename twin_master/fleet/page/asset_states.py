"""State, control and alarms of the assets of a group after their last steps.

They are read from the store of a flown fleet, or from the records of a watched one.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float, Index
from reporting.json_file import JsonObject, JsonRecord
from twin_master.fleet.members import RecordedMembers
from twin_master.fleet.reading import believed_means, last_steps, notice_counts, severity
from twin_master.fleet.storage.store import flown_rows
from twin_master.fleet.storage.store_layout import TWIN_AXIS, stored_values
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class AssetStates:
    """State, control and alarms of B assets of a group after their last steps.

    Attributes
    ----------
    scenario : Scenario
        Its scenario, with F factors of the state.
    step : (B,) array
        The last step of each.
    mean, deviation : (B, F) array
        Mean and standard deviation of the state, in SI units; NaN if no state of the model explains
        the observations.
    alarms : (B,) array
        The number of alarms.
    leaving_probability : (B,) array
        The probability that the control changes within the scenario's `prediction_steps`; NaN if
        unknown.
    """

    group: str
    scenario: Scenario
    names: list[str]
    step: Index
    mean: Float
    deviation: Float
    control: list[str]
    alarms: Index
    leaving_probability: Float

    def of_assets(self, indices: Index) -> "AssetStates":
        """Return the states of some of the assets, in the order of the indices."""
        numbers = indices.tolist()
        return replace(
            self,
            names=[self.names[number] for number in numbers],
            step=self.step[indices],
            mean=self.mean[indices],
            deviation=self.deviation[indices],
            control=[self.control[number] for number in numbers],
            alarms=self.alarms[indices],
            leaving_probability=self.leaving_probability[indices],
        )

    def followed_by(self, others: "AssetStates") -> "AssetStates":
        """Return the states of these assets and of others of the same group."""
        return replace(
            self,
            names=self.names + others.names,
            step=np.concatenate([self.step, others.step]),
            mean=np.concatenate([self.mean, others.mean]),
            deviation=np.concatenate([self.deviation, others.deviation]),
            control=self.control + others.control,
            alarms=np.concatenate([self.alarms, others.alarms]),
            leaving_probability=np.concatenate(
                [self.leaving_probability, others.leaving_probability]
            ),
        )

    @property
    def leaving_percentage(self) -> Float:
        """The probability of a change of control in whole percent, (B,); 0 if it is unknown."""
        return np.asarray(np.rint(100.0 * np.nan_to_num(self.leaving_probability)))

    @property
    def attention_order(self) -> Index:
        """The indices (B,) of the assets in the order in which they need attention.

        The order is by the number of alarms, then by the probability of a change of control, then
        by severity of damage. Assets without an estimated state count as the most damaged.
        """
        damage = np.nan_to_num(self.severity, nan=np.inf)
        # `lexsort` sorts by its last key first; minus signs give descending order.
        return np.lexsort((-damage, -self.leaving_percentage, -self.alarms))

    @property
    def needs_attention(self) -> NDArray[np.bool_]:
        """Whether each asset (B,) raised an alarm, may soon change its control, or has no estimate.

        An unknown probability of a change counts as a possible change.
        """
        may_change = (self.leaving_percentage > 0.0) | np.isnan(self.leaving_probability)
        return np.asarray((self.alarms > 0) | may_change | np.isnan(self.mean).any(axis=1))

    @property
    def severity(self) -> Float:
        """The severity of the damage of each asset, a (B,) array."""
        return severity(self.scenario, self.mean)

    @property
    def most_damaged(self) -> int | None:
        """The index of the most severely damaged asset; None if no asset has an estimated state."""
        if np.isnan(self.severity).all():
            return None
        return int(np.nanargmax(self.severity))


def states_of_flown_assets(
    group_record: JsonRecord,
    group: "xr.DataTree",
    rows: slice,
    leaving_probability: Float | None = None,
) -> AssetStates:
    """Return state, control and alarms of the flown twins in some rows after their last steps.

    Parameters
    ----------
    group_record : mapping
        The record of the group in `config.json`.
    group : DataTree
        The stored results of the group, with a row for each twin.
    leaving_probability : (B,) array, optional
        The probability that each twin in the rows changes its control; NaN if left out.
    """
    scenario = _scenario_of_group(group_record)
    members = RecordedMembers(group_record)
    first_row, _, distance = rows.indices(group.sizes[TWIN_AXIS])
    status = stored_values(group, "status", rows)
    flown = flown_rows(status)
    if leaving_probability is None:
        leaving_probability = np.full(len(status), np.nan)
    last_step = last_steps(group, rows)[flown]
    at_last_step = (flown, last_step)
    last_control = stored_values(group, "observed/control_index", rows)[at_last_step]
    return AssetStates(
        group=group_record["name"],
        scenario=scenario,
        names=[members.name(first_row + distance * row) for row in flown.tolist()],
        step=last_step,
        mean=believed_means(group, rows)[at_last_step],
        deviation=stored_values(group, "filtered/standard_deviation", rows)[at_last_step],
        control=[scenario.control_names[index] for index in last_control],
        alarms=notice_counts(group, "alarm", rows)[flown],
        leaving_probability=leaving_probability[flown],
    )


def states_of_watched_assets(group_record: JsonRecord, decided_assets: JsonRecord) -> AssetStates:
    """Return state, control and alarms of a watched group's assets after their last steps.

    Parameters
    ----------
    group_record : mapping
        The record of the group in `config.json`.
    decided_assets : mapping
        The records of the assets of all groups by GROUP/NAME, as `read_watched_state` returns
        them. The twin of each must have decided at least once: `last` of its record is the last
        decision.
    """
    scenario = _scenario_of_group(group_record)
    prefix = f"{group_record['name']}/"
    names = []
    asset_records = []
    for name_with_group, asset_record in decided_assets.items():
        if name_with_group.startswith(prefix):
            names.append(name_with_group.removeprefix(prefix))
            asset_records.append(asset_record)

    decisions = [asset_record["last"] for asset_record in asset_records]
    moments_by_asset = [decision["health"] for decision in decisions]
    alarms = [asset_record["alarms"] for asset_record in asset_records]
    # None where it is not known, which becomes NaN
    leaving_probability = [asset_record["leaving"] for asset_record in asset_records]
    return AssetStates(
        group=group_record["name"],
        scenario=scenario,
        names=names,
        step=np.array([decision["step"] for decision in decisions]),
        mean=_moments_of_states(scenario, moments_by_asset, "mean"),
        deviation=_moments_of_states(scenario, moments_by_asset, "standard_deviation"),
        control=[decision["control"] for decision in decisions],
        alarms=np.array(alarms, np.int64),
        leaving_probability=np.array(leaving_probability, np.float64),
    )


def _scenario_of_group(group_record: JsonRecord) -> Scenario:
    """Return a scenario whose states and controls hold for all assets of a group.

    All scenarios of a group come from one file, so the first one is taken.
    """
    return Scenario.model_validate(group_record["scenarios"][0])


def _moments_of_states(
    scenario: Scenario, moments_by_asset: list[JsonObject], moment: str
) -> Float:
    """Return a moment (B, F) of each state factor of each asset; NaN if it is missing.

    The moment is "mean" or "standard_deviation".
    """
    rows = []
    for moments in moments_by_asset:
        rows.append([moments[name][moment] for name in scenario.state_names])
    return np.array(rows, np.float64)
