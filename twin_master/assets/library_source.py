"""Observation libraries: the observations of an FMU at every draw, state and control, as NetCDF.

`uav-twin library sample` writes them, and a twin whose `belief` is of the kind `library` predicts
with one. The published strain library of Kapteyn et al. 2021 has a format of its own, see
`strain_library_source`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes, hash_file
from reporting.progress import Progress
from reporting.words import comma_list
from twin_master.assets.asset_source import OBSERVATIONS_COPY, AssetSource
from twin_master.assets.design_source import DESIGN_COPY, DesignBelief, DesignSource
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import InvalidModelError, MissionInputError
from twin_master.network.graphical_model import (
    Factor,
    GraphicalModel,
    StateSpace,
    build_graphical_model,
    interpolation_weights,
)
from twin_master.scenario.kinds import BeliefSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr


KIND = "uav-twin observation library"
FORMAT = 1
RESERVED = ("draw", "control", "sensor", "observation", "parameter_value", "sensor_unit")
"""Names that a state cannot have, because the file uses them."""

_RELATIVE_TOLERANCE = 1e-12
"""Values of control inputs and draws that differ by less are the same."""
_CONTROL_PREFIX = "control_"
"""Prefix of the names of variables that contain values of control inputs."""
_ADVICE = "sample one for this scenario."


class ObservationLibrary:
    """Observations over a grid of E draws, S states, U controls and G sensors.

    Parameters
    ----------
    dataset : Dataset
        A dataset with the layout of `sampled_dataset`.

    Attributes
    ----------
    values : (E, S, U, G) array
        The observations, in the units of the sensors.
    role : str
        The observed quantity, by its name in the binding.
    sensors, sensor_units : tuple of str
        The FMU variable and the unit of each sensor.
    states : StateSpace
        The state factors with their levels.
    state_units : tuple of str
        The unit of each state factor.
    controls : tuple of str
        The names of the controls, which are labels only.
    control_values : dict of str to (U,) array
        The value of each control input under each control.
    parameter : str
        The uncertain parameter; empty without one.
    draws : (E,) array
        The values of the parameter; NaN without a parameter.
    load, parameters : dict of str to float
        The loads and the other parameters of the FMU.
    settling_steps : int
        The number of steps from a fresh start at every point; 0 if the FMU has no memory, and each
        point is one step.
    fmu_hash : str
        The SHA-256 of the FMU.

    Raises
    ------
    KeyError, ValueError, TypeError, InvalidModelError
        If the dataset has another layout.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        self.dataset = dataset
        attributes = dataset.attrs
        state_names: list[str] = json.loads(attributes["states"])
        factors = [Factor(name, tuple(dataset[name].values.tolist())) for name in state_names]
        self.states = StateSpace(tuple(factors))
        self.state_units = tuple(str(dataset[name].attrs["units"]) for name in state_names)
        self.role = str(attributes["role"])
        self.parameter = str(attributes["parameter"])
        self.fmu_hash = str(attributes["fmu_sha256"])
        self.settling_steps = int(attributes["settling_steps"])
        self.load: Mapping[str, float] = json.loads(attributes["load"])
        self.parameters: Mapping[str, float] = json.loads(attributes["parameters"])
        self.sensors = _read_texts(dataset, "sensor")
        self.sensor_units = _read_texts(dataset, "sensor_unit")
        self.controls = _read_texts(dataset, "control")
        self.control_values: dict[str, Float] = {}
        for name in json.loads(attributes["control_units"]):
            self.control_values[name] = _read_finite_values(dataset, f"{_CONTROL_PREFIX}{name}")
        if self.parameter:
            self.draws = _read_finite_values(dataset, "parameter_value")
        else:
            self.draws = np.asarray(dataset["parameter_value"].values, np.float64)
        observation = self.dataset["observation"]
        # One axis for each state factor, between those of the draw and the control.
        table = observation.transpose("draw", *state_names, "control", "sensor").values
        shape = (len(table), self.states.size, *table.shape[-2:])
        values: Float = np.array(table, np.float64).reshape(shape)
        if not np.all(np.isfinite(values)):
            raise ValueError("an observation is not finite")
        values.setflags(write=False)
        self.values = values

    def state_indices(self, names: tuple[str, ...], coordinates: Float) -> list[int]:
        """Return the index of each of several states in the library.

        Parameters
        ----------
        names : tuple of str
            The names of the state factors, in any order.
        coordinates : (N, F) array
            The level of each factor in each of N states.

        Raises
        ------
        MissionInputError
            If the library has other state factors, or lacks a level.
        """
        if set(names) != set(self.states.names):
            raise MissionInputError(
                f"the observation library has the states {comma_list(self.states.names)}, and the "
                f"scenario asks for {comma_list(names)}: {_ADVICE}"
            )
        # The columns in the order of the library.
        states = coordinates[:, [names.index(name) for name in self.states.names]]
        message_start = "the observation library lacks a state: "
        with MissionInputError.instead_of(
            InvalidModelError, before=message_start, after=f"; {_ADVICE}"
        ):
            return [self.states.index(state) for state in states]

    def control_index(self, name: str, values: Mapping[str, float]) -> int:
        """Return the index of the sampled control whose inputs have the given values.

        The names of controls in a library are labels only, and are not compared.

        Parameters
        ----------
        name : str
            The name of the control in the scenario, for the message only.
        values : mapping of str to float
            The value of each control input.

        Raises
        ------
        MissionInputError
            If the library has no such control, or has other control inputs.
        """
        if set(values) != set(self.control_values):
            raise MissionInputError(
                "the observation library has the control inputs "
                f"{comma_list(self.control_values)}, but the scenario sets {comma_list(values)}: "
                f"{_ADVICE}"
            )
        # One truth value for each of the U sampled controls.
        is_same = np.ones(len(self.controls), dtype=bool)
        for key, value in values.items():
            is_same &= np.isclose(
                self.control_values[key], value, rtol=_RELATIVE_TOLERANCE, atol=0.0
            )
        if not is_same.any():
            settings = ", ".join(f"{key} = {value:g}" for key, value in values.items())
            raise MissionInputError(
                f"the observation library was not sampled at {settings}, the control {name} of the "
                f"scenario; it has {comma_list(self.controls)}: {_ADVICE}"
            )
        return int(np.argmax(is_same))

    def check_parameter(self, name: str) -> None:
        """Refuse a parameter other than the one over which the library was sampled.

        A library without an uncertain parameter is accepted: a twin with a single draw can use it.

        Raises
        ------
        MissionInputError
            If the library has another parameter.
        """
        if self.parameter and name != self.parameter:
            raise self._other_parameter_error(name)

    def _other_parameter_error(self, name: str) -> MissionInputError:
        """Return the error for a library that was sampled over another parameter."""
        return MissionInputError(
            f"the observation library was sampled over the parameter {self.parameter or 'none'}, "
            f"and the scenario calibrates {name}: {_ADVICE}"
        )

    def observations_at(self, name: str, draws: Float) -> Float:
        """Interpolate the observations linearly at given values of the parameter.

        A library without a parameter gives the same observations for a single draw of any
        parameter.

        Parameters
        ----------
        name : str
            The name of the parameter.
        draws : (N,) array
            The values of the parameter.

        Returns
        -------
        (N, S, U, G) array
            The observations by value, state, control and sensor.

        Raises
        ------
        MissionInputError
            If the library has another parameter, or a value lies outside the range of the sampled
            ones.
        """
        if not self.parameter and len(draws) == 1:
            return self.values
        if name != self.parameter:
            raise self._other_parameter_error(name)
        order = np.argsort(self.draws, kind="stable")
        nodes = self.draws[order]  # the sampled values, in rising order
        tolerance = _RELATIVE_TOLERANCE * float(np.abs(nodes).max())
        if draws.min() < nodes[0] - tolerance or draws.max() > nodes[-1] + tolerance:
            raise MissionInputError(
                f"the draws of {name} reach from {draws.min():.6g} to {draws.max():.6g}, but the "
                f"observation library covers {nodes[0]:.6g} to {nodes[-1]:.6g}: sample one for "
                f"this scenario and seed, or over a wider range with --grid parameter.{name}=..."
            )
        weights = interpolation_weights(nodes, draws)  # (nodes, N)
        return np.tensordot(weights.T, self.values[order], axes=1)


