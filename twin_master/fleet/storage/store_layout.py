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
from reporting.formats.netcdf import Variable
from reporting.json_file import JsonObject
from twin_master.scenario.schema import Scenario
from twin_master.store.schema import (
    SCHEMA,
    coordinate_variables,
    described_variable,
    fleet_rows,
    in_groups,
    observed_entries,
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
NO_STEP = -1
"""Value of `notice/first_step` for a kind of notice that was never given."""
_FILL_VALUES = {"observed/control_index": -1, "notice/first_step": NO_STEP}
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


def stored_layout(scenario: Scenario, parameters: Sequence[str] = ()) -> dict[str, Variable]:
    """Return the variables of a twin that has not flown, as the store of a fleet has them.

    Paths and rows of the schema are templates: a field in braces is filled in for the scenario, and
    a path with the field of a reading or a parameter stands for a variable of each of them.

    Parameters
    ----------
    scenario : Scenario
        The scenario of the group.
    parameters : sequence of str
        The names of the true parameters that differ from twin to twin.

    Returns
    -------
    dict of str to Variable
        The variables by their paths in the group, without the axis `twin`.
    """
    common_fields = scenario_fields(scenario)
    sizes = dimension_sizes(scenario)
    # The fields of each variable that a template stands for.
    fields_of_template: dict[str, list[Mapping[str, str]]] = {
        "truth/{parameter}": [{"parameter": parameter} for parameter in parameters],
        "observed/{role}_covariance": [],
        "observed/{reading}": [],
    }
    for entry in observed_entries(scenario, np.arange(scenario.row_width)):
        fields_of_template.setdefault(f"observed/{entry.name}", []).append(entry.fields)
    layout = {}
    for template, (*row, dtype) in fleet_rows().items():
        for own_fields in fields_of_template.get(template, [{}]):
            fields = {**common_fields, **own_fields}
            path = template.format(**fields)
            axes = row[0].split()
            usual_fill_value = np.nan if dtype[0] == "f" else 0
            unflown = np.full(
                [sizes[axis] for axis in axes], _FILL_VALUES.get(path, usual_fill_value), dtype
            )
            layout[path] = described_variable(row, unflown, fields)
    return layout


def twin_coordinate(names: Sequence[str]) -> Variable:
    """Return the coordinate with the names of twins."""
    labels = np.array(names, dtype=np.dtypes.StringDType())
    return described_variable(SCHEMA["fleet_coordinates"][TWIN_AXIS], labels, {})


def coordinates_of_groups(
    layout: Mapping[str, Variable], scenario: Scenario
) -> dict[str, dict[str, Variable]]:
    """Return the coordinates of each group of a layout by name; the outermost group is "".

    The names of the twins are not among them: the outermost group alone has them, and the groups
    inside it inherit them, so that the store has a million names once.
    """
    steps = np.arange(scenario.mission.steps)
    coordinates = coordinate_variables(scenario, steps, {"notice_kind": NOTICE_KINDS})
    return {name: {**group.coords} for name, group in in_groups(layout, coordinates).items()}


def observed_variables(scenario: Scenario, rows: AnyArray) -> dict[str, AnyArray]:
    """Return the observed variables by their paths, from rows of observations (..., W)."""
    variables = {}
    for entry in observed_entries(scenario, rows):
        name = entry.name.format(role=scenario.observation.role, **entry.fields)
        variables[f"observed/{name}"] = np.asarray(entry.values)
    return variables


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
    for path, columns in observed_variables(scenario, np.arange(scenario.row_width)).items():
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
        The group, with former names of variables.
    twins : sequence of str or None
        The names of the twins; None to leave them out.
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
            all_columns = np.arange(scenario.row_width)
            for path, columns in observed_variables(scenario, all_columns).items():
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
        entry.attrs = dict(layout[path].attrs)
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
