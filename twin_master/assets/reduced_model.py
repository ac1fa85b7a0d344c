"""A reduced model, of a wing or a structure: what it predicts, itself as an asset, and modes of records."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from fe.runtime.modal_system import rayleigh_damping_ratio
from fmu_asset.door.binding import Binding
from reporting.arrays import Float
from reporting.progress import Progress
from twin_master.assets.asset_source import Asset, AssetReading, AssetSource, InnerTruth, StatelessAsset
from twin_master.assets.parameter import ParameterDraws, calibrated_means
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.identified import packed_row
from twin_master.scenario.asset import FileSection
from twin_master.scenario.schema import Scenario
from twin_master.scenario.section import ModesSection
from twin_master.seeds import seed_sequence

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel
    from twin_master.assets.fmu_source import Session


class ReducedModelSource(AssetSource):
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

    label = "reduced model of the wing"

    def __init__(
        self, scenario: Scenario, model: "ReducedModel | None" = None, section: FileSection | None = None
    ) -> None:
        super().__init__(scenario, section)
        self.model = model

    @property
    def wing(self) -> "ReducedModel":
        """The reduced model, once prepared."""
        assert self.model is not None
        return self.model

    def _make(self, progress: Progress) -> dict[str, str]:
        return {"design": self.wing.design_hash}

    @property
    def _true_values(self) -> dict[str, float]:
        """What of the true asset is the same in every step, by the names of the model."""
        asset = self._scenario.asset
        means = calibrated_means(self._scenario.calibration)
        given = {**means, **asset.true_parameters, **asset.constant_load}
        return {name: value for name, value in given.items() if name in self.wing.chosen}

    @property
    def _outputs(self) -> slice:
        """Which outputs of the model are observed, where those at rest are."""
        gauges = self.wing.gauge_count
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
        beside = {**scenario.asset.constant_load, **{n: values[draw] for n, values in draws.others.items()}}
        columns: dict[str, Float | float] = {n: value for n, value in beside.items() if n in reduced.chosen}
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
            return observation.modes.observed(modal_values(self.wing, vector, observation.modes))
        return np.asarray(self.wing.modes(vector).frequency[: observation.count])

    def open(self) -> Asset:
        """Return the model as an asset, with the parameters of the scenario's true asset."""
        model, known, observation = self.wing, self._true_values, self._scenario.observation
        outputs = self._outputs

        def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
            values = {**known, **health, **control}
            if observation.modes is not None or observation.role == "frequency":
                return AssetReading(self._moving(model.vector(values)))
            found = model.static_response(values)
            shown = np.concatenate((found.strain, found.displacement))[outputs]
            return AssetReading(shown, {"strain_error_bound": found.strain_error_bound})

        return StatelessAsset(observe)


def modal_values(
    model: "ReducedModel", vector: Float, section: ModesSection, damping: tuple[float, float] | None = None
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
    frequency = modes.frequency[section.places]
    rows = [model.static_count + model.accelerations.index(name) for name in section.accelerometers]
    shape = modes.output[rows][:, section.places]
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
        bound = binding.with_header(step_size=1.0 / self._record.sampling_rate)
        self._parameters = {**parameters, "response": 2.0}
        self._session = session(bound, self._parameters)
        begin, names = bound.observation_slice("acceleration").start, self._section.accelerometers
        variables = bound.observation["acceleration"].variables
        self._chosen = [begin + variables.index(f"acceleration.{name}") for name in names]
        self.units = {name: item.unit for name, item in (*bound.parameter.items(), *bound.control.items())}
        self._turn = 0

    def step(self, control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        """Make and identify the record of a turn.

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
        random = np.random.default_rng([*root.generate_state(4).tolist(), self._turn])
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
        self._turn += 1
        given = {**self._parameters, **control, **health}
        vector = model.vector({name: value for name, value in given.items() if name in model.chosen})
        alpha, beta = model.damping.tolist()
        damping = given.get("damping_alpha", alpha), given.get("damping_beta", beta)
        errors = section.observed(found.standard_error).tolist()
        titles = self._scenario.observation.titles
        sensed = packed_row(section.observed(found.value), section.covariance(found.covariance))
        return AssetReading(
            section.observed(modal_values(model, vector, section, damping)),
            {f"standard_error_{title}": error for title, error in zip(titles, errors, strict=True)},
            InnerTruth({}, sensed),
        )

    def save_state(self) -> bytes:
        """Return the number of records made: each begins anew."""
        return str(self._turn).encode()

    def restore_state(self, state: bytes) -> None:
        """Go on behind as many records."""
        self._turn = int(state)

    def close(self) -> None:
        """End the worker."""
        self._session.close()
