"""An FMU as the asset of a mission: any FMU with a binding, or one that is packed from a script."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal, Union

import numpy as np
from pydantic import Field

from fmu_asset.archive.fmu_file import packed_design_hash
from fmu_asset.client.binding import Binding, load_binding
from fmu_asset.client.binding_remarks import undeclared_units_sentence, unset_inputs_sentence
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuInputError
from fmu_asset.folders import scratch_folder
from reporting.arrays import Float
from reporting.files import hash_file
from reporting.formats.toml_file import Check, Number, Positive
from reporting.progress import Progress
from reporting.system.log import module_logger
from reporting.units import conversion_of
from twin_master.assets.asset_source import (
    BINDING_COPY,
    FLOWN_DESIGN_HASH,
    Asset,
    AssetBelief,
    AssetReading,
    AssetSource,
    read_files,
    table_of_observations,
)
from twin_master.assets.parameter import (
    ParameterDraws,
    calibrated_means,
    check_calibration,
    read_calibration,
)
from twin_master.errors import MissionInputError, check_names
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import AssetSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import Flag, Name
from twin_master.seeds import generator

if TYPE_CHECKING:
    from calibration.result.record import Calibration as CalibrationRecord
    from fmu_asset.coupling.asset import CoupledAsset


_logger = module_logger(__name__)

Session = Union[FmiAsset, "CoupledAsset"]
"""One FMU, or several coupled ones; both have the same methods."""
FMU_COPY = "asset/asset.fmu"
LARGEST_FMU_SEED = 2**31 - 1
"""The largest value of an integer parameter of an FMU."""
_RESERVED_NAMES = ("state", "sensor_status", "step", "region", "sensor")
"""Names that the truth of a run contains already."""


class FmuSection(AssetSection):
    """The keys of any asset that is one or several FMUs."""

    is_fmu: ClassVar[bool] = True
    binding: str
    """A binding file, or the name of a shipped one."""
    isolated: Flag = True
    """Whether the FMU runs in a process of its own, so that its crash ends no mission."""
    step_timeout: Positive | None = None
    """Limit of the wall-clock time of a step [s]; by default that of the binding."""
    parameters: dict[str, Number] = Field(default_factory=dict)
    """True values of parameters, by the names of the binding [unit of the binding]."""
    load: dict[str, Number] = Field(default_factory=dict)
    """Constant values of load inputs, by the names of the binding [unit of the binding]."""
    seeds: tuple[Name, ...] = ()
    """Parameters of the binding whose values are drawn from the seed of the run."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY}

    def checks(self) -> Iterator[Check]:
        """Yield (has failed, message) for each rule on parameters that are seeds."""
        for name in self.seeds:
            yield (
                name in self.parameters,
                f"`{name}` is both in `parameters` and in `seeds`: keep one of them",
            )


