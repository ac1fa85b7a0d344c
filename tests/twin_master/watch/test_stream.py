"""What is wrong with a stream of messages as a whole is told once; a watch that it taught nothing fails."""

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from tests.command_line import command
from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import begun
from twin_master.errors import ImpossibleObservation
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed_choice import feed_of_lines
from twin_master.feeds.intake import Intake
from twin_master.scenario.reading import LoadedScenario
from twin_master.watch.folder import Watch

pytestmark = pytest.mark.xdist_group("watches")

EPOCH = 1_769_940_000


def with_section(watch: Watch, **keys: Any) -> Watch:
    """Return a watch whose scenario has other keys in its table `[watch]`."""
    watch.scenario = watch.scenario.with_changes("watch", **keys)
    return watch


def line(mission: Any, row: int, **others: Any) -> dict[str, Any]:
    """Return the message of a row of a mission, without saying which step it is."""
    control = ("2g", "3g")[mission.control_index[row]]
    return {"control": control, "strain": mission.observed[row].tolist(), **others}


def decisions_of(watch: Watch, messages: list[Mapping[str, Any]], steps: int | None = None) -> list[Any]:
    """Return what the operator is told of messages."""
    stream = io.BytesIO("".join(json.dumps(message) + "\n" for message in messages).encode())
    decisions = list[Any]()
    watch.run(feed_of_lines(watch.scenario, stream), decisions.append, step_limit=steps)
    return decisions


def kinds(decisions: list[Any]) -> list[tuple[int, str]]:
    return [(decision["step"], notice["kind"]) for decision in decisions for notice in decision["notices"]]


def sentence(decisions: list[Any], kind: str) -> str:
    """Return what a notice says, of which there is one."""
    (found,) = [notice for decision in decisions for notice in decision["notices"] if notice["kind"] == kind]
    return str(found["sentence"])


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
@pytest.mark.parametrize("begin", [0.0, EPOCH])
def test_times_of_another_unit_are_steps_in_their_order_and_the_unit_is_named(
    watch, mission, factor, unit, begin
):
    with_section(watch, seconds_per_step=1.0)
    jitter = [0.0, 0.08, -0.07]
    messages = [line(mission, step, time=factor * (begin + step + jitter[step])) for step in range(3)]
    decisions = decisions_of(watch, messages)
    assert [decision["step"] for decision in decisions] == [0, 1, 2]
    assert kinds(decisions) == [(1, "clock")]
    assert unit in sentence(decisions, "clock")
    np.testing.assert_array_equal(watch.filtered, mission.filtered[2])


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_a_stated_unit_show_gaps(watch, mission, unit, factor):
    with_section(watch, seconds_per_step=1.0, time_unit=unit)
    messages = [line(mission, step, time=factor * (EPOCH + step)) for step in (0, 1, 4)]
    decisions = decisions_of(watch, messages)
    assert [decision["step"] for decision in decisions] == [0, 1, 2, 3, 4]
    assert kinds(decisions) == [(2, "gap")]


def test_a_clock_that_changes_its_unit_is_counted_anew_and_the_unit_is_named(watch, mission):
    with_section(watch, seconds_per_step=1.0)
    messages = [line(mission, step, time=100.0 + step) for step in range(3)]
    messages += [line(mission, step, time=1000.0 * (100.0 + step)) for step in range(3, 7)]
    decisions = decisions_of(watch, messages)
    assert [decision["step"] for decision in decisions] == list(range(7))
    assert kinds(decisions) == [(3, "clock")]
    assert 'its times look like milliseconds: give `watch.time_unit = "ms"`' in sentence(decisions, "clock")


def test_a_gap_of_a_clock_that_is_known_is_a_gap_however_long_where_steps_go_on(watch, mission):
    with_section(watch, seconds_per_step=1.0, between="steps")
    messages = [line(mission, number, time=time) for number, time in enumerate([0.0, 1.0, 1001.0])]
    decisions = decisions_of(watch, messages)
    assert decisions[-1]["step"] == 1001
    told = sentence(decisions, "gap")
    assert told.startswith(
        "Steps 2 to 1000: no message was received, and the belief is predicted over 999 steps"
    )
    assert "milliseconds" not in told


