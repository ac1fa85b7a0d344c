"""A watch: the same as a mission, killed at any moment, patched on the way, over files and standard input."""

import io
import json
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

import uav_twin
from reporting.progress import SilentProgress
from tests.twin_master.runs import belief_in_journal, check_same, figures_of, journal
from tests.twin_master.watch.conftest import (
    begun,
    belief_of,
    journalled,
    killed_at,
    last_line,
    ran,
    watchful,
    write_csv,
)
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import FolderFeed
from twin_master.feeds.feed_choice import feed_of_lines, file_feed
from twin_master.mission.journal import JOURNAL_NAME, record_of_line
from twin_master.mission.recent_parts import BLOCK_STEPS
from twin_master.mission.replay import BelievedModel
from twin_master.mission.steps import History
from twin_master.scenario.reading import load_scenario
from twin_master.watch.folder import Watch
from twin_master.watch.result import notices_since, store_watch
from twin_master.watch.workflow import copy_of_run_until, resume_watch

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


@pytest.fixture(scope="module")
def whole_run(whole: Path) -> Any:
    """The store of the watch of the whole mission."""
    return uav_twin.open_run(whole)


def test_a_watch_keeps_what_was_flown_and_no_truth(whole_run, mission):
    observed = whole_run["observed"]
    np.testing.assert_array_equal(observed["strain"].values, mission.observed)
    np.testing.assert_array_equal(observed["control_index"].values, mission.control_index)
    assert "truth" not in whole_run.children


@pytest.mark.parametrize("group", ["filtered", "smoothed", "predicted"])
def test_a_watch_believes_what_the_twin_of_the_mission_believed(whole_run, mission, group):
    probability = whole_run[group]["probability"].values
    np.testing.assert_array_equal(probability, getattr(mission, group))


@pytest.mark.parametrize("name", ["log_evidence", "decision_probability"])
def test_a_watch_has_the_evidence_and_decisions_of_the_mission(whole_run, mission, name):
    np.testing.assert_array_equal(whole_run["filtered"][name].values, getattr(mission, name))


def test_a_journal_has_the_decision_of_each_step(base, whole):
    decisions = journalled(base, whole)
    announced = [decision["next_control"] for decision in decisions[:-1]]
    flown = [decision["control"] for decision in decisions[1:]]
    assert [decision["step"] for decision in decisions] == list(range(50))
    assert all(0.5 <= decision["probability"] <= 1.0 for decision in decisions)
    assert announced == flown


def test_a_watch_counts_steps_and_refused_messages(whole):
    figures = figures_of(whole)
    assert (figures["steps"], figures["rejected"], figures["missing"]) == (50, 7, 0)
    assert len((whole / "rejected.jsonl").read_text().splitlines()) == 7
    assert "messages refused" in (whole / "report.html").read_text()


@pytest.mark.parametrize("name", ["run.nc", "."])
def test_the_store_or_the_folder_of_a_watch_is_watched_again(base, whole, tmp_path, name):
    watch = begun(base, tmp_path / "again")
    watch.run(file_feed(whole / name, watch.scenario), str)
    assert belief_of(watch) == json.loads(last_line(whole))["filtered"]


def test_a_folder_without_a_journal_is_refused(base, tmp_path):
    with pytest.raises(MissionInputError, match="holds no journal"):
        file_feed(tmp_path, base.scenario)


def test_a_copy_up_to_a_step_is_removed_and_leaves_the_watch_as_it_was(whole):
    journal_before = (whole / JOURNAL_NAME).read_bytes()
    with copy_of_run_until(whole, 3, 20, SilentProgress()) as copy:
        store_is_there = (copy / "run.nc").is_file()
        steps = [record["step"] for record in journal(copy)]
    assert (store_is_there, steps) == (True, list(range(21)))
    assert not copy.exists()
    assert (whole / JOURNAL_NAME).read_bytes() == journal_before


def test_a_copy_from_behind_its_last_step_is_refused(whole):
    sentence = r"has the steps 0 to 20 up to step 20, and none from 21 on"
    copying = copy_of_run_until(whole, 21, 20, SilentProgress())
    with pytest.raises(MissionInputError, match=sentence), copying:
        raise AssertionError