def _read_texts(dataset: xr.Dataset, name: str) -> tuple[str, ...]:
    """Return the values of a variable as texts."""
    return tuple(str(text) for text in dataset[name].values)


def _read_finite_values(dataset: xr.Dataset, name: str) -> Float:
    """Return the values of a variable; raise `ValueError` if one is not finite."""
    if not np.all(np.isfinite(dataset[name].values)):
        raise ValueError(f"a value of {name} is not finite")
    return np.asarray(dataset[name].values, np.float64)


def write_observation_library(path: Path, library: ObservationLibrary) -> Path:
    """Write a library to a NetCDF file, completely or not at all.

    Equal libraries give equal bytes.

    Raises
    ------
    FileNotWrittenError
        If the disk is full or the folder cannot be written.
    """
    return atomic_write_bytes(path, bytes(library.dataset.to_netcdf(engine="h5netcdf")))


def load_observation_library(path: Path) -> ObservationLibrary:
    """Read an observation library and check its layout.

    Raises
    ------
    MissionInputError
        If the file does not exist, is damaged, or is not a library of this format.
    """
    if not path.is_file():
        raise MissionInputError(
            f"there is no observation library {path}: make it with `uav-twin library sample`."
        )
    from reporting.formats.netcdf import read_groups  # it loads xarray

    try:
        dataset = read_groups(path).to_dataset()
    except DamagedFileError as error:
        raise MissionInputError(
            f"{path} is not a whole NetCDF file: sample the library again."
        ) from error
    if dataset.attrs.get("kind") != KIND or dataset.attrs.get("format") != FORMAT:
        raise MissionInputError(
            f"{path} is not an observation library of this version (format {FORMAT}): sample it "
            "again."
        )
    try:
        return ObservationLibrary(dataset)
    except (KeyError, ValueError, TypeError, InvalidModelError) as error:
        reason = error.args[0] if error.args else error
        raise MissionInputError(
            f"{path} does not have the layout of an observation library ({reason}): sample it "
            "again."
        ) from error


