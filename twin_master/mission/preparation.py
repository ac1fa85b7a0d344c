"""What a twin knows before its flight: made of a scenario, a source and a seed, and kept in a run folder."""

import io
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reporting.arrays import Float
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.progress import Progress, SilentProgress
from reporting.words import brief
from twin_master.assets.asset_source import Asset, AssetSource
from twin_master.assets.parameter import ParameterDraws
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import RunFolderError, said
from twin_master.learning.expectation import LearntExpectation
from twin_master.learning.learning_filter import LearningFilter
from twin_master.learning.monitor import WatchfulEstimator
from twin_master.mission.planning import discounts, expected_plan
from twin_master.mission.steps import Plant, Truth
from twin_master.network.decision_problem import DecisionProblem
from twin_master.network.estimator import Estimator, ExactFilter, NoticeWording
from twin_master.network.graphical_model import GraphicalModel
from twin_master.network.identified import IdentifiedSensorModel, InspectedSensorModel
from twin_master.network.observation_classes import observation_classes
from twin_master.network.planner import BeliefPolicy, PlannedPolicy, evaluate_policy, value_iteration
from twin_master.network.quantity import RewardModel
from twin_master.network.sensor_model import GaussianSensorModel, check_noise
from twin_master.network.twin import Planner, Twin, build_graphical_model
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.seeds import generator


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
    predicted : (E, S, U, G)
        Observations that are expected for each of its E draws, SI.
    policy : (S, U), BeliefPolicy or None
        To fly instead of planning; p(U | D), row-stochastic.
    true : (E, S, U, G) or None
        What is there at the sensors, for limits and rewards, where that is not what they show, SI.

    Raises
    ------
    InvalidModelError, PlanningError
        What follows is asked for, and shapes do not fit the scenario, or there is no plan.
    """

    scenario: Scenario
    model: GraphicalModel
    draws: ParameterDraws
    predicted: Float
    policy: Float | BeliefPolicy | None = None
    true: Float | None = None

    def __repr__(self) -> str:
        return brief(
            self, mission=self.scenario.mission.name, model=self.model, sensor_model=self.sensor_model
        )

    @cached_property
    def sensor_model(self) -> GaussianSensorModel:
        """Predicted observations and the assumed noise."""
        section = self.scenario.observation
        kind: Callable[..., GaussianSensorModel] = GaussianSensorModel
        if section.modes is not None:
            kind = IdentifiedSensorModel
        elif self.scenario.readings:
            kind = partial(InspectedSensorModel, **_readings(self.scenario, self.model))
        within = self.model.states.change_within_interval
        return kind(
            self.predicted,
            section.standard_deviation,
            average=section.average_over_draws,
            model_error=section.model_error,
            interval=within(self.predicted.mean(axis=0)) if section.between_levels else None,
        )

    @cached_property
    def rewards(self) -> RewardModel:
        """Rewards by state and control."""
        section, scenario = self.scenario.rewards, self.scenario
        norm, chosen = section.normalise_error_by, section.health_sensors
        return RewardModel(
            self.sensor_model,
            limit=section.health_limit,
            control_reward=tuple(section.control[name] for name in scenario.control_names),
            error_scale=section.error_scale,
            control_normaliser=None if norm is None else tuple(c.values[norm] for c in scenario.control),
            health_sensors=None if chosen == "all" else tuple(number - 1 for number in chosen),
            true_per_draw=self.true,
        )

    @cached_property
    def plan(self) -> PlannedPolicy:
        """Value iteration, what the scenario asks for, or the policy that was given."""
        scenario, policy = self.scenario, self.policy
        basis = self.model.transition, self.planning_reward, discounts(scenario)
        if policy is not None and not isinstance(policy, BeliefPolicy):
            return evaluate_policy(*basis, self.model.policy(policy))
        plan = value_iteration(*basis)
        if policy is None and scenario.planner.policy == "qmdp":
            policy = BeliefPolicy(plan.action_value.T, np.arange(len(scenario.control)))
        elif policy is None and scenario.planner.policy == "belief":
            policy = expected_plan(scenario, self.problem, self.rewards)[0].policy
        return replace(plan, on_belief=policy)

    @cached_property
    def problem(self) -> DecisionProblem:
        """What is decided on, its observations joined to classes under the seed of the scenario."""
        seed = generator(self.scenario.mission.seed, "planning")
        classes = observation_classes(self.sensor_model, seed)
        basis = self.model.transition, self.planning_reward, discounts(self.scenario)
        return DecisionProblem(*basis, classes, self.model.prior)

    @property
    def planning_reward(self) -> Float:
        """Expected reward of each state and control (S, U) that is planned with, eqs. (9)-(11)."""
        weights = self.scenario.rewards
        return self.rewards.planning_reward(weights.health_weight, weights.control_weight)

    @cached_property
    def learning(self) -> LearningFilter | None:
        """What learns, without notices; None where nothing is learnt.

        Raises
        ------
        InvalidModelError
            A transition factor makes a probability larger than one.
        """
        scenario, learning = self.scenario, self.scenario.learning
        if learning is None:
            return None
        draws = (scenario.calibration.parameter, self.draws.values) if learning.parameter else None
        factors = learning.transition_factors
        moves = {factor: build_graphical_model(scenario, factor).transition for factor in factors}
        return LearningFilter(
            self.model, self.sensor_model, learning, draws, moves, scenario.mission.name,
            scenario.observation.sensor_units,
        )  # fmt: skip

    @cached_property
    def estimator(self) -> Estimator:
        """What holds the belief: the exact filter, or what learns and gives notice as the scenario says.

        Raises
        ------
        InvalidModelError
            There are too many states to watch, or as of `learning`.
        """
        notice = self.scenario.notice
        inner = self.learning or ExactFilter(self.model, self.sensor_model, self.scenario.mission.name)
        if notice is None:
            return inner
        words = NoticeWording.of(self.scenario)
        return WatchfulEstimator(inner, self.sensor_model, self.draws.values, notice, words)

    @cached_property
    def expectation(self) -> LearntExpectation | None:
        """What is expected of sensors and rewards by what is learnt; None where nothing is."""
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
        """Return a twin that has seen nothing yet.

        Parameters
        ----------
        policy : (S, U) or callable, optional
            p(U | D), row-stochastic, or a planner; that of the plan if left out.
        lag : int or None
            How many steps back it smooths and may be revised; None keeps all, as a mission of a known length
            wants.
        estimator : Estimator, optional
            What holds the belief in the place of the exact filter, or of what learns and gives notice where
            the scenario says so.
        """
        return Twin(
            self.scenario.mission.name,
            self.model,
            self.sensor_model,
            self.plan.policy if policy is None else policy,
            prediction_steps=self.scenario.mission.prediction_steps,
            decide_on=self.scenario.planner.decide_on,
            lag=lag,
            first_control=self.scenario.mission.first_control,
            estimator=estimator or self.estimator,
            safest=self.safest,
            on_belief=self.plan.on_belief if policy is None else None,
        )

    @property
    def safest(self) -> int:
        """Index of the control where no state is believed.

        That of the scenario, or the one with the least load: whose health reward is the best in the mean over
        all states, the first of equals.
        """
        named = self.scenario.planner.safest
        if named is not None:
            return self.scenario.control_names.index(named)
        return int(np.argmax(self.rewards.planning_reward(1.0, 0.0).mean(axis=0)))

    def asked(self, unexplained: ArrayLike) -> Float:
        """Return p(U | D) of steps to come (..., S, U), the safest so far as no state is believed (...)."""
        share = np.asarray(unexplained, dtype=np.float64)[..., None, None]
        safest = np.eye(len(self.model.controls))[self.safest]
        return np.asarray((1.0 - share) * self.plan.policy + share * safest)

    @cached_property
    def true_model(self) -> GraphicalModel:
        """States and transitions of what really happens, where it is random growth."""
        true = self.scenario.truth.probability
        if not true:
            return self.model
        return build_graphical_model(self.scenario.with_changes("transition", probability=true))

    def truth(self, seed: int) -> Truth:
        """Return what really happens under a seed."""
        return Truth(self.scenario, self.true_model, seed)

    def plant(self, truth: Truth, asset: Asset) -> Plant:
        """Return an asset, driven by a truth."""
        return Plant(self.scenario, truth, asset)


def prepare_knowledge(
    scenario: Scenario, source: AssetSource, seed: int, policy: Float | BeliefPolicy | None = None
) -> Knowledge:
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
    policy : (S, U) or BeliefPolicy, optional
        To fly instead of planning; p(U | D), row-stochastic.

    Raises
    ------
    InvalidModelError
        It does not fit in memory, or a sensor's noise is larger than all that it can show.
    """
    model = build_graphical_model(scenario)
    draws = source.draws(seed)
    predicted, section = source.observation_table(draws, model), scenario.observation
    true = source.structural_table(draws, model)
    for key, deviation in (
        ("observation.standard_deviation", section.standard_deviation),
        ("truth.noise.standard_deviation", scenario.truth.noise.standard_deviation),
    ):
        check_noise(key, deviation, predicted, section.sensor_units)
    return Knowledge(scenario, model, draws, predicted, policy, true)


