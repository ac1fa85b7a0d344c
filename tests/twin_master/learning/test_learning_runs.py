"""`[learning]` and `[notice]` in a scenario, and what a run leaves of them: store, summary, page."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.special import gammaln
from scipy.stats import invgamma

from scenarios import scenario_files
from tests.command_line import said
from tests.refusals import Inputs
from tests.twin_master.runs import changed_scenario, figures_of, flight_of, journal, of_wing, text_of, written
from twin_master.command import printed_value
from twin_master.errors import TwinMasterError
from twin_master.report.learnt import sensor_rows
from twin_master.report.page import render_page
from twin_master.report.reading import read_run
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.tables import Noticing
from twin_master.store.mission_result import MissionResult, printed_unit_of_quantity
from twin_master.viewer.flight import Flight
from uav_twin import fly, load_scenario, open_run, prepare_twin, report_figures

MOMENTS = ("mean", "standard_deviation", "lower", "upper")
STEPS = 9
SHORT = (
    ("steps = 50", f"steps = {STEPS}"),
    ("draws = 60", "draws = 8"),
    ("count = 24\n", "count = 24\nbetween_levels = false\n"),
)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    offsets = [50.0] * 23 + [0.0]
    learnt = f"gauge_gain_percent = 2\ngauge_offset_microstrain = {offsets}\n"
    learnt += "transition_factors = [0.5, 1, 2]\n"
    text = text_of("level_turns_learning", *SHORT, ("[learning]\n", "[learning]\n" + learnt))
    return written(tmp_path_factory.mktemp("learnt"), text)


@pytest.fixture(scope="module")
def folder(scenario: Path) -> Path:
    run = scenario.parent / "run"
    (scenario.parent / "said.json").write_text(said("run", scenario, "--out", run, "--no-report", "--json"))
    return run


@pytest.fixture(scope="module")
def learnt(folder: Path) -> xr.Dataset:
    return open_run(folder)["learnt"].to_dataset()


def test_the_store_holds_what_the_twin_said_in_every_step(folder, learnt):
    lines = [line["learnt"] for line in journal(folder)]
    assert len(lines) == STEPS
    assert len(lines[0]) == 1 + 1 + 24 + 24 + 23  # parameter, transitions, noise, gain, offset
    for name in lines[0]:
        base, _, sensor = name.rstrip("]").partition("[")
        for moment in MOMENTS:
            kept = learnt[f"{base}_{moment}"]
            told = [line[name][moment] for line in lines]
            np.testing.assert_array_equal(kept.sel(sensor=int(sensor)) if sensor else kept, told)
    assert np.isnan(learnt["gauge_offset_mean"].sel(sensor=24)).all()
    assert learnt["gauge_offset_prior_upper"].sel(sensor=1) > 0
    for variable in learnt.data_vars.values():
        assert variable.attrs["units"] == "1"  # strains and factors
        assert variable.attrs["long_name"]


def test_prior_and_truth_are_those_of_the_scenario(learnt, folder):
    run = open_run(folder)
    draws = run["calibration"]["draw_value"].values
    mean, wide = (learnt[f"young_modulus_factor_prior_{name}"].item() for name in MOMENTS[:2])
    assert mean == pytest.approx(draws.mean(), abs=0.1 * draws.std())  # between the draws as well
    assert wide == pytest.approx(draws.std(), rel=0.1)
    assert float(learnt["transition_factor_prior_mean"]) == pytest.approx(3.5 / 3)
    # lambda² ~ inverse gamma(5, 5); gain | lambda ~ N(0, (0.02 lambda)²), whose variance is 0.02² E[lambda²]
    squared = invgamma(5.0, scale=5.0)
    noise = [float(learnt[f"noise_scale_prior_{moment}"].sel(sensor=7)) for moment in MOMENTS]
    mean = np.sqrt(5.0) * np.exp(gammaln(4.5) - gammaln(5.0))
    wide = np.sqrt(squared.mean() - mean**2)
    np.testing.assert_allclose(noise, [mean, wide, *np.sqrt(squared.ppf([0.05, 0.95]))], rtol=1e-10)
    gain = float(learnt["gauge_gain_prior_standard_deviation"].sel(sensor=7))
    assert gain == pytest.approx(0.02 * np.sqrt(squared.mean()))
    truth = run["truth"].to_dataset()
    assert float(truth["young_modulus_factor"]) == 0.95
    np.testing.assert_allclose(truth["noise_scale"], 150 / 125)
    np.testing.assert_array_equal(truth["gauge_gain"], 0.0)
    assert "transition_factor" not in truth  # scripted damage has no probability


@pytest.mark.parametrize(("faster", "truth"), [({"2g": 0.1, "3g": 0.2}, 2.0), ({"2g": 0.1, "3g": 0.1}, None)])
def test_the_true_factor_is_that_of_the_true_probabilities(faster, truth):
    learning = {"parameter": False, "noise": False, "transition_factors": [1.0, 2.0]}
    changes = {"learning": learning, "truth": {"probability": faster}, "mission": {"steps": 2}}
    known, source = of_wing(changed_scenario("growing_damage", changes | {"notice": False}).scenario)
    (factor,) = MissionResult(known.scenario, known, flight_of(known, source), known.truth(3)).learnt
    assert (factor.name, factor.truth) == ("transition_factor", truth)


def test_the_summary_says_what_was_learnt_and_what_was_believed_before(scenario, folder, learnt):
    summary = json.loads((folder / "summary.json").read_text())
    figures = {figure["key"]: figure for figure in summary["figures"]}
    assert tuple(figures) == load_scenario(scenario).scenario.figure_names
    assert figures["young_modulus_factor_mean"]["value"] == learnt["young_modulus_factor_mean"].values[-1]
    assert figures["young_modulus_factor_mean"]["title"] == "Young modulus factor learnt, mean"
    assert figures["young_modulus_factor_prior_mean"]["value"] == pytest.approx(1.0)
    assert figures["young_modulus_factor_true"]["value"] == 0.95
    assert figures["noise_scale_mean"]["value"] == learnt["noise_scale_mean"].values[-1].mean()
    last = learnt.isel(step=-1)
    most = int(np.argmax(abs(last["gauge_gain_mean"].values) / last["gauge_gain_standard_deviation"].values))
    assert figures["gauge_gain_most"]["title"] == f"gain error learnt, gauge {most + 1} (departs most)"
    assert figures["gauge_gain_most"]["value"] == pytest.approx(100 * last["gauge_gain_mean"].values[most])
    told = json.loads((folder.parent / "said.json").read_text())
    assert told["learnt"] == summary["learnt"]
    noise = summary["learnt"]["noise_scale"]
    assert noise["posterior"]["upper"] == last["noise_scale_upper"].values.tolist()
    assert noise["truth"] == [1.2] * 24
    assert summary["learnt"]["gauge_offset"]["posterior"]["mean"][23] is None


def test_the_report_draws_and_lists_what_was_learnt(folder, learnt):
    record, drawn = read_run(folder), {figure.name: figure for figure in report_figures(folder)}
    figure = drawn["learnt"].figure
    assert len(figure.axes) == 2 + 3 * 2
    parameter = figure.axes[0]
    np.testing.assert_array_equal(parameter.get_lines()[0].get_ydata(), learnt["young_modulus_factor_mean"])
    assert parameter.get_lines()[-1].get_ydata()[0] == 0.95  # the truth
    sensors = sensor_rows(record)
    assert len(sensors) == 24
    assert sensors[23].count("—") == 1  # the offset
    text = render_page(record, dict.fromkeys(drawn, b'<svg viewBox="0 0 1 1"></svg>'), drawn)
    assert "0.05 in 2g and 0.1 in 3g" in text
    assert re.search(r">Young modulus factor</td>.*>Factor on the transitions</td>", text, re.DOTALL)
    assert re.search(r"it learnt the Young modulus factor: [\d.]+ \([\d.]+ to [\d.]+, truth 0\.95\)\.", text)
    assert "posterior mean of the Young" not in text


def test_the_view_shows_what_was_learnt(folder):
    """From the posterior of each quantity alone, which the journal tells."""
    flight, run = Flight(folder), open_run(folder)
    filtered = run["filtered"].to_dataset()
    flight.update()
    shown = flight.beliefs_in(flight.records_of_steps(0, STEPS)).expected
    noise = filtered["noise_standard_deviation"].values
    wide = np.hypot(noise, filtered["quantity_standard_deviation"].values)
    np.testing.assert_allclose(np.hypot(shown.standard_deviation, shown.noise), wide, rtol=0.1)
    np.testing.assert_allclose(shown.reward_mean, filtered["reward_mean"].values, atol=0.03)
    ahead = flight.prediction_after(flight.records_of_steps(STEPS - 1, STEPS)[0]).expected.mean
    assert np.abs((ahead - run["predicted"]["quantity_mean"].values[-1]) / noise[-1]).max() < 0.06

    def off() -> float:
        error = (
            flight.beliefs_in(flight.records_of_steps(0, STEPS)).expected.mean
            - filtered["quantity_mean"].values
        )
        return float(np.abs(error / noise).max())

    residual = (run["observed"]["strain"].values - filtered["quantity_mean"].values) / noise
    np.testing.assert_allclose(residual, filtered["residual"].values)
    learnt = off()
    flight.knowledge.__dict__["expectation"] = None
    assert learnt < 0.06 < 0.3 < off()  # as calibrated


def test_a_watch_keeps_the_last_steps_of_what_it_learnt(scenario, folder, learnt):
    out = folder.parent / "watch"
    said("watch", scenario, "--observations", folder, "--out", out, "--no-report", "--last", 4)
    watched = open_run(out)["learnt"].to_dataset()
    assert watched["step"].values.tolist() == [5, 6, 7, 8]
    for name, flown in learnt.data_vars.items():
        tail = flown.isel(step=slice(5, None)) if "step" in flown.dims else flown
        np.testing.assert_array_equal(watched[name].values, tail.values)


TEXT = text_of("level_turns_learning")


def test_more_transitions_than_there_can_be_are_refused(tmp_path):
    file = written(tmp_path, TEXT, ("noise_degrees = 10 ", "transition_factors = [1.0, 11.0] "))
    knowledge = prepare_twin(load_scenario(file))
    with pytest.raises(TwinMasterError, match=r"smaller `learning.transition_factors`"):
        knowledge.twin()


def test_offsets_of_sensors_of_several_units_have_their_own(tmp_path):
    """And no mean: that of litres a minute, newton metres, degrees and bars says nothing."""
    given: dict[str, Any] = {"mission": {"steps": 2}, "calibration": {"draws": 4}}
    given |= {"learning": {"gauge_offset": [0.5, 0.4, 1.0, 0.1]}}
    plain = changed_scenario("pump_wear", given | {"observation": {"unit": "1"}})  # which is not a strain
    assert printed_unit_of_quantity("gauge_offset", "1", plain.scenario) == (1.0, "")
    fly(changed_scenario("pump_wear", given), tmp_path, report=False)
    summary, units = json.loads((tmp_path / "summary.json").read_text()), ["L/min", "N.m", "degC", "bar"]
    told = {figure["key"]: figure for figure in summary["figures"]}
    most = told["gauge_offset_most"]
    assert most["unit"] == units[int(re.search(r"sensor (\d)", most["title"])[1]) - 1]
    assert told["gauge_offset_mean"]["value"] is None
    assert summary["learnt"]["gauge_offset"]["unit"] == units
    learnt = journal(tmp_path)[-1]["learnt"]
    assert [learnt[f"gauge_offset[{number}]"]["unit"] for number in range(1, 5)] == units


def test_notices_are_on_in_every_file_that_does_not_step_them_off(tmp_path):
    assert dict(Noticing()) == vars(Noticing())
    for name in scenario_files():
        loaded = load_scenario(name)
        # what two measure is the filter alone, and inspections stand beside what notices watch
        off = name in ("paper_level_turns", "model_mismatch", "inspected_wing")
        assert loaded.scenario.notice == (None if off else Noticing()), name
        assert not loaded.remark
        kept = loaded.scenario.to_dict()
        assert (kept["notice"] is None) is off
        assert parse_scenario(kept, name) == loaded.scenario  # as a run folder says it
        assert loaded.scenario.mission.name == name
    for name, searched in (("watched_wing", True), ("three_regions", False), ("pump_wear", False)):
        assert load_scenario(name).scenario.searchable is searched  # causes are looked for in wings alone
    of_its_own = ("[transition]", 'average_over_draws = "inside"\n[transition]')
    levels = "[0, 20, 40, 60, 80]\nprior = [1, 0, 0, 0, 0]"
    many = [(levels, f"{[*range(90)]}\nprior = {[1] + [0] * 89}")] * 2
    for changes, remark in (
        ([of_its_own], "each sensor has a parameter of"),
        (many, "they take 11,664,000 numbers a step, more than 1,000,000"),
    ):
        text = text_of("level_turns", *changes)
        loaded = load_scenario(written(tmp_path, text))
        assert loaded.scenario.notice is None
        assert remark in loaded.remark
        assert not load_scenario(written(tmp_path, text, ("format = 2", "format = 2\nnotice = false"))).remark
    asked = text_of("level_turns", of_its_own) + "[notice]\n"
    with pytest.raises(TwinMasterError, match=r"`notice` needs `observation.average_over_draws` `outside`"):
        load_scenario(written(tmp_path, asked))


def test_what_was_noticed_is_the_same_on_console_in_journal_store_summary_and_report(tmp_path):
    faults = ("# What the figures", Inputs(__file__).text("faults.toml") + "# What the figures")
    spoilt, noticed = written(tmp_path, TEXT, *SHORT, faults), tmp_path / "run"
    console = said("run", spoilt, "--out", noticed, "--no-report")
    assert printed_value(123_456, "") == "123456"  # a step has all of its digits
    alarm = next(line for line in console.splitlines() if line.startswith("Step ") and "gauge 5" in line)
    assert "gauge 5 shows too much, or the asset near it" in alarm
    assert ", since about step 2 (" in alarm
    search = f"; to find the cause: uav-twin discrepancy run --from-run {noticed} --from-step 2"
    assert alarm.endswith(f"alarm from 100){search}")
    assert "Step 3: gauge 12 shows 1e+14 microstrain, and no state can show less than" in console

    notices = json.loads((noticed / "summary.json").read_text())["notices"]
    assert {n["kind"] for n in notices} == {"gauge_left_out", "alarm", "hypothesis"}
    assert {(n["kind"], *n["sensors"]) for n in notices} >= {("gauge_left_out", 12), ("alarm", 5)}
    lines = journal(noticed)
    assert [{"step": line["step"]} | n for line in lines for n in line.get("notices", ())] == notices
    kept = open_run(noticed)["notice"].to_dataset()
    for name, values in kept.data_vars.items():
        assert [line["suspicion"][name] for line in lines] == values.values.tolist()
    np.testing.assert_array_equal(kept["left_out"].sel(sensor=12), [0, 0, 0, 1, 1, 1, 1, 1, 1])
    figures = figures_of(noticed)
    assert figures["alarm_step"] == next(n["step"] for n in notices if n["kind"] == "alarm")
    assert figures["gauge_off"] == kept["gauge_off"].values[-1]
    decided = [line["suspicion"]["decided_by"] for line in lines]
    assert figures["decided_by"] == decided[-1]
    assert decided[0] == "model"
    assert "gauge 5 off" in decided
    told = lines[-1]["suspicion"]["hypotheses"]
    assert told["none of these"] == pytest.approx(kept["none_of_these"].values[-1], rel=1e-12)
    assert sum(told.values()) == pytest.approx(1.0, abs=0.03)

    report = render_page(read_run(noticed), {}, {})
    assert "gauge 5 shows too much" in report
    assert f"what decides its control is: {figures['decided_by']}" in report
    assert "gauge 12 shows 1e+14 microstrain" in report
