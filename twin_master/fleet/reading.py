"""What stands in the store of a fleet, as figures with their errors."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from twin_master.fleet.flight import GROUPS, fleet_config
from twin_master.fleet.store import ENDED, FAILED, FLOWN, NOTICE_KINDS, WITHIN, has_flown, open_group
from twin_master.mission.preparation import Knowledge, load_knowledge
from twin_master.network.belief_planning import leaving_probability
from twin_master.network.estimator import BELIEVED
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Estimated:
    """A figure with its standard error."""

    value: float
    error: float


@dataclass(frozen=True)
class Outcomes:
    """What became of N missions, of F factors of the state.

    Attributes
    ----------
    within : Estimated
        Share of the called-for fallbacks that came within `WITHIN` steps, as far as these were flown; NaN
        without any.
    early : Estimated
        Share of missions with a fallback before the damage that calls for it; NaN where none does.
    rms, bias : tuple of Estimated
        Of each factor, SI: root of the mean squared error of its filtered mean over all steps of all
        missions, and the mean error.
    evidence : Estimated
        Mean log evidence of a step.
    credible : Estimated
        Share of the steps in which the true state lies in the smallest set of states that the filtered
        belief holds for `CREDIBILITY` probable.
    """

    within: Estimated
    early: Estimated
    rms: tuple[Estimated, ...]
    bias: tuple[Estimated, ...]
    evidence: Estimated
    credible: Estimated

    @classmethod
    def of(cls, stored: Mapping[Any, Any]) -> "Outcomes":
        """Return those of the twins that have flown, some until their assets ended, of the store."""
        flown = has_flown(np.asarray(stored["status"]))
        kept = {
            name: np.asarray(stored[name])[flown].astype(np.float64)
            for name in ("delay", "early", "credible", "mean", "state", "log_evidence")
        }
        error = np.ma.masked_invalid(kept["mean"] - kept["state"])  # (N, T, F), some steps were not flown
        squared, bias = ((error**power).mean(axis=1).filled(np.nan).T for power in (2, 1))
        return cls(
            within=_share(kept["delay"][~np.isnan(kept["delay"])] <= WITHIN),
            early=_share(kept["early"][kept["early"] >= 0.0] > 0.0),
            rms=tuple(_root(_mean(own)) for own in squared),
            bias=tuple(_mean(own) for own in bias),
            evidence=_mean(np.nanmean(kept["log_evidence"], axis=1)),
            credible=_mean(kept["credible"]),
        )


def _share(hits: NDArray[np.bool_]) -> Estimated:
    """Return a share; its error is that of its posterior under a uniform prior: 0 of 20 is not 0 ± 0."""
    if not len(hits):
        return Estimated(float("nan"), float("nan"))
    yes, no = np.sum(hits) + 1.0, np.sum(~hits) + 1.0  # of the Beta distribution
    error = np.sqrt(yes * no / (yes + no + 1.0)) / (yes + no)
    return Estimated(float(np.mean(hits)), float(error))


def _mean(values: Float) -> Estimated:
    """Return the mean over missions; the steps of a mission are not independent, the missions are."""
    count = len(values)
    error = float(np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else float("nan")
    return Estimated(float(np.mean(values)), error)


def _root(mean: Estimated) -> Estimated:
    root = float(np.sqrt(mean.value))
    return Estimated(root, mean.error / (2.0 * root) if root > 0.0 else 0.0)


def open_fleet(folder: Path | str) -> "dict[str, xr.Dataset]":
    """Return the groups of a fleet by their names.

    Raises
    ------
    RunFolderError, FleetError
        The folder holds no fleet.
    """
    names = [group["name"] for group in fleet_config(Path(folder))["fleet"]["groups"]]
    return {name: open_group(Path(folder), name) for name in names}


def noticed(group: "xr.Dataset", kind: str) -> NDArray[np.int64]:
    """Return how many notices of a kind each twin gave."""
    return np.asarray(group["notices"].values[:, NOTICE_KINDS.index(kind)], dtype=np.int64)


def believed_means(group: "xr.Dataset") -> Float:
    """Return the means of the states of B twins in T steps (B, T, F), SI; NaN where no state is believed."""
    unexplained = group["unexplained"].values > BELIEVED
    return np.where(unexplained[..., np.newaxis], np.nan, group["mean"].values)


def last_steps(group: "xr.Dataset") -> NDArray[np.int64]:
    """Return the last step of each twin: that of a recording may come early."""
    last: NDArray[np.int64] = np.maximum((group["control_index"].values >= 0).sum(axis=1) - 1, 0)
    return last


def severity(scenario: Scenario, mean: Float) -> Float:
    """Return how badly off assets are by the means of their states (..., F): the sum of shares of ranges."""
    low, high = np.array([(factor.levels[0], factor.levels[-1]) for factor in scenario.state]).T
    return np.asarray(((mean - low) / np.where(high > low, high - low, 1.0)).sum(axis=-1))


def attention(knowledge: Knowledge, belief: Float, control: int) -> Float:
    """Return the probability that twins leave a control within the steps that are predicted: (B,).

    Of a policy by states it is that of the state of each step, or of the step behind it where that decides;
    where the belief decides it is of lives that are drawn.

    Parameters
    ----------
    knowledge : Knowledge
        Of the twins.
    belief : (B, S)
        After the last step.
    control : int
        In force then; it stays so until it is left.
    """
    scenario, transition = knowledge.scenario, knowledge.model.transition
    steps = scenario.mission.prediction_steps
    if knowledge.plan.on_belief is not None:
        ahead = transition.forward(control, belief)
        chance = generator(scenario.mission.seed, "planning")
        return leaving_probability(knowledge.problem, knowledge.plan.on_belief, ahead, control, steps, chance)
    keeps = (knowledge.plan.control_index == control).astype(np.float64)
    stays = keeps.copy()
    for _ in range(steps - 1):
        stays = keeps * transition.expected(control, stays)
    if scenario.planner.decide_on == "predicted":
        stays = transition.expected(control, stays)
    return np.asarray(np.maximum(1.0 - belief @ stays, 0.0))


Known = tuple[NDArray[np.int64], Path, Knowledge]
"""The rows of twins in the store, the folder of what they know, and that."""


def known_twins(folder: Path, record: Mapping[str, Any], group: "xr.Dataset") -> Iterator[Known]:
    """Yield the twins of a group that have flown, those together that share what they know.

    Parameters
    ----------
    folder : Path
        Of the fleet.
    record : mapping
        Of the group, as `config.json` has it.
    group : Dataset
        Of the store.

    Raises
    ------
    RunFolderError
        What the twins know is missing or damaged.
    """
    flown = has_flown(group["status"].values)
    places = np.array([place for *_, place in record["members"]])[flown]
    for place in np.unique(places).tolist():
        rows, table = flown[places == place], record["scenarios"][place]
        home = folder / GROUPS / record["name"] / str(place)
        yield rows, home, load_knowledge(home, Scenario.model_validate(table).moved(home))


def leaving(folder: Path, record: Mapping[str, Any], group: "xr.Dataset") -> Float:
    """Return the probability that each twin of a group leaves its control soon, see `attention`: (B,).

    It is NaN of twins that have not flown, and where no state is believed. Parameters and errors are those of
    `known_twins`.
    """
    chance, belief = np.full(group.sizes["twin"], np.nan), group["belief"].values.astype(np.float64)
    control = group["control_index"].values[np.arange(len(chance)), last_steps(group)]
    for rows, _, knowledge in known_twins(folder, record, group):
        for index in np.unique(control[rows]).tolist():
            mine = rows[control[rows] == index]
            chance[mine] = attention(knowledge, belief[mine], index)
    last = np.arange(len(chance)), last_steps(group)
    chance[group["unexplained"].values[last] > BELIEVED] = np.nan
    return chance


def group_figures(group: "xr.Dataset") -> dict[str, Estimated | int]:
    """Return the figures of a group by their titles; a mean has its standard error over the twins."""
    status = group["status"].values
    found: dict[str, Estimated | int] = {
        "twins": len(status),
        "flown": int(np.sum(status == FLOWN)),
        "failed in flight": int(np.sum(status == FAILED)),
        **({"ended early": short} if (short := int(np.sum(status == ENDED))) else {}),
    }
    alarmed, left_out = (int(np.sum(noticed(group, kind) > 0)) for kind in NOTICE_KINDS)
    found |= {"raised an alarm": alarmed} if group.attrs.get("gives_notice") else {}
    found |= {"left a gauge out": left_out} if left_out else {}
    if not len(has_flown(status)):
        return found
    study = Outcomes.of(group)
    if not np.isnan(study.bias[0].value):  # of real assets nobody knows the truth
        if not np.isnan(study.within.value):
            step = f"{group.attrs['step_name']}s"
            found[f"fallback within {WITHIN} {step}, of those called for"] = study.within
        if not np.isnan(study.early.value):
            found["early fallback"] = study.early
        for name, rms, bias in zip(group.attrs["factors"], study.rms, study.bias, strict=True):
            found[f"filtered rms error of {name}"], found[f"bias of {name}"] = rms, bias
        found["log evidence of a step"] = study.evidence
        found["true state in the 90 % set"] = study.credible
        return found
    return found | {"log evidence of a step": study.evidence}


def figure_rows(groups: Mapping[str, Mapping[str, Estimated | int]]) -> list[list[str]]:
    """Return the figures of groups as rows of a table: the title, and what each group has."""
    titles = dict.fromkeys(title for figures in groups.values() for title in figures)
    return [[title, *(_shown(figures.get(title)) for figures in groups.values())] for title in titles]


def _shown(figure: Estimated | int | None) -> str:
    """Return a figure for people."""
    if figure is None:
        return ""
    if isinstance(figure, int):
        return str(figure)
    error = f" ± {figure.error:.2g}" if np.isfinite(figure.error) else ""  # one twin has none
    return f"{figure.value:.4g}{error}"
