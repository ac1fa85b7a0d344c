"""A wing that is inspected and repaired: actions in a scenario, flown, planned on the belief.

Which sensors tell most, against exhaustive search and integrals.
"""

import itertools
import json
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import meshio
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import uav_twin
from fe.structure.location import on_surface
from fe.structure.mesh_file import read_mesh
from tests.command_line import refused, said
from tests.twin_master.runs import edited, estimates_of, of_wing, text_of, written
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import FleetError, MissionInputError
from twin_master.fleet.plan import load_fleet
from twin_master.learning.learning_filter import LearningFilter
from twin_master.mission import sensor_design
from twin_master.mission.loop import fly
from twin_master.mission.planning import (
    compare_simple_rules,
    encode_policy,
    plan_within_limit,
    share_beyond_limit,
    simulate_policy,
)
from twin_master.mission.preparation import Knowledge, load_knowledge
from twin_master.mission.sensor_design import DrawnReadings, choose_sensors, draw_readings, level_separations
from twin_master.mission.side_by_side import Flights, fly_side_by_side
from twin_master.network.estimator import Estimator
from twin_master.network.planner import BeliefPolicy, ration_controls
from twin_master.network.transition import TransitionModel
from twin_master.plan_command import _without_information
from twin_master.run_folder import read_scenario
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import Learning, Noticing
from twin_master.watch.feeds import file_feed
from uav_twin import ExactFilter, WatchfulEstimator, open_run, reduced_model, structure_files

TEXT = text_of("inspected_wing", ("notice = false", ""))
INSPECT, REPAIR_1 = 2, 3
FIVE_LEVELS = "levels_percent = [0, 20, 40, 60, 80]\nprior = [1, 0, 0, 0, 0]"


def scenario(*changes: tuple[str, str], **planner: Any) -> Scenario:
    table = tomllib.loads(edited(TEXT, *changes))
    table["planner"] |= planner
    return parse_scenario(table, "x")


FOUR_STATES = 2 * ((FIVE_LEVELS, "levels_percent = [0, 40]\nprior = [1, 0]"),)
"""A change of the scenario, whose plan takes a second then."""


@cache
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


def test_an_action_is_a_control_with_a_price_and_a_repair_follows_the_growth_of_its_step():
    written = scenario()
    assert written.control_names == ("2g", "3g", "inspect", "repair_1", "repair_2")
    assert written.control[INSPECT].values == {"load_factor": 2.0}
    assert written.rewards.control["inspect"] == pytest.approx(-0.1 - 0.2 / 16.0)
    assert [reading[2:] for reading in written.readings] == [("inspect_z1", 0.1), ("inspect_z2", 0.1)]
    own = scenario(('"3g" = 0.15 }', '"3g" = 0.15, inspect = 0.0 }'))
    assert own.transition.probability["inspect"] == 0.0
    row = knowledge().model.transition.row(REPAIR_1, 4 * 5 + 1).reshape(5, 5)
    assert row[0] == pytest.approx([0.0, 0.95, 0.05, 0.0, 0.0])
    assert not row[1:].any()


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


def test_a_policy_file_is_flown_by_a_twin_that_learns_and_gives_notice_and_its_run_keeps_readings(tmp_path):
    learning = ("steps = 120", "steps = 12"), ("[planner]", "[learning]\n[notice]\n[planner]")
    path, policy, folder = written(tmp_path, TEXT, *learning), tmp_path / "policy.npz", tmp_path / "run"
    given = BeliefPolicy(np.random.default_rng(0).random((1, 25)), np.array([INSPECT]))
    policy.write_bytes(encode_policy(given, knowledge().model))
    (tmp_path / "empty").touch()
    for wrong in (path, tmp_path / "empty"):
        told = refused("run", path, "--policy", wrong, "--out", folder)
        assert "is not a policy" in told
        assert "pickle" not in told
    said("run", path, "--policy", policy, "--out", folder, "--no-report")
    kept = load_knowledge(folder, read_scenario(folder)).plan.on_belief
    assert np.array_equal(kept.vectors, given.vectors)
    run = open_run(folder)
    observed, truth = run["observed"], run["truth"]
    inspected = observed["control_index"].values == INSPECT
    fed = file_feed(folder / "run.nc", read_scenario(folder)).messages(None)
    rows = np.array([message.observed for message, _ in fed])
    np.testing.assert_array_equal(rows[:, :24], observed["strain"])
    for place, name in enumerate(("z1", "z2"), start=24):
        read = observed[f"inspect_{name}"].values
        np.testing.assert_array_equal(rows[:, place], read)
        assert np.array_equal(np.isfinite(read), inspected)
        assert inspected.sum() == 11
        assert read[inspected] == pytest.approx(truth["state"].sel(region=name).values[inspected], abs=0.4)
    assert "learnt" in run
    assert "notice" in run
    assert "belief predicted" in run["filtered"]["decision_probability"].attrs["long_name"]


