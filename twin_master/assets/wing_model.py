"""The reduced model of a wing as it meets a scenario: what it predicts, and itself as an asset."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress
from twin_master.assets.asset_source import FlownAndBelieved
from twin_master.assets.interface import Asset, AssetReading, StatelessAsset
from twin_master.assets.parameter import ParameterDraws, draw_parameter
from twin_master.errors import MissingObservationModelError
from twin_master.network.graphical_model import GraphicalModel
from twin_master.scenario.schema import Scenario

if TYPE_CHECKING:
    from fe.runtime.reduced import ReducedModel

Float = NDArray[np.float64]


def wing_observation_table(
    wing: "ReducedModel", scenario: Scenario, draws: ParameterDraws, model: GraphicalModel
) -> Float:
    """Return the strains (E, S, U, G) of a wing for each draw of e, state and control: eqs. (13), (15).

    Raises
    ------
    MissingObservationModelError
        The scenario's states, controls or parameter are not those of a wing model.
    OutsideModelError
        A state, control or draw lies outside the model's validity.
    """
    check_wing_scenario(scenario, wing.regions, wing.gauge_count)
    load = scenario.asset.constant_load.get("tip_force", 0.0)
    states = model.states.coordinates
    factors = np.array([control.values["load_factor"] for control in scenario.control])
    shape = (len(draws.values), len(states), len(factors))
    draw, state, control = (index.ravel() for index in np.indices(shape))
    vectors = wing.vectors(
        {
            "young_modulus_factor": draws.values[draw],
            **dict(zip(scenario.state_names, states[state].T, strict=True)),
            "load_factor": factors[control],
            "tip_force": load,
        }
    )
    return wing.static_outputs(vectors)[:, : wing.gauge_count].reshape(*shape, wing.gauge_count)


def check_wing_scenario(scenario: Scenario, regions: tuple[str, ...], gauge_count: int) -> None:
    """Check that a scenario speaks of what a wing model has.

    Raises
    ------
    MissingObservationModelError
        It does not.
    """
    expected: dict[str, tuple[set[str] | set[int], set[str] | set[int]]] = {
        "states": (set(scenario.state_names), {*regions}),
        "control inputs": (set(scenario.control[0].values), {"load_factor"}),
        "calibrated parameter": ({scenario.calibration.parameter}, {"young_modulus_factor"}),
        "sensor count": ({scenario.observation.count}, {gauge_count}),
    }
    for what, (came, wanted) in expected.items():
        if came != wanted:
            raise MissingObservationModelError(
                f"the design's model predicts observations for the {what} {_names(wanted)}, and the scenario "
                f"has {_names(came)}: set `belief.kind` to `asset` to ask what is flown itself."
            )


def _names(values: set[str] | set[int]) -> str:
    return ", ".join(sorted(str(value) for value in values))


def wing_asset(wing: "ReducedModel", scenario: Scenario) -> StatelessAsset:
    """Return the reduced model itself as an asset, with the parameters of the scenario's true wing."""
    e = scenario.asset.true_parameters.get("young_modulus_factor", 1.0)
    force = scenario.asset.constant_load.get("tip_force", 0.0)

    def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        response = wing.static_response(
            stiffness_loss=health,
            young_modulus_factor=e,
            load_factor=control["load_factor"],
            tip_force=force,
        )
        return AssetReading(response.strain, {"strain_error_bound": response.strain_error_bound})

    return StatelessAsset(observe)


class ReducedModelSource:
    """The reduced model of a wing, flown without an FMU."""

    def __init__(self, scenario: Scenario, wing: "ReducedModel") -> None:
        self._scenario = scenario
        self._wing = wing

    @property
    def origin(self) -> FlownAndBelieved:
        """The reduced model, twice."""
        return FlownAndBelieved("reduced model of the wing", "reduced model of the wing")

    def check(self) -> None:
        """Accept what was read already."""

    def files(self) -> dict[str, bytes]:
        """Return none: the model is made from the design of the program."""
        return {}

    def prepare(self, folder: Path, progress: Progress) -> dict[str, str]:
        """Return the hash of the design."""
        return {"design": self._wing.design_hash}

    def draws(self, seed: int) -> ParameterDraws:
        """Return draws of e."""
        return draw_parameter(self._scenario.calibration, seed, self._wing)

    def observation_table(self, draws: ParameterDraws, model: GraphicalModel) -> Float:
        """Return the strains (E, S, U, G)."""
        return wing_observation_table(self._wing, self._scenario, draws, model)

    def open(self) -> Asset:
        """Return the model as an asset."""
        return wing_asset(self._wing, self._scenario)

    def write_field(self, path: Path, state: Mapping[str, float], control: Mapping[str, float]) -> bool:
        """Write nothing: there is no mesh."""
        return False
