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
from twin_master.mission.loop import operate
from twin_master.mission.preparation import Knowledge
from twin_master.scenario.tables import WatchSection
from twin_master.watch import feeds
from twin_master.watch.csv_feed import CsvFeed
from twin_master.watch.feed import Feed
from twin_master.watch.intake import Intake
from twin_master.watch.message import LARGEST_MESSAGE, Message, MessageReader, Refused
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
    feed = feed or feeds.feed_of_json_lines(knowledge.scenario, io.BytesIO(b"".join(lines)))
    return Intake(knowledge.scenario, feed, rejected)


def watched(knowledge: Knowledge, lines: list[bytes], rejected: Path | None = None) -> tuple[Twin, Intake]:
    intake, twin = intake_of(knowledge, lines, rejected), knowledge.twin(lag=20)
    for _ in operate(twin, intake):
        pass
    return twin, intake


def same(first: Twin, second: Twin) -> bool:
    return first.save_state() == second.save_state()


def test_late_doubled_garbage_and_out_of_order_messages_end_as_the_clean_ones(
    knowledge, strains, clean, expected, tmp_path
):
    chance = random.Random(5)
    order = sorted(range(STEPS), key=lambda step: step + (chance.random() < 0.2) * chance.randint(1, 15))
    lines: list[bytes] = []
    for step in order:
        lines += [clean[step]] * (1 + (chance.random() < 0.2))
        if chance.random() < 0.2:
            lines.append(chance.randbytes(40).replace(b"\n", b"") + b"\n")
    twin, intake = watched(knowledge, [*lines, *[clean[STEPS - 1]] * 3], tmp_path / "rejected.jsonl")
    assert same(twin, expected)
    assert min(intake.counts.late, intake.counts.duplicates, intake.counts.rejected) >= 5
    assert intake.counts.missing == 0
    refused = [json.loads(line) for line in (tmp_path / "rejected.jsonl").read_text().splitlines()]
    assert len(refused) == intake.counts.rejected
    assert all(record["reason"] and record["text"] for record in refused)
    # A step that never came is predicted through, and its sensors may come one by one.
    parts = [line for step, line in enumerate(clean) if step != 50]
    gap, counted = watched(knowledge, parts)
    assert counted.counts.missing == 1
    assert not same(gap, expected)
    only = b'{"step": 50, "control": "3g"}\n'  # not what the twin proposed: something new, without any sensor
    late, told = watched(knowledge, [*parts, only])
    assert (told.counts.late, told.counts.duplicates) == (1, 0)
    assert same(late, watched(knowledge, [*clean[:50], only, *clean[51:]])[0])
    even = np.arange(24) % 2 == 0
    halves = [message(np.where(lost, np.nan, strains[50]), step=50) for lost in (even, ~even)]
    assert same(watched(knowledge, [*parts, *halves])[0], expected)
    halves[0] = halves[0].replace(b'"control": "3g", ', b"")  # the other one corrects what was assumed
    assert same(watched(knowledge, [*parts, *halves])[0], expected)


