"""The CSV files of a run, for people: the unit is in each header.

A strain is given in microstrain, a dimensionless state is a fraction and given in percent; anything else
stays in its unit.
"""

import csv
import io
from collections.abc import Mapping
from typing import Any

import numpy as np

from reporting.groups import Group

MICROSTRAIN = 1.0e6
PERCENT = 100.0

Columns = dict[str, Any]
"""Numbers or texts of each column, by its heading."""


def tables_of(groups: Mapping[str, Group], role: str) -> dict[str, str]:
    """Return the text of each CSV file by its name.

    Parameters
    ----------
    groups
        As `groups_of` returns them.
    role
        What is observed.
    """
    steps = {"step": [str(step) for step in groups["observed"]["step"].values]}
    tables = {
        "observed": steps | _observations(groups["observed"], role, role),
        "estimated": steps | _observations(groups["filtered"], "quantity_mean", role),
        **({"true": steps | _observations(groups["truth"], role, role)} if "truth" in groups else {}),
        "health": steps | _health(groups),
        "decisions": steps | _decisions(groups),
        "policy": _policy(groups),
    }
    return {name: _csv(columns) for name, columns in tables.items()}


def _observations(group: Group, variable: str, role: str) -> Columns:
    values, sensors = group[variable].values, group["sensor"].values
    units = [group[variable].attrs["units"]] * len(sensors)
    if "sensor_unit" in group.coords:
        units = [str(unit) for unit in group["sensor_unit"].values]
    columns = {}
    for place, (sensor, unit) in enumerate(zip(sensors, units, strict=True)):
        factor, name = _edge(unit, MICROSTRAIN, "microstrain") if role == "strain" else (1.0, unit)
        columns[f"{role}_{sensor}_{name}"] = factor * values[:, place]
    return columns


def _health(groups: Mapping[str, Group]) -> Columns:
    columns = {}
    for place, region in enumerate(groups["filtered"]["region"].values):
        factor, unit = _edge(groups["policy"][region].attrs["units"], PERCENT, "percent")
        if "truth" in groups:
            columns[f"{region}_true_{unit}"] = factor * groups["truth"]["state"].values[:, place]
        for kind in ("filtered", "smoothed"):
            for name in ("mean", "standard_deviation"):
                columns[f"{region}_{kind}_{name}_{unit}"] = factor * groups[kind][name].values[:, place]
    return columns


def _decisions(groups: Mapping[str, Group]) -> Columns:
    controls, filtered = groups["policy"]["control"].values, groups["filtered"]
    asked = filtered["decision_probability"].values
    rewards = zip(filtered["reward"].values, filtered["reward_mean"].values.T, strict=True)
    return {
        "control": controls[groups["observed"]["control_index"].values],
        **{f"{name}_reward": values for name, values in rewards},
        **{f"decision_probability_{n}": values for n, values in zip(controls, asked.T, strict=True)},
        "next_control": controls[asked.argmax(axis=1)],
    }


def _policy(groups: Mapping[str, Group]) -> Columns:
    policy, columns = groups["policy"], {}
    for region in groups["filtered"]["region"].values:
        factor, unit = _edge(policy[region].attrs["units"], PERCENT, "percent")
        columns[f"{region}_{unit}"] = factor * policy[region].values
    controls = policy["control"].values
    columns["control"] = controls[policy["control_index"].values]
    values = zip(controls, policy["action_value"].values.T, strict=True)
    return columns | {f"action_value_{name}": action for name, action in values}


def _edge(unit: str, factor: float, name: str) -> tuple[float, str]:
    """Return factor and name of the printed unit of a stored one."""
    return (factor, name) if unit == "1" else (1.0, unit)


def _csv(columns: Columns) -> str:
    """Return columns as text for people; a cell is empty where nothing was received."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*map(_cells, columns.values()), strict=True))
    return buffer.getvalue()


def _cells(values: Any) -> list[str]:
    """Return the cells of a column."""
    if isinstance(values[0], str):
        return [str(value) for value in values]
    return ["" if np.isnan(value) else f"{value:.6g}" for value in values]
