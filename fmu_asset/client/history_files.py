"""Histories of a simulation in files: inputs from CSV, outputs to CSV or NetCDF."""

import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmu_asset.errors import FmuInputError
from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.formats.table_file import TableErrors, read_table, table_text
from reporting.words import comma_list

from .binding import INPUT_ROLES, Binding
from .observations import ObservationHistory
from .session import FmiAsset

InputHistories = dict[str, dict[str, Float]]
"""Inputs of N steps for `FmiAsset.simulate`, by role and name: (N,), or (N, n) for an array."""

_ELEMENT = re.compile(r"(?P<name>.+)\[(?P<number>\d+)\]", re.DOTALL)
_TIME = "time"
_TIME_TOLERANCE = 1e-6
"""Largest error of a time, such as a spreadsheet's rounding, as a fraction of the interval between
observations."""
_WHOLE = 0
"""Stands for all of an input in one column, instead of the number of an element (from 1)."""


class _InputName(NamedTuple):
    """Role and name of an input in a binding."""

    role: str
    name: str

    @property
    def full(self) -> str:
        """The name with its role."""
        return f"{self.role}.{self.name}"


def read_histories(path: Path, binding: Binding) -> tuple[int, InputHistories]:
    """Read the number of steps, and the inputs in each step, from a CSV file.

    The first line names the columns. One is `time` [s], which begins at the binding's start time
    and grows by its step size. The others are inputs, such as `control.load_factor`, or only
    `load_factor` if no other role has an input of this name; the elements of an array are `u[1]`,
    `u[2]`, and so on. The values of a line hold over the step that begins at its time.

    Raises
    ------
    FmuInputError
        If the file is missing or no CSV, a column is missing, unknown or there twice, a cell is no
        finite number, or time is uneven.
    """
    table = read_table(path, TableErrors(FmuInputError, FmuInputError))
    time = table.numbers(_TIME, "a simulation")
    _check_times(time, path, binding)
    inputs_by_column_name = _inputs_by_column_name(binding)
    columns_of_input: dict[_InputName, dict[int, Float]] = {}
    for column in table.columns:
        if column == _TIME:
            continue
        input_name, number = _column_meaning(column, inputs_by_column_name)
        if input_name is None:
            # an input may have two names: without and with its role
            full_names = [name.full for name in dict.fromkeys(inputs_by_column_name.values())]
            raise FmuInputError(
                f"The column {column!r} of {path} is not an input of the binding {binding.name}; "
                f"it has {comma_list(full_names)}."
            )
        elements = columns_of_input.setdefault(input_name, {})
        mixes_forms = bool(elements) and (number == _WHOLE or _WHOLE in elements)
        if number in elements or mixes_forms:
            raise FmuInputError(
                f"{path} gives {input_name.full} in more than one column; keep one."
            )
        elements[number] = table.numbers(column, "a simulation")
    histories: InputHistories = {}
    for input_name, elements in columns_of_input.items():
        history = _joined_elements(input_name, elements, path)
        histories.setdefault(input_name.role, {})[input_name.name] = history
    return len(time), histories


def _check_times(time: Float, path: Path, binding: Binding) -> None:
    """Raise an error if times (N,) [s] are not those at which the binding's steps begin."""
    expected_times = binding.binding.start_time + binding.interval * np.arange(len(time))
    wrong_steps = np.flatnonzero(np.abs(time - expected_times) > _TIME_TOLERANCE * binding.interval)
    if len(wrong_steps):
        step = int(wrong_steps[0])
        raise FmuInputError(
            f"{path} has the time {time[step]:.12g} s where step {step} begins at "
            f"{expected_times[step]:.12g} s: the binding {binding.name} starts at "
            f"{binding.binding.start_time:g} s and goes on by {binding.interval:g} s. Resample the "
            "inputs, or change `step_size` or `start_time` in the binding."
        )


