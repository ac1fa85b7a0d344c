"""What a learning twin expects of sensors and rewards, against sums over trajectories and closed forms."""

from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.stats import foldnorm, norm

from tests.twin_master.learning.test_learning_filter import (
    CONTROLS,
    DRAWS,
    GAUGES,
    STEPS,
    enumerated,
    learner_of_all,
    model,
    observations,
    run,
    sensors,
)
from twin_master.learning.expectation import LearntExpectation
from twin_master.learning.hypotheses import quantiles_of
from twin_master.learning.learning_filter import LearningFilter, LearntPriors
from twin_master.network.estimator import Estimate
from twin_master.network.rewards import RewardModel, RewardSettings
from twin_master.network.sensor_model import GaussianSensorModel

Float = NDArray[np.float64]

SETTINGS = RewardSettings(2.0, (-0.1, 0.1), 0.8, (2.0, 3.0))
POLICY = np.array([[0.0, 1.0], [0.3, 0.7], [1.0, 0.0]])


@pytest.fixture(scope="module")
def turns() -> list[Estimate]:
    return run(learner_of_all(), observations(), CONTROLS)


@pytest.fixture(scope="module")
def expectation() -> LearntExpectation:
    return LearntExpectation(learner_of_all(), RewardModel(sensors(), SETTINGS), POLICY)


def moments(values: Float, weight: Float) -> tuple[Float, Float]:
    """Return mean and standard deviation of values (..., n) under weights (...)."""
    share = weight / weight.sum()
    mean = np.tensordot(share, values, axes=weight.ndim)
    return mean, np.sqrt(np.tensordot(share, (values - mean) ** 2, axes=weight.ndim))


def test_filtered_and_smoothed_are_sums_over_all_trajectories(
    turns: list[Estimate], expectation: LearntExpectation
) -> None:
    carried, seen, rewards = (
        [turn.carried for turn in turns],
        observations(),
        RewardModel(sensors(), SETTINGS),
    )
    filtered, smoothed = expectation.filtered(carried, seen), expectation.smoothed(carried, seen)
    value = sensors().value_per_draw
    whole = enumerated(STEPS)
    for t in range(STEPS):
        until = enumerated(t + 1)
        for found, table, axis in ((filtered, until, t), (smoothed, whole, t)):
            others = tuple(n for n in range(table.ndim - 2) if n != axis)
            weight = table.sum(axis=(*others, table.ndim - 1))  # (S, E)
            shown = value[:, :, CONTROLS[t]].swapaxes(0, 1)  # (S, E, G)
            mean, deviation = moments(shown, weight)
            np.testing.assert_allclose(found.mean[t], mean, atol=1e-8)
            np.testing.assert_allclose(found.standard_deviation[t], deviation, atol=1e-8)
            np.testing.assert_allclose(found.noise[t], [0.7, 1.1])
            health = rewards.health_per_draw[:, :, CONTROLS[t]].T[..., None]
            distance = np.ma.masked_invalid(np.abs(seen[t] - shown)).mean(axis=-1, keepdims=True)
            error = -distance.filled(np.nan) / (0.8 * np.array((2.0, 3.0))[CONTROLS[t]])
            for place, reward in ((0, health), (2, error)):
                mean, deviation = moments(reward, weight)
                np.testing.assert_allclose(found.reward_mean[t, place], mean[0], atol=1e-8)
                np.testing.assert_allclose(found.reward_standard_deviation[t, place], deviation[0], atol=1e-7)


def test_predicted_follows_the_scenario_through_the_policy(
    turns: list[Estimate], expectation: LearntExpectation
) -> None:
    found = expectation.predicted([turns[2].carried], 2)
    table = enumerated(3).sum(axis=(0, 1, 4))  # (S, E)
    table = table / table.sum()
    matrix, value = model().transition.matrix, sensors().value_per_draw
    weight = np.zeros((3, 3, 2, DRAWS))  # D_t+1, D_t+2, U_t+2, draw
    for now, one, two, control, then, draw in product(*map(range, (3, 3, 3, 2, 2, DRAWS))):
        p = (
            table[now, draw]
            * matrix[CONTROLS[2], now, one]
            * POLICY[one, control]
            * matrix[control, one, two]
        )
        weight[one, two, then, draw] += p * POLICY[two, then]
    shown = np.broadcast_to(value.transpose(1, 2, 0, 3), (3, 3, 2, DRAWS, GAUGES))
    mean, deviation = moments(shown, weight)
    np.testing.assert_allclose(found.mean[0, 1], mean, atol=1e-8)
    np.testing.assert_allclose(found.standard_deviation[0, 1], deviation, atol=1e-8)
    assert np.isnan(found.reward_mean[..., 2]).all()
    asked = weight.sum(axis=(0, 1, 3)) @ [-0.1, 0.1]
    assert found.reward_mean[0, 1, 1] == pytest.approx(asked)


