"""An FMU flown without a binding: its default experiment, values by names of variables, files of histories.

Inputs are read from CSV, outputs written as CSV or NetCDF.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from fmu_asset.archive.declared import FmuDescription, VariableInfo
from fmu_asset.errors import BindingError, FmuInputError, said
from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.table_file import TableErrors, read_table, table_text

from .binding import (
    INPUT_ROLES,
    Binding,
    BindingHeader,
    InputBinding,
    ParameterBinding,
    VectorBinding,
)
from .draft import bindable, observable
from .layout import ObservationHistory
from .session import FmiAsset

InputHistories = dict[str, dict[str, Float]]
"""Inputs of N steps by role and name, (N,) or (N, n) for an array: what `FmiAsset.simulate` takes."""

_ELEMENT = re.compile(r"(.+)\[(\d+)\]", re.DOTALL)
_TIME = "time"
# Of the interval between two observations: what a spreadsheet loses when it rounds.
_TIME_TOLERANCE = 1e-6


def read_histories(path: Path, binding: Binding) -> tuple[int, InputHistories]:
    """Return how many steps a CSV file has, and their inputs.

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
    wanted = binding.binding.start_time + binding.interval * np.arange(len(time))
    for step in np.flatnonzero(np.abs(time - wanted) > _TIME_TOLERANCE * binding.interval).tolist():
        times = time[step], wanted[step]
        raise FmuInputError(
            said("inputs.times", path=path, times=times, step=step, binding=binding)
        )
    keys = [(role, name) for role in INPUT_ROLES for name in binding.inputs(role)]
    keys += [
        ("port", f"{name}.{item}")
        for name, port in binding.port.items()
        for item in port.quantities
    ]
    named = Counter(name for _, name in keys)
    # A column may be called by the name alone where it is of one role.
    names = {key[1]: key for key in keys if named[key[1]] == 1} | {
        ".".join(key): key for key in keys
    }
    columns: dict[tuple[str, str], dict[int, Float]] = {}
    for column in table.columns:
        if column == _TIME:
            continue
        key, element = names.get(column), 0
        if key is None and (found := _ELEMENT.fullmatch(column)):
            key, element = names.get(found[1]), int(found[2])
        if key is None:
            known = [".".join(key) for key in dict.fromkeys(names.values())]
            raise FmuInputError(
                said("inputs.no_column", column=column, path=path, to=binding, known=known)
            )
        taken = columns.setdefault(key, {})
        if element in taken or (taken and 0 in (element, *taken)):
            raise FmuInputError(f"{path} gives {'.'.join(key)} in more than one column; keep one.")
        taken[element] = table.numbers(column, "a simulation")
    roles: InputHistories = {}
    for (role, name), elements in columns.items():
        lost = {*range(1, len(elements) + 1)} - elements.keys()
        if lost and 0 not in elements:
            raise FmuInputError(
                f"{path} lacks the column {role}.{name}[{min(lost)}]; count from 1."
            )
        array = np.column_stack([elements[number] for number in sorted(elements)])
        roles.setdefault(role, {})[name] = elements.get(0, array)
    return len(time), roles


def write_history(
    path: Path, asset: FmiAsset, source: tuple[str, str], history: ObservationHistory
) -> None:
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
    observed = dict(zip(asset.binding.observation_variables, history.values.T, strict=True))
    observed[_TIME] = history.time
    atomic_write_text(
        path, table_text({_TIME: history.time, **observed, **(history.extra | observed)})
    )


def _netcdf(asset: FmiAsset, source: tuple[str, str], history: ObservationHistory) -> bytes:
    import xarray as xr

    binding, units = asset.binding, asset.recorded_units
    observed_units = [unit for vector in binding.observation.values() for unit in vector.units]
    extra_units = [units[name] for name in history.extra]
    extra = (
        np.column_stack([*history.extra.values()])
        if history.extra
        else np.empty((len(history.time), 0))
    )
    data = xr.Dataset(
        {
            "observation": (("time", "observation_name"), history.values),
            "observation_unit": ("observation_name", np.array(observed_units, dtype=str)),
            "extra": (("time", "extra_name"), extra),
            "extra_unit": ("extra_name", np.array(extra_units, dtype=str)),
        },
        coords={
            "time": ("time", history.time, {"units": "s", "long_name": "end of the step"}),
            "observation_name": (
                "observation_name",
                np.array(binding.observation_variables, dtype=str),
            ),
            "extra_name": ("extra_name", np.array([*history.extra], dtype=str)),
        },
        attrs={"fmu": source[0], "fmu_sha256": source[1], "binding": binding.name},
    )
    return bytes(data.to_netcdf(engine="h5netcdf"))


