"""Figures draw what the run holds, and their numbers can be had by hand."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose, assert_array_equal

from calibration.result.plain import run_record
from calibration.result.record import Calibration
from reporting.figures import to_svg
from tests.twin_master.report.drawn import line, panel
from twin_master.report import belief as report_belief
from twin_master.report import calibration as report_calibration
from twin_master.report import check as report_check
from twin_master.report import data as report_data
from twin_master.report import mission as report_mission
from twin_master.report import network as report_network
from twin_master.report import page as report
from twin_master.report.text import (
    check_caption,
)
from twin_master.report.view import choose_sensors, default_now, short_number
from twin_master.run_folder import to_json


def test_the_mission_figure_draws_the_stored_arrays(record: report_data.RunRecord) -> None:
    now, sensors = 18, [16, 3]
    figure = report_mission.mission_figure(record, now, sensors)
    assert record.predicted is not None
    assert record.predicted.quantity is not None
    assert record.predicted.reward is not None
    assert record.filtered.quantity is not None
    assert record.filtered.reward is not None
    assert record.truth_state is not None
    assert record.observation is not None
    belief = report_data.smoothed_until(record, now)
    assert belief is not None
    for factor in range(2):
        axes = panel(figure, f"region {factor + 1}")
        assert_allclose(line(axes, "past")[:, 1], 100.0 * (belief @ record.coordinates)[:, factor])
        assert_allclose(line(axes, "at the time")[:, 1], 100.0 * record.filtered.mean[: now + 1, factor])
        coming = line(axes, "prediction")
        assert_array_equal(coming[:, 0], np.arange(19, 29))
        assert_allclose(coming[:, 1], 100.0 * record.predicted.mean[now, :, factor])
        assert_allclose(line(axes, "truth")[:, 1], 100.0 * record.truth_state[:29, factor])
    for sensor in sensors:
        axes = panel(figure, f"Gauge {sensor + 1}")
        assert_allclose(line(axes, "observed")[:, 1], 1e6 * record.observation[:19, sensor])
        assert_allclose(line(axes, "observed later")[:, 1], 1e6 * record.observation[19:29, sensor])
        assert_allclose(line(axes, "past")[:, 1], 1e6 * record.filtered.quantity.mean[:19, sensor])
        assert_allclose(line(axes, "prediction")[:, 1], 1e6 * record.predicted.quantity.mean[now, :, sensor])
    for index, name in enumerate(("Health", "Control", "Error")):
        axes = panel(figure, f"{name} reward")
        assert_allclose(line(axes, "past")[:, 1], record.filtered.reward.mean[:19, index])
        assert_allclose(line(axes, "prediction")[:, 1], record.predicted.reward.mean[now, :, index])


def test_bands_are_the_stored_intervals(record: report_data.RunRecord) -> None:
    assert record.smoothed is not None
    assert record.smoothed.quantity is not None
    figure = report_mission.mission_figure(record, 49, [16])
    band = panel(figure, "Gauge 17").collections[0].get_paths()[0].vertices
    for turn in (0, 20, 49):
        heights = band[band[:, 0] == turn][:, 1]
        assert_allclose(heights.min(), 1e6 * record.smoothed.quantity.lower[turn, 16])
        assert_allclose(heights.max(), 1e6 * record.smoothed.quantity.upper[turn, 16])
    loss = panel(figure, "region 2").collections[0].get_paths()[0].vertices
    assert loss[:, 1].min() >= 0.0
    assert loss[:, 1].max() <= 80.0


def test_control_bars_have_the_height_of_the_probability(record: report_data.RunRecord) -> None:
    axes = panel(report_mission.mission_figure(record, 18), "Control: flown")
    assert record.control_probability is not None
    for control, name in enumerate(record.controls):
        (bars,) = [c for c in axes.containers if c.get_label() == f"predicted {control}"]
        heights = [bar.get_height() / 0.82 for bar in bars]
        assert_allclose(heights, record.control_probability[18, :, control])
        assert [bar.get_y() for bar in bars] == [control] * 10
        assert axes.get_yticklabels()[control].get_text() == name


def test_the_present_is_chosen_before_the_first_change_of_control(record: report_data.RunRecord) -> None:
    change = int(np.flatnonzero(np.diff(record.control_index))[0]) + 1
    assert default_now(record) == change - 3
    assert default_now(replace(record, control_index=np.zeros(50, dtype=np.int64))) == 33
    assert default_now(replace(record, control_index=np.array([0]))) == 0


def test_sensors_worth_a_panel_are_the_highest_the_first_and_one_for_each_region(
    record: report_data.RunRecord,
) -> None:
    # built into the made-up wing: 17 is strained most, 19 answers to region 1 and 23 to region 2
    assert choose_sensors(record) == [16, 0, 18, 22]


def test_states_and_sensors_have_units_and_names_of_their_own(record: report_data.RunRecord) -> None:
    units = ("bar", *["L/min"] * 23)
    titles = ("pressure", *[f"flow {number}" for number in range(2, 25)])
    mission = {**record.config["scenario"]["mission"], "step_name": "shift"}
    noise = {**record.config["scenario"]["observation"], "standard_deviation": [2e-4] * 24}
    other = replace(
        record,
        state_units=("m2.K/W", "1"),
        sensor_units=units,
        sensor_titles=titles,
        observation_name="operation",
        config={"scenario": {**record.config["scenario"], "mission": mission, "observation": noise}},
    )
    figures = {figure.name: figure for figure in report.report_figures(other, 20)}
    axes = panel(figures["mission_now"].figure, "Stiffness loss of region 1")
    assert axes.get_ylabel() == "z₁ (m2.K/W)"
    assert [label.get_text() for label in axes.get_yticklabels()] == ["0", "0.2", "0.4", "0.6", "0.8"]
    assert_array_equal(line(axes, "at the time")[:, 1], record.filtered.mean[:21, 0])
    assert panel(figures["mission_now"].figure, "Stiffness loss of region 2").get_ylabel() == "z₂ (%)"
    pressure = panel(figures["mission_now"].figure, "Pressure")
    assert pressure.get_ylabel() == "bar"
    assert record.observation is not None
    assert_array_equal(line(pressure, "observed")[:, 1], record.observation[:21, 0])
    assert panel(figures["mission_now"].figure, "Flow 4").get_ylabel() == "L/min"
    assert "in m2.K/W, percent; the past" in figures["mission_now"].caption
    assert "0.0002 bar (pressure), 0.0002 L/min (flow 2)" in figures["check"].caption
    words = " ".join(figure.caption + figure.title for figure in figures.values())
    for word in ("turn", "gauge", "microstrain", "µε", "strain"):
        assert word not in words.lower(), word


def test_numbers_beside_an_axis_are_short() -> None:
    numbers = (0.0, 0.5, -20.0, 1500.0, 1e-4, 25000.0, -0.000125)
    assert [short_number(n) for n in numbers] == [
        "0", "0.5", "-20", "1500", "1e-4", "2.5e4", "-1.25e-4",
    ]  # fmt: skip


def test_belief_maps_show_the_joint_belief(record: report_data.RunRecord) -> None:
    figure = report_belief.belief_figure(record)
    turns = report_belief.belief_turns(record)
    assert (turns[0], turns[-1], len(turns)) == (0, 49, 8)
    for axes, turn in zip(figure.axes[:8], turns, strict=True):
        mesh = axes.collections[0].get_array().reshape(5, 5)
        assert_array_equal(mesh, record.filtered.probability[turn].reshape(5, 5).T)
        assert f"turn {turn}" in axes.get_title(loc="left")


@pytest.mark.parametrize("count", [1, 3])
def test_states_of_another_number_of_factors_have_a_figure_too(
    record: report_data.RunRecord, count: int
) -> None:
    levels = (np.array([0.0, 0.5]),) * count
    coordinates = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, count)
    probability = np.random.default_rng(1).dirichlet(np.ones(2**count), 50)
    mean, deviation = report_data.moments(probability, coordinates)
    names = tuple(f"a{k}" for k in range(count))
    other = replace(
        record, state_names=names, state_titles=names, levels=levels, coordinates=coordinates, config={},
        filtered=replace(record.filtered, probability=probability, mean=mean, standard_deviation=deviation),
        smoothed=None, predicted=None, control_probability=None, policy=None, truth_state=None,
    )  # fmt: skip
    names_drawn = [figure.name for figure in report.report_figures(other, 20)]
    assert "belief" in names_drawn
    assert "policy" not in names_drawn
    first = report_belief.belief_figure(other).axes[0].collections[0].get_array().reshape(2, 50)
    assert_allclose(first, np.stack([1 - 2 * mean[:, 0], 2 * mean[:, 0]]), atol=1e-12)


def test_policy_maps_show_policy_and_margin(record: report_data.RunRecord, tree: xr.DataTree) -> None:
    figure = report_belief.policy_figure(record)
    assert figure is not None
    value = tree["policy/action_value"].values
    assert_array_equal(
        figure.axes[0].collections[0].get_array().reshape(5, 5),
        tree["policy/control_index"].values.reshape(5, 5).T,
    )
    signed = value[:, 1] - value[:, 0]
    assert_array_equal(figure.axes[1].collections[0].get_array().reshape(5, 5), signed.reshape(5, 5).T)
    assert_allclose(report_belief.policy_margin(record), np.abs(signed))


def test_predictive_check_by_hand(record: report_data.RunRecord) -> None:
    check = report_check.predictive_check(record)
    assert check is not None
    assert record.observation is not None
    assert record.filtered.quantity is not None
    assert record.filtered.quantity_standard_deviation is not None
    spread = np.sqrt(125e-6**2 + record.filtered.quantity_standard_deviation**2)
    expected = (record.observation - record.filtered.quantity.mean) / spread
    assert_allclose(check.residual, expected)
    assert_allclose(check.coverage, np.mean(np.abs(expected) < 1.959964, axis=0))
    # the gauges have 150 microstrain and the twin assumes 125
    assert 1.0 < check.standard_deviation < 1.25
    assert check.transform.min() >= 0.0
    assert check.transform.max() <= 1.0


@pytest.mark.parametrize("error", [0.03, [0.01 * (gauge % 3) for gauge in range(24)]])
def test_a_model_error_counts_in_the_predictive_check(
    record: report_data.RunRecord, error: float | list[float]
) -> None:
    def assuming(value: object) -> report_data.RunRecord:
        observation = {**record.scenario["observation"], "model_error": value}
        return replace(record, config={"scenario": {**record.scenario, "observation": observation}})

    without, doubting = report_check.predictive_check(record), assuming(error)
    check = report_check.predictive_check(doubting)
    assert check is not None
    assert without is not None
    assert record.filtered.quantity is not None
    assert record.filtered.quantity_standard_deviation is not None
    variance = 125e-6**2 + record.filtered.quantity_standard_deviation**2
    wider = variance + (np.asarray(error) * record.filtered.quantity.mean) ** 2
    assert_allclose(check.residual, without.residual * np.sqrt(variance / wider))
    share = "3 %" if isinstance(error, float) else "0 to 2 %"
    assert f"and an error of its model of {share} of the predicted" in check_caption(doubting, check)
    assert "error of its model" not in check_caption(record, without)
    for damaged in ("a", [0.1], None, {}):
        unchanged = report_check.predictive_check(assuming(damaged))
        assert unchanged is not None
        assert_array_equal(unchanged.residual, without.residual)


def test_predictive_check_of_a_right_twin_is_uniform(record: report_data.RunRecord) -> None:
    assert record.filtered.quantity is not None
    random = np.random.default_rng(3)
    certain = replace(record.filtered, quantity_standard_deviation=None)
    observation = record.filtered.quantity.mean + 125e-6 * random.standard_normal((50, 24))
    check = report_check.predictive_check(replace(record, filtered=certain, observation=observation))
    assert check is not None
    assert abs(check.overall_coverage - 0.95) < 0.02
    assert abs(check.standard_deviation - 1.0) < 0.05
    assert np.all(np.abs(np.histogram(check.transform, 10)[0] - 120) < 45)


def test_calibration_shows_draws_posterior_and_measurements(
    record: report_data.RunRecord, tree: xr.DataTree
) -> None:
    bare = report_calibration.calibration_view(record)
    assert bare is not None
    assert (bare.posterior, bare.pairs, bare.true_value) == (None, None, 1.0073)
    assert len(report_calibration.calibration_figure(bare).axes) == 1
    grid = np.linspace(0.9, 1.1, 101)
    kept = {
        "prior": {"mean": 1.0, "standard_deviation": 0.0255},
        "posterior": {"grid": list(grid), "density": list(np.exp(-0.5 * ((grid - 1.007) / 0.01) ** 2))},
        "data": {"load": [2.5, 5.0, 7.5], "displacement": [0.004, 0.008, 0.011]},
        "tip_stiffness": {"mean": 681.1, "standard_deviation": 6.0, "unit": "N/m"},
    }
    view = report_calibration.calibration_view(replace(record, calibration=kept))
    assert view is not None
    earlier = {
        "prior": kept["prior"],
        "exact": kept["posterior"],
        "data": {"load_N": kept["data"]["load"], "displacement_m": kept["data"]["displacement"]},
        "tip_stiffness_exact": kept["tip_stiffness"],
    }
    told = report_calibration.calibration_view(replace(record, calibration=earlier))
    assert repr(told) == repr(view)  # a run of an earlier version
    figure = report_calibration.calibration_figure(view)
    assert_allclose(line(figure.axes[0], "measured"), [[2.5, 4.0], [5.0, 8.0], [7.5, 11.0]])
    assert_allclose(line(figure.axes[0], "calibrated")[1], [8.1, 1e3 * 8.1 / 681.1])
    posterior = line(figure.axes[1], "posterior")
    assert_allclose(posterior[:, 1], np.exp(-0.5 * ((posterior[:, 0] - 1.007) / 0.01) ** 2))
    assert "681.1 ± 6.0 N/m" in report_calibration.calibration_caption(view)
    cut = replace(view, prior=(1.0, 0.05), ends=(1.0, 1.02))
    prior = line(report_calibration.calibration_figure(cut).axes[1], "prior")
    assert (prior[0, 0], prior[-1, 0]) == (1.0, 1.02)
    assert np.trapezoid(prior[:, 1], prior[:, 0]) == pytest.approx(1.0, rel=1e-4)
    for broken in (
        {"prior": 3},
        {"posterior": {"grid": [1.0]}},
        {"data": {"load": [1.0], "displacement": []}},
    ):
        assert report_calibration.calibration_view(replace(record, calibration=broken)) is not None
    fixed = replace(record, parameter_draws=np.ones(5))
    assert report_calibration.calibration_figure(report_calibration.calibration_view(fixed)).axes


def test_a_calibration_file_shows_its_wing(
    record: report_data.RunRecord, make_calibration: Callable[..., Calibration]
) -> None:
    wing = make_calibration(young_modulus_factor=1.05)
    kept = json.loads(to_json(run_record(wing, "young_modulus_factor")))
    draws = wing.draws_of("young_modulus_factor")
    asset = {"design": "calibration", "file": None, "parameters": {}}
    flown = replace(
        record,
        parameter_name="young_modulus_factor",
        parameter_draws=draws,
        calibration=kept,
        config={**record.config, "scenario": {**record.scenario, "asset": asset}},
    )
    view = report_calibration.calibration_view(flown)
    assert view is not None
    assert view.true_value == wing.mean("young_modulus_factor")  # the FMU starts at the mean
    assert [figure.unit for figure in view.figures][:6] == ["1", "kg", "kg", "1/s", "s", "N/m"]
    servo = view.figures[1]
    assert (servo.mean, servo.standard_deviation) == pytest.approx(
        (wing.mean("servo_mass"), wing.standard_deviation("servo_mass"))
    )
    page = report.render_page(
        flown,
        [
            report.Drawing(figure.name, to_svg(figure.figure), figure.title, figure.caption)
            for figure in report.report_figures(flown, 0)
        ],
    )
    assert "The calibrated wing: Wing 7 (é)" in page
    assert "the model of another asset" not in page
    asset = asset | {"parameters": {"young_modulus_factor": 1.0}}
    other = replace(flown, config={"scenario": {**flown.scenario, "asset": asset}})
    away = report_calibration.calibration_view(other)
    assert away is not None
    assert away.true_value == 1.0
    page = " ".join(report.render_page(other, []).split())
    off = abs(1.0 - draws.mean()) / wing.standard_deviation("young_modulus_factor")
    words = f"The true Young modulus factor of the asset flown is 1, {off:.1f} standard deviations from the "
    assert words in page
    assert "the model of another asset" in page


def test_network_has_the_dependences_of_the_factors() -> None:
    parents: dict[tuple[str, int], set[tuple[str, int]]] = {}
    for edge in report_network.network_edges():
        parents.setdefault(edge.end, set()).add(edge.start)
    assert parents["D", 1] == {("D", 0), ("U", 0), ("O", 1)}
    assert parents["D", 2] == {("D", 1), ("U", 1)}
    assert parents["O", 1] == {("S", 1), ("U", 1)}
    assert parents["Q", 2] == {("D", 2), ("U", 2)}
    assert parents["R", 1] == {("D", 1), ("Q", 1), ("U", 1), ("O", 1)}
    assert parents["R", 3] == {("D", 3), ("Q", 3), ("U", 3)}
    assert ("U", 0) not in parents
    assert parents["U", 1] == {("D", 0)}
    assert parents["U", 2] == {("D", 1), ("D", 2)}
    flown = {(edge.start, edge.end) for edge in report_network.network_edges() if edge.flown}
    assert flown == {(("D", 0), ("U", 1)), (("D", 1), ("U", 2))}
    assert not {("O", 2), ("S", 2), ("O", 3), ("S", 3)} & set(report_network.network_nodes())


def test_nothing_is_drawn_outside_the_figure(record: report_data.RunRecord) -> None:
    for drawn in report.report_figures(record, 18):
        to_svg(drawn.figure)
        tight = drawn.figure.get_tightbbox()
        width, height = drawn.figure.get_size_inches()
        assert tight.x0 >= -0.01, drawn.name
        assert tight.y0 >= -0.01, drawn.name
        assert tight.x1 <= width + 0.01, drawn.name
        assert tight.y1 <= height + 0.01, drawn.name
