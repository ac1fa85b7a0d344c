"""Results of the groups of fleets side by side: returns of the flights, errors and counts."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonRecord
from reporting.words import between, plus_minus, rounded, significant
from twin_master.fleet.configuration import fleet_config
from twin_master.fleet.outcomes import Estimated, Outcomes, RunningMoments
from twin_master.fleet.reading import knowledge_of_scenario, notice_counts, open_groups
from twin_master.fleet.storage.store import ENDED, FAILED, FLOWN, WITHIN, flown_rows
from twin_master.fleet.storage.store_layout import row_blocks, stored_values
from twin_master.mission.earnings import promised_return
from twin_master.report.reading import NORMAL_95
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state

if TYPE_CHECKING:
    import xarray as xr

Statistic = Estimated | int | str
"""A statistic of a group: an estimate, a count, or a name."""
Statistics = dict[str, dict[str, Statistic]]
"""The statistics of each group, by the name of the group and of the statistic."""


def outcomes_of_group(group: "xr.DataTree") -> Outcomes:
    """Return the outcomes of the twins of a group of the store."""
    return Outcomes.from_blocks(
        partial(stored_values, group, rows=rows) for rows in row_blocks(group)
    )


def earned_statistics(group: "xr.DataTree") -> dict[str, Statistic]:
    """Return what the flights of a group earned, by title; empty for stores without rewards.

    The values are means over the flights, with their standard errors. Failed flights are left out.
    Of a flight that ended early, only the steps that it flew count.
    """
    if "earned" not in group.children:
        return {}
    controls = list(group.attrs["controls"])
    keys_of_controls = [f"steps with {control}" for control in controls]
    moments = {
        key: RunningMoments()
        for key in (
            RETURN,
            "reward of a step",
            *keys_of_controls,
            "steps beyond the limit",
            "needless steps",
            "steps beyond a health limit",
            "changes of control",
        )
    }
    for block in row_blocks(group):
        rows = flown_rows(stored_values(group, "status", block))
        control = stored_values(group, "observed/control_index", block)[rows]
        is_flown = control >= 0
        steps_flown = np.maximum(is_flown.sum(axis=1), 1)
        earned = {
            name: stored_values(group, f"earned/{name}", block)[rows]
            for name in ("return", "reward", "beyond_limit", "needless", "health")
        }
        # A column for each step; those that were not flown are NaN.
        values_of_steps = {
            "reward of a step": earned["reward"],
            "steps beyond the limit": earned["beyond_limit"],
            "needless steps": earned["needless"],
            "steps beyond a health limit": earned["health"] < 0.0,
        }
        for index, key in enumerate(keys_of_controls):
            values_of_steps[key] = control == index
        moments[RETURN].add(earned["return"])
        for key, values in values_of_steps.items():
            moments[key].add(np.nansum(values, axis=1, dtype=np.float64) / steps_flown)
        is_change = (np.diff(control, axis=1) != 0) & is_flown[:, 1:]
        moments["changes of control"].add(is_change.sum(axis=1).astype(np.float64))
    return {key: moments_of_key.mean for key, moments_of_key in moments.items()}


def group_statistics(group: "xr.DataTree") -> dict[str, Statistic]:
    """Return counts of a group's twins, and the statistics of their outcomes, by title.

    The statistics are means over the twins with their standard errors; a group without a flown twin
    has counts alone. Statistics that need the true state are left out for real assets.
    """
    statistics, flown_count = _counts_of_twins(group)
    if not flown_count:
        return statistics
    statistics |= earned_statistics(group)
    outcomes = outcomes_of_group(group)
    is_truth_known = not np.isnan(outcomes.bias[0].value)  # NaN for real assets
    if is_truth_known:
        if not np.isnan(outcomes.prompt_fallbacks.value):
            steps = f"{group.attrs['step_name']}s"
            statistics[f"fallback within {WITHIN} {steps}, of those called for"] = (
                outcomes.prompt_fallbacks
            )
        if not np.isnan(outcomes.early_fallbacks.value):
            statistics["early fallback"] = outcomes.early_fallbacks
        state_unit = unit_of_states(group)
        for name, rms, bias in zip(
            stored_values(group, "filtered/region"), outcomes.rms, outcomes.bias, strict=True
        ):
            statistics[f"filtered rms error of {name}"] = replace(rms, unit=state_unit)
            statistics[f"bias of {name}"] = replace(bias, unit=state_unit)
    statistics["log evidence of a step"] = outcomes.log_evidence
    if is_truth_known:
        statistics["true state in the 90 % set"] = outcomes.credible_coverage
    return statistics


class NamedGroup(NamedTuple):
    """A group of a fleet, to be compared with others.

    Attributes
    ----------
    name : str
        The name of the group; if there are several folders, with the folder, or the folder alone if
        it has one group.
    folder : Path
        The folder of the fleet.
    record : dict
        The record of the group in `config.json`.
    policy : str
        The name of the scenario's policy that decides, or "given" for one from the user.
    """

    name: str
    folder: Path
    record: JsonRecord
    group: "xr.DataTree"
    policy: str


def groups_of_fleets(folders: Sequence[Path]) -> list[NamedGroup]:
    """Return all groups of several fleets.

    Raises
    ------
    RunFolderError, FleetError
        If a folder does not hold a fleet, or if its store cannot be read.
    """
    named_groups = []
    for folder in folders:
        fleet = fleet_config(folder)["fleet"]
        groups = open_groups(folder)
        for record in fleet["groups"]:
            name = record["name"]
            full_name = f"{folder}: {name}"
            if len(folders) == 1:
                full_name = name
            elif len(groups) == 1:
                full_name = str(folder)
            policy = Scenario.model_validate(record["scenarios"][0]).planner.policy_name
            if "policy" in fleet.get("parts", {}):
                policy = "given"
            named_groups.append(NamedGroup(full_name, folder, record, groups[name], policy))
    return named_groups


def statistics_of_fleets(folders: Sequence[Path]) -> Statistics:
    """Return the statistics of each group by name; of several folders, the name has the folder.

    Raises
    ------
    RunFolderError, FleetError
        If a folder does not hold a fleet, or if its store cannot be read.
    """
    return {named.name: group_statistics(named.group) for named in groups_of_fleets(folders)}


def compare_fleets(folders: Sequence[Path]) -> Statistics:
    """Return the results of each group, beside the return that was planned and that of the first.

    Groups are compared seed by seed, because flights of one seed meet the same damage and noise
    (common random numbers): the difference of their returns varies less than the returns do.

    Raises
    ------
    RunFolderError, FleetError
        If a folder does not hold a fleet, or if its store cannot be read.
    """
    named_groups = groups_of_fleets(folders)
    first = named_groups[0]
    statistics: Statistics = {}
    for named in named_groups:
        statistics[named.name] = {"policy": named.policy} | group_statistics(named.group)
        if RETURN not in statistics[named.name]:
            continue
        # the return that the twin's model expects of the policy
        if len(named.record["scenarios"]) == 1:
            expected_return = promised_return(knowledge_of_scenario(named.folder, named.record, 0))
            statistics[named.name] = _with_statistic_after(
                statistics[named.name],
                RETURN,
                RETURN_PROMISED,
                Estimated(expected_return.mean, expected_return.standard_error),
            )
        # the difference from the first group, seed by seed
        if named is not first and RETURN in statistics[first.name]:
            difference = _difference_of_returns(named.group, first.group)
            statistics[named.name] = _with_statistic_after(
                statistics[named.name], RETURN, f"{RETURN_BEYOND}{first.name}", difference
            )
    return statistics


def _with_statistic_after(
    statistics: dict[str, Statistic], previous_key: str, key: str, statistic: Statistic
) -> dict[str, Statistic]:
    """Return statistics with a further one after that of another key."""
    ordered: dict[str, Statistic] = {}
    for known_key, known_statistic in statistics.items():
        ordered[known_key] = known_statistic
        if known_key == previous_key:
            ordered[key] = statistic
    return ordered


def returns_of_group(group: "xr.DataTree") -> Float:
    """Return the discounted returns of the flights of a group that did not fail: (B,).

    The array is empty for stores without rewards.
    """
    if "earned" not in group.children:
        return np.empty(0)
    rows = flown_rows(stored_values(group, "status"))
    return np.asarray(stored_values(group, "earned/return")[rows], dtype=np.float64)


def _difference_of_returns(group: "xr.DataTree", other_group: "xr.DataTree") -> Estimated:
    """Return how much more flights earn, in the mean, than those of another group with equal seeds.

    Only seeds with exactly one flight in each group count; the result is NaN if there is none.
    """
    returns_by_seed = []
    for tree in (group, other_group):
        rows = flown_rows(stored_values(tree, "status"))
        seeds, first_rows, counts = np.unique(
            stored_values(tree, "seed")[rows], return_index=True, return_counts=True
        )
        is_single = counts == 1
        returns = stored_values(tree, "earned/return")[rows][first_rows]
        returns_by_seed.append((seeds[is_single], returns[is_single]))
    (seeds, returns), (other_seeds, other_returns) = returns_by_seed
    _, rows, other_rows = np.intersect1d(
        seeds, other_seeds, assume_unique=True, return_indices=True
    )
    moments = RunningMoments()
    moments.add(returns[rows] - other_returns[other_rows])
    return moments.mean


def unit_of_states(group: "xr.DataTree") -> str:
    """Return the unit of the stored factors of the state; empty if they differ in it."""
    unit = str(group["filtered"].to_dataset()["mean"].attrs["units"])
    return "" if ", " in unit else unit


def _counts_of_twins(group: "xr.DataTree") -> tuple[dict[str, Statistic], int]:
    """Count the twins of a group that flew, failed, ended early or gave notices.

    Returns the counts by title, and the number of twins that have outcomes.
    """
    status_counts = np.zeros(max(FLOWN, FAILED, ENDED) + 1, dtype=np.int64)
    alarmed_count = 0
    left_gauge_out_count = 0
    for rows in row_blocks(group):
        status = stored_values(group, "status", rows)
        status_counts += np.bincount(status, minlength=len(status_counts))
        alarmed_count += int(np.sum(notice_counts(group, "alarm", rows) > 0))
        left_gauge_out_count += int(np.sum(notice_counts(group, "gauge_left_out", rows) > 0))
    statistics: dict[str, Statistic] = {
        "twins": int(status_counts.sum()),
        "flown": int(status_counts[FLOWN]),
        "failed in flight": int(status_counts[FAILED]),
    }
    if status_counts[ENDED]:
        statistics["ended early"] = int(status_counts[ENDED])
    if group.attrs.get("gives_notice"):
        statistics["raised an alarm"] = alarmed_count
    if left_gauge_out_count:
        statistics["left a gauge out"] = left_gauge_out_count
    return statistics, int(status_counts[FLOWN] + status_counts[ENDED])


class _PrintedStatistic(NamedTuple):
    """How a statistic of a group is printed.

    Attributes
    ----------
    title : str
        What it is called; the field `{of}` is the rest of its key.
    scale : float
        The factor from the stored to the printed values.
    unit : str
        The printed unit; empty for a plain number.
    interval : bool
        Whether the 95 % interval is printed, not the standard error.
    """

    title: str
    scale: float = 1.0
    unit: str = ""
    interval: bool = False


_LEAST_PRINTED_ERROR = 1e-5
"""The relative standard error to which values with an interval are printed."""
RETURN = "return"
"""The key of the discounted return of a flight."""
RETURN_PROMISED = "return promised"
"""The key of the return that the twin's own model expects."""
RETURN_BEYOND = "return beyond "
"""The beginning of the key of a difference of returns, before the name of the other group."""
PRINTED_STATISTICS_OF_FLEETS = {
    RETURN_PROMISED: _PrintedStatistic("return that the twin's model promises", interval=True),
    RETURN_BEYOND: _PrintedStatistic("return beyond that of {of}, seed by seed", interval=True),
    RETURN: _PrintedStatistic("return: rewards of a flight, discounted", interval=True),
    "reward of a step": _PrintedStatistic("reward of a step", interval=True),
    "steps with ": _PrintedStatistic("steps flown with {of}", 100.0, "%"),
    "steps beyond the limit": _PrintedStatistic(
        "steps with a harder control than the best one of the state", 100.0, "%"
    ),
    "needless steps": _PrintedStatistic(
        "steps with a gentler control than the best one of the state", 100.0, "%"
    ),
    "steps beyond a health limit": _PrintedStatistic("steps beyond a health limit", 100.0, "%"),
    "changes of control": _PrintedStatistic("changes of control in a flight"),
    f"fallback within {WITHIN} ": _PrintedStatistic(
        f"assets whose control changed within {WITHIN} steps of the damage that called for it",
        100.0,
        "%",
    ),
    "early fallback": _PrintedStatistic(
        "assets whose control changed before the damage called for it", 100.0, "%"
    ),
    "filtered rms error of ": _PrintedStatistic("rms error of the estimated {of}"),
    "bias of ": _PrintedStatistic("mean error of the estimated {of}"),
    "log evidence of a step": _PrintedStatistic("log evidence of a step", unit="nat"),
    "true state in the 90 % set": _PrintedStatistic(
        "steps in which the set of states with a probability of 90 % has the true one", 100.0, "%"
    ),
}
"""How statistics are printed, by the beginning of their keys; others are counts of assets."""
COUNTS_OF_FLEETS = (
    "twins",
    "flown",
    "failed in flight",
    "ended early",
    "raised an alarm",
    "left a gauge out",
)
"""Titles of the counts of assets, which are their keys."""