def run_with_flushes(watch: Watch, feed: CsvFeed) -> None:
    """Run a watch that flushes each line, so that each may be the last."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("twin_master.watch.folder.FLUSH_SECONDS", 0.0)
        ran(watch, feed, pause=0.005)


def test_a_kill_at_any_moment_loses_no_step(watch, recorded, whole):
    feed = CsvFeed(recorded, watch.scenario)
    chance = random.Random(3)
    file = watch.folder / JOURNAL_NAME
    expected = (whole / JOURNAL_NAME).read_bytes()
    kills, size = 0, 0
    while killed_at(
        watch, size + chance.randint(0, len(expected) // 16), lambda: run_with_flushes(watch, feed)
    ):
        kills += 1
        content = file.read_bytes()
        assert expected.startswith(content)
        size = len(content)
        with file.open("ab") as opened:  # as a kill within a write would leave it
            opened.write(expected[size : size + chance.choice([0, 1, 70, 300])])
    assert kills >= 5
    check_same(watch.folder, whole, JOURNAL_NAME, "rejected.jsonl")


class StoppedWatch:
    """A recording that is watched in one go, and by another watch that is stopped several times."""

    def __init__(self, base: Watch, knowledge: Any, recording: Path, stops: tuple[Any, ...], folder: Path):
        self.knowledge = knowledge
        feed = CsvFeed(recording, knowledge.scenario)
        self.whole = begun(base, folder / "whole")
        self.whole.models = [BelievedModel(0, knowledge)]
        self.counts_of_whole = ran(self.whole, feed)
        self.stopped = begun(base, folder / "stopped")
        self.stopped.models = [BelievedModel(0, knowledge)]
        self.counts_of_stopped = ran(self.stopped, feed, *stops)

    @property
    def counts(self) -> list[tuple[int, int, int]]:
        """Return how many messages either watch missed, refused and had late."""
        either = (self.counts_of_whole, self.counts_of_stopped)
        return [(counts.missing, counts.rejected, counts.late) for counts in either]

    @property
    def last_lines(self) -> list[str]:
        return [last_line(self.whole.folder), last_line(self.stopped.folder)]


@pytest.fixture(scope="module")
def stopped_within_gap(base: Watch, plain: Path, tmp_path_factory: pytest.TempPathFactory) -> StoppedWatch:
    """The recording has a gap of ten steps, within which a watch is stopped twice."""
    folder = tmp_path_factory.mktemp("gap")
    rows = plain.read_text(encoding="utf-8").splitlines()
    recording = folder / "m.csv"
    recording.write_text("\n".join([*rows[:11], "what", *rows[21:], ""]))
    scenario = base.scenario.model_copy()
    knowledge = replace(base.models[0].knowledge, scenario=scenario)
    return StoppedWatch(base, knowledge, recording, (0, 15, 20, None), folder)


def test_a_watch_that_is_stopped_within_a_gap_loses_nothing_behind_it(stopped_within_gap):
    watches = stopped_within_gap
    assert watches.counts == [(10, 1, 0)] * 2
    assert watches.last_lines[0] == watches.last_lines[1]
    check_same(watches.whole.folder, watches.stopped.folder, "rejected.jsonl")


def test_the_result_names_the_steps_of_a_gap(stopped_within_gap):
    watch = stopped_within_gap.stopped
    store_watch(watch, stopped_within_gap.counts_of_stopped, last=35, report=False)
    summary = json.loads((watch.folder / "summary.json").read_text())
    assert figures_of(watch.folder)["blind_steps"] == "15, 16, 17, 18, 19"
    assert summary["control"] == "left 3g for 2g at step 31"


@pytest.fixture(scope="module")
def other_controls(mission: History) -> np.ndarray:
    """The controls of the mission, from step 10 on those that were not flown."""
    return np.where(np.arange(50) < 10, mission.control_index, 1 - mission.control_index)


@pytest.fixture(scope="module")
def stopped_learning(
    base: Watch, mission: History, other_controls: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> StoppedWatch:
    """A watch that learns and gives notice, and is told those controls, is stopped four times."""
    folder = tmp_path_factory.mktemp("learning")
    recording = write_csv(folder / "m.csv", mission.observed, other_controls)
    learning = load_scenario("level_turns_learning").scenario
    tables = {"learning": learning.learning, "notice": learning.notice}
    knowledge = replace(base.models[0].knowledge, scenario=base.scenario.model_copy(update=tables))
    with pytest.MonkeyPatch.context() as shorter:
        shorter.setattr("twin_master.feeds.intake.SNAPSHOT_STEPS", 8)
        return StoppedWatch(base, knowledge, recording, (5, 12, 19, 31, None), folder)


def test_a_learning_watch_that_was_stopped_goes_on_as_if_it_had_never_ended(stopped_learning):
    watches = stopped_learning
    assert watches.counts == [(0, 0, 0)] * 2
    assert watches.last_lines[0] == watches.last_lines[1]
    check_same(watches.whole.folder, watches.stopped.folder, JOURNAL_NAME)


def test_a_learning_watch_believes_what_its_twin_learns(stopped_learning, mission, other_controls):
    last = json.loads(stopped_learning.last_lines[0])
    twin = stopped_learning.knowledge.twin()
    for row, control in zip(mission.observed, other_controls.tolist(), strict=True):
        estimate = twin.step(row, control)
    assert "young_modulus_factor" in last["learnt"]
    assert last["filtered"] == belief_in_journal(estimate.filtered)


def test_what_came_behind_the_last_step_of_a_live_watch_stays_counted(watch, mission):
    told = {"step": 0, "control": watch.scenario.control_names[mission.control_index[0]]}
    line = json.dumps(told | {"strain": mission.observed[0].tolist()}).encode() + b"\n"
    for lines, received in ((3 * line, 3), (b"", 3), (line, 4)):
        counts = ran(watch, feed_of_lines(watch.scenario, io.BytesIO(lines)))
        assert (counts.received, counts.duplicates) == (received, received - 1)
    assert [decision["step"] for decision in journalled(watch) if decision] == [0]


@pytest.fixture
def daily_files(plain: Path, tmp_path: Path) -> list[Path]:
    """Three files of a logger that begins one each day; the last is that before, which has grown."""
    header, *rows = plain.read_text(encoding="utf-8").splitlines()
    files = []
    for day, rows_of_day in enumerate((rows[:30], rows[30:45], rows[30:])):
        path = tmp_path / f"{day}.csv"
        path.write_text("\n".join([header, "-", *rows_of_day]) + "\n")
        files.append(path)
    return files


def counts_of(watch: Watch, file: Path) -> dict[str, int]:
    """Watch a file, and return what the watch has counted since it began."""
    counts = ran(watch, CsvFeed(file, watch.scenario))
    names = ("missing", "late", "duplicates", "rejected")
    return {name: getattr(counts, name) for name in names}


def test_another_file_is_read_from_its_beginning(watch, mission, daily_files):
    for file in daily_files:
        counts = ran(watch, CsvFeed(file, watch.scenario))
    assert (counts.received, counts.missing, counts.duplicates, counts.rejected) == (52, 0, 0, 2)
    assert belief_of(watch) == belief_in_journal(mission.filtered[-1])


def test_files_that_are_read_once_more_say_nothing_new(watch, mission, plain, daily_files):
    for file in daily_files:
        counts_of(watch, file)
    rejected = 2 + 1 + 7
    again = {"missing": 0, "late": 0, "duplicates": 8, "rejected": rejected}
    assert counts_of(watch, daily_files[1]) == again
    assert counts_of(watch, plain) == again | {"duplicates": 8 + 13, "rejected": rejected + 37}
    assert belief_of(watch) == belief_in_journal(mission.filtered[-1])


@pytest.fixture(scope="module")
def rows_of_other_controls(mission: History, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Header and rows of the mission; in steps 20 and 30 another control is told than is assumed."""
    controls = mission.control_index.copy()
    controls[[20, 30]] = 1 - controls[[20, 30]]
    path = write_csv(tmp_path_factory.mktemp("late") / "m.csv", mission.observed, controls)
    return path.read_text().split()


