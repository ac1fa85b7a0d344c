"""A scenario as an environment of gymnasium (extra `uav-twin[gym]`): for policies that others learn.

An action is a control of the scenario, an observation what its sensors say, the reward that of the scenario
for what really happened, eqs. (9) and (10) of Kapteyn et al. 2021 with its weights.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from fmu_asset.errors import FmuEndedError
from reporting.arrays import Float
from reporting.progress import Progress, SilentProgress
from twin_master.assets.asset_source import Asset
from twin_master.assets.resolution import Overrides, resolve_scenario
from twin_master.errors import MissionInputError, said
from twin_master.fleet.checks import source_of
from twin_master.mission.preparation import prepare_knowledge
from twin_master.mission.steps import Plant, decided_to_end
from twin_master.scenario.reading import LoadedScenario, load_scenario

try:
    import gymnasium
except ImportError:
    raise MissionInputError("a ScenarioEnvironment needs gymnasium: pip install 'uav-twin[gym]'.") from None


class ScenarioEnvironment(gymnasium.Env[Float, np.int64]):
    """The asset of a scenario, its damage and its sensors, step by step.

    The first step of the mission is flown by `reset` under the scenario's first control. An episode has as
    many steps as the mission, and then is truncated. A lost sensor shows zero; `info` holds NaN for it.

    Parameters
    ----------
    scenario : LoadedScenario, str or Path
        The scenario, its shipped name, or its file.
    overrides : Overrides or mapping, optional
        What differs from the file, as `fly` takes it.
    progress : Progress, optional
        Where the modelling reports.

    Attributes
    ----------
    knowledge : Knowledge
        What a twin of the scenario knows; `knowledge.twin()` is one, whose decisions are our own policy.
    action_space : Discrete(U)
        Index of a control.
    observation_space : Box (G,)
        What the sensors say, SI, without bounds.

    Raises
    ------
    MissionInputError
        gymnasium is not installed, or the scenario observes modes.
    TwinMasterError, FmuError, FiniteElementError, CalibrationError
        With one clear sentence.

    Notes
    -----
    `info` of a step holds `observed` (G,), NaN where lost; `control`, its index; `step`; `seed`, that of the
    mission: `reset(seed=s)` meets the noise and damage of `uav-twin run --seed s`; `state`, the true state by
    name, SI; `reward_health` and `reward_control`, unweighted.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as the base class has it

    def __init__(
        self,
        scenario: LoadedScenario | str | Path,
        overrides: Overrides | Mapping[str, Any] | None = None,
        *,
        progress: Progress | None = None,
    ) -> None:
        self.scenario = resolve_scenario(load_scenario(scenario), overrides)
        if self.scenario.observation.role == "modes":
            raise MissionInputError(said("environment.modes", name=self.scenario.mission.name))
        source = source_of(self.scenario)
        source.check()
        with ExitStack() as opened:  # what is packed is held as long as it is flown
            self._folder = Path(opened.enter_context(TemporaryDirectory(prefix="uav_twin_")))
            source.prepare(self._folder, progress or SilentProgress())
            self.knowledge = prepare_knowledge(self.scenario, source, self.scenario.mission.seed)
            self._asset: Asset | None = source.open()
            opened.callback(self._let_go)
            self._start = self._asset.save_state()
            self._opened = opened.pop_all()
        self._plant: Plant | None = None
        self._step, self._seed, self._control = 0, 0, 0
        self._seen: Float = np.empty(0)
        self._info: dict[str, Any] = {}
        sensors = self.scenario.observation.count + len(self.scenario.readings)
        self.action_space = gymnasium.spaces.Discrete(len(self.scenario.control))
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (sensors,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float, dict[str, Any]]:
        """Begin a mission, and fly its first step under the first control of the scenario.

        Parameters
        ----------
        seed : int, optional
            Seed of the mission; without it, it is drawn from the generator that the last seed began.
        options : dict, optional
            Not used.
        """
        super().reset(seed=seed)
        if self._asset is None:
            raise MissionInputError("the environment is closed: make a new one.")
        self._seed = int(self.np_random.integers(2**31)) if seed is None else seed
        if getattr(self.scenario.asset, "seeds", ()):  # chance of its own, which begins with it
            self._let_go()
            scenario = self.scenario.with_seed(self._seed)
            source = scenario.asset.source(scenario)
            source.use_prepared_folder(self._folder)
            self._asset = source.open()
        else:
            self._asset.restore_state(self._start)
        self._plant = self.knowledge.plant(self.knowledge.truth(self._seed), self._asset)
        self._step = 0
        observation, _, info = self._fly(self.knowledge.twin().proposed_control, None)
        return observation, info

    def step(self, action: np.int64 | int) -> tuple[Float, float, bool, bool, dict[str, Any]]:
        """Fly one step under a control: observation, reward, terminated, truncated, info.

        An asset that ends its simulation by itself terminates the episode, with the last observation, no
        reward and the sentence in `info["ended"]`, and so does an action that ends the mission, with what
        came of it; the last step of the mission truncates it.

        Raises
        ------
        gymnasium.error.ResetNeeded
            The mission has not begun, or is over.
        gymnasium.error.InvalidAction
            There is no such control.
        """
        if self._plant is None or self._step >= self.scenario.mission.steps:
            raise gymnasium.error.ResetNeeded("the mission is over or has not begun: call reset().")
        if not self.action_space.contains(action):
            known = self.scenario.control_names
            raise gymnasium.error.InvalidAction(said("environment.control", known=known, action=action))
        ended, last = "", self.scenario.mission.steps
        try:
            observation, reward, info = self._fly(int(action), self._control)
            if self.scenario.ends(int(action)):
                ended = decided_to_end(self.scenario, int(action))
        except FmuEndedError as error:
            observation, reward, info, ended = self._seen.copy(), 0.0, self._info, error.sentence
        if ended:
            self._step, info = last, info | {"ended": ended}
        return observation, reward, bool(ended), not ended and self._step >= last, info

    def close(self) -> None:
        """Let go of the asset and what was packed for it."""
        self._opened.close()
        self._plant = None

    def _let_go(self) -> None:
        if self._asset is not None:
            self._asset.close()
        self._asset = None

    def _fly(self, control: int, before: int | None) -> tuple[Float, float, dict[str, Any]]:
        assert self._plant is not None
        reading = self._plant.fly_step(control, before)
        sensed, happened = reading.observed, reading.happened
        assert happened is not None
        rewards, weights = self.knowledge.rewards, self.scenario.rewards
        health = float(rewards.health(happened.observation))
        worth = rewards.control_reward[control]
        reward = weights.health_weight * health + weights.control_weight * worth
        info = {
            "observed": sensed,
            "control": control,
            "step": self._step,
            "seed": self._seed,
            "state": dict(zip(self.scenario.state_names, happened.state.tolist(), strict=True)),
            "reward_health": health,
            "reward_control": worth,
        }
        self._control, self._step = control, self._step + 1
        self._seen, self._info = np.nan_to_num(sensed, nan=0.0), info
        return self._seen.copy(), reward, info
