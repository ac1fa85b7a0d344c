"""Outcomes, damage and decisions of the twins of a fleet, read from the fleet's store."""

from collections.abc import Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index, product_of_each
from reporting.json_file import JsonRecord
from twin_master.fleet.configuration import fleet_config, knowledge_folder
from twin_master.fleet.members import RecordedMembers
from twin_master.fleet.storage.store import (
    check_installed,
    flown_rows,
    open_group,
)
from twin_master.fleet.storage.store_layout import ALL_ROWS, NOTICE_KINDS, stored_values
from twin_master.mission.knowledge_file import load_knowledge
from twin_master.mission.preparation import Knowledge
from twin_master.network.estimator import BELIEVED
from twin_master.network.planner import BeliefPolicy
from twin_master.network.simulated_missions import leaving_probability
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

if TYPE_CHECKING:
    import xarray as xr


def open_fleet(folder: Path | str) -> "xr.DataTree":
    """Open everything that a fleet has stored, as labelled arrays that are read at first use.

    Returns
    -------
    xarray.DataTree
        A node for each group of the fleet, with the groups `observed`, `filtered`, `truth` and
        `notice` as in a run, whose variables have the dimension `twin` as well. The layout is in
        `docs/reference/stores.md`.

    Raises
    ------
    RunFolderError, FleetError
        If the folder does not hold a fleet, or if its store cannot be read.
    """
    check_installed("zarr")
    import xarray as xr

    return xr.DataTree(children=open_groups(Path(folder), names=True))


def open_groups(folder: Path, *, names: bool = False) -> "dict[str, xr.DataTree]":
    """Return the groups of a fleet's store by name.

    Parameters
    ----------
    names : bool
        Whether to read the names of the twins.

    Raises
    ------
    RunFolderError, FleetError
        If the folder does not hold a fleet, or if its store cannot be read.
    """
    records = fleet_config(folder)["fleet"]["groups"]
    return {record["name"]: open_group(folder, record["name"], names=names) for record in records}


def notice_counts(group: "xr.DataTree", kind: str, rows: slice = ALL_ROWS) -> Index:
    """Return how many notices of a kind each of the B twins in some rows gave: (B,)."""
    return np.asarray(
        stored_values(group, "notice/count", rows)[:, NOTICE_KINDS.index(kind)], dtype=np.int64
    )


def believed_means(group: "xr.DataTree", rows: slice = ALL_ROWS) -> Float:
    """Return the mean (B, T, F) of F state factors of B twins in T steps, in SI units.

    It is NaN in steps in which the probability that no state of the model explains the observations
    exceeds `BELIEVED`.
    """
    is_unexplained = stored_values(group, "notice/none_of_these", rows) > BELIEVED
    mean = stored_values(group, "filtered/mean", rows)
    return np.where(is_unexplained[..., np.newaxis], np.nan, mean)


def last_steps(group: "xr.DataTree", rows: slice = ALL_ROWS) -> Index:
    """Return the last flown step (B,) of each of B twins; 0 if none was flown."""
    # Steps that were not flown, at the end of a mission, have the control -1.
    flown_steps = (stored_values(group, "observed/control_index", rows) >= 0).sum(axis=1)
    last_step: Index = np.maximum(flown_steps - 1, 0)
    return last_step


def severity(scenario: Scenario, mean: ArrayLike) -> Float:
    """Return the severity of the damage of assets, a dimensionless number for ranking them.

    Each factor of the state counts by its position between its lowest level (0) and its highest
    level (1); the severity is the sum over the factors.

    Parameters
    ----------
    mean : (..., F) array
        The mean states, in SI units.

    Returns
    -------
    (...) array
        The severities.
    """
    lowest_level = np.array([factor.levels[0] for factor in scenario.state])  # (F,)
    highest_level = np.array([factor.levels[-1] for factor in scenario.state])  # (F,)
    level_range = highest_level - lowest_level
    divisor = np.where(level_range == 0.0, 1.0, level_range)  # a factor with one level counts 0
    severity_of_factor = (np.asarray(mean) - lowest_level) / divisor  # (..., F)
    return np.asarray(severity_of_factor.sum(axis=-1))