def _readings(scenario: Scenario, model: GraphicalModel) -> dict[str, Any]:
    """Return what inspections read in each state, and how well, for `InspectedSensorModel`."""
    asked_by, places, _, deviations = (np.array(column) for column in zip(*scenario.readings, strict=True))
    coordinates = model.states.coordinates
    within = np.zeros_like(coordinates)
    if scenario.observation.between_levels:
        within = np.einsum("sff->sf", model.states.change_within_interval(coordinates))
    return {
        "asked_by": asked_by,
        "reading": coordinates[:, places],
        "reading_deviation": np.hypot(within[:, places], deviations),
    }


def prepare_twin(
    scenario: LoadedScenario | str | Path,
    overrides: Overrides | Mapping[str, Any] | None = None,
    *,
    progress: Progress | None = None,
) -> Knowledge:
    """Return what the twin of a scenario knows before its flight, without a run folder.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    overrides : Overrides or mapping, optional
        What differs from the file, as `fly` takes it.
    progress : Progress, optional
        Where the modelling reports.

    Returns
    -------
    Knowledge
        Graphical model, sensors, rewards and plan; `.twin()` is a twin that has seen nothing yet.

    Raises
    ------
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        With one clear sentence.
    """
    resolved = resolve_scenario(load_scenario(scenario), overrides)
    return prepared_alone(resolved, asset_source(resolved), progress)


