"""The schema of stored results, `run.toml`, for the `run.nc` of a run and the store of a fleet."""

import tomllib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import AnyArray, Index
from reporting.formats.netcdf import NetcdfGroup, Variable
from twin_master.scenario.schema import Scenario

SCHEMA: dict[str, dict[str, list[str]]] = tomllib.loads(
    Path(__file__).with_name("run.toml").read_text(encoding="utf-8")
)
"""Axes, unit and meaning of every variable of `run.nc` and of a fleet's store, by its group.

The table `quantities` holds the titles of learnt quantities, see `quantity_titles`.
"""
FIELDS_OF_BELIEFS = {
    "filtered": {"lead": "step", "given": "observations up to the step"},
    "smoothed": {"lead": "step", "given": "all observations"},
    "predicted": {
        "lead": "step horizon",
        "given": "observations up to the step, through the policy",
    },
}
"""The groups that share the variables of a belief, with the words for their fields in braces."""
SEVERAL_UNITS = "see sensor_unit"
"""The unit of a variable over sensors of different units."""


def rows_of_group(group: str) -> dict[str, list[str]]:
    """Return axes, unit and meaning of the variables of a group of `run.nc`, by name."""
    rows = SCHEMA[group]
    if group == "filtered":
        rows = SCHEMA["noise"] | rows
    if group in FIELDS_OF_BELIEFS:
        rows = SCHEMA["belief"] | rows
    return rows


def fleet_rows() -> dict[str, list[str]]:
    """Return axes, unit, meaning and type of the variables of a fleet's store, by path."""
    rows = {}
    for path, row in SCHEMA["fleet"].items():
        group, _, name = path.partition("/")
        is_of_run = len(row) == 1
        if is_of_run:
            words = FIELDS_OF_BELIEFS.get(group, {})
            texts = rows_of_group(group)[name]
            for field, word in words.items():
                texts = [text.replace(f"{{{field}}}", word) for text in texts]
            row = [*texts, *row]
        rows[path] = row
    return rows


def variable_paths(role: str) -> list[str]:
    """Return the paths in `run.nc` of the variables that every run has, such as "filtered/mean".

    Parameters
    ----------
    role : str
        The role of the observation, such as "strain".
    """
    paths = [f"observed/{role}"]
    for group in ("observed", "filtered", "smoothed", "predicted", "policy", "calibration"):
        # A name with braces is a template, such as "{input}": its variables differ between runs.
        # Runs of earlier versions do not have the noise.
        names = [name for name in rows_of_group(group) if "{" not in name]
        paths += [f"{group}/{name}" for name in names if name not in SCHEMA["noise"]]
    return paths


def scenario_fields(scenario: Scenario) -> dict[str, str]:
    """Return the words of a scenario that replace fields in braces of the schema.

    They are the role of the observation and the units of sensors and state. Sensors of different
    units have the unit `SEVERAL_UNITS`, and factors of different units all of these with commas.
    """
    sensor_units = {*scenario.observation.sensor_units}
    return {
        "role": scenario.observation.role,
        "sensor_unit": SEVERAL_UNITS if len(sensor_units) > 1 else sensor_units.pop(),
        "state_unit": ", ".join(dict.fromkeys(factor.unit for factor in scenario.state)),
    }


class Entry(NamedTuple):
    """A variable to store.

    Attributes
    ----------
    name : str
        Its name in the schema, perhaps with fields in braces.
    values : array
        Its values.
    fields : mapping of str to str
        The values of its fields.
    """

    name: str
    values: ArrayLike
    fields: Mapping[str, str] = MappingProxyType({})


