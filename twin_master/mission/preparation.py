"""The knowledge of a twin before its flight, made from a scenario, an asset source and a seed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reporting.arrays import Float, Index
from reporting.progress import Progress, SilentProgress
from reporting.words import brief
from twin_master.assets.asset_source import Asset, AssetSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.resolution import (
    OverridesOrMapping,
    asset_source,
    resolve_scenario,
)
from twin_master.gauges.gauge_watch import WatchfulEstimator
from twin_master.learning.expectation import LearntExpectation
from twin_master.learning.learning_filter import LearningFilter
from twin_master.mission.parts import NO_PARTS, TwinParts
from twin_master.mission.planning import discounts, plan_within_limit
from twin_master.mission.plant import Plant, Truth
from twin_master.network.decision_problem import DecisionProblem, observation_classes
from twin_master.network.estimator import Estimator, NoticeWording
from twin_master.network.graphical_model import GraphicalModel, build_graphical_model
from twin_master.network.identified import IdentifiedSensorModel, InspectedSensorModel
from twin_master.network.inference import ExactFilter
from twin_master.network.planner import (
    BeliefPolicy,
    Hold,
    PlannedPolicy,
    RiskPolicy,
    evaluate_policy,
    value_iteration,
)
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel, check_noise
from twin_master.network.twin import Planner, Twin
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator

_DIGITS_OF_HEALTH = 9
"""Decimal digits to which the health rewards of two controls agree if their loads are equal."""


@dataclass(frozen=True)
class Knowledge:
    """What the twin knows before its flight: model, draws, predictions, policy.

    S is the number of states, U that of controls, G that of sensors, E that of draws of the
    calibrated parameter.

    Attributes
    ----------
    scenario : Scenario
        The scenario to fly.
    model : GraphicalModel
        The states, controls and transitions.
    draws : ParameterDraws
        The calibrated parameter.
    predicted : (E, S, U, G) array
        The observation that each draw predicts in each state and control, SI.
    policy : (S, U) array, BeliefPolicy, RiskPolicy or None
        The policy p(U | D), row-stochastic, or a policy on the belief, that is flown instead of a
        plan.
    true_values : (E, S, U, G) array or None
        The values of the structure itself at the sensors, SI, which limits and rewards refer to;
        None if the sensors show them.
    parts : TwinParts
        The sensor model and the estimator that a user gives in the place of the scenario's.

    Raises
    ------
    InvalidModelError, PlanningError
        When a property is used, if shapes do not fit the scenario, or if there is no plan.
    """

    scenario: Scenario
    model: GraphicalModel
    draws: ParameterDraws
    predicted: Float
    policy: Float | BeliefPolicy | RiskPolicy | None = None
    true_values: Float | None = None
    parts: TwinParts = NO_PARTS

    def __repr__(self) -> str:
        return brief(
            self,
            mission=self.scenario.mission.name,
            model=self.model,
            sensor_model=self.sensor_model,
        )

    @cached_property
    def sensor_model(self) -> GaussianSensorModel:
        """The sensors: their predicted values in each state, and the assumed noise.

        The first of these cases that holds decides:

        - If the user has given a sensor model, it is used.
        - If the observations are identified modes, an `IdentifiedSensorModel`, because they contain
          a covariance of their own.
        - If an action of the twin inspects the state, an `InspectedSensorModel`.
        - Otherwise a `GaussianSensorModel`.
        """
        if self.parts.sensor_model is not None:
            # A user's sensor model may be made from that of the scenario. So it gets knowledge
            # without parts, whose sensor model is one of the other cases.
            knowledge_of_scenario = replace(self, parts=NO_PARTS)
            return self.parts.make_sensor_model(knowledge_of_scenario)
        observation = self.scenario.observation
        make_sensor_model: Callable[..., GaussianSensorModel] = GaussianSensorModel
        if observation.modes is not None:
            make_sensor_model = IdentifiedSensorModel
        elif self.scenario.inspection_readings:
            make_sensor_model = _inspected_sensor_model(self.scenario, self.model)
        # With `between_levels` a state stands for an interval of values, within which its sensors
        # change; without it, for the values at its levels alone.
        change_within_interval = None
        if observation.between_levels:
            mean_of_draws = self.predicted.mean(axis=0)  # (S, U, G)
            change_within_interval = self.model.states.change_within_interval(mean_of_draws)
        return make_sensor_model(
            self.predicted,
            observation.standard_deviation,
            average=observation.average_over_draws,
            model_error=observation.model_error,
            interval=change_within_interval,
        )

    @cached_property
    def rewards(self) -> RewardModel:
        """The rewards for health, control and error, as the scenario states them."""
        section = self.scenario.rewards
        # The error is divided by one input of each control, such as the load factor.
        control_normaliser = None
        if section.normalise_error_by is not None:
            normalising_input = section.normalise_error_by
            control_normaliser = tuple(
                control.values[normalising_input] for control in self.scenario.control
            )
        # The scenario counts sensors from 1; None stands for all sensors.
        health_sensors = None
        if section.health_sensors != "all":
            health_sensors = tuple(number - 1 for number in section.health_sensors)
        return RewardModel(
            self.sensor_model,
            limit=section.health_limit,
            control_reward=tuple(section.control[name] for name in self.scenario.control_names),
            error_scale=section.error_scale,
            control_normaliser=control_normaliser,
            health_sensors=health_sensors,
            true_per_draw=self.true_values,  # limits refer to the structure, not to its sensors
        )

    @cached_property
    def plan(self) -> PlannedPolicy:
        """The plan by value iteration, with a policy on the belief if the scenario asks for one.

        If `policy` is given, it is not planned: a policy by states is only evaluated, and a policy
        on the belief takes the place of the scenario's.
        """
        if self.policy is not None and not isinstance(self.policy, BeliefPolicy | RiskPolicy):
            policy = self.model.policy(self.policy)
            return evaluate_policy(
                self.model.transition, self.planning_reward, discounts(self.scenario), policy
            )
        return replace(self.plan_by_states, on_belief=self._belief_policy(self.plan_by_states))

    @cached_property
    def plan_by_states(self) -> PlannedPolicy:
        """The best control of each state, by value iteration, eq. (36)."""
        return value_iteration(
            self.model.transition, self.planning_reward, discounts(self.scenario)
        )

    @cached_property
    def hardness(self) -> Index:
        """The rank of each control by its load, larger for a harder one: (U,).

        A control is harder if its health reward, averaged over all states, is smaller; controls of
        equal load have equal ranks. No control ranks below the safest one.
        """
        mean_health = self.rewards.planning_reward(1.0, 0.0).mean(axis=0)
        _, rank = np.unique(-np.round(mean_health, _DIGITS_OF_HEALTH), return_inverse=True)
        if rank[self.safest_control] > rank.min():
            rank[self.safest_control] = rank.min() - 1
        return np.asarray(rank, dtype=np.int64)

    @property
    def hold(self) -> Hold | None:
        """How often a harder control must be proposed in a row; None if once is enough."""
        if self.scenario.planner.hold == 1:
            return None
        return Hold(self.scenario.planner.hold, self.hardness)

    @cached_property
    def is_beyond_limit(self) -> NDArray[np.bool_]:
        """Whether a control is harder than the best control of a state: (S, U)."""
        return np.asarray(self.hardness > self.hardness[self.plan_by_states.control_index, None])

    @cached_property
    def is_needless(self) -> NDArray[np.bool_]:
        """Whether a control is gentler than the best control of a state: (S, U)."""
        return np.asarray(self.hardness < self.hardness[self.plan_by_states.control_index, None])

    def _belief_policy(self, plan: PlannedPolicy) -> BeliefPolicy | RiskPolicy | None:
        """Return the policy on the belief; None if the policy by states decides."""
        if isinstance(self.policy, BeliefPolicy | RiskPolicy):
            return self.policy
        if self.scenario.planner.risk is not None:
            return RiskPolicy(
                self.is_beyond_limit.astype(np.float64),
                np.argsort(-self.hardness, kind="stable"),
                self.scenario.planner.risk,
            )
        if self.scenario.planner.policy == "qmdp":
            # QMDP averages the returns of the fully observed problem over the belief: one vector of
            # returns for each control (Littman, Cassandra and Kaelbling 1995).
            return BeliefPolicy(plan.action_value.T, np.arange(len(self.scenario.control)))
        if self.scenario.planner.policy == "belief":
            return plan_within_limit(self.scenario, self.problem, self.rewards).policy
        return None

    @cached_property
    def problem(self) -> DecisionProblem:
        """The partially observed decision problem of the mission.

        It has finitely many observations: observations are drawn, and joined to classes.
        """
        random_numbers = generator(self.scenario.mission.seed, "planning")
        return DecisionProblem(
            self.model.transition,
            self.planning_reward,
            discounts(self.scenario),
            likelihood=observation_classes(self.sensor_model, random_numbers),
            prior=self.model.prior,
        )

    @property
    def planning_reward(self) -> Float:
        """The expected reward of each state and control (S, U), eqs. (9)-(11)."""
        weights = self.scenario.rewards
        return self.rewards.planning_reward(weights.health_weight, weights.control_weight)

    @cached_property
    def learning(self) -> LearningFilter | None:
        """The learning filter, without the search for faulty gauges; None if nothing is learnt.

        Raises
        ------
        InvalidModelError
            If a transition factor makes a probability larger than one, or saturation is to be
            learnt of sensors whose noise is not Gaussian.
        """
        scenario = self.scenario
        section = scenario.learning
        if section is None:
            return None
        draws = None
        if section.parameter:
            draws = (scenario.calibration.parameter, self.draws.values)
        transitions = {}
        for factor in section.transition_factors:
            transitions[factor] = build_graphical_model(scenario, factor).transition
        return LearningFilter(
            self.model,
            self.sensor_model,
            section,
            draws,
            transitions,
            scenario.mission.name,
            scenario.observation.sensor_units,
            NoticeWording.of(scenario),
        )

    @cached_property
    def estimator(self) -> Estimator:
        """The estimator of the belief: the user's own, else the learning or the exact filter.

        If the scenario has a table `notice`, the learning or exact filter is wrapped in an
        estimator that also looks for faulty gauges, and reports them as notices. An estimator of
        the user's own is not wrapped.

        Raises
        ------
        InvalidModelError
            If there are too many states to look for faulty gauges, if a transition factor makes a
            probability larger than one, or if saturation is to be learnt of sensors whose noise is
            not Gaussian.
        """
        if self.parts.estimator is not None:
            # The user's function that makes the estimator is given this preparation, and may ask it
            # for the scenario's estimator. With the user's own it would call itself without end.
            without_estimator = replace(self, parts=replace(self.parts, estimator=None))
            return self.parts.make_estimator(without_estimator)
        scenario = self.scenario
        belief_filter: Estimator = self.learning or ExactFilter(
            self.model, self.sensor_model, scenario.mission.name
        )
        if scenario.notice is None:
            return belief_filter
        return WatchfulEstimator(
            belief_filter,
            self.sensor_model,
            self.draws.values,
            scenario.notice,
            NoticeWording.of(scenario),
        )

    @cached_property
    def expectation(self) -> LearntExpectation | None:
        """Expected sensor values and rewards of the learning filter; None if nothing is learnt."""
        if self.learning is None:
            return None
        return LearntExpectation(self.learning, self.rewards, self.plan.policy)

    def twin(
        self,
        policy: ArrayLike | Planner | None = None,
        *,
        lag: int | None = None,
        estimator: Estimator | None = None,
    ) -> Twin:
        """Return a twin before its first observation.

        Parameters
        ----------
        policy : (S, U) array or callable, optional
            The policy p(U | D), row-stochastic, or a planner; the policy of the plan if left out.
        lag : int or None
            The number of steps that it smooths back over and that late observations may revise;
            None keeps all steps, as a mission of known length needs.
        estimator : Estimator, optional
            An estimator in place of the one that the scenario asks for.
        """
        if policy is None:
            policy_of_states: ArrayLike | Planner = self.plan.policy
            policy_on_belief = self.plan.on_belief
        else:
            policy_of_states = policy
            policy_on_belief = None
        return Twin(
            self.scenario.mission.name,
            self.model,
            self.sensor_model,
            policy_of_states,
            prediction_steps=self.scenario.mission.prediction_steps,
            decide_on=self.scenario.planner.decide_on,
            lag=lag,
            first_control=self.scenario.mission.first_control,
            estimator=estimator or self.estimator,
            safest=self.safest_control,
            on_belief=policy_on_belief,
            hold=self.hold,
        )

    @property
    def safest_control(self) -> int:
        """The index of the control that is flown if no state is believed.

        The scenario may name it. Otherwise it is the control with the least load: the one whose
        health reward, averaged over all states, is the largest, and the first of equals.
        """
        name = self.scenario.planner.safest
        if name is not None:
            return self.scenario.control_names.index(name)
        health_reward = self.rewards.planning_reward(1.0, 0.0)
        return int(np.argmax(health_reward.mean(axis=0)))

    def policy_with_safest_control(self, unexplained: ArrayLike) -> Float:
        """Return the policy p(control | state) of future steps, mixed with the safest control.

        The safest control is flown with the probability that no state explains the sensors.

        Parameters
        ----------
        unexplained : (...) array
            The probability that no state of the model explains the sensors.

        Returns
        -------
        (..., S, U) array
            The policy.
        """
        safest_weight = np.asarray(unexplained, dtype=np.float64)[..., None, None]
        certainly_safest = np.eye(len(self.model.controls))[self.safest_control]
        return np.asarray(
            (1.0 - safest_weight) * self.plan.policy + safest_weight * certainly_safest
        )

    @cached_property
    def true_model(self) -> GraphicalModel:
        """The model of true damage growth: the twin's, or one with other probabilities."""
        probability = self.scenario.truth.probability
        if not probability:
            return self.model
        return build_graphical_model(
            self.scenario.with_changes("transition", probability=probability)
        )

    def truth(self, seed: int) -> Truth:
        """Return the true damage, noise and faults of the mission with a seed."""
        return Truth(self.scenario, self.true_model, seed)

    def plant(self, truth: Truth, *assets: Asset) -> Plant:
        """Return the simulated asset, or several side by side, with damage, noise and faults."""
        return Plant(self.scenario, truth, *assets)


