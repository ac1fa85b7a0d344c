"""A watch: the same as a mission, killed at any moment, patched on the way, over files and standard input."""

import io
import json
import os
import random
import re
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import uav_twin
from reporting.progress import SilentProgress
from tests.command_line import command, said, seen
from tests.twin_master.runs import check_same, edited, figures_of, journal
from tests.twin_master.watch.conftest import begun, killed_at, ran, viewed, wait_until, watchful, write_csv
from twin_master.errors import MissionInputError, NotResumableError, RunFolderError
from twin_master.mission.decision_record import decision_from_line
from twin_master.mission.journal import JOURNAL_NAME, record_of_line
from twin_master.mission.replay import BelievedModel
from twin_master.scenario.reading import load_scenario
from twin_master.store.writing import open_run as stored_run
from twin_master.watch.csv_feed import CsvFeed
from twin_master.watch.feed import Feed
from twin_master.watch.feeds import feed_of_json_lines, file_feed
from twin_master.watch.folder import Watch
from twin_master.watch.opening import copy_of_run_until, resume_watch
from twin_master.watch.recorded_feeds import FolderFeed
from twin_master.watch.result import notices_since, store_watch

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


def last_line(folder: Path) -> str:
    """The last record of a journal, as text, without its hash."""
    return (folder / JOURNAL_NAME).read_text().splitlines()[-1][65:]


def journalled(watch: Watch, folder: Path | None = None) -> list[Any]:
    """The decisions that the journal of a watch, or of one like it, holds."""
    model, lines = watch.models[0].knowledge.model, journal(folder or watch.folder)
    return [decision_from_line(line, watch.scenario, model) for line in lines]


def belief_of(watch: Watch) -> object:
    return [line["filtered"] for line in journal(watch.folder) if "filtered" in line][-1]


def test_a_recorded_mission_is_watched_as_it_was_flown(base, mission, whole, tmp_path):
    run = uav_twin.open_run(whole)
    np.testing.assert_array_equal(run["observed"]["strain"].values, mission.observed)
    np.testing.assert_array_equal(run["observed"]["control_index"].values, mission.control_index)
    for group in ("filtered", "smoothed", "predicted"):
        np.testing.assert_array_equal(run[group]["probability"].values, getattr(mission, group))
    for name in ("log_evidence", "decision_probability"):
        np.testing.assert_array_equal(run["filtered"][name].values, getattr(mission, name))
    assert "truth" not in run.children
    told = journalled(base, whole)
    assert [decision["step"] for decision in told] == list(range(50))
    assert all(0.5 <= decision["probability"] <= 1.0 for decision in told)
    assert [d["next_control"] for d in told[:-1]] == [d["control"] for d in told[1:]]
    figures = figures_of(whole)
    assert (figures["steps"], figures["rejected"], figures["missing"]) == (50, 7, 0)
    assert len((whole / "rejected.jsonl").read_text().splitlines()) == 7
    assert "messages refused" in (whole / "report.html").read_text()
    for number, source in enumerate((whole / "run.nc", whole)):
        watch = begun(base, tmp_path / str(number))
        watch.run(file_feed(source, watch.scenario), str)
        assert belief_of(watch) == json.loads(last_line(whole))["filtered"]
    with pytest.raises(MissionInputError, match="holds no journal"):
        file_feed(tmp_path, base.scenario)
    before = (whole / JOURNAL_NAME).read_bytes()
    with copy_of_run_until(whole, 3, 20, SilentProgress()) as copy:  # up to a step
        assert (copy / "run.nc").is_file()
        assert [record["step"] for record in journal(copy)] == list(range(21))
    assert not copy.exists()
    assert (whole / JOURNAL_NAME).read_bytes() == before
    nowhere = r"has the steps 0 to 20 up to step 20, and none from 21 on"
    with pytest.raises(MissionInputError, match=nowhere), copy_of_run_until(whole, 21, 20, SilentProgress()):
        raise AssertionError


