"""A wing that is inspected and repaired: actions in a scenario, flown, planned on the belief."""

import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import uav_twin
from tests.command_line import refused, said
from tests.costs import once
from tests.twin_master.runs import edited, estimates_of, of_wing, text_of, written
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import FleetError
from twin_master.feeds.feed_choice import file_feed
from twin_master.fleet.plan import load_fleet
from twin_master.learning.learning_filter import LearningFilter
from twin_master.mission.earnings import discounted_return, earnings, promised_return
from twin_master.mission.flights import Flights, fly, fly_side_by_side
from twin_master.mission.knowledge_file import load_knowledge
from twin_master.mission.planning import (
    compare_simple_rules,
    encode_policy,
    fraction_beyond_limit,
    plan_within_limit,
    simulate_policy,
)
from twin_master.mission.preparation import Knowledge
from twin_master.network.estimator import Estimator
from twin_master.network.planner import BeliefPolicy, ration_controls
from twin_master.network.transition import TransitionModel
from twin_master.run_folder import read_scenario
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import Learning, Noticing
from uav_twin import ExactFilter, WatchfulEstimator, open_run, reduced_model

TEXT = text_of("inspected_wing", ("notice = false", ""))
INSPECT, REPAIR_1 = 2, 3
FIVE_LEVELS = "levels_percent = [0, 20, 40, 60, 80]\nprior = [1, 0, 0, 0, 0]"


def scenario(*changes: tuple[str, str], **planner: Any) -> Scenario:
    table = tomllib.loads(edited(TEXT, *changes))
    table["planner"] |= planner
    return parse_scenario(table, "x")


FOUR_STATES = 2 * ((FIVE_LEVELS, "levels_percent = [0, 40]\nprior = [1, 0]"),)
"""A change of the scenario, whose plan takes a second then."""


@once
def knowledge(*changes: tuple[str, str]) -> Knowledge:
    return of_wing(scenario(*changes, policy="mode"))[0]


def following(known: Knowledge, policy: BeliefPolicy, written: Scenario | None = None) -> Knowledge:
    """Return the same knowledge with a policy on the belief."""
    per_draw = known.sensor_model.value_per_draw
    return Knowledge(written or known.scenario, known.model, known.draws, per_draw, policy)


def side_by_side(known: Knowledge, seeds: int) -> Flights:
    return fly_side_by_side(known, [known.truth(seed) for seed in range(seeds)], [asset_of(known)] * seeds)


def asset_of(known: Knowledge) -> Any:
    return ReducedModelSource(known.scenario, reduced_model()).open()


def test_an_action_is_a_control():
    inspected = scenario()
    assert inspected.control_names == ("2g", "3g", "inspect", "repair_1", "repair_2")
    assert inspected.control[INSPECT].values == {"load_factor": 2.0}
    readings = [(reading.name, reading.standard_deviation) for reading in inspected.inspection_readings]
    assert readings == [("inspect_z1", 0.1), ("inspect_z2", 0.1)]


def test_the_price_of_an_action_is_taken_from_the_reward_of_its_control():
    assert scenario().rewards.control["inspect"] == pytest.approx(-0.1 - 0.2 / 16.0)


def test_an_action_may_have_a_probability_of_growth_of_its_own():
    inspected = scenario(('"3g" = 0.15 }', '"3g" = 0.15, inspect = 0.0 }'))
    assert inspected.transition.probability["inspect"] == 0.0


def test_a_repair_follows_the_growth_of_its_step():
    state_of_levels_4_and_1 = 4 * 5 + 1
    row = knowledge().model.transition.row(REPAIR_1, state_of_levels_4_and_1)
    probability = row.reshape(5, 5)
    assert probability[0] == pytest.approx([0.0, 0.95, 0.05, 0.0, 0.0])
    assert not probability[1:].any()


