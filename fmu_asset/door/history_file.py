"""Files of a simulation: the input histories as CSV, the outputs as CSV or NetCDF."""

import csv
import io
import re
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fmu_asset.errors import FmuInputError
from fmu_asset.sentences import said
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.table_file import TableErrors, read_table

from .binding import INPUT_ROLES, Binding
from .layout import ObservationHistory
from .session import FmiAsset

Roles = dict[str, dict[str, npt.NDArray[np.float64]]]

_ELEMENT = re.compile(r"(.+)\[(\d+)\]", re.DOTALL)
_TIME = "time"
# Of the interval between two observations: what a spreadsheet loses when it rounds.
_TIME_TOLERANCE = 1e-6


class InputHistories(NamedTuple):
    """The inputs of N steps.

    Attributes
    ----------
    steps : int
        N.
    roles : dict of str to dict of str to ndarray
        By role and name, (N,) or (N, n) for an array: what `FmiAsset.simulate` takes.
    """

    steps: int
    roles: Roles


def read_histories(path: Path, binding: Binding) -> InputHistories:
    """Read the inputs of all steps from a CSV file.

    The first line names the columns: `time` [s], which begins at the binding's start time and goes on by its
    interval, and inputs as `control.load_factor`, or `load_factor` where no other role has that name; the
    elements of an array are `u[1]`, `u[2]`, .... Each further line holds over the step that begins at its
    time.

    Parameters
    ----------
    path : Path
        The file.
    binding : Binding
        Whose inputs and units these are.

    Raises
    ------
    FmuInputError
        If the file is missing or no CSV, a column is missing, unknown or there twice, a cell is no finite
        number, or time is uneven.
    """
    table = read_table(path, TableErrors(FmuInputError, FmuInputError))
    time = table.numbers(_TIME, "a simulation")
    _check_time(path, time, binding)
    names = _input_names(binding)
    columns: dict[tuple[str, str], dict[int, npt.NDArray[np.float64]]] = {}
    for column in table.columns:
        if column == _TIME:
            continue
        key, element = names.get(column), 0
        if key is None and (found := _ELEMENT.fullmatch(column)):
            key, element = names.get(found[1]), int(found[2])
        if key is None:
            known = [".".join(key) for key in dict.fromkeys(names.values())]
            raise FmuInputError(said("inputs.no_column", column=column, path=path, to=binding, known=known))
        taken = columns.setdefault(key, {})
        if element in taken or (taken and 0 in (element, *taken)):
            raise FmuInputError(f"{path} gives {'.'.join(key)} in more than one column; keep one.")
        taken[element] = table.numbers(column, "a simulation")
    roles: Roles = {}
    for (role, name), elements in columns.items():
        lost = {*range(1, len(elements) + 1)} - elements.keys()
        if lost and 0 not in elements:
            raise FmuInputError(f"{path} lacks the column {role}.{name}[{min(lost)}]; count from 1.")
        array = np.column_stack([elements[number] for number in sorted(elements)])
        roles.setdefault(role, {})[name] = elements.get(0, array)
    return InputHistories(len(time), roles)


def write_history(path: Path, asset: FmiAsset, source: tuple[str, str], history: ObservationHistory) -> None:
    """Write what came out of a simulation, whole or not at all: NetCDF if the name ends with .nc, else CSV.

    Parameters
    ----------
    path : Path
        The file.
    asset : FmiAsset
        The asset that was simulated.
    source : (str, str)
        Name and SHA-256 of its file.
    history : ObservationHistory
        What came out: time at the end of each step, observations and extras.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If the file cannot be written.
    """
    if path.suffix == ".nc":
        atomic_write_bytes(path, _netcdf(asset, source, history))
        return
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([_TIME, *asset.binding.observation_variables, *history.extra])
    rows = np.column_stack([history.time, history.values, *history.extra.values()])
    writer.writerows(rows.tolist())
    atomic_write_text(path, text.getvalue())


def _check_time(path: Path, time: npt.NDArray[np.float64], binding: Binding) -> None:
    wanted = binding.binding.start_time + binding.interval * np.arange(len(time))
    wrong = np.flatnonzero(np.abs(time - wanted) > _TIME_TOLERANCE * binding.interval)
    if wrong.size:
        step = int(wrong[0])
        times = time[step], wanted[step]
        raise FmuInputError(said("inputs.times", path=path, times=times, step=step, binding=binding))


def _input_names(binding: Binding) -> dict[str, tuple[str, str]]:
    """Return role and name by what a column may be called."""
    keys = [(role, name) for role in INPUT_ROLES for name in binding.inputs(role)]
    keys += [("port", f"{name}.{item}") for name, port in binding.port.items() for item in port.quantities]
    times = Counter(name for _, name in keys)
    return {key[1]: key for key in keys if times[key[1]] == 1} | {".".join(key): key for key in keys}


def _netcdf(asset: FmiAsset, source: tuple[str, str], history: ObservationHistory) -> bytes:
    import xarray as xr

    binding, units = asset.binding, asset.recorded_units
    observed_units = [unit for vector in binding.observation.values() for unit in vector.units]
    extra_units = [units[name] for name in history.extra]
    extra = np.column_stack([*history.extra.values()]) if history.extra else np.empty((len(history.time), 0))
    data = xr.Dataset(
        {
            "observation": (("time", "observation_name"), history.values),
            "observation_unit": ("observation_name", np.array(observed_units, dtype=str)),
            "extra": (("time", "extra_name"), extra),
            "extra_unit": ("extra_name", np.array(extra_units, dtype=str)),
        },
        coords={
            "time": ("time", history.time, {"units": "s", "long_name": "end of the step"}),
            "observation_name": ("observation_name", np.array(binding.observation_variables, dtype=str)),
            "extra_name": ("extra_name", np.array([*history.extra], dtype=str)),
        },
        attrs={"fmu": source[0], "fmu_sha256": source[1], "binding": binding.name},
    )
    return bytes(data.to_netcdf(engine="h5netcdf"))
