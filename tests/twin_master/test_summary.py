"""The figures of a mission."""

from __future__ import annotations

import numpy as np
import pytest

from twin_master.scenario_file import load_scenario
from twin_master.summary import filtered_rms_error, find_fallback
from twin_master.twin import build_graphical_model

MODEL = build_graphical_model(load_scenario("level_turns").scenario)
Z1 = MODEL.states.coordinates[:, 0]
POLICY = np.where(Z1 > 0.59, 0, 1)
TRUTH = np.zeros((50, 2))
TRUTH[20:, 0], TRUTH[30:, 0] = 0.4, 0.6


def controls(*gentle: int) -> np.ndarray:
    flown = np.ones(50, dtype=np.int64)
    flown[list(gentle)] = 0
    return flown


@pytest.mark.parametrize(
    ("gentle", "delay", "early"),
    [
        (range(31, 50), 1, None),
        (range(33, 50), 3, None),
        ([*range(25, 27), *range(32, 50)], 2, 25),
        (range(29, 50), 0, 29),
        ([], None, None),
    ],
)
def test_fallback(gentle: range | list[int], delay: int | None, early: int | None) -> None:
    found = find_fallback(MODEL, POLICY, 1, controls(*gentle), TRUTH)
    assert (found.switch_state, found.switch_level) == ("z1", 0.6)
    assert found.called_for_step == 30
    assert found.delay == delay
    assert found.early_step == early


def test_a_policy_of_several_states_or_none_has_no_switch() -> None:
    both = np.where(MODEL.states.coordinates.sum(axis=1) > 0.59, 0, 1)
    for policy in (both, np.ones(25, dtype=np.int64)):
        found = find_fallback(MODEL, policy, 1, controls(31), TRUTH)
        assert found.switch_state is None
        assert found.delay is None


def test_no_damage_calls_for_no_fallback() -> None:
    found = find_fallback(MODEL, POLICY, 1, controls(12), np.zeros((50, 2)))
    assert found.called_for_step is None
    assert found.early_step == 12
    assert found.delay is None


def test_rms_error_of_a_certain_belief() -> None:
    belief = np.tile(MODEL.states.certain((0.2, 0.4)), (50, 1))
    error = filtered_rms_error(MODEL, belief, TRUTH)
    expected = np.sqrt([np.mean((0.2 - TRUTH[:, 0]) ** 2), 0.4**2])
    np.testing.assert_allclose(error, expected)
