"""The schema of scenario files: what is read, and the sentence for whatever is wrong."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenarios import scenario_files
from twin_master.errors import ScenarioError, TwinMasterError, UnknownScenarioError
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.scenario.schema import Scenario

TEXT = scenario_files()["level_turns"].read_text(encoding="utf-8")


def test_units_of_keys_are_honoured_and_everything_inside_is_si() -> None:
    scenario = load_scenario("level_turns").scenario
    assert scenario.state[0].levels == (0.0, 0.2, 0.4, 0.6, 0.8)
    assert scenario.observation.standard_deviation == 125e-6
    assert scenario.truth.noise.standard_deviation == 150e-6
    assert scenario.rewards.health_limit == 2500e-6
    assert scenario.truth.gains[0].gain == 0.02
    assert load_scenario("failing_gauges").scenario.truth.sensor_faults[-1].rate == 6e-6


def test_the_rule_of_decisions_is_a_key_of_the_scenario() -> None:
    table = tomllib.loads(TEXT)
    assert parse_scenario(table, "x").planner.decide_on == "filtered"
    table["planner"]["decide_on"] = "predicted"
    assert parse_scenario(table, "x").planner.decide_on == "predicted"


@pytest.mark.parametrize("name", sorted(scenario_files()))
def test_resolved_scenario_reads_back(name: str) -> None:
    scenario = load_scenario(name).scenario
    assert scenario.mission.name == name
    assert parse_scenario(scenario.to_dict(), "config.json") == scenario


PRIOR = "prior = [1, 0, 0, 0, 0]"
LEVELS = "[0, 20, 40, 60, 80]"
BROKEN = {
    "unknown key": ("steps = 50", "stepps = 50", ["mission.stepps", "unknown key", "steps"]),
    "unknown key in an array": ('title = "gentle turn"', 'tittle = "x"', ["control[1].tittle", "values"]),
    "wrong unit": ("standard_deviation_microstrain = 150", "standard_deviation_millistrain = 0.15",
                   ["truth.noise.standard_deviation_millistrain", "standard_deviation[_microstrain]"]),
    "missing key": ("steps = 50\n", "", ["mission.steps", "missing"]),
    "text for a number": ("gamma = 0.6", 'gamma = "0.6"', ["planner.gamma", "number", "'0.6'"]),
    "gamma too large": ("gamma = 0.6", "gamma = 1.0", ["planner.gamma", "less than 1", "1.0"]),
    "probability above one": ('"2g" = 0.05', '"2g" = 5', ["transition.probability.2g", "equal to 1", "5"]),
    "probability missing": ('"2g" = 0.05, ', "", ["transition.probability", "2g, 3g"]),
    "prior of the wrong shape": (PRIOR, "prior = [1, 0, 0, 0]", ["prior", "z1", "5", "4"]),
    "prior that does not sum to one": (PRIOR, "prior = [1, 1, 0, 0, 0]", ["z1", "sums to 2"]),
    "levels that do not increase": (LEVELS, "[0, 40, 20, 60, 80]", ["levels", "z1", "increase"]),
    "levels above 100 %": (LEVELS, "[0, 20, 40, 60, 180]", ["levels_percent", "180"]),
    "missing key with a unit": ("standard_deviation_microstrain = 150\n", "",
                                ["truth.noise.standard_deviation[_microstrain]", "missing"]),
    "first control unknown": ('first_control = "3g"', 'first_control = "4g"', ["2g, 3g", "4g"]),
    "controls with other inputs": ("{ load_factor = 2.0 }", "{ load = 2.0 }", ["2g", "3g", "same inputs"]),
    "normalised by nothing": ('normalise_error_by = "load_factor"', 'normalise_error_by = "lift"', ["lift"]),
    "zero steps": ("steps = 50", "steps = 0", ["mission.steps", "0"]),
    "gain of an unknown state": ('"z1", first_step = 10', '"z9", first_step = 10', ["z9", "z1, z2"]),
    "last step before first": ("last_step = 19", "last_step = 9", ["last_step", "9", "10"]),
    "unknown kind": ('kind = "scripted"', 'kind = "written"', ["truth.kind", "scripted", "written"]),
    "gains with random growth": ('kind = "scripted"', 'kind = "random_growth"', ["truth.gains", "scripted"]),
    "NaN": ("gamma = 0.6", "gamma = nan", ["planner.gamma"]),
    "no calibration mean": ('source = "static_test"', 'source = "normal"', ["calibration", "mean"]),
    "divided by a negative input": ("load_factor = 2.0", "load_factor = -2.0", ["load_factor", "positive"]),
    "unknown decision rule": ("gamma = 0.6", 'gamma = 0.6\ndecide_on = "smoothed"',
                              ["planner.decide_on", "'filtered' or 'predicted'", "smoothed"]),
    "reference of no figure": ('figure = "fallback_delay"', 'figure = "fallback_dely"',
                               ["reference.figure", "fallback_dely", "fallback_delay"]),
    "reference of a figure that cannot be": ('figure = "fallback_delay"', 'figure = "lost_observations"',
                                             ["reference.figure", "lost_observations"]),
    "two references of a figure": ('figure = "fallback_delay"', 'figure = "policy_switch_damage"',
                                   ["policy_switch_damage", "more than once"]),
    "reference without a source": ('source = "Kapteyn et al. 2021"\n', "",
                                   ["reference[1].source", "missing"]),
    "more steps than an array holds": ("steps = 50", "steps = 100000000000", ["mission.steps", "1000000"]),
    "as many ahead": ("prediction_steps = 10", "prediction_steps = 99999999", ["mission.prediction_steps"]),
    "as many draws": ("draws = 100", "draws = 99999999999", ["calibration.draws", "1000000", "arrays"]),
    "as many sensors": ("count = 24", "count = 99999999999", ["observation.count", "1000000"]),
    "an infinite deviation": ("draws = 100", "draws = 100\nstandard_deviation = inf",
                              ["calibration.standard_deviation", "finite", "inf"]),
    "a truth where a number is meant": ("gamma = 0.6", "gamma = true", ["planner.gamma", "number", "True"]),
    "an FMU without a binding": ('binding = "uav_wing"\n', "", ["asset", "binding"]),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(BROKEN))
def test_whatever_is_wrong_is_named_in_one_sentence(case: str, tmp_path: Path) -> None:
    old, new, words = BROKEN[case]
    assert old in TEXT
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ScenarioError) as caught:
        load_scenario(path)
    sentence = str(caught.value)
    assert str(path) in sentence
    assert "\n" not in sentence
    for word in words:
        assert word in sentence, sentence


def test_sensor_faults_name_sensors_that_exist(tmp_path: Path) -> None:
    text = scenario_files()["failing_gauges"].read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("sensors = [12]", "sensors = [25]"), encoding="utf-8")
    with pytest.raises(ScenarioError, match="from 1 to 24, and 25 came"):
        load_scenario(path)


def test_a_key_with_and_without_unit_is_refused() -> None:
    table = tomllib.loads(TEXT)
    table["observation"]["standard_deviation"] = 1e-4
    with pytest.raises(ScenarioError, match="both given"):
        parse_scenario(table, "mine.toml")


def test_not_toml_and_not_there(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text("format = = 1", encoding="utf-8")
    with pytest.raises(ScenarioError, match="is not valid TOML"):
        load_scenario(path)
    with pytest.raises(UnknownScenarioError, match="level_turns"):
        load_scenario("level_turn")


@pytest.mark.parametrize(
    ("section", "key", "value", "words"),
    [
        ("mission", "seed", 10**40, ["mission.seed", "at most 9223372036854775807", "files"]),
        ("mission", "seed", 10**5000, ["mission.seed", "thousands of digits"]),
        ("observation", "standard_deviation_microstrain", 10**400,
         ["observation.standard_deviation_microstrain", "finite"]),
        ("rewards", "health_weight", 10**5000, ["rewards.health_weight", "thousands of digits"]),
    ],
    ids=["seed", "long_seed", "deviation", "long_weight"],
)  # fmt: skip
def test_numbers_that_no_file_or_float_holds_are_refused(
    section: str, key: str, value: int, words: list[str]
) -> None:
    table = tomllib.loads(TEXT)
    table[section][key] = value
    with pytest.raises(ScenarioError) as caught:
        parse_scenario(table, "mine.toml")
    for word in words:
        assert word in str(caught.value)


def test_a_deeply_nested_file_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "deep.toml"
    for text in ("x = " + 20_000 * "[" + 20_000 * "]", "x = " + 20_000 * "{a=" + "1" + 20_000 * "}"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ScenarioError, match=r"deep\.toml"):
            load_scenario(path)


def test_tables_are_checked() -> None:
    table = tomllib.loads(TEXT)
    good = [
        [0.9, 0.1, 0, 0, 0],
        [0, 0.9, 0.1, 0, 0],
        [0, 0, 0.9, 0.1, 0],
        [0, 0, 0, 0.9, 0.1],
        [0, 0, 0, 0, 1],
    ]
    tables = {name: {"z1": [list(map(float, r)) for r in good], "z2": good} for name in ("2g", "3g")}
    table["transition"] = {"kind": "independent_tables", "tables": tables}
    assert parse_scenario(table, "x").transition.tables["2g"]["z1"][0][1] == 0.1
    tables["2g"]["z1"][1][1] = 0.8
    with pytest.raises(ScenarioError, match=r"2g\.z1.*sum to 1"):
        parse_scenario(table, "x")
    tables["2g"]["z1"] = good[:4]
    with pytest.raises(ScenarioError, match="5 rows of 5"):
        parse_scenario(table, "x")


@settings(deadline=None)  # the first one loads every source
@given(st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(max_size=4) | st.integers(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(
        [*Scenario.model_fields, "levels_percent", "prior", "name", "steps", "kind", "x"]
    ), inner, max_size=4),
    max_leaves=12,
))  # fmt: skip
def test_no_table_whatsoever_raises_anything_but_a_sentence(table: object) -> None:
    base = tomllib.loads(TEXT)
    candidates = [table] if isinstance(table, dict) else []
    candidates += [base | {key: table} for key in Scenario.model_fields]
    for candidate in candidates:
        sentence = "x.toml"
        try:
            parse_scenario(candidate, "x.toml")
        except TwinMasterError as error:
            sentence = str(error)
        assert sentence.startswith("x.toml")
