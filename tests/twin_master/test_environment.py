"""A scenario as an environment of gymnasium: its checker, and the mission that our own policy flies in it."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.twin_master.runs import changed_scenario, flight_of, text_of, written
from twin_master.assets.resolution import asset_source
from twin_master.environment import ScenarioEnvironment
from twin_master.errors import MissionInputError


@pytest.fixture(params=["level_turns", "growing_damage", "failing_gauges"])
def environment(request: pytest.FixtureRequest, library_file: Path) -> Iterator[ScenarioEnvironment]:
    made = ScenarioEnvironment(request.param, {"strain_library": library_file})
    yield made
    made.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space:UserWarning", "ignore:.*render:UserWarning")
def test_it_passes_the_checker_of_gymnasium(environment):
    check_env(environment)


def test_our_policy_flies_the_mission_of_the_loop(environment):
    """To the last bit, with the seed of the mission; rewards by enumeration. Wrong use is refused."""
    scenario, knowledge = environment.scenario, environment.knowledge
    flight = flight_of(knowledge, asset_source(scenario))
    for seed in (4, 3):  # an episode leaves nothing to the next one
        twin, (observation, info) = knowledge.twin(), environment.reset(seed=seed)
        observed, controls, rewards, truncated = [info["observed"]], [info["control"]], [], False
        while not truncated:
            action = twin.turn(info["observed"], info["control"]).next_control
            observation, reward, terminated, truncated, info = environment.step(action)
            assert not terminated
            np.testing.assert_array_equal(
                observation, np.where(np.isnan(info["observed"]), 0, info["observed"])
            )
            observed.append(info["observed"])
            controls.append(info["control"])
            rewards.append(reward)
    np.testing.assert_array_equal(observed, flight.observed)
    np.testing.assert_array_equal(controls, flight.control_index)
    assert info["state"] == dict(zip(scenario.state_names, flight.state[-1], strict=True))
    section = scenario.rewards
    worst = (flight.observation / section.health_limit).max(axis=1)
    worth = np.array([section.control[scenario.control_names[u]] for u in controls])
    expected = section.health_weight * (1 - worst) + section.control_weight * worth
    np.testing.assert_allclose(rewards, expected[1:], rtol=1e-14)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        environment.step(0)
    environment.reset(seed=1)
    with pytest.raises(gymnasium.error.InvalidAction, match="controls 2g, 3g, got 2"):
        environment.step(2)
    environment.close()
    with pytest.raises(MissionInputError, match="is closed"):
        environment.reset()


def test_an_action_that_ends_the_mission_terminates_the_episode(tmp_path):
    land = '[[action]]\nname = "land"\ncontrol = "2g"\ncost = 0.0\nends = true\n\n[observation]'
    text = text_of("inspected_wing", ("[observation]", land), ('policy = "belief"', 'policy = "mode"'))
    environment = ScenarioEnvironment(written(tmp_path, text), {"in_process": True})
    environment.reset(seed=1)
    assert not any(environment.step(0)[2:4])
    _, reward, terminated, truncated, info = environment.step(5)
    assert (terminated, truncated, info["ended"]) == (True, False, "the twin decided on `land`.")
    assert reward != 0.0
    with pytest.raises(gymnasium.error.ResetNeeded):
        environment.step(0)
    environment.close()


def test_chance_inside_the_asset_begins_with_the_seed_of_the_episode():
    loaded = changed_scenario("three_fmus", {"mission": {"steps": 3}})
    environment, other = (ScenarioEnvironment(loaded, {"in_process": True, "seed": seed}) for seed in (1, 5))
    first, second, again = (environment.reset(seed=seed)[0] for seed in (5, 6, 5))
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(other.reset(seed=5)[0], first)
    assert not np.array_equal(first, second)
    environment.close()
    other.close()


def test_without_gymnasium_there_is_a_sentence(monkeypatch):
    monkeypatch.delitem(sys.modules, "twin_master.environment")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissionInputError, match=r"needs gymnasium: pip install 'uav-twin\[gym\]'\.$"):
        importlib.import_module("twin_master.environment")