def test_a_kill_at_any_moment_loses_no_step(watch, recorded, whole, monkeypatch):
    monkeypatch.setattr("twin_master.watch.folder.FLUSH_SECONDS", 0.0)  # so that each line may be the last
    feed = CsvFeed(recorded, watch.scenario)
    chance, kills, file = random.Random(3), 0, watch.folder / JOURNAL_NAME
    expected, size = (whole / JOURNAL_NAME).read_bytes(), 0
    while killed_at(
        watch, size + chance.randint(0, len(expected) // 16), lambda: ran(watch, feed, pause=0.005)
    ):
        kills += 1
        content = file.read_bytes()
        assert expected.startswith(content)
        size = len(content)
        with file.open("ab") as opened:  # as a kill within a write would leave it
            opened.write(expected[size : size + chance.choice([0, 1, 70, 300])])
    assert kills >= 5
    check_same(watch.folder, whole, JOURNAL_NAME, "rejected.jsonl")


@pytest.mark.parametrize(
    ("case", "stops", "counted"),
    [
        ("gap", (0, 15, 20, None), (10, 1, 0)),  # nothing behind it is lost where the watch ends within
        ("learning", (5, 12, 19, 31, None), (0, 0, 0)),
    ],
)
def test_a_watch_that_was_stopped_goes_on_as_if_it_had_never_ended(
    base, mission, plain, tmp_path, monkeypatch, case, stops, counted
):
    """Also one that learns and gives notice, and is told from step 10 on of controls that were not flown."""
    given, path, tables = load_scenario("level_turns_learning").scenario, tmp_path / "m.csv", {}
    controls = np.where(np.arange(50) < 10, mission.control_index, 1 - mission.control_index)
    if case == "gap":
        rows = plain.read_text().splitlines()
        path.write_text("\n".join([*rows[:11], "what", *rows[21:], ""]))
    else:
        monkeypatch.setattr("twin_master.watch.intake.SNAPSHOT_STEPS", 8)
        write_csv(path, mission.observed, controls)
        tables = {"learning": given.learning, "notice": given.notice}
    knowledge = replace(base.models[0].knowledge, scenario=base.scenario.model_copy(update=tables))
    folders = []
    for name, ends in (("whole", (None,)), ("stopped", stops)):
        watch = begun(base, tmp_path / name)
        watch.models = [BelievedModel(0, knowledge)]
        counts = ran(watch, CsvFeed(path, knowledge.scenario), *ends)
        assert (counts.missing, counts.rejected, counts.late) == counted
        folders.append(watch.folder)
    check_same(*folders, *(["rejected.jsonl"] if case == "gap" else [JOURNAL_NAME]))
    assert last_line(folders[0]) == last_line(folders[1])
    if case == "gap":
        store_watch(watch, counts, last=35, report=False)
        assert figures_of(watch.folder)["blind_steps"] == "15, 16, 17, 18, 19"
        summary = json.loads((watch.folder / "summary.json").read_text())
        assert summary["control"] == "left 3g for 2g at step 31"
    if case == "learning":
        last = json.loads(last_line(folders[0]))
        assert "young_modulus_factor" in last["learnt"]
        twin = knowledge.twin()
        for row, control in zip(mission.observed, controls.tolist(), strict=True):
            found = twin.step(row, control)
        assert last["filtered"] == found.filtered.tolist()


def test_what_came_behind_the_last_step_of_a_live_watch_stays_counted(watch, mission):
    told = {"step": 0, "control": watch.scenario.control_names[mission.control_index[0]]}
    line = json.dumps(told | {"strain": mission.observed[0].tolist()}).encode() + b"\n"
    for lines, received in ((3 * line, 3), (b"", 3), (line, 4)):
        counts = ran(watch, feed_of_json_lines(watch.scenario, io.BytesIO(lines)))
        assert (counts.received, counts.duplicates) == (received, received - 1)
    assert [decision["step"] for decision in journalled(watch) if decision] == [0]


def test_another_file_is_read_from_its_beginning(watch, mission, plain, tmp_path):
    """A logger that begins a file each day; and the first of them once more, which says nothing new."""
    header, *rows = plain.read_text().splitlines()
    days = rows[:30], rows[30:45], rows[30:]  # the last is that before, which has grown
    for day, of_day in enumerate(days):
        (tmp_path / f"{day}.csv").write_text("\n".join([header, "-", *of_day]) + "\n")
    for day in (0, 1, 2):
        counts = ran(watch, CsvFeed(tmp_path / f"{day}.csv", watch.scenario))
    assert (counts.received, counts.missing, counts.duplicates, counts.rejected) == (52, 0, 0, 2)
    assert belief_of(watch) == mission.filtered[-1].tolist()
    counts = ran(watch, CsvFeed(tmp_path / "1.csv", watch.scenario))
    assert (counts.missing, counts.late, counts.duplicates, counts.rejected) == (0, 0, 8, 2 + 1 + 7)
    counts = ran(watch, CsvFeed(plain, watch.scenario))
    assert (counts.missing, counts.late, counts.duplicates, counts.rejected) == (0, 0, 8 + 13, 2 + 1 + 7 + 37)
    assert belief_of(watch) == mission.filtered[-1].tolist()


def test_what_came_late_stands_in_the_journal_and_is_fed_from_it(base, mission, plain, tmp_path):
    """Another control was assumed, for a gap and with one gauge alone; each line says what was told."""
    controls = mission.control_index.copy()
    controls[[20, 30]] = 1 - controls[[20, 30]]
    header, *rows = write_csv(tmp_path / "m.csv", mission.observed, controls).read_text().split()
    part = f"30,,{rows[30].split(',')[2]}{',' * 23}"  # one gauge, and no control
    late = [*rows[:20], *rows[21:25], rows[20], *rows[25:30], part, *rows[30:]]
    (tmp_path / "late.csv").write_text("\n".join([header, *late, ""]))
    first, second = begun(base, tmp_path / "first"), begun(base, tmp_path / "second")
    for watch, source, stops in (
        (first, tmp_path / "late.csv", (None,)),
        (second, first.folder, (22, 23, None)),
    ):
        counts = ran(watch, file_feed(source, watch.scenario), *stops)
        assert (counts.late, counts.rejected, counts.missing) == (2, 0, 0)
    assert belief_of(second) == belief_of(first)
    late = [*rows[:20], *rows[21:25], rows[20], rows[25].replace(",", ",,", 1), *rows[26:30], rows[25]]
    (tmp_path / "late.csv").write_text("\n".join([header, *late, ""]))
    watch = watchful(base, tmp_path / "watch")
    told = list[dict[str, Any]]()
    watch.run(CsvFeed(tmp_path / "late.csv", watch.scenario), told.append)
    assert journalled(watch) == told
    assert watch.last_decision() == told[-1] | {"told_again": True}
    assert [decision["revised_by_step"] for decision in told if "revised_by_step" in decision] == [20, 25]


def test_a_watch_is_taken_up_from_the_end_of_its_journal(watch, mission, tmp_path, monkeypatch):
    """It costs the same however long it is; what is not read is not missed, and what is read is checked."""
    monkeypatch.setattr("twin_master.watch.intake.SNAPSHOT_STEPS", 8)
    monkeypatch.setattr("twin_master.watch.teaching.CHECKED_BYTES", 1)
    observed, controls = np.tile(mission.observed, (4, 1)), np.tile(mission.control_index, 4)
    feed = CsvFeed(write_csv(tmp_path / "m.csv", observed, controls), watch.scenario)
    file, counts = watch.folder / JOURNAL_NAME, []
    for steps in (60, 100, 196):  # as many steps behind the last snapshot
        ran(watch, feed, steps)
        with patch("twin_master.mission.journal.record_of_line", wraps=record_of_line) as read:
            watch.last_decision()
            ran(watch, feed, steps)
        counts.append(read.call_count)
    assert counts[0] == counts[1] == counts[2] < 60
    lines = file.read_bytes().splitlines(keepends=True)
    file.write_bytes(b"".join([*lines[:3], lines[3].replace(b'"step": 2}', b'"step": 1}'), *lines[4:]]))
    ran(watch, feed, 198)
    with pytest.raises(
        NotResumableError, match=r"line 4 .*damaged.*; 3 before it and 195 after it are valid"
    ):
        notices_since(watch, 0)
    # Another watch takes in all but what the line said, and refuses that by name; the refusal says so.
    fed = [*FolderFeed(watch.folder, watch.scenario).messages(None)]
    assert "line 4 of journal.jsonl was changed or is damaged" in str(fed.pop(2)[0])
    others = np.delete(np.arange(198), 2)
    np.testing.assert_array_equal([message.step for message, _ in fed], others)
    np.testing.assert_array_equal([message.observed for message, _ in fed], observed[others])
    changed = lines[-2].replace(b'"step": 1', b'"step": 2')
    for wrong, sentence in (
        ([*lines[:3], *lines[4:]], r"line 196 .*lines before it are missing"),
        ([*lines[:-2], changed, lines[-1]], "line 196 .*and 1 behind it"),
    ):
        file.write_bytes(b"".join(wrong))
        with pytest.raises(NotResumableError, match=sentence):
            ran(watch, feed)
        assert file.read_bytes() == b"".join(wrong)
    monkeypatch.undo()
    with pytest.raises(NotResumableError, match=sentence) as caught:
        resume_watch(watch.folder, None, SilentProgress()).__enter__()
    assert f"--observations {watch.folder}" in caught.value.__notes__[-1]


@pytest.mark.parametrize("source", ["standard input", "a file that grows"])
def test_silence_is_told_and_journalled(watch, plain, tmp_path, source):
    told = list[dict[str, Any]]()
    section = watch.scenario.watch.model_copy(update={"quiet_after_seconds": 0.2})
    watch.scenario = watch.scenario.model_copy(update={"watch": section})
    if source == "standard input":
        read, write = os.pipe()
        stream = os.fdopen(read, "rb")
        feed: Feed = feed_of_json_lines(watch.scenario, stream)
        texts = [json.dumps({"step": step, "strain_1": 1e-3}) + "\n" for step in range(3)]
    else:
        header, *texts = plain.read_text().splitlines(keepends=True)[:4]
        path = tmp_path / "m.csv"
        path.write_text(header)
        stream, write = path.open("rb"), os.open(path, os.O_WRONLY | os.O_APPEND)
        feed = CsvFeed(path, watch.scenario, follow=True)
    watching = threading.Thread(target=watch.run, args=(feed, told.append), kwargs={"step_limit": 3})
    watching.start()

    def kinds(count: int) -> list[tuple[int, list[str]]]:
        wait_until(lambda: len(told) >= count)
        return [(said["step"], [notice["kind"] for notice in said["notices"]]) for said in told]

    def refused_message_is_sent() -> bool:
        """Send one, which is not a step; return whether the silence was told."""
        os.write(write, b'{"step": 0, "no_sensor": 1.0}\n')
        return any(notice["kind"] == "quiet" for said in told for notice in said["notices"])

    if source == "standard input":
        wait_until(refused_message_is_sent)
        assert kinds(2)[:1] == [(-1, ["refused"])]
        del told[0]
    assert kinds(1) == [(-1, ["quiet"])]  # nobody has decided anything yet
    assert "control" not in told[0]
    assert "see whether logger and broker are there" in told[0]["notices"][0]["sentence"]
    os.write(write, texts[0].encode())
    again = ["taken"] if source == "standard input" else []
    assert kinds(3)[1:] == [(0, [*again, "heard"]), (0, ["quiet"])]
    assert told[2] == told[1] | {"notices": told[2]["notices"], "told_again": True}
    os.write(write, (texts[1] + texts[2][:9]).encode())  # half a message is none
    assert kinds(5)[3:] == [(1, ["heard"]), (1, ["quiet"])]
    os.write(write, texts[2][9:].encode())
    watching.join(60)
    os.close(write)
    stream.close()
    assert kinds(6)[5:] == [(2, ["heard"])]
    assert journalled(watch)[-len(told) :] == told
    assert ran(watch, CsvFeed(plain, watch.scenario))
    shown = viewed(watch.folder).records_of_steps(0, 4)  # as the page shows it
    seen = [[notice["kind"] for notice in step.get("notices", ())] for step in shown]
    expected = [["heard", "quiet", "quiet"], ["heard", "quiet"], ["heard"], []]
    if source == "standard input":  # the recording contradicts the first three steps
        expected = [["taken", "heard", "refused", "quiet", "quiet"], ["heard", "quiet"]]
        expected += [["heard", "refused"], ["taken"]]
    assert seen == expected
    assert [step for step, notice in notices_since(watch, 0) if notice.kind == "quiet"] == [0, 0, 1]


def test_a_reader_that_leaves_ends_the_watch_in_order(scenario, mission, tmp_path, monkeypatch):
    rows = mission.observed[:4].tolist()
    lines = [json.dumps({"step": step, "strain": row}) + "\n" for step, row in enumerate(rows)]
    line = [sys.executable, "-m", "uav_twin", "watch", str(scenario.path), "--no-report"]
    out, pipe = ["--out", str(tmp_path / "watch")], subprocess.PIPE
    with subprocess.Popen([*line, *out], stdin=pipe, stdout=pipe, stderr=pipe, text=True) as process:
        process.stdin.write("".join(lines[:2]))
        process.stdin.flush()
        assert json.loads(process.stdout.readline())["step"] == 0
        process.stdout.close()  # as head does
        process.stdin.write("".join(lines[2:]))
        process.stdin.flush()
        assert process.wait(300) == 0
        complaint = process.stderr.read()
    assert "Traceback" not in complaint
    assert "Broken" not in complaint
    # It has ended; only after a kill, before the summary is written, nobody knows what was told.
    for again in (0, 1):
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO()))
        told = [json.loads(row) for row in said("watch", "--resume", *out, "--no-report").splitlines()]
        assert [(decision["told_again"], decision["step"] > 0) for decision in told] == [(True, True)] * again
        (tmp_path / "watch" / "summary.json").unlink()