_STEPS = 500
_MOST_STEPS = 10_000_000

Value = float | str | list[float] | list[str]
Bound = TypeVar("Bound", InputBinding, ParameterBinding)


class FmuExperiment(NamedTuple):
    """What is simulated.

    Attributes
    ----------
    binding : Binding
        All outputs of the FMU or system, in its units.
    steps : int
        Number of communication steps.
    parameters : dict of str to float or list
        By the binding's names.
    inputs : dict of str to dict of str to float or list
        By role and name; held from the start to the end.
    """

    binding: Binding
    steps: int
    parameters: dict[str, Value]
    inputs: dict[str, Any]


def default_experiment(
    description: FmuDescription,
    *,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: Mapping[str, Value] | None = None,
) -> FmuExperiment:
    """Return the default experiment of an FMU, or what is wanted instead.

    Parameters
    ----------
    description : FmuDescription
        The FMU.
    stop_time : float, optional
        End [s]; the FMU's own, or one second after its start.
    step_size : float, optional
        Communication step size [s]; the FMU's own, or a 500th of the time to the end.
    values : mapping of str to float, str or list, optional
        Parameters (structural ones, too) and inputs by the names of the FMU's variables, in its units. A text
        is read as `value_of_text` does.

    Raises
    ------
    BindingError
        If the FMU has no number to observe, or no parameter or input of a name, or the step is not positive.
    FmuInputError
        If the end does not come after the start, the steps are too many, or a text is no value.
    """
    start = description.start_time or 0.0
    wanted_end = description.stop_time if stop_time is None else stop_time
    end = start + 1.0 if wanted_end is None else wanted_end
    steps, size = _steps_to(start, end, description.step_of(step_size))
    binding = whole_binding(description, step_size=size)
    structural = [v.name for v in description.variables if v.causality == "structuralParameter"]
    known = [*binding.parameter, *binding.load, *structural]
    numbers: dict[str, Value] = {}
    for name, value in (values or {}).items():
        variable = description.variable(name)
        if name not in known or variable is None:
            raise BindingError(
                f"{description.label} has no parameter or input {name!r} that can be set; it has "
                f"{', '.join(known) or 'none'}."
            )
        numbers[name] = value_of_text(variable, value) if isinstance(value, str) else value
    parameters, load, sizes = (
        {name: value for name, value in numbers.items() if name in names}
        for names in (binding.parameter, binding.load, structural)
    )
    # The last step may lead beyond the end that was asked for, where that is not a whole number of steps.
    last_step_end = start + steps * size
    told_end = last_step_end if last_step_end > end + _TIME_TOLERANCE * size else end
    binding = binding.with_header(structural_parameters=sizes, stop_time=told_end)
    return FmuExperiment(binding, steps, parameters, {"load": load})


def value_of_text(variable: VariableInfo, text: str) -> Value:
    """Return the value that a text, as somebody types it, means for a variable.

    Parameters
    ----------
    variable : VariableInfo
        The parameter or input. If it is a text, the text is its value as it stands.
    text : str
        A number, true or false, or the name of an enumeration's item; of an array several with commas.

    Raises
    ------
    FmuInputError
        If it is no such thing.
    """
    if variable.is_text_parameter or text in variable.items:
        return text
    numbers = []
    for word in text.split(","):
        plain = word.strip()
        plain = {"true": "1", "false": "0"}.get(plain, plain)
        try:
            numbers.append(float(variable.items.get(plain, plain)))
        except ValueError:
            wanted = f"one of {variable.item_list}" if variable.items else "a number"
            raise FmuInputError(f"{variable.name} must be {wanted}, but is {text!r}.") from None
    return numbers[0] if len(numbers) == 1 else numbers


