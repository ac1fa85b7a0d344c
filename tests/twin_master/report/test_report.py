"""The report shows what the run holds, copes with what it does not hold, and is reproducible."""

import errno
import html
import importlib.util
import json
import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from calibration.wing.result import CalibrationResult
from calibration.wing.wing_record import run_record
from reporting.errors import DiskFullError
from reporting.figures import to_svg
from twin_master.errors import RunFolderError
from twin_master.report import belief as report_belief
from twin_master.report import calibration as report_calibration
from twin_master.report import check as report_check
from twin_master.report import data as report_data
from twin_master.report import mission as report_mission
from twin_master.report import network as report_network
from twin_master.report import page as report
from twin_master.report import reading as report_reading
from twin_master.report.opening import opening_sentences
from twin_master.report.text import (
    check_caption,
    lost_ranges,
    mission_caption,
    network_caption,
    number,
    turn_ranges,
)
from twin_master.report.view import choose_sensors, default_now, short_number
from twin_master.run_folder import to_json

# The tests are no package, so the generator beside this file is loaded by its path.
_specification = importlib.util.spec_from_file_location(
    "synthetic_run", Path(__file__).with_name("synthetic_run.py")
)
assert _specification is not None
assert _specification.loader is not None
synthetic_run = importlib.util.module_from_spec(_specification)
_specification.loader.exec_module(synthetic_run)


@pytest.fixture(scope="module")
def tree() -> xr.DataTree:
    return synthetic_run.build_tree()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, tree: xr.DataTree) -> Path:
    return synthetic_run.write_run(tmp_path_factory.mktemp("runs") / "run", tree)


@pytest.fixture(scope="module")
def record(folder: Path) -> report_data.RunRecord:
    return report_reading.read_run(folder)


