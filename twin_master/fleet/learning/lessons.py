"""The results of learning from a fleet, as the file `learnt.toml` and as rows of a table."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reporting.files import atomic_write_text
from reporting.formats.toml_file import toml_text
from reporting.json_file import JsonObject, JsonRecord
from reporting.words import counted
from twin_master.fleet.configuration import fleet_config

LESSONS_NAME = "learnt.json"
"""The file in the folder of a fleet that holds what was learnt from it, for its report."""
HEADING = """\
# Learnt by `uav-twin fleet learn`. Fly with it: `uav-twin run SCENARIO --learnt THIS_FILE`, or
# `learnt = "THIS_FILE"` in a group of a fleet.
"""

Record = JsonRecord
"""A part of the record that `learn_from_fleet` returns."""


def write_learnt(path: Path, folder: Path, record: Record) -> Path:
    """Write `learnt.toml`, whose tables replace those of a scenario.

    The first tables are for a new asset. They have the mean probabilities of worsening that the
    groups share, and the noise and the distribution of the parameter of the group with most twins.
    If there are several groups, each has tables of its own as well. All numbers are in SI units.

    Parameters
    ----------
    folder : Path
        The folder of the fleet, whose configuration has the assumed noise.
    record : mapping
        As `learn_from_fleet` returns it.
    """
    groups = record["groups"]
    scenarios = {}
    for group in fleet_config(folder)["fleet"]["groups"]:
        scenarios[group["name"]] = group["scenarios"][0]
    largest = max(groups, key=lambda name: groups[name]["twins"])
    shared_means = record.get("shared", groups[largest]["probability"])
    content: JsonObject = {
        "format": 1,
        "source": record["source"],
        **_scenario_tables(groups[largest], shared_means, scenarios[largest]),
    }
    if len(groups) > 1:
        content["group"] = {
            name: _scenario_tables(group, group["probability"], scenarios[name])
            for name, group in groups.items()
        }
    return atomic_write_text(path, HEADING + toml_text(content))


def _scenario_tables(group: Record, means: Record, scenario: Record) -> JsonObject:
    """Return the tables by which a group's results replace assumptions of its scenario.

    `means` has the mean of each probability, of the group or shared by all groups.
    """
    tables: JsonObject = {}
    # Probabilities of worsening by control, or by control and factor. For a control that was never
    # flown nothing was learnt: its probability is the assumed one.
    probability: JsonObject = {}
    for name, learnt in group["probability"].items():
        mean = means[name]["mean"] if learnt["flown"] else learnt["assumed"]
        control, _, factor = name.partition(", ")
        if factor:
            probability.setdefault(control, {})[factor] = mean
        else:
            probability[control] = mean
    if probability:
        tables["transition"] = {"probability": probability}
    assumed_noise = np.asarray(scenario["observation"]["standard_deviation"])
    noise = assumed_noise * group["noise_factor"]["mean"]
    tables["observation"] = {"standard_deviation": noise.tolist()}
    population = group.get("population")
    if population:
        # The predictive variance of an asset without observations is a sum: that of the population
        # (the square of its posterior mean, plus its posterior variance), and the posterior
        # variance of the mean.
        deviation = population["spread"]
        deviation_of_new_asset = float(
            np.linalg.norm(
                [
                    deviation["mean"],
                    deviation["standard_deviation"],
                    population["mean"]["standard_deviation"],
                ]
            )
        )
        tables["calibration"] = {
            "parameter": population["parameter"],
            "mean": population["mean"]["mean"],
            "standard_deviation": deviation_of_new_asset,
        }
    return tables


class LessonRow(NamedTuple):
    """A row of the table of learnt quantities.

    Attributes
    ----------
    group : str
        Name and size of the group in its first row; empty in the others.
    assumed, mean, interval : str
        The assumed value, the learnt mean and its 95 % interval.
    """

    group: str
    quantity: str
    assumed: str
    mean: str
    interval: str


def lesson_rows(record: Record) -> list[LessonRow]:
    """Return the learnt quantities of all groups as rows of a table."""
    rows = []
    for name, group in record["groups"].items():
        first_row, *other_rows = _group_rows(group)
        heading = f"{name}, {counted(group['twins'], 'twin')}"
        if group["alarmed"]:
            heading += f", {group['alarmed']} with an alarm"
        rows.append(first_row._replace(group=heading))
        rows += other_rows
    for control, mean_over_groups in record.get("shared", {}).items():
        mean = mean_over_groups["mean"]
        deviation = mean_over_groups["standard_deviation"]
        title = f"mean over groups, {control}"
        rows.append(LessonRow("all groups", title, "", f"{mean:.4f} ± {deviation:.2g}", ""))
    return rows


def _group_rows(group: Record) -> Iterator[LessonRow]:
    """Yield the rows of a group: probabilities of worsening, noise, and population moments."""
    for control, probability in group["probability"].items():
        title = f"probability to worsen, {control}"
        assumed = probability["assumed"]
        if not probability["flown"]:
            yield LessonRow("", title, f"{assumed:.4f}", "", "not flown")
            continue
        low = probability["lower_95"]
        high = probability["upper_95"]
        outside = "" if low <= assumed <= high else " (outside)"
        yield LessonRow(
            group="",
            quantity=title,
            assumed=f"{assumed:.4f}{outside}",
            mean=f"{probability['mean']:.4f}",
            interval=f"{low:.4f} to {high:.4f}",
        )
    if "transitions_kept_because" in group:
        yield LessonRow("", "transitions", "as assumed", "not learnt", "")
    yield _value_row("noise over the assumed", "1", group["noise_factor"])
    population = group.get("population")
    if population:
        for moment in ("mean", "spread"):
            title = f"{population['parameter']}, {moment}"
            yield _value_row(title, "", population[moment])


def _value_row(title: str, assumed: str, learnt: Record) -> LessonRow:
    """Return the table row for a quantity: its mean and its interval."""
    interval = f"{learnt['lower_95']:.4g} to {learnt['upper_95']:.4g}"
    return LessonRow("", title, assumed, f"{learnt['mean']:.4g}", interval)
