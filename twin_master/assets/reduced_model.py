"""The reduced model of a wing or structure, as a source of predictions and as an asset."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from fe.structure.tables import StructureDesign, StructureSettings
from reporting.arrays import Float
from reporting.progress import Progress
from reporting.words import comma_list
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, StatelessAsset
from twin_master.assets.parameter import (
    SAME_NAMES,
    ParameterDraws,
    calibrated_means,
    check_calibration,
)
from twin_master.assets.recorded_structure import modal_features
from twin_master.errors import MissionInputError, check_names
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.kinds import FileSection
from twin_master.scenario.observation import ModesSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel


FIELD_NAME = "structure.vtu"
UNITS = {"strain": "1", "displacement": "m", "frequency": "Hz"}
"""The units of the outputs of a reduced model, by role."""


@dataclass(frozen=True)
class Advice:
    """The advice of messages about something that a structure does not have.

    Attributes
    ----------
    calibration : str
        About a calibration with other parameters.
    parameter : str
        About a calibrated parameter that the structure does not have.
    state : str
        About a state, control or observation that the structure does not have; if empty, the
        message names the table that is missing in the structure file.
    static_test : str
        About the calibration source `static_test`; empty if the structure can have it.
    """

    calibration: str
    parameter: str
    state: str = ""
    static_test: str = ""


class ChosenValue(NamedTuple):
    """A value that a scenario gives to an input of a structure.

    Attributes
    ----------
    description : str
        The value in words.
    name : str
        The input.
    value : float
        The value, SI.
    """

    description: str
    name: str
    value: float


class StructureOfFile(AssetSource):
    """A structure from a file, with checks that it has everything that the scenario names."""

    section: Any  # each subclass has a section of its own
    advice: ClassVar[Advice] = Advice(
        calibration=SAME_NAMES,
        parameter="give it in a table [[parameter]]",
        static_test=(
            "the calibration source `static_test` is for wings: for a structure give `file`, or "
            "`normal` or `fixed` with `mean`."
        ),
    )

    @property
    def file(self) -> Path:
        """The structure file: the original before `prepare`, and its copy after it."""
        return self.path(self.section.copies()["structure"])

    @cached_property
    def design(self) -> StructureDesign:
        """The design, which names the inputs and outputs of the structure."""
        from fe.structure.design import load_structure

        return load_structure(self.file)

    @property
    def full_name(self) -> str:
        """The structure by its name, for messages."""
        return f"the structure {self.design.name}"

    @property
    def description(self) -> str:
        """The FMU or model, and the name of the structure."""
        return f"{self.label} of {self.full_name}"

    @property
    def design_hash(self) -> str:
        """The SHA-256 of the design."""
        from fe.structure.design import structure_hash

        return structure_hash(self.design, self.file.parent)

    @property
    def parameter_names(self) -> list[str]:
        """The parameters that may be calibrated."""
        free_masses = [mass.name for mass in self.design.mass if mass.free]
        return [parameter.name for parameter in self.design.parameter] + free_masses

    def load_reduced_model(self, progress: Progress) -> "ReducedModel":
        """Return the reduced model of the structure, from the cache if the cache has it."""
        from fe.reduction.model_cache import reduced_model

        return reduced_model(self.file, progress=progress)

    def check_model(self) -> None:
        """Check the mesh or matrices of the structure, without reducing it."""
        from fe.reduction.model_cache import check_structure

        check_structure(self.file)

    def parameters(self) -> dict[str, float]:
        """Return the mean of each uncertain parameter by name; other parameters are nominal."""
        return calibrated_means(self._scenario.calibration) | self._drawn_means

    def write_field(
        self, path: Path, state: Mapping[str, float], control: Mapping[str, float]
    ) -> bool:
        """Write displacement and strain of the full structure to a VTU file, if it has a mesh.

        Parameters
        ----------
        path : Path
            Any path in the folder of the VTU file, which is always called `structure.vtu`.
        state : mapping of str to float
            The estimated value of each state factor, SI.
        control : mapping of str to float
            The value of each control input, SI.

        Returns
        -------
        bool
            Whether the structure has a mesh.

        Raises
        ------
        FileNotWrittenError
            If the disk is full or the folder cannot be written.
        """
        from fe.structure.matrix_design import MatrixDesign
        from fe.structure.operators import load_and_assemble, write_structure_vtu

        if isinstance(self.design, MatrixDesign):
            return False
        values = {**self.parameters(), **state, **control}
        write_structure_vtu(path.with_name(FIELD_NAME), load_and_assemble(self.file), values)
        return True

    def _frequency_count(self) -> int:
        """Return how many natural frequencies are observed; refuse more than a model has."""
        observation = self._scenario.observation
        if observation.role != "frequency":
            return 0
        most = StructureSettings.mode_count
        if observation.count > most:
            raise MissionInputError(
                f"a structure gives its first {most} frequencies, but {observation.count} are "
                "observed."
            )
        return observation.count

    def _check_observed(self) -> None:
        """Refuse a scenario whose observations the structure does not have."""
        modes = self._scenario.observation.modes
        if modes is None:
            self._check_observed_sensors()
        else:
            self._check_observed_modes(modes)

    def _check_observed_modes(self, modes: ModesSection) -> None:
        """Refuse modes and accelerometers that the structure does not have."""
        most = StructureSettings.mode_count
        highest = max(modes.mode_indices) + 1
        if highest > most:
            raise MissionInputError(
                f"a structure gives its first {most} modes, but mode {highest} is observed."
            )
        accelerometers = [acceleration.name for acceleration in self.design.acceleration]
        names_by_kind = [("accelerometer", modes.accelerometers, accelerometers)]
        advice = self.advice.state or "give it in a table [[acceleration]]"
        check_names("the scenario has the", self.full_name, names_by_kind, advice=advice)

    def _check_observed_sensors(self) -> None:
        """Refuse sensors whose role, unit, number or titles do not fit the structure."""
        observation = self._scenario.observation
        role = observation.role
        sensors = {
            "strain": [gauge.name for gauge in self.design.gauge],
            "displacement": [sensor.name for sensor in self.design.displacement],
        }
        counts = {name: len(names) for name, names in sensors.items()}
        counts["frequency"] = self._frequency_count() or 1  # any structure has frequencies
        roles = [name for name, count in counts.items() if count]
        advice = self.advice.state or f"give it in a table [[{role}]]"
        check_names(
            "the scenario has the", self.full_name, [("observation", [role], roles)], advice=advice
        )
        other_units = sorted(set(observation.sensor_units) - {"1", UNITS[role]})
        if other_units:
            raise MissionInputError(
                f"{self.full_name} gives `{role}` in {UNITS[role]}, but `observation.unit` is "
                f"{comma_list(other_units)}: write {UNITS[role]}."
            )
        if observation.count != counts[role]:
            raise MissionInputError(
                f"{self.full_name} has {counts[role]} sensors of `{role}`, but the scenario "
                f"expects {observation.count}."
            )
        # Titles that are the names of the sensors in another order would name the wrong ones.
        titles = list(observation.titles)
        names = sensors.get(role, [])
        if titles != names and sorted(titles) == sorted(names):
            raise MissionInputError(
                f"`observation.titles` are {comma_list(titles)}, and {self.full_name} has these "
                f"sensors in the order {comma_list(names)}: give the titles in that order."
            )

    def _check_parameter(self, *, believed: bool) -> None:
        """Refuse a calibration whose source, parameters or design do not fit the structure.

        `believed` is true for the structure that the twin takes as its model. Only then must the
        design be the calibrated one: the structure that flies may differ from it.
        """
        calibration = self._scenario.calibration
        if calibration.source == "static_test" and self.advice.static_test:
            raise MissionInputError(self.advice.static_test)
        check_calibration(
            calibration,
            self.parameter_names,
            self.full_name,
            ranges=self.design.ranges,
            advice=self.advice.calibration,
            design_hash=self.design_hash if believed else "",
        )
        parameter_names = [("parameter", [calibration.parameter], self.parameter_names)]
        check_names(
            "the scenario calibrates the",
            self.full_name,
            parameter_names,
            advice=self.advice.parameter,
        )

    def _check_ranges(self, parameters: Mapping[str, float]) -> None:
        """Refuse values of the scenario outside the ranges of the structure's inputs.

        Values of inputs that the structure does not have are not checked.
        """
        for description, name, value in self._chosen_values(parameters):
            low, high = self.design.ranges.get(name, (value, value))  # without a range any value
            if not low <= value <= high:
                raise MissionInputError(
                    f"the {description} is {value:.6g}, but {self.full_name} gives {name} the "
                    f"range {low:g} to {high:g}; give a value inside, or widen the range in its "
                    "file."
                )

    def _chosen_values(self, parameters: Mapping[str, float]) -> Iterator[ChosenValue]:
        """Yield each value that the scenario gives to an input of the structure, with its source.

        `parameters` are values of calibrated or fixed parameters, by name.
        """
        scenario = self._scenario
        for name, value in parameters.items():
            yield ChosenValue(f"parameter {name}", name, value)
        for name, value in scenario.asset.constant_load.items():
            yield ChosenValue(f"load {name}", name, value)
        calibration = scenario.calibration
        if calibration.mean is not None:
            description = "mean of the calibration"
            yield ChosenValue(description, calibration.parameter, calibration.mean)
        for factor in scenario.state:
            for level in factor.levels:
                yield ChosenValue(f"level of {factor.name}", factor.name, level)
        for control in scenario.control:
            for name, value in control.values.items():
                yield ChosenValue(f"{name} of the control {control.name}", name, value)
        if scenario.truth.kind != "scripted":
            return
        for step, state in enumerate(scenario.scripted_history().tolist()):
            when = f"in {scenario.mission.step_name} {step}"
            for name, value in zip(scenario.state_names, state, strict=True):
                yield ChosenValue(f"{name} that `truth.gains` give {when}", name, value)


class ReducedModelSource(StructureOfFile):
    """A reduced model that the twin believes, or that flies without an FMU.

    Parameters
    ----------
    model : ReducedModel, optional
        The reduced model of a wing, if it exists already.
    section : FileSection, optional
        The table of the scenario that names the files.
    """

    label = "reduced model"

    def __init__(
        self,
        scenario: Scenario,
        model: "ReducedModel | None" = None,
        section: FileSection | None = None,
    ) -> None:
        super().__init__(scenario, section)
        self.model = model

    @property
    def prepared_model(self) -> "ReducedModel":
        """The reduced model, once it is prepared."""
        assert self.model is not None
        return self.model

    def check(self) -> None:
        """Check the files and the scenario without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError
            If a file cannot be read or is wrong; if the mesh does not have what the structure
            names; or if the structure does not have the scenario's states, controls, sensors or
            calibrated parameter.
        """
        self.files()
        design = self.design
        scenario = self._scenario
        self._check_parameter(believed=True)
        damage_names = [damage.name for damage in design.damage]
        control_names = [control.name for control in design.control]
        names_by_kind = (
            ("state", scenario.state_names, damage_names),
            ("control input", scenario.control[0].values, control_names),
        )
        advice = self.advice.state
        check_names("the scenario has the", self.full_name, names_by_kind, advice=advice)
        self._check_observed()
        self._check_ranges({})
        self.check_model()

    def _build(self, progress: Progress) -> dict[str, str]:
        """Reduce the structure, and return the hash of its design."""
        self.model = self.model or self.load_reduced_model(progress)
        return {"design": self.model.design_hash}

    @property
    def _observes_modes(self) -> bool:
        """Whether natural frequencies or other features of modes are observed."""
        observation = self._scenario.observation
        return observation.modes is not None or observation.role == "frequency"

    @property
    def _observed_outputs(self) -> slice:
        """The positions of the observed strains or displacements among the static outputs."""
        gauge_count = len(self.prepared_model.gauges)
        if self._scenario.observation.role == "strain":
            return slice(0, gauge_count)
        return slice(gauge_count, None)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Predict the observations (strains, displacements or features of modes) of every case.

        See Kapteyn et al. 2021, eqs. (13) and (15). Natural frequencies are in rising order.
        Features of modes do not depend on the control, and are repeated for each control.

        Parameters
        ----------
        draws : ParameterDraws
            The E draws of the parameter.

        Returns
        -------
        (E, S, U, G) array
            By draw, state, control and sensor, SI.

        Raises
        ------
        OutsideModelError
            If a state, control or draw is outside the ranges of the model.
        """
        draw_count = len(draws.values)
        state_count = len(model.states.coordinates)
        control_count = len(self._scenario.control)
        inputs = self._inputs_of_all_cases(draws, model.states.coordinates)  # (E S U, V)
        if not self._observes_modes:
            outputs = self.prepared_model.static_outputs(inputs)
            observed = outputs[:, self._observed_outputs]  # (E S U, G)
            return observed.reshape(draw_count, state_count, control_count, -1)

        # Modes are computed under control 0 only, because they do not depend on the control.
        input_count = inputs.shape[1]
        inputs_by_case = inputs.reshape(draw_count, state_count, control_count, input_count)
        inputs_of_control_0 = inputs_by_case[:, :, 0].reshape(-1, input_count)  # (E S, V)
        features = np.array([self._observed_features(row) for row in inputs_of_control_0])
        features_of_control_0 = features.reshape(draw_count, state_count, 1, -1)
        return np.repeat(features_of_control_0, control_count, axis=2)

    def _inputs_of_all_cases(self, draws: ParameterDraws, states: Float) -> Float:
        """Return the V model inputs for all combinations of draw, state and control.

        Parameters
        ----------
        states : (S, F) array
            The value of each state factor in each joint state, SI.

        Returns
        -------
        (E * S * U, V) array
            One row for each combination; the control varies fastest, the draw slowest.
        """
        reduced = self.prepared_model
        scenario = self._scenario
        controls = scenario.control
        # The index of draw, state and control in each row.
        indices = np.indices((len(draws.values), len(states), len(controls)))
        draw_of_row, state_of_row, control_of_row = (index.ravel() for index in indices)
        # The values of each input, one for each row or one for all rows.
        input_values: dict[str, Float | float] = {}
        for name, value in scenario.asset.constant_load.items():
            if name in reduced.input_names:
                input_values[name] = value
        for name, values in draws.others.items():
            if name in reduced.input_names:
                input_values[name] = values[draw_of_row]
        input_values[draws.name] = draws.values[draw_of_row]
        input_values |= zip(scenario.state_names, states[state_of_row].T, strict=True)
        for name in controls[0].values:
            values_by_control = np.array([entry.values[name] for entry in controls])
            input_values[name] = values_by_control[control_of_row]
        return reduced.vectors(input_values)

    def _observed_features(self, inputs: Float) -> Float:
        """Return the observed frequencies or features of modes (G,) for inputs (V,)."""
        observation = self._scenario.observation
        model = self.prepared_model
        if observation.modes is not None:
            features = modal_features(model, inputs, observation.modes)
            return observation.modes.observed_features(features)
        return np.asarray(model.modes(inputs).frequency[: observation.count])

    def open(self) -> Asset:
        """Return the model as an asset, with the parameters of the scenario's true asset."""
        model = self.prepared_model
        observed_outputs = self._observed_outputs
        asset = self._scenario.asset
        means = calibrated_means(self._scenario.calibration)
        constants = {**means, **asset.true_parameters, **asset.constant_load}
        constant_inputs = {
            name: value for name, value in constants.items() if name in model.input_names
        }

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            values = {**constant_inputs, **health, **control}
            if self._observes_modes:
                return AssetReading(self._observed_features(model.vector(values)))
            response = model.static_response(values)
            outputs = np.concatenate((response.strain, response.displacement))
            monitors = {"strain_error_bound": response.strain_error_bound}
            return AssetReading(outputs[observed_outputs], monitors)

        return StatelessAsset(observe)
