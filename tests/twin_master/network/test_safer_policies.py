"""Policies that are safer than the most probable control: by risk, and with held changes."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from twin_master.network.planner import Hold, RiskPolicy
from twin_master.network.transition import TransitionModel
from twin_master.network.twin import DecisionRule
from uav_twin import GraphicalModel, Twin

GENTLE, MIDDLE, HARD = 0, 1, 2
BEYOND_LIMIT = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
"""The hard control is allowed in the first state only, the middle one in the first two."""
HARDEST_FIRST = np.array([HARD, MIDDLE, GENTLE])
beliefs = hnp.arrays(np.float64, 3, elements=st.floats(0.0, 1.0)).filter(lambda row: row.sum() > 0.1)


def by_risk(level: float) -> RiskPolicy:
    return RiskPolicy(BEYOND_LIMIT, HARDEST_FIRST, level)


@given(beliefs, st.floats(0.01, 1.0), st.floats(0.0, 1.0))
def test_the_hardest_control_below_the_level_is_taken(weights, level, unexplained):
    belief = weights / weights.sum()
    risk = {
        HARD: (1 - unexplained) * (belief[1] + belief[2]) + unexplained,
        MIDDLE: (1 - unexplained) * belief[2] + unexplained,
        GENTLE: 0.0,
    }
    taken = int(by_risk(level).decide(belief, unexplained))
    allowed = [control for control in (HARD, MIDDLE, GENTLE) if risk[control] < level - 1e-12]
    nearly_allowed = [control for control in (HARD, MIDDLE, GENTLE) if risk[control] < level + 1e-12]
    assert nearly_allowed[0] <= taken or taken == allowed[0]
    assert taken in (allowed[0], nearly_allowed[0])


@given(beliefs, st.floats(0.02, 1.0))
def test_a_smaller_level_never_takes_a_harder_control(weights, level):
    belief = weights / weights.sum()
    assert by_risk(level / 2).decide(belief) <= by_risk(level).decide(belief)


def test_without_an_explanation_the_gentlest_control_is_taken():
    assert by_risk(0.5).decide([1.0, 0.0, 0.0], 0.6) == GENTLE


def test_the_decision_of_twins_contains_that_no_state_explains_the_sensors():
    transition = TransitionModel((np.stack([np.eye(3)] * 3),))
    rule = DecisionRule(transition, np.eye(3), by_risk(0.05), safest=np.eye(3)[GENTLE])
    probability = rule.probabilities(
        np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), np.array([HARD, HARD]), np.array([0.0, 0.1])
    )
    assert np.array_equal(probability, np.eye(3)[[HARD, GENTLE]])


def held_controls(proposals: list[int], needed: int) -> list[int]:
    """Return the controls that follow proposals, the first of which is made under the gentle control."""
    hold = Hold(needed, np.array([0, 1, 2]))
    control = np.array([GENTLE])
    in_a_row = np.zeros(1, dtype=np.int64)
    controls = []
    for proposal in proposals:
        probability, in_a_row = hold.apply(np.eye(3)[[proposal]], control, in_a_row)
        control = np.argmax(probability, axis=1)
        controls.append(int(control[0]))
    return controls


@pytest.mark.parametrize(
    ("proposals", "controls"),
    [
        ([HARD, HARD, HARD], [GENTLE, GENTLE, HARD]),
        ([HARD, HARD, GENTLE, HARD, HARD], [GENTLE] * 5),
        ([HARD, HARD, HARD, MIDDLE, HARD], [GENTLE, GENTLE, HARD, MIDDLE, MIDDLE]),
        ([HARD, MIDDLE, HARD, GENTLE], [GENTLE, GENTLE, HARD, GENTLE]),
    ],
)
def test_a_harder_control_needs_three_proposals_in_a_row(proposals, controls):
    assert held_controls(proposals, 3) == controls


@given(st.lists(st.integers(0, 2), max_size=12), st.integers(1, 4))
def test_held_controls_are_never_harder_than_those_proposed(proposals, needed):
    pairs = zip(held_controls(proposals, needed), proposals, strict=True)
    assert all(control <= proposal for control, proposal in pairs)


@given(hnp.arrays(np.float64, (4, 3), elements=st.floats(0.01, 1.0)), st.integers(1, 3))
def test_held_probabilities_sum_to_those_of_the_policy(probability, needed):
    control = np.array([GENTLE, MIDDLE, HARD, GENTLE])
    held, _ = Hold(needed, np.arange(3)).apply(probability, control, np.array([0, 1, 2, 1]))
    assert held.sum(axis=1) == pytest.approx(probability.sum(axis=1))
    assert (held >= 0.0).all()


class ToldStates:
    """A sensor model whose observation is the number of the state, for a wear of two levels."""

    def log_likelihood(self, observation: np.ndarray, control: int) -> np.ndarray:
        """Return the log likelihood of each state; zero where nothing is observed."""
        if np.isnan(observation).all():
            return np.zeros(2)
        return np.where(np.arange(2) == int(observation[0]), 0.0, -20.0)


def holding_twin(lag: int | None = None) -> Twin:
    table = [[0.9, 0.1], [0.1, 0.9]]
    model = GraphicalModel.from_tables(
        levels={"wear": (0.0, 1.0)},
        prior={"wear": (0.5, 0.5)},
        tables={"soft": {"wear": table}, "hard": {"wear": table}},
    )
    policy = np.array([[0.0, 1.0], [1.0, 0.0]])  # hard if not worn
    hold = Hold(2, np.array([0, 1]))
    return Twin("mine", model, ToldStates(), policy, lag=lag, first_control="soft", hold=hold)


def test_a_twin_holds_a_harder_control():
    twin = holding_twin()
    assert [twin.step([state]).next_control for state in (1, 0, 0, 1, 0, 1, 0, 0)] == [0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize("states", list(product((0, 1), repeat=3)))
def test_a_late_observation_is_held_as_one_in_time(states):
    in_time, late = holding_twin(lag=5), holding_twin(lag=5)
    for state in states:
        expected = in_time.step([state], "soft")
    for step, state in enumerate(states):
        late.step([np.nan if step == 1 else state], "soft")
    revised = late.revise(1, [states[1]])
    assert revised.next_control == expected.next_control
    assert late.save_state() == in_time.save_state()


def test_a_restored_twin_goes_on_holding():
    twin, restored = holding_twin(), holding_twin()
    twin.step([0])
    restored.restore_state(twin.save_state())
    assert restored.step([0]).next_control == twin.step([0]).next_control == 1