def test_the_shipped_recording_is_noticed(tmp_path, monkeypatch):
    """The gauge that comes loose at step 10, and the skin that softens from step 25 on."""
    monkeypatch.setattr("twin_master.watch.opening.store_watch", lambda *_arguments, **_options: None)
    folder = tmp_path / "a b"
    done = command("watch", "watched_wing", "--out", folder, "--pace", "0.001")
    assert done.returncode == 0, done.stderr
    decisions = [json.loads(line) for line in done.stdout.splitlines()]
    assert [decision["step"] for decision in decisions] == list(range(60))
    notices = [(d["step"], notice) for d in decisions for notice in d["notices"]]
    (first, gauge), (second, none) = ((step, said) for step, said in notices if said["kind"] == "alarm")
    assert [said["sensors"] for _, said in notices if said["kind"] == "hypothesis"] == [[4], []]
    assert decisions[24]["decided_by"] == "gauge 4 off"
    assert (decisions[-1]["decided_by"], decisions[-1]["next_control"]) == ("none of these", "2g")
    assert 10 < first < 25 < second < 40
    assert gauge["sensors"] == [4]
    assert abs(gauge["since"] - 10) <= 2
    assert "gauge 4 shows too little, " in gauge["sentence"]
    assert f"--from-run '{folder}' --from-step {gauge['since']}\n" in done.stderr
    assert "no state of the model explains all gauges" in none["sentence"]
    assert decisions[24]["none_of_these"] < 0.5
    assert decisions[-1]["none_of_these"] > 0.999
    again = command("watch", "--resume", "--out", folder)  # nothing is read
    told = [json.loads(line) for line in again.stdout.splitlines()]
    assert [(decision["step"], decision["told_again"]) for decision in told] == [(59, True)]
    assert "60 messages." in again.stderr
    line = r"step 59: 3g, no state is believed; next 2g with .*; by none of these \(1\.00\)"
    assert re.search(line, seen("watch", "--resume", "--out", folder))  # as people read it


