"""A watch as a user calls it: with pipes, of the shipped recording, and from Python."""

import io
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uav_twin
from tests.command_line import command, said, seen
from tests.twin_master.runs import edited, journal
from tests.twin_master.watch.conftest import (
    HANGS,
    journalled,
    last_line,
)
from twin_master.errors import MissionInputError, RunFolderError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.steps import History
from twin_master.scenario.reading import LoadedScenario
from twin_master.store.writing import open_run as stored_run

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


@pytest.fixture(scope="module")
def abandoned_watch(
    scenario: LoadedScenario, mission: History, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, Any], int, str]:
    """Folder, first decision, exit code and complaint of a watch whose reader leaves, as `head` does."""
    folder = tmp_path_factory.mktemp("abandoned") / "watch"
    rows = mission.observed[:4].tolist()
    lines = [json.dumps({"step": step, "strain": row}) + "\n" for step, row in enumerate(rows)]
    program = [sys.executable, "-m", "uav_twin"]
    words = ["watch", str(scenario.path), "--no-report", "--out", str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen([*program, *words], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            process.stdin.write("".join(lines[:2]))
            process.stdin.flush()
            decision = json.loads(process.stdout.readline())
            process.stdout.close()
            process.stdin.write("".join(lines[2:]))
            process.stdin.flush()
            code = process.wait(HANGS)
            complaint = process.stderr.read()
        finally:
            process.kill()
    return folder, decision, code, complaint


def test_a_reader_that_leaves_ends_the_watch_in_order(abandoned_watch):
    _, decision, code, complaint = abandoned_watch
    assert (decision["step"], code) == (0, 0)
    assert "Traceback" not in complaint
    assert "Broken" not in complaint


def test_the_last_decision_is_told_again_only_after_a_kill_before_the_summary(
    abandoned_watch, tmp_path, monkeypatch
):
    """Nobody knows then what was told."""
    folder = tmp_path / "watch"
    shutil.copytree(abandoned_watch[0], folder)

    def decisions_of_resumed_watch() -> list[tuple[bool, bool]]:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(), encoding="utf-8"))
        lines = said("watch", "--resume", "--out", folder, "--no-report").splitlines()
        decisions = [json.loads(line) for line in lines]
        return [(decision["told_again"], decision["step"] > 0) for decision in decisions]

    assert decisions_of_resumed_watch() == []
    (folder / "summary.json").unlink()
    assert decisions_of_resumed_watch() == [(True, True)]