def _inputs_by_column_name(binding: Binding) -> dict[str, _InputName]:
    """Map each accepted name of a column to its input of the binding.

    A column has the name of its input with the role, such as `control.load_factor` or
    `port.spring.force`. The name alone, such as `load_factor`, is accepted too if only one role has
    an input of this name.
    """
    inputs = []
    for role in INPUT_ROLES:
        for name in binding.inputs(role):
            inputs.append(_InputName(role, name))
    for port_name, port in binding.port.items():
        for quantity in port.quantities:
            inputs.append(_InputName("port", f"{port_name}.{quantity}"))
    name_counts = Counter(entry.name for entry in inputs)
    short_names = {entry.name: entry for entry in inputs if name_counts[entry.name] == 1}
    full_names = {entry.full: entry for entry in inputs}
    return short_names | full_names


def _column_meaning(
    column: str, known_names: dict[str, _InputName]
) -> tuple[_InputName | None, int]:
    """Return the input that a column belongs to, and the number of its element.

    The input is None if there is none of that name; the number is `_WHOLE` for a column of a whole
    input.
    """
    if column in known_names:
        return known_names[column], _WHOLE
    match = _ELEMENT.fullmatch(column)
    if match is None:
        return None, _WHOLE
    return known_names.get(match["name"]), int(match["number"])


def _joined_elements(input_name: _InputName, elements: dict[int, Float], path: Path) -> Float:
    """Return the history (N,) of an input's own column, or (N, n) of its n elements' columns."""
    if _WHOLE in elements:
        return elements[_WHOLE]
    missing_numbers = {*range(1, len(elements) + 1)} - elements.keys()
    if missing_numbers:
        raise FmuInputError(
            f"{path} lacks the column {input_name.full}[{min(missing_numbers)}]; count from 1."
        )
    return np.column_stack([elements[number] for number in sorted(elements)])


def write_history(
    path: Path, asset: FmiAsset, source: tuple[str, str], history: ObservationHistory
) -> None:
    """Write the outputs of a simulation, as NetCDF if the name ends with .nc, else as CSV.

    The file is written whole or not at all.

    Parameters
    ----------
    source : (str, str)
        Name and SHA-256 of its FMU file.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    if path.suffix == ".nc":
        atomic_write_bytes(path, _netcdf(asset, source, history))
        return
    names = asset.binding.observation_variables
    observed_columns = dict(zip(names, history.values.T, strict=True))
    observed_columns[_TIME] = history.time
    # time first, then observations, then extras of other names
    columns = {_TIME: history.time, **observed_columns, **(history.extra | observed_columns)}
    atomic_write_text(path, table_text(columns))


def _netcdf(asset: FmiAsset, source: tuple[str, str], history: ObservationHistory) -> bytes:
    """Return the NetCDF file of a history; see `write_history`."""
    import xarray as xr

    binding = asset.binding
    observation_units = [unit for vector in binding.observation.values() for unit in vector.units]
    extra_names = [*history.extra]
    extra_units = [asset.recorded_units[name] for name in extra_names]
    extra_values = np.empty((len(history.time), 0))
    if extra_names:
        extra_values = np.column_stack([*history.extra.values()])
    observation_names = np.array(binding.observation_variables, dtype=str)
    file_name, file_hash = source
    data = xr.Dataset(
        {
            "observation": (("time", "observation_name"), history.values),
            "observation_unit": ("observation_name", np.array(observation_units, dtype=str)),
            "extra": (("time", "extra_name"), extra_values),
            "extra_unit": ("extra_name", np.array(extra_units, dtype=str)),
        },
        coords={
            "time": ("time", history.time, {"units": "s", "long_name": "end of the step"}),
            "observation_name": ("observation_name", observation_names),
            "extra_name": ("extra_name", np.array(extra_names, dtype=str)),
        },
        attrs={"fmu": file_name, "fmu_sha256": file_hash, "binding": binding.name},
    )
    return bytes(data.to_netcdf(engine="h5netcdf"))