def test_a_gap_is_told_once_by_a_watch_that_ends_within(watch, mission, tmp_path):
    messages = [line(mission, step, step=step) for step in (0, 1, 9)]
    decisions = decisions_of(watch, messages, steps=4) + decisions_of(watch, messages[2:])
    assert kinds(decisions) == [(2, "gap")]
    assert sentence(decisions, "gap").startswith("Steps 2 to 8: no message was received")
    assert decisions[-1]["step"] == 9


@pytest.fixture
def refused_in_rows(watch, mission) -> list[dict[str, Any]]:
    """The decisions of three messages, two refused ones after the first, and five after the second."""
    good = [line(mission, step, step=step) for step in range(3)]
    bad = {"step": "one"}
    return decisions_of(watch, [good[0], bad, bad, good[1], *[bad] * 5, good[2]])


def test_refusals_in_a_row_are_told_once(refused_in_rows):
    told = sentence(refused_in_rows, "refused")
    assert kinds(refused_in_rows) == [(1, "refused"), (2, "taken")]
    assert "Since step 1, 3 messages were received, and all were refused" in told


def test_it_is_told_with_the_last_decision_that_messages_are_taken_again(refused_in_rows, watch):
    assert "after 5 were refused" in sentence(refused_in_rows, "taken")
    assert refused_in_rows[2]["told_again"]
    assert watch.intake.complaint() == ""


def test_a_counter_that_begins_again_is_told_as_that(watch, mission):
    messages = [line(mission, step, step=step) for step in range(8)]
    again = [line(mission, step + 8, step=step) for step in range(4)]
    decisions = decisions_of(watch, messages + again)
    assert kinds(decisions) == [(7, "refused")]
    assert "the steps 0, 1 and 2, which were watched before" in sentence(decisions, "refused")
    assert watch.intake.complaint().startswith(
        "The watch ended while messages were refused: the last 4 of 12"
    )


def test_observations_that_no_state_shows_are_refusals(base, mission):
    """They are refused once their step is assimilated, so that steps go on."""
    text = "".join(json.dumps(line(mission, step, step=step)) + "\n" for step in range(3))
    intake = Intake(base.scenario, feed_of_lines(base.scenario, io.BytesIO(text.encode())))
    twin = base.models[0].knowledge.twin(lag=12)
    for step in range(3):
        reading = intake.read(twin)
        assert reading is not None
        predicted = intake.replace_impossible(reading, ImpossibleObservation("wing", step))
        twin.step(predicted.observed, predicted.control)
    assert "probability zero" in intake.stream.report_refusals(twin.steps).sentence
    assert intake.complaint().startswith("The watch ended while messages were refused: the last 3 of 3")


@pytest.mark.parametrize("name", ["fields", "strian"])
def test_a_message_without_a_known_sensor_is_told_until_one_comes(watch, mission, name):
    with_section(watch, allow_unknown=True)
    good = [line(mission, step, step=step) for step in range(4)]
    blind = [{"step": step, name: [1e-3] * 24} for step in range(4)]
    decisions = decisions_of(watch, [good[0], blind[1], blind[2], good[3]])
    assert [kind for kind in kinds(decisions) if kind[1] == "blind"] == [(1, "blind")]
    assert f"no reading of any gauge; passed over: `{name}`" in sentence(decisions, "blind")


def test_nested_messages_are_refused_and_nothing_is_advised_that_passes_over_all(watch):
    with_section(watch, allow_unknown=True)
    nested = {"fields": {"strain_1_microstrain": 2520.8}, "tags": {"host": "pi"}}
    decisions = decisions_of(watch, [{"step": step, **nested} for step in range(4)])
    assert kinds(decisions) == [(-1, "refused")]
    told = sentence(decisions, "refused")
    assert "`fields` holds an object" in told
    assert "--allow-unknown" not in told