class LibraryBelief(BeliefSection):
    """The twin believes an observation library that `uav-twin library sample` wrote."""

    kind: Literal["library"] = "library"
    file: str
    """An observation library."""
    design: str | None = None
    """A wing design, whose stiffness curve the calibration uses and whose field is drawn."""

    copy_paths: ClassVar[Mapping[str, str]] = {"file": OBSERVATIONS_COPY, "design": DESIGN_COPY}

    def source(self, scenario: Scenario, flown_source: AssetSource) -> LibrarySource:
        """Return the source of the library.

        Raises
        ------
        MissionInputError
            If what flies is not an FMU.
        """
        if not isinstance(flown_source, FmuSource):
            raise MissionInputError(
                "an observation library is sampled from an FMU, but the kind of the asset is "
                f"`{scenario.asset.kind}`: set `belief.kind` to `asset` or `design`."
            )
        return LibrarySource(scenario, self, flown_source)


class LibrarySource(AssetSource):
    """The source of predictions from an observation library.

    Parameters
    ----------
    section : LibraryBelief
        The table `belief` of the scenario.
    flown_source : FmuSource
        The source of the FMU that flies. It also draws the parameter and writes the field, unless
        the section names a design.
    """

    def __init__(self, scenario: Scenario, section: LibraryBelief, flown_source: FmuSource) -> None:
        super().__init__(scenario, section)
        self._flown = flown_source
        self._design_source: DesignSource | None = None
        if section.design is not None:
            belief = DesignBelief(design=section.design)
            self._design_source = DesignSource(scenario, section=belief)
        self._relation_to_flown = " of it"
        """The relation of the library to the FMU that flies, in words."""

    @property
    def _model_source(self) -> AssetSource:
        """The source of parameter draws and field: the design, or the FMU that flies."""
        return self._flown if self._design_source is None else self._design_source

    @property
    def description(self) -> str:
        """The library, and in words whether it was sampled from the FMU that flies."""
        return f"observation library{self._relation_to_flown}"

    @cached_property
    def library(self) -> ObservationLibrary:
        """The library, which is read and checked against the scenario at the first use.

        Raises
        ------
        MissionInputError
            If the file is missing or damaged, or lacks a state, control, sensor or parameter of the
            scenario.
        """
        library = load_observation_library(self.path(OBSERVATIONS_COPY))
        self._check_labels(library)
        library.check_parameter(self._scenario.calibration.parameter)
        model = build_graphical_model(self._scenario)
        self._state_and_control_indices(library, model)  # raises an error if one is missing
        return library

    def _check_labels(self, library: ObservationLibrary) -> None:
        """Refuse a library whose role, sensors, units or load differ from the scenario's."""
        scenario = self._scenario
        observation = scenario.observation
        self._check_same_texts("observes", [library.role], [observation.role])
        vector = self._flown.binding().observation.get(observation.role)
        sensors = () if vector is None else vector.variables
        self._check_same_texts("has the sensors", library.sensors, sensors)
        self._check_same_texts("has them in", library.sensor_units, observation.sensor_units)
        names_and_units = zip(library.states.names, library.state_units, strict=True)
        library_units = sorted(f"{name}: {unit}" for name, unit in names_and_units)
        units = sorted({f"{factor.name}: {factor.unit}" for factor in scenario.state})
        self._check_same_texts("has the states in", library_units, units)
        load = _named_values_as_texts(scenario.asset.constant_load)
        self._check_same_texts(
            "was sampled under the load", _named_values_as_texts(library.load), load
        )

    def _check_same_texts(
        self, verb: str, library_labels: Sequence[str], scenario_labels: Sequence[str]
    ) -> None:
        """Refuse a library whose labels differ from the scenario's in number or order."""
        if list(library_labels) != list(scenario_labels):
            raise MissionInputError(
                f"the observation library {self.path(OBSERVATIONS_COPY).name} {verb} "
                f"{', '.join(library_labels) or 'none'}, but the scenario with its binding asks "
                f"for {', '.join(scenario_labels) or 'none'}: {_ADVICE}"
            )

    def check(self) -> None:
        """Check that the library has everything that the scenario needs."""
        _ = self.library  # reading the library checks it

    def _build(self, progress: Progress) -> dict[str, str]:
        """Prepare the design, and find out whether the library was sampled from the FMU that flies.

        `PairedSource` has prepared that FMU. If the library is of another FMU or of other
        parameters, the description says so, and the two models are marked as different.
        """
        assert self._folder is not None
        library = self.library
        hashes = {}
        if self._design_source is not None:
            hashes = self._design_source.prepare(self._folder, progress)
        fmu = self._folder / FMU_COPY
        flown_parameters = self._flown.parameters()
        flown_parameters.pop(library.parameter, None)
        if not fmu.exists():  # several FMUs fly, and each has a hash of its own
            self._relation_to_flown = ""
        elif library.fmu_hash != hash_file(fmu):
            self._relation_to_flown = " of another FMU"
            self.differ = True
        elif library.parameters != flown_parameters:
            self._relation_to_flown = " of it under other parameters"
            self.differ = True
        return hashes

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter from the calibration of the scenario.

        Their source says so if the library has to be interpolated at one of them.
        """
        draws = self._model_source.draws(seed)
        if not self.library.parameter or np.isin(draws.values, self.library.draws).all():
            return draws
        source = f"{draws.source}; the observation library is interpolated between its own"
        return replace(draws, source=source)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the library's observations (E, S, U, G), by draw, state, control and sensor.

        Raises
        ------
        MissionInputError
            If the library lacks a state or a control of the scenario, or a draw lies outside the
            sampled range of the parameter.
        """
        state_indices, control_indices = self._state_and_control_indices(self.library, model)
        observations = self.library.observations_at(draws.name, draws.values)
        return observations[:, state_indices][:, :, control_indices]

    def write_field(
        self, path: Path, state: Mapping[str, float], control: Mapping[str, float]
    ) -> bool:
        """Write the field of the design, or else of the FMU; return whether it was written."""
        return self._model_source.write_field(path, state, control)

    def _state_and_control_indices(
        self, library: ObservationLibrary, model: GraphicalModel
    ) -> tuple[list[int], list[int]]:
        """Return the indices in the library of the states and of the controls of the scenario."""
        scenario = self._scenario
        states = library.state_indices(scenario.state_names, model.states.coordinates)
        controls = [
            library.control_index(control.name, control.values) for control in scenario.control
        ]
        return states, controls


def _named_values_as_texts(values: Mapping[str, float]) -> list[str]:
    """Return named values as texts such as "mass = 2", sorted by name."""
    return [f"{name} = {value:g}" for name, value in sorted(values.items())]
