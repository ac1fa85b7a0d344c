"""The journal of a watch that learns: short, told again with what was learnt, read in its first format."""

import json
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.own_process import ended_by
from tests.twin_master.runs import check_same, in_format_1, journal
from tests.twin_master.watch.conftest import (
    Mosquitto,
    before_begin,
    begun,
    mosquitto,
    ran,
    wait_until,
    write_csv,
)
from tests.twin_master.watch.test_brokers import TOPIC, heard_at, run_over, where_of
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import FolderFeed
from twin_master.mission.journal import JOURNAL_NAME, JournalFile, records
from twin_master.mission.recent_parts import RECENT_NAMES
from twin_master.mission.replay import BelievedModel, replay
from twin_master.mission.steps import History
from twin_master.scenario.reading import load_scenario
from twin_master.watch.folder import Watch
from twin_master.watch.teaching import Teaching

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches

STEPS = 150


class LearningWatch:
    """A watch that learns and gives notice, of three missions one after another, and its decisions."""

    def __init__(self, base: Watch, mission: History, folder: Path) -> None:
        self._base = base
        observed = np.tile(mission.observed, (3, 1))
        self.recording = write_csv(folder / "m.csv", observed, np.tile(mission.control_index, 3))
        learning = load_scenario("level_turns_learning").scenario
        tables = {"learning": learning.learning, "notice": learning.notice}
        self._knowledge = replace(base.models[0].knowledge, scenario=base.scenario.model_copy(update=tables))
        self.watch = self.new(folder / "whole")
        self.decisions = list[dict[str, Any]]()
        self.watch.run(CsvFeed(self.recording, self.watch.scenario), self.decisions.append)

    def new(self, folder: Path) -> Watch:
        """Return another watch like it, before its first step."""
        return self.over(begun(self._base, folder))

    def over(self, watch: Watch) -> Watch:
        """Return a watch that learns, too."""
        watch.scenario = self._knowledge.scenario
        watch.models = [BelievedModel(0, self._knowledge)]
        watch.update_from_journal()
        return watch

    def run(self, watch: Watch, steps: int | None = None) -> None:
        ran(watch, CsvFeed(self.recording, watch.scenario), steps)

    def messages(self, steps: int) -> list[str]:
        """Return the first steps of the recording as messages for a broker."""
        messages = []
        for line in self.recording.read_text().splitlines()[1 : steps + 1]:
            step, control, *cells = line.split(",")
            strain = [float(cell) if cell else None for cell in cells]
            messages.append(json.dumps({"step": int(step), "control": control, "strain": strain}))
        return messages

    def killed_at(self, step: int, folder: Path, name: str) -> Watch:
        """Return a watch that was killed by SIGKILL before or after a method of its journal wrote a step."""
        watch = self.new(folder)
        feed = CsvFeed(self.recording, watch.scenario)
        kill_at(step, partial(ran, watch, feed), after=name == "after")
        return watch


def kill_at(step: int, run: Callable[[], object], *, after: bool) -> None:
    """Run in a process of its own, which is killed before or after its journal has a step."""

    def run_patched() -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(JournalFile, "append", dying_at(step, after=after))
            run()

    assert ended_by(run_patched) == -signal.SIGKILL


def dying_at(step: int, *, after: bool) -> Callable[..., None]:
    """Return `JournalFile.append` that is killed before or after it has written a step."""
    append = JournalFile.append

    def dying(self: JournalFile, record: Any, parts: Any = None) -> None:
        if record.get("step") == step and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        append(self, record, parts)
        if record.get("step") == step:
            os.kill(os.getpid(), signal.SIGKILL)

    return dying


@pytest.fixture(scope="module")
def learning(base: Watch, mission: History, tmp_path_factory: pytest.TempPathFactory) -> LearningWatch:
    return LearningWatch(base, mission, tmp_path_factory.mktemp("learning"))


def test_a_step_of_a_watch_takes_a_kilobyte(learning):
    """Also while an alarm lasts, as here."""
    assert learning.watch.journal.size <= 1100 * STEPS


def test_the_last_decisions_are_in_the_journal_as_they_were_given(learning):
    recent = learning.watch.journal.recent
    lines = [line for line, _, _ in records(learning.watch.journal_path, recent=recent)]
    decisions = [learning.watch.decision_of(line) for line in lines[-64:]]
    assert decisions == learning.decisions[-64:]
    assert "noise_scale[3]" in decisions[0]["learnt"]


@pytest.mark.parametrize(("moment", "last_step"), [("before", 69), ("after", 70)])
def test_after_a_kill_the_last_decision_is_told_again_with_what_was_learnt(
    learning, tmp_path, moment, last_step
):
    watch = learning.killed_at(70, tmp_path / "watch", moment)
    assert watch.last_decision() == learning.decisions[last_step] | {"told_again": True}


