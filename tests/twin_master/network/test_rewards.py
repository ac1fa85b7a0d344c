from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin_master.errors import InvalidModelError
from twin_master.network.inference import known_control
from twin_master.network.quantity import QuantityModel
from twin_master.network.rewards import RewardModel, RewardSettings, health_reward

LOAD = (2.0, 3.0)
SETTINGS = RewardSettings(
    limit=2500e-6, control_reward=(-0.1, 0.1), error_scale=125e-6, control_normaliser=LOAD
)


def random_case(seed):
    rng = np.random.default_rng(seed)
    values = rng.uniform(500e-6, 4000e-6, size=(4, 3, 2, 5))
    weight = rng.dirichlet(np.ones(4))
    joint = rng.dirichlet(np.ones(6)).reshape(3, 2)
    return rng, QuantityModel(values, weight), joint


@given(st.integers(0, 2**32 - 1))
def test_expectations_are_sums_over_states_controls_and_draws(seed):
    rng, quantity, joint = random_case(seed)
    observation = rng.uniform(500e-6, 4000e-6, 5)
    observation[rng.integers(5)] = np.nan
    probability = quantity.draw_weight[:, None, None] * joint
    value = quantity.value_per_draw
    rewards = [
        1.0 - value.max(axis=3) / 2500e-6,
        np.broadcast_to([-0.1, 0.1], probability.shape),
        -np.nanmean(np.abs(observation - value), axis=3) / 125e-6 / LOAD,
    ]
    found = RewardModel(quantity, SETTINGS).expectation(joint, observation)
    for i, reward in enumerate(rewards):
        mean = (probability * reward).sum()
        spread = np.sqrt((probability * (reward - mean) ** 2).sum())
        assert found.mean[i] == pytest.approx(mean, abs=1e-12)
        assert found.standard_deviation[i] == pytest.approx(spread, abs=1e-7)


def test_a_known_control_has_no_spread_and_a_prediction_no_error():
    _, quantity, _ = random_case(1)
    joint = known_control(np.full((6, 3), 1 / 3), np.array([0, 1, 0, 1, 0, 1]), 2)
    found = RewardModel(quantity, SETTINGS).expectation(joint)
    assert found.mean.shape == (6, 3)
    np.testing.assert_allclose(found.mean[:, 1], [-0.1, 0.1] * 3, rtol=1e-14)
    np.testing.assert_allclose(found.standard_deviation[:, 1], 0.0, atol=1e-15)
    assert np.all(np.isnan(found.mean[:, 2]))
    assert np.all(np.isnan(found.standard_deviation[:, 2]))


def test_with_every_sensor_lost_the_error_is_unknown():
    _, quantity, joint = random_case(2)
    found = RewardModel(quantity, SETTINGS).expectation(joint, np.full(5, np.nan))
    assert np.isnan(found.mean[2])
    assert np.all(np.isfinite(found.mean[:2]))


def test_planning_reward_weighs_health_and_control():
    _, quantity, _ = random_case(3)
    model = RewardModel(quantity, SETTINGS)
    health = np.tensordot(quantity.draw_weight, health_reward(quantity.value_per_draw, 2500e-6), axes=1)
    np.testing.assert_allclose(model.planning_reward(1.0, 2.5), health + np.array([-0.25, 0.25]), rtol=1e-13)


def test_settings_are_checked():
    for bad in ({"limit": 0.0}, {"limit": np.nan}, {"error_scale": -1.0}):
        with pytest.raises(InvalidModelError, match="must be finite and positive"):
            RewardSettings(**({"limit": 1.0, "control_reward": (0.0,), "error_scale": 1.0} | bad))
    with pytest.raises(InvalidModelError, match="'control_normaliser' must be finite and positive"):
        RewardSettings(1.0, (0.0, 1.0), 1.0, (1.0, 0.0))
    with pytest.raises(InvalidModelError, match="'control_reward' must be finite"):
        RewardSettings(1.0, (0.0, np.inf), 1.0)
    _, quantity, joint = random_case(4)
    with pytest.raises(InvalidModelError, match="each of 2 controls, got 3"):
        RewardModel(quantity, RewardSettings(1.0, (0.0, 1.0, 2.0), 1.0))
    model = RewardModel(quantity, RewardSettings(1.0, (0.0, 1.0), 1.0))
    with pytest.raises(InvalidModelError, match="joint belief"):
        model.expectation(joint[0])
    with pytest.raises(InvalidModelError, match="expected observations of shape"):
        model.expectation(joint, np.zeros(4))
