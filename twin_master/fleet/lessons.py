"""What a fleet has learnt, for people and as `learnt.toml`, with which a scenario is flown."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from reporting.files import atomic_write_text
from reporting.progress import Progress
from twin_master.fleet.learn import FleetLessons, learn_fleet
from twin_master.fleet.posterior import Line
from twin_master.run_folder import to_json

LESSONS_NAME = "learnt.json"
"""In the folder of a fleet: what was learnt from it, for its report."""


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
    lines = [
        "# Learnt by `uav-twin fleet learn`. Fly with it: `uav-twin run SCENARIO --learnt THIS_FILE`, or",
        '# `learnt = "THIS_FILE"` in a group of a fleet.',
        "format = 1",
        f"source = {_inline(lessons.source)}",
        "",
    ]
    largest = max(range(len(lessons.groups)), key=lambda number: lessons.groups[number].twins)
    means = [marginal.mean for marginal in lessons.probabilities(largest)]
    if lessons.shared is not None:
        means = [mean for mean, _ in lessons.shared.mean]
    lines += _tables(lessons, largest, means, "")
    if len(lessons.groups) > 1:
        for number, group in enumerate(lessons.groups):
            own = [marginal.mean for marginal in lessons.probabilities(number)]
            lines += _tables(lessons, number, own, f"group.{group.name}.")
    return atomic_write_text(path, "\n".join(lines))


def _tables(lessons: FleetLessons, number: int, means: list[float], prefix: str) -> list[str]:
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
    assumed = np.asarray(lessons.scenarios[group.name].observation.standard_deviation)
    noise = (assumed * group.noise.mean).tolist()
    lines = [f"[{prefix}transition]", f"probability = {_inline(probability)}", ""]
    lines += [f"[{prefix}observation]", f"standard_deviation = {json.dumps(noise)}", ""]
    if group.population is not None:
        middle, spread = group.population
        total = float(np.hypot(np.hypot(spread.mean, spread.standard_deviation), middle.standard_deviation))
        lines += [f"[{prefix}calibration]", f"parameter = {json.dumps(group.parameter)}"]
        lines += [f"mean = {middle.mean!r}", f"standard_deviation = {total!r}", ""]
    return lines


def _inline(table: dict[str, Any]) -> str:
    """Return a table as TOML in one line."""
    entries = (
        f"{json.dumps(key)} = {_inline(value) if isinstance(value, dict) else json.dumps(value)}"
        for key, value in table.items()
    )
    return f"{{ {', '.join(entries)} }}"


def lessons_record(lessons: FleetLessons) -> dict[str, Any]:
    """Return what was learnt beside what was assumed, for JSON and the report."""
    groups = {}
    for number, group in enumerate(lessons.groups):
        rates = {
            name: {"assumed": float(assumed), "flown": flown, **_figures(marginal)}
            for name, assumed, flown, marginal in zip(
                group.worsening.names,
                group.worsening.assumed,
                lessons.flown(number),
                lessons.probabilities(number),
                strict=True,
            )
        }
        counts = {"twins": group.twins, "left_out": group.unexplained, "alarmed": group.alarmed}
        found: dict[str, Any] = {**counts, "probability": rates}
        found["noise_factor"] = _figures(group.noise)
        if group.population is not None:
            mean, spread = group.population
            found["population"] = {
                "parameter": group.parameter, "mean": _figures(mean), "spread": _figures(spread)
            }  # fmt: skip
        groups[group.name] = found
    record: dict[str, Any] = {"source": lessons.source, "groups": groups}
    if lessons.shared is not None:
        names = lessons.groups[0].worsening.names
        pairs = zip(names, lessons.shared.mean, lessons.shared.concentration, strict=True)
        record["shared"] = {
            name: {
                "mean": mean[0],
                "standard_deviation": mean[1],
                "log10_concentration": size[0],
                "log10_concentration_standard_deviation": size[1],
            }
            for name, mean, size in pairs
        }
    return record


def _figures(marginal: Line) -> dict[str, float]:
    low, high = marginal.interval()
    deviation = marginal.standard_deviation
    return {"mean": marginal.mean, "standard_deviation": deviation, "lower_95": low, "upper_95": high}
