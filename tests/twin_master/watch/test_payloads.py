"""Payloads of Telegraf and InfluxDB: their messages, in which step they are, and what becomes of them."""

import io
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.refusals import Inputs
from tests.twin_master.runs import belief_in_journal, journal
from tests.twin_master.watch.conftest import HANGS, begun, ran
from twin_master.feeds.feed import LinesFeed
from twin_master.feeds.feed_choice import feed_of_lines, feed_of_mappings, file_feed
from twin_master.feeds.line_protocol import write_line
from twin_master.feeds.message import Message, Refused
from twin_master.feeds.payload import PayloadReader
from twin_master.feeds.points import Point, seconds_since_1970
from twin_master.scenario.reading import load_scenario
from twin_master.watch.folder import Watch

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches
INPUTS = Inputs(__file__)
EPOCH = 1_714_557_600  # 1 May 2024, 10:00 UTC
SCENARIO = load_scenario("level_turns").scenario.with_changes("watch", seconds_per_step=1.0)


def read(payload: str) -> list[Message | Refused]:
    return PayloadReader(SCENARIO).read(payload.encode())


def only_message(payload: str) -> Message:
    (message,) = read(payload)
    assert isinstance(message, Message), message
    return message


METRIC = {
    "fields": {"strain_1_microstrain": 812.5, "strain_2": 1e-4},
    "name": "wing",
    "tags": {"host": "logger", "control": "3g"},
    "timestamp": EPOCH,
}
FORMS = {
    "line protocol": f"wing,host=logger,control=3g strain_1_microstrain=812.5,strain_2=1e-4 {EPOCH}000000000",
    "line protocol with blanks escaped": (
        rf"wing,host=my\ logger,control=3g strain_1\ [microstrain]=812.5,strain_2=1e-4 {EPOCH}000000000"
    ),
    "a line for each gauge": (
        f"strain_1_microstrain,control=3g value=812.5 {EPOCH}000000000\n"
        f"# a comment\nstrain_2,control=3g value=1e-4 {EPOCH}000000000\n"
    ),
    "a metric": json.dumps(METRIC),
    "a metric with nested fields": json.dumps(
        {**METRIC, "fields": {"strain": {"1": {"microstrain": 812.5}, "2": 1e-4}}}
    ),
    "a batch of a metric for each gauge": json.dumps(
        {
            "metrics": [
                {**METRIC, "fields": {"value": 812.5}, "name": "strain_1_microstrain"},
                {**METRIC, "fields": {"value": 1e-4}, "name": "strain_2"},
            ]
        }
    ),
}


@pytest.mark.parametrize("payload", FORMS.values(), ids=FORMS)
def test_each_form_is_the_same_message(payload):
    message = only_message(payload)
    assert message.observed[:2] == pytest.approx([812.5e-6, 1e-4], rel=1e-15)
    assert np.isnan(message.observed[2:]).all()
    assert (message.time, message.control, message.step) == (EPOCH, 1, None)


@pytest.mark.parametrize("units_per_second", [1, 10**3, 10**6, 10**9])
def test_the_size_of_a_timestamp_shows_its_unit(units_per_second):
    message = only_message(f"wing strain_1=1e-4 {EPOCH * units_per_second + units_per_second // 2}")
    assert message.time == pytest.approx(EPOCH + 0.5 * (units_per_second > 1), abs=1e-6)


@given(st.integers(10**8, 10**11 - 1), st.sampled_from([1, 10**3, 10**6, 10**9]))
def test_any_time_after_1973_is_read_in_any_unit(seconds, units_per_second):
    assert seconds_since_1970(seconds * units_per_second) == pytest.approx(seconds, rel=1e-15)


@pytest.mark.parametrize("step", ["12", "12i", "12u"])
def test_a_field_names_the_step_whatever_clock_the_publisher_has(step):
    message = only_message(f"wing step={step},strain_1=1e-4 17")
    assert (message.step, message.time) == (12, None)


