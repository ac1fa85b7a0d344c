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
from tests.twin_master.report.conftest import page_of
from tests.twin_master.runs import changed_scenario, figures_of, flight_of, journal, of_wing, text_of, written
from twin_master.command import printed_value
from twin_master.errors import TwinMasterError
from twin_master.report.learnt import sensor_rows
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
    printed = said("run", scenario, "--out", run, "--no-report", "--json")
    (scenario.parent / "said.json").write_text(printed)
    return run


@pytest.fixture(scope="module")
def stored(folder: Path) -> xr.DataTree:
    """The store of the run."""
    return open_run(folder)


@pytest.fixture(scope="module")
def learnt(stored: xr.DataTree) -> xr.Dataset:
    return stored["learnt"].to_dataset()


@pytest.fixture(scope="module")
def learnt_lines(folder: Path) -> list[dict[str, Any]]:
    """What the journal says in each step of what was learnt."""
    return [line["learnt"] for line in journal(folder)]


def test_the_journal_has_each_learnt_quantity_in_every_step(learnt_lines):
    parameter, transitions, noises, gains, offsets = 1, 1, 24, 24, 23
    assert len(learnt_lines) == STEPS
    assert len(learnt_lines[0]) == parameter + transitions + noises + gains + offsets


def test_the_store_holds_what_the_twin_said_in_every_step(learnt, learnt_lines):
    for name in learnt_lines[0]:
        quantity, _, sensor = name.rstrip("]").partition("[")
        for moment in MOMENTS:
            stored = learnt[f"{quantity}_{moment}"]
            course = stored.sel(sensor=int(sensor)) if sensor else stored
            journalled = [line[name][moment] for line in learnt_lines]
            np.testing.assert_array_equal(course, journalled)


def test_a_gauge_without_a_deviation_of_its_offset_learns_none(learnt):
    assert np.isnan(learnt["gauge_offset_mean"].sel(sensor=24)).all()
    assert learnt["gauge_offset_prior_upper"].sel(sensor=1) > 0


def test_learnt_variables_have_units_and_names(learnt):
    """Strains and factors have no unit."""
    assert {variable.attrs["units"] for variable in learnt.data_vars.values()} == {"1"}
    assert all(variable.attrs["long_name"] for variable in learnt.data_vars.values())


def test_the_prior_of_the_parameter_is_that_of_its_draws(learnt, stored):
    """States between the draws are believed as well."""
    draws = stored["calibration"]["draw_value"].values
    mean = learnt["young_modulus_factor_prior_mean"].item()
    standard_deviation = learnt["young_modulus_factor_prior_standard_deviation"].item()
    assert mean == pytest.approx(draws.mean(), abs=0.1 * draws.std())
    assert standard_deviation == pytest.approx(draws.std(), rel=0.1)


def test_the_prior_of_the_transitions_is_the_mean_of_their_factors(learnt):
    assert float(learnt["transition_factor_prior_mean"]) == pytest.approx(3.5 / 3)


SQUARED_SCALE = invgamma(5.0, scale=5.0)
"""The square of the scale lambda of the noise is distributed as an inverse gamma(5, 5)."""


def test_the_prior_of_the_noise_is_that_of_an_inverse_gamma(learnt):
    prior = [float(learnt[f"noise_scale_prior_{moment}"].sel(sensor=7)) for moment in MOMENTS]
    mean = np.sqrt(5.0) * np.exp(gammaln(4.5) - gammaln(5.0))
    standard_deviation = np.sqrt(SQUARED_SCALE.mean() - mean**2)
    interval = np.sqrt(SQUARED_SCALE.ppf([0.05, 0.95]))
    np.testing.assert_allclose(prior, [mean, standard_deviation, *interval], rtol=1e-10)


def test_the_prior_of_a_gain_scales_with_the_noise(learnt):
    """gain | lambda ~ N(0, (0.02 lambda)²), whose variance is 0.02² E[lambda²]."""
    standard_deviation = float(learnt["gauge_gain_prior_standard_deviation"].sel(sensor=7))
    assert standard_deviation == pytest.approx(0.02 * np.sqrt(SQUARED_SCALE.mean()))


def test_the_truth_is_that_of_the_scenario(stored):
    truth = stored["truth"].to_dataset()
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


