"""Outcomes, damage and decisions of the twins of a fleet, read from the fleet's store."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float, Index, product_of_each
from reporting.json_file import JsonRecord
from reporting.words import plus_minus, significant
from twin_master.fleet.configuration import GROUPS, fleet_config
from twin_master.fleet.members import RecordedMembers
from twin_master.fleet.outcomes import Estimated, Outcomes
from twin_master.fleet.storage.store import (
    ENDED,
    FAILED,
    FLOWN,
    WITHIN,
    check_installed,
    flown_rows,
    open_group,
)
from twin_master.fleet.storage.store_layout import ALL_ROWS, NOTICE_KINDS, row_blocks, stored_values
from twin_master.mission.preparation import Knowledge, load_knowledge
from twin_master.network.estimator import BELIEVED
from twin_master.network.simulated_missions import leaving_probability
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.seeds import generator

if TYPE_CHECKING:
    import xarray as xr


def open_fleet(folder: Path | str) -> "xr.DataTree":
    """Return everything that a fleet has stored, as labelled arrays that are read at first use.

    Parameters
    ----------
    folder : Path or str
        The folder of the fleet.

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
    """Return the groups of the store of a fleet by name.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
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
    """Return the mean of F state factors of B twins in T steps, a (B, T, F) array in SI units.

    They are NaN in steps in which the probability that no state of the model explains the
    observations is above `BELIEVED`.
    """
    is_unexplained = stored_values(group, "notice/none_of_these", rows) > BELIEVED
    mean = stored_values(group, "filtered/mean", rows)
    return np.where(is_unexplained[..., np.newaxis], np.nan, mean)


def last_steps(group: "xr.DataTree", rows: slice = ALL_ROWS) -> Index:
    """Return the number of the last flown step of each of B twins: (B,); 0 if none was flown."""
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
    scenario : Scenario
        The scenario with F factors of the state.
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

    If the policy maps states to controls, this is the probability that the predicted course of
    states reaches one for which the policy chooses another control. If the policy maps beliefs to
    controls, it is the fraction of simulated missions in which the control changes.

    Parameters
    ----------
    knowledge : Knowledge
        The knowledge that the twins share.
    belief : (B, S) array
        Their beliefs after the last step.
    control : int
        The index of the control in force, under which the states change until it is left.

    Returns
    -------
    (B,) array
        The probabilities.
    """
    scenario = knowledge.scenario
    transition = knowledge.model.transition
    steps = scenario.mission.prediction_steps
    if knowledge.plan.on_belief is not None:
        return leaving_probability(
            knowledge.problem,
            knowledge.plan.on_belief,
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
    folder : Path
        The folder of the fleet.
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
        knowledge_folder = _knowledge_folder(folder, record, number)
        rows = rows_flown[scenario_numbers == number]
        yield TwinsOfScenario(rows, knowledge_folder, _knowledge(folder, record, number))


def _knowledge_folder(folder: Path, record: JsonRecord, scenario_number: int) -> Path:
    """Return the folder with the prepared knowledge of a scenario of a group."""
    return folder / GROUPS / str(record["name"]) / str(scenario_number)


def _knowledge(folder: Path, record: JsonRecord, scenario_number: int) -> Knowledge:
    """Return the knowledge of the twins of a scenario of a group."""
    knowledge_folder = _knowledge_folder(folder, record, scenario_number)
    scenario = Scenario.model_validate(record["scenarios"][scenario_number])
    return load_knowledge(knowledge_folder, scenario.with_paths_from(knowledge_folder))


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
        self._knowledge = lru_cache(maxsize=1)(partial(_knowledge, folder, record))

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
        # `unexplained` is the filter's probability that no state explains the observations.
        is_unexplained = stored_values(group, "notice/none_of_these", rows)[at_last_step] > BELIEVED
        probability[is_unexplained] = np.nan
        return probability


def outcomes_of_group(group: "xr.DataTree") -> Outcomes:
    """Return the outcomes of the twins of a group of the store."""
    return Outcomes.from_blocks(
        partial(stored_values, group, rows=rows) for rows in row_blocks(group)
    )


def group_figures(group: "xr.DataTree") -> dict[str, Estimated | int]:
    """Return counts of a group's twins, and the figures of their outcomes, by title.

    The figures are means over the twins with their standard errors; a group without a flown twin
    has counts alone. Figures that need the true state are left out for real assets.
    """
    figures, flown_count = _counts_of_twins(group)
    if not flown_count:
        return figures
    outcomes = outcomes_of_group(group)
    is_truth_known = not np.isnan(outcomes.bias[0].value)  # NaN for real assets
    if is_truth_known:
        if not np.isnan(outcomes.prompt_fallbacks.value):
            steps = f"{group.attrs['step_name']}s"
            figures[f"fallback within {WITHIN} {steps}, of those called for"] = (
                outcomes.prompt_fallbacks
            )
        if not np.isnan(outcomes.early_fallbacks.value):
            figures["early fallback"] = outcomes.early_fallbacks
        state_unit = unit_of_states(group)
        for name, rms, bias in zip(
            stored_values(group, "filtered/region"), outcomes.rms, outcomes.bias, strict=True
        ):
            figures[f"filtered rms error of {name}"] = replace(rms, unit=state_unit)
            figures[f"bias of {name}"] = replace(bias, unit=state_unit)
    figures["log evidence of a step"] = outcomes.log_evidence
    if is_truth_known:
        figures["true state in the 90 % set"] = outcomes.credible_coverage
    return figures


Figures = dict[str, dict[str, Estimated | int]]
"""The figures of each group, by the name of the group and of the figure."""


def figures_of_fleets(folders: Sequence[Path]) -> Figures:
    """Return the figures of each group by name; of several folders, the name has the folder.

    Raises
    ------
    RunFolderError, FleetError
        If a folder does not hold a fleet, or if its store cannot be read.
    """
    figures = {}
    for folder in folders:
        for name, group in open_groups(folder).items():
            full_name = name if len(folders) == 1 else f"{folder}: {name}"
            figures[full_name] = group_figures(group)
    return figures


def unit_of_states(group: "xr.DataTree") -> str:
    """Return the unit of the stored factors of the state; empty if they differ in it."""
    unit = str(group["filtered"].to_dataset()["mean"].attrs["units"])
    return "" if ", " in unit else unit


def _counts_of_twins(group: "xr.DataTree") -> tuple[dict[str, Estimated | int], int]:
    """Return the numbers of twins by title, and the number of twins that have outcomes.

    Counted are twins that flew, failed, ended early, or gave notices.
    """
    status_counts = np.zeros(max(FLOWN, FAILED, ENDED) + 1, dtype=np.int64)
    alarmed = 0
    left_gauge_out = 0
    for rows in row_blocks(group):
        status = stored_values(group, "status", rows)
        status_counts += np.bincount(status, minlength=len(status_counts))
        alarmed += int(np.sum(notice_counts(group, "alarm", rows) > 0))
        left_gauge_out += int(np.sum(notice_counts(group, "gauge_left_out", rows) > 0))
    figures: dict[str, Estimated | int] = {
        "twins": int(status_counts.sum()),
        "flown": int(status_counts[FLOWN]),
        "failed in flight": int(status_counts[FAILED]),
    }
    if status_counts[ENDED]:
        figures["ended early"] = int(status_counts[ENDED])
    if group.attrs.get("gives_notice"):
        figures["raised an alarm"] = alarmed
    if left_gauge_out:
        figures["left a gauge out"] = left_gauge_out
    return figures, int(status_counts[FLOWN] + status_counts[ENDED])


class _PrintedFigure(NamedTuple):
    """How a figure of a group is printed.

    Attributes
    ----------
    title : str
        What it is called; the field `{of}` is the rest of its key.
    scale : float
        The factor from the stored to the printed values.
    unit : str
        The printed unit; empty for a plain number.
    """

    title: str
    scale: float = 1.0
    unit: str = ""


PRINTED_FIGURES_OF_FLEETS = {
    f"fallback within {WITHIN} ": _PrintedFigure(
        f"assets whose control changed within {WITHIN} steps of the damage that called for it",
        100.0,
        "%",
    ),
    "early fallback": _PrintedFigure(
        "assets whose control changed before the damage called for it", 100.0, "%"
    ),
    "filtered rms error of ": _PrintedFigure("rms error of the estimated {of}"),
    "bias of ": _PrintedFigure("mean error of the estimated {of}"),
    "log evidence of a step": _PrintedFigure("log evidence of a step", unit="nat"),
    "true state in the 90 % set": _PrintedFigure(
        "steps in which the set of states with a probability of 90 % has the true one", 100.0, "%"
    ),
}
"""How figures are printed, by the beginning of their keys; others are counts of assets."""
COUNTS_OF_FLEETS = (
    "twins",
    "flown",
    "failed in flight",
    "ended early",
    "raised an alarm",
    "left a gauge out",
)
"""Titles of the counts of assets, which are their keys."""


def figure_rows(groups: Mapping[str, Mapping[str, Estimated | int]]) -> list[list[str]]:
    """Return the figures of groups as rows of a table: a title, and a cell for each group."""
    keys: dict[str, None] = {}  # used as an ordered set
    for figures in groups.values():
        keys |= dict.fromkeys(figures)
    rows = []
    for key in keys:
        printed_figure = _PrintedFigure(key)
        for beginning, description in PRINTED_FIGURES_OF_FLEETS.items():
            if key.startswith(beginning):
                printed_figure = description._replace(
                    title=description.title.format(of=key.removeprefix(beginning))
                )
        cells = [_figure_text(figures.get(key), printed_figure) for figures in groups.values()]
        rows.append([printed_figure.title, *cells])
    return rows


def _figure_text(figure: Estimated | int | None, printed_figure: _PrintedFigure) -> str:
    """Return a figure with its standard error and unit as text; empty if there is none."""
    if figure is None:
        return ""
    if isinstance(figure, int):
        return str(figure)
    scale = printed_figure.scale
    unit = printed_figure.unit
    if figure.unit:
        scale, unit = printed_state(figure.unit, "percentage points")
    value = scale * figure.value
    error = scale * figure.error
    # One twin has no standard error.
    text = plus_minus(value, error) if np.isfinite(error) else significant(value)
    return f"{text} {unit}".rstrip()
