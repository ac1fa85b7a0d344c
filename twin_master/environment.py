"""A scenario as an environment of gymnasium (extra `uav-twin[gym]`), for reinforcement learning.

An action is a control of the scenario, an observation is that of its sensors. The reward is that of
the scenario for the true state: eqs. (9) and (10) of Kapteyn et al. 2021 with the scenario's
weights.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fmu_asset.errors import FmuEndedError
from reporting.arrays import Float
from reporting.progress import Progress, SilentProgress
from reporting.words import comma_list
from twin_master.assets.asset_source import Asset
from twin_master.assets.resolution import OverridesOrMapping, resolve_scenario
from twin_master.errors import MissionInputError
from twin_master.fleet.checks import source_of
from twin_master.mission.plant import Plant, sentence_of_ending_action
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import LoadedScenario, load_scenario

try:
    import gymnasium
except ImportError:
    raise MissionInputError(
        "a ScenarioEnvironment needs gymnasium: pip install 'uav-twin[gym]'."
    ) from None

Info = dict[str, Any]
"""Facts about a step in addition to its observation, see `ScenarioEnvironment`."""


class ScenarioEnvironment(gymnasium.Env[Float, np.int64]):
    """The asset of a scenario, its damage and its sensors, step by step.

    `reset` flies the first step of the mission, under the scenario's first control. An episode has
    as many steps as the mission, and then is truncated. A lost sensor shows zero; `info` has NaN
    for it.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    overrides : Overrides or mapping, optional
        What differs from the file, as for `fly`.
    progress : Progress, optional
        Shows the stages of the modelling.

    Attributes
    ----------
    scenario : Scenario
        The scenario with the overrides.
    knowledge : Knowledge
        The knowledge of a twin of the scenario; `knowledge.twin()` is a twin with the policy of
        the scenario.
    action_space : Discrete(U)
        The index of a control.
    observation_space : Box (G,)
        The sensor values, SI, without bounds.

    Raises
    ------
    MissionInputError
        If gymnasium is not installed, or the scenario observes modes.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        If the scenario cannot be modelled; the error is one clear sentence.

    Notes
    -----
    The entries of `info` after a step are

    - `observed`: the sensor values (G,), NaN for a lost sensor;
    - `control`: the index of the control;
    - `step`: the number of the step;
    - `seed`: the seed of the mission; `reset(seed=s)` meets the noise and damage of
      `uav-twin run --seed s`;
    - `state`: the true state by name, SI;
    - `reward_health`, `reward_control`: the rewards without weights.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as the base class has it

    def __init__(
        self,
        scenario: LoadedScenario | str | Path,
        overrides: OverridesOrMapping | None = None,
        *,
        progress: Progress | None = None,
    ) -> None:
        self.scenario = resolve_scenario(load_scenario(scenario), overrides)
        if self.scenario.observation.role == "modes":
            raise MissionInputError(
                f"the scenario {self.scenario.mission.name} observes modes with a covariance, "
                "which are not a vector of sensors: take a scenario that observes sensors."
            )
        source = source_of(self.scenario)
        source.check()
        with ExitStack() as resources:
            folder = resources.enter_context(TemporaryDirectory(prefix="uav_twin_"))
            self._folder = Path(folder)
            source.prepare(self._folder, progress or SilentProgress())
            self.knowledge = prepare_knowledge(self.scenario, source, self.scenario.mission.seed)
            self._asset: Asset | None = source.open()
            resources.callback(self._close_asset)
            self._initial_state = self._asset.save_state()
            # Nothing failed: folder and asset stay open until `close`.
            self._resources = resources.pop_all()
        self._plant: Plant | None = None
        self._step = 0
        self._seed = 0
        self._control = 0
        self._last_observation: Float = np.empty(0)
        self._last_info: Info = {}
        values = self.scenario.observation.count + len(self.scenario.inspection_readings)
        self.action_space = gymnasium.spaces.Discrete(len(self.scenario.control))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (values,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float, Info]:
        """Begin a mission, and fly its first step under the first control of the scenario.

        Parameters
        ----------
        seed : int, optional
            The seed of the mission; if left out, it is drawn.
        options : dict, optional
            Not used.

        Returns
        -------
        (G,) array
            The observation.
        dict
            The entries of `info`.
        """
        super().reset(seed=seed)
        if self._asset is None:
            raise MissionInputError("the environment is closed: make a new one.")
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        asset_draws_by_itself = bool(getattr(self.scenario.asset, "seeds", ()))
        if asset_draws_by_itself:
            # Such an asset takes its seed when it is opened.
            self._close_asset()
            scenario = self.scenario.with_seed(self._seed)
            source = scenario.asset.source(scenario)
            source.use_prepared_folder(self._folder)
            self._asset = source.open()
        else:
            self._asset.restore_state(self._initial_state)
        self._plant = self.knowledge.plant(self.knowledge.truth(self._seed), self._asset)
        self._step = 0
        first_control = self.knowledge.twin().proposed_control
        observation, _reward, info = self._fly(first_control, None)
        return observation, info

    def step(self, action: np.int64 | int) -> tuple[Float, float, bool, bool, Info]:
        """Fly one step under a control.

        The episode is terminated if an action ends the mission, or if the asset ends its simulation
        by itself; then `info["ended"]` holds the sentence. In the latter case the observation is
        that of the step before, and the reward is zero. After the last step of the mission the
        episode is truncated.

        Parameters
        ----------
        action : int
            The index of the control.

        Returns
        -------
        (G,) array
            The observation.
        float
            The reward.
        bool
            Whether the episode is terminated.
        bool
            Whether the episode is truncated.
        dict
            The entries of `info`.

        Raises
        ------
        gymnasium.error.ResetNeeded
            If the mission has not begun, or is over.
        gymnasium.error.InvalidAction
            If there is no such control.
        """
        steps = self.scenario.mission.steps
        if self._plant is None or self._step >= steps:
            raise gymnasium.error.ResetNeeded("the mission is over or has not begun: call reset().")
        if not self.action_space.contains(action):
            raise gymnasium.error.InvalidAction(
                "the action must be the index of one of the controls "
                f"{comma_list(self.scenario.control_names)}, but it is {action!r}"
            )
        reason_of_end = ""
        try:
            observation, reward, info = self._fly(int(action), self._control)
            if self.scenario.ends(int(action)):
                reason_of_end = sentence_of_ending_action(self.scenario, int(action))
        except FmuEndedError as error:
            observation = self._last_observation.copy()
            reward = 0.0
            info = self._last_info
            reason_of_end = error.sentence
        terminated = reason_of_end != ""
        if terminated:
            self._step = steps
            info = info | {"ended": reason_of_end}
        truncated = not terminated and self._step >= steps
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Close the asset, and remove its temporary files."""
        self._resources.close()
        self._plant = None

    def _close_asset(self) -> None:
        if self._asset is not None:
            self._asset.close()
        self._asset = None

    def _fly(self, control: int, previous_control: int | None) -> tuple[Float, float, Info]:
        """Fly one step under a control; return the observation (G,), the reward and `info`."""
        assert self._plant is not None
        reading = self._plant.fly_step(control, previous_control)
        ground_truth = reading.ground_truth
        assert ground_truth is not None  # a plant is simulated
        weights = self.scenario.rewards
        rewards = self.knowledge.rewards
        health_reward = float(rewards.health(ground_truth.observation))
        control_reward = rewards.control_reward[control]
        reward = weights.health_weight * health_reward + weights.control_weight * control_reward
        info = {
            "observed": reading.observed,
            "control": control,
            "step": self._step,
            "seed": self._seed,
            "state": dict(zip(self.scenario.state_names, ground_truth.state.tolist(), strict=True)),
            "reward_health": health_reward,
            "reward_control": control_reward,
        }
        self._control = control
        self._step += 1
        self._last_observation = np.nan_to_num(reading.observed, nan=0.0)
        self._last_info = info
        return self._last_observation.copy(), reward, info
