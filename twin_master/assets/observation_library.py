"""Observation libraries: what an FMU showed at every draw of a parameter, state and control, as NetCDF.

`uav-twin library sample` writes them, and a scenario with a `belief` of the kind `library` believes one.
The published strain library of Kapteyn et al. 2021 has a format of its own, see `strain_library`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes
from reporting.netcdf import read_groups
from twin_master.errors import InvalidModelError, InvalidObservationLibraryError
from twin_master.network.graphical_model import Factor, StateSpace

__all__ = ["ObservationLibrary", "load_observation_library", "write_observation_library"]

Float = NDArray[np.float64]

KIND = "uav-twin observation library"
FORMAT = 1
RESERVED = ("draw", "control", "sensor", "observation", "parameter_value", "sensor_unit")
"""Names that a state cannot have, because the file has them already."""

_SAME = 1e-12
_RECORDS = ("load", "parameters", "control_units")


@dataclass(frozen=True)
class ObservationLibrary:
    """Observations over a grid of E draws, S states, U controls and G sensors.

    Attributes
    ----------
    values : (E, S, U, G)
        In the units of the sensors.
    role : str
        Observation of the binding.
    sensors, sensor_units : tuple of str
        FMU variable and unit of each sensor.
    states : StateSpace
        Factors with their levels.
    state_units : tuple of str
        Unit of each factor.
    controls : tuple of str
        Names of the controls, labels only.
    control_values : dict of str to (U,)
        Value of each control input under each control.
    control_units : dict of str to str
        Unit of each control input.
    parameter, parameter_unit : str
        The uncertain parameter; empty without one.
    draws : (E,)
        Its values; NaN without one.
    load, parameters : dict of str to float
        What else was set.
    settling_steps : int
        Steps from a fresh start at every point; 0: the FMU has no memory, and each point is one step.
    fmu_hash, binding_hash : str
        SHA-256 of the files.
    version : str
        Version of uav-twin that sampled it.
    """

    values: Float
    role: str
    sensors: tuple[str, ...]
    sensor_units: tuple[str, ...]
    states: StateSpace
    state_units: tuple[str, ...]
    controls: tuple[str, ...]
    control_values: Mapping[str, Float]
    control_units: Mapping[str, str]
    parameter: str
    parameter_unit: str
    draws: Float
    load: Mapping[str, float]
    parameters: Mapping[str, float]
    settling_steps: int
    fmu_hash: str
    binding_hash: str
    version: str

    def rows_of(self, names: tuple[str, ...], coordinates: Float) -> list[int]:
        """Return the index of each state (N, F), whose factors are named in any order.

        Raises
        ------
        InvalidObservationLibraryError
            The library has other states, or a level is none of its levels.
        """
        if set(names) != set(self.states.names):
            raise InvalidObservationLibraryError(
                f"the observation library has the states {', '.join(self.states.names)}, and the scenario "
                f"asks for {', '.join(names)}: sample one for this scenario."
            )
        index = np.zeros(len(coordinates), dtype=int)
        for factor in self.states.factors:
            levels, wanted = np.asarray(factor.levels), coordinates[:, names.index(factor.name)]
            distance = np.abs(levels - wanted[:, None])
            missing = distance.min(axis=1) > _SAME * np.maximum(np.abs(wanted), 1.0)
            if missing.any():
                raise InvalidObservationLibraryError(
                    f"the observation library has the levels {_listed(levels)} of {factor.name}, and the "
                    f"scenario asks for {wanted[missing][0]:g}: sample one for this scenario."
                )
            index = index * len(levels) + distance.argmin(axis=1)
        return [int(row) for row in index]

    def control_of(self, name: str, values: Mapping[str, float]) -> int:
        """Return the index of the control whose inputs have the given values; its name does not matter.

        Raises
        ------
        InvalidObservationLibraryError
            There is none, or the library has other control inputs.
        """
        if set(values) != set(self.control_values):
            raise InvalidObservationLibraryError(
                f"the observation library has the control inputs {', '.join(self.control_values)}, and the "
                f"scenario sets {', '.join(values)}: sample one for this scenario."
            )
        distance = np.max(
            [
                np.abs(self.control_values[key] - value) / max(abs(value), 1.0)
                for key, value in values.items()
            ],
            axis=0,
        )
        if distance.min() > _SAME:
            shown = ", ".join(f"{key} = {value:g}" for key, value in values.items())
            raise InvalidObservationLibraryError(
                f"the observation library was not sampled at {shown}, the control {name} of the scenario; it "
                f"has {', '.join(self.controls)}: sample one for this scenario."
            )
        return int(distance.argmin())

    def at_draws(self, name: str, draws: Float) -> Float:
        """Return the observations (N, S, U, G) at N values of the parameter, linear between the sampled ones.

        Raises
        ------
        InvalidObservationLibraryError
            The library has another parameter, or a value lies outside the sampled ones.
        """
        if not self.parameter and len(draws) == 1:
            return self.values
        if name != self.parameter:
            raise InvalidObservationLibraryError(
                f"the observation library was sampled over the parameter {self.parameter or 'none'}, and the "
                f"scenario calibrates {name}: sample one for this scenario."
            )
        order = np.argsort(self.draws, kind="stable")
        nodes = self.draws[order]
        slack = _SAME * max(1.0, float(np.abs(nodes).max()))
        if draws.min() < nodes[0] - slack or draws.max() > nodes[-1] + slack:
            raise InvalidObservationLibraryError(
                f"the draws of {name} reach from {draws.min():.6g} to {draws.max():.6g}, and the observation "
                f"library from {nodes[0]:.6g} to {nodes[-1]:.6g}: sample one for this scenario and seed, or "
                f"over a wider range with --grid parameter.{name}=..."
            )
        upper = np.clip(np.searchsorted(nodes, draws, side="left"), 0, len(nodes) - 1)
        lower = np.maximum(upper - 1, 0)
        width = nodes[upper] - nodes[lower]
        share = np.divide(draws - nodes[lower], width, out=np.ones(len(draws)), where=width > 0.0)
        share = np.clip(share, 0.0, 1.0)[:, None, None, None]
        low, high = self.values[order[lower]], self.values[order[upper]]
        # At a sampled value exactly what was sampled.
        return np.where(share == 1.0, high, (1.0 - share) * low + share * high)

    def holds_draws(self, draws: Float) -> bool:
        """Return whether every value of the parameter was sampled, so that nothing is interpolated."""
        return bool(np.isin(draws, self.draws).all())

    def to_dataset(self) -> xr.Dataset:
        """Return the library as a labelled dataset; a state factor is a dimension of its own."""
        names = self.states.names
        taken = sorted({*names} & {*RESERVED})
        if taken:
            raise InvalidObservationLibraryError(
                f"a state cannot be called {taken[0]} in an observation library: give it another name in the "
                "binding."
            )
        sensor = {"long_name": f"FMU variable of each value of {self.role}"}
        coordinates: dict[str, xr.Variable] = {
            "sensor": xr.Variable("sensor", np.array(self.sensors), sensor),
            "sensor_unit": xr.Variable("sensor", np.array(self.sensor_units), {"long_name": "unit"}),
            "control": xr.Variable("control", np.array(self.controls), {"long_name": "control"}),
            "parameter_value": xr.Variable(
                "draw", self.draws, {"long_name": self.parameter or "none", "units": self.parameter_unit}
            ),
        }
        for factor, unit in zip(self.states.factors, self.state_units, strict=True):
            levels = np.array(factor.levels)
            coordinates[factor.name] = xr.Variable(factor.name, levels, {"long_name": "state", "units": unit})
        for name, values in self.control_values.items():
            attributes = {"long_name": f"control input {name}", "units": self.control_units[name]}
            coordinates[f"control_{name}"] = xr.Variable("control", values, attributes)
        shape = (len(self.draws), *self.states.shape, *self.values.shape[2:])
        return xr.Dataset(
            {
                "observation": (
                    ("draw", *names, "control", "sensor"),
                    self.values.reshape(shape),
                    {"long_name": f"{self.role} without noise", "units": "see sensor_unit"},
                )
            },
            coords=coordinates,
            attrs={
                "kind": KIND,
                "format": FORMAT,
                "role": self.role,
                "states": json.dumps(names),
                "parameter": self.parameter,
                "settling_steps": self.settling_steps,
                "fmu_sha256": self.fmu_hash,
                "binding_sha256": self.binding_hash,
                "uav_twin_version": self.version,
            }
            | {name: json.dumps(dict(getattr(self, name)), sort_keys=True) for name in _RECORDS},
        )


def write_observation_library(path: Path, library: ObservationLibrary) -> Path:
    """Write a library in one step; equal libraries give equal bytes.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    return atomic_write_bytes(path, bytes(library.to_dataset().to_netcdf(engine="h5netcdf")))


