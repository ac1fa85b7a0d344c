from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_master.assets.strain_library_source import load_strain_library
from twin_master.errors import InvalidDistributionError, PlanningError
from twin_master.network.graphical_model import worsening_table
from twin_master.network.planner import evaluate_policy, value_iteration
from twin_master.network.quantity import QuantityModel
from twin_master.network.rewards import RewardModel, RewardSettings
from twin_master.network.transition import TransitionModel

LIBRARY = Path(__file__).parents[3].parent / "shared" / "reference" / "uav_digital_twin"


def random_problem(seed, states=7, controls=3):
    rng = np.random.default_rng(seed)
    transition = rng.dirichlet(np.full(states, 0.3), (controls, states))
    transition /= transition.sum(axis=2, keepdims=True)
    return transition, rng.normal(size=(states, controls))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), discount=st.sampled_from([0.0, 0.6, 0.9, 0.99]))
def test_the_value_is_optimal_and_that_of_its_policy(seed, discount):
    transition, reward = random_problem(seed)
    plan = value_iteration(transition, reward, discount)
    scale = np.abs(reward).max() / (1.0 - discount)
    exact = evaluate_policy(transition, reward, discount, plan.policy)
    np.testing.assert_allclose(plan.value, exact, rtol=0, atol=1e-11 * scale)
    action_value = reward + discount * np.einsum("ust,t->su", transition, plan.value)
    np.testing.assert_allclose(plan.action_value, action_value, rtol=0, atol=1e-12 * scale)
    np.testing.assert_allclose(plan.value, action_value.max(axis=1), rtol=0, atol=1e-11 * scale)
    np.testing.assert_array_equal(plan.policy.argmax(axis=1), plan.control_index)


@pytest.mark.parametrize("seed", range(5))
def test_equal_to_pymdptoolbox(seed):
    transition, reward = random_problem(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from mdptoolbox.mdp import PolicyIteration, ValueIteration

        iteration = ValueIteration(transition, reward, 0.6, epsilon=1e-12, max_iter=10_000)
        iteration.run()
        exact = PolicyIteration(transition, reward, 0.6)
        exact.run()
    plan = value_iteration(transition, reward, 0.6)
    np.testing.assert_array_equal(plan.control_index, iteration.policy)
    np.testing.assert_array_equal(plan.control_index, exact.policy)
    np.testing.assert_allclose(plan.value, exact.V, rtol=0, atol=1e-10)


def test_closed_form_of_one_state():
    plan = value_iteration(np.ones((2, 1, 1)), [[1.0, 3.0]], 0.75)
    assert plan.value == pytest.approx(12.0, rel=1e-12)
    assert plan.control_index == [1]


def test_ties_go_to_the_first_control():
    transition, reward = random_problem(0)
    doubled = np.concatenate([transition, transition])
    plan = value_iteration(doubled, np.concatenate([reward, reward + 1e-15], axis=1), 0.9)
    assert np.all(plan.control_index < 3)
    assert np.all(value_iteration(transition, np.zeros((7, 3)), 0.9).control_index == 0)


MOVES, REWARD = random_problem(0)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: value_iteration(MOVES, REWARD.T, 0.6), "rewards of shape"),
        *(
            (lambda bad=bad: value_iteration(MOVES, REWARD, bad), r"discount factor in \[0, 1\)")
            for bad in (1.0, -0.1, np.nan)
        ),
        (lambda: value_iteration(MOVES, REWARD, 0.9, max_iterations=3), "after 3 sweeps"),
        (lambda: value_iteration(MOVES * 0.95, REWARD, 0.6), "does not sum to one"),
        (lambda: evaluate_policy(MOVES, REWARD, 0.6, np.ones((7, 1))), "expected a policy of shape"),
        (lambda: value_iteration(MOVES, np.full((7, 3), np.nan), 0.6), r"\(0, 0\) is nan"),
    ],
)
def test_bad_problems_are_refused(make, sentence):
    with pytest.raises((PlanningError, InvalidDistributionError), match=sentence):
        make()


@pytest.mark.skipif(not LIBRARY.exists(), reason="the authors' strain library is not on this machine")
def test_the_authors_library_gives_the_published_policy():
    """3g until z1 reaches 60 percent, then 2g, whatever z2 (Kapteyn et al. 2021, Fig. 6)."""
    library = load_strain_library(LIBRARY)
    rewards = RewardModel(
        QuantityModel(library.strain_per_draw), RewardSettings(2500e-6, (-0.1, 0.1), 125e-6, (2.0, 3.0))
    )
    tables = [[worsening_table(5, library.worsening_probability[c])] * 2 for c in library.controls]
    transition = TransitionModel.from_factors(tables)
    plan = value_iteration(transition.matrix, rewards.planning_reward(1.0, 2.5), library.discount)
    z1 = library.states.coordinates[:, 0]
    np.testing.assert_array_equal(plan.control_index == library.controls.index("3g"), z1 < 0.6 - 1e-9)
    margin = (
        plan.action_value[:, library.controls.index("3g")]
        - plan.action_value[:, library.controls.index("2g")]
    )
    np.testing.assert_allclose(margin[np.isclose(z1, 0.4)], 0.007, atol=5e-4)
    np.testing.assert_allclose(margin[np.isclose(z1, 0.6)], -0.059, atol=5e-4)