def prepared_alone(scenario: Scenario, source: AssetSource, progress: Progress | None = None) -> Knowledge:
    """Return what a twin knows that flies in no folder."""
    source.check()
    with TemporaryDirectory(prefix="uav_twin_") as folder:
        source.prepare(Path(folder), progress or SilentProgress())
        return prepare_knowledge(scenario, source, scenario.mission.seed)


KNOWLEDGE_NAME, CALIBRATION_NAME = "twin.npz", "calibration.json"
EARLIER_KNOWLEDGE = "twin_{}.npz"
"""Of the models that a watch believed before its last one, by their numbers from 0."""


def keep_knowledge(folder: Path, knowledge: Knowledge, number: int | None = None) -> None:
    """Write what a twin knows before its flight; the bytes depend on nothing else.

    The arrays are `predicted` (E, S, U, G), SI, `draws` (E,) and `policy` (S, U); where it is decided by the
    belief also `belief_vectors` (N, S) and `belief_control` (N,); where what is there at
    the sensors is not what they show also `true` (E, S, U, G), SI.

    Raises
    ------
    FileNotWrittenError
        The disk is full or the folder cannot be written.
    """
    content, true = io.BytesIO(), knowledge.true
    arrays: dict[str, Any] = {
        "predicted": knowledge.predicted,
        "draws": knowledge.draws.values,
        "policy": knowledge.plan.policy,
    }
    if knowledge.plan.on_belief is not None:
        arrays |= {f"belief_{name}": array for name, array in vars(knowledge.plan.on_belief).items()}
    np.savez(content, **arrays | ({} if true is None else {"true": true}))
    name = KNOWLEDGE_NAME if number is None else EARLIER_KNOWLEDGE.format(number)
    atomic_write_bytes(folder / name, content.getvalue())
    if knowledge.draws.record is not None:
        text = json.dumps(knowledge.draws.record, sort_keys=True, allow_nan=False)
        atomic_write_text(folder / CALIBRATION_NAME, text + "\n")


def share_knowledge(folder: Path, other: Path) -> None:
    """Keep what a twin knows in another folder, too, on the same bytes of the disk where it has links."""
    if (other / KNOWLEDGE_NAME).exists():
        return
    try:
        os.link(folder / KNOWLEDGE_NAME, other / KNOWLEDGE_NAME)
    except OSError:
        atomic_write_bytes(other / KNOWLEDGE_NAME, (folder / KNOWLEDGE_NAME).read_bytes())


def kept_knowledge(folder: Path, scenario: Scenario, number: int | None = None) -> Knowledge:
    """Return what the twin of a run knew before its flight.

    Parameters
    ----------
    folder : Path
        The run folder.
    scenario : Scenario
        Of its `config.json`.
    number : int, optional
        Of an earlier model of a watch, from 0; the last one where there is no such file.

    Raises
    ------
    RunFolderError
        The file is missing or damaged, or belongs to another scenario.
    """
    earlier = folder / EARLIER_KNOWLEDGE.format(number)
    path = earlier if earlier.is_file() else folder / KNOWLEDGE_NAME
    try:
        with np.load(path, allow_pickle=False) as kept:
            predicted, draws, policy = (
                np.asarray(kept[name], dtype=np.float64) for name in ("predicted", "draws", "policy")
            )
            true = np.asarray(kept["true"], dtype=np.float64) if "true" in kept else None
            on_belief = BeliefPolicy.from_arrays(kept, "belief_") if "belief_control" in kept else None
        calibration = scenario.calibration
        parameter = ParameterDraws(
            calibration.parameter, draws, float(draws.mean()), float(draws.std()), calibration.source
        )
        model = build_graphical_model(scenario)
        found = Knowledge(scenario, model, parameter, predicted, on_belief or policy, true)
        _ = found.plan  # what does not fit is said now
        return found
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RunFolderError(said("mission.knowledge", path=path, error=error)) from error
