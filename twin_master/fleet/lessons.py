"""What a fleet has learnt, for people and as `learnt.toml`, with which a scenario is flown."""

from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import atomic_write_text
from reporting.progress import Progress
from reporting.toml_file import toml_text
from reporting.words import counted
from twin_master.fleet.learn import FleetLessons, learn_fleet
from twin_master.fleet.posterior import Line
from twin_master.run_folder import to_json

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
    lessons = learn_fleet(folder, progress=progress)
    write_learnt(Path(out), lessons)
    record = lessons_record(lessons)
    atomic_write_text(Path(folder) / LESSONS_NAME, to_json(record))
    return record


def write_learnt(path: Path, lessons: FleetLessons) -> Path:
    """Write what takes the place of the tables of a scenario, whole: for a new asset, and for each group.

    A new asset has the means that the groups share, and the population of the parameter over the largest
    group. Figures are in SI.
    """
    own = [[marginal.mean for marginal in lessons.probabilities(n)] for n in range(len(lessons.groups))]
    largest = max(range(len(own)), key=lambda number: lessons.groups[number].twins)
    means = own[largest] if lessons.shared is None else [mean for mean, _ in lessons.shared.mean]
    content = {"format": 1, "source": lessons.source} | _tables(lessons, largest, means)
    if len(own) > 1:
        named = zip(lessons.groups, own, strict=True)
        content["group"] = {group.name: _tables(lessons, n, mean) for n, (group, mean) in enumerate(named)}
    return atomic_write_text(path, HEADING + toml_text(content))


def _tables(lessons: FleetLessons, number: int, means: list[float]) -> dict[str, Any]:
    group = lessons.groups[number]
    probability: dict[str, Any] = {}
    assumptions = group.worsening.assumed.tolist()
    told = zip(group.worsening.keys, means, assumptions, lessons.flown(number), strict=True)
    for (control, factor), learnt, assumed, flown in told:
        mean = learnt if flown else assumed  # of a control that never flew nothing was learnt
        if factor is None:
            probability[control] = mean
        else:
            probability.setdefault(control, {})[factor] = mean
    noise = np.asarray(lessons.scenarios[group.name].observation.standard_deviation) * group.noise.mean
    tables: dict[str, Any] = {
        "transition": {"probability": probability},
        "observation": {"standard_deviation": noise.tolist()},
    }
    if group.population is not None:
        middle, spread = group.population
        total = np.linalg.norm([spread.mean, spread.standard_deviation, middle.standard_deviation])
        tables["calibration"] = {
            "parameter": group.parameter, "mean": middle.mean, "standard_deviation": float(total)
        }  # fmt: skip
    return tables


def lessons_record(lessons: FleetLessons) -> dict[str, Any]:
    """Return what was learnt beside what was assumed, for JSON and the report."""
    groups = {}
    for number, group in enumerate(lessons.groups):
        told = zip(
            group.worsening.names, group.worsening.assumed.tolist(), lessons.flown(number),
            lessons.probabilities(number), strict=True,
        )  # fmt: skip
        found: dict[str, Any] = {
            "twins": group.twins, "left_out": group.unexplained, "alarmed": group.alarmed,
            "probability": {
                name: {"assumed": assumed, "flown": flown, **_figures(marginal)}
                for name, assumed, flown, marginal in told
            },
            "noise_factor": _figures(group.noise),
        }  # fmt: skip
        if group.population is not None:
            mean, spread = map(_figures, group.population)
            found["population"] = {"parameter": group.parameter, "mean": mean, "spread": spread}
        groups[group.name] = found
    record: dict[str, Any] = {"source": lessons.source, "groups": groups}
    if lessons.shared is not None:
        names = lessons.groups[0].worsening.names
        pairs = zip(names, lessons.shared.mean, lessons.shared.concentration, strict=True)
        titles = "mean", "standard_deviation", "log10_concentration", "log10_concentration_standard_deviation"
        record["shared"] = {
            name: dict(zip(titles, (*mean, *size), strict=True)) for name, mean, size in pairs
        }
    return record


def _figures(marginal: Line) -> dict[str, float]:
    low, high = marginal.interval()
    deviation = marginal.standard_deviation
    return {"mean": marginal.mean, "standard_deviation": deviation, "lower_95": low, "upper_95": high}


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