def test_an_action_that_ends_ends_the_mission():
    written = scenario(('repairs = ["z2"]', "ends = true"), ("cost = 3.0\nrepairs", "cost = 0.0\nrepairs"))
    known = of_wing(written)[0]
    stop = following(known, BeliefPolicy(np.ones((1, 25)), np.array([4])))
    flown = fly(written, stop.twin(), stop.plant(stop.truth(1), asset_of(stop)))
    assert flown.control_index.tolist() == [1, 4]
    assert "decided on `repair_2`" in flown.notices[-1][1].sentence
    assert side_by_side(stop, 2).ended[1] == flown.notices[-1][1].sentence
    value = known.plan.action_value[:, 4]
    assert value == pytest.approx(known.planning_reward[:, 4])  # and nothing behind it


@cache
def planned() -> tuple[Any, Any]:
    known = knowledge(*FOUR_STATES)
    problem = known.problem
    return problem, plan_within_limit(known.scenario, problem, known.rewards)[0]


def flown_and(known: Knowledge, mean: float, half_width: float) -> tuple[float, float]:
    """Return what 300 flown missions bring, and half its 99 % interval: what was said lies inside."""
    flown = side_by_side(known, 300)
    place = np.rint(flown.state / 0.4).astype(int) @ (2, 1)
    reward = known.planning_reward[place, flown.control_index]
    total = reward @ known.scenario.planner.gamma ** np.arange(reward.shape[1])
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


def test_a_limit_is_kept_by_the_plan():
    known, (problem, plan) = knowledge(*FOUR_STATES), planned()
    free = share_beyond_limit(known.scenario, problem, known.rewards, plan.policy)
    limited = scenario(*FOUR_STATES, policy="belief", limit_probability=round(0.6 * free, 4))
    careful, price = plan_within_limit(limited, problem, known.rewards)
    assert price > 0.0
    assert share_beyond_limit(limited, problem, known.rewards, careful.policy) <= 0.6 * free
    assert (
        simulate_policy(limited, problem, careful.policy).mean
        < simulate_policy(limited, problem, plan.policy).mean
    )


def test_the_command_plans_draws_and_says_what_inspections_gauges_and_simpler_rules_are_worth(
    tmp_path, monkeypatch
):
    monkeypatch.setattr("twin_master.mission.planning.INSPECTION_PERIODS", (5,))
    policy, picture = tmp_path / "policy.npz", tmp_path / "plan.svg"
    worse = 2 * (("[0, 40]", "[0, 80]"),)
    path = written(tmp_path, TEXT, *FOUR_STATES, *worse)
    words = ("plan", path, "--value-of", "inspect", "--out", policy, "--picture", picture, "--json")
    record = json.loads(said(*words))
    assert record["lower"] < record["upper"]
    assert record["value"]["mean"] > record["value"]["half_width"] > 0.0
    assert policy.stat().st_size > 1000
    assert picture.read_bytes().startswith(b"<?xml")
    rules = json.loads(said("plan", path, "--json"))["rules"]
    assert rules["QMDP"][0] < rules["inspection every 5 steps"][0] < rules["planned on the belief"][0]
    worth = json.loads(said("design", path, "--sensors", 1, "--among", "17,24", "--worth", "--json"))["worth"]
    assert worth["all beyond chosen"][0] == pytest.approx(worth["all"][0] - worth["chosen"][0])
    assert worth["all beyond chosen"][1] < 0.2 * worth["all"][1]  # mission by mission


