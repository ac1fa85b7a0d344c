"""The layout of a fleet's store: groups, names, axes and units are those of a run's `run.nc`.

`store/run.toml` lists the variables. Stores of earlier versions, whose variables stood in one group
under other names, are read in the present layout.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from math import prod
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from reporting.arrays import AnyArray, Float, Index
from reporting.json_file import JsonObject
from reporting.netcdf import Variable
from twin_master.scenario.schema import Scenario
from twin_master.store.schema import (
    SCHEMA,
    coordinate_variables,
    coordinates_of_axes,
    described_variable,
    scenario_fields,
)

if TYPE_CHECKING:
    import xarray as xr

NOTICE_KINDS = ("alarm", "gauge_left_out")
"""The kinds of notices that are kept of each twin."""

BLOCK_TWINS = 256
"""Twins that are read together at least, which is the usual number in a chunk of the store."""
_VALUES_TOGETHER = 200_000
"""Steps of twins that are read together at most, unless `BLOCK_TWINS` have more."""
TWIN_AXIS = "twin"
"""The dimension with a row for each twin, and the coordinate with their names."""
_NO_CONTROL = -1
"""Value of `control_index` in steps that were not flown."""
_NO_STEP = -1
"""Value of `notice/first_step` for a kind of notice that was never given."""
_FILL_VALUES = {"observed/control_index": _NO_CONTROL, "notice/first_step": _NO_STEP}
"""Values of twins that have not flown, for variables in which 0 has a meaning."""

FORMER_DIMENSIONS = {
    "turn": "step",
    "factor": "region",
    "level": "state",
}
"""The present name of each dimension of a store of an earlier version."""
FORMER_PATHS = {
    "control_index": "observed/control_index",
    "mean": "filtered/mean",
    "standard_deviation": "filtered/standard_deviation",
    "log_evidence": "filtered/log_evidence",
    "belief": "filtered/last_probability",
    "state": "truth/state",
    "unexplained": "notice/none_of_these",
    "notices": "notice/count",
    "first_notice": "notice/first_step",
}
"""The present path of each variable that had another name in a store of an earlier version."""
_FORMER_OBSERVED = "observed"
"""The former variable with the sensors and, behind them, what else was read in a step."""


class StoredVariable(NamedTuple):
    """A variable of the store.

    Attributes
    ----------
    axes : tuple of str
        Its dimensions beside `twin`.
    unit, title : str
        Its unit and its name in words.
    dtype : str
        The type of its values, such as "f4".
    fill_value : float
        The value of twins that have not flown.
    """

    axes: tuple[str, ...]
    unit: str
    title: str
    dtype: str
    fill_value: float

    @property
    def attributes(self) -> dict[str, str]:
        """The attributes of the variable, as those of a run."""
        return {"units": self.unit, "long_name": self.title}


def dimension_sizes(scenario: Scenario) -> dict[str, int]:
    """Return the sizes of the store's dimensions for a scenario, by name."""
    observation = scenario.observation
    return {
        "step": scenario.mission.steps,
        "sensor": observation.count,
        "pair": observation.width - observation.count,
        "region": len(scenario.state),
        "notice_kind": len(NOTICE_KINDS),
        "state": prod(len(factor.levels) for factor in scenario.state),
    }


def stored_layout(scenario: Scenario, parameters: Sequence[str] = ()) -> dict[str, StoredVariable]:
    """Return the variables that the store of a fleet has for a group of assets.

    They are listed in the schema, a table that has a row with axes, unit, title and type for each
    variable. Path and row are templates: a field in braces is filled in for the scenario, and a
    path with the field of a reading or a parameter stands for a variable of each of them.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the group.
    parameters : sequence of str
        The names of the true parameters that differ from twin to twin.

    Returns
    -------
    dict of str to StoredVariable
        The variables by their paths in the group.
    """
    common_fields = scenario_fields(scenario)
    layout = {}
    for path_template, row_templates in SCHEMA["fleet"].items():
        for own_fields in _fields_of_entries(path_template, scenario, parameters):
            fields = common_fields | own_fields
            path = path_template.format(**fields)
            axes, unit, title, dtype = (template.format(**fields) for template in row_templates)
            usual_fill_value = np.nan if dtype[0] == "f" else 0
            fill_value = _FILL_VALUES.get(path, usual_fill_value)
            layout[path] = StoredVariable(tuple(axes.split()), unit, title, dtype, fill_value)
    return layout