def test_what_came_late_stands_in_the_journal_and_is_fed_from_it(base, rows_of_other_controls, tmp_path):
    """Another control was assumed, for a gap and with one gauge alone; each line says what was told."""
    header, *rows = rows_of_other_controls
    one_gauge_without_control = f"30,,{rows[30].split(',')[2]}{',' * 23}"
    late = [*rows[:20], *rows[21:25], rows[20], *rows[25:30], one_gauge_without_control, *rows[30:]]
    recording = tmp_path / "late.csv"
    recording.write_text("\n".join([header, *late, ""]))
    first, second = begun(base, tmp_path / "first"), begun(base, tmp_path / "second")
    counts_of_first = ran(first, file_feed(recording, first.scenario))
    counts_of_second = ran(second, file_feed(first.folder, second.scenario), 22, 23, None)
    for counts in (counts_of_first, counts_of_second):
        assert (counts.late, counts.rejected, counts.missing) == (2, 0, 0)
    assert belief_of(second) == belief_of(first)


def test_decisions_that_late_messages_revise_are_told_and_journalled(base, rows_of_other_controls, tmp_path):
    header, *rows = rows_of_other_controls
    without_control = rows[25].replace(",", ",,", 1)
    late = [*rows[:20], *rows[21:25], rows[20], without_control, *rows[26:30], rows[25]]
    recording = tmp_path / "late.csv"
    recording.write_text("\n".join([header, *late, ""]))
    watch = watchful(base, tmp_path / "watch")
    decisions = list[dict[str, Any]]()
    watch.run(CsvFeed(recording, watch.scenario), decisions.append)
    revising = [decision["revised_by_step"] for decision in decisions if "revised_by_step" in decision]
    assert journalled(watch) == decisions
    assert watch.last_decision() == decisions[-1] | {"told_again": True}
    assert revising == [20, 25]


LONG_STEPS = 198


