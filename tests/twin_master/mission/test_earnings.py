"""What flights earn: rewards by state and belief, the discounted return, and what was promised."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.costs import once
from tests.twin_master.runs import of_wing, table_of
from twin_master.mission.earnings import discounted_return, earnings, promised_return
from twin_master.mission.flights import Flights, fly_side_by_side
from twin_master.mission.preparation import Knowledge
from twin_master.network.graphical_model import Factor, StateSpace
from twin_master.report.reading import NORMAL_95
from twin_master.scenario.reading import parse_scenario

GENTLE, SHARP = 0, 1


@once
def knowledge(**planner: object) -> Knowledge:
    """Return what the twin of growing_damage knows, with few draws and other keys of `planner`."""
    table = table_of("growing_damage")
    table["planner"] |= planner
    table["calibration"]["draws"] = 5
    return of_wing(parse_scenario(table, "x"))[0]


def flown(known: Knowledge, seeds: int) -> Flights:
    from twin_master.assets.reduced_model import ReducedModelSource
    from uav_twin import reduced_model

    asset = ReducedModelSource(known.scenario, reduced_model()).open()
    return fly_side_by_side(known, [known.truth(seed) for seed in range(seeds)], [asset] * seeds)


@pytest.mark.parametrize("control", [GENTLE, SHARP])
def test_a_known_state_earns_the_reward_that_is_planned_for(control):
    known = knowledge()
    states = known.model.states.coordinates
    controls = np.full(len(states), control)
    earned = earnings(known, controls, np.full((len(states), len(states)), np.nan), states)
    assert earned.reward == pytest.approx(known.planning_reward[:, control])
    assert np.array_equal(earned.beyond_limit, known.is_beyond_limit[:, control])


def test_between_two_levels_the_reward_is_interpolated():
    known = knowledge()
    low, high = known.model.states.index((0.2, 0.0)), known.model.states.index((0.4, 0.0))
    no_belief = np.full((1, known.model.states.size), np.nan)
    earned = earnings(known, np.array([SHARP]), no_belief, np.array([[0.25, 0.0]]))
    expected = 0.75 * known.planning_reward[low, SHARP] + 0.25 * known.planning_reward[high, SHARP]
    assert earned.reward == pytest.approx([expected])


def test_an_unknown_state_earns_the_mean_over_the_belief():
    known = knowledge()
    belief = np.zeros((1, known.model.states.size))
    belief[0, [0, 10]] = 0.3, 0.7
    earned = earnings(known, np.array([SHARP]), belief, np.full((1, 2), np.nan))
    assert earned.reward == pytest.approx(belief @ known.planning_reward[:, SHARP])
    assert earned.beyond_limit == pytest.approx(belief @ known.is_beyond_limit[:, SHARP])


def test_steps_that_were_not_flown_earn_nothing():
    known = knowledge()
    not_flown = np.full(3, -1)
    earned = earnings(known, not_flown, np.full((3, 25), np.nan), np.full((3, 2), np.nan))
    assert np.isnan(earned.reward).all()
    assert np.isnan(discounted_return(known.scenario, earned.reward, not_flown))


def test_a_control_is_beyond_the_limit_where_the_best_one_is_gentler():
    known = knowledge()
    best = known.plan_by_states.control_index
    assert set(best.tolist()) == {GENTLE, SHARP}
    assert np.array_equal(known.is_beyond_limit[:, SHARP], best == GENTLE)
    assert np.array_equal(known.is_needless[:, GENTLE], best == SHARP)
    assert not known.is_beyond_limit[:, GENTLE].any()


@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8))
def test_the_return_is_the_discounted_sum(rewards):
    known = knowledge()
    gamma = known.scenario.planner.gamma
    expected = sum(gamma**step * reward for step, reward in enumerate(rewards))
    control = np.zeros(len(rewards), dtype=int)
    assert discounted_return(known.scenario, np.array(rewards), control) == pytest.approx(expected, abs=1e-12)


@given(st.floats(-0.2, 1.2), st.floats(0.0, 3.0))
def test_the_nearest_state_and_interpolation_agree_with_their_definition(first, second):
    states = StateSpace((Factor("a", (0.0, 0.2, 1.0)), Factor("b", (1.5,))))
    nearest = states.coordinates[int(states.nearest([first, second]))]
    assert abs(nearest[0] - first) <= np.abs(states.coordinates[:, 0] - first).min() + 1e-9
    linear = states.interpolate(3.0 * states.coordinates[:, :1], [first, second])
    assert linear[0] == pytest.approx(3.0 * np.clip(first, 0.0, 1.0))


@pytest.mark.parametrize(
    "planner", [{}, {"hold": 3}, {"policy": "risk", "risk": 0.1}, {"policy": "qmdp", "hold": 2}]
)
def test_flights_earn_what_the_model_of_the_twin_promises(planner):
    """Damage grows as the twin assumes; the wing is the calibrated one, up to the draws."""
    known = knowledge(**planner)
    flights = flown(known, 150)
    earned = earnings(known, flights.control_index, flights.filtered, flights.state)
    returns = discounted_return(known.scenario, earned.reward, flights.control_index)
    promised = promised_return(known)
    error = np.hypot(returns.std() / np.sqrt(len(returns)), promised.half_width / NORMAL_95)
    assert abs(returns.mean() - promised.mean) < 3.0 * error


def test_controls_of_equal_load_are_equally_hard():
    inspected = of_wing("inspected_wing")[0]
    hardness = dict(zip(inspected.scenario.control_names, inspected.hardness.tolist(), strict=True))
    assert hardness["2g"] == hardness["inspect"] == hardness["repair_1"] < hardness["3g"]


def test_the_safest_control_that_is_named_is_the_gentlest_one():
    assert np.argmin(knowledge(safest="3g").hardness) == SHARP


@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("mode", {"policy": "mode", "risk": None, "hold": 1}),
        ("qmdp, hold 2", {"policy": "qmdp", "hold": 2}),
        ("risk 0.05, hold 3", {"policy": "risk", "risk": 0.05, "hold": 3}),
    ],
)
def test_a_policy_is_chosen_by_the_name_that_it_is_given(name, keys):
    planner = knowledge().scenario.with_policy(name).planner
    assert planner.policy_name == name
    assert {key: getattr(planner, key) for key in keys} == keys


def test_a_name_without_a_policy_keeps_that_of_the_scenario():
    scenario = knowledge(policy="risk", risk=0.1).scenario
    assert scenario.with_policy("hold 4").planner.policy_name == "risk 0.1, hold 4"


def test_risk_is_flown_seldomer_beyond_the_limit_than_the_most_probable_control():
    shares = []
    for planner in ({}, {"policy": "risk", "risk": 0.05}):
        known = knowledge(**planner)
        flights = flown(known, 60)
        earned = earnings(known, flights.control_index, flights.filtered, flights.state)
        shares.append(float(earned.beyond_limit.mean()))
    assert shares[1] < shares[0]
