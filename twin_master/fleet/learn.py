"""What a fleet teaches: how fast damage grows, how noisy the sensors are, how the assets differ.

For people, and as `learnt.toml`, with which a scenario is flown.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reporting.arrays import Float, Index
from reporting.files import atomic_write_text, hash_record
from reporting.progress import Progress, SilentProgress
from reporting.toml_file import toml_text
from reporting.words import counted
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import FleetError, said
from twin_master.fleet.evidence import (
    Worsening,
    node_evidence,
    scaled_likelihood,
    transition_evidence,
    why_transitions_are_kept,
)
from twin_master.fleet.flight import fleet_config, source_of
from twin_master.fleet.posterior import Grid, Line, masses, narrowed, population, refined, shared
from twin_master.fleet.reading import Known, known_twins, noticed
from twin_master.fleet.store import open_group
from twin_master.mission.preparation import Knowledge
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.run_folder import to_json

if TYPE_CHECKING:
    import xarray as xr

NOISE_TWINS = 100
"""Twins of a group from which the noise is learnt: they know it to one part in a few hundred."""
LARGEST_NOISE = 3.0
"""Factor on the assumed noise, and one over it, up to which is looked."""
NOISE_POINTS = 13
NODES, NODE_DEVIATIONS = 61, 6.0
"""Values of the parameter, and how many deviations of its calibration they reach to either side."""


@dataclass(frozen=True)
class _Lessons:
    """What the twins of one group teach, as far as no other group takes part.

    Attributes
    ----------
    worsening : Worsening
        The probabilities and what was assumed of them.
    grid : Grid or None
        Their likelihood; None where the transitions are not learnt.
    flown : set of str
        The controls under which a step was followed by another.
    record : dict
        Of the group, but for the probabilities.
    """

    worsening: Worsening
    grid: Grid | None
    flown: set[str]
    record: dict[str, Any]

    @property
    def marginals(self) -> tuple[Line, ...]:
        """Posterior of each probability under a uniform prior."""
        return () if self.grid is None else self.grid.marginals

    def told(self, lines: Sequence[Line], flown: set[str]) -> dict[str, Any]:
        """Return the record, with the posteriors of the probabilities, and the controls that have flown."""
        told = zip(self.worsening.names, self.worsening.assumed.tolist(), lines, strict=True)
        return self.record | {
            "probability": {
                name: {"assumed": assumed, "flown": name.partition(", ")[0] in flown, **line.figures}
                for name, assumed, line in told
            }
        }


def learn_fleet(folder: Path | str, *, progress: Progress | None = None) -> dict[str, Any]:
    """Return the record of what the store of a fleet teaches, see `learn_from_fleet`; it may still grow.

    The prior of each probability is uniform; that of several groups is a Beta distribution which they share.

    Raises
    ------
    RunFolderError, FleetError
        There is no fleet, nothing has flown, or no state of its twins explains what was observed.
    """
    folder, progress = Path(folder), progress or SilentProgress()
    config = fleet_config(folder)
    records, found = config["fleet"]["groups"], dict[str, _Lessons]()
    with progress.stage("Learning", total=len(records), unit="groups") as stage:
        for record in records:
            group = open_group(folder, record["name"])
            if parts := list(known_twins(folder, record, group)):
                found[record["name"]] = _lessons(record, group, parts)
            stage.advance()
    if not found:
        raise FleetError(f"{folder} holds no twin that has flown to its end: fly the fleet first.")
    names, told = next(iter(found.values())).worsening.names, dict[str, Any]()
    lines, everywhere = [lessons.marginals for lessons in found.values()], set[str]()
    grids = [lessons.grid for lessons in found.values() if lessons.grid is not None]
    are_alike = {each.worsening.names for each in found.values()} == {names}
    if len(grids) > 1 and len(names) <= 2 and are_alike:
        figures, lines = shared(grids)
        everywhere = set().union(*(lessons.flown for lessons in found.values()))
        told = {"shared": dict(zip(names, figures, strict=True))}
    groups = {
        name: lessons.told(own, lessons.flown | everywhere)
        for (name, lessons), own in zip(found.items(), lines, strict=True)
    }
    source = {
        "fleet": config["fleet"]["name"],
        "seed": config["fleet"]["seed"],
        "twins": sum(group["twins"] for group in groups.values()),
        "config": hash_record({key: config[key] for key in ("kind", "format", "fleet")}),
        "program": config["provenance"]["versions"].get("uav-twin", ""),
    }
    return {"source": source, "groups": groups} | told


Seen = tuple[Knowledge, Float, Index]
"""What twins know, what they saw (B, T, G + I), and the control in force (B, T)."""


def _lessons(record: dict[str, Any], group: "xr.Dataset", parts: Sequence[Known]) -> _Lessons:
    """Learn the noise first, for what else is learnt rests on it, then the rates, then the population."""
    _, home, known = parts[0]
    reason = why_transitions_are_kept(known.scenario)
    worsening = Worsening.kept(known.scenario, reason) if reason else Worsening.of(known.scenario)
    controls = known.scenario.control_names
    given = group["control_index"].values.astype(np.int64)
    # Behind the end of a recording nothing is observed, so that any control says the same.
    observed, control = group["observed"].values.astype(np.float64), np.maximum(given, 0)
    seen: list[Seen] = [(knowledge, observed[rows], control[rows]) for rows, _, knowledge in parts]
    nodes = _nodes(home, known, real="recordings" in record) if len(parts) == 1 else None
    noise = _noise(seen, worsening, nodes)
    likely = []
    for knowledge, shown, in_force in seen:
        likelihood = scaled_likelihood(_noisier(knowledge.sensor_model, noise.mean), shown, in_force)[0]
        evidence = transition_evidence(worsening, _possible(worsening)[None], likelihood, in_force)
        explained = np.isfinite(evidence[:, 0])
        likely.append((likelihood[explained], in_force[explained]))
    twins = sum(len(in_force) for _, in_force in likely)
    if not twins:
        raise FleetError(said("fleet.unexplained", group=record["name"]))

    def log_likelihood(points: Float) -> Float:
        return np.asarray(sum(transition_evidence(worsening, points, *some).sum(axis=0) for some in likely))

    grid = refined(log_likelihood, len(worsening.names)) if worsening.names else None
    rows = np.concatenate([rows for rows, *_ in parts])
    alarmed = int(np.sum(noticed(group, "alarm")[rows] > 0))
    told = {"twins": twins, "left_out": len(rows) - twins, "alarmed": alarmed, "noise_factor": noise.figures}
    if worsening.kept_because:
        told["transitions_kept_because"] = worsening.kept_because
    if nodes is not None:
        learnt = np.array([marginal.mean for marginal in grid.marginals]) if grid else worsening.assumed
        each = node_evidence(worsening, learnt, _noisier(known.sensor_model, noise.mean, nodes), *seen[0][1:])
        mean, spread = population(nodes.values, each, known.draws.standard_deviation)
        told["population"] = {"parameter": known.draws.name, "mean": mean.figures, "spread": spread.figures}
    followed = np.unique(given[rows, :-1][given[rows, 1:] >= 0])
    return _Lessons(worsening, grid, {controls[index] for index in followed}, told)


def _possible(worsening: Worsening) -> Float:
    """Return what is assumed, so that any worsening may happen."""
    return worsening.assumed.clip(1e-3, 0.9)


@dataclass(frozen=True)
class _Nodes:
    """Values of the calibrated parameter (E,), their prior (E,), and what the sensors show there."""

    values: Float
    prior: Float
    predicted: Float


def _nodes(folder: Path, known: Knowledge, *, real: bool) -> _Nodes | None:
    """Return values of the parameter about its calibration; None where it is fixed, or no model tells."""
    draws = known.draws
    if draws.standard_deviation <= 0.0:
        return None
    deviations = np.linspace(-NODE_DEVIATIONS, NODE_DEVIATIONS, NODES)
    values = draws.mean + draws.standard_deviation * deviations
    prior = np.exp(-0.5 * deviations**2)
    source = source_of(known.scenario, real=real)
    source.prepare(folder, SilentProgress())
    given = ParameterDraws(draws.name, values, draws.mean, draws.standard_deviation, "nodes")
    predicted = source.observation_table(given, known.model)
    if len(predicted) != NODES:  # a library has draws of its own
        return None
    return _Nodes(values, prior / prior.sum(), predicted)


def _noisier(model: GaussianSensorModel, factor: float, nodes: _Nodes | None = None) -> GaussianSensorModel:
    """Return a sensor model with a factor on its noise, and nodes in the place of its draws."""
    return type(model)(
        model.value_per_draw if nodes is None else nodes.predicted,
        model.standard_deviation * factor,
        average="inside" if model.averages_inside else "outside",
        model_error=model.model_error,
        interval=model.interval,
        **model.extra_arguments,
    )


def _noise(seen: Sequence[Seen], worsening: Worsening, nodes: _Nodes | None) -> Line:
    """Return the posterior of the factor on the assumed noise, uniform in its logarithm before the data.

    The parameter of an asset is the same in all its steps: a twin that draws it anew in each takes a part of
    the noise for it.
    """
    assumed = _possible(worsening)
    some = [(one, shown[:NOISE_TWINS], control[:NOISE_TWINS]) for one, shown, control in seen[:NOISE_TWINS]]

    def log_likelihood(factor: float) -> float:
        total = 0.0
        for knowledge, observed, control in some:
            model = _noisier(knowledge.sensor_model, factor, nodes)
            if nodes is None:
                scaled, common = scaled_likelihood(model, observed, control)
                evidence = transition_evidence(worsening, assumed[None], scaled, control)[:, 0] + common
            else:
                each = node_evidence(worsening, assumed, model, observed, control)
                best = each.max(axis=1, keepdims=True)
                evidence = best[:, 0] + np.log(np.exp(each - best) @ nodes.prior)
            total += float(evidence[np.isfinite(evidence)].sum())
        return total

    bound = np.log(LARGEST_NOISE)
    (axis,), found = narrowed(
        lambda axes: np.array([log_likelihood(float(factor)) for factor in np.exp(axes[0])]),
        (np.linspace(-bound, bound, NOISE_POINTS),),
    )
    return Line(axis, masses(found), np.exp)


_Told = Mapping[str, Any]
LESSONS_NAME = "learnt.json"
"""In the folder of a fleet: what was learnt from it, for its report."""
HEADING = """\
# Learnt by `uav-twin fleet learn`. Fly with it: `uav-twin run SCENARIO --learnt THIS_FILE`, or
# `learnt = "THIS_FILE"` in a group of a fleet.
"""


def learn_from_fleet(
    folder: Path | str, out: Path | str = "learnt.toml", *, progress: Progress | None = None
) -> dict[str, Any]:
    """Learn from all twins of a fleet: how fast damage grows, how noisy sensors are, how assets differ.

    Parameters
    ----------
    folder : Path
        Of the fleet, which may still fly.
    out : Path
        The file to write, for the override ``learnt`` of a mission or the key of that name of a group.
    progress : Progress, optional

    Returns
    -------
    record : dict
        What was learnt beside what was assumed: `groups`, by the name of each, with `probability` (by
        control; else `transitions_kept_because`), `noise_factor` and `population`; `shared` over several
        groups; `source`.

    Raises
    ------
    RunFolderError, FleetError
        There is no fleet, nothing has flown, or no state of its twins explains what was observed.
    """
    record = learn_fleet(folder, progress=progress)
    write_learnt(Path(out), Path(folder), record)
    atomic_write_text(Path(folder) / LESSONS_NAME, to_json(record))
    return record


def write_learnt(path: Path, folder: Path, record: Mapping[str, Any]) -> Path:
    """Write what takes the place of the tables of a scenario, whole: for a new asset, and for each group.

    A new asset has the means that the groups share, and the population of the parameter over the largest
    group. Figures are in SI; what was assumed of the sensors stands in the folder of the fleet.
    """
    groups = record["groups"]
    scenarios = {told["name"]: told["scenarios"][0] for told in fleet_config(folder)["fleet"]["groups"]}
    tables = {name: _tables(group, group["probability"], scenarios[name]) for name, group in groups.items()}
    largest = max(groups, key=lambda name: groups[name]["twins"])
    means = record.get("shared", groups[largest]["probability"])
    new = _tables(groups[largest], means, scenarios[largest])
    content: dict[str, Any] = {"format": 1, "source": record["source"]} | new
    if len(groups) > 1:
        content["group"] = tables
    return atomic_write_text(path, HEADING + toml_text(content))


def _tables(
    group: Mapping[str, Any], means: Mapping[str, Any], scenario: Mapping[str, Any]
) -> dict[str, Any]:
    probability: dict[str, Any] = {}
    for name, told in group["probability"].items():
        # of a control that never flew nothing was learnt
        mean = means[name]["mean"] if told["flown"] else told["assumed"]
        control, _, factor = name.partition(", ")
        if factor:
            probability.setdefault(control, {})[factor] = mean
        else:
            probability[control] = mean
    noise = np.asarray(scenario["observation"]["standard_deviation"]) * group["noise_factor"]["mean"]
    tables: dict[str, Any] = {"transition": {"probability": probability}} if probability else {}
    tables["observation"] = {"standard_deviation": noise.tolist()}
    if learnt := group.get("population"):
        middle, spread = learnt["mean"], learnt["spread"]
        total = np.linalg.norm([spread["mean"], spread["standard_deviation"], middle["standard_deviation"]])
        tables["calibration"] = {
            "parameter": learnt["parameter"], "mean": middle["mean"], "standard_deviation": float(total)
        }  # fmt: skip
    return tables


def lesson_rows(record: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return what was learnt as rows of a table: group, what, assumed, mean, 95 % interval."""
    rows: list[tuple[str, ...]] = []
    for name, group in record["groups"].items():
        heading = f"{name}, {counted(group['twins'], 'twin')}"
        heading += f", {group['alarmed']} with an alarm" if group["alarmed"] else ""
        for control, rate in group["probability"].items():
            mean, interval, off = "", "not flown", ""
            if rate["flown"]:
                low, high = rate["lower_95"], rate["upper_95"]
                mean, interval = f"{rate['mean']:.4f}", f"{low:.4f} to {high:.4f}"
                off = "" if low <= rate["assumed"] <= high else " (outside)"
            title = f"probability to worsen, {control}"
            rows.append((heading, title, f"{rate['assumed']:.4f}{off}", mean, interval))
            heading = ""
        if "transitions_kept_because" in group:
            rows.append((heading, "transitions", "as assumed", "not learnt", ""))
        lines = [("noise over the assumed", "1", group["noise_factor"])]
        if told := group.get("population"):
            lines += [(f"{told['parameter']}, {moment}", "", told[moment]) for moment in ("mean", "spread")]
        for title, assumed, line in lines:
            interval = f"{line['lower_95']:.4g} to {line['upper_95']:.4g}"
            rows.append(("", title, assumed, f"{line['mean']:.4g}", interval))
    for control, told in record.get("shared", {}).items():
        mean = f"{told['mean']:.4f} ± {told['standard_deviation']:.2g}"
        rows.append(("all groups", f"mean over groups, {control}", "", mean, ""))
    return rows