def _fields_of_entries(
    template: str, scenario: Scenario, parameters: Sequence[str]
) -> Iterator[dict[str, str]]:
    """Yield for each variable that one row of the schema describes the values of its fields."""
    if "{reading}" in template:
        for reading in scenario.inspection_readings:
            yield {"reading": reading.name, "unit": scenario.state[reading.state_index].unit}
    elif "{parameter}" in template:
        for parameter in parameters:
            yield {"parameter": parameter}
    elif "_covariance" not in template or scenario.observation.modes is not None:
        yield {}


def twin_coordinate(names: Sequence[str]) -> Variable:
    """Return the coordinate with the names of twins."""
    labels = np.array(names, dtype=np.dtypes.StringDType())
    return described_variable(SCHEMA["fleet_coordinates"][TWIN_AXIS], labels, {})


def coordinates_of_groups(
    layout: Mapping[str, StoredVariable], scenario: Scenario
) -> dict[str, dict[str, Variable]]:
    """Return for each group of a store the coordinates of all axes that its variables have.

    The names of the twins are not among them: the outermost group alone has them, and the groups
    inside it inherit them, so that the store has a million names once.

    Parameters
    ----------
    layout : mapping of str to StoredVariable
        The variables by their paths.
    scenario : Scenario
        The scenario of the group of assets.

    Returns
    -------
    dict of str to dict
        The coordinates by name, for each group by its path; the path of the outermost one is empty.
    """
    steps = np.arange(scenario.mission.steps)
    coordinates = coordinate_variables(scenario, steps, {"notice_kind": NOTICE_KINDS})
    axes_of_group: dict[str, set[str]] = {}
    for path, variable in layout.items():
        group, _, _ = path.rpartition("/")
        axes_of_group.setdefault(group, set()).update(variable.axes)
    return {group: coordinates_of_axes(coordinates, axes) for group, axes in axes_of_group.items()}


def observed_columns(scenario: Scenario) -> dict[str, slice | int]:
    """Return where each observed variable stands in the row of observations of a step.

    Returns
    -------
    dict of str to slice or int
        The columns of the sensors and of the covariance of modes, and the column of each reading
        of an inspection, by the paths of the variables.
    """
    observation = scenario.observation
    columns: dict[str, slice | int] = {f"observed/{observation.role}": slice(observation.count)}
    if observation.modes is not None:
        covariance = slice(observation.count, observation.width)
        columns[f"observed/{observation.role}_covariance"] = covariance
    for number, reading in enumerate(scenario.inspection_readings):
        columns[f"observed/{reading.name}"] = observation.width + number
    return columns


ALL_ROWS = slice(None)
"""All twins of a group."""


def stored_values(group: "xr.DataTree", path: str, rows: slice = ALL_ROWS) -> AnyArray:
    """Return the values of a variable in some rows of a group of a store, given its path."""
    variable = cast("xr.DataArray", group[path])
    values: AnyArray = np.asarray(variable[rows].values)
    return values