@pytest.fixture(scope="module")
def summary(folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return record


@pytest.fixture(scope="module")
def figures(summary: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The figures of the summary by their keys."""
    return {figure["key"]: figure for figure in summary["figures"]}


def test_the_summary_has_the_figures_that_the_scenario_names(figures, scenario):
    assert tuple(figures) == load_scenario(scenario).scenario.summary_keys


def test_the_summary_says_what_was_learnt_of_the_parameter(figures, learnt):
    figure = figures["young_modulus_factor_mean"]
    assert figure["value"] == learnt["young_modulus_factor_mean"].values[-1]
    assert figure["title"] == "Young modulus factor learnt, mean"


def test_the_summary_says_what_was_believed_before_and_what_is_true(figures):
    assert figures["young_modulus_factor_prior_mean"]["value"] == pytest.approx(1.0)
    assert figures["young_modulus_factor_true"]["value"] == 0.95


def test_the_summary_has_the_mean_of_the_noise_of_all_gauges(figures, learnt):
    assert figures["noise_scale_mean"]["value"] == learnt["noise_scale_mean"].values[-1].mean()


def test_the_summary_names_the_gauge_whose_gain_departs_most(figures, learnt):
    last = learnt.isel(step=-1)
    gain = last["gauge_gain_mean"].values
    departure = abs(gain) / last["gauge_gain_standard_deviation"].values
    gauge = int(np.argmax(departure))
    figure = figures["gauge_gain_most"]
    assert figure["title"] == f"gain error learnt, gauge {gauge + 1} (departs most)"
    assert figure["value"] == pytest.approx(100 * gain[gauge])


def test_the_command_prints_what_the_summary_says_was_learnt(folder, summary):
    printed = json.loads((folder.parent / "said.json").read_text())
    assert printed["learnt"] == summary["learnt"]


def test_the_summary_has_each_gauge_with_its_truth(summary, learnt):
    noise = summary["learnt"]["noise_scale"]
    offset = summary["learnt"]["gauge_offset"]
    assert noise["posterior"]["upper"] == learnt["noise_scale_upper"].values[-1].tolist()
    assert noise["truth"] == [1.2] * 24
    assert offset["posterior"]["mean"][23] is None


@pytest.fixture(scope="module")
def report_of_run(folder: Path) -> Any:
    """What the report reads of the run."""
    return read_run(folder)


@pytest.fixture(scope="module")
def drawn(folder: Path) -> dict[str, Any]:
    """The figures of the report by their names."""
    return {figure.name: figure for figure in report_figures(folder)}


def test_the_report_draws_what_was_learnt(drawn, learnt):
    figure = drawn["learnt"].figure
    course, *_, truth = figure.axes[0].get_lines()
    assert len(figure.axes) == 2 + 3 * 2
    np.testing.assert_array_equal(course.get_ydata(), learnt["young_modulus_factor_mean"])
    assert truth.get_ydata()[0] == 0.95


def test_the_report_lists_what_was_learnt_of_each_gauge(report_of_run):
    """Of the last gauge no offset was learnt."""
    rows = sensor_rows(report_of_run)
    assert len(rows) == 24
    assert rows[23].count("—") == 1


@pytest.fixture(scope="module")
def page(report_of_run: Any, drawn: dict[str, Any]) -> str:
    return page_of(report_of_run, *drawn)


def test_the_report_lists_what_was_learnt_of_parameter_and_transitions(page):
    rows = re.compile(r">Young modulus factor</td>.*>Factor on the transitions</td>", re.DOTALL)
    assert "0.05 in 2g and 0.1 in 3g" in page
    assert rows.search(page)


def test_the_report_begins_with_what_was_learnt(page):
    opening = r"it learnt the Young modulus factor: [\d.]+ \([\d.]+ to [\d.]+, truth 0\.95\)\."
    assert re.search(opening, page)
    assert "posterior mean of the Young" not in page


class View:
    """The run as its view shows it, from the posterior of each quantity alone, which the journal has."""

    def __init__(self, folder: Path, stored: xr.DataTree) -> None:
        self.flight = Flight(folder)
        self.flight.update()
        self.filtered = stored["filtered"].to_dataset()
        self.mean = self.filtered["quantity_mean"].values
        self.noise = self.filtered["noise_standard_deviation"].values

    def expected(self) -> Any:
        """Return what the view expects the gauges to read in all steps."""
        return self.flight.beliefs_in(self.flight.records_of_steps(0, STEPS)).expected

    def largest_error(self) -> float:
        """Return the largest error of the shown means, in standard deviations of the noise."""
        return float(np.abs((self.expected().mean - self.mean) / self.noise).max())


@pytest.fixture
def view(folder: Path, stored: xr.DataTree) -> View:
    return View(folder, stored)


def test_the_view_shows_the_standard_deviations_and_rewards_of_the_store(view):
    shown = view.expected()
    stored_deviation = np.hypot(view.noise, view.filtered["quantity_standard_deviation"].values)
    shown_deviation = np.hypot(shown.standard_deviation, shown.noise_standard_deviation)
    np.testing.assert_allclose(shown_deviation, stored_deviation, rtol=0.1)
    np.testing.assert_allclose(shown.reward_mean, view.filtered["reward_mean"].values, atol=0.03)


def test_the_view_predicts_what_the_store_does(view, stored):
    last = view.flight.records_of_steps(STEPS - 1, STEPS)[0]
    shown = view.flight.prediction_after(last).expected.mean
    predicted = stored["predicted"]["quantity_mean"].values[-1]
    assert np.abs((shown - predicted) / view.noise[-1]).max() < 0.06


def test_a_stored_residual_is_the_reading_minus_its_mean_over_the_noise(view, stored):
    residual = (stored["observed"]["strain"].values - view.mean) / view.noise
    np.testing.assert_allclose(residual, view.filtered["residual"].values)


def test_the_view_shows_what_was_learnt_and_not_what_was_calibrated(view):
    error_as_learnt = view.largest_error()
    view.flight.knowledge.__dict__["expectation"] = None
    error_as_calibrated = view.largest_error()
    assert error_as_learnt < 0.06 < 0.3 < error_as_calibrated


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


PUMP_UNITS = ["L/min", "N.m", "degC", "bar"]
PUMP_OFFSETS: dict[str, Any] = {
    "mission": {"steps": 2},
    "calibration": {"draws": 4},
    "learning": {"gauge_offset": [0.5, 0.4, 1.0, 0.1]},
}


@pytest.fixture(scope="module")
def pump_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of two steps of a pump that learns offsets of four sensors in four units."""
    folder = tmp_path_factory.mktemp("pump")
    fly(changed_scenario("pump_wear", PUMP_OFFSETS), folder, report=False)
    return folder


def test_an_offset_of_a_quantity_without_unit_is_printed_without_one():
    no_strain = changed_scenario("pump_wear", PUMP_OFFSETS | {"observation": {"unit": "1"}})
    assert printed_unit_of_quantity("gauge_offset", "1", no_strain.scenario) == (1.0, "")


def test_the_offset_that_departs_most_has_the_unit_of_its_sensor(pump_run):
    summary = json.loads((pump_run / "summary.json").read_text())
    figure = next(row for row in summary["figures"] if row["key"] == "gauge_offset_most")
    sensor = int(re.search(r"sensor (\d)", figure["title"])[1])
    assert figure["unit"] == PUMP_UNITS[sensor - 1]


def test_offsets_of_sensors_of_several_units_have_no_mean(pump_run):
    """A mean of litres a minute, newton metres, degrees and bars says nothing."""
    assert figures_of(pump_run)["gauge_offset_mean"] is None


def test_offsets_of_sensors_of_several_units_have_their_own(pump_run):
    summary = json.loads((pump_run / "summary.json").read_text())
    last = journal(pump_run)[-1]["learnt"]
    assert summary["learnt"]["gauge_offset"]["unit"] == PUMP_UNITS
    assert [last[f"gauge_offset[{number}]"]["unit"] for number in range(1, 5)] == PUMP_UNITS


WITHOUT_NOTICES = ("paper_level_turns", "model_mismatch", "inspected_wing")
"""Two of them measure what the filter alone does; inspections stand beside what notices watch."""


def test_notices_have_the_defaults_of_their_table():
    assert dict(Noticing()) == vars(Noticing())


@pytest.mark.parametrize("name", scenario_files())
def test_notices_are_on_in_every_file_that_does_not_turn_them_off(name):
    loaded = load_scenario(name)
    assert loaded.scenario.notice == (None if name in WITHOUT_NOTICES else Noticing())
    assert not loaded.remark


@pytest.mark.parametrize("name", scenario_files())
def test_a_run_folder_keeps_a_scenario_with_its_notices(name):
    scenario = load_scenario(name).scenario
    kept = scenario.to_dict()
    assert (kept["notice"] is None) is (name in WITHOUT_NOTICES)
    assert parse_scenario(kept, name) == scenario
    assert scenario.mission.name == name


@pytest.mark.parametrize(
    ("name", "searchable"), [("watched_wing", True), ("three_regions", False), ("pump_wear", False)]
)
def test_causes_are_looked_for_in_wings_alone(name, searchable):
    assert load_scenario(name).scenario.searchable is searchable


AVERAGE_INSIDE = ("[transition]", 'average_over_draws = "inside"\n[transition]')
FIVE_LEVELS = "[0, 20, 40, 60, 80]\nprior = [1, 0, 0, 0, 0]"
NINETY_LEVELS = (FIVE_LEVELS, f"{[*range(90)]}\nprior = {[1] + [0] * 89}")


@pytest.mark.parametrize(
    ("changes", "remark"),
    [
        ([AVERAGE_INSIDE], "each sensor has a parameter of"),
        ([NINETY_LEVELS] * 2, "they take 11,664,000 numbers a step, more than 1,000,000"),
    ],
    ids=["averages within the likelihood", "many levels"],
)
def test_notices_that_cannot_be_given_are_off_with_a_remark(tmp_path, changes, remark):
    text = text_of("level_turns", *changes)
    loaded = load_scenario(written(tmp_path, text))
    turned_off = written(tmp_path, text, ("format = 2", "format = 2\nnotice = false"))
    assert loaded.scenario.notice is None
    assert remark in loaded.remark
    assert not load_scenario(turned_off).remark


def test_notices_that_cannot_be_given_and_are_asked_for_are_refused(tmp_path):
    asked_for = text_of("level_turns", AVERAGE_INSIDE) + "[notice]\n"
    sentence = r"`notice` needs `observation.average_over_draws` `outside`"
    with pytest.raises(TwinMasterError, match=sentence):
        load_scenario(written(tmp_path, asked_for))


class NoticedRun:
    """A run in which gauge 5 drifts, and gauge 12 shows absurd values from step 3 on."""

    def __init__(self, folder: Path) -> None:
        end = "# What the figures"
        faults = Inputs(__file__).text("faults.toml")
        spoilt = written(folder, TEXT, *SHORT, (end, faults + end))
        self.folder = folder / "run"
        self.console = said("run", spoilt, "--out", self.folder, "--no-report")
        self.lines = journal(self.folder)
        self.notices = json.loads((self.folder / "summary.json").read_text())["notices"]
        self.store = open_run(self.folder)["notice"].to_dataset()
        self.figures = figures_of(self.folder)


@pytest.fixture(scope="module")
def noticed(tmp_path_factory: pytest.TempPathFactory) -> NoticedRun:
    return NoticedRun(tmp_path_factory.mktemp("noticed"))


def test_a_large_whole_number_is_printed_with_all_digits():
    """The number of a step is one."""
    assert printed_value(123_456, "") == "123456"


def test_the_console_says_what_an_alarm_is_of_and_how_its_cause_is_found(noticed):
    lines = noticed.console.splitlines()
    alarm = next(line for line in lines if line.startswith("Step ") and "gauge 5" in line)
    command = f"uav-twin discrepancy run --from-run {noticed.folder} --from-step 2"
    assert "gauge 5 shows too much, or the asset near it" in alarm
    assert ", since about step 2 (" in alarm
    assert alarm.endswith(f"alarm from 100); to find the cause: {command}")


def test_the_console_says_that_a_gauge_shows_what_no_state_can_show(noticed):
    sentence = "Step 3: gauge 12 shows 1e+14 microstrain, and no state can show less than"
    assert sentence in noticed.console


def test_the_summary_has_the_notices_of_both_gauges(noticed):
    of_gauges = {(notice["kind"], *notice["sensors"]) for notice in noticed.notices}
    kinds = {notice["kind"] for notice in noticed.notices}
    assert kinds == {"gauge_left_out", "alarm", "hypothesis", "advice"}
    assert of_gauges >= {("gauge_left_out", 12), ("alarm", 5)}


def test_the_journal_has_the_notices_of_the_summary(noticed):
    journalled = [
        {"step": line["step"]} | notice for line in noticed.lines for notice in line.get("notices", ())
    ]
    assert journalled == noticed.notices


def test_the_store_has_the_suspicions_of_the_journal(noticed):
    for name, stored in noticed.store.data_vars.items():
        journalled = [line["suspicion"][name] for line in noticed.lines]
        np.testing.assert_allclose(journalled, stored.values, rtol=1e-9, atol=1e-10)


def test_the_store_says_from_when_on_a_gauge_is_left_out(noticed):
    left_out = noticed.store["left_out"].sel(sensor=12)
    np.testing.assert_array_equal(left_out, [0, 0, 0, 1, 1, 1, 1, 1, 1])


def test_the_figures_of_a_run_are_those_of_its_notices(noticed):
    alarm = next(notice for notice in noticed.notices if notice["kind"] == "alarm")
    assert noticed.figures["alarm_step"] == alarm["step"]
    assert noticed.figures["gauge_off"] == noticed.store["gauge_off"].values[-1]


def test_the_model_decides_until_a_gauge_is_believed_to_be_off(noticed):
    deciding = [line["suspicion"]["decided_by"] for line in noticed.lines]
    assert noticed.figures["decided_by"] == deciding[-1]
    assert deciding[0] == "model"
    assert "gauge 5 off" in deciding


def test_the_journal_has_the_probability_of_each_hypothesis(noticed):
    probability = noticed.lines[-1]["suspicion"]["hypotheses"]
    stored = noticed.store["none_of_these"].values[-1]
    assert probability["none of these"] == pytest.approx(stored, abs=1e-10)
    assert sum(probability.values()) == pytest.approx(1.0, abs=0.03)


def test_the_report_says_what_was_noticed(noticed):
    report = page_of(read_run(noticed.folder))
    assert "gauge 5 shows too much" in report
    assert f"what decides its control is: {noticed.figures['decided_by']}" in report
    assert "gauge 12 shows 1e+14 microstrain" in report