class ShippedRecording:
    """The shipped recording as the command watches it; its report has tests of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = self.command("--pace", "0.001")
        lines = self.process.stdout.splitlines()
        self.decisions: list[dict[str, Any]] = [json.loads(line) for line in lines]
        notices = [(d["step"], notice) for d in self.decisions for notice in d["notices"]]
        self.alarms = [(step, notice) for step, notice in notices if notice["kind"] == "alarm"]
        self.hypotheses = [notice for _, notice in notices if notice["kind"] == "hypothesis"]

    def command(self, *options: str) -> subprocess.CompletedProcess[str]:
        """Watch the recording, or resume the watch, without storing its result."""
        with pytest.MonkeyPatch.context() as patching:
            patching.setattr("twin_master.watch.workflow.store_watch", lambda *_words, **_options: None)
            if "--resume" in options:
                return command("watch", "--out", self.folder, *options)
            return command("watch", "watched_wing", "--out", self.folder, *options)


@pytest.fixture(scope="module")
def shipped_recording(tmp_path_factory: pytest.TempPathFactory) -> ShippedRecording:
    """A gauge comes loose at step 10, and the skin softens from step 25 on."""
    return ShippedRecording(tmp_path_factory.mktemp("shipped") / "a b")


def test_each_step_of_the_shipped_recording_is_decided(shipped_recording):
    assert shipped_recording.process.returncode == 0, shipped_recording.process.stderr
    assert [decision["step"] for decision in shipped_recording.decisions] == list(range(60))


def test_the_shipped_recording_has_an_alarm_for_each_of_its_two_faults(shipped_recording):
    (gauge_step, _), (skin_step, _) = shipped_recording.alarms
    assert 10 < gauge_step < 25 < skin_step < 40
    assert [notice["sensors"] for notice in shipped_recording.hypotheses] == [[4], []]


def test_the_loose_gauge_is_named_with_the_step_at_which_it_came_loose(shipped_recording):
    _, alarm = shipped_recording.alarms[0]
    assert alarm["sensors"] == [4]
    assert abs(alarm["since"] - 10) <= 2
    assert "gauge 4 shows too little, " in alarm["sentence"]


def test_an_alarm_names_the_command_that_searches_its_cause(shipped_recording):
    _, alarm = shipped_recording.alarms[0]
    options = f"--from-run '{shipped_recording.folder}' --from-step {alarm['since']}\n"
    assert options in shipped_recording.process.stderr


def test_the_loose_gauge_is_left_out_of_the_decision(shipped_recording):
    decision = shipped_recording.decisions[24]
    assert decision["decided_by"] == "gauge 4 off"
    assert decision["none_of_these"] < 0.5


def test_no_state_is_believed_once_the_skin_softens(shipped_recording):
    _, alarm = shipped_recording.alarms[1]
    decision = shipped_recording.decisions[-1]
    assert "no state of the model explains all gauges" in alarm["sentence"]
    assert (decision["decided_by"], decision["next_control"]) == ("none of these", "2g")
    assert decision["none_of_these"] > 0.999


def test_a_recording_that_was_watched_to_its_end_is_not_read_again(shipped_recording):
    again = shipped_recording.command("--resume")
    decisions = [json.loads(line) for line in again.stdout.splitlines()]
    assert [(decision["step"], decision["told_again"]) for decision in decisions] == [(59, True)]
    assert "60 messages." in again.stderr


def test_a_decision_without_a_believed_state_is_shown_to_people(shipped_recording, monkeypatch):
    monkeypatch.setattr("twin_master.watch.workflow.store_watch", lambda *_words, **_options: None)
    line = r"step 59: 3g, no state is believed; next 2g with .*; by none of these \(1\.00\)"
    assert re.search(line, seen("watch", "--resume", "--out", shipped_recording.folder))


class PythonWatch:
    """A watch called from Python for 20 steps, which is opened at step 7 by another reader."""

    def __init__(self, scenario: LoadedScenario, recording: Path, folder: Path) -> None:
        self.folder = folder
        self.decisions = list[dict[str, object]]()
        uav_twin.watch(scenario, recording, folder, decide=self.decide, steps=20, report=False)

    def decide(self, decision: Mapping[str, object]) -> None:
        self.decisions.append(dict(decision))
        if decision["step"] == 7:
            self.journal_before = (self.folder / JOURNAL_NAME).read_bytes()
            with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
                stored_run(self.folder)
            self.probability = uav_twin.open_run(self.folder)["filtered"]["probability"].values
            self.journal_after = (self.folder / JOURNAL_NAME).read_bytes()


@pytest.fixture(scope="module")
def python_watch(
    scenario: LoadedScenario, recorded: Path, tmp_path_factory: pytest.TempPathFactory
) -> PythonWatch:
    return PythonWatch(scenario, recorded, tmp_path_factory.mktemp("python") / "watch")


def test_a_watch_that_goes_on_is_opened_from_python(python_watch, mission):
    np.testing.assert_array_equal(python_watch.probability, mission.filtered[:8])
    assert python_watch.journal_after == python_watch.journal_before


def test_a_watch_is_taken_up_from_python(python_watch, base, mission, recorded, whole, tmp_path):
    folder = tmp_path / "watch"
    shutil.copytree(python_watch.folder, folder)
    decisions = [*python_watch.decisions]

    def decide(decision: Mapping[str, object]) -> None:
        decisions.append(dict(decision))

    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, steps=30, report=False)
    (folder / "summary.json").unlink()  # as a kill before the end leaves it
    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, last=10, report=False)
    told_again = [decision["step"] for decision in decisions if decision.get("told_again")]
    new_decisions = [decision for decision in decisions if not decision.get("told_again")]
    run = uav_twin.open_run(folder)
    assert told_again == [29]
    assert new_decisions == journalled(base, whole)
    assert last_line(folder) == last_line(whole)
    np.testing.assert_array_equal(run["filtered"]["step"].values, np.arange(40, 50))
    for group in ("filtered", "smoothed"):
        np.testing.assert_array_equal(run[group]["probability"].values, getattr(mission, group)[40:])


def test_a_folder_that_is_no_watch_cannot_be_opened(tmp_path):
    with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
        uav_twin.open_run(tmp_path / "watch")


def test_a_scenario_without_asset_or_recording_is_refused_and_writes_nothing(scenario, tmp_path):
    folder = tmp_path / "none"
    with pytest.raises(Exception, match=r"this scenario has no `\[asset\]`"):
        uav_twin.fly(scenario, folder)
    with pytest.raises(MissionInputError, match="names no recording: give the observations"):
        uav_twin.watch(scenario, folder=folder)
    assert not folder.exists()


@pytest.fixture(scope="module")
def watch_of_misspelt_column(
    scenario: LoadedScenario, recorded: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Folder of a watch of two steps whose recording has a misspelt column."""
    folder = tmp_path_factory.mktemp("misspelt")
    recording = folder / "slip.csv"
    recording.write_text(edited(recorded.read_text(encoding="utf-8"), ("strain_24", "strian_24")))
    return uav_twin.watch(scenario, recording, folder / "watch", allow_unknown=True, steps=2, report=False)


def test_a_column_that_is_unknown_and_allowed_is_a_lost_sensor(watch_of_misspelt_column, base):
    decisions = journalled(base, watch_of_misspelt_column)
    assert [decision["lost_sensors"] for decision in decisions] == [1, 1]


def test_a_run_is_not_replaced_unless_that_is_asked_for(python_watch, scenario, recorded):
    with pytest.raises(RunFolderError, match="holds a run already"):
        uav_twin.watch(scenario, recorded, python_watch.folder)


@pytest.mark.parametrize("name", ["run.nc", "."])
def test_a_watch_does_not_replace_what_it_reads(watch_of_misspelt_column, scenario, name):
    folder = watch_of_misspelt_column
    with pytest.raises(MissionInputError, match="choose another --out"):
        uav_twin.watch(scenario, folder / name, folder, replace=True)
    assert len(journal(folder)) == 2


def test_a_watch_that_is_resumed_takes_no_options(python_watch, recorded):
    with pytest.raises(MissionInputError, match="leave out options that would change them"):
        uav_twin.watch(None, recorded, python_watch.folder, {"seed": 3}, resume=True)
