"""A twin, its plan and its plant, put together from a scenario, a source of assets and a seed."""

from __future__ import annotations

from dataclasses import dataclass

from twin_master.asset_source import AssetSource
from twin_master.assets import Asset
from twin_master.graphical_model import GraphicalModel
from twin_master.parameter import ParameterDraws
from twin_master.planner import PlannedPolicy, value_iteration
from twin_master.plant import Plant
from twin_master.rewards import RewardModel, RewardSettings
from twin_master.scenario import Scenario
from twin_master.sensor_model import GaussianSensorModel
from twin_master.truth import Truth
from twin_master.twin import Twin, build_graphical_model


@dataclass(frozen=True)
class Knowledge:
    """What the twin knows before it flies.

    Attributes
    ----------
    scenario : Scenario
        What is to be flown.
    model : GraphicalModel
        S states, U controls.
    draws : ParameterDraws
        The calibrated parameter.
    sensor_model : GaussianSensorModel
        Predicted observations (E, S, U, G) and the assumed noise.
    rewards : RewardModel
        Rewards by state and control.
    plan : PlannedPolicy
        Value iteration.
    """

    scenario: Scenario
    model: GraphicalModel
    draws: ParameterDraws
    sensor_model: GaussianSensorModel
    rewards: RewardModel
    plan: PlannedPolicy

    def twin(self) -> Twin:
        """Return a twin that has seen nothing yet."""
        return Twin(
            self.scenario.mission.name,
            self.model,
            self.sensor_model,
            self.plan.policy,
            self.scenario.mission.steps,
            self.scenario.mission.prediction_steps,
            self.scenario.planner.decide_on,
        )

    def truth(self, seed: int) -> Truth:
        """Return what really happens under a seed."""
        return Truth(self.scenario, self.model, seed)

    def plant(self, truth: Truth, asset: Asset) -> Plant:
        """Return an asset, driven by a truth."""
        return Plant(self.scenario, truth, asset)


def prepare_knowledge(scenario: Scenario, source: AssetSource, seed: int) -> Knowledge:
    """Calibrate, predict the observations of every state and control, and plan.

    Kapteyn et al. 2021, eqs. (30) and (36).

    Parameters
    ----------
    scenario : Scenario
        What is to be flown.
    source : AssetSource
        Already prepared.
    seed : int
        Seed of the run.
    """
    model = build_graphical_model(scenario)
    draws = source.draws(seed)
    sensor_model = GaussianSensorModel(
        source.observation_table(draws, model),
        scenario.observation.standard_deviation,
        average=scenario.observation.average_over_draws,
        model_error=scenario.observation.model_error,
    )
    rewards = RewardModel(sensor_model, reward_settings(scenario))
    plan = value_iteration(
        model.transition.matrix,
        rewards.planning_reward(scenario.rewards.health_weight, scenario.rewards.control_weight),
        scenario.planner.gamma,
    )
    return Knowledge(scenario, model, draws, sensor_model, rewards, plan)


def reward_settings(scenario: Scenario) -> RewardSettings:
    """Return the figures of the rewards in the order of the scenario's controls."""
    section = scenario.rewards
    norm = section.normalise_error_by
    return RewardSettings(
        limit=section.health_limit,
        control_reward=tuple(section.control[name] for name in scenario.control_names),
        error_scale=section.error_scale,
        control_normaliser=None if norm is None else tuple(c.values[norm] for c in scenario.control),
        health_sensors=None
        if section.health_sensors == "all"
        else tuple(number - 1 for number in section.health_sensors),
    )
