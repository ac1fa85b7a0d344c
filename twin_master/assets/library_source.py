"""Observation libraries: what an FMU showed at every draw of a parameter, state and control, as NetCDF.

`uav-twin library sample` writes them, and a scenario with a `belief` of the kind `library` believes one.
The published strain library of Kapteyn et al. 2021 has a format of its own, see `strain_library_source`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.files import atomic_write_bytes, hash_file
from reporting.progress import Progress
from twin_master.assets.asset_source import OBSERVATIONS_COPY, AssetSource
from twin_master.assets.design_source import DESIGN_COPY, DesignBelief, DesignSource
from twin_master.assets.fmu_source import FMU_COPY, FmuSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.errors import InvalidModelError, MissionInputError, said
from twin_master.network.graphical_model import Factor, GraphicalModel, StateSpace
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.kinds import BeliefSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr


KIND = "uav-twin observation library"
FORMAT = 1
RESERVED = ("draw", "control", "sensor", "observation", "parameter_value", "sensor_unit")
"""Names that a state cannot have, because the file has them already."""

_SAME = 1e-12


class ObservationLibrary:
    """Observations over a grid of E draws, S states, U controls and G sensors.

    Parameters
    ----------
    dataset : Dataset
        Of the layout that `sampled_dataset` makes.

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
    parameter : str
        The uncertain parameter; empty without one.
    draws : (E,)
        Its values; NaN without one.
    load, parameters : dict of str to float
        What else was set.
    settling_steps : int
        Steps from a fresh start at every point; 0: the FMU has no memory, and each point is one step.
    fmu_hash : str
        SHA-256 of the FMU.

    Raises
    ------
    KeyError, ValueError, TypeError, InvalidModelError
        It is no such dataset.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        about = dataset.attrs
        names: list[str] = json.loads(about["states"])
        self.dataset = dataset
        self.states = StateSpace(tuple(Factor(name, tuple(dataset[name].values.tolist())) for name in names))
        self.state_units = tuple(str(dataset[name].attrs["units"]) for name in names)
        self.role, self.parameter, self.fmu_hash = (
            str(about[name]) for name in ("role", "parameter", "fmu_sha256")
        )
        self.settling_steps = int(about["settling_steps"])
        self.load: Mapping[str, float] = json.loads(about["load"])
        self.parameters: Mapping[str, float] = json.loads(about["parameters"])
        self.sensors, self.sensor_units, self.controls = (
            tuple(str(text) for text in dataset[name].values) for name in ("sensor", "sensor_unit", "control")
        )
        inputs = [f"control_{name}" for name in json.loads(about["control_units"])]
        for name in (*inputs, *["parameter_value"] * bool(self.parameter)):
            if not np.all(np.isfinite(dataset[name].values)):
                raise ValueError(f"a value of {name} is not finite")
        self.control_values: dict[str, Float] = {
            name.removeprefix("control_"): np.asarray(dataset[name].values, np.float64) for name in inputs
        }
        self.draws: Float = np.asarray(dataset["parameter_value"].values, np.float64)
        table = dataset["observation"].transpose("draw", *names, "control", "sensor").values
        self.values: Float = np.array(table, np.float64).reshape(
            len(table), self.states.size, *table.shape[-2:]
        )
        if not np.all(np.isfinite(self.values)):
            raise ValueError("an observation is not finite")
        self.values.setflags(write=False)

    def rows_of(self, names: tuple[str, ...], coordinates: Float) -> list[int]:
        """Return the index of each state (N, F), whose factors are named in any order.

        Raises
        ------
        MissionInputError
            The library has other states, or a level is none of its levels.
        """
        if set(names) != set(self.states.names):
            raise MissionInputError(said("assets.states", self=self, names=names))
        wanted = coordinates[:, [names.index(name) for name in self.states.names]]
        before, after = "the observation library lacks a state: ", "; sample one for this scenario."
        with MissionInputError.instead_of(InvalidModelError, before=before, after=after):
            return [self.states.index(state) for state in wanted]

    def control_of(self, name: str, values: Mapping[str, float]) -> int:
        """Return the index of the control whose inputs have the given values; its name does not matter.

        Raises
        ------
        MissionInputError
            There is none, or the library has other control inputs.
        """
        if set(values) != set(self.control_values):
            raise MissionInputError(said("assets.inputs", self=self, values=values))
        known, wanted = (
            np.column_stack([self.control_values[key] for key in values]),
            [*values.values()],
        )
        if not (same := np.isclose(known, wanted, rtol=_SAME, atol=0.0).all(axis=1)).any():
            shown = ", ".join(f"{key} = {value:g}" for key, value in values.items())
            raise MissionInputError(said("assets.control", shown=shown, name=name, self=self))
        return int(np.argmax(same))

    def at_draws(self, name: str, draws: Float) -> Float:
        """Return the observations (N, S, U, G) at N values of the parameter, linear between the sampled ones.

        Raises
        ------
        MissionInputError
            The library has another parameter, or a value lies outside the sampled ones.
        """
        if not self.parameter and len(draws) == 1:
            return self.values
        if name != self.parameter:
            own = self.parameter or "none"
            raise MissionInputError(said("assets.parameter", own=own, name=name))
        order = np.argsort(self.draws, kind="stable")
        nodes = self.draws[order]
        slack = _SAME * float(np.abs(nodes).max())
        if draws.min() < nodes[0] - slack or draws.max() > nodes[-1] + slack:
            ends = draws.min(), draws.max(), nodes[0], nodes[-1]
            raise MissionInputError(said("assets.draws", name=name, ends=ends))
        share = np.array([np.interp(draws, nodes, own) for own in np.eye(len(nodes))])
        return np.tensordot(share.T, self.values[order], axes=1)