def test_a_watch_that_goes_on_is_opened_and_taken_up_from_python(
    scenario, base, mission, recorded, whole, tmp_path
):
    folder, decisions, opened = tmp_path / "watch", list[dict[str, object]](), []

    def decide(decision: Mapping[str, object]) -> None:
        decisions.append(dict(decision))
        if decision["step"] == 7:
            before = (folder / JOURNAL_NAME).read_bytes()
            with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
                stored_run(folder)
            opened.append(uav_twin.open_run(folder)["filtered"]["probability"].values)
            assert (folder / JOURNAL_NAME).read_bytes() == before

    with pytest.raises(RunFolderError, match=r"holds no run\.nc"):
        uav_twin.open_run(folder)
    uav_twin.watch(scenario, recorded, folder, decide=decide, steps=20, report=False)
    np.testing.assert_array_equal(opened[0], mission.filtered[:8])
    with pytest.raises(Exception, match=r"this scenario has no `\[asset\]`"):
        uav_twin.fly(scenario, tmp_path / "none")
    with pytest.raises(MissionInputError, match="names no recording: give the observations"):
        uav_twin.watch(scenario, folder=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    slip, out = tmp_path / "slip.csv", tmp_path / "slip"
    slip.write_text(edited(recorded.read_text(), ("strain_24", "strian_24")))
    passed = uav_twin.watch(scenario, slip, out, allow_unknown=True, steps=2, report=False)
    assert [line["lost_sensors"] for line in journalled(base, passed)] == [1, 1]
    with pytest.raises(RunFolderError, match="holds a run already"):
        uav_twin.watch(scenario, recorded, folder)
    for source in (passed, passed / "run.nc"):
        with pytest.raises(MissionInputError, match="choose another --out"):
            uav_twin.watch(scenario, source, passed, replace=True)
    assert len(journal(passed)) == 2
    with pytest.raises(MissionInputError, match="leave out options that would change them"):
        uav_twin.watch(None, recorded, folder, {"seed": 3}, resume=True)
    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, steps=30, report=False)
    (folder / "summary.json").unlink()  # as a kill before the end leaves it
    uav_twin.watch(None, recorded, folder, decide=decide, resume=True, last=10, report=False)
    assert [decision["step"] for decision in decisions if decision.get("told_again")] == [29]
    assert [decision for decision in decisions if not decision.get("told_again")] == journalled(base, whole)
    run = uav_twin.open_run(folder)
    np.testing.assert_array_equal(run["filtered"]["step"].values, np.arange(40, 50))
    for group in ("filtered", "smoothed"):
        np.testing.assert_array_equal(run[group]["probability"].values, getattr(mission, group)[40:])
    assert last_line(folder) == last_line(whole)
