"""The CSV files of a run, for people: the unit is in each header.

A strain is given in microstrain, a dimensionless state is a fraction and given in percent; anything else
stays in its unit.
"""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reporting.groups import Group

Float = NDArray[np.float64]

MICROSTRAIN = 1.0e6
PERCENT = 100.0

Table = tuple[list[str], list[list[str]]]


def tables_of(groups: Mapping[str, Group], role: str) -> dict[str, str]:
    """Return the text of each CSV file by its name.

    Parameters
    ----------
    groups
        Groups of `run.nc`.
    role
        Name of the observed quantity, such as `strain`.
    """
    steps = [str(step) for step in groups["observed"]["step"].values]
    tables = {
        "observed": _observations(steps, groups["observed"], role, role),
        "estimated": _observations(steps, groups["filtered"], "quantity_mean", role),
        **({"true": _observations(steps, groups["truth"], role, role)} if "truth" in groups else {}),
        "health": _health(steps, groups),
        "decisions": _decisions(steps, groups),
        "policy": _policy(groups),
    }
    return {name: _csv(*table) for name, table in tables.items()}


def _observations(steps: list[str], group: Group, variable: str, role: str) -> Table:
    sensors = group["sensor"].values
    units = [group[variable].attrs["units"]] * len(sensors)
    if "sensor_unit" in group.coords:
        units = _names(group["sensor_unit"].values)
    if role == "strain":
        edges = [_edge(unit, MICROSTRAIN, "microstrain") for unit in units]
    else:
        edges = [(1.0, unit) for unit in units]
    header = ["step", *(f"{role}_{s}_{unit}" for s, (_, unit) in zip(sensors, edges, strict=True))]
    factors = np.array([factor for factor, _ in edges])
    rows = zip(steps, group[variable].values * factors, strict=True)
    return header, [[step, *_numbers(row)] for step, row in rows]


def _health(steps: list[str], groups: Mapping[str, Group]) -> Table:
    kinds = [(kind, name) for kind in ("filtered", "smoothed") for name in ("mean", "standard_deviation")]
    known = [groups["truth"]["state"].values] if "truth" in groups else []
    columns = [*known, *(groups[kind][name].values for kind, name in kinds)]
    header = ["step"]
    values = np.stack(columns, axis=-1)
    for index, region in enumerate(_names(groups["filtered"]["region"].values)):
        factor, unit = _edge(groups["policy"][region].attrs["units"], PERCENT, "percent")
        header += [f"{region}_true_{unit}"] * len(known)
        header += [f"{region}_{kind}_{name}_{unit}" for kind, name in kinds]
        values[:, index] *= factor
    stacked = values.reshape(len(steps), -1)
    return header, [[step, *_numbers(row)] for step, row in zip(steps, stacked, strict=True)]


def _decisions(steps: list[str], groups: Mapping[str, Group]) -> Table:
    names = _names(groups["policy"]["control"].values)
    flown = groups["observed"]["control_index"].values
    rewards = groups["filtered"]
    asked = rewards["decision_probability"].values
    header = ["step", "control", *(f"{name}_reward" for name in rewards["reward"].values)]
    header += [*(f"decision_probability_{name}" for name in names), "next_control"]
    values = np.column_stack([rewards["reward_mean"].values, asked])
    rows = zip(steps, flown, values, asked.argmax(axis=1), strict=True)
    return header, [[step, names[now], *_numbers(row), names[coming]] for step, now, row, coming in rows]


def _policy(groups: Mapping[str, Group]) -> Table:
    policy = groups["policy"]
    names = _names(policy["control"].values)
    regions = _names(groups["filtered"]["region"].values)
    edges = [_edge(policy[name].attrs["units"], PERCENT, "percent") for name in regions]
    levels = np.stack(
        [policy[n].values * factor for n, (factor, _) in zip(regions, edges, strict=True)], axis=-1
    )
    shown = [f"{name}_{unit}" for name, (_, unit) in zip(regions, edges, strict=True)]
    header = [*shown, "control", *(f"action_value_{n}" for n in names)]
    rows = zip(levels, policy["control_index"].values, policy["action_value"].values, strict=True)
    return header, [[*_numbers(level), names[control], *_numbers(row)] for level, control, row in rows]


def _edge(unit: str, factor: float, name: str) -> tuple[float, str]:
    """Return factor and name of the printed unit of a stored one."""
    return (factor, name) if unit == "1" else (1.0, unit)


def _names(values: NDArray[Any]) -> list[str]:
    return [str(value) for value in values]


def _numbers(values: Iterable[float]) -> list[str]:
    """Return numbers for people; empty where nothing was received."""
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]


def _csv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return buffer.getvalue()