def probability_of_leaving(knowledge: Knowledge, belief: Float, control: int) -> Float:
    """Return the probability that twins leave a control within the scenario's `prediction_steps`.

    If the policy maps states to controls, this is the probability that the state, as predicted,
    comes to one for which the policy chooses another control. If the policy maps beliefs to
    controls, it is the fraction of simulated missions in which the control changes.

    Parameters
    ----------
    knowledge : Knowledge
        What the twins share: model, policy and draws.
    belief : (B, S) array
        Their beliefs after the last step.
    control : int
        The index of the control in force, under which the states evolve until it is left.

    Returns
    -------
    (B,) array
        The probabilities.
    """
    scenario = knowledge.scenario
    transition = knowledge.model.transition
    steps = scenario.mission.prediction_steps
    policy_on_belief = knowledge.plan.on_belief
    if isinstance(policy_on_belief, BeliefPolicy):
        return leaving_probability(
            knowledge.problem,
            policy_on_belief,
            np.stack([transition.forward(control, row) for row in belief]),
            control,
            steps,
            generator(scenario.mission.seed, "planning"),
        )
    # Backward recursion over the steps: k_1(s) = 1 if the policy keeps the control in state s, else
    # 0; k_n(s) = k_1(s) E[k_(n-1)(next state) | s] is the probability that n decisions keep it.
    keeps_control = (knowledge.plan.control_index == control).astype(np.float64)
    probability_kept = keeps_control.copy()
    for _ in range(steps - 1):
        probability_kept = keeps_control * transition.expected_value(control, probability_kept)
    if scenario.planner.decide_on == "predicted":  # the state after the next transition decides
        probability_kept = transition.expected_value(control, probability_kept)
    probability_of_twin = product_of_each(belief, probability_kept[:, None]).squeeze(axis=-1)
    return np.asarray(np.maximum(1.0 - probability_of_twin, 0.0))


class TwinsOfScenario(NamedTuple):
    """Twins of a group that share a scenario, and thus a model and a policy.

    Attributes
    ----------
    rows : (B,) array
        Their rows in the store.
    folder : Path
        The folder of their prepared knowledge.
    knowledge : Knowledge
        Their knowledge: model, policy and calibration draws.
    """

    rows: Index
    folder: Path
    knowledge: Knowledge


def flown_twins(
    folder: Path, record: JsonRecord, group: "xr.DataTree"
) -> Iterator[TwinsOfScenario]:
    """Yield the twins of a group that have flown, scenario by scenario.

    Parameters
    ----------
    record : mapping
        The group in `config.json`.
    group : DataTree
        The group in the store.

    Raises
    ------
    RunFolderError
        If a file of the twins' prepared knowledge is missing or damaged.
    """
    rows_flown = flown_rows(stored_values(group, "status"))
    scenario_numbers = RecordedMembers(record).scenario_numbers(rows_flown)
    for number in np.unique(scenario_numbers).tolist():
        rows = rows_flown[scenario_numbers == number]
        yield TwinsOfScenario(
            rows,
            knowledge_folder(folder, record["name"], number),
            knowledge_of_scenario(folder, record, number),
        )


def knowledge_of_scenario(folder: Path, record: JsonRecord, scenario_number: int) -> Knowledge:
    """Return the knowledge of the twins of a scenario of a group."""
    prepared = knowledge_folder(folder, record["name"], scenario_number)
    scenario = Scenario.model_validate(record["scenarios"][scenario_number])
    return load_knowledge(prepared, scenario.with_paths_from(prepared))


class ControlForecast:
    """How probably the twins of a group change their control, by the policies of their scenarios.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    record : mapping
        The record of the group in `config.json`.
    """

    def __init__(self, folder: Path, record: JsonRecord) -> None:
        self._members = RecordedMembers(record)
        # The twins of a block have one scenario, or each has its own.
        self._knowledge = lru_cache(maxsize=1)(partial(knowledge_of_scenario, folder, record))

    def probabilities(self, group: "xr.DataTree", rows: slice) -> Float:
        """Return the probability that each of B twins changes control within `prediction_steps`.

        Parameters
        ----------
        group : DataTree
            The stored results of the group, with a row for each twin.
        rows : slice
            The rows of the B twins.

        Returns
        -------
        (B,) array
            The probabilities of `probability_of_leaving` after the last step; NaN for twins that
            have not flown, and for twins whose observations no state of the model explains.

        Raises
        ------
        RunFolderError
            If a file of the twins' prepared knowledge is missing or damaged.
        """
        status = stored_values(group, "status", rows)
        at_last_step = (np.arange(len(status)), last_steps(group, rows))
        belief = stored_values(group, "filtered/last_probability", rows).astype(np.float64)
        control_in_force = stored_values(group, "observed/control_index", rows)[at_last_step]
        row_numbers = np.arange(*rows.indices(group.sizes["twin"]))
        scenario_numbers = self._members.scenario_numbers(row_numbers)
        has_flown = np.zeros(len(status), dtype=bool)
        has_flown[flown_rows(status)] = True
        probability = np.full(len(status), np.nan)
        for number in np.unique(scenario_numbers[has_flown]).tolist():
            knowledge = self._knowledge(number)
            has_scenario = has_flown & (scenario_numbers == number)
            for control_index in np.unique(control_in_force[has_scenario]).tolist():
                twins = has_scenario & (control_in_force == control_index)
                probability[twins] = probability_of_leaving(knowledge, belief[twins], control_index)
        # Nothing is predicted for twins that believe in no state of the model.
        is_unexplained = stored_values(group, "notice/none_of_these", rows)[at_last_step] > BELIEVED
        probability[is_unexplained] = np.nan
        return probability
