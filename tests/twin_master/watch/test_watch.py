"""A watch: the same as a mission, killed at any moment, patched on the way, over files and a real broker."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import uav_twin
from fe.runtime.patch import ModelPatch, SensorGain
from fmu_asset.packing.patch_file import SCHEMA
from reporting.progress import SilentProgress
from tests.twin_master.watch.watches import begun, lines, soon_quiet, wait_until, watchful, write_csv
from twin_master.errors import MissionInputError, NotResumableError, RunFolderError
from twin_master.mission.journal import JOURNAL_NAME, line_of, records, whole_record
from twin_master.mission.turns import History
from twin_master.network.estimator import ExactFilter
from twin_master.report.reading import open_run as stored_run
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.viewer.flight import Flight as SeenFlight
from twin_master.watch.feeds import CsvFeed, FolderFeed, JsonLinesFeed, file_feed
from twin_master.watch.folder import Patched, Watch
from twin_master.watch.intake import Feed
from twin_master.watch.message import Message
from twin_master.watch.opening import flown, resume_watch
from twin_master.watch.replay import BelievedModel, journalled_decision
from uav_twin.cli import app

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


def test_a_recorded_mission_is_watched_as_it_was_flown(mission: History, whole: Path) -> None:
    run = uav_twin.open_run(whole)
    for group, name, found in (
        ("observed", "strain", mission.observed),
        ("observed", "control_index", mission.control_index),
        ("filtered", "probability", mission.filtered),
        ("filtered", "log_evidence", mission.log_evidence),
        ("filtered", "decision_probability", mission.decision_probability),
        ("smoothed", "probability", mission.smoothed),
        ("predicted", "probability", mission.predicted),
    ):
        np.testing.assert_array_equal(run[group][name].values, found, err_msg=f"{group}/{name}")
    assert "truth" not in run.children
    decisions = json.loads((whole / "decisions.json").read_text())
    assert [d["next_control"] for d in decisions[:-1]] == [d["control"] for d in decisions[1:]]
    figures = {f["key"]: f["value"] for f in json.loads((whole / "summary.json").read_text())["figures"]}
    assert (figures["turns"], figures["rejected"], figures["missing"]) == (50, 7, 0)
    assert len((whole / "rejected.jsonl").read_text().splitlines()) == 7
    assert "messages refused" in (whole / "report.html").read_text()


def test_a_run_file_is_watched_too(base: Watch, whole: Path, tmp_path: Path) -> None:
    last = [json.loads((whole / JOURNAL_NAME).read_text().splitlines()[-1][65:])]
    for number, source in enumerate((whole / "run.nc", whole)):
        watch = begun(base, tmp_path / str(number))
        watch.run(file_feed(source, watch.scenario), lambda _decision: None)
        last.append(json.loads((watch.folder / JOURNAL_NAME).read_text().splitlines()[-1][65:]))
    assert last[0]["filtered"] == last[1]["filtered"] == last[2]["filtered"]
    with pytest.raises(MissionInputError, match="holds no journal"):
        file_feed(tmp_path, base.scenario)


def test_a_program_hands_over_messages_and_is_told_decisions(
    scenario: LoadedScenario, mission: History, whole: Path, tmp_path: Path
) -> None:
    controls = [("2g", "3g")[index] for index in mission.control_index]
    messages = (
        {"turn": turn, "control": controls[turn], "strain": mission.observed[turn]} for turn in range(6)
    )
    decisions: list[dict[str, object]] = []
    folder = uav_twin.watch(
        scenario, messages, tmp_path / "watch", report=False, decide=lambda told: decisions.append(dict(told))
    )
    assert decisions == json.loads((whole / "decisions.json").read_text())[:6]
    np.testing.assert_array_equal(uav_twin.open_run(folder)["filtered"]["probability"], mission.filtered[:6])
    with pytest.raises(MissionInputError, match="names no recording: give the observations"):
        uav_twin.watch(scenario, folder=tmp_path / "none")
    with pytest.raises(MissionInputError, match="--teach begins with an alarm"):
        uav_twin.watch(scenario, [], tmp_path / "none", teach=True)
    assert not (tmp_path / "none").exists()


def killed(watch: Watch, feed: CsvFeed, size: int) -> bool:
    """Watch in a process of its own, killed once the journal has a size; return whether it was killed."""
    child = os.fork()
    if not child:
        try:
            watch.run(feed, lambda _decision: time.sleep(0.005))
            os._exit(0)
        finally:
            os._exit(1)
    journal = watch.folder / JOURNAL_NAME
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if journal.exists() and journal.stat().st_size >= size:
            os.kill(child, signal.SIGKILL)
            ended = os.waitpid(child, 0)
            break
    assert ended[1] in (0, signal.SIGKILL)
    return ended[1] == signal.SIGKILL


def test_a_kill_at_any_moment_loses_no_turn(
    base: Watch, recorded: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.watch.folder.FLUSH_SECONDS", 0.0)  # so that each line may be the last
    folder = tmp_path / "watch"
    watch = begun(base, folder)
    feed = CsvFeed(recorded, watch.scenario)
    chance, kills, journal = random.Random(3), 0, folder / JOURNAL_NAME
    expected, size = (whole / JOURNAL_NAME).read_bytes(), 0
    while killed(watch, feed, size + chance.randint(0, len(expected) // 16)):
        kills += 1
        content = journal.read_bytes()
        assert expected.startswith(content)
        size = len(content)
        with journal.open("ab") as file:  # as a kill within a write would leave it
            file.write(expected[size : size + chance.choice([0, 1, 70, 300])])
    assert kills >= 5
    assert journal.read_bytes() == expected
    assert (folder / "rejected.jsonl").read_bytes() == (whole / "rejected.jsonl").read_bytes()


def test_what_comes_behind_a_gap_is_not_lost_when_the_watch_ends_within_it(
    base: Watch, mission: History, tmp_path: Path
) -> None:
    observed = mission.observed.copy()
    path = write_csv(tmp_path / "m.csv", observed, mission.control_index)
    lines = path.read_text().splitlines()
    path.write_text("what\n".join(["\n".join([*lines[:11], ""]), "\n".join(lines[21:])]) + "\n")
    ends = []
    for name, stops in (("whole", (None,)), ("stopped", (0, 15, 20, None))):
        watch = begun(base, tmp_path / name)
        for stop in stops:
            counts = watch.run(CsvFeed(path, watch.scenario), lambda _decision: None, turns=stop)
        assert (counts.missing, counts.rejected, counts.late) == (10, 1, 0)
        lines = (watch.folder / JOURNAL_NAME).read_text().splitlines()
        ends.append((lines[-1], (watch.folder / "rejected.jsonl").read_text()))
    assert ends[0] == ends[1]


def belief_of(watch: Watch) -> object:
    return json.loads((watch.folder / JOURNAL_NAME).read_text().splitlines()[-1][65:])["filtered"]


def test_another_file_is_read_from_its_beginning(base: Watch, mission: History, tmp_path: Path) -> None:
    """A logger that begins a file each day; and the first of them once more, which says nothing new."""
    whole = write_csv(tmp_path / "m.csv", mission.observed, mission.control_index)
    header, *rows = whole.read_text().splitlines()
    for day, of_day in enumerate((rows[:30], rows[30:45], [*rows[30:45], *rows[45:]])):
        (tmp_path / f"{day}.csv").write_text("\n".join([header, "-", *of_day]) + "\n")
    watch = begun(base, tmp_path / "watch")
    for day in (0, 1, 2):  # the last is that before it, which has grown
        counts = watch.run(CsvFeed(tmp_path / f"{day}.csv", watch.scenario), lambda _decision: None)
    assert (counts.received, counts.missing, counts.duplicates, counts.rejected) == (52, 0, 0, 2)
    assert belief_of(watch) == mission.filtered[-1].tolist()
    counts = watch.run(CsvFeed(tmp_path / "1.csv", watch.scenario), lambda _decision: None)
    assert (counts.missing, counts.late, counts.duplicates) == (0, 0, 0)
    again = watch.run(CsvFeed(whole, watch.scenario), lambda _decision: None)
    assert (again.missing, again.late, again.duplicates, again.rejected) == (0, 0, 13, 2 + 37)
    assert belief_of(watch) == mission.filtered[-1].tolist()


def test_a_folder_tells_what_came_late_into_a_gap(base: Watch, mission: History, tmp_path: Path) -> None:
    controls = mission.control_index.copy()
    controls[20] = 1 - controls[20]  # not what was assumed while nothing was known of it
    header, *rows = write_csv(tmp_path / "m.csv", mission.observed, controls).read_text().splitlines()
    late = [*rows[:20], *rows[21:25], rows[20], *rows[25:]]
    (tmp_path / "late.csv").write_text("\n".join([header, *late]) + "\n")
    first, second = begun(base, tmp_path / "first"), begun(base, tmp_path / "second")
    told = first.run(CsvFeed(tmp_path / "late.csv", first.scenario), lambda _decision: None)
    feed = file_feed(first.folder, second.scenario)
    for turns in (22, 23, None):
        counts = second.run(feed, lambda _decision: None, turns=turns)
    assert (told.late, told.rejected, told.missing) == (1, 0, 0)
    assert (counts.late, counts.rejected, counts.missing) == (1, 0, 0)
    assert belief_of(second) == belief_of(first)


def test_a_watch_that_learns_goes_on_as_if_it_had_never_ended(
    base: Watch, mission: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.watch.keeping.SNAPSHOT_TURNS", 8)
    learning = load_scenario("level_turns_learning").scenario.learning
    scenario = base.scenario.model_copy(update={"learning": learning})
    knowledge = replace(base.models[0].knowledge, scenario=scenario)
    path = write_csv(tmp_path / "m.csv", mission.observed, mission.control_index)
    journals = []
    for name, stops in (("whole", (None,)), ("stopped", (5, 19, 31, None))):
        watch = begun(base, tmp_path / name)
        watch.models = [BelievedModel(0, knowledge)]
        for stop in stops:
            watch.run(CsvFeed(path, scenario), lambda _decision: None, turns=stop)
        journals.append((watch.folder / JOURNAL_NAME).read_bytes())
    assert journals[0] == journals[1]
    learnt = json.loads(journals[0].splitlines()[-1][65:])["learnt"]
    assert learnt["young_modulus_factor"]["standard_deviation"] < 0.01
    twin = knowledge.twin()
    for turn, row in enumerate(mission.observed):
        last = twin.turn(row, int(mission.control_index[turn]))
    assert json.loads(journals[0].splitlines()[-1][65:])["filtered"] == last.filtered.tolist()


def test_a_control_that_is_reported_wrongly_ends_no_watch(
    base: Watch, mission: History, tmp_path: Path
) -> None:
    """From turn 10 on, for a twin that learns and gives notice, also when it is taken up again."""
    controls = np.where(np.arange(50) < 10, mission.control_index, 1 - mission.control_index)
    path = write_csv(tmp_path / "m.csv", mission.observed, controls)
    given = load_scenario("level_turns_learning").scenario
    tables = {"learning": given.learning, "notice": given.notice}
    scenario, ends = base.scenario.model_copy(update=tables), []
    for name, stops in (("whole", (None,)), ("stopped", (12, 35, None))):
        watch = begun(base, tmp_path / name)
        watch.models = [BelievedModel(0, replace(base.models[0].knowledge, scenario=scenario))]
        for stop in stops:
            counts = watch.run(CsvFeed(path, scenario), lambda _decision: None, turns=stop)
        assert (counts.received, counts.rejected, counts.missing) == (50, 0, 0)
        ends.append((watch.folder / JOURNAL_NAME).read_bytes())
    assert ends[0] == ends[1]


def test_a_long_watch_goes_on_from_its_snapshot(
    base: Watch, mission: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.watch.keeping.SNAPSHOT_TURNS", 16)
    path = write_csv(tmp_path / "m.csv", mission.observed, mission.control_index)
    watch = begun(base, tmp_path / "watch")
    seen: list[int] = []
    monkeypatch.setattr(ExactFilter, "turn", counting(seen, ExactFilter.turn))
    for turns in (18, 40, None):
        counts = watch.run(CsvFeed(path, watch.scenario), lambda _decision: None, turns=turns)
    assert len(seen) == 50 + (17 - 2) + (39 - 18)  # each once, and those behind what is settled
    watch.store(counts, last=20, report=False)
    run = uav_twin.open_run(tmp_path / "watch")
    np.testing.assert_array_equal(run["filtered"]["step"].values, np.arange(30, 50))
    np.testing.assert_array_equal(run["filtered"]["probability"].values, mission.filtered[30:])
    np.testing.assert_array_equal(run["smoothed"]["probability"].values, mission.smoothed[30:])


def test_a_watch_is_taken_up_from_the_end_of_its_journal(
    base: Watch, mission: History, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It costs the same however long it is; what is not read is not missed, and what is read is checked."""
    monkeypatch.setattr("twin_master.watch.keeping.SNAPSHOT_TURNS", 8)
    monkeypatch.setattr("twin_master.watch.keeping.CHECKED", 1)
    observed, controls = np.tile(mission.observed, (4, 1)), np.tile(mission.control_index, 4)
    feed = CsvFeed(write_csv(tmp_path / "m.csv", observed, controls), base.scenario)
    watch, journal = begun(base, tmp_path / "watch"), tmp_path / "watch" / JOURNAL_NAME
    counts, read = [], list[int]()
    for turns in (60, 100, 196):  # as many turns behind the last snapshot
        watch.run(feed, lambda _decision: None, turns=turns)
        with monkeypatch.context() as patched:
            patched.setattr("twin_master.mission.journal.whole_record", counting(read, whole_record))
            watch.last_decision()
            watch.run(feed, lambda _decision: None, turns=turns)
        counts.append(len(read))
        read.clear()
    assert counts[0] == counts[1] == counts[2] < 60
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join([*lines[:3], lines[3].replace(b'"turn": 2}', b'"turn": 1}'), *lines[4:]]))
    watch.run(feed, lambda _decision: None, turns=198)
    with pytest.raises(NotResumableError, match=r"line 4 .*; 3 before it are whole"):
        watch.told(0)
    for wrong, said in (
        (lines[:3] + lines[4:], r"line 192 .*lines before it are missing"),
        (
            [*lines[:-2], lines[-2].replace(b'"turn": ', b'"turn": 1'), lines[-1]],
            "line 196 .*and 1 behind it",
        ),
    ):
        journal.write_bytes(b"".join(wrong))
        with pytest.raises(NotResumableError, match=said):
            watch.run(feed, lambda _decision: None)
        assert journal.read_bytes() == b"".join(wrong)


