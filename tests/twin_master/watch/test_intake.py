"""What a publisher sends: put in its place, or refused; never a change of the past, never an end."""

import io
import json
import random
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.refusals import Inputs
from tests.twin_master.runs import of_library
from twin_master.feeds import feed_choice
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import Feed
from twin_master.feeds.intake import Intake
from twin_master.feeds.message import LARGEST_MESSAGE, Message, MessageReader, Refused
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import operate
from twin_master.scenario.tables import WatchSection
from uav_twin import Twin, load_scenario

STEPS = 60
NAMES = [f"strain_{number}" for number in range(1, 25)]


@pytest.fixture(scope="module")
def knowledge(library_file: Path) -> Knowledge:
    return of_library("level_turns", library_file, 0, watch=WatchSection(lag=20, longest_gap=30))[0]


@pytest.fixture(scope="module")
def strains(knowledge: Knowledge) -> np.ndarray:
    """Sixty steps (60, 24) of a wing that is getting worse, as 3g shows it."""
    noise = np.random.default_rng(2).standard_normal((STEPS, 24))
    return knowledge.sensor_model.mean[np.arange(STEPS) // 13 * 6, 1] + 150e-6 * noise


@pytest.fixture(scope="module")
def clean(strains: np.ndarray) -> list[bytes]:
    """Their messages."""
    return [message(row, step=step) for step, row in enumerate(strains)]


@pytest.fixture(scope="module")
def expected(knowledge: Knowledge, clean: list[bytes]) -> Twin:
    """What the clean messages end in."""
    return watched(knowledge, clean)[0]


def message(row: np.ndarray, **others: object) -> bytes:
    shown = [None if np.isnan(value) else value for value in row.tolist()]
    return json.dumps({"control": "3g", "strain": shown, **others}).encode() + b"\n"


def intake_of(
    knowledge: Knowledge, lines: list[bytes], rejected: Path | None = None, feed: Feed | None = None
) -> Intake:
    feed = feed or feed_choice.feed_of_lines(knowledge.scenario, io.BytesIO(b"".join(lines)))
    return Intake(knowledge.scenario, feed, rejected)


def watched(knowledge: Knowledge, lines: list[bytes], rejected: Path | None = None) -> tuple[Twin, Intake]:
    intake, twin = intake_of(knowledge, lines, rejected), knowledge.twin(lag=20)
    for _ in operate(twin, intake):
        pass
    return twin, intake


def same(first: Twin, second: Twin) -> bool:
    return first.save_state() == second.save_state()


@pytest.fixture(scope="module")
def disordered(
    knowledge: Knowledge, clean: list[bytes], tmp_path_factory: pytest.TempPathFactory
) -> tuple[Twin, Intake, list[dict[str, Any]]]:
    """The end of messages that come late, doubled, among garbage and out of order; and what was refused."""
    rejected = tmp_path_factory.mktemp("disordered") / "rejected.jsonl"
    chance = random.Random(5)
    order = sorted(range(STEPS), key=lambda step: step + (chance.random() < 0.2) * chance.randint(1, 15))
    lines: list[bytes] = []
    for step in order:
        lines += [clean[step]] * (1 + (chance.random() < 0.2))
        if chance.random() < 0.2:
            lines.append(chance.randbytes(40).replace(b"\n", b"") + b"\n")
    last_three_times = [clean[STEPS - 1]] * 3
    twin, intake = watched(knowledge, [*lines, *last_three_times], rejected)
    return twin, intake, [json.loads(line) for line in rejected.read_text().splitlines()]


def test_late_doubled_garbage_and_out_of_order_messages_end_as_the_clean_ones(disordered, expected):
    twin, _, _ = disordered
    assert same(twin, expected)


def test_late_doubled_and_refused_messages_are_counted(disordered):
    _, intake, refused = disordered
    assert min(intake.counts.late, intake.counts.duplicates, intake.counts.rejected) >= 5
    assert intake.counts.missing == 0
    assert len(refused) == intake.counts.rejected


def test_refused_messages_are_kept_with_their_reason(disordered):
    _, _, refused = disordered
    assert all(record["reason"] and record["text"] for record in refused)


@pytest.fixture(scope="module")
def without_step_50(clean: list[bytes]) -> list[bytes]:
    """The messages without that of a step."""
    return [line for step, line in enumerate(clean) if step != 50]


def test_a_step_that_never_came_is_predicted_through(knowledge, without_step_50, expected):
    twin, intake = watched(knowledge, without_step_50)
    assert intake.counts.missing == 1
    assert not same(twin, expected)


def test_a_late_control_without_any_sensor_is_something_new(knowledge, clean, without_step_50):
    """The control is not the one that the twin proposed."""
    control_only = b'{"step": 50, "control": "3g"}\n'
    twin, intake = watched(knowledge, [*without_step_50, control_only])
    twin_in_order, _ = watched(knowledge, [*clean[:50], control_only, *clean[51:]])
    assert (intake.counts.late, intake.counts.duplicates) == (1, 0)
    assert same(twin, twin_in_order)


@pytest.mark.parametrize("first_has_control", [True, False])
def test_sensors_of_a_step_may_come_one_by_one(
    knowledge, strains, without_step_50, expected, first_has_control
):
    """If the first message has no control, the other one corrects what was assumed."""
    is_even = np.arange(24) % 2 == 0
    odd, even = (message(np.where(lost, np.nan, strains[50]), step=50) for lost in (is_even, ~is_even))
    if not first_has_control:
        odd = odd.replace(b'"control": "3g", ', b"")
    twin, _ = watched(knowledge, [*without_step_50, odd, even])
    assert same(twin, expected)


class RefusedBehindStep:
    """A file with refused rows before, between and behind two steps; its intake after the first step."""

    def __init__(self, knowledge: Knowledge, folder: Path, cut: str) -> None:
        self.knowledge = knowledge
        self.path, self.rejected = folder / "m.csv", folder / "rejected.jsonl"
        self.path.write_text("step,strain_1\nno,1\n0,1e-4\nno,2\n1,1e-4\nno,3\n")
        intake = intake_of(knowledge, [], self.rejected, self.feed())
        states = [json.dumps(intake.state()) for _ in operate(knowledge.twin(lag=20), intake)]
        self.first_state = json.loads(states[0])
        self.whole = self.rejected.read_text()
        self.rejected.write_text(self.whole + cut)

    def feed(self) -> CsvFeed:
        return CsvFeed(self.path, self.knowledge.scenario)


@pytest.fixture(params=["", '{"message": 7, "rea'], ids=["whole", "half a line that a kill left"])
def refused_behind_step(
    request: pytest.FixtureRequest, knowledge: Knowledge, tmp_path: Path
) -> RefusedBehindStep:
    return RefusedBehindStep(knowledge, tmp_path, request.param)


def test_a_live_feed_keeps_what_was_refused_behind_the_last_step(refused_behind_step):
    case = refused_behind_step
    intake = intake_of(case.knowledge, [], case.rejected)
    intake.restore(case.first_state)
    assert case.rejected.read_text() == case.whole
    assert (intake.counts.rejected, intake.counts.received) == (3, 4)


def test_what_was_refused_behind_the_last_step_is_refused_once_when_it_is_read_again(refused_behind_step):
    case = refused_behind_step
    intake = intake_of(case.knowledge, [], case.rejected, case.feed())
    intake.restore(case.first_state)
    assert [*operate(case.knowledge.twin(lag=20), intake)]
    assert case.rejected.read_text() == case.whole


INPUTS = Inputs(__file__)


def test_what_is_refused_changes_nothing(knowledge, clean, expected, tmp_path):
    rows, path = INPUTS.refused("messages"), tmp_path / "rejected.jsonl"
    lines = [json.dumps(sent).encode() + b"\n" for sent, _ in rows]
    twin, intake = watched(knowledge, [*clean, *lines], path)
    assert same(twin, expected)
    assert intake.counts.rejected == len(rows)
    for (sent, reason), line in zip(rows, path.read_text().splitlines(), strict=True):
        assert reason in json.loads(line)["reason"], sent


KEYS = st.sampled_from(["step", "time", "strain", "strain_1", "unit", "control"])
ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner),
    max_leaves=6,
)


