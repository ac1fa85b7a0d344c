"""A reduced model, of a wing or a structure, in a scenario: what it predicts, and itself as an asset."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from twin_master.assets.asset_source import Source
from twin_master.assets.interface import Asset, AssetReading, StatelessAsset
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.structure_modes import modal_values
from twin_master.errors import MissingObservationModelError, MissionInputError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.asset import FileSection
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel

Float = NDArray[np.float64]


class ReducedModelSource(Source):
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
        self._means: dict[str, float] = {}

    @property
    def wing(self) -> "ReducedModel":
        """The reduced model, once prepared."""
        if self.model is None:
            raise MissionInputError("the model was not prepared: call `prepare` first.")
        return self.model

    def _make(self, progress: Progress) -> dict[str, str]:
        return {"design": self.wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of the parameter."""
        found = super().draws(seed)
        self._means[found.name] = found.mean
        return found

    @property
    def _true_values(self) -> dict[str, float]:
        """What of the true asset is the same in every step, by the names of the model."""
        asset = self._scenario.asset
        given = {**asset.true_parameters, **asset.constant_load}
        return {name: value for name, value in given.items() if name in self.wing.chosen}

    @property
    def _outputs(self) -> slice:
        """Which outputs of the model are observed, where those at rest are."""
        return slice(0, self.wing.gauge_count)

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
        loads = scenario.asset.constant_load
        columns: dict[str, Float | float] = {n: value for n, value in loads.items() if n in reduced.chosen}
        columns |= {n: values[draw] for n, values in {**draws.others, draws.name: draws.values}.items()}
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


def check_wing_scenario(scenario: Scenario, regions: tuple[str, ...], gauge_count: int) -> None:
    """Check that a scenario speaks of what a wing model has.

    Raises
    ------
    MissingObservationModelError
        It does not.
    """
    for what, came, wanted in (
        ("states", scenario.state_names, regions),
        ("control inputs", scenario.control[0].values, ("load_factor",)),
        ("calibrated parameter", (scenario.calibration.parameter,), ("young_modulus_factor",)),
        ("sensor count", (str(scenario.observation.count),), (str(gauge_count),)),
    ):
        if {*came} != {*wanted}:
            raise MissingObservationModelError(
                f"the design's model predicts observations for the {what} {', '.join(sorted(wanted))}, and "
                f"the scenario has {', '.join(sorted(came))}: set `belief.kind` to `asset` to ask what is "
                "flown itself."
            )