def counting(seen: list[int], inner: Callable[..., object]) -> Callable[..., object]:
    def turn(*arguments: object) -> object:
        seen.append(1)
        return inner(*arguments)

    return turn


def test_the_last_decision_is_read_from_the_journal(base: Watch, whole: Path, tmp_path: Path) -> None:
    decisions = json.loads((whole / "decisions.json").read_text())
    watch, journal = begun(base, tmp_path / "watch"), tmp_path / "watch" / JOURNAL_NAME
    lines = (whole / JOURNAL_NAME).read_bytes().splitlines(keepends=True)
    again = {"told_again": True}
    for cut in (lines, [*lines, lines[-1][:90]], [*lines, line_of({"turn": 49, "model": {}})]):
        journal.write_bytes(b"".join(cut))
        assert watch.last_decision() == decisions[-1] | again
    # What came late is told with the control of the last turn, not with that of its own.
    late = json.loads(lines[-1][65:]) | {"observation_turn": 40, "control_index": 0, "observed": [None] * 24}
    journal.write_bytes(b"".join([*lines, line_of(late | {"control_in_force": 1})]))
    told = watch.last_decision()
    changed = {"control": "3g", "lost_sensors": 24, "revised_by_turn": 40}
    assert told == decisions[-1] | changed | again
    journal.write_bytes(lines[0])
    assert watch.last_decision() is None
    journal.unlink()
    assert watch.last_decision() is None