def load_observation_library(path: Path) -> ObservationLibrary:
    """Read a library.

    Raises
    ------
    InvalidObservationLibraryError
        There is no whole library; the sentence says what is wrong.
    """
    if not path.is_file():
        raise InvalidObservationLibraryError(
            f"there is no observation library {path}: make it with `uav-twin library sample`."
        )
    try:
        dataset = read_groups(path).to_dataset()
    except DamagedFileError as error:
        raise InvalidObservationLibraryError(
            f"{path} is not a whole NetCDF file: sample the library again."
        ) from error
    if dataset.attrs.get("kind") != KIND or dataset.attrs.get("format") != FORMAT:
        raise InvalidObservationLibraryError(
            f"{path} is no observation library of this version (format {FORMAT}): sample it again."
        )
    try:
        return _from_dataset(dataset)
    except (KeyError, ValueError, TypeError, InvalidModelError) as error:
        reason = error.args[0] if error.args else error
        raise InvalidObservationLibraryError(
            f"{path} does not have the layout of an observation library ({reason}): sample it again."
        ) from error


def _from_dataset(dataset: xr.Dataset) -> ObservationLibrary:
    names: list[str] = json.loads(dataset.attrs["states"])
    states = StateSpace(tuple(Factor(name, tuple(dataset[name].values.tolist())) for name in names))
    records: dict[str, dict[str, Any]] = {name: json.loads(dataset.attrs[name]) for name in _RECORDS}
    table = dataset["observation"].transpose("draw", *names, "control", "sensor").values
    values = np.array(table, dtype=np.float64).reshape(len(table), states.size, *table.shape[-2:])
    if not np.all(np.isfinite(values)):
        raise ValueError("an observation is not finite")
    values.setflags(write=False)
    parameter = str(dataset.attrs["parameter"])
    nodes = [f"control_{name}" for name in records["control_units"]] + ["parameter_value"] * bool(parameter)
    for name in nodes:
        if not np.all(np.isfinite(dataset[name].values)):
            raise ValueError(f"a value of {name} is not finite")
    return ObservationLibrary(
        values=values,
        role=str(dataset.attrs["role"]),
        sensors=_texts(dataset["sensor"]),
        sensor_units=_texts(dataset["sensor_unit"]),
        states=states,
        state_units=tuple(str(dataset[name].attrs["units"]) for name in names),
        controls=_texts(dataset["control"]),
        control_values={
            name: np.asarray(dataset[f"control_{name}"].values, dtype=np.float64)
            for name in records["control_units"]
        },
        control_units=records["control_units"],
        parameter=parameter,
        parameter_unit=str(dataset["parameter_value"].attrs["units"]),
        draws=np.asarray(dataset["parameter_value"].values, dtype=np.float64),
        load=records["load"],
        parameters=records["parameters"],
        settling_steps=int(dataset.attrs["settling_steps"]),
        fmu_hash=str(dataset.attrs["fmu_sha256"]),
        binding_hash=str(dataset.attrs["binding_sha256"]),
        version=str(dataset.attrs["uav_twin_version"]),
    )


def _texts(variable: xr.DataArray) -> tuple[str, ...]:
    return tuple(str(value) for value in variable.values)


def _listed(values: Float) -> str:
    return ", ".join(f"{value:g}" for value in values)
