"""Journals, recordings and messages of versions that called a step of a mission `turn`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reporting.formats import former_names
from reporting.formats.former_names import FormerNameWarning
from tests.twin_master.runs import journal, with_former_names
from tests.twin_master.watch.conftest import begun, ran, viewed, watchful, write_csv
from tests.twin_master.watch.test_teaching import tutor
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import FolderFeed
from twin_master.feeds.message import Message, MessageReader, Refused
from twin_master.mission.journal import JOURNAL_NAME

SENTENCE = "`turn` is now called `step`"


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every file be one of which nothing was told yet."""
    monkeypatch.setattr(former_names, "_sources_told", set())


def told_in(folder: Path) -> list[dict[str, Any]]:
    """Return the lines of a journal without what depends on its length in bytes."""
    lines = journal(folder)
    for line in lines:
        line.get("standing", {}).pop("begin", None)
        line.pop("settled", None)
    return lines


class FormerJournal:
    """A watch of a loose gauge that is stopped four times, and whose journal gets its former names each time.

    It is stopped in the middle of a search, of the trial of a patch, and behind its adoption. Another watch
    of the same recording is not stopped.
    """

    def __init__(self, base: Any, recording: Path, folder: Path) -> None:
        (folder / "whole").mkdir()
        self.whole = watchful(base, folder / "whole" / "watch")
        feed = CsvFeed(recording, self.whole.scenario)
        self.whole.run(feed, str, tutor(self.whole, folder, "named", -0.3).teach)
        (asked,) = [line["verdict"]["to_step"] for line in journal(self.whole.folder) if "verdict" in line]
        self.lines_of_whole = told_in(self.whole.folder)
        self.lines_after_stops, self.warnings = [], []
        self.stopped = watchful(base, folder / "stopped")
        for number, end in enumerate((asked, asked + 5, asked + 15, None)):
            teach = tutor(self.stopped, folder, "named", -0.3).teach
            self.stopped.run(CsvFeed(recording, self.stopped.scenario), str, teach, step_limit=end)
            with_former_names(self.stopped.folder)
            with pytest.warns(FormerNameWarning, match=SENTENCE) as told:
                self.stopped = watchful(self.stopped, folder / str(number))
            self.lines_after_stops.append(told_in(self.stopped.folder))
            self.warnings.append((self.stopped.folder / JOURNAL_NAME, [str(w.message) for w in told]))


@pytest.fixture(scope="module")
def former_journal(base, loose, tmp_path_factory) -> FormerJournal:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(former_names, "_sources_told", set())
        return FormerJournal(base, loose, tmp_path_factory.mktemp("former_journal"))


def test_a_journal_of_an_earlier_version_is_gone_on_with(former_journal):
    for lines in former_journal.lines_after_stops:
        assert lines == former_journal.lines_of_whole[: len(lines)]
    assert len(former_journal.lines_after_stops[-1]) == len(former_journal.lines_of_whole)


def test_a_journal_of_an_earlier_version_is_told_of_once(former_journal):
    for path, sentences in former_journal.warnings:
        (sentence,) = sentences
        assert str(path) in sentence


def test_a_journal_of_an_earlier_version_is_viewed(former_journal):
    with pytest.warns(FormerNameWarning, match=SENTENCE):
        flight = viewed(former_journal.stopped.folder)
    flight_of_whole = viewed(former_journal.whole.folder)
    shown = [step["filtered"] for step in flight.records_of_steps(0, flight.steps)]
    assert shown == [step["filtered"] for step in flight_of_whole.records_of_steps(0, flight.steps)]


def test_a_journal_of_an_earlier_version_is_watched_again(former_journal):
    stopped = former_journal.stopped
    with pytest.warns(FormerNameWarning, match=SENTENCE):
        messages = [message for message, _ in FolderFeed(stopped.folder, stopped.scenario).messages(None)]
    steps = [line["step"] for line in former_journal.lines_of_whole if "filtered" in line]
    assert [message.step for message in messages if isinstance(message, Message)] == [*range(max(steps) + 1)]


def test_a_recording_with_a_column_of_turns_is_read(base, mission, tmp_path):
    present = write_csv(tmp_path / "present.csv", mission.observed[:6], mission.control_index[:6])
    former = tmp_path / "former.csv"
    former.write_text(present.read_text().replace("step,", "turn,", 1))
    read, expected = (begun(base, tmp_path / name) for name in ("former", "present"))
    with pytest.warns(FormerNameWarning, match=SENTENCE) as told:
        ran(read, CsvFeed(former, read.scenario))
    assert [str(warning.message).split(":")[0] for warning in told] == [str(former)]
    ran(expected, CsvFeed(present, expected.scenario))
    assert [line["step"] for line in told_in(read.folder)] == [*range(6)]
    observed = [np.array(line["observed"]) for line in told_in(read.folder)]
    np.testing.assert_array_equal(observed, [line["observed"] for line in told_in(expected.folder)])


def test_messages_that_say_turn_are_read_with_one_sentence(base):
    reader = MessageReader(base.scenario)
    content = [json.dumps({"turn": turn, "strain_1": 1e-3}).encode() for turn in (4, 5)]
    with pytest.warns(FormerNameWarning, match=f"^A message: {SENTENCE}. The former name is still") as told:
        messages = [reader.read(text) for text in content]
    assert len(told) == 1
    assert [message.step for message in messages if isinstance(message, Message)] == [4, 5]


def test_a_message_that_says_turn_and_step_is_refused(base):
    refusal = MessageReader(base.scenario).read({"turn": 4, "step": 4, "strain_1": 1e-3})
    assert isinstance(refusal, Refused)
    assert str(refusal) == f"A message: {SENTENCE}, and both are given."
