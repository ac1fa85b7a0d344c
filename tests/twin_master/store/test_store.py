"""The run store: bytes that depend on nothing but the mission, tables and figures, whole files or none."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tests.twin_master.runs import flight_of, loaded_from, of_library, table_of
from twin_master.errors import InvalidModelError, RunFolderError
from twin_master.fleet.storage.store import in_credible_set
from twin_master.mission.earnings import promised_return
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.mission import Reference
from twin_master.scenario.reading import load_scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import csv_tables, run_groups
from twin_master.store.summary import fallback_group, find_fallback, summarise
from twin_master.store.writing import open_run, write_run


@pytest.fixture(scope="module")
def result(library_file: Path) -> MissionResult:
    return flown("failing_gauges", library_file)


def flown(name: str, library_file: Path) -> MissionResult:
    knowledge, source = of_library(name, library_file)
    return MissionResult(knowledge.scenario, knowledge, flight_of(knowledge, source), knowledge.truth(3))


def test_the_bytes_of_a_store_depend_on_the_tree_alone(result, tmp_path):
    first = write_run(tmp_path / "a", run_groups(result), {"seed": 3}).read_bytes()
    assert write_run(tmp_path / "b", run_groups(result), {"seed": 3}).read_bytes() == first
    assert write_run(tmp_path / "c", run_groups(result), {"seed": 4}).read_bytes() != first


@pytest.fixture(scope="module")
def stored(result: MissionResult, tmp_path_factory: pytest.TempPathFactory) -> xr.DataTree:
    """The store of the mission as it is read."""
    folder = tmp_path_factory.mktemp("stored")
    write_run(folder, run_groups(result), {"seed": 3})
    return open_run(folder)


def test_groups_of_a_store_read_back(result, stored):
    groups = run_groups(result)
    assert ([*stored.children], stored.attrs) == ([*groups], {"seed": 3})
    for name, group in groups.items():
        dataset = stored[name].to_dataset()
        assert {*dataset.variables} == {*group.variables, *group.coords}
        assert dataset.attrs == group.attrs


def test_variables_of_a_store_read_back(result, stored):
    np.testing.assert_array_equal(stored["observed"]["strain"], result.flight.observed)
    for name, group in run_groups(result).items():
        dataset = stored[name].to_dataset()
        for key, variable in {**group.variables, **group.coords}.items():
            np.testing.assert_array_equal(dataset[key], variable.values)
            assert (dataset[key].dims, dataset[key].attrs) == (variable.dims, variable.attrs)


def test_variables_of_a_store_have_units_and_names(result):
    for group in run_groups(result).values():
        for variable in group.variables.values():
            assert variable.attrs["units"]
            assert variable.attrs["long_name"]


def test_a_torn_store_is_refused(result, tmp_path):
    path = write_run(tmp_path, run_groups(result), {})
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(RunFolderError, match="not a whole run"):
        open_run(tmp_path)


def test_stored_means_are_those_of_stored_probabilities(result, stored):
    filtered = stored["filtered"].to_dataset()
    levels = result.knowledge.model.states.coordinates
    np.testing.assert_allclose(filtered["mean"], filtered["probability"].values @ levels)


def test_the_stored_decision_is_the_next_control(result, stored):
    decision = stored["filtered"]["decision_probability"].argmax("control")
    np.testing.assert_array_equal(decision[:-1], result.flight.control_index[1:])


def test_the_first_stored_quantity_is_that_of_a_healthy_wing(result, stored):
    """At 3g, its mean over the draws of e; the noise is that with the place between the levels."""
    filtered = stored["filtered"].to_dataset()
    sensors = result.knowledge.sensor_model
    deviation = sensors.value_per_draw[:, 0, 1].std(axis=0)
    noise = sensors.total_standard_deviation
    np.testing.assert_allclose(filtered["quantity_mean"][0], sensors.mean[0, 1])
    np.testing.assert_allclose(filtered["quantity_standard_deviation"][0], deviation)
    np.testing.assert_allclose(filtered["noise_standard_deviation"][0], noise[0, 1])
    assert noise.max() > 1.1 * noise.min()


def test_steps_without_readings_have_no_error_reward(stored):
    filtered = stored["filtered"].to_dataset()
    predicted_error = stored["predicted"]["reward_mean"].sel(reward="error")
    assert filtered["sensors_received"].values[36] == 0
    assert np.isnan(filtered["reward_mean"].sel(reward="error").values[36:38]).all()
    assert np.isnan(predicted_error).all()


def test_the_stored_truth_says_which_gauge_drifts(stored):
    drifting = 2
    assert set(stored["truth"]["sensor_status"].values[8:36, 11]) == {drifting}


@pytest.fixture(scope="module")
def tables(result: MissionResult) -> dict[str, list[dict[str, str]]]:
    """The rows of each table by their headers."""
    texts = csv_tables(run_groups(result), result.scenario.observation)
    return {name: [*csv.DictReader(text.splitlines())] for name, text in texts.items()}


def test_states_in_tables_are_in_percent(tables):
    loss = [float(row["z1_true_percent"]) for row in tables["health"][8:13]]
    assert loss == [0, 0, 2, 4, 6]


def test_strains_in_tables_are_in_microstrain_and_empty_where_they_were_lost(result, tables):
    name = "strain_5_microstrain"
    strain = float(tables["observed"][3][name])
    assert strain == pytest.approx(1e6 * result.flight.observed[3, 4], rel=1e-5)
    assert tables["observed"][36][name] == ""


def test_the_table_of_the_policy_has_a_control_for_each_state(tables):
    first, last = tables["policy"][0], tables["policy"][-1]
    assert (first["z1_percent"], first["control"]) == ("0", "3g")
    assert (last["z1_percent"], last["control"]) == ("80", "2g")


def test_the_table_of_decisions_has_controls_and_rewards(tables):
    decisions = tables["decisions"]
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
def test_a_fallback_has_a_delay_or_is_early(gentle, truth, delay, early):
    """A fallback that came before the damage has no delay among the figures."""
    fallback = find_fallback(MODEL.states, POLICY, 1, controls(*gentle), truth)
    *_, figures = fallback_group(fallback, SCENARIO)
    delay_of_figure = None if early == 29 else delay
    assert (fallback.delay, fallback.early_change_step) == (delay, early)
    assert list(figures)[3:] == [delay_of_figure, early]


@pytest.mark.parametrize(("truth", "step"), [(TRUTH, 30), (np.zeros((50, 2)), None)])
def test_damage_calls_for_a_fallback_at_the_level_of_the_policy(truth, step):
    fallback = find_fallback(MODEL.states, POLICY, 1, controls(), truth)
    assert (fallback.switch_factor, fallback.switch_level) == ("z1", 0.6)
    assert fallback.step_at_switch_level == step


def test_a_true_state_between_the_levels_calls_for_the_fallback_from_the_nearest_level_on():
    """Levels of 25 % stand for a script of 20 % a time: 40 % is nearest to the 50 % of the policy."""
    table = table_of("level_turns")
    for factor in table["state"]:
        factor["levels_percent"] = [0, 25, 50, 75, 80]
    states = build_graphical_model(loaded_from(table, "level_turns").scenario).states
    policy = np.where(states.coordinates[:, 0] > 0.49, 0, 1)
    found = find_fallback(states, policy, 1, controls(*range(21, 50)), TRUTH)
    assert (found.switch_level, found.step_at_switch_level) == (0.5, 20)
    assert (found.delay, found.early_change_step) == (1, None)
    assert find_fallback(states, policy, 1, controls(15, *range(21, 50)), TRUTH).early_change_step == 15


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
    assert find_fallback(model.states, POLICY, 1, controls(40), truth).step_at_switch_level == 30
    belief = np.tile(model.states.certain_belief((0.2 * unit, 0.4 * unit)), (50, 1))
    expected = in_credible_set(MODEL, belief, SCENARIO.scripted_history())
    np.testing.assert_array_equal(in_credible_set(model, belief, truth), expected)
    assert expected.sum() == 6
    with pytest.raises(InvalidModelError, match="not a level of factor"):
        model.states.index((0.3 * unit, 0.0))


@pytest.fixture(scope="module", params=["level_turns", "failing_gauges", "growing_damage"])
def monitored(request: pytest.FixtureRequest, library_file: Path) -> MissionResult:
    """A mission with two references, whose asset also monitored an error bound."""
    mission = flown(request.param, library_file)
    steps = []
    for step in mission.flight.steps:
        truth = step.reading.ground_truth._replace(monitors={"strain_error_bound": 2e-6})
        steps.append(replace(step, reading=replace(step.reading, ground_truth=truth)))
    references = (
        Reference(figure="fallback_delay", value="1 or 2", source="somewhere"),
        Reference(figure="mean_reward_error", value=-0.4, source="elsewhere"),
    )
    scenario = mission.scenario.model_copy(update={"reference": references})
    return replace(mission, scenario=scenario, flight=replace(mission.flight, steps=steps))


SECONDS = np.zeros((50, 3))


def test_every_figure_is_one_that_a_reference_can_name(monitored):
    figures = summarise(monitored, SECONDS)
    assert tuple(figure.key for figure in figures) == monitored.scenario.summary_keys


def test_the_rms_error_is_that_of_the_filtered_mean(monitored):
    value = {figure.key: figure.value for figure in summarise(monitored, SECONDS)}
    flight = monitored.flight
    error = 100.0 * (flight.filtered @ monitored.knowledge.model.states.coordinates - flight.state)
    rms = [value[f"filtered_rms_error_{name}"] for name in monitored.scenario.state_names]
    np.testing.assert_allclose(rms, np.sqrt(np.mean(error**2, axis=0)))


def test_a_reference_stands_beside_its_figure(monitored):
    references = {
        figure.key: (figure.reference, figure.reference_source)
        for figure in summarise(monitored, SECONDS)
        if figure.reference is not None
    }
    assert references == {
        "fallback_delay": ("1 or 2", "somewhere"),
        "mean_reward_error": (-0.4, "elsewhere"),
    }


def test_what_was_promised_of_a_given_policy_stands_beside_what_it_earned(monitored):
    given = replace(monitored.knowledge, policy=monitored.knowledge.plan.policy)
    (figure,) = [
        figure for figure in summarise(replace(monitored, knowledge=given), SECONDS) if figure.key == "return"
    ]
    assert figure.value == pytest.approx(monitored.discounted_return)
    numbers = re.findall(r"−?[0-9]+[.][0-9]+", str(figure.reference))
    mean, low, high = (float(number.replace("−", "-")) for number in numbers)
    returns = promised_return(given).returns
    assert mean == pytest.approx(returns.mean(), abs=0.1 * returns.std())
    assert np.mean((low <= returns) & (returns <= high)) == pytest.approx(0.95, abs=0.02)


def test_an_asset_that_shows_nothing_has_no_misfit(monitored):
    misfit = np.full((2, 2, 3), np.nan)
    assert "model_misfit_rms" not in {figure.key for figure in summarise(monitored, SECONDS, misfit)}


def test_the_misfit_is_that_of_the_gauges_that_are_shown(monitored):
    misfit = np.full((2, 2, 3), np.nan)
    misfit[:, 1, 2] = 0.3, -0.4
    value = {figure.key: figure.value for figure in summarise(monitored, SECONDS, misfit)}
    assert value["model_misfit_largest"] == pytest.approx(40.0)
    assert value["model_misfit_rms"] == pytest.approx(100.0 * np.sqrt(0.125))