def _inspected_sensor_model(
    scenario: Scenario, model: GraphicalModel
) -> "partial[InspectedSensorModel]":
    """Return the constructor of a sensor model with the scenario's inspections.

    An inspection reads one factor of the state, with noise of a stated standard deviation.
    """
    readings = scenario.inspection_readings
    controls = np.array([reading.control_index for reading in readings])
    factors = np.array([reading.state_index for reading in readings])
    deviations = np.array([reading.standard_deviation for reading in readings])
    coordinates = model.states.coordinates  # (S, F)
    within_level = np.zeros_like(coordinates)
    if scenario.observation.between_levels:
        # The standard deviation of each factor inside the interval that its level stands for. The
        # changes are (S, F, F): of each factor (second axis), if a factor (third axis) is off its
        # level. A factor changes only with itself, on the diagonal.
        within_level = np.einsum("sff->sf", model.states.change_within_interval(coordinates))
    return partial(
        InspectedSensorModel,
        asked_by=controls,
        expected_reading=coordinates[:, factors],
        reading_deviation=np.hypot(within_level[:, factors], deviations),
    )


def prepare_knowledge(
    scenario: Scenario,
    source: AssetSource,
    seed: int,
    policy: Float | BeliefPolicy | None = None,
    parts: TwinParts = NO_PARTS,
) -> Knowledge:
    """Prepare what a twin knows: calibrated draws, and predictions by draw, state and control.

    Kapteyn et al. 2021, eq. (30). The plan, eq. (36), is made when it is first used.

    Parameters
    ----------
    source : AssetSource
        The source of the asset, already prepared.
    seed : int
        The seed of the run.
    policy : (S, U) array or BeliefPolicy, optional
        The policy that is flown instead of a plan; p(U | D), row-stochastic.
    parts : TwinParts
        The sensor model and the estimator that a user gives in the place of the scenario's.

    Raises
    ------
    MissionInputError
        If a given part does not fit the scenario.
    InvalidModelError
        If the tables do not fit in memory, or the noise of a sensor exceeds all that it can show.
    """
    model = build_graphical_model(scenario)
    draws = source.draws(seed)
    predicted_readings = source.observation_table(draws, model)
    true_values = source.structural_table(draws, model)
    noise_settings = {
        "observation.standard_deviation": scenario.observation.standard_deviation,
        "truth.noise.standard_deviation": scenario.truth.noise.standard_deviation,
    }
    for key, deviation in noise_settings.items():
        check_noise(key, deviation, predicted_readings, scenario.observation.sensor_units)
    knowledge = Knowledge(scenario, model, draws, predicted_readings, policy, true_values, parts)
    if parts.replace_filter:
        _ = knowledge.estimator  # made now, so that a part that does not fit is refused here
    return knowledge


def prepare_twin(
    scenario: LoadedScenario | str | Path,
    overrides: OverridesOrMapping | None = None,
    *,
    progress: Progress | None = None,
) -> Knowledge:
    """Return the knowledge of a scenario's twin before its flight, without a run folder.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    overrides : Overrides or mapping, optional
        The values that replace those of the file, as for `fly`.
    progress : Progress, optional
        Shows the stages of the modelling.

    Returns
    -------
    Knowledge
        The graphical model, sensors, rewards and plan; `.twin()` is a twin before its first
        observation.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        If the scenario cannot be modelled; the error is one clear sentence.
    """
    resolved_scenario = resolve_scenario(load_scenario(scenario), overrides)
    return prepare_without_folder(resolved_scenario, asset_source(resolved_scenario), progress)


def prepare_without_folder(
    scenario: Scenario, source: AssetSource, progress: Progress | None = None
) -> Knowledge:
    """Return the knowledge of a twin without a run folder: the source uses a temporary folder."""
    source.check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        source.prepare(Path(folder), progress or SilentProgress())
        return prepare_knowledge(scenario, source, scenario.mission.seed)