def test_a_reading_is_weighed_beside_the_gauges_and_only_in_its_step():
    known = knowledge()
    row = np.full(26, np.nan)
    row[24] = 0.37
    seen = known.sensor_model.log_likelihood(row, INSPECT)
    levels = known.model.states.coordinates[:, 0]
    assert seen == pytest.approx(norm.logpdf(0.37, levels, 0.1))
    assert not known.sensor_model.log_likelihood(row[:24], INSPECT).any()
    drawn = known.sensor_model.draw_observations(np.zeros(9, dtype=int), 0, np.random.default_rng(0))  # type: ignore[attr-defined]
    assert np.isnan(drawn[:, 24:]).all()


@pytest.mark.parametrize("gauges", [True, False])
def test_what_learns_or_gives_notice_takes_a_reading_as_the_exact_filter_does(gauges):
    known = knowledge()
    model, sensors = known.model, known.sensor_model
    exact = ExactFilter(model, sensors, "x")
    others: list[Estimator] = [LearningFilter(model, sensors, Learning(noise=False))]
    if not gauges:  # then no hypothesis about them is told from another, however probable it is
        wary = Noticing(prior=0.3)
        others.append(WatchfulEstimator(exact, sensors, known.draws.values, wary))
    rng, states = np.random.default_rng(1), np.array([0, 1, 6, 7, 12, 13])
    controls = [1, INSPECT, 0, INSPECT, INSPECT, 1]
    rows = [
        sensors.draw_observations(states[[step]], control, rng)[0] for step, control in enumerate(controls)
    ]
    seen = np.where(gauges | (np.arange(26) >= 24), rows, np.nan)
    expected = estimates_of(exact, seen, controls)
    for estimator in others:
        for found, right in zip(estimates_of(estimator, seen, controls), expected, strict=True):
            assert found.filtered == pytest.approx(right.filtered, abs=1e-5)
            assert found.forecast == pytest.approx(right.forecast, abs=1e-5)
    assert expected[-1].filtered.max() > 0.3  # something was told


@pytest.fixture(scope="module")
def learning_scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inspected wing for twelve steps, with a twin that learns and gives notice."""
    shorter = ("steps = 120", "steps = 12")
    learning = ("[planner]", "[learning]\n[notice]\n[planner]")
    return written(tmp_path_factory.mktemp("learning"), TEXT, shorter, learning)


@pytest.fixture(scope="module")
def inspecting_policy() -> BeliefPolicy:
    """A policy that inspects whatever the belief is."""
    return BeliefPolicy(np.random.default_rng(0).random((1, 25)), np.array([INSPECT]))


@pytest.fixture(scope="module")
def inspecting_run(
    learning_scenario: Path, inspecting_policy: BeliefPolicy, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Folder of the mission that the policy flies in that scenario."""
    folder = tmp_path_factory.mktemp("inspecting")
    policy = folder / "policy.npz"
    policy.write_bytes(encode_policy(inspecting_policy, knowledge().model))
    run = folder / "run"
    said("run", learning_scenario, "--policy", policy, "--out", run, "--no-report")
    return run


@pytest.fixture(scope="module")
def inspecting_store(inspecting_run: Path) -> Any:
    """The store of that mission."""
    return open_run(inspecting_run)


@pytest.fixture(scope="module")
def observations_read_again(inspecting_run: Path) -> np.ndarray:
    """What a watch that is fed with the store of that mission would see, (steps, sensors)."""
    feed = file_feed(inspecting_run / "run.nc", read_scenario(inspecting_run))
    return np.array([message.observed for message, _ in feed.messages(None)])


@pytest.mark.parametrize("content", ["a scenario", "nothing"])
def test_a_file_that_is_no_policy_is_refused(learning_scenario, tmp_path, content):
    empty = tmp_path / "empty"
    empty.touch()
    policy = learning_scenario if content == "a scenario" else empty
    sentence = refused("run", learning_scenario, "--policy", policy, "--out", tmp_path / "run")
    assert "is not a policy" in sentence
    assert "pickle" not in sentence


def test_a_policy_that_is_neither_file_nor_name_is_refused_with_the_names(learning_scenario, tmp_path):
    sentence = refused("run", learning_scenario, "--policy", "fast", "--out", tmp_path / "run")
    assert "there is no file fast with a policy" in sentence
    assert "'risk 0.05'" in sentence