def write_observation_library(path: Path, library: ObservationLibrary) -> Path:
    """Write a library in one step; equal libraries give equal bytes.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    return atomic_write_bytes(path, bytes(library.dataset.to_netcdf(engine="h5netcdf")))


def load_observation_library(path: Path) -> ObservationLibrary:
    """Read a library.

    Raises
    ------
    MissionInputError
        There is no whole library; the sentence says what is wrong.
    """
    if not path.is_file():
        raise MissionInputError(said("assets.no_library", path=path))
    from reporting.netcdf import read_groups  # which loads xarray

    try:
        dataset = read_groups(path).to_dataset()
    except DamagedFileError as error:
        raise MissionInputError(said("assets.not_whole", path=path)) from error
    if dataset.attrs.get("kind") != KIND or dataset.attrs.get("format") != FORMAT:
        raise MissionInputError(said("assets.format", path=path, format=FORMAT))
    try:
        return ObservationLibrary(dataset)
    except (KeyError, ValueError, TypeError, InvalidModelError) as error:
        reason = error.args[0] if error.args else error
        raise MissionInputError(said("assets.layout", path=path, reason=reason)) from error


class LibraryBelief(BeliefSection):
    """An observation library, as `uav-twin library sample` writes it."""

    kind: Literal["library"] = "library"
    file: str
    design: str | None = None
    """The wing whose stiffness curve the calibration takes, and whose field is drawn, where there is one."""

    copy_paths: ClassVar[Mapping[str, str]] = {"file": OBSERVATIONS_COPY, "design": DESIGN_COPY}

    def source(self, scenario: Scenario, flown: AssetSource) -> LibrarySource:
        """Return the library.

        Raises
        ------
        MissionInputError
            What flies is no FMU.
        """
        if not isinstance(flown, FmuSource):
            raise MissionInputError(said("assets.not_sampled", kind=scenario.asset.kind))
        return LibrarySource(scenario, self, flown)


class LibrarySource(AssetSource):
    """Predicted observations from an observation library.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    section : LibraryBelief
        What is believed.
    flown : FmuSource
        Gives the draws of the parameter and the field where no design does.
    """

    def __init__(self, scenario: Scenario, section: LibraryBelief, flown: FmuSource) -> None:
        super().__init__(scenario, section)
        self._flown = flown
        self._model: AssetSource = flown
        if section.design is not None:
            self._model = DesignSource(scenario, section=DesignBelief(design=section.design))
        self._of = " of it"

    @property
    def words(self) -> str:
        """The library; it differs if it was sampled from another FMU or with other parameters."""
        return f"observation library{self._of}"

    @cached_property
    def library(self) -> ObservationLibrary:
        """The library, which has what the scenario asks for.

        Raises
        ------
        MissionInputError
            It is missing or damaged, or lacks something.
        """
        library = load_observation_library(self.path(OBSERVATIONS_COPY))
        scenario, section = self._scenario, self._scenario.observation
        vector = self._flown.binding().observation.get(section.role)
        units = zip(library.states.names, library.state_units, strict=True)
        of_states = {f"{factor.name}: {factor.unit}" for factor in scenario.state}
        for what, has, wanted in (
            ("observes", (library.role,), (section.role,)),
            ("has the sensors", library.sensors, () if vector is None else vector.variables),
            ("has them in", library.sensor_units, section.sensor_units),
            (
                "has the states in",
                sorted(f"{name}: {unit}" for name, unit in units),
                sorted(of_states),
            ),
            (
                "was sampled under the load",
                _shown(library.load),
                _shown(scenario.asset.constant_load),
            ),
        ):
            if has != wanted:
                what = f"{self.path(OBSERVATIONS_COPY).name} {what}"
                both = [", ".join(names) or "none" for names in (has, wanted)]
                raise MissionInputError(said("assets.differs", what=what, both=both))
        if not library.parameter or library.parameter == scenario.calibration.parameter:
            self._places(library, build_graphical_model(scenario))
        else:
            library.at_draws(scenario.calibration.parameter, np.zeros(2))  # says what is wrong
        return library

    def check(self) -> None:
        """Check that the library has what the scenario asks for."""
        _ = self.library

    def _make(self, progress: Progress) -> dict[str, str]:
        """Prepare the design if one is named; what is flown is prepared before."""
        assert self._folder is not None
        fmu, own, library = self._folder / FMU_COPY, self._model is not self._flown, self.library
        flown = {k: value for k, value in self._flown.parameters().items() if k != library.parameter}
        hashes = self._model.prepare(self._folder, progress) if own else {}
        if not fmu.exists():  # of several FMUs each has its own hash
            self._of = ""
        elif library.fmu_hash != hash_file(fmu):
            self._of, self.differ = " of another FMU", True
        elif library.parameters != flown:
            self._of, self.differ = " of it under other parameters", True
        return hashes

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter, from the calibration of the scenario."""
        draws = self._model.draws(seed)
        if not self.library.parameter or np.isin(draws.values, self.library.draws).all():
            return draws
        return replace(
            draws, source=f"{draws.source}; the observation library is interpolated between its own"
        )

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the observations (E, S, U, G) in the order of the scenario's states and controls.

        Raises
        ------
        MissionInputError
            The library lacks a state, control or range of the parameter.
        """
        rows, controls = self._places(self.library, model)
        return self.library.at_draws(draws.name, draws.values)[:, rows][:, :, controls]

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write the field of the model."""
        return self._model.write_field(path, state, control)

    def _places(self, library: ObservationLibrary, model: GraphicalModel) -> tuple[list[int], list[int]]:
        """Return where the states and controls of the scenario stand in the library."""
        rows = library.rows_of(self._scenario.state_names, model.states.coordinates)
        controls = [library.control_of(control.name, control.values) for control in self._scenario.control]
        return rows, controls


def _shown(values: Mapping[str, float]) -> list[str]:
    return [f"{name} = {value:g}" for name, value in sorted(values.items())]
