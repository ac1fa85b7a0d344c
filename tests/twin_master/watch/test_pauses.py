"""Where counting begins, pauses, jumps of a clock, jitter, and loggers with a rate of their own."""

import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import begun, killed_at, ran
from tests.twin_master.watch.test_stream import EPOCH, decisions_of, kinds, line, sentence, with_section
from twin_master.feeds.feed_choice import file_feed
from twin_master.feeds.message import Message, MessageReader
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.watch.folder import Watch

pytestmark = pytest.mark.xdist_group("watches")

NIGHT = 50_000.0
"""A pause of more steps than the longest gap."""


def timed(mission: Any, times: list[float]) -> list[dict[str, Any]]:
    """Return the first messages of a mission with these times."""
    return [line(mission, row, time=time) for row, time in enumerate(times)]


def numbered(mission: Any, numbers: list[int]) -> list[dict[str, Any]]:
    """Return the first messages of a mission with these numbers of steps."""
    return [line(mission, row, step=number) for row, number in enumerate(numbers)]


def check_filtered_in_order(watch: Watch, mission: Any, count: int) -> None:
    """Check that the first messages of a mission were filtered as its consecutive steps."""
    np.testing.assert_array_equal(watch.filtered, mission.filtered[count - 1])
    assert (watch.twin.steps, watch.intake.counts.rejected) == (count, 0)


@pytest.mark.parametrize("pause", [900.0, 4.0])
def test_nothing_wears_in_a_pause_between_times(watch, mission, pause):
    with_section(watch, seconds_per_step=1.0)
    decisions = decisions_of(watch, timed(mission, [0, 1, 2, 3 + pause, 4 + pause, 5 + pause]))
    check_filtered_in_order(watch, mission, 6)
    assert kinds(decisions) == [(3, "pause")]
    assert f"a pause of {pause:.0f} steps" in sentence(decisions, "pause")
    assert 'give `watch.between = "steps"`' in sentence(decisions, "pause")


def test_nothing_wears_in_a_pause_between_numbers_where_the_scenario_says_so(watch, mission):
    with_section(watch, between="rest")
    decisions = decisions_of(watch, numbered(mission, [0, 1, 2, 900, 901]))
    check_filtered_in_order(watch, mission, 5)
    assert kinds(decisions) == [(3, "pause")]


