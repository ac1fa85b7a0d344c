"""An FMU as the asset of a mission: packed from a wing design, or any FMU with a binding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from calibration.result import CalibrationResult
from fe.cache import reduced_model
from fe.design import WingDesign
from fe.reduced import ReducedModel
from fmu_asset.binding import Binding, load_binding
from fmu_asset.build import build_fmu
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.patch_file import load_patch
from fmu_asset.script import script_fmu
from fmu_asset.session import FmiAsset
from reporting.files import atomic_write_bytes
from reporting.progress import Progress, SilentProgress
from reporting.provenance import hash_file
from twin_master.asset_source import (
    BINDING_COPY,
    CALIBRATION_COPY,
    DESIGN_COPY,
    FMU_COPY,
    MODEL_PATCH_COPY,
    PATCH_COPY,
    Origin,
    check_wing_scenario,
)
from twin_master.assets import Asset, AssetReading, InnerTruth
from twin_master.calibrated_asset import pack_calibrated_wing
from twin_master.design_source import read_calibration, read_content, read_design, write_design_field
from twin_master.errors import MissionInputError
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws, draw_parameter
from twin_master.patches import arrays_of, check_model_patch, effect_names, model_observation_table
from twin_master.scenario import Scenario
from twin_master.seeds import generator

Float = NDArray[np.float64]
Session = FmiAsset | CoupledAsset
"""One FMU, or several as one, with the same face."""
LARGEST_SEED = 2**31 - 1
"""Of an FMU's integer parameter."""


@dataclass(frozen=True)
class InnerRoles:
    """Where an asset with damage and sensors of its own tells the truth; see `[truth]` of a scenario.

    Attributes
    ----------
    state : dict of str to str
        Monitor by state factor.
    observation : slice
        The noise-free observation among those of the binding.
    received : slice or None
        Where the binding observes whether each sensor is received.
    """

    state: Mapping[str, str]
    observation: slice
    received: slice | None


_TAKEN = ("state", "sensor_status", "step", "region", "sensor")
"""What the truth of a run holds already."""