def test_a_run_keeps_the_policy_of_the_file(inspecting_run, inspecting_policy):
    kept = load_knowledge(inspecting_run, read_scenario(inspecting_run)).plan.on_belief
    assert np.array_equal(kept.vectors, inspecting_policy.vectors)


def test_a_stored_run_gives_back_its_strains(inspecting_store, observations_read_again):
    strain = inspecting_store["observed"]["strain"]
    np.testing.assert_array_equal(observations_read_again[:, :24], strain)


@pytest.mark.parametrize(("region", "sensor"), [("z1", 24), ("z2", 25)])
def test_a_run_keeps_the_readings_of_its_inspections(
    inspecting_store, observations_read_again, region, sensor
):
    observed = inspecting_store["observed"]
    inspected = observed["control_index"].values == INSPECT
    reading = observed[f"inspect_{region}"].values
    level = inspecting_store["truth"]["state"].sel(region=region).values
    np.testing.assert_array_equal(observations_read_again[:, sensor], reading)
    assert np.array_equal(np.isfinite(reading), inspected)
    assert inspected.sum() == 11
    assert reading[inspected] == pytest.approx(level[inspected], abs=0.4)


def test_a_twin_with_a_policy_learns_and_gives_notice(inspecting_store):
    assert "learnt" in inspecting_store
    assert "notice" in inspecting_store
    decision = inspecting_store["filtered"]["decision_probability"]
    assert "belief predicted" in decision.attrs["long_name"]


ENDING_REPAIR = (
    ('repairs = ["z2"]', "ends = true"),
    ("cost = 3.0\nrepairs", "cost = 0.0\nrepairs"),
)
REPAIR_2 = 4


@once
def stopping() -> Knowledge:
    """Return the knowledge with a policy whose only action is the second repair, which ends the mission."""
    always_repair = BeliefPolicy(np.ones((1, 25)), np.array([REPAIR_2]))
    return following(knowledge_of_scenario(*ENDING_REPAIR), always_repair)


@once
def knowledge_of_scenario(*changes: tuple[str, str]) -> Knowledge:
    return of_wing(scenario(*changes))[0]


def test_an_action_that_ends_ends_the_mission():
    stop = stopping()
    flown = fly(stop.scenario, stop.twin(), stop.plant(stop.truth(1), asset_of(stop)))
    assert flown.control_index.tolist() == [1, REPAIR_2]
    sentence = flown.notices[-1][1].sentence
    assert "decided on `repair_2`" in sentence
    assert side_by_side(stop, 2).ended[1] == sentence


def test_an_action_that_ends_has_no_value_behind_it():
    known = knowledge_of_scenario(*ENDING_REPAIR)
    value = known.plan.action_value[:, REPAIR_2]
    assert value == pytest.approx(known.planning_reward[:, REPAIR_2])


@once
def planned() -> tuple[Any, Any]:
    known = knowledge(*FOUR_STATES)
    problem = known.problem
    return problem, plan_within_limit(known.scenario, problem, known.rewards)


def flown_and(known: Knowledge, mean: float, half_width: float) -> tuple[float, float]:
    """Return what 300 flown missions bring, and half its 99 % interval: what was said lies inside."""
    flown = side_by_side(known, 300)
    earned = earnings(known, flown.control_index, flown.filtered, flown.state)
    total = discounted_return(known.scenario, earned.reward, flown.control_index)
    half = 2.58 * total.std() / np.sqrt(len(total))
    assert abs(total.mean() - mean) <= np.hypot(half, 2.58 / 1.96 * half_width)
    return total.mean(), half


def test_flown_missions_bring_the_return_that_was_promised():
    known, (problem, plan) = knowledge(*FOUR_STATES), planned()
    said = simulate_policy(known.scenario, problem, plan.policy)
    mean, half = flown_and(following(known, plan.policy), said.mean, said.half_width)
    assert plan.lower - half <= mean <= plan.upper + half


@pytest.mark.parametrize("decide_on", ["filtered", "predicted"])
def test_simpler_rules_bring_what_is_said_of_them(decide_on, monkeypatch):
    monkeypatch.setattr("twin_master.mission.planning.INSPECTION_PERIODS", ())
    for policy in ("mode", "qmdp"):
        known = of_wing(scenario(*FOUR_STATES, policy=policy, decide_on=decide_on))[0]
        rule = compare_simple_rules(known.scenario, planned()[0])[policy == "qmdp"]
        flown_and(known, rule.mean, rule.half_width)


