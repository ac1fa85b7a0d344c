"""Quantities, rewards and plans: sums over states, controls and draws; optimal values."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_master.errors import InvalidModelError, PlanningError
from twin_master.network.inference import known_control
from twin_master.network.planner import given_policy, value_iteration
from twin_master.network.quantity import QuantityModel, RewardModel
from twin_master.network.transition import TransitionModel

SEEDS = st.integers(0, 2**32 - 1)


def random_case(seed, ties=False):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(4, 3, 2, 5))
    if ties:
        values = np.round(values)
    weight = rng.dirichlet(np.ones(4))
    joint = rng.dirichlet(np.ones(6), size=7).reshape(7, 3, 2)
    joint[0] = 0.0
    joint[0, 1, 1] = 1.0
    return values, weight, joint


def points(values, weight, joint, sensor):
    """Every value of one sensor with its probability, under one joint belief."""
    probability = weight[:, None, None] * joint
    return values[..., sensor].ravel(), probability.ravel()


@settings(deadline=None)
@given(SEEDS, st.booleans())
def test_moments_and_quantiles_are_those_of_the_mixture(seed, ties):
    """The smallest value whose cumulative probability reaches the level; ties and zero weights included."""
    values, weight, joint = random_case(seed, ties)
    levels, model = [0.025, 0.3, 0.5, 0.975, 1.0], QuantityModel(values, weight)
    (mean, deviation), result = model.moments(joint), model.quantiles(joint, levels)
    assert result.shape == (7, 5, 5)
    nested = joint[:6].reshape(2, 3, 3, 2)
    np.testing.assert_array_equal(model.moments(nested)[1].reshape(6, 5), deviation[:6])
    assert model.quantiles(nested, levels).shape == (2, 3, 5, 5)
    for b in range(7):
        for g in range(5):
            x, p = points(values, weight, joint[b], g)
            assert mean[b, g] == pytest.approx(p @ x, abs=1e-13)
            assert deviation[b, g] == pytest.approx(np.sqrt(p @ (x - p @ x) ** 2), abs=1e-13)
            x, p = x[p > 0], p[p > 0]
            order = np.argsort(x)
            cumulative = np.cumsum(p[order])
            for i, level in enumerate(levels):
                expected = x[order][np.argmax(cumulative >= level - 1e-12)] if level < 1 else x.max()
                assert result[b, i, g] == expected


LIMIT, LOAD = 2500e-6, (2.0, 3.0)
SETTINGS = LIMIT, (-0.1, 0.1), 125e-6, LOAD


def strains(seed):
    rng = np.random.default_rng(seed)
    quantity = QuantityModel(rng.uniform(500e-6, 4000e-6, size=(4, 3, 2, 5)), rng.dirichlet(np.ones(4)))
    return rng, quantity, rng.dirichlet(np.ones(6)).reshape(3, 2)


@given(SEEDS)
def test_rewards_are_sums_over_states_controls_and_draws(seed):
    rng, quantity, joint = strains(seed)
    observation = rng.uniform(500e-6, 4000e-6, 5)
    observation[rng.integers(5)] = np.nan
    probability, value = quantity.draw_weight[:, None, None] * joint, quantity.value_per_draw
    rewards = [
        1.0 - value.max(axis=3) / LIMIT,
        np.broadcast_to([-0.1, 0.1], probability.shape),
        -np.nanmean(np.abs(observation - value), axis=3) / 125e-6 / LOAD,
    ]
    model = RewardModel(quantity, *SETTINGS)
    means, spreads = model.expectation(joint, observation)
    for i, reward in enumerate(rewards):
        mean = (probability * reward).sum()
        spread = np.sqrt((probability * (reward - mean) ** 2).sum())
        assert means[i] == pytest.approx(mean, abs=1e-12)
        assert spreads[i] == pytest.approx(spread, abs=1e-7)
    # A known control has no spread, and without an observation there is no error.
    mean, spread = model.expectation(known_control(np.full((2, 3), 1 / 3), np.array([0, 1]), 2))
    np.testing.assert_allclose(mean[:, 1], [-0.1, 0.1], rtol=1e-14)
    np.testing.assert_allclose(spread[:, 1], 0.0, atol=1e-15)
    lost, _ = model.expectation(joint, np.full(5, np.nan))
    assert np.isnan([*mean[:, 2], *spread[:, 2], lost[2]]).all()
    health = np.tensordot(quantity.draw_weight, 1.0 - value.max(axis=3) / LIMIT, axes=1)
    np.testing.assert_allclose(model.planning_reward(1.0, 2.5), health + np.array([-0.25, 0.25]), rtol=1e-13)


def random_problem(seed, states=7, controls=3):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.full(states, 0.3), (controls, states))
    transition /= transition.sum(axis=2, keepdims=True)
    return transition, rng.normal(size=(states, controls))


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS, discount=st.sampled_from([0.0, 0.6, 0.9, 0.99]), product=st.booleans())
def test_the_value_is_optimal_and_that_of_its_policy(seed, discount, product):
    transition, reward = random_problem(seed, 6)
    model = TransitionModel((transition,))
    if product:
        model = TransitionModel(tuple(random_problem(seed, states)[0] for states in (2, 3)))
        transition = model.matrix
    plan = value_iteration(model, reward, discount)
    scale = np.abs(reward).max() / (1.0 - discount)
    for policy in (np.random.default_rng(seed).dirichlet(np.ones(3), 6), plan.policy):
        closed_loop = discount * np.einsum("su,ust->st", policy, transition)
        exact = np.linalg.solve(np.eye(6) - closed_loop, (policy * reward).sum(axis=1))
        found = given_policy(model, reward, discount, policy)
        np.testing.assert_allclose(found.value, exact, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(plan.value, exact, rtol=0, atol=1e-11 * scale)
    action_value = reward + discount * np.einsum("ust,t->su", transition, plan.value)
    np.testing.assert_allclose(plan.action_value, action_value, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(plan.value, action_value.max(axis=1), rtol=0, atol=1e-11 * scale)
    np.testing.assert_array_equal(plan.policy.argmax(axis=1), plan.control_index)


def test_ties_go_to_the_first_control():
    transition, reward = random_problem(0)
    doubled = TransitionModel((np.concatenate([transition, transition]),))
    plan = value_iteration(doubled, np.concatenate([reward, reward + 1e-15], axis=1), 0.9)
    assert np.all(plan.control_index < 3)
    assert np.all(value_iteration(TransitionModel((transition,)), np.zeros((7, 3)), 0.9).control_index == 0)


TABLE, REWARD = random_problem(0)
MOVES = TransitionModel((TABLE,))
VALUES, WEIGHT, JOINT = random_case(0)
HOLED = np.where(np.arange(VALUES.size).reshape(VALUES.shape) == 12, np.nan, VALUES)  # at (0, 1, 0, 2)
QUANTITY = QuantityModel(VALUES, WEIGHT)
REWARDS = RewardModel(QUANTITY, 1.0, (0.0, 1.0), 1.0)
REFUSED = [
    (lambda: QuantityModel(VALUES[0]), r"\(draws, states, controls, sensors\)"),
    (lambda: QuantityModel(HOLED), r"\(0, 1, 0, 2\) is nan"),
    (lambda: QuantityModel(VALUES, WEIGHT * 2), "draw weights"),
    (lambda: QUANTITY.moments(JOINT[:, :, 0]), "known_control"),
    *((lambda bad=bad: QUANTITY.quantiles(JOINT, bad), "increasing quantile levels")
      for bad in ([0.9, 0.1], [0.0], [1.1], 0.5, [np.nan])),
    (lambda: REWARDS.expectation(JOINT[1, 0]), "joint belief"),
    (lambda: value_iteration(MOVES, REWARD.T, 0.6), "rewards of shape"),
    *((lambda bad=bad: value_iteration(MOVES, REWARD, bad), r"discount factor in \[0, 1\)")
      for bad in (1.0, -0.1, np.nan)),
    (lambda: value_iteration(MOVES, REWARD, 0.9, max_iterations=3), "after 3 sweeps"),
    (lambda: value_iteration(TABLE * 0.95, REWARD, 0.6), "does not sum to one"),
    (lambda: value_iteration(MOVES, np.full((7, 3), np.nan), 0.6), r"\(0, 0\) is nan"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "sentence"), REFUSED)
def test_what_does_not_fit_is_refused(make, sentence):
    with pytest.raises((InvalidModelError, PlanningError), match=sentence):
        make()