@pytest.mark.parametrize("step", [63, 64, 100])
def test_a_watch_that_was_killed_has_the_journal_of_one_that_was_not(learning, tmp_path, step):
    watch = learning.killed_at(step, tmp_path / "watch", "after")
    learning.run(learning.over(watch))
    check_same(watch.folder, learning.watch.folder, JOURNAL_NAME, *RECENT_NAMES)


def test_without_its_recent_parts_a_watch_goes_on_alike_and_tells_again_what_its_journal_has(
    learning, tmp_path
):
    watch = learning.killed_at(100, tmp_path / "watch", "after")
    for name in RECENT_NAMES:
        (watch.folder / name).unlink()
    told = watch.last_decision()
    expected = learning.decisions[100] | {"told_again": True}
    del expected["learnt"]
    assert told == expected
    learning.run(learning.over(watch))
    check_same(watch.folder, learning.watch.folder, JOURNAL_NAME)


def test_the_twin_is_restored_from_the_recent_parts(learning):
    """It filters again no more steps than there are since the last snapshot and within the lag."""
    watch = learning.watch
    lag = watch.scenario.watch.lag
    history, _ = replay(watch.journal_path, watch.models, lag)
    assert history.twin.save_state() == watch.twin.save_state()
    assert len(history.steps) <= 32 + lag + 1


def test_the_state_of_teaching_follows_from_any_beginning_of_the_journal(learning, tmp_path):
    """It follows from the lines since the last one that has it, as from all lines."""
    content = learning.watch.journal_path.read_bytes()
    in_order, path = Teaching(100.0), tmp_path / JOURNAL_NAME
    for record, _, end in records(learning.watch.journal_path):
        in_order.take_line(record)
        if record["step"] % 7 == 0:
            path.write_bytes(content[:end])
            restored = Teaching(100.0)
            restored.read_journal(path)
            assert json.dumps(restored.as_record()) == json.dumps(in_order.as_record())


@pytest.fixture(scope="module")
def former(learning: LearningWatch, tmp_path_factory: pytest.TempPathFactory) -> Watch:
    """A watch that was begun with the first format of the journal, and taken up by this version twice."""
    watch = learning.new(tmp_path_factory.mktemp("former") / "watch")
    learning.run(watch, 60)
    in_format_1(watch.folder)
    learning.run(learning.over(watch), 90)
    learning.run(learning.over(watch))
    return watch


def test_a_journal_of_the_first_format_is_gone_on_with(former, learning):
    def told(folder: Path) -> list[dict[str, Any]]:
        names = ("step", "observed", "filtered", "log_evidence", "next_control", "intake", "notices")
        return [{name: record.get(name) for name in names} for record in journal(folder)]

    assert told(former.folder) == told(learning.watch.folder)
    assert former.twin.save_state() == learning.watch.twin.save_state()


def test_a_journal_of_the_first_format_is_fed_again(former, learning):
    feeds = [FolderFeed(watch.folder, watch.scenario) for watch in (former, learning.watch)]
    first, second = ([message.observed for message, _ in feed.messages(None)] for feed in feeds)
    assert len(first) == STEPS
    np.testing.assert_array_equal(first, second)


KILLED_AFTER = (40, 63, 64)
"""Steps after which the watch is killed; 64 begins the other file of recent parts."""
STEPS_OVER_BROKER = 70


class KilledOverBroker:
    """A learning watch that is killed several times over a broker, and the decisions that are heard."""

    def __init__(self, learning: LearningWatch, broker: Mosquitto, folder: Path) -> None:
        watch, where = learning.new(folder), where_of(broker)
        messages = learning.messages(STEPS_OVER_BROKER)
        listener, self.heard = heard_at(broker, "listener")

        def publish(_note: str) -> None:
            for message in messages:
                listener.publish(TOPIC, message, qos=1)

        # All messages but the first wait at the broker
        run_over(where, watch, 1, publish)
        listener.disconnect()
        listener.loop_stop()  # the broker keeps what it is to hear
        for step in KILLED_AFTER:
            learning.over(watch)
            kill_at(step, partial(run_over, where, before_begin(watch), STEPS_OVER_BROKER), after=True)
        learning.over(watch)
        run_over(where, watch, STEPS_OVER_BROKER)
        listener = broker.client("listener", self.heard)
        wait_until(lambda: self.heard and self.heard[-1]["step"] == STEPS_OVER_BROKER - 1)
        listener.disconnect()


def test_a_killed_watch_publishes_what_it_has_learnt_again_with_the_same_bits(learning, tmp_path):
    with mosquitto(tmp_path) as broker:
        heard = KilledOverBroker(learning, broker, tmp_path / "watch").heard
    expected = json.loads(json.dumps(learning.decisions[:STEPS_OVER_BROKER]))
    told_again = {decision["step"] for decision in heard if decision.pop("told_again", False)}
    assert {decision["step"] for decision in heard} == set(range(STEPS_OVER_BROKER))
    assert [decision for decision in heard if decision != expected[decision["step"]]] == []
    assert told_again >= set(KILLED_AFTER)