def test_what_was_refused_behind_the_last_step_is_refused_once_when_it_is_read_again(knowledge, tmp_path):
    path, rejected = tmp_path / "m.csv", tmp_path / "rejected.jsonl"
    path.write_text("step,strain_1\nno,1\n0,1e-4\nno,2\n1,1e-4\nno,3\n")
    intake = intake_of(knowledge, [], rejected, CsvFeed(path, knowledge.scenario))
    states = [json.dumps(intake.state()) for _ in operate(knowledge.twin(lag=20), intake)]
    whole = rejected.read_text()
    for cut in ("", '{"message": 7, "rea'):  # a kill may leave half a line
        rejected.write_text(whole + cut)
        live = intake_of(knowledge, [], rejected)
        live.restore(json.loads(states[0]))  # it keeps all
        assert rejected.read_text() == whole
        assert (live.counts.rejected, live.counts.received) == (3, 4)
        rejected.write_text(whole + cut)
        again = intake_of(knowledge, [], rejected, CsvFeed(path, knowledge.scenario))
        again.restore(json.loads(states[0]))
        assert [*operate(knowledge.twin(lag=20), again)]
        assert rejected.read_text() == whole


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
    monkeypatch.setattr("twin_master.watch.rejected.REJECTED_KEPT", 50)
    big = b'{"strain_1": "' + b"x" * 10_000_000 + b'"}\n'
    deep = b'{"strain": ' + b"[" * (LARGEST_MESSAGE // 4) + b"\n"
    flood = [big, deep, b"\xff\xfe{\n", b"NaN\n", b'{"step": NaN}\n', b'{"step": 1e999}\n'] * 3
    lines = [*clean[:30], *flood, *[b"{}x\n"] * 300, *clean[30:]]
    twin, intake = watched(knowledge, lines, tmp_path / "r")
    assert same(twin, expected)
    assert intake.counts.rejected == 318
    content = (tmp_path / "r").read_text().splitlines()
    assert len(content) == 50
    assert max(map(len, content)) < 1200


RIGHT = [1.7e9 + 0.5 * step for step in range(8)]


JITTERED = [time + 0.1 * (step % 3 - 1) for step, time in enumerate(RIGHT)]


@pytest.mark.parametrize(
    "times", [[0.0, *RIGHT[1:]], [1.7e308, *RIGHT[1:]], [1.7e9, 4e9, *RIGHT[2:]], JITTERED]
)  # the first three of a clock that was not yet set
def test_times_stand_for_steps_and_a_clock_that_is_set_after_the_first_spoils_none(
    knowledge, strains, clean, times
):
    section = WatchSection(lag=20, longest_gap=30, seconds_per_step=0.5)
    timed = replace(knowledge, scenario=knowledge.scenario.model_copy(update={"watch": section}))

    def taken_up(state: object, line: bytes) -> Intake:
        intake = intake_of(timed, [line])
        intake.restore(json.loads(json.dumps(state)))
        return intake

    lines = [message(row, time=time) for time, row in zip(times, strains, strict=False)]
    twin, intake = watched(timed, lines)
    assert (twin.steps, intake.counts.rejected, intake.counts.missing) == (8, 0, 0)
    assert same(twin, watched(timed, clean[:8])[0])
    gap, counted = watched(timed, [*lines[:4], *lines[5:]])
    assert (gap.steps, counted.counts.missing) == (8, 1)
    np.testing.assert_array_equal(gap.observed(7), strains[7])
    # Two steps have agreed about the time: another such clock is refused, also by a watch that is taken up;
    # the first is near enough that a missing limit ends, too.
    for later in (b"1700000500", b"1.6e9", b"1.7e308"):
        again = taken_up(intake.state(), b'{"time": %s, "strain_1": 1e-4}\n' % later)
        assert again.read(twin) is None
        assert again.counts.rejected == 1
    twin, intake = watched(timed, lines[:1])  # taken up after its first step the clock may still be set
    reading = taken_up(intake.state(), lines[1]).read(twin)
    assert reading.revises is None
    np.testing.assert_array_equal(reading.observed, strains[1])


def test_csv_as_people_write_it(knowledge, strains, tmp_path):
    path = tmp_path / "gauges.csv"

    def feed(text: str, scenario: Any = knowledge.scenario) -> CsvFeed:
        path.write_text(text, encoding="utf-8")
        return CsvFeed(path, scenario)

    def messages(text: str) -> list[Any]:
        return [fed[0] for fed in feed(text).messages(None)]

    forms = [INPUTS.refused("names")[number % 5] for number in range(24)]  # names with units
    scale = np.array([value / 8.12e-4 for _, value in forms])
    rows = [f"{step},3g," + ",".join(map(repr, (scale * row).tolist())) for step, row in enumerate(strains)]
    rows[7] = rows[7].replace(repr(float((scale * strains[7])[4])), "nan")
    rows[9] = "9,3g" + "," * 24
    rows[11] = "eleven,3g,0.0" + "," * 23
    rows[12] = "12,3g"
    names = ",".join(form.replace("strain_3", name) for name, (form, _) in zip(NAMES, forms, strict=True))
    text = "\ufeffstep,control," + names + "\r\n" + "\r\n".join(rows)
    found = messages(text)
    assert len(found) == STEPS
    assert [step for step, fed in enumerate(found) if isinstance(fed, Refused)] == [11, 12]
    for step, fed in enumerate(found):
        if not isinstance(fed, Refused):
            assert (fed.step, fed.control) == (step, 1)
            lost = np.isnan(fed.observed)
            assert lost.sum() == {7: 1, 9: 24}.get(step, 0)
            np.testing.assert_allclose(fed.observed[~lost], strains[step][~lost], rtol=1e-15)
    read = feed(text)
    assert len(list(islice(read.messages(None), 50))) == 50
    assert len([*feed(text).messages(read.position)]) == STEPS - 50
    text = "time,strain_2,strain_1_microstrain\n0.5,0.6,5\n,1e-4,inf\n,nan,5\n"
    units, infinite, fine = cast(list[Message], messages(text))
    assert units.unreadable == {1: "0.6; give its unit, such as `strain_2_microstrain`"}
    assert (infinite.observed[1], infinite.unreadable) == (1e-4, {0: '"inf"'})
    np.testing.assert_allclose(fine.observed[:2], [5e-6, np.nan], rtol=1e-15)
    whole, half = messages("step,_rain,strain_1\n12.0,wet,1e-4\n12.5,wet,1e-4\n")
    assert (whole.step, whole.observed[0]) == (12, 1e-4)
    assert "not a number" in str(half)
    path.write_bytes(b'strain_1\n"' + b"x" * 200_000 + b'"\na\r"b\n\xff\n')
    refused = CsvFeed(path, knowledge.scenario).messages(None)
    assert all(isinstance(fed[0], Refused) for fed in refused)
    for header, sentence in INPUTS.refused("headers"):
        with pytest.raises(Exception, match=sentence):
            feed(header + "\n")
    allowing = knowledge.scenario.model_copy(update={"watch": WatchSection(allow_unknown=True)})
    ((passed, _),) = feed("step,strian_1,strain_2\n1,2,1e-4\n", allowing).messages(None)
    assert isinstance(passed, Message)
    assert (passed.observed[1], np.isnan(passed.observed).sum(), passed.unreadable) == (1e-4, 23, {})
    assert MessageReader(allowing).read(b'{"strian_1": 2, "strain_2": 1e-4}').observed[1] == 1e-4
    together = MessageReader(allowing).read({"strain": [812.0] * 24, "unit": "microstrain"})
    np.testing.assert_allclose(together.observed, 8.12e-4, rtol=1e-15)
    scenario = load_scenario("pump_wear").scenario
    pump, unit = MessageReader(scenario), scenario.observation.sensor_units[0]
    assert pump.read({f"{next(iter(pump._sensor_of_name))} [k{unit}]": 2.0}).observed[0] == 2000.0
    for own, unit, size in (
        ("m2", "mm2", 1e-6),
        ("m\N{SUPERSCRIPT THREE}/s", "mm\N{SUPERSCRIPT THREE}/s", 1e-9),
        ("s^-1", "ms^-1", 1e3),
    ):
        leak = scenario.observation.model_copy(update={"unit": own})
        reader = MessageReader(scenario.model_copy(update={"observation": leak}))
        np.testing.assert_allclose(reader.read({f"operation_2 [{unit}]": 3.0}).observed[1], 3.0 * size)
    refused = MessageReader(allowing).read(b'{"strain_2_bar": 1e-4}')  # a gauge that is there
    assert "`bar` is not a unit of sensor 2" in str(refused)


@pytest.mark.parametrize(("text", "shown"), [*INPUTS.refused("unreadable"), ("9" * 5000, "Infinity")])
def test_an_unreadable_gauge_is_lost_alone_and_named_once(knowledge, strains, tmp_path, text, shown):
    """As a list, under its name, and as a cell; through a watch that is taken up in the middle of it."""
    lines: dict[str, list[bytes]] = {"list": [], "names": [], "lost": []}
    cells = ["step,control," + ",".join(NAMES)]
    for step, row in enumerate(strains[:9]):
        begin, values = f'{{"step": {step}, "control": "3g"', [repr(value) for value in row.tolist()]
        values[4] = text if 3 <= step < 6 else values[4]
        told = [f', "{name}": {value}' for name, value in zip(NAMES, values, strict=True)]
        lines["list"].append(f'{begin}, "strain": [{", ".join(values)}]}}\n'.encode())
        lines["names"].append(f"{begin}{''.join(told)}}}\n".encode())
        told[4] = "" if 3 <= step < 6 else told[4]
        lines["lost"].append(f"{begin}{''.join(told)}}}\n".encode())
        cells.append(f"{step},3g," + ",".join(value.strip('"') for value in values))
    expected, silent = watched(knowledge, lines["lost"])
    assert silent.notices == []
    path = tmp_path / "gauges.csv"
    path.write_text("\n".join(cells) + "\n", encoding="utf-8")
    for name in ("list", "names", "csv"):
        twin, state, notices = knowledge.twin(lag=20), None, []
        for part in (slice(0, 5), slice(5, 9)):
            csv = CsvFeed(path, knowledge.scenario) if name == "csv" else None
            intake = intake_of(knowledge, lines.get(name, [])[part], feed=csv)
            intake.restore(state)
            for _ in operate(twin, intake):
                notices += [(intake.observation_step, notice) for notice in intake.notices]
                if twin.steps == part.stop:
                    break
            state = json.loads(json.dumps(intake.state()))
        assert same(twin, expected)
        assert (intake.counts.received, intake.counts.rejected) == (9, 0)
        said = [(step, notice.kind, notice.sensors) for step, notice in notices]
        assert said == [(3, "gauge_left_out", (5,)), (6, "gauge_back", (5,))]
        assert "3: gauge 5 shows " in notices[0][1].sentence
        assert name == "csv" or shown in notices[0][1].sentence