def test_inspections_of_a_fleet_go_where_they_are_worth_most():
    known, (_, plan) = knowledge(*FOUR_STATES), planned()
    ahead = np.random.default_rng(0).dirichlet(np.full(4, 0.3), 60)
    model = replace(known.model, transition=TransitionModel((np.tile(np.eye(4), (5, 1, 1)),)))
    chosen = plan.policy.decide(ahead)
    wanting = np.flatnonzero(chosen == INSPECT)
    few = ration_controls(model.transition, ahead, np.zeros(60, dtype=int), chosen, plan.policy, [INSPECT], 3)
    value = plan.policy.action_value(ahead, 5)
    other = np.delete(value, INSPECT, axis=1).max(axis=1)
    gain = value[:, INSPECT] - other
    kept = np.flatnonzero(few == INSPECT)
    assert len(wanting) > len(kept) == 3
    assert gain[kept].min() >= np.delete(gain, kept)[np.isin(np.delete(np.arange(60), kept), wanting)].max()
    late = np.setdiff1d(wanting, kept)
    assert value[late, few[late]] == pytest.approx(other[late])
    assert np.array_equal(np.delete(few, wanting), np.delete(chosen, wanting))


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


# ---------------------------------------------------------------- sensors


@cache
def gauged() -> Knowledge:
    return of_wing("level_turns")[0]