def test_a_line_of_the_journal_says_what_was_told(base: Watch, mission: History, tmp_path: Path) -> None:
    header, *rows = write_csv(tmp_path / "m.csv", mission.observed, mission.control_index).read_text().split()
    late = [*rows[:20], *rows[21:25], rows[20], rows[25].replace(",", ",,", 1), *rows[26:30], rows[25]]
    (tmp_path / "late.csv").write_text("\n".join([header, *late, ""]))
    watch, told = watchful(base, tmp_path / "watch"), list[dict[str, object]]()
    feed = CsvFeed(tmp_path / "late.csv", watch.scenario)
    watch.run(feed, lambda decision: told.append(dict(decision)))
    model = watch.models[0].knowledge.model
    assert [journalled_decision(line, watch.scenario, model) for line in lines(watch)] == told
    assert [decision["revised_by_turn"] for decision in told if "revised_by_turn" in decision] == [20, 25]


@pytest.mark.parametrize("source", ["standard input", "a file that grows"])
def test_silence_is_told_and_journalled(base: Watch, mission: History, tmp_path: Path, source: str) -> None:
    watch, told = soon_quiet(begun(base, tmp_path / "watch")), list[dict[str, Any]]()
    path = tmp_path / "m.csv"
    if source == "standard input":
        read, write = os.pipe()
        stream = os.fdopen(read, "rb")
        feed: Feed = JsonLinesFeed(watch.scenario, stream)
        texts = [json.dumps({"turn": turn, "strain_1": 1e-3}) + "\n" for turn in range(3)]
    else:
        header, *rows = write_csv(path, mission.observed[:3], mission.control_index).read_text().split()
        path.write_text(header + "\n")
        stream = path.open("rb")
        write = os.open(path, os.O_WRONLY | os.O_APPEND)
        feed, texts = CsvFeed(path, watch.scenario, follow=True), [row + "\n" for row in rows]
    watching = threading.Thread(target=watch.run, args=(feed, told.append), kwargs={"turns": 3})
    watching.start()

    def kinds(count: int) -> list[tuple[int, list[str]]]:
        wait_until(lambda: len(told) >= count)
        return [(said["turn"], [notice["kind"] for notice in said["notices"]]) for said in told]

    assert kinds(1) == [(-1, ["quiet"])]  # nobody has decided anything yet
    assert "control" not in told[0]
    os.write(write, texts[0].encode())
    assert kinds(3)[1:] == [(0, ["heard"]), (0, ["quiet"])]
    assert told[2] == told[1] | {"notices": told[2]["notices"], "told_again": True}
    os.write(write, (texts[1] + texts[2][:9]).encode())  # half a message is none
    assert kinds(5)[3:] == [(1, ["heard"]), (1, ["quiet"])]
    os.write(write, texts[2][9:].encode())
    watching.join(60)
    os.close(write)
    stream.close()
    assert kinds(6)[5:] == [(2, ["heard"])]
    model = watch.models[0].knowledge.model
    assert [journalled_decision(line, watch.scenario, model) for line in lines(watch)] == told
    assert watch.run(CsvFeed(write_csv(path, mission.observed, mission.control_index), watch.scenario), str)
    flight = SeenFlight(watch.folder)  # as the page shows it
    while flight.update():
        pass
    seen = [[notice.kind for notice in turn.notices] for turn in flight.seen(0, 4)]
    assert seen == [["heard", "quiet", "quiet"], ["heard", "quiet"], ["heard"], []]
    assert [turn for turn, notice in watch.told(0) if notice.kind == "quiet"] == [0, 0, 1]


