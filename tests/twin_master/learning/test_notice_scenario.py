"""`[notice]` in a scenario: what is refused, and what a run leaves of what was noticed."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from scenarios import scenario_files
from twin_master.errors import TwinMasterError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.report.page import render_page
from twin_master.report.reading import open_run, read_run
from twin_master.scenario.reading import load_scenario, parse_scenario
from twin_master.scenario.tables import Noticing
from twin_master.workflow import resume as resume_run
from uav_twin.cli import app

TEXT = scenario_files()["level_turns_learning"].read_text()
FAULTS = """
[[truth.sensor_faults]]
kind = "drift"
sensors = [5]
first_step = 0
rate_microstrain_per_step = 100

[[truth.sensor_faults]]
kind = "drift"
sensors = [12]
first_step = 3
rate_microstrain_per_step = 1e14

# What the figures"""


def test_notices_are_on_in_every_file_that_does_not_turn_them_off(tmp_path: Path) -> None:
    assert dict(Noticing()) == vars(Noticing())
    for name in scenario_files():
        loaded = load_scenario(name)
        # what two measure is the filter alone, and inspections stand beside what notices watch
        off = name in ("paper_level_turns", "model_mismatch", "inspected_wing")
        assert loaded.scenario.notice == (None if off else Noticing()), name
        assert not loaded.remark
        written = loaded.scenario.to_dict()
        assert ("notice" in written) is not off
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


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("threshold = 1.0", "greater than 1"),
        ("gauge_gain_percent = 60", "less than or equal to 0.4"),
        ("absurd_deviations = 1", "greater than or equal to 3"),
        ("prior = 0.5", "less than 0.5"),
        ("colour = true", "colour"),
    ],
)
def test_what_cannot_be_noticed_is_refused_in_a_sentence(tmp_path: Path, line: str, sentence: str) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(TEXT.replace("threshold = 100 ", line + " "))
    with pytest.raises(TwinMasterError, match=sentence):
        load_scenario(file)


def test_sensors_with_parameters_of_their_own_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    before, after = TEXT.split("[learning]")
    text = before + "[notice]" + after.split("[notice]")[1]
    file.write_text(text.replace("[transition]", 'average_over_draws = "inside"\n[transition]', 1))
    with pytest.raises(TwinMasterError, match=r"`notice` needs `observation.average_over_draws` `outside`"):
        load_scenario(file)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("notice") / "mine.toml"
    text = TEXT.replace("# What the figures", FAULTS).replace("steps = 50", "steps = 9")
    text = text.replace("count = 24\n", "count = 24\nbetween_levels = false\n")
    file.write_text(text.replace("draws = 60", "draws = 8"))
    return file


@pytest.fixture(scope="module")
def folder(scenario: Path) -> Path:
    run = scenario.parent / "run"
    result = CliRunner().invoke(app, ["run", str(scenario), "--out", str(run), "--no-report"])
    assert result.exit_code == 0, result.output
    (scenario.parent / "said.txt").write_text(result.stdout)
    return run


def test_the_search_for_causes_is_named_for_a_wing_alone() -> None:
    for name, searched in (("watched_wing", True), ("three_regions", False), ("pump_wear", False)):
        assert load_scenario(name).scenario.searchable is searched


def test_the_console_names_turn_gauge_and_the_command(folder: Path) -> None:
    said = (folder.parent / "said.txt").read_text()
    alarm = next(line for line in said.splitlines() if line.startswith("Turn ") and "gauge 5" in line)
    assert f"to find the cause: uav-twin discrepancy run --from-run {folder}" in alarm
    assert "Turn 3: gauge 12 shows 1e+14 microstrain, and no state can show less than" in said


def test_journal_store_and_summary_agree(folder: Path) -> None:
    notices = json.loads((folder / "summary.json").read_text())["notices"]
    assert {n["kind"] for n in notices} == {"gauge_left_out", "alarm", "hypothesis"}
    assert {(n["kind"], *n["sensors"]) for n in notices} >= {("gauge_left_out", 12), ("alarm", 5)}
    lines = [json.loads(line[65:]) for line in (folder / JOURNAL_NAME).read_text().splitlines()[1:]]
    assert [{"turn": line["turn"]} | n for line in lines for n in line.get("notices", ())] == notices
    kept = open_run(folder)["notice"].to_dataset()
    for name, values in kept.data_vars.items():
        assert [line["suspicion"][name] for line in lines] == values.values.tolist()
    np.testing.assert_array_equal(kept["left_out"].sel(sensor=12), [0, 0, 0, 1, 1, 1, 1, 1, 1])
    alarm = next(n["turn"] for n in notices if n["kind"] == "alarm")
    figures = {f["key"]: f["value"] for f in json.loads((folder / "summary.json").read_text())["figures"]}
    assert figures["alarm_step"] == alarm
    assert figures["gauge_off"] == kept["gauge_off"].values[-1]
    decided = [line["suspicion"]["decided_by"] for line in lines]
    assert figures["decided_by"] == decided[-1]
    assert decided[0] == "model"
    assert "gauge 5 off" in decided
    told = lines[-1]["suspicion"]["hypotheses"]
    assert told["none of these"] == pytest.approx(kept["none_of_these"].values[-1], rel=1e-12)
    assert sum(told.values()) == pytest.approx(1.0, abs=0.03)


def test_the_report_has_the_alarm(folder: Path) -> None:
    text = render_page(read_run(folder), {}, {})
    assert "gauge 5 shows too much" in text
    decided = read_run(folder).summary["figures"][-1]
    assert decided["key"] == "decided_by"
    assert f"what decides its control is: {decided['value']}" in text
    assert "gauge 12 shows 1e+14 microstrain" in text


def test_a_run_that_was_cut_off_ends_the_same(folder: Path) -> None:
    cut = folder.parent / "cut"
    shutil.copytree(folder, cut)
    journal = cut / JOURNAL_NAME
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:6]))
    kept = {name: (cut / name).read_bytes() for name in ("run.nc", "summary.json")}
    for name in kept:
        (cut / name).unlink()
    resume_run(cut, report=False)
    assert {name: (cut / name).read_bytes() for name in kept} == kept