def test_the_information_of_sensors_is_that_of_an_integral_also_where_something_moves_them_together():
    """Two sensors that step one reading, and another of no meaning, by 30 degrees tell what the one does."""
    means, moved = np.array([0.0, 1.0, 3.0]), np.array([0.3, 1.0, 0.6])
    spread, state = np.sqrt(1.0 + moved**2), np.arange(60_000) % 3
    shown = means[state] + spread[state] * norm.ppf((np.arange(60_000) // 3 + 0.5) / 20_000)
    residual = np.stack((shown[:, None] - means, np.ones((60_000, 3))), axis=-1)
    turned = np.array([[0.75**0.5, 0.0, 0.5], [-0.5, 0.0, 0.75**0.5]])  # and one shows nothing
    shares = moved[:, None] * turned[0]
    readings = DrawnReadings(state, residual @ turned, shares[..., None], np.zeros((3, 3)))

    def entropy(value: float) -> float:
        density = norm.pdf(value - means, scale=spread).mean()
        return -float(density * np.log2(density))

    noise = np.log2(spread).mean() + 0.5 * np.log2(2.0 * np.pi * np.e)
    exact = quad(entropy, -9.0, 12.0, limit=200)[0] - noise
    assert readings.information([0, 2]) == pytest.approx(exact, abs=3e-5)


@pytest.mark.parametrize("samples", [7, 30])
def test_readings_are_drawn_in_states_that_are_all_alike_probable(samples, monkeypatch):
    monkeypatch.setattr(sensor_design, "SAMPLES", samples)
    for readings in draw_readings(gauged()):
        times = np.bincount(readings.state, minlength=25)
        assert times.max() == 1
        assert times.sum() == min(samples, 25)
        assert len({*(readings.state // 5)}) > 2  # not only where the first region is sound


def test_three_of_twelve_are_those_of_an_exhaustive_search():
    """One beside a region separates its levels, and those of the other region are hardly told."""
    readings, able = draw_readings(gauged()), range(0, 24, 2)
    found = choose_sensors(readings, able, 3)
    told = {
        some: float(np.mean([under.information(some) for under in readings]))
        for some in itertools.combinations(able, 3)
    }
    best = max(told, key=lambda some: told[some])
    assert tuple(sorted(found.sensors)) == best
    assert found.information[-1] == pytest.approx(told[best], rel=1e-12)
    assert found.of_all > found.information[-1] > found.information[0] > 0.0
    with pytest.raises(MissionInputError, match="from 1 to 2"):
        choose_sensors(readings, [0, 1], 3)
    apart, fewer = (level_separations(gauged(), readings, gauges) for gauges in (range(24), [16, 23]))
    assert min(far for (name, _), far in apart.items() if name == "z1") > 2.0
    assert max(far for (name, _), far in apart.items() if name == "z2") < 1.0
    assert all(fewer[place] <= far + 1e-9 for place, far in apart.items())


def test_a_gauge_that_is_taken_away_tells_nothing_whatever_its_unit():
    known, size = gauged(), 1e12
    observation = known.scenario.observation.model_copy(update={"standard_deviation": size * 125e-6})
    large = known.scenario.model_copy(update={"observation": observation})
    values = size * known.sensor_model.value_per_draw
    model = _without_information(Knowledge(large, known.model, known.draws, values), ["24"]).sensor_model
    seen = np.where(np.arange(24) == 23, values[0, 0, 1], np.nan)
    assert np.ptp(model.log_likelihood(seen, 1)) < 1e-6


def test_the_command_chooses_draws_and_names_what_is_not_separated(tmp_path):
    picture, points = tmp_path / "design.png", tmp_path / "gauges.vtu"
    words = ("design", "level_turns", "--sensors", 2, "--among")
    record = json.loads(said(*words, "1,17,24", "--picture", picture, "--vtu", points, "--json"))
    assert record["sensors"] == ["17", "24"]
    assert "z2 of 0 % from 20 %" in record["not_separated"]
    assert picture.read_bytes().startswith(b"\x89PNG")
    rank = meshio.read(points).point_data["rank"]
    assert rank[[16, 23]].tolist() == [1.0, 2.0]
    assert rank.sum() == 3.0


def designed(*words: object) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(said("design", "stiffened_panel", *words, "--json"))
    return record


def test_gauges_may_be_anywhere_on_the_surface_of_a_structure(tmp_path):
    points, picture = tmp_path / "gauges.vtu", tmp_path / "design.svg"
    declared = designed("--sensors", 2)
    found = designed("--sensors", 2, "--candidates", 10, "--vtu", points, "--picture", picture)
    assert found["of_all"] > declared["of_all"]
    assert found["information"][-1] > declared["information"][-1]
    cloud = meshio.read(points)
    assert len(cloud.points) == 6 + 3 * 10
    mesh = read_mesh(structure_files()["stiffened_panel"].with_suffix(".msh"), 1e-3, "mm")
    places = cloud.points[6::3]
    assert max(on_surface(mesh, place, "it").distance for place in places) < 1e-9
    apart = np.linalg.norm(places[:, None] - places, axis=2) + np.eye(10)
    assert apart.min() > 0.02  # of a panel of 0.3 m by 0.2 m
    assert picture.read_bytes().startswith(b"<?xml")


def test_a_listed_candidate_tells_what_the_same_gauge_of_the_file_does(tmp_path):
    listed = tmp_path / "more.toml"
    listed.write_text(
        '[[gauge]]\nname = "twin_of_end"\npoint = [40, 50, -20]\ndirection = [1, 0, 0]\nlength = 5\n'
        '[[rosette]]\nname = "r"\npoint = [150, 100, 2]\naxes = [[1, 0, 0], [0, 1, 0]]\nangles = [0, 90]\n'
    )
    words = ("--sensors", 1, "--candidates", listed, "--among")
    same, own, other = (designed(*words, name)["of_all"] for name in ("twin_of_end", "end 1", "stiffener 1"))
    assert same == pytest.approx(own, rel=0.05)  # the noise is drawn anew
    assert abs(other - own) > 0.1 * own
    assert designed(*words, "r_b,skin across")["sensors"][0] in ("r_b", "skin across")
    listed.write_text("gauge = 3\n")
    assert "more.toml" in refused("design", "stiffened_panel", *words, "end 1")