def row_blocks(group: "xr.DataTree") -> Iterator[slice]:
    """Yield the rows of a group of a store, block by block.

    A fleet has more values than fit in memory; those of a block always do.
    """
    twin_count = group.sizes[TWIN_AXIS]
    step_count = group["observed"].sizes["step"]
    blocks_of_chunks = max(1, _VALUES_TOGETHER // (BLOCK_TWINS * step_count))
    length = BLOCK_TWINS * blocks_of_chunks
    for first_row in range(0, twin_count, length):
        yield slice(first_row, min(first_row + length, twin_count))


def observation_rows(group: "xr.DataTree", scenario: Scenario, twins: slice = ALL_ROWS) -> Float:
    """Return the rows of observations of some twins of a group, a (B, T, W) array.

    A row has the values of the sensors, the covariance of modes, and the readings of inspections.
    """
    twin_count = len(range(group.sizes["twin"])[twins])
    rows = np.empty((twin_count, scenario.mission.steps, scenario.row_width))
    for path, columns in observed_columns(scenario).items():
        rows[..., columns] = stored_values(group, path, twins)
    return rows


def is_former_layout(dataset: "xr.Dataset") -> bool:
    """Return whether the group of a store was written by an earlier version."""
    return not FORMER_PATHS.keys().isdisjoint(dataset.data_vars)


def in_present_layout(
    dataset: "xr.Dataset", scenario: Scenario, twins: Sequence[str] | None
) -> "xr.DataTree":
    """Return a group of a store of an earlier version in the present layout.

    Parameters
    ----------
    dataset : Dataset
        The group, whose variables have their former names.
    scenario : Scenario
        The scenario of the group.
    twins : sequence of str or None
        The names of the twins; None if they are not wanted.
    """
    import xarray as xr

    dimensions = {
        former_name: present_name
        for former_name, present_name in FORMER_DIMENSIONS.items()
        if former_name in dataset.dims
    }
    variables = {}
    for name, stored_variable in dataset.data_vars.items():
        variable = stored_variable.rename(
            {
                former_name: present_name
                for former_name, present_name in dimensions.items()
                if former_name in stored_variable.dims
            }
        )
        if name == _FORMER_OBSERVED:
            for path, columns in observed_columns(scenario).items():
                variables[path] = variable.isel(sensor=columns)
            continue
        path = FORMER_PATHS.get(str(name), str(name))
        if path not in SCHEMA["fleet"]:  # a true parameter
            path = f"truth/{name}"
        variables[path] = variable
    parameters = [path.partition("/")[2] for path in variables if path.startswith("truth/")]
    layout = stored_layout(scenario, [name for name in parameters if name != "state"])
    groups: dict[str, JsonObject] = {"": {}}
    for path, variable in variables.items():
        group, _, name = path.rpartition("/")
        entry = variable.variable.copy(deep=False)
        entry.attrs = layout[path].attributes
        groups.setdefault(group, {})[name] = entry
    datasets = {}
    coordinates = coordinates_of_groups(layout, scenario)
    if twins is not None:
        coordinates[""][TWIN_AXIS] = twin_coordinate(twins)
    for group, entries in groups.items():
        labels = {
            name: xr.Variable(coordinate.dims, coordinate.values, dict(coordinate.attrs))
            for name, coordinate in coordinates[group].items()
        }
        datasets[f"/{group}"] = xr.Dataset(entries, labels)
    datasets["/"].attrs.update(dataset.attrs)
    return xr.DataTree.from_dict(datasets)


def former_names_used(dataset: "xr.Dataset") -> Mapping[str, str]:
    """Return the present name of each former name that the group of a store has.

    Names of dimensions come first, then those of variables, which become paths.
    """
    dimensions = {
        name: present_name
        for name, present_name in FORMER_DIMENSIONS.items()
        if name in dataset.dims
    }
    paths = {name: path for name, path in FORMER_PATHS.items() if name in dataset.data_vars}
    return dimensions | paths


class ObservedTwins(NamedTuple):
    """The observations of some twins of one scenario in T steps.

    Attributes
    ----------
    observed : (B, T, G + I) array
        The readings of sensors and inspections in SI units; NaN where there is none.
    control : (B, T) array
        The control in force in each step.
    """

    observed: Float
    control: Index


class StoredObservations:
    """The observations of a group in the store, read by blocks of twins.

    A fleet may have more observations than fit in memory. The last block is kept, because the twins
    of a block may have scenarios of their own.
    """

    def __init__(self, group: "xr.DataTree", scenario: Scenario) -> None:
        self._group = group
        self._scenario = scenario
        self._block = lru_cache(maxsize=1)(self._read_block)

    def blocks(self, rows: Index) -> Iterator[ObservedTwins]:
        """Yield the observations of the twins in the rows of the store (B,), in ascending order."""
        for number in np.unique(rows // BLOCK_TWINS).tolist():
            rows_of_block = rows[rows // BLOCK_TWINS == number] - number * BLOCK_TWINS
            observed, control = self._block(number)
            yield ObservedTwins(observed[rows_of_block], control[rows_of_block])

    def _read_block(self, number: int) -> ObservedTwins:
        """Return the observations of all twins of a block."""
        rows = slice(number * BLOCK_TWINS, (number + 1) * BLOCK_TWINS)
        control = stored_values(self._group, "observed/control_index", rows).astype(np.int64)
        # Steps that were not flown have the control -1. They have no observations, so that the
        # evidence does not depend on their control: the first control takes its place.
        return ObservedTwins(
            observation_rows(self._group, self._scenario, rows), np.maximum(control, 0)
        )