def test_each_pause_after_steps_in_a_row_is_told(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    decisions = decisions_of(watch, timed(mission, [0, 1, 100, 101, 200, 201]))
    assert kinds(decisions) == [(2, "pause"), (4, "pause")]


@pytest.mark.parametrize("times", [[0, 1, 2, NIGHT, NIGHT + 1], [5, 6, EPOCH, EPOCH + 1, EPOCH + 2]])
def test_a_watch_goes_on_after_more_than_the_longest_gap(watch, mission, times):
    with_section(watch, seconds_per_step=1.0)
    decisions = decisions_of(watch, timed(mission, times))
    check_filtered_in_order(watch, mission, 5)
    assert [kind for _, kind in kinds(decisions)] == ["clock"]
    assert "Counting begins anew with this message" in sentence(decisions, "clock")


def test_where_steps_go_on_the_belief_is_widened_by_the_longest_gap(watch, mission, base, tmp_path):
    gap = with_section(begun(base, tmp_path / "gap"), longest_gap=5)
    decisions_of(gap, numbered(mission, [0, 1, 7, 8]))
    with_section(watch, longest_gap=5)
    decisions = decisions_of(watch, numbered(mission, [0, 1, 70_000, 70_001]))
    np.testing.assert_array_equal(watch.filtered, gap.filtered)
    assert watch.intake.counts.missing == 5
    assert 'give `watch.between = "rest"`' in sentence(decisions, "clock")


@pytest.mark.parametrize("first", [1, 1001, 2**53 + 1])
def test_the_first_message_says_where_counting_begins(watch, mission, first):
    decisions = decisions_of(watch, numbered(mission, [first, first + 1, first + 2]))
    check_filtered_in_order(watch, mission, 3)
    assert kinds(decisions) == [(0, "begin")]
    assert f"calls itself step {first}." in sentence(decisions, "begin")


def test_a_decision_has_the_step_by_the_count_of_the_messages(watch, mission):
    with_section(watch, between="rest")
    decisions = decisions_of(watch, numbered(mission, [1001, 1002, 2000, 2001]))
    assert [decision["step"] for decision in decisions] == [0, 1, 2, 3]
    assert [decision["message_step"] for decision in decisions] == [1001, 1002, 2000, 2001]


@pytest.mark.parametrize("wrong_number", [65_538, 2**60])
def test_a_counter_returns_from_a_wrong_number(watch, mission, wrong_number):
    with_section(watch, between="rest")
    decisions = decisions_of(watch, numbered(mission, [0, 1, wrong_number, 3, 4, 5]))
    check_filtered_in_order(watch, mission, 6)
    assert kinds(decisions) == [(2, "clock")]


def test_a_message_from_within_a_pause_is_refused_with_the_remedy(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    decisions_of(watch, timed(mission, [0, 1, 100, 101, 50]))
    (record,) = map(json.loads, (watch.folder / "rejected.jsonl").read_text().splitlines())
    assert "it belongs to the pause before step 2" in record["reason"]
    assert 'give `watch.between = "steps"`' in record["reason"]


def test_messages_doubled_around_a_pause_are_duplicates(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    messages = timed(mission, [0, 1, 100, 101])
    decisions_of(watch, [*messages, *messages])
    check_filtered_in_order(watch, mission, 4)
    assert watch.intake.counts.duplicates == 4


def jittered_times(seed: int) -> list[float]:
    """Return forty times of steps of a second with a jitter of 0.4 s, the first at one of its ends."""
    jitter = np.random.default_rng(seed).uniform(-0.4, 0.4, 40)
    jitter[0] = 0.4 if seed % 2 else -0.4
    return (EPOCH + np.arange(40) + jitter).tolist()


@pytest.mark.parametrize("seed", range(4))
def test_jitter_of_four_tenths_of_a_step_loses_nothing(watch, mission, seed):
    with_section(watch, seconds_per_step=1.0)
    decisions = decisions_of(watch, timed(mission, jittered_times(seed)))
    check_filtered_in_order(watch, mission, 40)
    assert kinds(decisions) == []


@pytest.mark.parametrize("seed", range(4))
def test_jittered_messages_that_come_twice_are_duplicates(watch, mission, seed):
    with_section(watch, seconds_per_step=1.0)
    messages = timed(mission, jittered_times(seed))
    decisions_of(watch, [message for message in messages for _ in range(2)])
    check_filtered_in_order(watch, mission, 40)
    assert watch.intake.counts.duplicates == 40


def test_a_late_time_finds_its_step(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    messages = timed(mission, [0, 1, 2.2, 3.1, 4, 5])
    decisions_of(watch, [*messages[:2], *messages[3:5], messages[2], messages[5]])
    check_filtered_in_order(watch, mission, 6)
    assert watch.intake.counts.late == 1


@pytest.mark.parametrize("count", [2, 3, 10])
def test_a_logger_that_sends_too_often_is_told_what_to_do(watch, mission, count):
    with_section(watch, seconds_per_step=1.0)
    times = (EPOCH + np.arange(40) / count).tolist()
    told = sentence(decisions_of(watch, timed(mission, times)), "rate")
    assert told.startswith(f"A message comes every {1 / count:.4g} s, and a step takes 1 s")
    assert f"give `watch.every = {count}`" in told


def test_a_logger_that_sends_too_seldom_is_told_what_to_do(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    decisions = decisions_of(watch, timed(mission, [2.0 * row for row in range(20)]))
    assert "give `watch.seconds_per_step = 2`" in sentence(decisions, "rate")


def test_lost_messages_are_no_other_rate(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    times = [0, 1, 3, 4, 7, 9, 10, 13, 15, 16, 17, 20, 22, 23]
    assert {kind for _, kind in kinds(decisions_of(watch, timed(mission, times)))} == {"gap"}


@pytest.mark.parametrize("key", ["time", "step", None])
def test_every_second_message_is_taken_where_the_scenario_says_so(watch, mission, key):
    with_section(watch, seconds_per_step=1.0, every=2)
    messages = []
    for number in range(12):
        position = {} if key is None else {key: number if key == "step" else EPOCH + 0.5 * number}
        messages.append(line(mission, number // 2 + 30 * (number % 2), **position))
    decisions = decisions_of(watch, messages)
    check_filtered_in_order(watch, mission, 6)
    assert kinds(decisions) == []


DATES = [
    "2026-03-31T10:00:01Z",
    "2026-03-31T10:00:01",
    "2026-03-31 10:00:01.000",
    "2026-03-31 10:00:01 UTC",
    "2026-03-31T12:00:01+02:00",
    "20260331T100001Z",
]


@pytest.mark.parametrize("text", DATES)
@pytest.mark.parametrize("unit", ["s", "ms"])
def test_a_date_and_time_counts_from_1970_in_any_unit_of_times(base, text, unit):
    reader = MessageReader(base.scenario.with_changes("watch", time_unit=unit))
    message = reader.read({"time": text, "strain_1": 1e-4})
    assert isinstance(message, Message)
    assert message.time == 1_774_951_201.0


@pytest.mark.parametrize("value", [1500, 1500.0, "1500", " 1.5e3"])
def test_a_time_may_stand_in_quotes(base, value):
    reader = MessageReader(base.scenario.with_changes("watch", time_unit="ms"))
    assert reader.read({"time": value, "strain_1": 1e-4}).time == 1.5


@pytest.mark.parametrize("value", [5, 5.0, "5", "5.0"])
def test_the_number_of_a_step_may_have_any_form(base, value):
    assert MessageReader(base.scenario).read({"step": value, "strain_1": 1e-4}).step == 5


@pytest.fixture
def eventful(mission: Any, tmp_path: Path) -> Path:
    """A recording with pauses, jumps, gaps, jitter, late and doubled messages, and a fast logger."""
    times = [0, 1, 2.3, 2.9, 7, 8, 107, 108, 109.4, 110, 110, 109.4, 108, 90, NIGHT, NIGHT + 1]
    times += [111, 112, 114, 113, EPOCH, EPOCH + 1, *(EPOCH + 2 + 0.5 * np.arange(12)).tolist()]
    rows = {time: row for row, time in enumerate(dict.fromkeys(times))}
    messages = [line(mission, rows[time], time=time) for time in times]
    numbers = [700, 701, 705, 900_000, 900_001, 703]
    messages += [line(mission, 40 + row, step=number) for row, number in enumerate(numbers)]
    path = tmp_path / "eventful.jsonl"
    path.write_text("".join(json.dumps(message) + "\n" for message in messages), encoding="utf-8")
    return path


def test_a_watch_that_was_killed_anywhere_is_the_same_to_the_bit(base, eventful, tmp_path):
    watches = []
    for name in ("whole", "killed"):
        watch = begun(base, tmp_path / name)
        watches.append(with_section(watch, seconds_per_step=1.0, longest_gap=200))
    whole, killed = watches
    ran(whole, file_feed(eventful, whole.scenario))
    expected = (whole.folder / JOURNAL_NAME).read_bytes()
    told = {notice["kind"] for record in journal(whole.folder) for notice in record.get("notices", ())}
    assert {"pause", "clock", "gap", "rate", "begin"} <= told
    chance = random.Random(1)
    kills, size = 0, 0
    feed = file_feed(eventful, killed.scenario)
    while killed_at(killed, size + chance.randint(1, 12_000), lambda: ran(killed, feed, pause=0.005)):
        kills += 1
        content = (killed.folder / JOURNAL_NAME).read_bytes()
        assert expected.startswith(content)
        size = len(content)
    assert kills >= 5
    assert (killed.folder / JOURNAL_NAME).read_bytes() == expected