class FmuFileSection(FmuSection):
    """An FMU from a file, made by any tool."""

    kind: Literal["fmu"] = "fmu"
    file: str
    """The FMU."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "file": FMU_COPY}

    def source(self, scenario: Scenario) -> "FmuSource":
        """Return the source of the FMU."""
        return FmuSource(scenario, self)


class ScriptSection(FmuSection):
    """A script of pythonfmu, which is packed as an FMU: a shipped one, or a file."""

    kind: Literal["script"] = "script"
    script: str
    """A script, or the name of a shipped one."""

    copy_paths: ClassVar[Mapping[str, str]] = {"binding": BINDING_COPY, "script": FMU_COPY}

    def portable(self) -> FmuFileSection:
        """Return the table as one of the kind `fmu`, as the run folder contains the packed FMU.

        The paths of files become those of the copies inside the run folder.
        """
        common_keys = [name for name in FmuSection.model_fields if name != "kind"]
        table = {name: getattr(self, name) for name in common_keys}
        table["binding"] = super().portable().model_dump()["binding"]
        table["file"] = FMU_COPY
        return FmuFileSection.model_validate(table)

    def source(self, scenario: Scenario) -> "ScriptSource":
        """Return the source of the FMU."""
        return ScriptSource(scenario, self)


@dataclass(frozen=True)
class TruthOutputs:
    """The outputs of an FMU that report its true state, if damage and sensors are inside it.

    Attributes
    ----------
    state_monitors : mapping of str to str
        The monitor of the binding that holds the true value of a state factor, by the factor's
        name.
    observation : slice
        The positions of the noise-free values among the observed values of the binding.
    received : slice or None
        The positions of the values that are 0 if the reading of a sensor is lost; None if no
        reading is ever lost.
    """

    state_monitors: Mapping[str, str]
    observation: slice
    received: slice | None


class FmuAsset(Asset):
    """The asset of a mission that is one FMU or several coupled ones.

    Parameters
    ----------
    observation : slice
        The positions of the observed quantity among the observed values of the binding.
    load : mapping of str to float
        The load inputs, the same in every step.
    truth_outputs : TruthOutputs, optional
        The outputs that report the truth, if damage and sensors are inside the asset.
    """

    def __init__(
        self,
        session: "Session",
        observation: slice,
        load: Mapping[str, float],
        truth_outputs: TruthOutputs | None = None,
    ) -> None:
        self._session = session
        self._observation = observation
        self._load = dict(load)
        self._truth_outputs = truth_outputs
        binding = session.binding
        reserved_names = {*binding.control, *binding.observation, *_RESERVED_NAMES}
        self._stored_names = _stored_names(session.recorded_units, reserved_names)
        units = {name: entry.unit for name, entry in binding.parameter.items()}
        units |= {name: entry.unit for name, entry in binding.control.items()}
        for name, unit in session.recorded_units.items():
            units[self._stored_names[name]] = unit
        self.units = units

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make one communication step, and return the observation at its end.

        If the asset has damage and sensors of its own, the reading contains the true state, and
        lost sensors are NaN.

        Parameters
        ----------
        control : mapping of str to float
            The value of each control input, SI.
        health : mapping of str to float
            The true value of each state factor, SI.
        """
        observation = self._session.step(control, health, self._load)
        sensed = observation.values[self._observation]
        monitors = {self._stored_names[name]: value for name, value in observation.extra.items()}
        outputs = self._truth_outputs
        if outputs is None:
            return AssetReading(sensed, monitors)
        state = {}
        for factor, monitor in outputs.state_monitors.items():
            state[factor] = observation.extra[monitor]
        if outputs.received is not None:
            is_lost = observation.values[outputs.received] == 0.0
            sensed = np.where(is_lost, np.nan, sensed)
        return AssetReading(observation.values[outputs.observation], monitors, state, sensed)

    def save_state(self) -> bytes:
        """Return the state of the FMU."""
        return self._session.save_state()

    def restore_state(self, state: bytes) -> None:
        """Continue from a saved state."""
        self._session.restore_state(state)

    def close(self) -> None:
        """Close the FMU."""
        self._session.close()


def _stored_names(names: Iterable[str], reserved_names: Iterable[str]) -> dict[str, str]:
    """Return the name of each FMU variable in the run's NetCDF file, which allows fewer characters.

    `/` would make a group in that file; it and unprintable characters become `_`. A name that is
    reserved or already used gets `_` at its end until it is unique.
    """
    used_names = set(reserved_names)
    stored_names = {}
    for name in names:
        characters = ["_" if char == "/" or not char.isprintable() else char for char in name]
        stored_name = "".join(characters).strip()
        while not stored_name or stored_name in used_names:
            stored_name += "_"
        used_names.add(stored_name)
        stored_names[name] = stored_name
    return stored_names