def test_a_payload_has_a_message_for_each_time():
    lines = [f"wing strain_1={1e-4 * number} {EPOCH + number}" for number in (1, 2, 3)]
    messages = read("\n".join([lines[0], "wing strain_1=?", *lines[1:]]))
    assert isinstance(messages[0], Refused)
    assert [message.time - EPOCH for message in messages[1:]] == [1, 2, 3]


def test_a_gauge_without_a_number_is_lost_alone():
    message = only_message(f'wing strain_1=nan,strain_2="OL",strain_3=t,strain_4=1e-4 {EPOCH}')
    assert set(message.unreadable) == {0, 1, 2}
    assert message.observed[3] == 1e-4


@pytest.mark.parametrize(("payload", "sentence"), INPUTS.refused("payloads"))
def test_what_is_wrong_is_said(payload, sentence):
    (refusal,) = read(payload)
    assert isinstance(refusal, Refused)
    with pytest.raises(Refused, match=sentence):
        raise refusal


@given(st.binary(max_size=60))
def test_any_bytes_are_messages_or_refused(payload):
    assert all(isinstance(message, Message | Refused) for message in PayloadReader(SCENARIO).read(payload))


class Published:
    """A mission as Telegraf would write it, in each form, a step each second."""

    def __init__(self, mission: Any) -> None:
        self.points = []
        for step, row in enumerate(mission.observed):
            fields = {f"strain_{number}": value for number, value in enumerate(row.tolist(), 1)}
            control = ("2g", "3g")[mission.control_index[step]]
            time = (EPOCH + step) * 10**9
            self.points.append(Point("wing", fields, {"host": "logger", "control": control}, time))

    def lines(self) -> list[str]:
        return [write_line(point) for point in self.points]

    def metrics(self) -> list[dict[str, Any]]:
        return [
            {"fields": dict(p.fields), "name": p.measurement, "tags": dict(p.tags), "timestamp": p.timestamp}
            for p in self.points
        ]

    def batches(self) -> list[str]:
        metrics = self.metrics()
        return [json.dumps({"metrics": metrics[first : first + 7]}) for first in range(0, len(metrics), 7)]


@pytest.fixture(scope="module")
def published(mission) -> Published:
    return Published(mission)


@pytest.fixture
def timed_watch(watch: Watch) -> Watch:
    """A watch whose steps are a second apart."""
    watch.scenario = watch.scenario.with_changes("watch", seconds_per_step=1.0)
    return watch


def check_mission(watch: Watch, mission: Any) -> None:
    """Check that the belief in each step is that of the mission."""
    assert [line["filtered"] for line in journal(watch.folder)] == belief_in_journal(mission.filtered)


@pytest.mark.parametrize("form", ["lines", "batches"])
def test_a_pipe_of_telegraf_leads_to_the_belief_of_the_mission(timed_watch, mission, published, form):
    stream = io.BytesIO("\n".join(getattr(published, form)()).encode())
    counts = ran(timed_watch, feed_of_lines(timed_watch.scenario, stream))
    check_mission(timed_watch, mission)
    assert (counts.received, counts.rejected) == (len(mission.observed), 0)


def test_metrics_of_a_program_lead_to_the_belief_of_the_mission(timed_watch, mission, published):
    ran(timed_watch, feed_of_mappings(timed_watch.scenario, published.metrics()))
    check_mission(timed_watch, mission)


@pytest.mark.parametrize(("name", "form"), [("wing.out", "lines"), ("wing.json", "batches")])
def test_a_file_of_telegraf_is_resumed_after_any_step(timed_watch, mission, published, tmp_path, name, form):
    """Also in the middle of a batch, the rest of which is read again."""
    path = tmp_path / name
    path.write_text("\n".join(getattr(published, form)()) + "\n", encoding="utf-8")
    feed = file_feed(path, timed_watch.scenario)
    assert isinstance(feed, LinesFeed)
    for steps in (1, 10, 11, None):
        counts = ran(timed_watch, file_feed(path, timed_watch.scenario), steps)
    check_mission(timed_watch, mission)
    assert (counts.rejected, counts.missing) == (0, 0)


