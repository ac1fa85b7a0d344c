"""An FMU as the asset of a mission: packed from a wing design, or any FMU with a binding."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from fe.cache import reduced_model
from fe.design import load_design
from fe.reduced import ReducedModel
from fmu_asset.binding import Binding, load_binding
from fmu_asset.build import build_fmu
from fmu_asset.script import script_fmu
from fmu_asset.session import FmiAsset
from reporting.files import atomic_write_bytes
from reporting.progress import Progress
from reporting.provenance import hash_file
from twin_master.asset_source import (
    BINDING_COPY,
    DESIGN_COPY,
    FMU_COPY,
    Origin,
    check_wing_scenario,
    wing_observation_table,
)
from twin_master.assets import Asset, AssetReading
from twin_master.design_source import read_content, write_design_field
from twin_master.errors import MissionInputError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws, draw_parameter
from twin_master.scenario import Scenario

Float = NDArray[np.float64]


class FmuAsset:
    """An FMU behind its one door, as the mission flies it.

    Parameters
    ----------
    session : FmiAsset
        The door, at its start.
    observation : slice
        Where the observed quantity stands among the observations of the binding.
    load : mapping of str to float
        Load inputs, the same in every step.
    """

    def __init__(self, session: FmiAsset, observation: slice, load: Mapping[str, float]) -> None:
        self._session = session
        self._observation = observation
        self._load = dict(load)
        binding = session.binding
        self._units = {
            name: scalar.unit
            for table in (binding.parameter, binding.monitor, binding.control)
            for name, scalar in table.items()
        }

    @property
    def units(self) -> Mapping[str, str]:
        """Units of control inputs, monitors and parameters, as the binding has them."""
        return self._units

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make one communication step."""
        observation = self._session.step(control, health, self._load)
        return AssetReading(observation.values[self._observation], observation.extra)

    def save_state(self) -> bytes:
        """Return the state of the FMU."""
        return self._session.save_state()

    def restore_state(self, state: bytes) -> None:
        """Bring the FMU to a saved state."""
        self._session.restore_state(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()


class FmuSource:
    """An FMU from a wing design or from a file.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    binding : Path
        Binding file.
    design : Path or None
        Wing design: the twin's model, and what is packed where no FMU is given.
    fmu : Path or None
        The FMU to fly.
    script : Path or None
        A model script that is packed as the FMU to fly.
    """

    def __init__(
        self,
        scenario: Scenario,
        binding: Path,
        design: Path | None,
        fmu: Path | None,
        script: Path | None = None,
    ) -> None:
        self._scenario = scenario
        self._binding = binding
        self._script = script
        self._given = {BINDING_COPY: binding, DESIGN_COPY: design, FMU_COPY: fmu}
        self._folder: Path | None = None
        self._wing: ReducedModel | None = None
        self._design_name = ""

    @property
    def origin(self) -> Origin:
        """The FMU, and the model of the design or the FMU itself.

        An FMU that is given may hold any model, also that of the design: whether they differ is not known.
        """
        model = f"reduced model of the design {self._design_name}".rstrip()
        if not self._scenario.asset.model_of_the_design:
            return Origin("FMU", "FMU")
        return Origin("FMU" if self._given[FMU_COPY] else f"FMU of the {model}", model)

    @property
    def wing(self) -> ReducedModel | None:
        """The reduced model of the design, once prepared."""
        return self._wing

    def _path(self, name: str) -> Path:
        if self._folder is None:
            raise MissionInputError("the asset was not prepared: call `prepare` first.")
        return self._folder / name

    def check(self) -> None:
        """Read binding, design and FMU where they are, without copying or starting anything.

        Raises
        ------
        MissionInputError
            A file cannot be read, or the binding observes another number of values than the scenario.
        InvalidDesignError, FmuError
            A design, binding or FMU is wrong, or the binding does not fit the FMU.
        """
        self.files()
        design, fmu = self._given[DESIGN_COPY], self._given[FMU_COPY]
        binding = load_binding(self._binding)
        self._observed(binding)
        self._check_names(binding)
        if design is not None:
            gauges = len(load_design(design).gauges.positions)
            if self._scenario.asset.model_of_the_design:
                check_wing_scenario(self._scenario, gauges)
        if fmu is not None:
            FmiAsset(fmu, binding, parameters=self._scenario.asset.parameters)
        elif self._script is not None:
            with TemporaryDirectory(prefix="uav_twin_") as folder:
                packed = Path(folder) / "asset.fmu"
                packed.write_bytes(script_fmu(self._script)[0])
                FmiAsset(packed, binding, parameters=self._scenario.asset.parameters)

    def files(self) -> dict[str, bytes]:
        """Return binding, design and FMU as they are given; a model script is packed.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        FmuBuildError
            The model script cannot be packed.
        """
        contents = {name: read_content(path) for name, path in self._given.items() if path is not None}
        if self._script is not None:
            contents[FMU_COPY] = script_fmu(self._script)[0]
        return contents

    def _check_names(self, binding: Binding) -> None:
        scenario = self._scenario
        for what, names, known in (
            ("control input", scenario.control[0].values, binding.control),
            ("state", scenario.state_names, binding.health),
            ("load", scenario.asset.load, binding.load),
            ("parameter", scenario.asset.parameters, binding.parameter),
        ):
            unknown = sorted({*names} - {*known})
            if unknown:
                raise MissionInputError(
                    f"the scenario has the {what} {', '.join(unknown)}, which the binding {binding.name} "
                    f"does not know; it knows {', '.join(known) or 'none'}."
                )

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Copy what is given into the run folder, reduce the design and pack the FMU; return the hashes.

        Raises
        ------
        MissionInputError
            A file cannot be read.
        InvalidDesignError, FmuError
            A design, binding or FMU is wrong.
        """
        self._folder = folder
        for name, content in self.files().items():
            if not self._path(name).exists():
                atomic_write_bytes(self._path(name), content)
        self._observed(load_binding(self._path(BINDING_COPY)))
        hashes = {"binding": hash_file(self._path(BINDING_COPY))}
        if self._given[DESIGN_COPY] is not None:
            design = load_design(self._path(DESIGN_COPY))
            self._design_name = design.name
            self._wing = reduced_model(design, progress=progress)
            hashes["design"] = self._wing.design_hash
            if self._given[FMU_COPY] is None:
                with progress.stage("Packing the FMU"):
                    build_fmu(self._wing, self._path(FMU_COPY), replace=True)
        hashes["fmu"] = hash_file(self._path(FMU_COPY))
        return hashes

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        return draw_parameter(self._scenario.calibration, seed, self._wing)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted observations (E, S, U, G), from the design's model or from the FMU itself."""
        if self._scenario.asset.observation_model == "asset" or self._wing is None:
            return self._tabulate(draws, model)
        return wing_observation_table(self._wing, self._scenario, draws, model)

    def _tabulate(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Ask the FMU for its observation at every draw, state and control: for assets without memory."""
        scenario = self._scenario
        states, controls = model.states.coordinates, scenario.control
        table = np.empty((len(draws.values), len(states), len(controls), scenario.observation.count))
        with self._session() as session:
            chosen = self._observed(session.binding)
            for row, value in enumerate(draws.values):
                session.reset({**scenario.asset.parameters, draws.name: float(value)})
                for state, levels in enumerate(states):
                    health = dict(zip(scenario.state_names, levels.tolist(), strict=True))
                    for index, control in enumerate(controls):
                        reading = session.step(control.values, health, scenario.asset.load)
                        table[row, state, index] = reading.values[chosen]
        return table

    def _observed(self, binding: Binding) -> slice:
        """Return where the observed quantity stands among the observations of the binding."""
        role, expected = self._scenario.observation.role, self._scenario.observation.count
        chosen = binding.observation_slice(role)
        if chosen.stop - chosen.start != expected:
            raise MissionInputError(
                f"the binding {binding.name} observes {chosen.stop - chosen.start} values of `{role}`, and "
                f"the scenario expects {expected}."
            )
        return chosen

    def _session(self) -> FmiAsset:
        asset = self._scenario.asset
        return FmiAsset(
            self._path(FMU_COPY),
            self._path(BINDING_COPY),
            isolated=asset.isolated,
            step_timeout=asset.step_timeout,
            parameters=asset.parameters,
        )

    def open(self) -> Asset:
        """Return the FMU at its start, with the parameters of the scenario.

        Raises
        ------
        FmuError
            The FMU cannot be flown, or the binding does not fit it.
        MissionInputError
            The FMU observes another number of values than the scenario.
        """
        session = self._session()
        chosen = self._observed(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, chosen, self._scenario.asset.load)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU, with the parameters of the scenario."""
        if self._wing is None:
            return False
        e = self._scenario.asset.parameters.get("young_modulus_factor", 1.0)
        return write_design_field(path, self._scenario, self._path(DESIGN_COPY), e, state, control)