def observed_entries(scenario: Scenario, rows: AnyArray) -> Iterator[Entry]:
    """Yield the observed variables of the group `observed`, from rows of observations (..., W).

    A row has the values of the sensors, the covariance of identified modes if the sensors are
    modes, and the readings of inspections.
    """
    observation = scenario.observation
    yield Entry("{role}", rows[..., : observation.count])
    if observation.modes is not None:
        yield Entry("{role}_covariance", rows[..., observation.count : observation.width])
    for number, reading in enumerate(scenario.inspection_readings):
        fields = {"reading": reading.name, "unit": scenario.state[reading.state_index].unit}
        yield Entry("{reading}", rows[..., observation.width + number], fields)


def described_variable(
    row: Iterable[str], values: ArrayLike, fields: Mapping[str, str]
) -> Variable:
    """Return a variable with axes, unit and title from a row of the schema.

    The fields in braces of the row are filled in.
    """
    axes, unit, title = (template.format(**fields) for template in row)
    units = {"units": unit} if unit else {}
    return Variable(tuple(axes.split()), np.asarray(values), {**units, "long_name": title})


def described_variables(
    group: str, entries: Iterable[Entry], fields: Mapping[str, str]
) -> dict[str, Variable]:
    """Return the variables of a group of `run.nc` by their paths.

    Names and attributes in the schema have fields in braces. They are filled with the given
    `fields`, those of the group and those of the entry; of one name, the last of these holds.
    """
    rows = rows_of_group(group)
    variables = {}
    for entry in entries:
        all_fields = {**fields, **FIELDS_OF_BELIEFS.get(group, {}), **entry.fields}
        path = f"{group}/{entry.name.format(**all_fields)}"
        variables[path] = described_variable(rows[entry.name], entry.values, all_fields)
    return variables


def coordinate_variables(
    scenario: Scenario, steps: Index, labels: Mapping[str, ArrayLike]
) -> dict[str, Variable]:
    """Return the coordinates of stored results by name.

    Parameters
    ----------
    scenario : Scenario
        The scenario: it has sensors, regions and the levels of the state.
    steps : (T,) array
        The numbers of the steps.
    labels : mapping of str to array
        The labels of the other axes that only a run or only a fleet has.
    """
    observation = scenario.observation
    all_labels: dict[str, ArrayLike] = {
        "step": steps,
        "sensor": np.arange(1, observation.count + 1),
        "region": scenario.state_names,
        **labels,
    }
    if len({*observation.sensor_units}) > 1:
        all_labels["sensor_unit"] = observation.sensor_units
    if observation.titles:
        all_labels["sensor_title"] = observation.titles
    rows = SCHEMA["coordinates"] | SCHEMA["fleet_coordinates"]
    coordinates = {
        name: described_variable(rows[name], values, {}) for name, values in all_labels.items()
    }
    # The level of each factor in each joint state, of which the last factor varies fastest.
    grids = np.meshgrid(*(factor.levels for factor in scenario.state), indexing="ij")
    for grid, factor in zip(grids, scenario.state, strict=True):
        fields = {"factor": factor.name, "factor_unit": factor.unit}
        coordinates[factor.name] = described_variable(rows["{factor}"], grid.ravel(), fields)
    return coordinates


def in_groups(
    variables: Mapping[str, Variable], coordinates: Mapping[str, Variable]
) -> dict[str, NetcdfGroup]:
    """Sort variables into their groups, each with the coordinates along the axes that it has.

    Parameters
    ----------
    variables : mapping of str to Variable
        The variables by path; one outside of all groups is in the group "".
    coordinates : mapping of str to Variable
        All coordinates by name.
    """
    variables_of_group: dict[str, dict[str, Variable]] = {}
    for path, variable in variables.items():
        group, _, name = path.rpartition("/")
        variables_of_group.setdefault(group, {})[name] = variable
    groups = {}
    for group, variables_by_name in variables_of_group.items():
        axes = {axis for variable in variables_by_name.values() for axis in variable.dims}
        labels = {name: entry for name, entry in coordinates.items() if axes.issuperset(entry.dims)}
        groups[group] = NetcdfGroup(variables_by_name, labels)
    return groups