class FmuAsset:
    """An FMU, or several coupled ones, as the mission flies them.

    Parameters
    ----------
    session : FmiAsset or CoupledAsset
        The door, at its start.
    observation : slice
        Where the observed quantity stands among the observations of the binding.
    load : mapping of str to float
        Load inputs, the same in every step.
    inner : InnerRoles, optional
        Given where damage and sensors are the asset's own.
    """

    def __init__(
        self,
        session: Session,
        observation: slice,
        load: Mapping[str, float],
        inner: InnerRoles | None = None,
    ) -> None:
        self._session = session
        self._observation = observation
        self._load = dict(load)
        self._inner = inner
        binding, recorded = session.binding, session.recorded_units
        taken = {*binding.control, *binding.observation, *_TAKEN}
        self._names = {name: _plain_name(name, taken) for name in recorded}
        self._units = {
            name: scalar.unit
            for table in (binding.parameter, binding.control)
            for name, scalar in table.items()
        }
        self._units |= {self._names[name]: unit for name, unit in recorded.items()}

    @property
    def units(self) -> Mapping[str, str]:
        """Units of parameters, control inputs and of what is recorded beside the observations."""
        return self._units

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make one communication step."""
        observation = self._session.step(control, health, self._load)
        sensed = observation.values[self._observation]
        extra = {self._names[name]: value for name, value in observation.extra.items()}
        if self._inner is None:
            return AssetReading(sensed, extra)
        state = {name: observation.extra[monitor] for name, monitor in self._inner.state.items()}
        if self._inner.received is not None:
            sensed = np.where(observation.values[self._inner.received] == 0.0, np.nan, sensed)
        free = observation.values[self._inner.observation]
        return AssetReading(free, extra, InnerTruth(state, sensed))

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
    calibration : Path or None
        Calibration file of the wing.
    tailored : bool
        Whether the design is that of the calibration file.
    script : Path or None
        A model script that is packed as the FMU to fly.
    """

    def __init__(
        self,
        scenario: Scenario,
        binding: Path,
        design: Path | None,
        fmu: Path | None,
        *,
        calibration: Path | None = None,
        tailored: bool = False,
        script: Path | None = None,
    ) -> None:
        self._scenario = scenario
        self._binding = binding
        self._tailored = tailored
        self._script = script
        self._given = {
            BINDING_COPY: binding,
            DESIGN_COPY: design,
            FMU_COPY: fmu,
            CALIBRATION_COPY: calibration,
            PATCH_COPY: _optional(scenario.asset.patch),
            MODEL_PATCH_COPY: _optional(scenario.asset.model_patch),
        }
        self._folder: Path | None = None
        self._design: WingDesign | None = None
        self._calibration: CalibrationResult | None = None
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
        asset = "FMU" if self._given[FMU_COPY] else f"FMU of the {model}"
        patched, believed = (self._given[name] is not None for name in (PATCH_COPY, MODEL_PATCH_COPY))
        return Origin(
            f"{asset}, with hidden effects" if patched else asset,
            f"{model}, with effects" if believed else model,
            differ=patched or believed,
        )

    @property
    def wing(self) -> ReducedModel | None:
        """The reduced model of the design, once prepared."""
        return self._wing

    def binding(self) -> Binding:
        """Return the binding, once prepared."""
        return load_binding(self._path(BINDING_COPY))

    def fmu_path(self) -> Path:
        """Return the FMU, once prepared."""
        return self._path(FMU_COPY)

    def _path(self, name: str) -> Path:
        if self._folder is None:
            raise MissionInputError("the asset was not prepared: call `prepare` first.")
        return self._folder / name

    def check(self) -> None:
        """Read binding, design, calibration and FMU where they are, without copying or starting anything.

        Raises
        ------
        MissionInputError
            A file cannot be read, or the binding observes another number of values than the scenario.
        InvalidDesignError, FmuError
            A design, binding or FMU is wrong, or the binding does not fit the FMU.
        CalibrationRecordError
            The calibration file is damaged or of another kind, or has no samples of the parameter.
        """
        calibration = read_calibration(self._given[CALIBRATION_COPY], self._scenario)
        self.files()
        design = read_design(self._given[DESIGN_COPY], calibration, tailored=self._tailored)
        fmu = self._given[FMU_COPY]
        binding = load_binding(self._binding)
        gauges = 0 if design is None else len(design.gauges.positions)
        self._check_names(binding, effect_names(self._given[PATCH_COPY], gauges))
        model_patch = self._given[MODEL_PATCH_COPY]
        if model_patch is not None:
            check_model_patch(load_patch(model_patch), gauges, str(model_patch))
        if design is not None and self._scenario.asset.model_of_the_design:
            check_wing_scenario(self._scenario, len(design.gauges.positions))
        # Only with the FMU it is known how many values an array has.
        if fmu is not None:
            binding = FmiAsset(fmu, binding, parameters=self.parameters()).binding
        elif self._script is not None:
            with TemporaryDirectory(prefix="uav_twin_") as folder:
                packed = Path(folder) / "asset.fmu"
                packed.write_bytes(script_fmu(self._script)[0])
                binding = FmiAsset(packed, binding, parameters=self.parameters()).binding
        self._observed(binding)
        self._inner_roles(binding)

    def files(self) -> dict[str, bytes]:
        """Return binding, design, calibration and FMU as they are given; a model script is packed.

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

    def _check_names(self, binding: Binding, effects: tuple[str, ...] = ()) -> None:
        """Check the scenario's names against the binding; `effects` are parameters by the FMU's own names."""
        scenario = self._scenario
        for what, names, known in (
            ("control input", scenario.control[0].values, binding.control),
            ("state", () if scenario.truth.kind == "asset" else scenario.state_names, binding.health),
            ("load", scenario.asset.load, binding.load),
            ("parameter", (*scenario.asset.parameters, *scenario.asset.seeds),
             [*binding.parameter, *effects]),
        ):  # fmt: skip
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
        hashes = {"binding": hash_file(self._path(BINDING_COPY))}
        hashes |= self._prepare_model(progress)
        if self._wing is not None and self._given[FMU_COPY] is None:
            with progress.stage("Packing the FMU"):
                self._pack(self._wing, self._path(FMU_COPY), tailored=self._tailored, progress=progress)
        hashes["fmu"] = hash_file(self._path(FMU_COPY))
        return hashes

    def _prepare_model(self, progress: Progress) -> dict[str, str]:
        """Read the calibration and reduce the design that the twin believes; return the hashes."""
        hashes = {
            Path(name).stem: hash_file(self._path(name))
            for name in (PATCH_COPY, MODEL_PATCH_COPY)
            if self._given[name] is not None
        }
        if self._given[CALIBRATION_COPY] is not None:
            self._calibration = read_calibration(self._path(CALIBRATION_COPY), self._scenario)
            hashes["calibration"] = hash_file(self._path(CALIBRATION_COPY))
        copy = None if self._given[DESIGN_COPY] is None else self._path(DESIGN_COPY)
        self._design = read_design(copy, self._calibration, tailored=self._tailored)
        if self._design is not None:
            self._design_name = self._design.name
            self._wing = reduced_model(self._design, progress=progress)
            hashes["design"] = self._wing.design_hash
        return hashes

    def _pack(
        self, wing: ReducedModel, target: Path, *, tailored: bool, progress: Progress | None = None
    ) -> None:
        """Pack an FMU to fly; where the scenario names no parameter, the start value is flown."""
        patch = None if self._given[PATCH_COPY] is None else load_patch(self._path(PATCH_COPY))
        arrays = arrays_of(self._design, patch, progress or SilentProgress())
        if tailored and self._calibration is not None:
            pack_calibrated_wing(
                wing, self._calibration, target, patch=patch, activate=True, arrays=arrays, replace=True
            )
        else:
            build_fmu(wing, target, patch=patch, activate=True, arrays=arrays, replace=True)

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the calibrated parameter."""
        return draw_parameter(self._scenario.calibration, seed, self._wing)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the predicted observations (E, S, U, G), from the design's model or from the FMU itself."""
        if self._scenario.asset.observation_model == "asset" or self._wing is None:
            return self._tabulate(draws, model)
        patch = None if self._given[MODEL_PATCH_COPY] is None else self._path(MODEL_PATCH_COPY)
        return model_observation_table(self._wing, self._scenario, draws, model, patch, self._design)

    def _tabulate(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Ask the FMU for its observation at every draw, state and control: for assets without memory."""
        scenario = self._scenario
        states, controls = model.states.coordinates, scenario.control
        table = np.empty((len(draws.values), len(states), len(controls), scenario.observation.count))
        with self._session() as session:
            chosen = self._observed(session.binding)
            for row, value in enumerate(draws.values):
                session.reset({**self.parameters(), draws.name: float(value)})
                for state, levels in enumerate(states):
                    health = dict(zip(scenario.state_names, levels.tolist(), strict=True))
                    for index, control in enumerate(controls):
                        reading = session.step(control.values, health, scenario.asset.load)
                        table[row, state, index] = reading.values[chosen]
        return table

    def _observed(self, binding: Binding) -> slice:
        """Return where the observed quantity stands among the observations of the binding."""
        return self._slice(binding, self._scenario.observation.role)

    def _slice(self, binding: Binding, role: str) -> slice:
        expected = self._scenario.observation.count
        chosen = binding.observation_slice(role)
        if chosen.stop - chosen.start != expected:
            raise MissionInputError(
                f"the binding {binding.name} observes {chosen.stop - chosen.start} values of `{role}`, and "
                f"the scenario expects {expected}."
            )
        return chosen

    def _inner_roles(self, binding: Binding) -> InnerRoles | None:
        """Return where the asset tells of its own damage and sensors; None where the truth is the scenario's.

        Raises
        ------
        MissionInputError
            The binding has no such monitor or observation.
        """
        truth, asset = self._scenario.truth, self._scenario.asset
        if truth.kind != "asset":
            return None
        if asset.design is None or asset.observation_model == "asset":
            raise MissionInputError(
                "an asset that carries its own damage cannot be asked what the twin should expect of each "
                "state: give `asset.design`, a model for the twin."
            )
        unknown = sorted({*truth.state.values()} - {*binding.monitor})
        if unknown:
            raise MissionInputError(
                f"`truth.state` names the monitor {', '.join(unknown)}, which the binding {binding.name} "
                f"does not know; it knows {', '.join(binding.monitor) or 'none'}."
            )
        return InnerRoles(
            state=truth.state,
            observation=self._slice(binding, truth.observation or self._scenario.observation.role),
            received=None if truth.received is None else self._slice(binding, truth.received),
        )

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the scenario, and the numbers drawn for its seeds."""
        asset = self._scenario.asset
        drawn = generator(self._scenario.mission.seed, "asset").integers(LARGEST_SEED, size=len(asset.seeds))
        return asset.parameters | {name: float(value) for name, value in zip(asset.seeds, drawn, strict=True)}

    def _session(self) -> Session:
        asset = self._scenario.asset
        return FmiAsset(
            self._path(FMU_COPY),
            self._path(BINDING_COPY),
            isolated=asset.isolated,
            step_timeout=asset.step_timeout,
            parameters=self.parameters(),
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
        chosen, inner = self._observed(session.binding), self._inner_roles(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, chosen, self._scenario.asset.load, inner)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write displacement and strain of the wing as VTU, with the parameters of the scenario."""
        if self._design is None:
            return False
        start = 1.0 if self._calibration is None else self._calibration.mean("young_modulus_factor")
        e = self._scenario.asset.parameters.get("young_modulus_factor", start)
        return write_design_field(path, self._scenario, self._design, e, state, control)


def _optional(path: str | None) -> Path | None:
    return None if path is None else Path(path)


def _plain_name(name: str, taken: set[str]) -> str:
    """Return a name under which a variable of an FMU can be stored: without `/`, and not taken."""
    plain = "".join("_" if letter == "/" or not letter.isprintable() else letter for letter in name).strip()
    while plain in taken or not plain:
        plain += "_"
    taken.add(plain)
    return plain
