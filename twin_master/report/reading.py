"""Reading a run folder into a `RunRecord`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from reporting.errors import DamagedFileError
from reporting.folders import restore_folder
from reporting.json_file import read_json
from reporting.netcdf import read_groups
from twin_master.errors import RunFolderError
from twin_master.report.data import (
    NORMAL_95,
    Estimate,
    LearntCourse,
    PolicyTable,
    RunRecord,
    Uncertain,
    moments,
)
from twin_master.store.mission_result import MOMENTS

Float = NDArray[np.floating[Any]]

_ROUNDING = 1e-6


def read_run(folder: Path) -> RunRecord:
    """Read a run folder.

    Raises
    ------
    RunFolderError
        There is no ``run.nc``, it is damaged, or it has another layout.
    """
    path = folder / "run.nc"
    tree = open_run(folder)
    groups = {name: tree[name].to_dataset() for name in tree.children}
    attributes = {str(name): value for name, value in tree.attrs.items()}
    try:
        record = _record(groups, attributes, folder)
        _check_values(record)
    except (KeyError, ValueError, IndexError, TypeError, AttributeError, OverflowError) as error:
        reason = error.args[0] if error.args else error
        raise RunFolderError(
            f"{path} does not have the layout of a run of this version ({reason}): fly the run again."
        ) from error
    return record


def open_run(folder: Path | str) -> xr.DataTree:
    """Return everything that a run has stored, `run.nc`; `watch.snapshot.open_run` also reads what goes on.

    Raises
    ------
    RunFolderError
        There is no ``run.nc``, or it is damaged.
    """
    path = Path(folder) / "run.nc"
    restore_folder(path.parent)
    if not path.is_file():
        raise RunFolderError(
            f"{folder} holds no run.nc, so there is no run to report: fly or resume the run first."
        )
    try:
        return read_groups(path)
    except DamagedFileError as error:
        raise RunFolderError(
            f"{error}, so that it cannot be read: resume the run or fly it again."
        ) from error


def _check_values(record: RunRecord) -> None:
    """Refuse what no twin has ever stored; the figures rely on it."""
    controls, (lowest, highest) = len(record.controls), (0, len(record.controls) - 1)
    indices = [("observed/control_index", record.control_index)]
    if record.policy is not None:
        indices.append(("policy/control_index", record.policy.control_index))
    for name, values in indices:
        if values.size and not (lowest <= values.min() and values.max() <= highest):
            raise ValueError(f"{name} goes beyond its {controls} controls")
    for name, estimate in (
        ("filtered", record.filtered),
        ("smoothed", record.smoothed),
        ("predicted", record.predicted),
    ):
        if estimate is None:
            continue
        total = estimate.probability.sum(axis=-1)
        if not (np.all(estimate.probability >= 0.0) and np.all(np.abs(total - 1.0) < _ROUNDING)):
            raise ValueError(f"a row of {name}/probability is no distribution")
        for part in (estimate.mean, estimate.standard_deviation):
            if not np.all(np.isfinite(part)):
                raise ValueError(f"a moment of {name} is not finite")
    if not np.all(np.isfinite(record.coordinates)):
        raise ValueError("a level of the state is not finite")


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    content = read_json(path, RunFolderError)
    if not isinstance(content, dict):
        raise RunFolderError(f"{path} must hold one JSON object: fly the run again.")
    return content


def _array(dataset: xr.Dataset | None, name: str, *dimensions: str) -> Float | None:
    """Return a variable with its axes in the order given, or None if it was not stored."""
    if dataset is None or name not in dataset:
        return None
    variable = dataset[name]
    if set(variable.dims) != set(dimensions):
        raise ValueError(f"{name} has the axes {variable.dims} and not {dimensions}")
    return np.asarray(variable.transpose(*dimensions).values, dtype=np.float64)


def _needed(dataset: xr.Dataset | None, group: str, name: str, *dimensions: str) -> Float:
    values = _array(dataset, name, *dimensions)
    if values is None:
        raise ValueError(f"the variable {group}/{name} is missing")
    return values


def _names(groups: Mapping[str, xr.Dataset], dimension: str, fallback: int) -> tuple[str, ...]:
    for dataset in groups.values():
        if dimension in dataset.coords and dataset.coords[dimension].dims == (dimension,):
            return tuple(_text(value) for value in dataset.coords[dimension].values)
    return tuple(str(index + 1) for index in range(fallback))


def _text(value: Any) -> str:
    return value.decode("utf-8") if isinstance(value, bytes) else str(value)


def _estimate(dataset: xr.Dataset | None, group: str, coordinates: Float, *lead: str) -> Estimate | None:
    if dataset is None or "probability" not in dataset:
        return None
    probability = _needed(dataset, group, "probability", *lead, "state")
    mean = _array(dataset, "mean", *lead, "region")
    deviation = _array(dataset, "standard_deviation", *lead, "region")
    if mean is None or deviation is None:
        mean, deviation = moments(probability, coordinates)
    return Estimate(
        probability=probability,
        mean=mean,
        standard_deviation=deviation,
        quantity=_uncertain(dataset, "quantity", *lead, "sensor"),
        quantity_standard_deviation=None
        if group == "predicted"  # nothing of the report shows it, and it is large
        else _array(dataset, "quantity_standard_deviation", *lead, "sensor"),
        reward=_uncertain(dataset, "reward", *lead, "reward"),
    )


def _uncertain(dataset: xr.Dataset, name: str, *dimensions: str) -> Uncertain | None:
    """Read mean and 95 % interval; without stored bounds they are those of a normal distribution."""
    mean, lower, upper, deviation = (
        _array(dataset, f"{name}_{part}", *dimensions)
        for part in ("mean", "lower", "upper", "standard_deviation")
    )
    if mean is None:
        return None
    if lower is None or upper is None:
        half = np.zeros_like(mean) if deviation is None else NORMAL_95 * deviation
        lower = mean - half if lower is None else lower
        upper = mean + half if upper is None else upper
    return Uncertain(mean, lower, upper)


def _coordinates(groups: Mapping[str, xr.Dataset], names: tuple[str, ...]) -> Float:
    for dataset in groups.values():
        if all(name in dataset.coords and dataset.coords[name].dims == ("state",) for name in names):
            return np.stack([np.asarray(dataset.coords[name].values, dtype=float) for name in names], axis=-1)
    raise ValueError(f"the states have no coordinates {', '.join(names)}")


def _record(groups: Mapping[str, xr.Dataset], attributes: Mapping[str, Any], folder: Path) -> RunRecord:
    config = _read_json(folder / "config.json")
    observed, filtered_group, predicted_group = (
        groups.get(name) for name in ("observed", "filtered", "predicted")
    )
    control_index = _needed(observed, "observed", "control_index", "step").astype(np.int64)
    role = _role(observed, config)
    observation = _array(observed, role, "step", "sensor")
    names = _names(groups, "region", 0)
    if not names or not len(control_index):
        raise ValueError("the axis `region` has no names" if not names else "it holds no step")
    coordinates = _coordinates(groups, names)
    filtered = _estimate(filtered_group, "filtered", coordinates, "step")
    if filtered is None:
        raise ValueError("the variable filtered/probability is missing")
    policy_group, truth, draws_group = (groups.get(name) for name in ("policy", "truth", "calibration"))
    chosen = _array(policy_group, "control_index", "state")
    value = _array(policy_group, "action_value", "state", "control")
    policy = None if chosen is None else PolicyTable(chosen.astype(np.int64), value)
    sensor_count = 0 if observation is None else observation.shape[1]
    sensors = np.asarray([int(name) for name in _names(groups, "sensor", sensor_count)], dtype=np.int64)
    unit = "1" if observed is None or role not in observed else str(observed[role].attrs.get("units", "1"))
    return RunRecord(
        state_names=names,
        state_titles=_titles(config, names),
        levels=tuple(np.unique(coordinates[:, k]) for k in range(len(names))),
        coordinates=coordinates,
        sensors=sensors,
        controls=_names(groups, "control", int(control_index.max()) + 1),
        rewards=_names(groups, "reward", 0),
        observation=observation,
        observation_name=role,
        observation_unit=unit,
        control_index=control_index,
        filtered=filtered,
        smoothed=_estimate(groups.get("smoothed"), "smoothed", coordinates, "step"),
        predicted=_estimate(predicted_group, "predicted", coordinates, "step", "horizon"),
        control_probability=_array(predicted_group, "control_probability", "step", "horizon", "control"),
        decision_probability=_array(filtered_group, "decision_probability", "step", "control"),
        log_evidence=_array(filtered_group, "log_evidence", "step"),
        policy=policy,
        truth_state=_array(truth, "state", "step", "region"),
        truth_observation=_array(truth, role, "step", "sensor"),
        monitors=_monitors(truth),
        parameter_name="" if draws_group is None else _text(draws_group.attrs.get("parameter", "parameter")),
        parameter_draws=_array(draws_group, "draw_value", "draw"),
        calibration=_read_json(folder / "calibration.json"),
        attributes=attributes,
        config=config,
        summary=_read_json(folder / "summary.json"),
        state_units=_state_units(groups, names),
        sensor_units=_sensor_texts(observed, "sensor_unit"),
        sensor_titles=_sensor_texts(observed, "sensor_title"),
        parameter_unit=_draw_unit(draws_group),
        learnt=_learnt(groups.get("learnt"), truth),
        first_step=0 if observed is None else int(observed["step"].values[0]),
        learnt_noise=_array(filtered_group, "noise_standard_deviation", "step", "sensor"),
    )


def _learnt(dataset: xr.Dataset | None, truth: xr.Dataset | None) -> tuple[LearntCourse, ...]:
    """Return what was learnt, in the order in which it is stored."""
    found = []
    for variable in () if dataset is None else dataset.data_vars:
        name = str(variable).removesuffix(f"_prior_{MOMENTS[0]}")
        if dataset is None or name == variable:
            continue
        sensor = ("sensor",) if "sensor" in dataset[variable].dims else ()
        course = [_needed(dataset, "learnt", f"{name}_{moment}", "step", *sensor) for moment in MOMENTS]
        prior = [_needed(dataset, "learnt", f"{name}_prior_{moment}", *sensor) for moment in MOMENTS]
        unit = str(dataset[variable].attrs.get("units", "1"))
        found.append(
            LearntCourse(
                name, unit, np.stack(course, axis=-1), np.stack(prior, axis=-1), _array(truth, name, *sensor)
            )
        )
    return tuple(found)


def _state_units(groups: Mapping[str, xr.Dataset], names: tuple[str, ...]) -> tuple[str, ...]:
    for dataset in groups.values():
        if all(name in dataset.coords for name in names):
            return tuple(str(dataset.coords[name].attrs.get("units", "1")) for name in names)
    return ()


def _sensor_texts(observed: xr.Dataset | None, name: str) -> tuple[str, ...]:
    if observed is None or name not in observed.coords:
        return ()
    return tuple(_text(value) for value in observed.coords[name].values)


def _draw_unit(draws: xr.Dataset | None) -> str:
    return (
        "1"
        if draws is None or "draw_value" not in draws
        else str(draws["draw_value"].attrs.get("units", "1"))
    )


def _monitors(truth: xr.Dataset | None) -> dict[str, tuple[Float, str]]:
    """Return the variables of `truth` with one value a step, and their units."""
    if truth is None:
        return {}
    return {
        str(name): (np.asarray(variable.values, dtype=np.float64), str(variable.attrs.get("units", "1")))
        for name, variable in truth.data_vars.items()
        if variable.dims == ("step",) and variable.dtype.kind == "f"
    }


def _role(observed: xr.Dataset | None, config: Mapping[str, Any]) -> str:
    """Return the name of the observed variable: as the scenario has it, else the only one of each sensor."""
    scenario = config.get("scenario")
    section = scenario.get("observation") if isinstance(scenario, Mapping) else None
    if isinstance(section, Mapping) and "role" in section:
        return str(section["role"])
    names = [] if observed is None else [str(n) for n, v in observed.data_vars.items() if "sensor" in v.dims]
    return names[0] if names else "strain"


def _titles(config: Mapping[str, Any], names: tuple[str, ...]) -> tuple[str, ...]:
    scenario = config.get("scenario")
    factors = scenario.get("state", []) if isinstance(scenario, Mapping) else []
    titles = {f.get("name"): f.get("title") for f in factors if isinstance(f, Mapping)} if factors else {}
    return tuple(str(titles.get(name) or name) for name in names)