@pytest.fixture
def no_drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make figures and page, but do not render the figures, which takes most of the time."""
    monkeypatch.setattr(report, "to_svg", lambda figure: b'<svg viewBox="0 0 1 1"></svg>')
    monkeypatch.setattr(report, "to_png", lambda figure: b"")


def panel(figure: Figure, title: str) -> Axes:
    (found,) = [axes for axes in figure.axes if title in axes.get_title(loc="left")]
    return found


def line(axes: Axes, label: str) -> np.ndarray:
    (found,) = [item for item in axes.get_lines() if item.get_label() == label]
    return np.asarray(found.get_xydata())


def test_what_is_read_is_what_was_stored(record: report_data.RunRecord, tree: xr.DataTree) -> None:
    assert record.state_names == ("z1", "z2")
    assert record.controls == ("2g", "3g")
    assert record.rewards == ("health", "control", "error")
    assert (record.step_count, record.horizon) == (50, 10)
    assert_array_equal(record.sensors, np.arange(1, 25))
    assert_array_equal(record.filtered.probability, tree["filtered/probability"].values)
    assert record.predicted is not None
    assert_array_equal(record.predicted.mean, tree["predicted/mean"].values)
    assert_array_equal(record.observation, tree["observed/strain"].values)
    assert_array_equal(record.truth_state, tree["truth/state"].values)
    assert record.state_titles[0] == "stiffness loss of region 1"


def test_axes_stored_in_another_order_are_put_right(tmp_path: Path, tree: xr.DataTree) -> None:
    changed = tree.copy()
    changed["predicted"] = xr.DataTree(
        tree["predicted"].to_dataset().transpose("state", "horizon", "step", ...)
    )
    found = report_reading.read_run(synthetic_run.write_run(tmp_path / "run", changed))
    assert found.predicted is not None
    assert_array_equal(found.predicted.probability, tree["predicted/probability"].values)


@pytest.mark.parametrize("now", [0, 7, 18])
def test_smoothing_up_to_a_turn_equals_a_mission_that_ended_there(
    record: report_data.RunRecord, tmp_path: Path, now: int
) -> None:
    shorter = synthetic_run.build_tree(steps=now + 1)
    assert_array_equal(shorter["filtered/probability"].values, record.filtered.probability[: now + 1])
    found = report_data.smoothed_until(record, now)
    assert found is not None
    assert_allclose(found, shorter["smoothed/probability"].values, atol=1e-12)


def test_smoothing_up_to_the_last_turn_is_the_stored_one(record: report_data.RunRecord) -> None:
    found = report_data.smoothed_until(record, 49)
    assert found is not None
    assert record.smoothed is not None
    assert_allclose(found, record.smoothed.probability, atol=1e-12)


def test_without_a_configuration_the_past_is_the_filtered_one(record: report_data.RunRecord) -> None:
    bare = replace(record, config={})
    assert report_data.smoothed_until(bare, 20) is None
    past = line(panel(report_mission.mission_figure(bare, 20), "region 1"), "past")
    assert_allclose(past[:, 1], 100.0 * record.filtered.mean[:21, 0])


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


def test_the_page_begins_with_what_was_decided_believed_and_explained(record: report_data.RunRecord) -> None:
    decided, believed, explained = opening_sentences(record)
    assert decided == "The twin left 3g for 2g at turn 21."  # by a policy of both states
    mean, deviation = 100 * record.filtered.mean[-1, 0], 100 * record.filtered.standard_deviation[-1, 0]
    low, high = max(mean - 2 * deviation, 0.0), min(mean + 2 * deviation, 80.0)
    assert (
        f"puts the stiffness loss of region 1 at {mean:.1f} % ({low:.1f} to {high:.1f}, truth 60)" in believed
    )
    check = report_check.predictive_check(record)  # 150 µε of noise, 125 assumed
    assert check is not None
    assert f"{check.standard_deviation:.3g} times as far as it assumes" in explained
    assert " ".join(opening_sentences(record)) in " ".join(
        html.unescape(report.render_page(record, [])).replace("\N{NO-BREAK SPACE}", " ").split()
    )


def flown(record: report_data.RunRecord, *gentle: int, **changes: object) -> str:
    """The first sentence of a run that flew 2g at these turns."""
    control = np.ones(50, dtype=np.int64)
    control[list(gentle)] = 0
    policy = report_data.PolicyTable(np.where(record.coordinates[:, 0] > 0.59, 0, 1), None)
    changes = {"policy": policy, "control_index": control} | changes
    return opening_sentences(replace(record, **changes))[0]  # type: ignore[arg-type]


def test_the_first_sentence_follows_the_record(record: report_data.RunRecord) -> None:
    region = "the stiffness loss of region 1"
    reached = f"; {region} reached the 60 % from which the policy leaves 3g at turn 30."
    never = f"; {region} never reached the 60 % from which the policy leaves 3g."
    assert record.truth_state is not None
    healthy = np.zeros_like(record.truth_state)
    assert flown(record, *range(30, 50)).endswith(
        "at turn 30, when the stiffness loss of region 1 had reached 60 %."
    )
    assert flown(record) == f"The twin kept 3g at every turn{reached}"
    assert flown(record, truth_state=healthy) == f"The twin kept 3g at every turn{never}"
    assert flown(record, *range(12, 50)) == f"The twin left 3g for 2g at turn 12{reached}"
    again = flown(record, 33, *range(40, 50))
    assert again.endswith(
        "; the first change came 3 turns after the stiffness loss of region 1 had reached 60 %."
    )
    # of a real asset nothing is known but what was recorded
    watched = replace(record, config={**record.config, "watched": True}, truth_state=None, first_step=1000)
    assert flown(watched, *range(31, 50)) == "The asset left 3g for 2g at turn 1031."
    assert "truth" not in " ".join(opening_sentences(watched))
    assert flown(record, policy=None) == "The twin kept 3g at every turn."
    one = replace(record, controls=("3g",), control_index=np.zeros(50, dtype=np.int64))
    assert opening_sentences(one)[0] == "There was one control, 3g, and nothing to decide."


def test_the_last_sentence_judges_the_scatter(record: report_data.RunRecord) -> None:
    assert record.filtered.quantity is not None
    random, expected = np.random.default_rng(3), record.filtered.quantity.mean
    noise = np.full(expected.shape, 125e-6)
    known = replace(record, learnt_noise=noise, filtered=replace(
        record.filtered, quantity_standard_deviation=np.zeros_like(expected)
    ))  # fmt: skip
    draws = random.standard_normal(expected.shape)

    def last(scatter: np.ndarray) -> str:
        return opening_sentences(replace(known, observation=expected + noise * scatter))[-1]

    assert last(draws).startswith(
        "The twin's model explains the observations within the noise that it assumes: 9"
    )
    assert last(0.5 * draws).endswith("its intervals are wider than they need be.")
    assert last(2.0 * draws).endswith("the noise is larger, or the model is off.")
    draws[:, 6] += 1.4  # one gauge is off, and the others hide it
    assert "intervals, but" in last(draws)
    assert last(draws).endswith("% of those of gauge 7.")
    assert len(opening_sentences(replace(known, observation=None))) == 2


def test_what_was_learnt_and_many_states(record: report_data.RunRecord) -> None:
    course = np.tile([1.02, 0.004, 1.01, 1.03], (50, 1))
    learnt = report_data.LearntCourse("young_modulus_factor", "1", course, course[0], np.array(1.025))
    said = opening_sentences(replace(record, parameter_name=learnt.name, learnt=(learnt,)))[1]
    assert said.endswith("; it learnt the Young modulus factor: 1.020 (1.012 to 1.028, truth 1.025).")
    moments = (np.tile(part[:, :1], 6) for part in (record.filtered.mean, record.filtered.standard_deviation))
    mean, deviation = moments
    six = replace(
        record,
        state_names=tuple("abcdef"), state_titles=tuple("abcdef"), levels=record.levels[:1] * 6,
        state_units=("mm",) * 6, policy=None, truth_state=None,
        filtered=replace(record.filtered, mean=mean, standard_deviation=0.0 * deviation),
    )  # fmt: skip
    said = opening_sentences(six)[1]
    assert f"d at {mean[-1, 0]:.3g} mm (sure to the digit shown) and 2 other states as the figures" in said


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


@pytest.mark.usefixtures("no_drawing")
def test_another_model_is_told_before_anything_else(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "model differ" not in report.write_report(place).read_text(encoding="utf-8")
    origin = {"asset": "strain library", "twin_model": "reduced model", "asset_and_model_differ": True}
    (place / "summary.json").write_text(json.dumps(synthetic_run.summary() | origin))
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "differ: flown was the strain library, and the twin believes the reduced model." in text


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
        "exact": {"grid": list(grid), "density": list(np.exp(-0.5 * ((grid - 1.007) / 0.01) ** 2))},
        "data": {"load_N": [2.5, 5.0, 7.5], "displacement_m": [0.004, 0.008, 0.011]},
        "tip_stiffness_exact": {"mean": 681.1, "standard_deviation": 6.0, "unit": "N/m"},
    }
    view = report_calibration.calibration_view(replace(record, calibration=kept))
    assert view is not None
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
        {"exact": {"grid": [1.0]}},
        {"data": {"load_N": [1.0], "displacement_m": []}},
    ):
        assert report_calibration.calibration_view(replace(record, calibration=broken)) is not None
    fixed = replace(record, parameter_draws=np.ones(5))
    assert report_calibration.calibration_figure(report_calibration.calibration_view(fixed)).axes


def test_a_calibration_file_shows_its_wing(
    record: report_data.RunRecord, make_calibration: Callable[..., CalibrationResult]
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


def test_equal_runs_give_equal_bytes(folder: Path, tmp_path: Path, tree: xr.DataTree) -> None:
    other = synthetic_run.write_run(tmp_path / "elsewhere", tree)
    first, second = report.write_report(folder), report.write_report(other)
    contents = []
    for place in (folder, other):
        drawings = {path.name: path.read_bytes() for path in (place / "figures").iterdir()}
        contents.append((drawings, (place / "report.html").read_bytes()))
    assert contents[0] == contents[1]
    assert set(contents[0][0]) == {
        "mission_now.svg", "mission_now.png", "mission_whole.svg", "belief.svg", "policy.svg", "check.svg",
        "calibration.svg", "network.svg",
    }  # fmt: skip
    assert first.read_bytes() == second.read_bytes()


def test_the_page_needs_nothing_from_outside(folder: Path) -> None:
    text = report.write_report(folder).read_text(encoding="utf-8")
    assert "http://" not in text
    assert "https://" not in text
    assert text.count("<script>") == text.count("<script") == 1
    assert not re.search(r'(?:src|href)="(?!#|data:image/png;base64,)', text)
    assert not re.search(r"url\((?!#)", text)
    assert text.count("<figure") == 7
    assert str(folder) not in text
    assert re.search(r"largest tip displacement</td><td>0.18\sm<", text)
    assert re.search(r"largest strain error bound</td><td>1.2\sµε<", text)
    for word in ("Kapteyn", "seed 5", "policy leaves the first control from z1", "timing.json"):
        assert word in text


@pytest.mark.long
@pytest.mark.usefixtures("no_drawing")
def test_wall_clock_times_stay_out_of_the_page(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    before = report.write_report(place).read_bytes()
    (place / "timing.json").write_text('{"total_seconds": 4.321}')
    assert report.write_report(place).read_bytes() == before


@pytest.mark.long
@pytest.mark.usefixtures("no_drawing")
def test_figures_without_references_have_no_column_for_them(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    assert "source of the reference" in report.write_report(place).read_text(encoding="utf-8")
    content = json.loads((place / "summary.json").read_text(encoding="utf-8"))
    for figure in content["figures"]:
        figure["reference"] = None
    (place / "summary.json").write_text(json.dumps(content))
    assert "reference</th>" not in report.write_report(place).read_text(encoding="utf-8")


def test_the_caption_tells_the_decision_and_what_it_rests_on(
    record: report_data.RunRecord, tree: xr.DataTree, tmp_path: Path
) -> None:
    assert "twin decided" not in mission_caption(record, 18)  # not stored in this run
    probability = np.full((50, 2), [0.25, 0.75])
    changed = tree.copy()
    changed["filtered"] = xr.DataTree(
        tree["filtered"].to_dataset().assign(decision_probability=(("step", "control"), probability))
    )
    found = report_reading.read_run(synthetic_run.write_run(tmp_path / "run", changed))
    sentence = "At the end of turn 18 the twin decided on 3g for the next one"
    assert f"{sentence}: the policy asks for it with probability 0.75 in the state as just observed." in (
        mission_caption(found, 18)
    )
    scenario = {**found.scenario, "planner": {"gamma": 0.6, "decide_on": "predicted"}}
    ahead = replace(found, config={**found.config, "scenario": scenario})
    assert "in the state predicted for that turn." in mission_caption(ahead, 18)
    assert network_caption(ahead) != network_caption(found)


@pytest.mark.parametrize(
    "missing",
    [
        "truth", "smoothed", "policy", "calibration",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in (
                "predicted", "policy/action_value", "observed/strain", "truth/strain",
                "filtered/quantity_mean", "filtered/reward_mean", "predicted/quantity_mean",
                "predicted/control_probability", "filtered/log_evidence",
                "filtered/quantity_standard_deviation", "filtered/quantity_lower",
                "predicted/reward_standard_deviation",
            )
        ),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("no_drawing")
def test_a_missing_part_is_left_out(tmp_path: Path, tree: xr.DataTree, missing: str) -> None:
    part = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in tree.children})
    group, _, variable = missing.partition("/")
    if variable:
        part[group] = xr.DataTree(part[group].to_dataset().drop_vars(variable))
    else:
        del part[group]
    text = report.write_report(synthetic_run.write_run(tmp_path / "run", part)).read_text(encoding="utf-8")
    assert text.count("<figure") >= 4
    if missing == "truth":
        assert "truth" not in text.replace("the truth, which", "")
    if missing == "observed/strain":
        assert "holds no observations" in text


@pytest.mark.usefixtures("no_drawing")
def test_a_run_without_any_json_is_reported(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    for path in place.glob("*.json"):
        path.unlink()
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "<h1>level_turns</h1>" in text


@pytest.mark.long
@pytest.mark.parametrize(("steps", "horizon"), [(1, 10), (2, 0)])
def test_short_missions(tmp_path: Path, steps: int, horizon: int) -> None:
    short = synthetic_run.build_tree(steps=steps, horizon=horizon, sensors=5)
    text = report.write_report(synthetic_run.write_run(tmp_path / "run", short)).read_text(encoding="utf-8")
    assert f"{steps} turns" in text


@pytest.mark.usefixtures("no_drawing")
@pytest.mark.parametrize(
    ("steps", "horizon"),
    [(12, 10), *(pytest.param(*row, marks=pytest.mark.long) for row in ((2, 3), (3, 1), (4, 0)))],
)
def test_other_short_missions(tmp_path: Path, steps: int, horizon: int) -> None:
    test_short_missions(tmp_path, steps, horizon)


@pytest.mark.usefixtures("no_drawing")
def test_lost_gauges_are_told_and_marked(tmp_path: Path) -> None:
    place = synthetic_run.write_run(tmp_path / "run", synthetic_run.build_tree(lost=True))
    record = report_reading.read_run(place)
    assert lost_ranges(record) == "gauges 17, 18, 19, 20 at turns 12–18; all gauges at turns 3–4"
    text = report.write_report(place).read_text(encoding="utf-8")
    assert "the belief followed the dynamics alone" in text
    axes = panel(report_mission.mission_figure(record, 49, [16]), "Gauge 17")
    assert_array_equal(line(axes, "lost")[:, 0], [3, 4, *range(12, 19)])
    check = report_check.predictive_check(record)
    assert check is not None
    assert check.count[16] == 50 - 2 - 7


@pytest.mark.usefixtures("no_drawing")
def test_a_gauge_that_never_reports_and_a_run_without_any_observation(
    tmp_path: Path, tree: xr.DataTree
) -> None:
    for name, sensors in (("one", slice(4, 5)), ("all", slice(None))):
        changed = tree.copy(deep=True)
        changed["observed/strain"].values[:, sensors] = np.nan
        place = synthetic_run.write_run(tmp_path / name, changed)
        text = report.write_report(place).read_text(encoding="utf-8")
        assert "Observations lost" in text


@pytest.mark.parametrize("content", [b"", b"not a run", b"\x89HDF\r\n\x1a\n" + bytes(100), None])
def test_a_damaged_run_gives_one_sentence(folder: Path, tmp_path: Path, content: bytes | None) -> None:
    whole = (folder / "run.nc").read_bytes()
    (tmp_path / "run.nc").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(RunFolderError, match=r"damaged.* cannot be read") as caught:
        report.write_report(tmp_path)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "report.html").exists()


def test_a_folder_without_a_run_gives_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
        report.write_report(tmp_path)


@pytest.mark.parametrize(
    "missing", ["filtered", "filtered/probability", "observed", "observed/control_index"]
)
@pytest.mark.usefixtures("no_drawing")
def test_another_layout_gives_one_sentence(tmp_path: Path, tree: xr.DataTree, missing: str) -> None:
    part = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in tree.children})
    group, _, variable = missing.partition("/")
    if variable:
        part[group] = xr.DataTree(part[group].to_dataset().drop_vars(variable))
    else:
        del part[group]
    with pytest.raises(RunFolderError, match="layout of a run"):
        report.write_report(synthetic_run.write_run(tmp_path / "run", part))


def test_other_axes_give_one_sentence(tmp_path: Path, tree: xr.DataTree) -> None:
    changed = tree.copy()
    renamed = tree["filtered"].to_dataset().rename({"step": "time"})
    del changed["filtered"]
    changed["filtered"] = xr.DataTree(renamed)
    with pytest.raises(RunFolderError, match="probability has the axes"):
        report.write_report(synthetic_run.write_run(tmp_path / "run", changed))


def test_a_damaged_configuration_gives_one_sentence(tmp_path: Path, tree: xr.DataTree) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    for content in ('{"half": ', "[1]"):
        (place / "config.json").write_text(content)
        with pytest.raises(RunFolderError, match=r"config\.json"):
            report.write_report(place)


@pytest.mark.parametrize("now", [-1, 50])
def test_the_present_must_be_a_turn_of_the_run(folder: Path, now: int) -> None:
    with pytest.raises(RunFolderError, match=r"must lie in 0\.\.49"):
        report.write_report(folder, now=now)


@pytest.mark.usefixtures("no_drawing")
def test_a_full_disk_keeps_the_old_report(
    tmp_path: Path, tree: xr.DataTree, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = synthetic_run.write_run(tmp_path / "run", tree)
    (place / "report.html").write_text("old")

    def fail(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DiskFullError):
        report.write_report(place)
    assert (place / "report.html").read_text() == "old"
    assert list((place / "figures").iterdir()) == []


def test_words() -> None:
    assert turn_ranges([]) == "no turn"
    assert turn_ranges([4]) == "turn 4"
    assert turn_ranges([4, 5, 6, 9]) == "turns 4–6, 9"
    assert number(None) == "—"
    assert number(-0.123456) == "−0.12346"
    assert number(3) == "3"
    assert number(True) == "yes"


def test_nothing_is_drawn_outside_the_figure(record: report_data.RunRecord) -> None:
    for drawn in report.report_figures(record, 18):
        to_svg(drawn.figure)
        tight = drawn.figure.get_tightbbox()
        width, height = drawn.figure.get_size_inches()
        assert tight.x0 >= -0.01, drawn.name
        assert tight.y0 >= -0.01, drawn.name
        assert tight.x1 <= width + 0.01, drawn.name
        assert tight.y1 <= height + 0.01, drawn.name


def test_a_run_that_was_cut_off_anywhere_is_one_sentence(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "run.nc").read_bytes()
    (tmp_path / "config.json").write_bytes((folder / "config.json").read_bytes())
    for length in (1, 100, 2_000, len(whole) // 3, len(whole) - 10):
        (tmp_path / "run.nc").write_bytes(whole[:length])
        with pytest.raises(RunFolderError, match=r"damaged.*: resume the run or fly it again\.$"):
            report_reading.read_run(tmp_path)


def test_a_title_that_would_be_broken_mathematics(record: report_data.RunRecord, tmp_path: Path) -> None:
    titles = (r"loss of $\frac{1$", "loss $_{$ of region 2")
    sensors = tuple(f"gauge ${number}^" for number in record.sensors)
    for drawn in report.report_figures(replace(record, state_titles=titles, sensor_titles=sensors), 20):
        assert to_svg(drawn.figure)
