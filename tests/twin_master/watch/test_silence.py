"""Silence at standard input and at a file that grows is told, journalled and shown."""

import json
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.twin_master.watch.conftest import HANGS, begun, journalled, ran, viewed, wait_until
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import Feed
from twin_master.feeds.feed_choice import feed_of_lines
from twin_master.watch.folder import Watch
from twin_master.watch.result import notices_since

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


def kinds_of_notices(decisions: Sequence[Mapping[str, Any]]) -> list[tuple[int, list[str]]]:
    """Return the step of each decision and the kinds of its notices."""
    return [(decision["step"], [notice["kind"] for notice in decision["notices"]]) for decision in decisions]


class SilentSource:
    """A watch of three messages that come late enough for it to tell that nothing is heard."""

    def __init__(self, base: Watch, plain: Path, folder: Path, source: str) -> None:
        self.from_standard_input = source == "standard input"
        self.watch = begun(base, folder / "watch")
        section = self.watch.scenario.watch.model_copy(update={"quiet_after_seconds": 0.2})
        self.watch.scenario = self.watch.scenario.model_copy(update={"watch": section})
        self.decisions = list[dict[str, Any]]()
        self.first_kinds: tuple[int, list[str]] | None = None
        texts = self.open_standard_input() if self.from_standard_input else self.open_file(plain, folder)
        watching = threading.Thread(
            target=self.watch.run,
            args=(self.feed, self.decisions.append),
            kwargs={"step_limit": 3},
            daemon=True,
        )
        watching.start()
        if self.from_standard_input:
            wait_until(self.refused_message_is_sent)
            self.wait_for_decisions(2)
            self.first_kinds = kinds_of_notices(self.decisions)[0]
            del self.decisions[0]
        self.wait_for_decisions(1)
        self.send(texts[0])
        self.wait_for_decisions(3)
        self.send(texts[1] + texts[2][:9])  # half a message is none
        self.wait_for_decisions(5)
        self.send(texts[2][9:])
        watching.join(HANGS)
        os.close(self.write)
        self.stream.close()
        self.wait_for_decisions(6)
        self.journal = journalled(self.watch)
        self.counts_of_recording = ran(self.watch, CsvFeed(plain, self.watch.scenario))

    def open_standard_input(self) -> list[str]:
        """Feed the watch from a pipe, and return three messages for it."""
        read, self.write = os.pipe()
        self.stream = os.fdopen(read, "rb")
        self.feed: Feed = feed_of_lines(self.watch.scenario, self.stream)
        return [json.dumps({"step": step, "strain_1": 1e-3}) + "\n" for step in range(3)]

    def open_file(self, plain: Path, folder: Path) -> list[str]:
        """Feed the watch from a file that has a header only, and return three rows for it."""
        header, *rows = plain.read_text(encoding="utf-8").splitlines(keepends=True)[:4]
        path = folder / "m.csv"
        path.write_text(header)
        self.stream = path.open("rb")
        self.write = os.open(path, os.O_WRONLY | os.O_APPEND)
        self.feed = CsvFeed(path, self.watch.scenario, follow=True)
        return rows

    def send(self, text: str) -> None:
        os.write(self.write, text.encode())

    def wait_for_decisions(self, count: int) -> None:
        wait_until(lambda: len(self.decisions) >= count)

    def refused_message_is_sent(self) -> bool:
        """Send a message which is no step; return whether the silence was told."""
        self.send('{"step": 0, "no_sensor": 1.0}\n')
        notices = [notice for decision in self.decisions for notice in decision["notices"]]
        return any(notice["kind"] == "quiet" for notice in notices)


@pytest.fixture(scope="module", params=["standard input", "a file that grows"])
def silent_source(
    request: pytest.FixtureRequest, base: Watch, plain: Path, tmp_path_factory: pytest.TempPathFactory
) -> SilentSource:
    return SilentSource(base, plain, tmp_path_factory.mktemp("silent"), request.param)


def test_a_refused_message_is_told_before_any_step(silent_source):
    expected = (-1, ["refused"]) if silent_source.from_standard_input else None
    assert silent_source.first_kinds == expected


def test_silence_is_told_before_anybody_has_decided_anything(silent_source):
    decision = silent_source.decisions[0]
    assert kinds_of_notices([decision]) == [(-1, ["quiet"])]
    assert "control" not in decision
    assert "see whether logger and broker are there" in decision["notices"][0]["sentence"]


def test_a_message_ends_a_silence_and_the_next_silence_tells_its_decision_again(silent_source):
    taken = ["taken"] if silent_source.from_standard_input else []
    heard, quiet = silent_source.decisions[1:3]
    assert kinds_of_notices([heard, quiet]) == [(0, [*taken, "heard"]), (0, ["quiet"])]
    assert quiet == heard | {"notices": quiet["notices"], "told_again": True}


def test_half_a_message_ends_no_silence(silent_source):
    later = silent_source.decisions[3:]
    assert kinds_of_notices(later[:2]) == [(1, ["heard"]), (1, ["quiet"])]
    assert kinds_of_notices(later[2:]) == [(2, ["heard"])]


def test_silence_is_journalled(silent_source):
    decisions = silent_source.decisions
    silent_steps = [step for step, notice in notices_since(silent_source.watch, 0) if notice.kind == "quiet"]
    assert silent_source.journal[-len(decisions) :] == decisions
    assert silent_steps == [0, 0, 1]


def test_the_page_shows_silence_in_its_steps(silent_source):
    """From standard input came other values than the recording has, which contradicts three steps."""
    expected = [["heard", "quiet", "quiet"], ["heard", "quiet"], ["heard"], []]
    if silent_source.from_standard_input:
        expected = [
            ["taken", "heard", "refused", "quiet", "quiet"],
            ["heard", "quiet"],
            ["heard", "refused"],
            ["taken"],
        ]
    steps = viewed(silent_source.watch.folder).records_of_steps(0, 4)
    shown = [[notice["kind"] for notice in step.get("notices", ())] for step in steps]
    assert silent_source.counts_of_recording
    assert shown == expected
