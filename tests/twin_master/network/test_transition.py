"""Transitions as products of blocks: equal to one table of all states, however small the probabilities."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from twin_master.errors import ImpossibleObservation, InvalidModelError
from twin_master.network import transition as transition_file
from twin_master.network.graphical_model import Factor, GraphicalModel, StateSpace, worsening_table
from twin_master.network.inference import filter_sequence, filter_step, predict, smooth
from twin_master.network.planner import evaluate_policy, given_policy, value_iteration
from twin_master.network.transition import TransitionModel

sys.path.insert(0, str(Path(__file__).parent))
from decision_oracles import precise_forward_backward


def both(rng, shape=(3, 4, 2), zeros=0.3, least=0.0):
    """The same model as a product of one block for each factor, and as one table."""
    blocks = []
    for count in shape:
        block = rng.dirichlet(np.ones(count), (2, count))
        block[rng.random(block.shape) < zeros] = least
        block[:, np.arange(count), rng.integers(count, size=count)] += 0.1
        blocks.append(block / block.sum(axis=2, keepdims=True))
    space = StateSpace(tuple(Factor(f"f{i}", tuple(map(float, range(n)))) for i, n in enumerate(shape)))
    prior = rng.dirichlet(np.ones(space.size))
    prior[rng.random(space.size) < zeros] = 0.0
    prior[0] += 0.1
    prior /= prior.sum()
    product = TransitionModel(tuple(blocks))
    models = [
        GraphicalModel(space, ("u0", "u1"), prior, moves)
        for moves in (product, TransitionModel((product.matrix,)))
    ]
    assert [model.transition.is_product for model in models] == [True, False]
    return models


def infer(model, control, rows):
    filtered = filter_sequence(model, control, rows)
    return filtered, smooth(model, control, filtered.log_filtered)


@settings(max_examples=40)
@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1.0, 30.0, 3000.0]))
def test_a_product_of_blocks_gives_what_the_table_gives(seed, scale):
    """Also where all but a few states underflow."""
    rng = np.random.default_rng(seed)
    product, table = both(rng, shape=tuple(rng.integers(1, 5, 3)))
    control = rng.integers(0, 2, 6)
    rows = -scale * rng.random((6, product.states.size))
    (found, smoothed), (expected, smoothed_by_table) = (infer(m, control, rows) for m in (product, table))
    for name in ("forecast", "filtered"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(expected, name), rtol=1e-11, atol=1e-300, err_msg=name
        )
    np.testing.assert_allclose(smoothed, smoothed_by_table, rtol=1e-10, atol=1e-300)
    np.testing.assert_allclose(found.log_filtered, expected.log_filtered, rtol=1e-13, atol=1e-11)
    np.testing.assert_allclose(found.log_evidence, expected.log_evidence, rtol=1e-13, atol=1e-11)
    last = filter_step(product, found.log_filtered[-2], int(control[-2]), rows[-1])
    np.testing.assert_array_equal(last.log_filtered, found.log_filtered[-1])


def test_probabilities_that_no_double_holds_come_back():
    """A belief that was 10^-8000, and transitions of 10^-300 in all, against 60 decimals."""
    rng = np.random.default_rng(5)
    product, _ = both(rng, shape=(2, 2, 2), zeros=0.5, least=1e-100)
    rows = np.zeros((4, 8))
    rows[1, :7] = -5000.0
    rows[2, 7] = -20000.0
    rows[3] = rng.normal(size=8)
    control = np.array([0, 1, 1, 0])
    filtered, smoothed = infer(product, control, rows)
    oracle = precise_forward_backward(product, control, rows)
    np.testing.assert_allclose(filtered.filtered, oracle[0], rtol=1e-10, atol=1e-300)
    np.testing.assert_allclose(smoothed, oracle[1], rtol=1e-10, atol=1e-300)


def test_what_is_impossible_stays_impossible_and_is_named():
    product, table = both(np.random.default_rng(2), shape=(2, 3, 2), zeros=0.6)
    rows = np.zeros((3, 12))
    assert np.array_equal(
        filter_sequence(product, [0, 1, 0], rows).filtered == 0.0,
        filter_sequence(table, [0, 1, 0], rows).filtered == 0.0,
    )
    rows[1] = -np.inf
    with pytest.raises(ImpossibleObservation):
        filter_sequence(product, [0, 1, 0], rows)


def test_prediction_and_plan_follow():
    rng = np.random.default_rng(4)
    product, table = both(rng)
    policy = product.policy(rng.dirichlet(np.ones(2), 24))
    belief = rng.dirichlet(np.ones(24))
    for name in ("predicted", "joint", "control_probability"):
        one, other = (getattr(predict(model, belief, 1, policy, 4), name) for model in (product, table))
        np.testing.assert_allclose(one, other, rtol=1e-12, err_msg=name)
    reward = rng.normal(size=(24, 2))
    plan, plan_by_table = (value_iteration(model.transition, reward, 0.9) for model in (product, table))
    np.testing.assert_allclose(plan.value, plan_by_table.value, rtol=1e-11)
    np.testing.assert_array_equal(plan.control_index, plan_by_table.control_index)
    assert plan.iterations == plan_by_table.iterations
    for discount in (0.0, 0.97):
        one, other = (evaluate_policy(m.transition, reward, discount, policy) for m in (product, table))
        np.testing.assert_allclose(one, other, rtol=1e-11)
    one, other = (given_policy(m.transition, reward, 0.9, policy) for m in (product, table))
    np.testing.assert_allclose(one.action_value, other.action_value, rtol=1e-11)


def test_factors_share_a_table_where_that_is_small_and_blocks_where_it_costs_no_more(monkeypatch):
    worse = worsening_table(5, 0.1)
    sizes = {
        count: [block.shape[1] for block in TransitionModel.from_factors([[worse] * count] * 2).blocks]
        for count in (1, 2, 4, 6, 7)
    }
    assert sizes == {1: [5], 2: [25], 4: [25, 25], 6: [25, 25, 25], 7: [25, 25, 25, 5]}
    full = np.full((40, 40), 1.0 / 40)
    assert [b.shape[1] for b in TransitionModel.from_factors([[full, full]]).blocks] == [40, 40]
    still = np.eye(400)
    assert [b.shape[1] for b in TransitionModel.from_factors([[still, still]]).blocks] == [400, 400]
    monkeypatch.setattr(transition_file, "JOINT_NON_ZEROS", 0)
    tables = [[worsening_table(n, p) for n in (3, 2, 4)] for p in (0.1, 0.2)]
    np.testing.assert_allclose(
        TransitionModel.from_factors(tables).matrix[1],
        np.kron(np.kron(tables[1][0], tables[1][1]), tables[1][2]),
        rtol=1e-15,
    )


def test_blocks_of_different_controls_are_refused():
    with pytest.raises(InvalidModelError, match="the same controls"):
        TransitionModel((np.eye(2)[None], np.stack([np.eye(3)] * 2)))
