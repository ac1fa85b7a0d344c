"""The run store: bytes that depend on nothing but the mission, tables and figures, whole files or none."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.twin_master.runs import flight_of, loaded_from, of_library, table_of
from twin_master.errors import InvalidModelError, RunFolderError
from twin_master.fleet.store import in_credible_set
from twin_master.network.twin import build_graphical_model
from twin_master.scenario.mission import Reference
from twin_master.scenario.reading import load_scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import csv_tables, run_groups
from twin_master.store.summary import fallback_figures, find_fallback, summarise
from twin_master.store.writing import open_run, write_run


@pytest.fixture(scope="module")
def result(library_file: Path) -> MissionResult:
    return flown("failing_gauges", library_file)


def flown(name: str, library_file: Path) -> MissionResult:
    knowledge, source = of_library(name, library_file)
    return MissionResult(knowledge.scenario, knowledge, flight_of(knowledge, source), knowledge.truth(3))


def test_the_file_reads_back_and_its_bytes_depend_on_the_tree_alone(result, tmp_path):
    groups = run_groups(result)
    first = write_run(tmp_path / "a", groups, {"seed": 3}).read_bytes()
    assert write_run(tmp_path / "b", run_groups(result), {"seed": 3}).read_bytes() == first
    assert write_run(tmp_path / "c", run_groups(result), {"seed": 4}).read_bytes() != first
    read = open_run(tmp_path / "a")
    assert ([*read.children], read.attrs) == ([*groups], {"seed": 3})
    for name, made in groups.items():
        node, variables = read[name].to_dataset(), {**made.variables, **made.coords}
        assert ({*node.variables}, node.attrs) == ({*variables}, made.attrs)
        for key, variable in variables.items():
            np.testing.assert_array_equal(node[key], variable.values)
            assert (node[key].dims, node[key].attrs) == (variable.dims, variable.attrs)
            assert key not in made.variables or (variable.attrs["units"] and variable.attrs["long_name"])
    np.testing.assert_array_equal(read["observed"]["strain"], result.flight.observed)
    (tmp_path / "a/run.nc").write_bytes(first[:1000])
    with pytest.raises(RunFolderError, match="not a whole run"):
        open_run(tmp_path / "a")


def test_what_is_stored_agrees_with_itself(result, tmp_path):
    write_run(tmp_path, run_groups(result), {})
    tree = open_run(tmp_path)
    filtered, predicted = tree["filtered"].to_dataset(), tree["predicted"].to_dataset()
    levels = result.knowledge.model.states.coordinates
    np.testing.assert_allclose(filtered["mean"], filtered["probability"].values @ levels)
    decided = filtered["decision_probability"]
    np.testing.assert_array_equal(decided.argmax("control")[:-1], result.flight.control_index[1:])
    # A healthy wing at 3g: the mean over the draws of e is the quantity of interest.
    np.testing.assert_allclose(filtered["quantity_mean"][0], result.knowledge.sensor_model.mean[0, 1])
    deviation = result.knowledge.sensor_model.value_per_draw[:, 0, 1].std(axis=0)
    np.testing.assert_allclose(filtered["quantity_standard_deviation"][0], deviation)
    noise = result.knowledge.sensor_model.total_standard_deviation  # with the place between the levels
    np.testing.assert_allclose(filtered["noise_standard_deviation"][0], noise[0, 1])
    assert noise.max() > 1.1 * noise.min()
    assert filtered["sensors_received"].values[36] == 0
    assert np.isnan(filtered["reward_mean"].sel(reward="error").values[36:38]).all()
    assert np.isnan(predicted["reward_mean"].sel(reward="error")).all()
    assert set(tree["truth"]["sensor_status"].values[8:36, 11]) == {2}  # it drifts


def test_tables_are_in_the_units_of_their_headers(result):
    texts = csv_tables(run_groups(result), result.scenario.observation)
    tables = {name: [*csv.DictReader(text.splitlines())] for name, text in texts.items()}
    health, observed = tables["health"], tables["observed"]
    assert [float(row["z1_true_percent"]) for row in health[8:13]] == [0, 0, 2, 4, 6]
    shown = float(observed[3]["strain_5_microstrain"])
    assert shown == pytest.approx(1e6 * result.flight.observed[3, 4], rel=1e-5)
    assert observed[36]["strain_5_microstrain"] == ""
    policy, decisions = tables["policy"], tables["decisions"]
    assert (policy[0]["z1_percent"], policy[0]["control"]) == ("0", "3g")
    assert (policy[-1]["z1_percent"], policy[-1]["control"]) == ("80", "2g")
    assert decisions[0]["control"] == "3g"
    assert decisions[36]["error_reward"] == ""


SCENARIO = load_scenario("level_turns").scenario
MODEL = build_graphical_model(SCENARIO)
POLICY = np.where(MODEL.states.coordinates[:, 0] > 0.59, 0, 1)
TRUTH = np.zeros((50, 2))
TRUTH[20:, 0], TRUTH[30:, 0] = 0.4, 0.6


def controls(*gentle: int) -> np.ndarray:
    flown = np.ones(50, dtype=np.int64)
    flown[list(gentle)] = 0
    return flown


@pytest.mark.parametrize(
    ("gentle", "truth", "delay", "early"),
    [
        (range(31, 50), TRUTH, 1, None),
        (range(33, 50), TRUTH, 3, None),
        ([*range(25, 27), *range(32, 50)], TRUTH, 2, 25),
        (range(29, 50), TRUTH, 0, 29),
        ([], TRUTH, None, None),
        ([12], np.zeros((50, 2)), None, 12),  # no damage calls for it
    ],
)
def test_fallback(gentle, truth, delay, early):
    found = find_fallback(MODEL.states, POLICY, 1, controls(*gentle), truth)
    assert (found.switch_state, found.switch_level) == ("z1", 0.6)
    assert found.called_for_step == (30 if truth.any() else None)
    assert (found.delay, found.early_step) == (delay, early)
    told = list(fallback_figures(found, SCENARIO)[2])  # one that came before the damage has no delay
    assert told[3:] == [None if early == 29 else delay, early]


def test_a_true_state_between_the_levels_calls_for_the_fallback_from_the_nearest_level_on():
    """Levels of 25 % stand for a script of 20 % a time: 40 % is nearest to the 50 % of the policy."""
    table = table_of("level_turns")
    for factor in table["state"]:
        factor["levels_percent"] = [0, 25, 50, 75, 80]
    states = build_graphical_model(loaded_from(table, "level_turns").scenario).states
    policy = np.where(states.coordinates[:, 0] > 0.49, 0, 1)
    found = find_fallback(states, policy, 1, controls(*range(21, 50)), TRUTH)
    assert (found.switch_level, found.called_for_step) == (0.5, 20)
    assert (found.delay, found.early_step) == (1, None)
    assert find_fallback(states, policy, 1, controls(15, *range(21, 50)), TRUTH).early_step == 15


@pytest.mark.parametrize("unit", [1.0, 1e-13, 1e9])
def test_figures_of_a_mission_do_not_depend_on_the_unit_of_the_state(unit):
    """History, fallback and credible sets of leaks of square millimetres, told in square metres, too."""
    table = table_of("level_turns")
    for factor in table["state"]:
        factor["levels"] = [unit * level / 100 for level in factor.pop("levels_percent")]
    for gain in table["truth"]["gains"]:
        gain["gain"] = unit * gain.pop("gain_percent") / 100
    scenario = loaded_from(table, "level_turns").scenario
    model, truth = build_graphical_model(scenario), scenario.scripted_history()
    np.testing.assert_allclose(truth, unit * SCENARIO.scripted_history(), rtol=1e-12)
    assert find_fallback(model.states, POLICY, 1, controls(40), truth).called_for_step == 30
    belief = np.tile(model.states.certain((0.2 * unit, 0.4 * unit)), (50, 1))
    expected = in_credible_set(MODEL, belief, SCENARIO.scripted_history())
    np.testing.assert_array_equal(in_credible_set(model, belief, truth), expected)
    assert expected.sum() == 6
    with pytest.raises(InvalidModelError, match="not a level of factor"):
        model.states.index((0.3 * unit, 0.0))


@pytest.mark.parametrize("name", ["level_turns", "failing_gauges", "growing_damage"])
def test_every_figure_is_one_that_a_reference_can_name_and_stands_beside_it(name, library_file):
    each = flown(name, library_file)
    steps = []
    for step in each.flight.steps:
        happened = step.reading.ground_truth._replace(monitors={"strain_error_bound": 2e-6})
        steps.append(replace(step, reading=replace(step.reading, ground_truth=happened)))
    references = (
        Reference(figure="fallback_delay", value="1 or 2", source="somewhere"),
        Reference(figure="mean_reward_error", value=-0.4, source="elsewhere"),
    )
    scenario = each.scenario.model_copy(update={"reference": references})
    complete = replace(each, scenario=scenario, flight=replace(each.flight, steps=steps))
    figures = [*summarise(complete, np.zeros((50, 3)))]
    assert tuple(figure.key for figure in figures) == each.scenario.figure_names
    value, flight = {figure.key: figure.value for figure in figures}, each.flight
    error = 100.0 * (flight.filtered @ each.knowledge.model.states.coordinates - flight.state)
    rms = [value[f"filtered_rms_error_{name}"] for name in each.scenario.state_names]
    np.testing.assert_allclose(rms, np.sqrt(np.mean(error**2, axis=0)))
    found = {f.key: (f.reference, f.reference_source) for f in figures if f.reference is not None}
    assert found == {"fallback_delay": ("1 or 2", "somewhere"), "mean_reward_error": (-0.4, "elsewhere")}
    blind = np.full((2, 2, 3), np.nan)  # the asset shows nothing anywhere, or one gauge alone
    assert "model_misfit_rms" not in [f.key for f in summarise(complete, np.zeros((50, 3)), blind)]
    blind[:, 1, 2] = 0.3, -0.4
    found = {f.key: f.value for f in summarise(complete, np.zeros((50, 3)), blind)}
    assert found["model_misfit_largest"] == pytest.approx(40.0)
    assert found["model_misfit_rms"] == pytest.approx(100.0 * np.sqrt(0.125))
