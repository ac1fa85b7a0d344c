"""`[learning]` and `[notice]` in a scenario: what is read and refused, and what a run leaves of notices."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from scenarios import scenario_files
from tests.command_line import said
from tests.refusals import Inputs
from tests.twin_master.runs import check_same, figures_of, journal, text_of, written
from twin_master.errors import TwinMasterError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.report.page import render_page
from twin_master.report.reading import read_run
from twin_master.scenario.reading import parse_scenario
from twin_master.scenario.tables import Noticing
from twin_master.store.writing import open_run
from uav_twin import ExactFilter, load_scenario, prepare_twin, resume

TEXT, INPUTS = text_of("level_turns_learning"), Inputs(__file__)


def test_without_the_table_the_filter_is_the_exact_one():
    loaded = load_scenario("level_turns")
    assert loaded.scenario.to_dict()["learning"] is None
    assert isinstance(prepare_twin("paper_level_turns").twin().estimator, ExactFilter)


@pytest.mark.parametrize(("old", "new", "sentence"), INPUTS.refused("learning"))
def test_what_cannot_be_learnt_or_noticed_is_refused_in_a_sentence(tmp_path, old, new, sentence):
    with pytest.raises(TwinMasterError, match=sentence):
        load_scenario(written(tmp_path, TEXT, (old, new)))


def test_more_transitions_than_there_can_be_are_refused(tmp_path):
    file = written(tmp_path, TEXT, ("noise_degrees = 10 ", "transition_factors = [1.0, 11.0] "))
    knowledge = prepare_twin(load_scenario(file))
    with pytest.raises(TwinMasterError, match=r"smaller `learning.transition_factors`"):
        knowledge.twin()


def test_notices_are_on_in_every_file_that_does_not_turn_them_off(tmp_path):
    assert dict(Noticing()) == vars(Noticing())
    for name in scenario_files():
        loaded = load_scenario(name)
        # what two measure is the filter alone, and inspections stand beside what notices watch
        off = name in ("paper_level_turns", "model_mismatch", "inspected_wing")
        assert loaded.scenario.notice == (None if off else Noticing()), name
        assert not loaded.remark
        written = loaded.scenario.to_dict()
        assert (written["notice"] is None) is off
        assert parse_scenario(written, name).notice == loaded.scenario.notice  # as a run folder says it
    text = scenario_files()["level_turns"].read_text()
    file = tmp_path / "mine.toml"
    for old, new, remark in (
        ("[transition]", 'average_over_draws = "inside"\n[transition]', "each sensor has a parameter of"),
        ("[0, 20, 40, 60, 80]\nprior = [1, 0, 0, 0, 0]", f"{[*range(90)]}\nprior = {[1] + [0] * 89}",
         "they take 11,664,000 numbers a turn, more than 1,000,000"),
    ):  # fmt: skip
        file.write_text(text.replace(old, new))
        assert load_scenario(file).scenario.notice is None
        assert remark in load_scenario(file).remark
        file.write_text(text.replace(old, new).replace("format = 2", "format = 2\nnotice = false"))
        assert not load_scenario(file).remark


def test_sensors_with_parameters_of_their_own_are_refused(tmp_path):
    learning = TEXT[TEXT.index("[learning]") : TEXT.index("[notice]")]
    inside = ("[transition]", 'average_over_draws = "inside"\n[transition]')
    file = written(tmp_path, TEXT, (learning, ""), inside)
    with pytest.raises(TwinMasterError, match=r"`notice` needs `observation.average_over_draws` `outside`"):
        load_scenario(file)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    changes = (
        ("# What the figures", INPUTS.text("faults.toml") + "# What the figures"),
        ("steps = 50", "steps = 9"),
        ("draws = 60", "draws = 8"),
    )
    levels = ("count = 24\n", "count = 24\nbetween_levels = false\n")
    return written(tmp_path_factory.mktemp("notice"), TEXT, *changes, levels)


@pytest.fixture(scope="module")
def folder(scenario: Path) -> Path:
    run = scenario.parent / "run"
    (scenario.parent / "said.txt").write_text(said("run", scenario, "--out", run, "--no-report"))
    return run


def test_the_search_for_causes_is_named_for_a_wing_alone():
    for name, searched in (("watched_wing", True), ("three_regions", False), ("pump_wear", False)):
        assert load_scenario(name).scenario.searchable is searched


def test_the_console_names_turn_gauge_and_the_command(folder):
    text = (folder.parent / "said.txt").read_text()
    alarm = next(line for line in text.splitlines() if line.startswith("Turn ") and "gauge 5" in line)
    assert f"to find the cause: uav-twin discrepancy run --from-run {folder}" in alarm
    assert "Turn 3: gauge 12 shows 1e+14 microstrain, and no state can show less than" in text


def test_journal_store_and_summary_agree(folder):
    notices = json.loads((folder / "summary.json").read_text())["notices"]
    assert {n["kind"] for n in notices} == {"gauge_left_out", "alarm", "hypothesis"}
    assert {(n["kind"], *n["sensors"]) for n in notices} >= {("gauge_left_out", 12), ("alarm", 5)}
    lines = journal(folder)
    assert [{"turn": line["turn"]} | n for line in lines for n in line.get("notices", ())] == notices
    kept = open_run(folder)["notice"].to_dataset()
    for name, values in kept.data_vars.items():
        assert [line["suspicion"][name] for line in lines] == values.values.tolist()
    np.testing.assert_array_equal(kept["left_out"].sel(sensor=12), [0, 0, 0, 1, 1, 1, 1, 1, 1])
    alarm = next(n["turn"] for n in notices if n["kind"] == "alarm")
    figures = figures_of(folder)
    assert figures["alarm_step"] == alarm
    assert figures["gauge_off"] == kept["gauge_off"].values[-1]
    decided = [line["suspicion"]["decided_by"] for line in lines]
    assert figures["decided_by"] == decided[-1]
    assert decided[0] == "model"
    assert "gauge 5 off" in decided
    told = lines[-1]["suspicion"]["hypotheses"]
    assert told["none of these"] == pytest.approx(kept["none_of_these"].values[-1], rel=1e-12)
    assert sum(told.values()) == pytest.approx(1.0, abs=0.03)


def test_the_report_has_the_alarm(folder):
    text = render_page(read_run(folder), {}, {})
    assert "gauge 5 shows too much" in text
    decided = read_run(folder).summary["figures"][-1]
    assert decided["key"] == "decided_by"
    assert f"what decides its control is: {decided['value']}" in text
    assert "gauge 12 shows 1e+14 microstrain" in text


def test_a_run_that_was_cut_off_ends_the_same(folder):
    cut = Path(shutil.copytree(folder, folder.parent / "cut"))
    lines = (cut / JOURNAL_NAME).read_text().splitlines(keepends=True)
    (cut / JOURNAL_NAME).write_text("".join(lines[:6]))
    for name in ("run.nc", "summary.json"):
        (cut / name).unlink()
    resume(cut, report=False)
    check_same(cut, folder, "run.nc", "summary.json")