def test_a_file_is_followed_while_telegraf_writes_it(timed_watch, mission, published, tmp_path):
    """It is empty at first, so that its name shows what will be in it."""
    path = tmp_path / "wing.lp"
    path.touch()
    steps = len(mission.observed)
    feed = file_feed(path, timed_watch.scenario, follow=True)
    writer = f"""
import sys, time
with open({str(path)!r}, "a", encoding="utf-8") as file:
    for line in sys.stdin:
        file.write(line[:40]); file.flush()
        file.write(line[40:]); file.flush()
"""
    process = subprocess.Popen([sys.executable, "-c", writer], stdin=subprocess.PIPE, text=True)
    assert process.stdin is not None
    try:
        with process.stdin:
            process.stdin.write("\n".join(published.lines()) + "\n")
        ran(timed_watch, feed, steps)
        assert process.wait(HANGS) == 0
    finally:
        process.kill()
        process.wait()
    check_mission(timed_watch, mission)


def test_json_lines_may_stand_in_a_file(watch, mission, tmp_path):
    path = tmp_path / "wing.log"
    rows = []
    for row, control in zip(mission.observed, mission.control_index, strict=True):
        rows.append(json.dumps({"control": ("2g", "3g")[control], "strain": row.tolist()}))
    path.write_text("\n".join(rows), encoding="utf-8")
    ran(watch, file_feed(path, watch.scenario))
    check_mission(watch, mission)


def test_gauges_that_come_one_by_one_end_in_the_belief_of_all(base, mission, published, tmp_path):
    """Each further gauge of a step revises it; the belief is that of a message with all gauges."""
    steps = 6
    watch = begun(base, tmp_path / "watch")
    watch.scenario = watch.scenario.with_changes("watch", seconds_per_step=1.0)
    lines = []
    for point in published.points[:steps]:
        for name, value in point.fields.items():
            lines.append(write_line(Point("wing", {name: value}, point.tags, point.timestamp)))
    ran(watch, feed_of_lines(watch.scenario, io.BytesIO("\n".join(lines).encode())))
    last = [line for line in journal(watch.folder) if "filtered" in line][-1]
    np.testing.assert_allclose(last["filtered"], mission.filtered[steps - 1], rtol=1e-9, atol=1e-9)


def test_a_message_with_a_time_alone_needs_the_length_of_a_step(watch):
    line = f"wing strain_1=1e-4 {EPOCH}\n".encode()
    counts = ran(watch, feed_of_lines(watch.scenario, io.BytesIO(line)))
    assert counts.rejected == 1
    assert "no `watch.seconds_per_step`" in Path(watch.folder, "rejected.jsonl").read_text(encoding="utf-8")


PAGE = Path(__file__).parents[3] / "docs/how_to/live_data.md"


def test_the_configurations_of_the_page_are_toml_with_sensors_of_the_wing():
    blocks = re.findall(r"^```toml\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    telegraf, *others = [tomllib.loads(block) for block in blocks]
    assert len(others) == 2
    fields = telegraf["inputs"]["modbus"][0]["request"][0]["fields"]
    metric = {"fields": {field["name"]: 1.0 for field in fields}, "name": "wing", "timestamp": EPOCH * 1000}
    assert only_message(json.dumps(metric)).observed[:2] == pytest.approx([1e-6, 1e-6])


def test_the_lines_of_the_page_are_messages():
    block = re.search(r"^```\n(wing,.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert block is not None
    messages = read(block[1])
    assert [(message.time, message.control) for message in messages] == [(EPOCH, 1), (EPOCH + 1, 1)]