class FmuSource(AssetSource):
    """The source of an asset that is one FMU.

    Parameters
    ----------
    section : FmuSection
        The table `asset` of the scenario.
    """

    # An FMU may hold any model, also that of the believed design, so that it is not known whether
    # the two differ.
    label = "FMU"
    section: FmuSection

    def binding(self) -> Binding:
        """Return the binding: the original before `prepare`, and the copy after it."""
        return load_binding(self.path(BINDING_COPY))

    def check(self) -> None:
        """Check that the files, the binding and the scenario fit together; nothing is copied.

        Raises
        ------
        MissionInputError
            If a file cannot be read, or the binding does not fit the scenario.
        CalibrationRecordError
            If the calibration file is damaged or of another kind, or has no samples of the
            parameter.
        FmuError, FiniteElementError
            If binding, FMU, script, design or structure is wrong, or the binding does not fit the
            FMU.
        """
        calibration = read_calibration(self._scenario.calibration)
        self.files()
        binding = self.binding()
        self._check_calibration(binding)
        self._check_names(binding)
        binding = self._fit_binding(binding)
        self._observation_slice(binding)
        self._find_truth_outputs(binding)
        self._check_state_units(binding)
        if calibration is not None and calibration.design is None:
            _check_calibrated_units(binding, calibration)

    def _check_calibration(self, binding: Binding) -> None:
        """Refuse a calibration file of unknown parameters, or of another design than the FMU's.

        The design is compared only if the twin believes the FMU itself and the FMU records it.
        """
        calibration = self._scenario.calibration
        believes_fmu = isinstance(self._scenario.belief, AssetBelief)
        design_hash = ""
        if believes_fmu and FMU_COPY in self.file_paths:
            design_hash = packed_design_hash(self.path(FMU_COPY))
        binding_label = f"the binding {binding.name}"
        check_calibration(calibration, binding.parameter, binding_label, design_hash=design_hash)

    def _effect_parameters(self) -> tuple[str, ...]:
        """Return the FMU's parameters of missing effects, which the binding does not list."""
        return ()

    def _check_names(self, binding: Binding) -> None:
        """Refuse states, control inputs, loads and parameters that the binding does not have."""
        scenario = self._scenario
        section = self.section
        # If the damage is inside the asset, the binding has no health inputs.
        states = () if scenario.truth.kind == "asset" else scenario.state_names
        given_parameters = (*section.parameters, *section.seeds)
        known_parameters = (*binding.parameter, *self._effect_parameters())
        owner = "the scenario has the"
        label = f"the binding {binding.name}"
        advice = (
            "bind each state in a table [health.NAME] to an input of the FMU, or to a parameter "
            "that is set at the start"
        )
        check_names(owner, label, [("state", states, binding.health)], advice=advice)
        names_by_kind = (
            ("control input", scenario.control[0].values, binding.control),
            ("load", section.load, binding.load),
            ("parameter", given_parameters, known_parameters),
        )
        check_names(owner, label, names_by_kind)

    def _fit_binding(self, binding: Binding) -> Binding:
        """Check the binding against the FMU; return it with the lengths of the FMU's arrays.

        If the FMU refuses the value of a parameter, the error also names the calibrated parameters,
        as one of them may be the cause.
        """
        try:
            with scratch_folder() as scratch:
                return self._fit_to_fmu(binding, scratch)
        except FmuInputError as error:
            calibrated_values = []
            for name, mean in calibrated_means(self._scenario.calibration).items():
                if name not in self.section.parameters:
                    calibrated_values.append(f"{name} = {mean:.6g}")
            if not calibrated_values:
                raise
            raise MissionInputError(
                f"{error} The calibration has {', '.join(calibrated_values)}: give a calibration "
                "of the asset that flies, or name the parameter in `asset.parameters`."
            ) from error

    def _fit_to_fmu(self, binding: Binding, scratch: Path) -> Binding:
        """Check the binding against the FMU; return it with the lengths of the FMU's arrays.

        A subclass may write into the scratch folder, which the caller removes.
        """
        asset = FmiAsset(self.path(FMU_COPY), binding, parameters=self.parameters())
        self._warn_of_unset_inputs(asset)
        warning = undeclared_units_sentence(asset.description, asset.binding)
        if warning:
            _logger.warning("%s", warning)
        return asset.binding

    def _warn_of_unset_inputs(self, asset: FmiAsset) -> None:
        """Warn of inputs of an FMU that keep their start values during the whole mission.

        An FMU that uav-twin packed from a design of a wing or structure is skipped: its unset
        inputs are forces, which are rightly zero.
        """
        is_packed_from_design = packed_design_hash(asset.description.path) != ""
        if is_packed_from_design:
            return
        # Every control has values for the same inputs, so that the first one names all of them.
        inputs_with_values = {
            "control": self._scenario.control[0].values.keys(),
            "health": self._scenario.state_names,
            "load": self.section.load.keys(),
        }
        warning = unset_inputs_sentence(asset.description, asset.binding, inputs_with_values)
        if warning:
            _logger.warning("%s", warning)

    def _check_state_units(self, binding: Binding) -> None:
        """Refuse a state factor whose monitor or health input has another unit."""
        state_monitors = self._scenario.truth.state
        for factor in self._scenario.state:
            if state_monitors:
                bound_unit = binding.monitor[state_monitors[factor.name]].unit
            else:
                bound_unit = binding.health[factor.name].unit
            factor_label = f"the state {factor.name}"
            _check_unit(binding, factor_label, bound_unit, "state.unit", factor.unit)

    def _build(self, progress: Progress) -> dict[str, str]:
        """Return the hashes of the FMU, and of the wing design inside it, if there is one."""
        hashes = {}
        design_hash = packed_design_hash(self.path(FMU_COPY))
        if design_hash:
            hashes[FLOWN_DESIGN_HASH] = design_hash
        hashes["fmu"] = hash_file(self.path(FMU_COPY))
        return hashes

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Predict the observations (E, S, U, G) by the FMU, by draw, state, control and sensor.

        The FMU is reset once for each draw, and then makes one step for each state and control. An
        FMU that remembers earlier steps would therefore give wrong predictions.
        """
        load = self.section.load
        tables = []
        with self._open_session(self.binding(), self.parameters()) as session:
            observation = self._observation_slice(session.binding)
            bound_parameters = session.binding.parameter

            def predict(control: Mapping[str, float], health: Mapping[str, float]) -> Float:
                return session.step(control, health, load).values[observation]

            for draw, value in enumerate(draws.values):
                parameters = self.parameters()
                for name, values in draws.others.items():
                    if name in bound_parameters:
                        parameters[name] = float(values[draw])
                parameters[draws.name] = float(value)
                session.reset(parameters)
                states = model.states.coordinates
                tables.append(table_of_observations(self._scenario, states, predict))
        return np.array(tables)

    def _observation_slice(self, binding: Binding, role: str = "") -> slice:
        """Return the positions of an observed quantity among the observed values of the binding.

        `role` is the name of the quantity in the binding; by default, the one that the scenario
        observes. It must have as many values as the scenario expects, in the same units.
        """
        observation = self._scenario.observation
        role = role or observation.role
        positions = self._slice_of_role(binding, role)
        bound_units = binding.observation[role].units
        unit_pairs = zip(bound_units, observation.sensor_units, strict=True)
        for number, (bound_unit, unit) in enumerate(unit_pairs, 1):
            value_label = f"value {number} of `{role}`"
            _check_unit(binding, value_label, bound_unit, "observation.unit", unit)
        return positions

    def _slice_of_role(self, binding: Binding, role: str) -> slice:
        """Return the positions of a role's values; raise an error if the scenario expects others.

        The scenario states how many values an observation has.
        """
        expected_count = self._scenario.observation.count
        positions = binding.observation_slice(role)
        count = positions.stop - positions.start
        if count != expected_count:
            raise MissionInputError(
                f"the binding {binding.name} observes {count} values of `{role}`, but the scenario "
                f"expects {expected_count}."
            )
        return positions

    def _find_truth_outputs(self, binding: Binding) -> TruthOutputs | None:
        """Return the outputs that report the true state; None if the scenario states it itself.

        The true state happens inside the asset if `truth.kind` is "asset". Then `truth.state` names
        the monitor of the true value of each state factor, `truth.observation` the readings without
        noise, and `truth.received` the values that are 0 for a lost reading.

        Raises
        ------
        MissionInputError
            If the binding lacks a monitor or observation that `truth` names, or the twin uses the
            asset itself as its model.
        """
        truth = self._scenario.truth
        if truth.kind != "asset":
            return None
        if isinstance(self._scenario.belief, AssetBelief):
            raise MissionInputError(
                "an asset with damage of its own cannot predict the observations of each state: "
                "name a model for the twin in the table `belief`."
            )
        names_by_kind = [("monitor", truth.state.values(), binding.monitor)]
        check_names(
            owner="`truth.state` names the",
            reference=f"the binding {binding.name}",
            rows=names_by_kind,
        )
        received_positions = None
        if truth.received is not None:
            received_positions = self._slice_of_role(binding, truth.received)
        # without a name of its own, the true observation has that of the scenario's observation
        observation = self._observation_slice(binding, role=truth.observation or "")
        return TruthOutputs(truth.state, observation, received_positions)

    def parameters(self) -> dict[str, float]:
        """Return the parameters of the FMU.

        They are those of the scenario, a random integer for each parameter in `seeds`, and the
        posterior means of the calibration. A value of the scenario replaces a mean.
        """
        section = self.section
        random = generator(self._scenario.mission.seed, "asset")
        integers = random.integers(LARGEST_FMU_SEED, size=len(section.seeds))
        seeds = {name: float(seed) for name, seed in zip(section.seeds, integers, strict=True)}
        return calibrated_means(self._scenario.calibration) | section.parameters | seeds

    def _open_session(self, binding: Binding, parameters: Mapping[str, float]) -> "Session":
        """Return the FMU with a binding and parameters, ready to be started."""
        return FmiAsset(
            self.path(FMU_COPY),
            binding,
            isolated=self.section.isolated,
            step_timeout=self.section.step_timeout,
            parameters=parameters,
        )

    def open(self) -> Asset:
        """Return the FMU in its initial state, with the parameters of the scenario.

        Raises
        ------
        FmuError
            If the FMU cannot be flown, or the binding does not fit it.
        MissionInputError
            If the binding does not fit the scenario.
        """
        session = self._open_session(self.binding(), self.parameters())
        observation = self._observation_slice(session.binding)
        truth_outputs = self._find_truth_outputs(session.binding)
        try:
            session.reset()
        except BaseException:
            session.close()
            raise
        return FmuAsset(session, observation, self.section.load, truth_outputs)


def _check_calibrated_units(binding: Binding, calibration: "CalibrationRecord") -> None:
    """Refuse a calibrated parameter whose unit differs from that in the binding."""
    for prior in calibration.priors:
        if prior.name in binding.parameter:
            bound_unit = binding.parameter[prior.name].unit
            parameter_label = f"the parameter {prior.name}"
            _check_unit(binding, parameter_label, bound_unit, "calibration.file", prior.unit)


def _check_unit(binding: Binding, what: str, bound_unit: str, key: str, unit: str) -> None:
    """Refuse a unit of the scenario that is not the unit in the binding.

    The unit "1" is the default of a scenario, and so may stand for any unit. It is refused only if
    the binding's unit is dimensionless with a factor, such as %, because the values would then be
    misread.

    Parameters
    ----------
    what, bound_unit : str
        The quantity in words, and its unit in the binding.
    key, unit : str
        The key of the scenario, and the unit that it states.
    """
    if bound_unit == unit:
        return  # saves the third of a second in which the library of units loads
    conversion = conversion_of(bound_unit)
    is_scaled_fraction = (
        conversion is not None and not any(conversion.exponents) and conversion.factor != 1.0
    )
    if unit != "1" or is_scaled_fraction:
        raise MissionInputError(
            f"the binding {binding.name} gives {what} in {bound_unit}, and `{key}` of the scenario "
            f"says {unit}: write the same unit in both."
        )


class ScriptSource(FmuSource):
    """An FMU that is packed from a model script."""

    def files(self) -> dict[str, bytes]:
        """Return the contents of the binding and of the packed FMU by the paths of their copies.

        Raises
        ------
        MissionInputError
            If a file cannot be read.
        FmuBuildError
            If the script cannot be packed.
        """
        from fmu_asset.packing.script import script_fmu

        other_files = dict(self.file_paths)
        script = other_files.pop(FMU_COPY)
        return {**read_files(other_files), FMU_COPY: script_fmu(script).content}

    def _fit_to_fmu(self, binding: Binding, scratch: Path) -> Binding:
        """Pack the FMU in the scratch folder; return the binding with the lengths of its arrays."""
        packed_fmu = scratch / "asset.fmu"
        packed_fmu.write_bytes(self.files()[FMU_COPY])
        asset = FmiAsset(packed_fmu, binding, parameters=self.parameters())
        self._warn_of_unset_inputs(asset)
        return asset.binding