@contextmanager
def short_snapshots() -> Iterator[None]:
    """Write a snapshot every 8 steps, and check no more than the last bytes of a journal."""
    with pytest.MonkeyPatch.context() as patching:
        patching.setattr("twin_master.feeds.intake.SNAPSHOT_STEPS", 8)
        patching.setattr("twin_master.watch.teaching.CHECKED_BYTES", 1)
        yield


class LongWatch:
    """A watch of 200 steps with short snapshots; it was taken up after 60, 100 and 196 steps."""

    def __init__(self, base: Watch, mission: History, folder: Path) -> None:
        self.observed = np.tile(mission.observed, (4, 1))
        controls = np.tile(mission.control_index, 4)
        self.recording = write_csv(folder / "m.csv", self.observed, controls)
        self.watch = begun(base, folder / "watch")
        self.records_read = []
        for steps in (60, 100, 196):  # as many steps behind the last snapshot
            self.run(self.watch, steps)
            with patch("twin_master.mission.journal.record_of_line", wraps=record_of_line) as read:
                self.watch.last_decision()
                self.run(self.watch, steps)
            self.records_read.append(read.call_count)

    def run(self, watch: Watch, steps: int | None = None) -> None:
        """Let this watch or a copy of it go on up to a number of steps."""
        with short_snapshots():
            ran(watch, CsvFeed(self.recording, watch.scenario), steps)

    def damaged_copy(self, folder: Path, damage: Callable[[list[bytes]], None]) -> Watch:
        """Return a watch like it in a folder of its own, with other lines in its journal."""
        watch = begun(self.watch, folder)
        file = watch.folder / JOURNAL_NAME
        lines = file.read_bytes().splitlines(keepends=True)
        damage(lines)
        file.write_bytes(b"".join(lines))
        return watch


def change_line_4(lines: list[bytes]) -> None:
    lines[3] = lines[3].replace(b'"step":2}', b'"step":1}')


def remove_line_4(lines: list[bytes]) -> None:
    del lines[3]


def change_last_line_but_one(lines: list[bytes]) -> None:
    assert b'"step":1' in lines[-2]
    lines[-2] = lines[-2].replace(b'"step":1', b'"step":2')


@pytest.fixture(scope="module")
def long_watch(base: Watch, mission: History, tmp_path_factory: pytest.TempPathFactory) -> LongWatch:
    return LongWatch(base, mission, tmp_path_factory.mktemp("long"))


def test_a_watch_is_taken_up_from_the_end_of_its_journal(long_watch):
    """It costs no more however long it is: back to the last line with the state of teaching."""
    assert max(long_watch.records_read) < 60 + BLOCK_STEPS


@pytest.fixture
def damaged_watch(long_watch: LongWatch, tmp_path: Path) -> Watch:
    """That watch with another step in line 4 of its journal, which nobody read when it went on."""
    watch = long_watch.damaged_copy(tmp_path / "watch", change_line_4)
    long_watch.run(watch, LONG_STEPS)
    return watch


def test_a_damaged_line_that_is_read_is_refused_with_the_numbers_of_whole_ones(damaged_watch):
    sentence = r"line 4 .*damaged.*; 3 before it and 195 after it are valid"
    with pytest.raises(NotResumableError, match=sentence):
        notices_since(damaged_watch, 0)


def test_another_watch_takes_in_all_but_what_a_damaged_line_said(damaged_watch, long_watch):
    """It refuses the line by its number."""
    messages = [*FolderFeed(damaged_watch.folder, damaged_watch.scenario).messages(None)]
    refusal, _ = messages.pop(2)
    others = np.delete(np.arange(LONG_STEPS), 2)
    assert "line 4 of journal.jsonl was changed or is damaged" in str(refusal)
    np.testing.assert_array_equal([message.step for message, _ in messages], others)
    observed = [message.observed for message, _ in messages]
    np.testing.assert_array_equal(observed, long_watch.observed[others])


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (remove_line_4, r"line 196 .*lines before it are missing"),
        (change_last_line_but_one, "line 196 .*and 1 after it"),
    ],
)
def test_a_journal_with_a_fault_at_its_end_is_refused_and_left(long_watch, tmp_path, damage, sentence):
    watch = long_watch.damaged_copy(tmp_path / "watch", damage)
    journal_before = (watch.folder / JOURNAL_NAME).read_bytes()
    with pytest.raises(NotResumableError, match=sentence):
        long_watch.run(watch)
    assert (watch.folder / JOURNAL_NAME).read_bytes() == journal_before


def test_a_damaged_watch_names_the_command_that_watches_its_messages_again(long_watch, tmp_path):
    watch = long_watch.damaged_copy(tmp_path / "watch", change_last_line_but_one)
    with pytest.raises(NotResumableError, match=r"line 196 .*and 1 after it") as caught:
        resume_watch(watch.folder, None, SilentProgress()).__enter__()
    assert f"--observations {watch.folder}" in caught.value.__notes__[-1]
