"""A reduced model, of a wing or a structure: what it predicts, itself as an asset, and modes of records."""

from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fe.runtime.modal_system import rayleigh_damping_ratio
from fe.structure.tables import StructureDesign, StructureSettings
from fmu_asset.client.binding import Binding
from reporting.arrays import Float
from reporting.progress import Progress
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, StatelessAsset
from twin_master.assets.parameter import (
    SAME_NAMES,
    ParameterDraws,
    calibrated_means,
    check_calibration,
)
from twin_master.errors import MissionInputError, check_names, said
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.identified import packed_row
from twin_master.scenario.kinds import FileSection
from twin_master.scenario.observation import MODES_ROLE, ModesSection
from twin_master.scenario.schema import Scenario
from twin_master.seeds import seed_sequence

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from twin_master.assets.fmu_source import Session


FIELD_NAME = "structure.vtu"
UNITS = {"strain": "1", "displacement": "m", "frequency": "Hz"}
"""Of what a reduced model shows, by role."""


class NamedStructure(AssetSource):
    """A structure that a scenario names, and whether the scenario speaks of what it has."""

    section: Any
    advice: ClassVar[Mapping[str, str]] = {
        "calibration": SAME_NAMES,
        "parameter": "give it in a table [[parameter]]",
        "state": "",
        "static_test": "the calibration source `static_test` is for wings: of a structure give `file`, or "
        "`normal` or `fixed` with `mean`.",
    }
    """What to do about names that it does not have, and about a source of calibrations that it cannot."""

    @property
    def file(self) -> Path:
        """Its file, where it is given, or its copy once kept."""
        return self.path(self.section.copies()["structure"])

    @cached_property
    def design(self) -> StructureDesign:
        """By name what can be chosen of it, commanded and read."""
        from fe.structure.design import load_structure

        return load_structure(self.file)

    @property
    def where(self) -> str:
        """What has these names, in words."""
        return f"the structure {self.design.name}"

    @property
    def words(self) -> str:
        """The FMU or model with its name."""
        return f"{self.label} of {self.where}"

    @property
    def hash(self) -> str:
        """SHA-256 of its design."""
        from fe.structure.design import structure_hash

        return structure_hash(self.design, self.file.parent)

    @property
    def parameter_names(self) -> list[str]:
        """What may be calibrated."""
        free = [part.name for part in self.design.mass if part.free]
        return [part.name for part in self.design.parameter] + free

    def reduced(self, progress: Progress) -> "ReducedModel":
        """Return the reduced model, from the cache if it is there."""
        from fe.reduction.model_cache import reduced_model

        return reduced_model(self.file, progress=progress)

    def check_model(self) -> None:
        """Look at what the reduced model is made of, as far as that takes no time."""
        from fe.reduction.model_cache import check_structure

        check_structure(self.file)

    def parameters(self) -> dict[str, float]:
        """Return what it is drawn with, by name; what is not among them is nominal."""
        return calibrated_means(self._scenario.calibration) | self._means

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Solve the full structure and write displacement and strain as VTU, if it has a mesh.

        Raises
        ------
        FileNotWrittenError
            The disk is full or the folder cannot be written.
        """
        from fe.structure.matrix_design import MatrixDesign
        from fe.structure.operators import load_and_assemble, write_structure_vtu

        if isinstance(self.design, MatrixDesign):
            return False
        values = {**self.parameters(), **state, **control}
        write_structure_vtu(path.with_name(FIELD_NAME), load_and_assemble(self.file), values)
        return True

    def _frequencies(self) -> int:
        """Return how many natural frequencies are observed; raises `MissionInputError` for too many."""
        if self._scenario.observation.role != "frequency":
            return 0
        count, most = self._scenario.observation.count, StructureSettings.mode_count
        if count > most:
            raise MissionInputError(said("assets.frequencies", most=most, count=count))
        return count

    def _check_observed(self) -> None:
        """Refuse observations that the structure does not have; raises `MissionInputError`.

        Titles that are its sensors in another order raise `MissionInputError`: they would name the wrong
        ones.
        """
        design, observation = self.design, self._scenario.observation
        where, role, modes = self.where, observation.role, observation.modes
        names = {
            "strain": [part.name for part in design.gauge],
            "displacement": [part.name for part in design.displacement],
        }
        known = {name: len(sensors) for name, sensors in names.items()}
        known |= {"frequency": self._frequencies() or 1}
        row, table = ("observation", [role], [name for name, count in known.items() if count]), role
        if modes is not None:
            known[MODES_ROLE] = observation.count
            there = [part.name for part in design.acceleration]
            row, table = ("accelerometer", [*modes.accelerometers], there), "acceleration"
            most = StructureSettings.mode_count
            if max(modes.mode_indices) >= most:
                number = max(modes.mode_indices) + 1
                raise MissionInputError(said("assets.modes", most=most, number=number))
        advice = self.advice["state"] or f"give it in a table [[{table}]]"
        check_names("the scenario has the", where, [row], advice=advice)
        if modes is None and (came := sorted({*observation.sensor_units} - {"1", UNITS[role]})):
            raise MissionInputError(
                said("assets.own_unit", where=where, role=role, own=UNITS[role], came=came)
            )
        if observation.count != known[role]:
            both = {"has": known[role], "count": observation.count}
            raise MissionInputError(said("assets.sensors", where=where, role=role, **both))
        titles, own = [*observation.titles], names.get(role, [])
        if titles != own and sorted(titles) == sorted(own):
            raise MissionInputError(said("assets.titles", titles=titles, where=where, own=own))

    def _check_parameter(self, *, believed: bool) -> None:
        """Refuse a calibration that the structure cannot have; raises `MissionInputError`."""
        calibration, known = self._scenario.calibration, self.parameter_names
        if refusal := self.advice.get(calibration.source):
            raise MissionInputError(refusal)
        check_calibration(
            calibration, known, self.where, ranges=self.design.ranges, advice=self.advice["calibration"],
            design_hash=self.hash if believed else "",
        )  # fmt: skip
        rows = [("parameter", [calibration.parameter], known)]
        check_names("the scenario calibrates the", self.where, rows, advice=self.advice["parameter"])

    def _check_ranges(self, parameters: Mapping[str, float]) -> None:
        """Refuse levels, controls, loads and `parameters` outside the ranges; raises `MissionInputError`.

        A name that the structure does not have is passed over.
        """
        scenario, ranges = self._scenario, self.design.ranges
        given = [(f"parameter {name}", name, value) for name, value in parameters.items()]
        given += [(f"load {name}", name, value) for name, value in scenario.asset.constant_load.items()]
        if (mean := scenario.calibration.mean) is not None:
            given.append(("mean of the calibration", scenario.calibration.parameter, mean))
        given += [(f"level of {f.name}", f.name, level) for f in scenario.state for level in f.levels]
        given += [
            (f"{name} of the control {control.name}", name, value)
            for control in scenario.control
            for name, value in control.values.items()
        ]
        if scenario.truth.kind == "scripted":
            given += [
                (
                    f"{name} that `truth.gains` give in {scenario.mission.step_name} {step}",
                    name,
                    value,
                )
                for step, state in enumerate(scenario.scripted_history().tolist())
                for name, value in zip(scenario.state_names, state, strict=True)
            ]
        for what, name, value in given:
            low, high = ranges.get(name, (value, value))
            if not low <= value <= high:
                what, ends = f"{what} is {value:.6g}, but {self.where}", (low, high)
                raise MissionInputError(said("assets.outside", what=what, name=name, ends=ends))


class ReducedModelSource(NamedStructure):
    """A reduced model, believed or flown without an FMU.

    Parameters
    ----------
    scenario : Scenario
        What is flown.
    model : ReducedModel, optional
        Where it is there already, of a wing.
    section : FileSection, optional
        The table that names the files.
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
    def wing(self) -> "ReducedModel":
        """The reduced model, once prepared."""
        assert self.model is not None
        return self.model

    def check(self) -> None:
        """Read the file without building anything.

        Raises
        ------
        MissionInputError, FiniteElementError
            A file cannot be read or is wrong, or the mesh does not hold what the structure names; or the
            scenario's states, controls, sensors or calibrated parameter are not those of the structure.
        """
        self.files()
        design, scenario = self.design, self._scenario
        self._check_parameter(believed=True)
        rows = (
            ("state", scenario.state_names, [part.name for part in design.damage]),
            ("control input", scenario.control[0].values, [part.name for part in design.control]),
        )
        check_names("the scenario has the", self.where, rows, advice=self.advice["state"])
        self._check_observed()
        self._check_ranges({})
        self.check_model()

    def _make(self, progress: Progress) -> dict[str, str]:
        self.model = self.model or self.reduced(progress)
        return {"design": self.model.design_hash}

    @property
    def _outputs(self) -> slice:
        """Which outputs of the model are observed, where those at rest are."""
        gauges = len(self.wing.gauges)
        return slice(0, gauges) if self._scenario.observation.role == "strain" else slice(gauges, None)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return strains, displacements, natural frequencies or features of modes (E, S, U, G).

        Kapteyn et al. 2021, eqs. (13), (15). Frequencies are in rising order; they and modes do not depend on
        the control.

        Raises
        ------
        OutsideModelError
            A state, control or draw lies outside the ranges of the model.
        """
        reduced, scenario = self.wing, self._scenario
        states, controls = model.states.coordinates, scenario.control
        shape = (len(draws.values), len(states), len(controls))
        draw, state, control = (index.ravel() for index in np.indices(shape))
        beside = {
            **scenario.asset.constant_load,
            **{n: values[draw] for n, values in draws.others.items()},
        }
        columns: dict[str, Float | float] = {
            n: value for n, value in beside.items() if n in reduced.input_names
        }
        columns[draws.name] = draws.values[draw]
        columns |= zip(scenario.state_names, states[state].T, strict=True)
        for name in controls[0].values:
            columns[name] = np.array([item.values[name] for item in controls])[control]
        vectors = reduced.vectors(columns)
        observation = scenario.observation
        if observation.modes is None and observation.role != "frequency":
            return reduced.static_outputs(vectors)[:, self._outputs].reshape(*shape, -1)
        first = vectors.reshape(*shape, -1)[:, :, 0].reshape(-1, vectors.shape[1])
        found = np.array([self._moving(vector) for vector in first]).reshape(*shape[:2], 1, -1)
        return np.repeat(found, shape[2], axis=2)

    def _moving(self, vector: Float) -> Float:
        """Return the natural frequencies or features of modes that are observed (G,)."""
        observation = self._scenario.observation
        if observation.modes is not None:
            return observation.modes.observed_features(modal_values(self.wing, vector, observation.modes))
        return np.asarray(self.wing.modes(vector).frequency[: observation.count])

    def open(self) -> Asset:
        """Return the model as an asset, with the parameters of the scenario's true asset."""
        model, observation, outputs = self.wing, self._scenario.observation, self._outputs
        asset, means = self._scenario.asset, calibrated_means(self._scenario.calibration)
        given = {**means, **asset.true_parameters, **asset.constant_load}
        known = {name: value for name, value in given.items() if name in model.input_names}

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            values = {**known, **health, **control}
            if observation.modes is not None or observation.role == "frequency":
                return AssetReading(self._moving(model.vector(values)))
            found = model.static_response(values)
            shown = np.concatenate((found.strain, found.displacement))[outputs]
            return AssetReading(shown, {"strain_error_bound": found.strain_error_bound})

        return StatelessAsset(observe)


