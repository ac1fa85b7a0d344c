"""Outcomes, damage and decisions of the twins of a fleet, read from the fleet's store."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index
from reporting.json_file import JsonRecord
from reporting.words import plus_minus, significant
from twin_master.fleet.configuration import GROUPS, fleet_config
from twin_master.fleet.store import (
    ENDED,
    FAILED,
    FLOWN,
    WITHIN,
    check_installed,
    flown_rows,
    open_group,
)
from twin_master.fleet.store_layout import NOTICE_KINDS, stored_values
from twin_master.mission.preparation import Knowledge, load_knowledge
from twin_master.network.estimator import BELIEVED
from twin_master.network.simulated_missions import leaving_probability
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import printed_state
from twin_master.seeds import generator

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Estimated:
    """An estimated quantity with its standard error; NaN if it cannot be estimated.

    Attributes
    ----------
    value, error : float
        The estimate, and its standard error.
    unit : str
        The unit of both; empty for a plain number, or where factors of a state differ in it.
    """

    value: float
    error: float
    unit: str = ""


@dataclass(frozen=True)
class Outcomes:
    """The outcomes of N missions, for a state of F factors.

    Attributes
    ----------
    prompt_fallbacks : Estimated
        Of the missions whose true damage called for a fallback to a gentler control, the fraction
        in which it came within `WITHIN` steps; NaN if there is no such mission. A mission that
        ended within `WITHIN` steps of the call, without a fallback, is not counted.
    early_fallbacks : Estimated
        The fraction of missions with a fallback before the damage that calls for it; NaN if no
        damage calls for one.
    rms : tuple of Estimated
        For each factor, the root mean square error of its filtered mean over all steps of all
        missions, in SI units.
    bias : tuple of Estimated
        For each factor, the mean error of its filtered mean, in SI units.
    log_evidence : Estimated
        The mean log evidence of a step.
    credible_coverage : Estimated
        The fraction of the steps in which the true state lies in the smallest set of states that
        has a probability of `CREDIBILITY` under the filtered belief.
    """

    prompt_fallbacks: Estimated
    early_fallbacks: Estimated
    rms: tuple[Estimated, ...]
    bias: tuple[Estimated, ...]
    log_evidence: Estimated
    credible_coverage: Estimated

    @classmethod
    def from_store(cls, stored_arrays: Mapping[Any, Any]) -> "Outcomes":
        """Return the outcomes of all twins in a group of the store that have flown.

        Of a twin whose asset ended its simulation early, the flown steps are counted.

        Parameters
        ----------
        stored_arrays : mapping of str to array
            The variables of the group by name, with a row for each twin.
        """
        rows_flown = flown_rows(np.asarray(stored_arrays["status"]))

        def values(name: str) -> Float:
            return np.asarray(stored_arrays[name])[rows_flown].astype(np.float64)

        delay = values("delay")
        delays_when_called_for = delay[~np.isnan(delay)]  # NaN: the damage called for no fallback
        early = values("early")  # 1: early, 0: not early, -1: not defined
        error = np.ma.masked_invalid(
            values("filtered/mean") - values("truth/state")
        )  # masked: steps not flown
        # Means over the steps of each mission: (N, T, F) becomes (F, N).
        mean_square = (error**2).mean(axis=1).filled(np.nan).T
        mean_error = error.mean(axis=1).filled(np.nan).T
        return cls(
            prompt_fallbacks=_fraction(delays_when_called_for <= WITHIN),
            early_fallbacks=_fraction(early[early >= 0.0] > 0.0),
            rms=tuple(_root(_mean(factor)) for factor in mean_square),
            bias=tuple(_mean(factor) for factor in mean_error),
            log_evidence=_mean(np.nanmean(values("filtered/log_evidence"), axis=1)),
            credible_coverage=_mean(values("credible")),
        )


def _fraction(hits: NDArray[np.bool_]) -> Estimated:
    """Return the fraction of hits among trials; NaN if there is no trial.

    Its error is the standard deviation of the posterior Beta(hits + 1, misses + 1) of the
    probability of a hit under a uniform prior. It is above 0 even if no trial is a hit.
    """
    if not len(hits):
        return Estimated(float("nan"), float("nan"))
    a = np.sum(hits) + 1.0
    b = np.sum(~hits) + 1.0
    error = np.sqrt(a * b / (a + b + 1.0)) / (a + b)  # standard deviation of Beta(a, b)
    return Estimated(float(np.mean(hits)), float(error))


def _mean(values: Float) -> Estimated:
    """Return the mean of one value for each of N independent missions, with its standard error."""
    count = len(values)
    error = float(np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    return Estimated(float(np.mean(values)), error)


def _root(mean_square: Estimated) -> Estimated:
    """Return the root r of a mean square, with the first-order standard error d(r^2) / (2 r)."""
    root = float(np.sqrt(mean_square.value))
    return Estimated(root, mean_square.error / (2.0 * root) if root > 0.0 else 0.0)


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
    groups = fleet_config(Path(folder))["fleet"]["groups"]
    check_installed("zarr")
    import xarray as xr

    nodes = {group["name"]: open_group(Path(folder), group["name"]) for group in groups}
    return xr.DataTree(children=nodes)


def notice_counts(group: "xr.DataTree", kind: str) -> Index:
    """Return how many notices of a kind each of the B twins in a group gave: (B,)."""
    return np.asarray(
        stored_values(group, "notice/count")[:, NOTICE_KINDS.index(kind)], dtype=np.int64
    )


def believed_means(group: "xr.DataTree") -> Float:
    """Return the mean of F state factors of B twins in T steps, a (B, T, F) array in SI units.

    They are NaN in steps in which the probability that no state of the model explains the
    observations is above `BELIEVED`.
    """
    is_unexplained = stored_values(group, "notice/none_of_these") > BELIEVED
    return np.where(is_unexplained[..., np.newaxis], np.nan, stored_values(group, "filtered/mean"))


def last_steps(group: "xr.DataTree") -> Index:
    """Return the number of the last flown step of each of B twins: (B,); 0 if none was flown."""
    # Steps that were not flown, at the end of a mission, have the control -1.
    flown_steps = (stored_values(group, "observed/control_index") >= 0).sum(axis=1)
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
            transition.forward(control, belief),
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
    return np.asarray(np.maximum(1.0 - belief @ probability_kept, 0.0))


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
    scenario_numbers = np.array([number for _name, _seed, number in record["members"]])[rows_flown]
    for number in np.unique(scenario_numbers).tolist():
        knowledge_folder = folder / GROUPS / record["name"] / str(number)
        scenario = Scenario.model_validate(record["scenarios"][number]).with_paths_from(
            knowledge_folder
        )
        rows = rows_flown[scenario_numbers == number]
        yield TwinsOfScenario(rows, knowledge_folder, load_knowledge(knowledge_folder, scenario))


def leaving_probabilities(folder: Path, record: JsonRecord, group: "xr.DataTree") -> Float:
    """Return the probability that each of B twins changes its control within `prediction_steps`.

    Parameters
    ----------
    folder : Path
        The folder of the fleet.
    record : mapping
        The record of the group in `config.json`.
    group : DataTree
        The stored results of the group, with a row for each twin.

    Returns
    -------
    (B,) array
        The probabilities of `probability_of_leaving` after the last step; NaN for twins that have
        not flown, and for twins whose observations no state of the model explains.

    Raises
    ------
    RunFolderError
        If a file of the twins' prepared knowledge is missing or damaged.
    """
    twin_count = group.sizes["twin"]
    at_last_step = (np.arange(twin_count), last_steps(group))
    belief = stored_values(group, "filtered/last_probability").astype(np.float64)
    control_in_force = stored_values(group, "observed/control_index")[at_last_step]
    probability = np.full(twin_count, np.nan)
    for scenario_twins in flown_twins(folder, record, group):
        for control_index in np.unique(control_in_force[scenario_twins.rows]).tolist():
            rows = scenario_twins.rows[control_in_force[scenario_twins.rows] == control_index]
            probability[rows] = probability_of_leaving(
                scenario_twins.knowledge, belief[rows], control_index
            )
    # `unexplained` is the filter's probability that no state explains the observations.
    probability[stored_values(group, "notice/none_of_these")[at_last_step] > BELIEVED] = np.nan
    return probability


def group_figures(group: "xr.DataTree") -> dict[str, Estimated | int]:
    """Return counts of a group's twins, and the figures of their outcomes, by title.

    The figures are means over the twins with their standard errors; a group without a flown twin
    has counts alone. Figures that need the true state are left out for real assets.
    """
    status = stored_values(group, "status")
    figures = _counts_of_twins(group)
    if not len(flown_rows(status)):
        return figures
    outcomes = Outcomes.from_store(group)
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


def unit_of_states(group: "xr.DataTree") -> str:
    """Return the unit of the stored factors of the state; empty if they differ in it."""
    unit = str(group["filtered"].to_dataset()["mean"].attrs["units"])
    return "" if ", " in unit else unit


def _counts_of_twins(group: "xr.DataTree") -> dict[str, Estimated | int]:
    """Return the numbers of twins that flew, failed, ended early, or gave notices, by title."""
    status = stored_values(group, "status")
    figures: dict[str, Estimated | int] = {
        "twins": len(status),
        "flown": int(np.sum(status == FLOWN)),
        "failed in flight": int(np.sum(status == FAILED)),
    }
    ended_early = int(np.sum(status == ENDED))
    if ended_early:
        figures["ended early"] = ended_early
    if group.attrs.get("gives_notice"):
        figures["raised an alarm"] = int(np.sum(notice_counts(group, "alarm") > 0))
    left_gauge_out = int(np.sum(notice_counts(group, "gauge_left_out") > 0))
    if left_gauge_out:
        figures["left a gauge out"] = left_gauge_out
    return figures


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