def test_a_reader_that_leaves_ends_the_watch_in_order(
    scenario: LoadedScenario, mission: History, tmp_path: Path
) -> None:
    shown = mission.observed[:4].tolist()
    lines = [json.dumps({"turn": turn, "strain": row}) + "\n" for turn, row in enumerate(shown)]
    command = [sys.executable, "-m", "uav_twin", "watch", str(scenario.path), "--no-report"]
    out, pipe = ["--out", str(tmp_path / "watch")], subprocess.PIPE
    with subprocess.Popen([*command, *out], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdin.write("".join(lines[:2]))
        process.stdin.flush()
        assert json.loads(process.stdout.readline())["turn"] == 0
        process.stdout.close()  # as head does
        process.stdin.write("".join(lines[2:]))
        process.stdin.flush()
        assert process.wait(60) == 0
        said = process.stderr.read()
    assert "Traceback" not in said
    assert "Broken" not in said
    # It has ended; only after a kill, before the summary is written, nobody knows what was told.
    for again in (0, 1):
        result = CliRunner().invoke(app, ["watch", "--resume", *out, "--no-report"], input="")
        assert result.exit_code == 0, result.output
        told = [json.loads(line) for line in result.stdout.splitlines()]
        assert [(decision["told_again"], decision["turn"] > 0) for decision in told] == [(True, True)] * again
        (tmp_path / "watch" / "summary.json").unlink()


def test_a_changed_journal_and_other_folders_are_refused(
    scenario: LoadedScenario, recorded: Path, whole: Path, tmp_path: Path
) -> None:
    shutil.copytree(whole, tmp_path / "copy")
    journal = tmp_path / "copy" / JOURNAL_NAME
    journal.write_bytes(journal.read_bytes().replace(b'"turn": 9}', b'"turn": 8}', 1))
    sentence = r"line 11 .*damaged.*; 10 before it are whole, and 40 behind it"
    with pytest.raises(NotResumableError, match=sentence) as caught:
        resume_watch(tmp_path / "copy", None, SilentProgress())
    # Another watch takes in all but what the line said, and refuses that by name.
    assert f"--observations {tmp_path / 'copy'}" in caught.value.__notes__[-1]
    fed = [
        list(FolderFeed(folder, scenario.scenario).messages(None)) for folder in (whole, tmp_path / "copy")
    ]
    assert "line 11 of journal.jsonl was changed or is damaged" in str(fed[1][9][0])
    for (said, _), (kept, _) in zip(fed[0][:9] + fed[0][10:], fed[1][:9] + fed[1][10:], strict=True):
        assert isinstance(said, Message)
        assert isinstance(kept, Message)
        np.testing.assert_array_equal(said.observed, kept.observed)
        assert said.turn == kept.turn
    result = CliRunner().invoke(app, ["watch", str(scenario.path), "--out", str(whole)])
    assert "holds a run already" in str(result.exception)
    with pytest.raises(Exception, match=r"this scenario has no `\[asset\]`"):
        uav_twin.fly(scenario, tmp_path / "run")
    for options in (["--resume", "--seed", "3"], ["--model-patch", "x.json"], []):
        assert CliRunner().invoke(app, ["watch", *options]).exit_code != 0


def test_the_shipped_recording_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The gauge that comes loose at turn 10, and the skin that softens from turn 25 on."""
    monkeypatch.setattr(Watch, "store", lambda *_arguments, **_options: None)
    folder = tmp_path / "a b"
    result = CliRunner().invoke(app, ["watch", "watched_wing", "--out", str(folder), "--pace", "0.001"])
    assert result.exit_code == 0, result.output
    decisions = [json.loads(line) for line in result.stdout.splitlines()]
    assert [decision["turn"] for decision in decisions] == list(range(60))
    notices = [(d["turn"], notice) for d in decisions for notice in d["notices"]]
    (first, gauge), (second, none) = ((turn, said) for turn, said in notices if said["kind"] == "alarm")
    followed = [(turn, said["sensors"]) for turn, said in notices if said["kind"] == "hypothesis"]
    assert [sensors for _, sensors in followed] == [[4], []]
    assert decisions[24]["decided_by"] == "gauge 4 off"
    assert (decisions[-1]["decided_by"], decisions[-1]["next_control"]) == ("none of these", "2g")
    assert 10 < first < 25 < second < 40
    assert gauge["sensors"] == [4]
    assert "no state of the model explains all gauges" in none["sentence"]
    assert decisions[24]["none_of_these"] < 0.5
    assert decisions[-1]["none_of_these"] > 0.999
    assert f"--from-run '{folder}'" in result.stderr
    again = CliRunner().invoke(app, ["watch", "--resume", "--out", str(folder)])
    told = [json.loads(line) for line in again.stdout.splitlines()]
    assert [(decision["turn"], decision["told_again"]) for decision in told] == [
        (59, True)
    ]  # nothing is read
    assert "60 messages." in again.stderr


@pytest.mark.long
def test_a_patch_is_believed_from_a_stated_turn_on(base: Watch, mission: History, tmp_path: Path) -> None:
    observed = mission.observed.copy()
    observed[20:, 4] *= 0.88
    path = write_csv(tmp_path / "m.csv", observed, mission.control_index)
    patch = tmp_path / "patch.json"
    effects = [{"id": "loose", "primitives": ModelPatch((SensorGain("g5", -0.12),)).to_list()}]
    patch.write_text(json.dumps({"schema": SCHEMA, "effects": effects, "channels": {"g5": "strain[5]"}}))
    watch = begun(base, tmp_path / "watch")
    watch.run(CsvFeed(path, watch.scenario), lambda _decision: None, turns=40)
    with pytest.raises(MissionInputError, match="--from-turn names one of the 40 turns"):
        watch.run(CsvFeed(path, watch.scenario), str, patched=Patched(patch, 41))
    watch = begun(base, tmp_path / "other")
    shutil.copy(tmp_path / "watch" / JOURNAL_NAME, tmp_path / "other")
    watch.run(CsvFeed(path, watch.scenario), lambda _decision: None, turns=45, patched=Patched(patch, 20))
    later = begun(base, tmp_path / "later")
    shutil.copytree(tmp_path / "other", tmp_path / "later", dirs_exist_ok=True)
    later.models.append(watch.models[1])  # as the journal says
    later.store(later.run(CsvFeed(path, later.scenario), lambda _decision: None), report=False)

    twin = base.models[0].knowledge.twin()
    beliefs = []
    for turn, row in enumerate(observed):
        if turn == 20:
            knew = watch.models[1].knowledge.twin()
            knew.restore_state(twin.save_state())
            twin = knew
        beliefs.append(twin.turn(row, int(mission.control_index[turn])).filtered)
    run = uav_twin.open_run(tmp_path / "later")
    assert (run.attrs["model_patch"], run.attrs["model_patch_from_step"]) == ("asset/model_patch_1.json", 20)
    np.testing.assert_array_equal(run["filtered"]["probability"].values, beliefs)
    figures = {
        figure["key"]: figure["value"]
        for figure in json.loads((tmp_path / "later" / "summary.json").read_text())["figures"]
    }
    assert figures["gap_after_patch_20"] < 0.97 * figures["gap_before_patch_20"]


def test_a_watch_is_read_up_to_a_turn_while_it_goes_on(whole: Path) -> None:
    before = (whole / JOURNAL_NAME).read_bytes()
    with flown(whole, 3, 20, SilentProgress()) as copy:
        ended = [record for record, *_ in records(copy / JOURNAL_NAME)]
        assert (copy / "run.nc").is_file()
    assert [record["turn"] for record in ended] == list(range(21))
    assert not copy.exists()
    assert (whole / JOURNAL_NAME).read_bytes() == before
    with (
        pytest.raises(MissionInputError, match=r"has the turns 0 to 20 up to turn 20, and none from 21 on"),
        flown(whole, 21, 20, SilentProgress()),
    ):
        raise AssertionError


def test_a_watch_that_goes_on_is_opened_and_taken_up_from_python(
    scenario: LoadedScenario, mission: History, recorded: Path, whole: Path, tmp_path: Path
) -> None:
    folder, decisions = tmp_path / "watch", list[dict[str, object]]()
    opened = []

    def decide(decision: Mapping[str, object]) -> None:
        decisions.append(dict(decision))
        if decision["turn"] == 7:
            before = (folder / JOURNAL_NAME).read_bytes()
            with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
                stored_run(folder)
            opened.append(uav_twin.open_run(folder)["filtered"]["probability"].values)
            assert (folder / JOURNAL_NAME).read_bytes() == before

    with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
        uav_twin.open_run(folder)
    uav_twin.watch(scenario, recorded, folder, decide=decide, turns=20, report=False)
    np.testing.assert_array_equal(opened[0], mission.filtered[:8])
    with pytest.raises(MissionInputError, match="give nothing beside --resume"):
        uav_twin.watch(None, recorded, folder, {"seed": 3}, resume=True)
    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, turns=30, report=False)
    (folder / "summary.json").unlink()  # as a kill before the end leaves it
    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, last=10, report=False)
    again = [decision["turn"] for decision in decisions if decision.get("told_again")]
    told = [decision for decision in decisions if not decision.get("told_again")]
    assert (again, told) == ([29], json.loads((whole / "decisions.json").read_text()))
    run = uav_twin.open_run(folder)
    np.testing.assert_array_equal(run["filtered"]["probability"].values, mission.filtered[40:])
    assert (folder / JOURNAL_NAME).read_text().splitlines()[-1][65:] == (
        (whole / JOURNAL_NAME).read_text().splitlines()[-1][65:]
    )


def test_an_unknown_column_is_passed_over_on_request(
    scenario: LoadedScenario, recorded: Path, tmp_path: Path
) -> None:
    path, out = tmp_path / "m.csv", tmp_path / "watch"
    path.write_text(recorded.read_text().replace("strain_24", "strian_24", 1))
    words = ["watch", str(scenario.path), "--observations", str(path), "--out", str(out), "--no-report"]
    refused = CliRunner().invoke(app, [*words, "--turns", "2"])
    assert "the column `strian_24` is no sensor: a sensor is called such as `strain_24`" in str(
        refused.exception
    )
    assert not out.exists()
    passed = CliRunner().invoke(app, [*words, "--turns", "2", "--allow-unknown"])
    assert passed.exit_code == 0, passed.output
    assert [json.loads(line)["lost_sensors"] for line in passed.stdout.splitlines()] == [1, 1]


def test_a_slip_of_the_pen_makes_no_folder(scenario: LoadedScenario, tmp_path: Path) -> None:
    (tmp_path / "run.nc").touch()
    (tmp_path / "wrong.csv").write_text("turn,strian_1\n")
    (tmp_path / "lines.jsonl").write_text('{"turn": 0, "strain_1": 1e-4}\n')
    for source, said in (
        (["missing.csv"], "there is no file"),
        ([str(tmp_path / "wrong.csv")], "the column `strian_1` is no sensor"),
        ([str(tmp_path / "lines.jsonl")], "holds JSON lines"),
        ([str(tmp_path / "run.nc"), "--follow"], "only a CSV file can be followed"),
        (["-", "--follow"], "--follow belongs to a CSV file"),
        (["mqtt://host"], "is expected"),
        (["-", "--teach"], "this scenario gives none: `notice` is off"),
    ):
        options = ["--out", str(tmp_path / "watch"), "--observations", *source]
        result = CliRunner().invoke(app, ["watch", str(scenario.path), *options])
        assert said in str(result.exception)
        assert not (tmp_path / "watch").exists()


def test_what_is_watched_is_not_replaced_by_its_watch(
    scenario: LoadedScenario, whole: Path, tmp_path: Path
) -> None:
    shutil.copytree(whole, tmp_path / "watch")
    for source in (tmp_path / "watch", tmp_path / "watch" / "run.nc"):
        options = ["--out", str(tmp_path / "watch"), "--replace", "--observations", str(source)]
        result = CliRunner().invoke(app, ["watch", str(scenario.path), *options])
        assert "choose another --out" in str(result.exception)
    assert (tmp_path / "watch" / JOURNAL_NAME).read_bytes() == (whole / JOURNAL_NAME).read_bytes()