def statistic_rows(groups: Mapping[str, Mapping[str, Statistic]]) -> list[list[str]]:
    """Return the statistics of groups as rows of a table: a title, and a cell for each group."""
    keys: list[str] = []
    for statistics in groups.values():
        position = 0
        for key in statistics:
            if key not in keys:
                keys.insert(position, key)  # after the statistic that stands before it
            position = keys.index(key) + 1
    rows = []
    for key in keys:
        printed_statistic = _PrintedStatistic(key)
        for beginning, description in PRINTED_STATISTICS_OF_FLEETS.items():
            if key.startswith(beginning):
                printed_statistic = description._replace(
                    title=description.title.format(of=key.removeprefix(beginning))
                )
                break
        cells = [
            _statistic_text(statistics.get(key), printed_statistic)
            for statistics in groups.values()
        ]
        rows.append([printed_statistic.title, *cells])
    return rows


def _statistic_text(statistic: Statistic | None, printed_statistic: _PrintedStatistic) -> str:
    """Return a statistic with its standard error and unit as text; empty if there is none."""
    if statistic is None:
        return ""
    if isinstance(statistic, int | str):
        return str(statistic)
    scale = printed_statistic.scale
    unit = printed_statistic.unit
    if statistic.unit:
        scale, unit = printed_state(statistic.unit, "percentage points")
    value = scale * statistic.value
    error = scale * statistic.error
    if printed_statistic.interval and np.isfinite(error):
        error = max(error, abs(value) * _LEAST_PRINTED_ERROR)
        low, high = value - NORMAL_95 * error, value + NORMAL_95 * error
        return f"{rounded(value, error)} ({between(low, high, error)})"
    # One twin has no standard error.
    text = plus_minus(value, error) if np.isfinite(error) else significant(value)
    return f"{text} {unit}".rstrip()