def test_the_promise_of_a_plan_is_that_of_its_twin():
    known, (problem, plan) = knowledge(*FOUR_STATES), planned()
    said = simulate_policy(known.scenario, problem, plan.policy)
    promised = promised_return(following(known, plan.policy))
    assert np.array_equal(promised.returns, said.returns)


def test_a_limit_is_kept_by_the_plan():
    known, (problem, plan) = knowledge(*FOUR_STATES), planned()
    free = fraction_beyond_limit(known.scenario, problem, known.rewards, plan.policy)
    limited = scenario(*FOUR_STATES, policy="belief", limit_probability=round(0.6 * free, 4))
    careful = plan_within_limit(limited, problem, known.rewards)
    assert fraction_beyond_limit(limited, problem, known.rewards, careful.policy) <= 0.6 * free
    assert (
        simulate_policy(limited, problem, careful.policy).mean
        < simulate_policy(limited, problem, plan.policy).mean
    )


@pytest.fixture(scope="module")
def severe_scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inspected wing with four states, of which three are severe."""
    severe = ("[0, 40]", "[0, 80]")
    return written(tmp_path_factory.mktemp("severe"), TEXT, *FOUR_STATES, severe, severe)


def plan_of_command(*words: object) -> dict[str, Any]:
    """Return what the command plans, compared with one rule of inspections only: every 5 steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin_master.mission.planning.INSPECTION_PERIODS", (5,))
        record: dict[str, Any] = json.loads(said("plan", *words, "--json"))
    return record


@pytest.fixture(scope="module")
def severe_plan(severe_scenario: Path) -> dict[str, Any]:
    """What the command says of the plan for it; policy and picture are written beside the scenario."""
    policy = severe_scenario.with_name("policy.npz")
    picture = severe_scenario.with_name("plan.svg")
    options = ("--value-of", "inspect", "--out", policy, "--picture", picture)
    return plan_of_command(severe_scenario, *options)


def test_the_command_bounds_what_a_plan_brings_and_says_what_inspections_are_worth(severe_plan):
    value = severe_plan["value"]
    assert severe_plan["lower"] < severe_plan["upper"]
    assert value["mean"] > value["half_width"] > 0.0


def test_the_command_writes_the_policy_of_a_plan_and_draws_it(severe_scenario, severe_plan):
    assert severe_scenario.with_name("policy.npz").stat().st_size > 1000
    assert severe_scenario.with_name("plan.svg").read_bytes().startswith(b"<?xml")


def test_the_command_says_what_simpler_rules_are_worth(severe_scenario):
    rules = plan_of_command(severe_scenario)["rules"]
    mean = {name: row[0] for name, row in rules.items()}
    assert mean["QMDP"] < mean["inspection every 5 steps"] < mean["planned on the belief"]


def test_the_command_says_what_gauges_are_worth(severe_scenario):
    """Differences are taken mission by mission, so that they scatter less than each of the values."""
    options = ("--sensors", 1, "--among", "17,24", "--worth", "--json")
    worth = json.loads(said("design", severe_scenario, *options))["worth"]
    mean = {name: row[0] for name, row in worth.items()}
    half_width = {name: row[1] for name, row in worth.items()}
    assert mean["all beyond chosen"] == pytest.approx(mean["all"] - mean["chosen"])
    assert half_width["all beyond chosen"] < 0.2 * half_width["all"]