def test_gain_offset_and_noise_are_those_of_the_regression() -> None:
    value = np.full((1, 1, 2, 1), 5.0)
    value[0, 0, 1] = 8.0
    sensor, one = GaussianSensorModel(value, [0.5]), model(levels=1)
    priors = LearntPriors(noise_degrees=10.0, gain=0.1, offset=2.0)
    learner = LearningFilter(one, sensor, priors)
    controls = [0, 1, 1, 0, 1, 0]
    shown = value[0, 0, controls, 0]
    seen = 1.5 + 0.93 * shown + np.array([0.1, -0.7, 0.4, 0.2, -0.1, 0.9])
    carried = [turn.carried for turn in run(learner, seen[:, None], controls)]
    # Bayesian linear regression of (o - h) / sigma on (offset, gain) in their prior deviations.
    design = np.stack([np.full(6, 2.0), 0.1 * shown], axis=1) / 0.5
    left = (seen - shown) / 0.5
    covariance = np.linalg.inv(np.eye(2) + design.T @ design)
    mean = covariance @ design.T @ left
    squares = 10.0 + left @ left - mean @ design.T @ left
    scale2 = squares / (10.0 + 6.0 - 2.0)
    row = design[-1]
    rewards = RewardModel(sensor, RewardSettings(9.0, (0.0, 0.0), 0.8))
    found = LearntExpectation(learner, rewards, np.array([[1.0, 0.0]])).filtered(carried, seen[:, None])
    spread = 0.5 * np.sqrt(scale2 * row @ covariance @ row)
    assert found.mean[-1, 0] == pytest.approx(shown[-1] + 0.5 * row @ mean)
    assert found.standard_deviation[-1, 0] == pytest.approx(spread)
    assert found.noise[-1, 0] == pytest.approx(0.5 * np.sqrt(scale2))
    distance = abs(seen[-1] - found.mean[-1, 0])
    folded = foldnorm(distance / spread, scale=spread)
    assert found.reward_mean[-1, 2] == pytest.approx(-folded.mean() / 0.8)
    assert found.reward_standard_deviation[-1, 2] == pytest.approx(folded.std() / 0.8)
    low, high = norm(found.mean[-1, 0], spread).ppf([0.025, 0.975])
    assert (found.lower[-1, 0], found.upper[-1, 0]) == pytest.approx((low, high), abs=1e-3 * spread)


def test_a_turn_says_what_the_store_says(turns: list[Estimate], expectation: LearntExpectation) -> None:
    found = expectation.filtered([turn.carried for turn in turns], observations())
    for t, turn in enumerate(turns):
        assert turn.expected is not None
        mean, noise = turn.expected()
        np.testing.assert_allclose(found.mean[t], mean, atol=1e-12)
        np.testing.assert_allclose(found.noise[t], noise)


def test_quantiles_are_those_of_the_mixture() -> None:
    weight, mean, deviation = np.array([0.5, 0.3, 0.2]), np.array([0.0, 4.0, 5.0]), np.array([1.0, 0.5, 0.0])
    levels = np.array([0.025, 0.5, 0.9])
    result = quantiles_of(weight, mean[:, None], deviation[:, None], levels)

    def reached(x: float) -> float:
        return float(weight[:2] @ norm.cdf((x - mean[:2]) / deviation[:2]))

    expected = [brentq(lambda x, level=level: reached(x) - level, -9.0, 4.9) for level in levels[:2]]
    np.testing.assert_allclose(result[:, 0], [*expected, 5.0], atol=1e-3)