@pytest.mark.parametrize(
    ("message", "is_advised"),
    [
        ({"battery": 3.3, "strain_1": 1e-3}, True),
        ({"battery": 3.3}, False),
        ({"strian_2": 1e-3, "strain_1": 1e-3}, False),
    ],
)
def test_to_pass_over_names_is_advised_only_where_it_helps(watch, message, is_advised):
    decisions_of(watch, [message])
    (record,) = map(json.loads, (watch.folder / "rejected.jsonl").read_text().splitlines())
    assert ("--allow-unknown" in record["reason"]) == is_advised


def test_a_name_that_is_passed_over_and_looks_like_a_slip_is_told_once(watch, mission):
    with_section(watch, allow_unknown=True)
    messages = [{"step": step, "strain_1": 1e-3, "strian_2": 1e-3, "battery": 3.3} for step in range(3)]
    decisions = decisions_of(watch, messages[:2]) + decisions_of(watch, messages[2:])
    assert kinds(decisions) == [(0, "passed_over")]
    assert sentence(decisions, "passed_over") == (
        "Step 0: passed over as no gauge: `strian_2` (probably `strain_2`)."
    )


def test_a_watch_that_was_stopped_anywhere_tells_the_same(base, mission, tmp_path):
    header = "step,control," + ",".join(f"strain_{number}" for number in range(1, 25))
    rows = [f"{step},3g," + ",".join(map(repr, row)) for step, row in enumerate(mission.observed.tolist())]
    bad = ["no,3g" + ",1e-3" * 24]
    path = tmp_path / "m.csv"
    parts = [header, *rows[:3], *bad * 4, *rows[3:5], *rows[9:11], *bad * 2, "11,3g" + "," * 24, *rows[12:14]]
    path.write_text("\n".join(parts) + "\n", encoding="utf-8")
    told = []
    for name, stops in (("whole", (None,)), ("stopped", (1, 3, 4, 6, 8, 10, 12, None))):
        watch = begun(base, tmp_path / name)
        for steps in stops:
            watch.run(CsvFeed(path, watch.scenario), str, step_limit=steps)
        lines = journal(watch.folder)
        told.append([(one["step"], notice) for one in lines for notice in one.get("notices", ())])
    assert told[0] == told[1]
    assert [(step, notice["kind"]) for step, notice in told[0]] == [
        (2, "refused"), (3, "taken"), (5, "gap"), (11, "blind"),
    ]  # fmt: skip


def watched(scenario: LoadedScenario, folder: Path, messages: list[Mapping[str, Any]]) -> Any:
    """Run `uav-twin watch` with messages on its standard input."""
    text = "".join(json.dumps(message) + "\n" for message in messages)
    with patch("sys.stdin", io.TextIOWrapper(io.BytesIO(text.encode()), encoding="utf-8")):
        return command("watch", scenario.path, "--observations", "-", "--out", folder, "--no-report")


REFUSED_LINES = [{"step": step, "fields": {}} for step in range(2)]


def test_a_watch_whose_messages_were_refused_fails(scenario, tmp_path):
    done = watched(scenario, tmp_path / "watch", REFUSED_LINES)
    sentence = "The watch ended while messages were refused: the last 2 of 2 messages"
    assert done.returncode == 1
    assert sentence in done.stderr


def test_a_watch_without_a_reading_fails(scenario, tmp_path):
    blind = [{"step": step, "control": "3g"} for step in range(2)]
    done = watched(scenario, tmp_path / "watch", blind)
    assert done.returncode == 1
    assert "None of 2 messages has a reading of any gauge" in done.stderr


def test_a_watch_with_refused_messages_among_others_succeeds(scenario, mission, tmp_path):
    good = [line(mission, step, step=step) for step in range(2)]
    before, after = REFUSED_LINES
    assert watched(scenario, tmp_path / "watch", [before, *good, after]).returncode == 0
