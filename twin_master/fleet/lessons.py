"""What a fleet has learnt, for people and as `learnt.toml`, with which a scenario is flown."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import atomic_write_text
from reporting.progress import Progress
from reporting.toml_file import toml_text
from reporting.words import counted
from twin_master.fleet.flight import fleet_config
from twin_master.fleet.learn import learn_fleet
from twin_master.run_folder import to_json

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
        control), `noise_factor` and `population`; `shared` over several groups; `source`.

    Raises
    ------
    RunFolderExistsError, FleetError
        There is no fleet, nothing has flown, or its transitions cannot be learnt.
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
    tables: dict[str, Any] = {
        "transition": {"probability": probability},
        "observation": {"standard_deviation": noise.tolist()},
    }
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