def whole_binding(description: FmuDescription, *, step_size: float | None = None) -> Binding:
    """Return a binding of all numbers and text parameters of an FMU, by their own names and in its units.

    Parameters
    ----------
    description : FmuDescription
        The FMU, or a system of several.
    step_size : float, optional
        Communication step size [s]; that of the FMU's default experiment, or 1.

    Raises
    ------
    BindingError
        If the FMU has no number to observe.
    """
    usable = [v for v in description.variables if bindable(v)]

    settable = [*usable, *(v for v in description.variables if v.is_text_parameter)]

    def of(causality: str, kind: type[Bound]) -> dict[str, Bound]:
        found = [v for v in settable if v.causality == causality and v.variability != "constant"]
        return {v.name: kind(variable=v.name, unit=v.unit or "1") for v in found}

    return Binding(
        binding=BindingHeader(
            name=description.model_name or "fmu",
            step_size=description.step_of(step_size) or 1.0,
            start_time=description.start_time or 0.0,
            interface=description.interface,
        ),
        load=of("input", InputBinding),
        parameter=of("parameter", ParameterBinding),
        observation={
            v.name: VectorBinding(variables=(v.name,), unit=v.unit or "1")
            for v in observable(description, usable)
        },
    )


def _steps_to(start: float, end: float, size: float | None) -> tuple[int, float]:
    """Return number and size of the steps to an end: 500 of them where nothing says more.

    Raises
    ------
    FmuInputError
        If the end does not come after the start, or the steps are too many.
    """
    if not (math.isfinite(end) and end > start):
        raise FmuInputError(said("inputs.end", start=start, end=end))
    size = size or (end - start) / _STEPS
    steps = max(1, round((end - start) / size))
    if steps > _MOST_STEPS:
        ends = start, end
        raise FmuInputError(
            said("inputs.most_steps", ends=ends, steps=steps, size=size, most=_MOST_STEPS)
        )
    return steps, size


def ending_with_histories(binding: Binding, steps: int) -> Binding:
    """Return the binding with the end of a file's histories as its stop time, unless it has one.

    Parameters
    ----------
    binding : Binding
        The binding.
    steps : int
        Number of rows of the file: each is a step, but for the first one under linear interpolation.
    """
    header = binding.binding
    moves = steps if header.interpolation == "zero-order" else steps - 1
    if header.stop_time is not None or moves < 1:
        return binding
    return binding.with_header(stop_time=header.start_time + moves * binding.interval)


def run_histories(asset: FmiAsset, steps: int, roles: InputHistories) -> ObservationHistory:
    """Simulate an asset under the histories of a file, as `read_histories` returns them.

    Each row holds over the step that begins at its time. Under linear interpolation lines lead from row to
    row: the first is where the asset starts, and there is a moment for each row.

    Raises
    ------
    FmuInputError
        If there is nothing to lead a line to.
    FmuError
        As `FmiAsset.simulate`.
    """
    if asset.binding.binding.interpolation == "zero-order":
        return asset.simulate(**roles, steps=steps, progress=None)
    if steps < 2:
        raise FmuInputError(said("inputs.one_row"))
    first = {role: {name: v[0] for name, v in table.items()} for role, table in roles.items()}
    rest = {role: {name: v[1:] for name, v in table.items()} for role, table in roles.items()}
    asset.reset(**first)
    return simulate_from_now(asset, steps - 1, rest)


def simulate_from_now(asset: FmiAsset, steps: int, roles: InputHistories) -> ObservationHistory:
    """Return this moment and what comes out of the steps after it."""
    first, then = asset.observe(), asset.simulate(**roles, steps=steps, progress=None)
    return ObservationHistory(
        np.concatenate(([first.time], then.time)),
        np.vstack((first.values, then.values)),
        {
            name: np.concatenate(([first.extra[name]], values))
            for name, values in then.extra.items()
        },
        then.ended,
    )


def run_experiment(asset: FmiAsset, experiment: FmuExperiment) -> ObservationHistory:
    """Start an asset, and return its start and what came out of the steps after it.

    Parameters
    ----------
    asset : FmiAsset or CoupledAsset
        The asset.
    experiment : FmuExperiment
        Steps, parameters and inputs, which hold already in the initialisation.

    Returns
    -------
    ObservationHistory
        N + 1 moments; fewer if the FMU ends the simulation by itself.

    Raises
    ------
    FmuError
        As `FmiAsset.simulate`.
    """
    asset.reset(experiment.parameters, **experiment.inputs)
    return simulate_from_now(asset, experiment.steps, {})