@settings(max_examples=75, deadline=None)
@given(st.binary(max_size=60) | ANYTHING.map(lambda value: json.dumps(value).encode()))
def test_anything_is_an_observation_or_refused(content):
    reader = MessageReader(load_scenario("level_turns").scenario)
    found = reader.read(content)
    assert isinstance(found, Refused) or found.observed.shape == (24,)
    assert isinstance(found, Refused) or not np.isinf(found.observed).any()


def test_a_flood_and_messages_of_ten_megabytes_are_counted_and_forgotten(
    knowledge, clean, expected, tmp_path, monkeypatch
):
    monkeypatch.setattr("twin_master.feeds.rejected.REJECTED_KEPT", 50)
    big = b'{"strain_1": "' + b"x" * 10_000_000 + b'"}\n'
    deep = b'{"strain": ' + b"[" * (LARGEST_MESSAGE // 4) + b"\n"
    flood = [big, deep, b"\xff\xfe{\n", b"NaN\n", b'{"step": NaN}\n', b'{"step": 1e999}\n'] * 3
    lines = [*clean[:30], *flood, *[b"{}x\n"] * 300, *clean[30:]]
    twin, intake = watched(knowledge, lines, tmp_path / "rejected.jsonl")
    lengths = [len(line) for line in (tmp_path / "rejected.jsonl").read_text().splitlines()]
    assert same(twin, expected)
    assert intake.counts.rejected == 318
    assert (len(lengths), max(lengths) < 1200) == (50, True)


RIGHT = [1.7e9 + 0.5 * step for step in range(8)]


JITTERED = [time + 0.1 * (step % 3 - 1) for step, time in enumerate(RIGHT)]
NEVER_SET, SET_FAR_AHEAD, SET_LATE = [0.0, *RIGHT[1:]], [1.7e308, *RIGHT[1:]], [1.7e9, 4e9, *RIGHT[2:]]
"""Times of a clock that was set after its first or second message."""


@pytest.fixture(scope="module")
def timed(knowledge: Knowledge) -> Knowledge:
    """The knowledge with steps of half a second."""
    section = WatchSection(lag=20, longest_gap=30, seconds_per_step=0.5)
    return replace(knowledge, scenario=knowledge.scenario.model_copy(update={"watch": section}))


@pytest.fixture(params=[NEVER_SET, SET_FAR_AHEAD, SET_LATE, JITTERED])
def timed_lines(request: pytest.FixtureRequest, strains: np.ndarray) -> list[bytes]:
    """Messages with a time each."""
    return [message(row, time=time) for time, row in zip(request.param, strains, strict=False)]


def taken_up(timed: Knowledge, state: object, line: bytes) -> Intake:
    """Return an intake of one further line that goes on from a state."""
    intake = intake_of(timed, [line])
    intake.restore(json.loads(json.dumps(state)))
    return intake


def test_times_stand_for_steps_and_a_clock_that_is_set_after_the_first_spoils_none(timed, timed_lines, clean):
    twin, intake = watched(timed, timed_lines)
    assert (twin.steps, intake.counts.rejected, intake.counts.missing) == (8, 0, 0)
    assert same(twin, watched(timed, clean[:8])[0])


def test_a_missing_time_is_a_missing_step(timed, timed_lines, strains):
    twin, intake = watched(timed, [*timed_lines[:4], *timed_lines[5:]])
    assert (twin.steps, intake.counts.missing) == (8, 1)
    np.testing.assert_array_equal(twin.observed(7), strains[7])


@pytest.mark.parametrize("time", [b"1.6e9", b"1.7e308"])
def test_a_clock_that_two_steps_contradict_is_refused_also_after_the_watch_is_taken_up(
    timed, timed_lines, time
):
    """The first time is near enough that a missing limit ends, too."""
    twin, intake = watched(timed, timed_lines)
    again = taken_up(timed, intake.state(), b'{"time": %s, "strain_1": 1e-4}\n' % time)
    assert again.read(twin) is None
    assert again.counts.rejected == 1


def test_the_clock_may_still_be_set_when_a_watch_is_taken_up_after_its_first_step(
    timed, timed_lines, strains
):
    twin, intake = watched(timed, timed_lines[:1])
    reading = taken_up(timed, intake.state(), timed_lines[1]).read(twin)
    assert reading.revises is None
    np.testing.assert_array_equal(reading.observed, strains[1])


class CsvWriter:
    """Writes CSV files, and reads what a feed makes of them."""

    def __init__(self, knowledge: Knowledge, folder: Path) -> None:
        self.scenario = knowledge.scenario
        self.path = folder / "gauges.csv"

    def feed(self, text: str, scenario: Any = None) -> CsvFeed:
        self.path.write_text(text, encoding="utf-8")
        return CsvFeed(self.path, scenario or self.scenario)

    def messages(self, text: str) -> list[Any]:
        return [message for message, _ in self.feed(text).messages(None)]


@pytest.fixture
def csv(knowledge: Knowledge, tmp_path: Path) -> CsvWriter:
    return CsvWriter(knowledge, tmp_path)


@pytest.fixture(scope="module")
def table_with_units(strains: np.ndarray) -> str:
    """The steps as a table whose columns have units; in step 7 a cell, in step 9 all cells say nothing.

    The number of step 11 is a word, and the row of step 12 is cut off.
    """
    forms = [INPUTS.refused("names")[number % 5] for number in range(24)]
    units = np.array([value / 8.12e-4 for _, value in forms])
    rows = [f"{step},3g," + ",".join(map(repr, (units * row).tolist())) for step, row in enumerate(strains)]
    rows[7] = rows[7].replace(repr(float((units * strains[7])[4])), "nan")
    rows[9] = "9,3g" + "," * 24
    rows[11] = "eleven,3g,0.0" + "," * 23
    rows[12] = "12,3g"
    names = [form.replace("strain_3", name) for name, (form, _) in zip(NAMES, forms, strict=True)]
    return "\ufeffstep,control," + ",".join(names) + "\r\n" + "\r\n".join(rows)


def test_rows_that_are_no_step_are_refused_alone(csv, table_with_units):
    messages = csv.messages(table_with_units)
    assert len(messages) == STEPS
    assert [step for step, row in enumerate(messages) if isinstance(row, Refused)] == [11, 12]


def test_columns_with_units_are_read_and_cells_that_say_nothing_are_lost(csv, table_with_units, strains):
    for step, row in enumerate(csv.messages(table_with_units)):
        if isinstance(row, Refused):
            continue
        is_lost = np.isnan(row.observed)
        assert (row.step, row.control) == (step, 1)
        assert is_lost.sum() == {7: 1, 9: 24}.get(step, 0)
        np.testing.assert_allclose(row.observed[~is_lost], strains[step][~is_lost], rtol=1e-15)


def test_a_table_is_read_on_from_where_it_was_left(csv, table_with_units):
    feed = csv.feed(table_with_units)
    read = list(islice(feed.messages(None), 50))
    remaining = [*csv.feed(table_with_units).messages(feed.position)]
    assert (len(read), len(remaining)) == (50, STEPS - 50)


def test_cells_without_a_unit_or_a_finite_number_are_unreadable(csv):
    text = "time,strain_2,strain_1_microstrain\n0.5,0.6,5\n,1e-4,inf\n,nan,5\n"
    without_unit, infinite, readable = cast(list[Message], csv.messages(text))
    assert without_unit.unreadable == {1: "0.6; give its unit, such as `strain_2_microstrain`"}
    assert (infinite.observed[1], infinite.unreadable) == (1e-4, {0: '"inf"'})
    np.testing.assert_allclose(readable.observed[:2], [5e-6, np.nan], rtol=1e-15)


def test_a_step_is_a_whole_number(csv):
    whole, half = csv.messages("step,_rain,strain_1\n12.0,wet,1e-4\n12.5,wet,1e-4\n")
    assert (whole.step, whole.observed[0]) == (12, 1e-4)
    assert "`step` is a whole number" in str(half)


def test_cells_without_an_end_and_other_bytes_are_refused(csv):
    csv.path.write_bytes(b'strain_1\n"' + b"x" * 200_000 + b'"\na\r"b\n\xff\n')
    messages = CsvFeed(csv.path, csv.scenario).messages(None)
    assert all(isinstance(message, Refused) for message, _ in messages)


@pytest.mark.parametrize(("header", "sentence"), INPUTS.refused("headers"))
def test_a_header_that_cannot_be_is_refused(csv, header, sentence):
    with pytest.raises(Exception, match=sentence):
        csv.feed(header + "\n")


@pytest.fixture(scope="module")
def allowing(knowledge: Knowledge) -> Any:
    """The scenario with unknown names allowed."""
    return knowledge.scenario.model_copy(update={"watch": WatchSection(allow_unknown=True)})


def test_an_unknown_column_that_is_allowed_is_passed_over(csv, allowing):
    ((row, _),) = csv.feed("step,strian_1,strain_2\n1,2,1e-4\n", allowing).messages(None)
    assert isinstance(row, Message)
    assert (row.observed[1], np.isnan(row.observed).sum(), row.unreadable) == (1e-4, 23, {})


def test_an_unknown_name_that_is_allowed_is_passed_over(allowing):
    row = MessageReader(allowing).read(b'{"strian_1": 2, "strain_2": 1e-4}')
    assert row.observed[1] == 1e-4


def test_a_gauge_in_a_wrong_unit_is_refused_also_where_unknown_names_are_allowed(allowing):
    refusal = MessageReader(allowing).read(b'{"strain_2_bar": 1e-4}')
    assert "`bar` is not a unit of sensor 2" in str(refusal)


def test_a_message_may_have_one_unit_for_all_sensors(allowing):
    row = MessageReader(allowing).read({"strain": [812.0] * 24, "unit": "microstrain"})
    np.testing.assert_allclose(row.observed, 8.12e-4, rtol=1e-15)


def test_a_sensor_is_read_in_a_prefixed_unit():
    scenario = load_scenario("pump_wear").scenario
    reader = MessageReader(scenario)
    name, unit = next(iter(reader._sensor_of_name)), scenario.observation.sensor_units[0]
    assert reader.read({f"{name} [k{unit}]": 2.0}).observed[0] == 2000.0


@pytest.mark.parametrize(
    ("unit_of_sensor", "unit", "size"),
    [
        ("m2", "mm2", 1e-6),
        ("m\N{SUPERSCRIPT THREE}/s", "mm\N{SUPERSCRIPT THREE}/s", 1e-9),
        ("s^-1", "ms^-1", 1e3),
    ],
)
def test_the_prefix_of_a_power_is_raised_with_its_unit(unit_of_sensor, unit, size):
    scenario = load_scenario("pump_wear").scenario
    observation = scenario.observation.model_copy(update={"unit": unit_of_sensor})
    reader = MessageReader(scenario.model_copy(update={"observation": observation}))
    row = reader.read({f"operation_2 [{unit}]": 3.0})
    np.testing.assert_allclose(row.observed[1], 3.0 * size)


class UnreadableGauge:
    """Nine steps, in the middle three of which gauge 5 has a text: as a list, under its name, as a cell."""

    def __init__(self, strains: np.ndarray, text: str, path: Path) -> None:
        self.list_lines, self.named_lines, self.lines_without_gauge = [], [], []
        self.path = path
        rows = ["step,control," + ",".join(NAMES)]
        for step, strain in enumerate(strains[:9]):
            is_unreadable = 3 <= step < 6
            beginning = f'{{"step": {step}, "control": "3g"'
            values = [repr(value) for value in strain.tolist()]
            if is_unreadable:
                values[4] = text
            named = [f', "{name}": {value}' for name, value in zip(NAMES, values, strict=True)]
            self.list_lines.append(f'{beginning}, "strain": [{", ".join(values)}]}}\n'.encode())
            self.named_lines.append(f"{beginning}{''.join(named)}}}\n".encode())
            if is_unreadable:
                del named[4]
            self.lines_without_gauge.append(f"{beginning}{''.join(named)}}}\n".encode())
            rows.append(f"{step},3g," + ",".join(value.strip('"') for value in values))
        path.write_text("\n".join(rows) + "\n", encoding="utf-8")


def watched_in_two_parts(
    knowledge: Knowledge, lines: list[bytes], path: Path | None = None
) -> tuple[Twin, Intake, list[tuple[int, Any]]]:
    """Watch nine steps of lines or of a file; the watch is taken up after five. Return its notices, too."""
    twin, notices = knowledge.twin(lag=20), []
    state: Any = None
    for begin, end in ((0, 5), (5, 9)):
        feed = CsvFeed(path, knowledge.scenario) if path else None
        intake = intake_of(knowledge, lines[begin:end], feed=feed)
        intake.restore(state)
        for _ in operate(twin, intake):
            notices += [(intake.observation_step, notice) for notice in intake.notices]
            if twin.steps == end:
                break
        state = json.loads(json.dumps(intake.state()))
    return twin, intake, notices


@pytest.mark.parametrize("form", ["list", "names", "csv"])
@pytest.mark.parametrize(("text", "shown"), [*INPUTS.refused("unreadable"), ("9" * 5000, "Infinity")])
def test_an_unreadable_gauge_is_lost_alone_and_named_once(knowledge, strains, tmp_path, text, shown, form):
    gauge = UnreadableGauge(strains, text, tmp_path / "gauges.csv")
    lines = {"list": gauge.list_lines, "names": gauge.named_lines, "csv": []}[form]
    path = gauge.path if form == "csv" else None
    twin, intake, notices = watched_in_two_parts(knowledge, lines, path)
    twin_without_gauge, _ = watched(knowledge, gauge.lines_without_gauge)
    assert same(twin, twin_without_gauge)
    assert (intake.counts.received, intake.counts.rejected) == (9, 0)
    check_notices_of_gauge(notices, "" if form == "csv" else shown)


def check_notices_of_gauge(notices: list[tuple[int, Any]], shown: str) -> None:
    """Check that gauge 5 was left out with the text that it showed, and came back."""
    summary = [(step, notice.kind, notice.sensors) for step, notice in notices]
    sentence = notices[0][1].sentence
    assert summary == [(3, "gauge_left_out", (5,)), (6, "gauge_back", (5,))]
    assert "3: gauge 5 shows " in sentence
    assert shown in sentence


def test_a_gauge_that_does_not_report_is_no_notice(knowledge, strains, tmp_path):
    gauge = UnreadableGauge(strains, "null", tmp_path / "gauges.csv")
    _, intake = watched(knowledge, gauge.lines_without_gauge)
    assert intake.notices == []