class RationedFleet:
    """Sixty twins, of which three may inspect: what each of them wants, may do, and would gain."""

    def __init__(self) -> None:
        known = knowledge(*FOUR_STATES)
        policy = planned()[1].policy
        belief = np.random.default_rng(0).dirichlet(np.full(4, 0.3), 60)
        steady = TransitionModel((np.tile(np.eye(4), (5, 1, 1)),))
        transition = replace(known.model, transition=steady).transition
        no_control_yet = np.zeros(60, dtype=int)
        self.wanted = policy.decide(belief)
        self.rationed = ration_controls(transition, belief, no_control_yet, self.wanted, policy, [INSPECT], 3)
        self.value = policy.action_value(belief, 5)
        self.best_without = np.delete(self.value, INSPECT, axis=1).max(axis=1)
        self.gain = self.value[:, INSPECT] - self.best_without
        self.wanting = np.flatnonzero(self.wanted == INSPECT)
        self.inspecting = np.flatnonzero(self.rationed == INSPECT)
        self.declined = np.setdiff1d(self.wanting, self.inspecting)


@once
def rationed_fleet() -> RationedFleet:
    return RationedFleet()


def test_inspections_of_a_fleet_go_where_they_are_worth_most():
    fleet = rationed_fleet()
    assert len(fleet.wanting) > len(fleet.inspecting) == 3
    assert fleet.gain[fleet.inspecting].min() >= fleet.gain[fleet.declined].max()


def test_a_twin_without_its_inspection_takes_the_next_best_control():
    fleet = rationed_fleet()
    declined = fleet.declined
    value = fleet.value[declined, fleet.rationed[declined]]
    assert value == pytest.approx(fleet.best_without[declined])


def test_a_twin_that_wants_no_inspection_does_what_it_wants():
    fleet = rationed_fleet()
    others = np.delete(np.arange(60), fleet.wanting)
    assert np.array_equal(fleet.rationed[others], fleet.wanted[others])


def test_a_budget_of_inspections_is_kept_in_every_step():
    known, (_, plan) = knowledge(*FOUR_STATES), planned()
    settings = known.scenario.planner.model_copy(update={"inspections_per_step": 3})
    written = known.scenario.model_copy(update={"planner": settings})
    flown = side_by_side(following(known, plan.policy, written), 40)
    inspections = (flown.control_index == INSPECT).sum(axis=0)
    assert inspections.max() == 3


def test_a_fleet_shares_its_inspections_in_one_shard(tmp_path):
    text = 'format = 1\nfleet = { name = "inspected", shard = 20 }\n[[group]]\nname = "all"\n'
    text += 'scenario = "inspected_wing"\ncount = 30\ninspections_per_step = 2\n'
    with pytest.raises(FleetError, match="`shard` be 30 or more"):
        load_fleet(written(tmp_path, text))
    fleet = load_fleet(written(tmp_path, text, ("shard = 20", "shard = 30")))
    assert fleet.groups[0].scenarios[0].planner.inspections_per_step == 2


def test_a_watch_proposes_inspections_and_takes_their_readings(tmp_path):
    text = text_of("inspected_wing", *FOUR_STATES)
    flown = text[text.index("# What flies.") : text.index("# What the twin believes")]
    path = written(tmp_path, text[: text.index("[truth]")], (flown, ""))
    known = of_wing(scenario(*FOUR_STATES))[0]
    flown = fly(known.scenario, known.twin(), known.plant(known.truth(2), asset_of(known)))
    names = known.scenario.control_names

    def messages() -> Iterator[dict[str, Any]]:
        for step, flight in enumerate(flown.steps[:15]):
            row = flight.reading.observed
            read = dict(zip(("inspect_z1_percent", "inspect_z2_percent"), 100.0 * row[24:], strict=True))
            read = {name: value for name, value in read.items() if np.isfinite(value)}
            control = names[flown.control_index[step]]
            yield {"step": step, "control": control, "strain": row[:24].tolist()} | read

    told: list[Mapping[str, Any]] = []
    uav_twin.watch(path, messages(), tmp_path / "watch", decide=told.append, report=False)
    for step, decision in enumerate(told):
        assert decision["next_control"] == names[flown.control_index[step + 1]]
        mean = known.model.states.mean(flown.filtered[step])
        assert decision["health"]["z2"]["mean"] == pytest.approx(mean[1], abs=1e-5)
    inspected = flown.control_index.tolist().index(INSPECT)
    spread = [decision["health"]["z2"]["standard_deviation"] for decision in told]
    assert spread[inspected] < 0.7 * spread[inspected - 1]
