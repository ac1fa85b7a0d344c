"""Figures draw what the run holds, and their numbers can be had by hand."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.transforms import Bbox
from numpy.testing import assert_allclose, assert_array_equal

from fe.wing.design import SHIPPED_DESIGN, load_design
from tests.twin_master.report.conftest import altered, line, panel, rescripted
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


def test_the_mission_figure_draws_the_stored_arrays(run):
    now, sensors = 18, [16, 3]
    figure = mission_figure(run, now, sensors)
    belief, truth, observed = run.smoothed_until(now), run.true_state, run.observations
    for factor in range(2):
        axes = panel(figure, f"region {factor + 1}")
        assert_allclose(line(axes, "past")[:, 1], 100.0 * (belief @ run.model.states.coordinates)[:, factor])
        assert_allclose(
            line(axes, "as seen at the time")[:, 1], 100.0 * run["filtered/mean"][: now + 1, factor]
        )
        coming = line(axes, "prediction")
        assert_array_equal(coming[:, 0], np.arange(19, 29))
        assert_allclose(coming[:, 1], 100.0 * run["predicted/mean"][now, :, factor])
        assert_allclose(line(axes, "truth")[:, 1], 100.0 * truth[:29, factor])
    for sensor in sensors:
        axes = panel(figure, f"Gauge {sensor + 1}")
        assert_allclose(line(axes, "observed")[:, 1], 1e6 * observed[:19, sensor])
        assert_allclose(line(axes, "observed later")[:, 1], 1e6 * observed[19:29, sensor])
        assert_allclose(line(axes, "past")[:, 1], 1e6 * run["filtered/quantity_mean"][:19, sensor])
        assert_allclose(line(axes, "prediction")[:, 1], 1e6 * run["predicted/quantity_mean"][now, :, sensor])
    for index, name in enumerate(("Health", "Control", "Error")):
        axes = panel(figure, f"{name} reward")
        assert_allclose(line(axes, "past")[:, 1], run["filtered/reward_mean"][:19, index])
        if name == "Error":  # of what nobody has seen yet there is none
            assert "prediction" not in [drawn.get_label() for drawn in axes.get_lines()]
        else:
            assert_allclose(line(axes, "prediction")[:, 1], run["predicted/reward_mean"][now, :, index])
    axes = panel(figure, "Control: flown")
    for control, name in enumerate(run.controls):
        (bars,) = [c for c in axes.containers if c.get_label() == f"_predicted {control}"]
        heights = [bar.get_height() / 0.82 for bar in bars]
        assert_allclose(heights, run["predicted/control_probability"][18, :, control])
        assert [bar.get_y() for bar in bars] == [control] * 10
        assert axes.get_yticklabels()[control].get_text() == name
    # Bands are the stored intervals.
    figure = mission_figure(run, 49, [16])
    band = panel(figure, "Gauge 17").collections[0].get_paths()[0].vertices
    heights = band[band[:, 0] == 20][:, 1]
    ends = (run[f"smoothed/quantity_{end}"][20, 16] for end in ("lower", "upper"))
    assert_allclose([heights.min(), heights.max()], [1e6 * end for end in ends])
    loss = panel(figure, "region 2").collections[0].get_paths()[0].vertices
    assert 0.0 <= loss[:, 1].min() <= loss[:, 1].max() <= 80.0
    # Worth a panel; built into the library: 17 is strained most, 5 answers to region 1 and 10 to region 2.
    assert choose_sensors(run) == [16, 0, 4, 9]


def test_states_and_sensors_have_units_and_names_of_their_own(run, hold, tmp_path):
    observation = {
        "role": "operation", "unit": ["bar", *["L/min"] * 23], "standard_deviation": [2e-4] * 24,
        "titles": ["pressure", *[f"flow {number}" for number in range(2, 25)]],
    }  # fmt: skip
    other = rescripted(run, mission={"step_name": "shift"}, observation=observation)
    other.config["scenario"]["state"][0]["unit"] = "m2.K/W"
    tree = altered(run).tree
    for name in ("observed", "truth"):
        tree[name] = xr.DataTree(tree[name].to_dataset().rename({"strain": "operation"}))
    hold(replace(other, tree=tree, scenario=Scenario.model_validate(other.config["scenario"])))
    figures = {figure.name: figure for figure in report.report_figures(tmp_path, 20)}
    now = figures["mission_now"].figure
    axes = panel(now, "Stiffness loss of region 1")
    assert axes.get_ylabel() == "z₁ (m2.K/W)"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0", "0.2", "0.4", "0.6", "0.8"]
    assert_array_equal(line(axes, "as seen at the time")[:, 1], run["filtered/mean"][:21, 0])
    assert panel(now, "Stiffness loss of region 2").get_ylabel() == "z₂ (%)"
    pressure = panel(now, "Pressure")
    assert pressure.get_ylabel() == "bar"
    assert_array_equal(line(pressure, "observed")[:, 1], run.observations[:21, 0])
    assert panel(now, "Flow 4").get_ylabel() == "L/min"
    assert "in m2.K/W, percent; the past" in figures["mission_now"].caption
    assert "0.0002 bar (pressure), 0.0002 L/min (flow 2)" in figures["check"].caption
    words = " ".join(figure.caption + figure.title for figure in figures.values())
    for word in ("step", "gauge", "microstrain", "µε", "strain"):
        assert word not in words.lower(), word


def test_numbers_beside_an_axis_are_short():
    for number in ("0", "0.5", "-20", "1500", "1e-4", "2.5e4", "-1.25e-4"):
        assert short_number(float(number)) == number


def test_maps_show_the_joint_belief_the_policy_and_its_margin(run):
    figure, steps = belief_figure(run), belief_steps(run)
    assert (steps[0], steps[-1], len(steps)) == (0, 49, 8)
    for axes, step in zip(figure.axes[:8], steps, strict=True):
        mesh = axes.collections[0].get_array().reshape(5, 5)
        assert_array_equal(mesh, run["filtered/probability"][step].reshape(5, 5).T)
        assert f"step {step}" in axes.get_title(loc="left")
    named = [(bool(axes.get_xlabel()), bool(axes.get_ylabel())) for axes in figure.axes[:8]]
    assert named == [(lowest, first) for lowest in (False, True) for first in (True, *(False,) * 3)]
    figure = policy_figure(run)
    value = run["policy/action_value"]
    chosen, margin = (axes.collections[0].get_array().reshape(5, 5) for axes in figure.axes[:2])
    assert_array_equal(chosen, run["policy/control_index"].reshape(5, 5).T)
    assert_array_equal(margin, (value[:, 1] - value[:, 0]).reshape(5, 5).T)


@pytest.mark.parametrize("count", [1, 3])
def test_states_of_another_number_of_factors_show_their_marginals(run, count):
    levels = [np.array([0.0, 0.5])] * count
    coordinates = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, count)
    probability = np.random.default_rng(1).dirichlet(np.ones(2**count), 50)
    each = ({"name": f"a{k}", "unit": "1", "levels": (0.0, 0.5), "prior": (1.0, 0.0)} for k in range(count))
    state = tuple(run.scenario.state[0].model_copy(update=changes) for changes in each)
    scenario = run.scenario.model_copy(update={"state": state})
    groups = {
        "observed": run.tree["observed"].to_dataset(),
        "filtered": xr.Dataset({"probability": (("step", "state"), probability)}),
        "policy": xr.Dataset({f"a{k}": ("state", coordinates[:, k]) for k in range(count)}),
    }
    other = replace(run, tree=xr.DataTree.from_dict(groups), scenario=scenario)
    first = belief_figure(other).axes[0].collections[0].get_array().reshape(2, 50)
    mean = (probability @ coordinates)[:, 0]
    assert_allclose(first, np.stack([1 - 2 * mean, 2 * mean]), atol=1e-12)


@pytest.mark.parametrize(
    ("error", "share"), [(0.0, ""), (0.03, "3 %"), ([0.01 * (gauge % 3) for gauge in range(24)], "0 to 2 %")]
)
def test_predictive_check_by_hand(run, error, share):
    """All that the twin leaves unsaid counts."""
    doubting, mean = rescripted(run, observation={"model_error": error}), run["filtered/quantity_mean"]
    unsaid = np.hypot(125e-6, np.asarray(error) * mean)
    check = predictive_check(altered(doubting, filtered__noise_standard_deviation=unsaid))
    expected = (run.observations - mean) / np.hypot(unsaid, run["filtered/quantity_standard_deviation"])
    assert_allclose(check.residual, expected)
    assert_allclose(check.coverage, np.mean(np.abs(expected) < 1.959964, axis=0))
    assert assumed_model_error(doubting) == share
    if not share:
        # the gauges have 150 microstrain and the twin assumes 125
        assert 1.0 < check.standard_deviation < 1.25
        assert check.transform.min() >= 0.0
        assert check.transform.max() <= 1.0
        old = altered(run, filtered__noise_standard_deviation=None)  # as earlier versions wrote it
        assert_allclose(predictive_check(old).residual, expected)


def test_calibration_shows_draws_posterior_and_measurements(run):
    assert load_test(run) is None
    assert len(calibration_figure(run).axes) == 1
    grid = np.linspace(0.9, 1.1, 101)
    kept = {
        "prior": {"mean": 1.0, "standard_deviation": 0.0255},
        "posterior": {"grid": list(grid), "density": list(np.exp(-0.5 * ((grid - 1.007) / 0.01) ** 2))},
        "data": {"load": [2.5, 5.0, 7.5], "displacement": [0.004, 0.008, 0.011]},
        "tip_stiffness": {"mean": 681.1, "standard_deviation": 6.0, "unit": "N/m"},
    }
    pairs, density = calibration_figure(replace(run, calibration=kept)).axes
    assert_allclose(line(pairs, "measured"), [[2.5, 4.0], [5.0, 8.0], [7.5, 11.0]])
    assert_allclose(line(pairs, "calibrated")[1], [8.1, 1e3 * 8.1 / 681.1])
    posterior = line(density, "posterior")
    assert_allclose(posterior[:, 1], np.exp(-0.5 * ((posterior[:, 0] - 1.007) / 0.01) ** 2))
    cut = kept | {"prior": {"mean": 1.0, "standard_deviation": 0.05, "range": [1.0, 1.02]}}
    prior = line(calibration_figure(replace(run, calibration=cut)).axes[1], "prior")
    assert (prior[0, 0], prior[-1, 0]) == (1.0, 1.02)
    assert np.trapezoid(prior[:, 1], prior[:, 0]) == pytest.approx(1.0, rel=1e-4)
    assert calibration_figure(altered(run, calibration__draw_value=np.ones(5))).axes


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