def modal_values(
    model: "ReducedModel",
    vector: Float,
    section: ModesSection,
    damping: tuple[float, float] | None = None,
) -> Float:
    """Return frequency [Hz], damping ratio and relative shape (M, 1 + A) of the observed modes of a model.

    Parameters
    ----------
    model : ReducedModel
    vector : (V,)
        Values of all that can be chosen.
    section : ModesSection
        Which modes, at which accelerometers.
    damping : (float, float), optional
        Rayleigh's alpha [1/s] and beta [s]; those of the model by default.

    Raises
    ------
    OutsideModelError
        A value lies outside the ranges of the model.
    """
    modes = model.modes(vector)
    alpha, beta = model.damping.tolist() if damping is None else damping
    frequency = modes.frequency[section.mode_indices]
    rows = [model.static_output_count + model.accelerations.index(name) for name in section.accelerometers]
    shape = modes.output[rows][:, section.mode_indices]
    return np.column_stack(
        [frequency, rayleigh_damping_ratio(alpha, beta, frequency), *(shape[1:] / shape[0])]
    )


class RecordedStructure(Asset):
    """The FMU of a structure in motion: each step makes a record of accelerations and identifies its modes.

    Each record begins anew at rest; what the sensors say are the features that were identified, with their
    covariance, and the noise-free observation are those of the model that was packed.

    Parameters
    ----------
    scenario : Scenario
        With `observation.modes` and `truth.record`.
    model : ReducedModel
        The model that was packed.
    session : callable
        Opens the FMU with a binding and parameters.
    binding : Binding
        Of the FMU.
    parameters : mapping of str to float
        Of the true structure.
    """

    def __init__(
        self,
        scenario: Scenario,
        model: "ReducedModel",
        session: "Callable[[Binding, Mapping[str, float]], Session]",
        binding: Binding,
        parameters: Mapping[str, float],
    ) -> None:
        assert scenario.observation.modes is not None
        assert scenario.truth.record is not None
        self._scenario, self._model = scenario, model
        self._section, self._record = scenario.observation.modes, scenario.truth.record
        bound = binding.with_header(step_size=1.0 / self._record.sampling_rate, decimation=1)
        self._parameters = {**parameters, "response": 2.0}
        self._session = session(bound, self._parameters)
        begin, names = bound.observation_slice("acceleration").start, self._section.accelerometers
        variables = bound.observation["acceleration"].variables
        self._chosen = [begin + variables.index(f"acceleration.{name}") for name in names]
        self.units = {name: item.unit for name, item in (*bound.parameter.items(), *bound.control.items())}
        self._step = 0

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make and identify the record of a step.

        Raises
        ------
        FmuError
            The FMU refuses an input, or fails.
        ExperimentDataError
            The record is too short for the bands.
        """
        from calibration.dynamics.modal_identification import identify_modes

        section, record, model = self._section, self._record, self._model
        root = seed_sequence(self._scenario.mission.seed, "asset")
        random = np.random.default_rng([*root.generate_state(4).tolist(), self._step])
        count = round(record.duration * record.sampling_rate)
        held: dict[str, float] = dict(control)
        course: dict[str, Float | float] = dict(control)
        if record.kind == "ambient":
            course[record.input] = held[record.input] + record.amplitude * random.standard_normal(count)
        else:
            held[record.input] += record.amplitude
        self._session.reset(self._parameters, control=held, health=health)
        history = self._session.simulate(control=course, health=health, steps=count)
        acceleration = history.values[:, self._chosen]
        acceleration = acceleration + record.noise * random.standard_normal(acceleration.shape)
        found = identify_modes(acceleration, record.sampling_rate, section.bands, record.kind)
        self._step += 1
        given = {**self._parameters, **control, **health}
        vector = model.vector({name: value for name, value in given.items() if name in model.input_names})
        alpha, beta = model.damping.tolist()
        damping = given.get("damping_alpha", alpha), given.get("damping_beta", beta)
        errors = section.observed_features(found.standard_error).tolist()
        titles = self._scenario.observation.titles
        sensed = packed_row(
            section.observed_features(found.value), section.observed_covariance(found.covariance)
        )
        return AssetReading(
            section.observed_features(modal_values(model, vector, section, damping)),
            {f"standard_error_{title}": error for title, error in zip(titles, errors, strict=True)},
            sensed=sensed,
        )

    def save_state(self) -> bytes:
        """Return the number of records made: each begins anew."""
        return str(self._step).encode()

    def restore_state(self, state: bytes) -> None:
        """Go on behind as many records."""
        self._step = int(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()
