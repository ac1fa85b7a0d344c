"""Journals, recordings and messages of versions that called a step of a mission `turn`."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reporting import former_names
from reporting.former_names import FormerNameWarning
from tests.twin_master.runs import journal, with_former_names
from tests.twin_master.watch.conftest import begun, ran, viewed, watchful, write_csv
from tests.twin_master.watch.test_teaching import tutor
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.watch.csv_feed import CsvFeed
from twin_master.watch.message import Message, MessageReader, Refused
from twin_master.watch.recorded_feeds import FolderFeed

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


def test_a_journal_of_an_earlier_version_is_read_and_gone_on_with(base, loose, tmp_path):
    """Also in the middle of a search, of the trial of a patch, and behind its adoption."""
    (tmp_path / "whole").mkdir()
    whole = watchful(base, tmp_path / "whole" / "watch")
    whole.run(CsvFeed(loose, whole.scenario), str, tutor(whole, tmp_path, "named", -0.3).teach)
    (asked,) = [line["verdict"]["to_step"] for line in journal(whole.folder) if "verdict" in line]
    stopped = watchful(base, tmp_path / "stopped")
    for number, end in enumerate((asked, asked + 5, asked + 15, None)):
        teach = tutor(stopped, tmp_path, "named", -0.3).teach
        stopped.run(CsvFeed(loose, stopped.scenario), str, teach, step_limit=end)
        with_former_names(stopped.folder)
        with pytest.warns(FormerNameWarning, match=SENTENCE) as told:
            stopped = watchful(stopped, tmp_path / str(number))
        expected = told_in(whole.folder)[: len(told_in(stopped.folder))]
        assert told_in(stopped.folder) == expected
        assert len(told) == 1
        assert str(stopped.folder / JOURNAL_NAME) in str(told[0].message)
    assert len(told_in(stopped.folder)) == len(told_in(whole.folder))
    former_names._sources_told.clear()
    with pytest.warns(FormerNameWarning, match=SENTENCE):
        flight = viewed(stopped.folder)
    shown = [step["filtered"] for step in flight.records_of_steps(0, flight.steps)]
    assert shown == [step["filtered"] for step in viewed(whole.folder).records_of_steps(0, flight.steps)]
    messages = [message for message, _ in FolderFeed(stopped.folder, stopped.scenario).messages(None)]
    assert [message.step for message in messages if isinstance(message, Message)] == [*range(flight.steps)]


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


def test_a_message_that_says_turn_is_read(base):
    reader = MessageReader(base.scenario)
    content = [json.dumps({"turn": turn, "strain_1": 1e-3}).encode() for turn in (4, 5)]
    with pytest.warns(FormerNameWarning, match=f"^A message: {SENTENCE}. The former name is still") as told:
        messages = [reader.read(text) for text in content]
    assert len(told) == 1
    assert [message.step for message in messages if isinstance(message, Message)] == [4, 5]
    refusal = reader.read({"turn": 4, "step": 4, "strain_1": 1e-3})
    assert isinstance(refusal, Refused)
    assert str(refusal) == f"A message: {SENTENCE}, and both are given."
