"""Figures draw what the run holds, and their numbers can be had by hand."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.transforms import Bbox
from numpy.testing import assert_allclose, assert_array_equal

from fe.wing.design import SHIPPED_DESIGN, load_design
from reporting.pages.page import ReportFigure
from tests.twin_master.report.conftest import altered, figures_of_unwritten, line, panel, rescripted
from twin_master.assets.design_source import DESIGN_COPY
from twin_master.report import page as report
from twin_master.report.belief import belief_figure, belief_steps, policy_figure
from twin_master.report.calibration import calibration_figure, load_test
from twin_master.report.captions import assumed_model_error
from twin_master.report.check import predictive_check
from twin_master.report.mission import choose_sensors, mission_figure
from twin_master.report.reading import short_number
from twin_master.report.structure import planform_figure, planform_of
from twin_master.scenario.schema import Scenario

NOW = 18
GAUGES = [16, 3]


@pytest.fixture(scope="module")
def figure_now(run):
    """The mission as it is known at a step, with two gauges."""
    return mission_figure(run, NOW, GAUGES)


PERCENT = 100.0


@pytest.mark.parametrize("region", [0, 1])
def test_the_mission_figure_draws_what_is_believed_of_a_region(run, figure_now, region):
    axes = panel(figure_now, f"region {region + 1}")
    smoothed_means = run.smoothed_until(NOW) @ run.model.states.coordinates
    filtered_means = run["filtered/mean"][: NOW + 1]
    past = line(axes, "past")
    as_seen = line(axes, "as seen at the time")
    assert_allclose(past[:, 1], PERCENT * smoothed_means[:, region])
    assert_allclose(as_seen[:, 1], PERCENT * filtered_means[:, region])


@pytest.mark.parametrize("region", [0, 1])
def test_the_mission_figure_draws_what_is_predicted_of_a_region_and_its_truth(run, figure_now, region):
    axes = panel(figure_now, f"region {region + 1}")
    steps, prediction = line(axes, "prediction").T
    truth = line(axes, "truth")
    assert_array_equal(steps, np.arange(19, 29))
    assert_allclose(prediction, PERCENT * run["predicted/mean"][NOW, :, region])
    assert_allclose(truth[:, 1], PERCENT * run.true_state[:29, region])


@pytest.mark.parametrize("sensor", GAUGES)
def test_the_mission_figure_draws_what_is_seen_and_expected_of_a_gauge(run, figure_now, sensor):
    axes = panel(figure_now, f"Gauge {sensor + 1}")
    expected = run["predicted/quantity_mean"][NOW, :, sensor]
    assert_allclose(line(axes, "observed")[:, 1], 1e6 * run.observations[:19, sensor])
    assert_allclose(line(axes, "observed later")[:, 1], 1e6 * run.observations[19:29, sensor])
    assert_allclose(line(axes, "past")[:, 1], 1e6 * run["filtered/quantity_mean"][:19, sensor])
    assert_allclose(line(axes, "prediction")[:, 1], 1e6 * expected)


@pytest.mark.parametrize(("number", "name"), [(0, "Health"), (1, "Control"), (2, "Error")])
def test_the_mission_figure_draws_past_rewards(run, figure_now, number, name):
    axes = panel(figure_now, f"{name} reward")
    assert_allclose(line(axes, "past")[:, 1], run["filtered/reward_mean"][:19, number])


@pytest.mark.parametrize(("number", "name"), [(0, "Health"), (1, "Control")])
def test_the_mission_figure_draws_expected_rewards(run, figure_now, number, name):
    prediction = line(panel(figure_now, f"{name} reward"), "prediction")
    assert_allclose(prediction[:, 1], run["predicted/reward_mean"][NOW, :, number])


def test_the_mission_figure_predicts_no_error_of_what_nobody_has_seen_yet(figure_now):
    labels = [curve.get_label() for curve in panel(figure_now, "Error reward").get_lines()]
    assert "prediction" not in labels


@pytest.mark.parametrize("control", [0, 1])
def test_the_mission_figure_draws_the_probability_of_a_control(run, figure_now, control):
    axes = panel(figure_now, "Control: flown")
    (bars,) = [bars for bars in axes.containers if bars.get_label() == f"_predicted {control}"]
    probability = [bar.get_height() / 0.82 for bar in bars]
    assert_allclose(probability, run["predicted/control_probability"][NOW, :, control])
    assert [bar.get_y() for bar in bars] == [control] * 10
    assert axes.get_yticklabels()[control].get_text() == run.controls[control]


def test_bands_are_the_stored_intervals(run):
    figure = mission_figure(run, 49, [16])
    band = panel(figure, "Gauge 17").collections[0].get_paths()[0].vertices
    ends_in_step_20 = band[band[:, 0] == 20][:, 1]
    low, high = (run[f"smoothed/quantity_{end}"][20, 16] for end in ("lower", "upper"))
    loss = panel(figure, "region 2").collections[0].get_paths()[0].vertices[:, 1]
    assert_allclose([ends_in_step_20.min(), ends_in_step_20.max()], [1e6 * low, 1e6 * high])
    assert 0.0 <= loss.min() <= loss.max() <= 80.0


def test_gauges_that_are_worth_a_panel_are_chosen(run):
    """The library has gauge 17 strained most; 5 answers to region 1, and 10 to region 2."""
    assert choose_sensors(run) == [16, 0, 4, 9]


@pytest.fixture(scope="module")
def figures_of_other_units(run) -> dict[str, ReportFigure]:
    """The figures of a run with a state in m2.K/W, a pressure, flows, and steps that are shifts."""
    flows = range(2, 25)
    observation = {
        "role": "operation",
        "unit": ["bar", *["L/min"] * 23],
        "standard_deviation": [2e-4] * 24,
        "titles": ["pressure", *[f"flow {number}" for number in flows]],
    }
    other = rescripted(run, mission={"step_name": "shift"}, observation=observation)
    other.config["scenario"]["state"][0]["unit"] = "m2.K/W"
    tree = altered(run).tree
    for name in ("observed", "truth"):
        tree[name] = xr.DataTree(tree[name].to_dataset().rename({"strain": "operation"}))
    scenario = Scenario.model_validate(other.config["scenario"])
    return figures_of_unwritten(replace(other, tree=tree, scenario=scenario), 20)


def test_states_have_units_of_their_own(run, figures_of_other_units):
    figure = figures_of_other_units["mission_now"].figure
    axes = panel(figure, "Stiffness loss of region 1")
    ticks = [label.get_text() for label in axes.get_yticklabels()]
    assert (axes.get_ylabel(), ticks) == ("z₁ (m2.K/W)", ["0", "0.2", "0.4", "0.6", "0.8"])
    assert panel(figure, "Stiffness loss of region 2").get_ylabel() == "z₂ (%)"
    assert_array_equal(line(axes, "as seen at the time")[:, 1], run["filtered/mean"][:21, 0])


def test_sensors_have_units_of_their_own(run, figures_of_other_units):
    figure = figures_of_other_units["mission_now"].figure
    pressure = panel(figure, "Pressure")
    assert pressure.get_ylabel() == "bar"
    assert panel(figure, "Flow 4").get_ylabel() == "L/min"
    assert_array_equal(line(pressure, "observed")[:, 1], run.observations[:21, 0])


def test_captions_have_the_units_of_states_and_sensors(figures_of_other_units):
    noise = "0.0002 bar (pressure), 0.0002 L/min (flow 2)"
    assert "in m2.K/W, percent; lines are means" in figures_of_other_units["mission_now"].caption
    assert noise in figures_of_other_units["check"].caption


@pytest.mark.parametrize("word", ["step", "gauge", "microstrain", "µε", "strain"])
def test_captions_and_titles_have_no_words_of_wings(figures_of_other_units, word):
    texts = [figure.caption + figure.title for figure in figures_of_other_units.values()]
    assert word not in " ".join(texts).lower()


def test_numbers_beside_an_axis_are_short():
    for number in ("0", "0.5", "-20", "1500", "1e-4", "2.5e4", "-1.25e-4"):
        assert short_number(float(number)) == number


def map_of(axes):
    """Return the values of a map, by the levels of both regions, transposed as they are drawn."""
    return axes.collections[0].get_array().reshape(5, 5)


def test_maps_show_the_joint_belief(run):
    steps = belief_steps(run)
    assert (steps[0], steps[-1], len(steps)) == (0, 49, 8)
    for axes, step in zip(belief_figure(run).axes[:8], steps, strict=True):
        assert_array_equal(map_of(axes), run["filtered/probability"][step].reshape(5, 5).T)
        assert f"step {step}" in axes.get_title(loc="left")


def test_only_maps_at_the_edge_of_a_figure_have_labels(run):
    """Two rows of four."""
    has_labels = [(bool(axes.get_xlabel()), bool(axes.get_ylabel())) for axes in belief_figure(run).axes[:8]]
    upper_row = [(False, True), (False, False), (False, False), (False, False)]
    lower_row = [(True, True), (True, False), (True, False), (True, False)]
    assert has_labels == upper_row + lower_row


def test_maps_show_the_policy_and_its_margin(run):
    of_controls, of_margin = policy_figure(run).axes[:2]
    first_value, second_value = run["policy/action_value"].T
    margin = second_value - first_value
    assert_array_equal(map_of(of_controls), run["policy/control_index"].reshape(5, 5).T)
    assert_array_equal(map_of(of_margin), margin.reshape(5, 5).T)


def with_factors(run, count, probability):
    """Return a run whose states are of some factors of two levels each, and its coordinates."""
    levels = [np.array([0.0, 0.5])] * count
    coordinates = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, count)
    names = [f"a{number}" for number in range(count)]
    factor = run.scenario.state[0]
    unit_factor = {"unit": "1", "levels": (0.0, 0.5), "prior": (1.0, 0.0)}
    state = tuple(factor.model_copy(update={"name": name, **unit_factor}) for name in names)
    policy = {name: ("state", column) for name, column in zip(names, coordinates.T, strict=True)}
    groups = {
        "observed": run.tree["observed"].to_dataset(),
        "filtered": xr.Dataset({"probability": (("step", "state"), probability)}),
        "policy": xr.Dataset(policy),
    }
    scenario = run.scenario.model_copy(update={"state": state})
    return replace(run, tree=xr.DataTree.from_dict(groups), scenario=scenario), coordinates


@pytest.mark.parametrize("count", [1, 3])
def test_states_of_another_number_of_factors_show_their_marginals(run, count):
    probability = np.random.default_rng(1).dirichlet(np.ones(2**count), 50)
    changed, coordinates = with_factors(run, count, probability)
    of_first_factor = belief_figure(changed).axes[0].collections[0].get_array().reshape(2, 50)
    mean = probability @ coordinates[:, 0]
    assert_allclose(of_first_factor, np.stack([1 - 2 * mean, 2 * mean]), atol=1e-12)


def run_with_model_error(run, error):
    """Return the run of a twin that states an error of its model, which counts as noise."""
    noise = np.hypot(125e-6, np.asarray(error) * run["filtered/quantity_mean"])
    doubting = rescripted(run, observation={"model_error": error})
    return altered(doubting, filtered__noise_standard_deviation=noise), noise


def residual_by_hand(run, noise):
    deviation = np.hypot(noise, run["filtered/quantity_standard_deviation"])
    return (run.observations - run["filtered/quantity_mean"]) / deviation


@pytest.mark.parametrize(
    ("error", "share"), [(0.0, ""), (0.03, "3 %"), ([0.01 * (gauge % 3) for gauge in range(24)], "0 to 2 %")]
)
def test_predictive_check_by_hand(run, error, share):
    """All that the twin leaves unsaid counts."""
    doubting, noise = run_with_model_error(run, error)
    expected = residual_by_hand(run, noise)
    check = predictive_check(doubting)
    assert_allclose(check.residual, expected)
    assert_allclose(check.coverage, np.mean(np.abs(expected) < 1.959964, axis=0))
    assert assumed_model_error(doubting) == share


def test_the_predictive_check_sees_that_there_is_more_noise_than_assumed(run):
    """The gauges have 150 microstrain, and the twin assumes 125."""
    check = predictive_check(run_with_model_error(run, 0.0)[0])
    assert 1.0 < check.standard_deviation < 1.25
    assert check.transform.min() >= 0.0
    assert check.transform.max() <= 1.0


def test_a_run_of_an_earlier_version_has_the_noise_of_its_scenario(run):
    without_noise = altered(run, filtered__noise_standard_deviation=None)
    assert_allclose(predictive_check(without_noise).residual, residual_by_hand(run, 125e-6))


POSTERIOR_GRID = np.linspace(0.9, 1.1, 101)
POSTERIOR_DENSITY = np.exp(-0.5 * ((POSTERIOR_GRID - 1.007) / 0.01) ** 2)
LOAD_TEST = {
    "prior": {"mean": 1.0, "standard_deviation": 0.0255},
    "posterior": {"grid": list(POSTERIOR_GRID), "density": list(POSTERIOR_DENSITY)},
    "data": {"load": [2.5, 5.0, 7.5], "displacement": [0.004, 0.008, 0.011]},
    "tip_stiffness": {"mean": 681.1, "standard_deviation": 6.0, "unit": "N/m"},
}


def test_a_run_without_a_load_test_shows_its_draws(run):
    assert load_test(run) is None
    assert len(calibration_figure(run).axes) == 1


def test_draws_that_are_all_alike_are_shown(run):
    assert calibration_figure(altered(run, calibration__draw_value=np.ones(5))).axes


def test_calibration_shows_posterior_and_measurements(run):
    pairs, density = calibration_figure(replace(run, calibration=LOAD_TEST)).axes
    posterior = line(density, "posterior")
    expected = np.exp(-0.5 * ((posterior[:, 0] - 1.007) / 0.01) ** 2)
    assert_allclose(line(pairs, "measured"), [[2.5, 4.0], [5.0, 8.0], [7.5, 11.0]])
    assert_allclose(line(pairs, "calibrated")[1], [8.1, 1e3 * 8.1 / 681.1])
    assert_allclose(posterior[:, 1], expected)


def test_a_prior_that_is_cut_off_is_shown_within_its_range(run):
    cut_off = {"prior": {"mean": 1.0, "standard_deviation": 0.05, "range": [1.0, 1.02]}}
    _, density = calibration_figure(replace(run, calibration=LOAD_TEST | cut_off)).axes
    prior = line(density, "prior")
    assert (prior[0, 0], prior[-1, 0]) == (1.0, 1.02)
    assert np.trapezoid(prior[:, 1], prior[:, 0]) == pytest.approx(1.0, rel=1e-4)


def test_the_wing_is_coloured_by_belief_and_its_gauges_by_reading_and_residual(run):
    design = load_design()
    planform, chords = planform_of(design, run.scenario), design.planform
    above = planform.outline[:, 1]  # on the straight chord line every place has the height zero
    assert above[0] - above[3] == pytest.approx(chords.root_chord)
    assert above[1] - above[2] == pytest.approx(chords.tip_chord)
    assert chords.straight_chord_line * above[2] == pytest.approx((chords.straight_chord_line - 1) * above[1])
    assert_allclose(planform.gauges[:, 0], [span for span, _ in design.gauges.positions])
    observed = run.observations.copy()
    observed[-1, 4] = np.nan
    changed = altered(run, observed__strain=observed)
    residual = predictive_check(changed).residual[-1]
    figure = planform_figure(changed, planform, residual)
    for axes, expected in zip(figure.axes[:2], (1e6 * observed[-1], residual), strict=True):
        regions, dots, lost = axes.collections
        assert_allclose(regions.get_array(), 100.0 * run["filtered/mean"][-1])
        assert_allclose(dots.get_array(), np.delete(expected, 4))
        assert_allclose(dots.get_offsets(), np.delete(planform.gauges, 4, axis=0))
        assert_allclose(lost.get_offsets(), planform.gauges[[4]])


def test_nothing_is_drawn_outside_the_figure(run, hold, tmp_path):
    """Also with titles that would be broken mathematics."""
    titles = [f"gauge ${number}^" for number in range(1, 25)]
    hold(rescripted(run, state={"title": r"loss of $\frac{1$"}, observation={"titles": titles}))
    (tmp_path / DESIGN_COPY).parent.mkdir()
    shutil.copy(SHIPPED_DESIGN, tmp_path / DESIGN_COPY)
    names = []
    for drawn in report.report_figures(tmp_path, 18):
        names.append(drawn.name)
        tight, whole = drawn.figure.get_tightbbox(), drawn.figure.bbox_inches.padded(0.01)
        assert np.array_equal(Bbox.union([tight, whole]).bounds, whole.bounds), drawn.name
    assert names[-1] == "structure"
