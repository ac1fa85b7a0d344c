"""The estimator that a scenario asks for: one that learns, one that gives notice, or both."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin_master.learning.learning_filter import LearningFilter, LearntPriors
from twin_master.learning.monitor import WatchfulEstimator
from twin_master.learning.words import Words
from twin_master.network.estimator import Estimator, ExactFilter
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.sensor_model import GaussianSensorModel
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.schema import Scenario


def scenario_estimator(
    scenario: Scenario,
    model: GraphicalModel,
    sensor_model: GaussianSensorModel,
    draws: NDArray[np.float64],
) -> Estimator | None:
    """Return what learns and gives notice as the scenario says, or None where it says nothing.

    Parameters
    ----------
    scenario : Scenario
    model : GraphicalModel
        Its states, controls and transitions.
    sensor_model : GaussianSensorModel
        Predictions for each draw, and the noise that is assumed.
    draws : (E,)
        Of the calibrated parameter.

    Raises
    ------
    InvalidModelError
        A transition factor makes a probability larger than one, or there are too many states to watch.
    """
    learning = learning_filter(scenario, model, sensor_model, draws)
    if scenario.notice is None:
        return learning
    return WatchfulEstimator(
        learning or ExactFilter(model, sensor_model, scenario.mission.name),
        sensor_model,
        draws,
        scenario.notice,
        words_of(scenario),
    )


def words_of(scenario: Scenario) -> Words:
    """Return how sentences speak of the turns and sensors of a scenario."""
    observation = scenario.observation
    more: dict[str, Any] = {"names": observation.titles} | ({} if scenario.searchable else {"command": ""})
    if observation.role == "strain" and set(observation.sensor_units) == {"1"}:
        return Words(scenario.mission.step_name, "gauge", 1e6, ("microstrain",) * observation.count, **more)
    sensor = "gauge" if observation.role == "strain" else "sensor"
    return Words(scenario.mission.step_name, sensor, 1.0, observation.sensor_units, **more)


def learning_filter(
    scenario: Scenario,
    model: GraphicalModel,
    sensor_model: GaussianSensorModel,
    draws: NDArray[np.float64],
) -> LearningFilter | None:
    """Return the filter that learns as the scenario says, without notices; None where nothing is learnt.

    Parameters and errors are those of `scenario_estimator`.
    """
    learning = scenario.learning
    if learning is None:
        return None
    units = set(scenario.observation.sensor_units)
    priors = LearntPriors(
        parameter=scenario.calibration.parameter if learning.parameter else None,
        draws=draws,
        noise_degrees=learning.noise_degrees if learning.noise else 0.0,
        gain=learning.gauge_gain,
        offset=learning.gauge_offset,
        sensor_unit=units.pop() if len(units) == 1 else "",
    )
    factors = learning.transition_factors
    moves = {factor: build_graphical_model(scenario, factor).transition for factor in factors}
    return LearningFilter(model, sensor_model, priors, moves, scenario.mission.name)
