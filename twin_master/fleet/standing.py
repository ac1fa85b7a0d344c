"""State, control and alarms of the assets of a group after their last steps.

They are read from the store of a flown fleet, or from the records of a watched one.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from reporting.arrays import Float, Index
from reporting.json_file import JsonObject, JsonRecord
from twin_master.fleet.reading import believed_means, last_steps, notice_counts, severity
from twin_master.fleet.store import flown_rows
from twin_master.fleet.store_layout import stored_values
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Standing:
    """State, control and alarms of B assets of a group after their last steps.

    Attributes
    ----------
    group : str
        The name of the group.
    scenario : Scenario
        Its scenario, with F factors of the state.
    names : list of str
        The names of the assets.
    step : (B,) array
        The last step of each.
    mean, deviation : (B, F) array
        Mean and standard deviation of the state, in SI units; NaN if no state of the model
        explains the observations.
    control : list of str
        The control in force.
    alarms : (B,) array
        The number of alarms.
    leaving_probability : (B,) array
        The probability that the control changes within the scenario's `prediction_steps`; NaN if
        it is not known.
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


def standing_of_flown(group_record: JsonRecord, group: "xr.DataTree") -> Standing:
    """Return state, control and alarms of the flown twins of a group after their last steps.

    The probabilities of leaving a control are NaN here: `leaving_probabilities` computes them,
    because they need the twins' model and policy, which the store does not hold.

    Parameters
    ----------
    group_record : mapping
        The record of the group in `config.json`.
    group : DataTree
        The stored results of the group, with a row for each twin.
    """
    scenario = _scenario_of_group(group_record)
    rows_flown = flown_rows(stored_values(group, "status"))
    last_step = last_steps(group)[rows_flown]
    at_last_step = (rows_flown, last_step)
    last_control = stored_values(group, "observed/control_index")[at_last_step]
    names = [name for name, _seed, _scenario_number in group_record["members"]]
    return Standing(
        group=group_record["name"],
        scenario=scenario,
        names=[names[row] for row in rows_flown],
        step=last_step,
        mean=believed_means(group)[at_last_step],
        deviation=stored_values(group, "filtered/standard_deviation")[at_last_step],
        control=[scenario.control_names[index] for index in last_control],
        alarms=notice_counts(group, "alarm")[rows_flown],
        leaving_probability=np.full(len(rows_flown), np.nan),
    )


def standing_of_watched(group_record: JsonRecord, decided_assets: JsonRecord) -> Standing:
    """Return state, control and alarms of the assets of a watched group after their last steps.

    Parameters
    ----------
    group_record : mapping
        The record of the group in `config.json`.
    decided_assets : mapping
        The records of the assets of all groups by GROUP/NAME, as `read_standing` returns them. The
        twin of each must have decided at least once: `last` of its record is the last decision.
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
    return Standing(
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

    All scenarios of a group come from one scenario file, and differ only in what it lets differ
    from asset to asset, so that the first one is taken.
    """
    return Scenario.model_validate(group_record["scenarios"][0])


def _moments_of_states(
    scenario: Scenario, moments_by_asset: list[JsonObject], moment: str
) -> Float:
    """Return a moment of each state factor of each asset, a (B, F) array.

    It is NaN where the record has None.

    Parameters
    ----------
    scenario : Scenario
        The scenario, which names the factors.
    moments_by_asset : list of dict
        For each asset, the moments of each state factor by the factor's name.
    moment : str
        The key of the moment: "mean" or "standard_deviation".
    """
    rows = []
    for moments in moments_by_asset:
        rows.append([moments[name][moment] for name in scenario.state_names])
    return np.array(rows, np.float64)
