"""The view of a flight: its numbers against those of the run, its protocol, its page in a real browser."""

import json
import os
import re
import select
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, open_browser
from fe.wing.design import SHIPPED_DESIGN
from reporting.figures import new_figure, to_svg
from tests.refusals import Inputs
from tests.twin_master.runs import check_same
from tests.twin_master.watch.conftest import served, viewed
from twin_master.assets.design_source import DESIGN_COPY
from twin_master.errors import RunFolderError
from twin_master.mission.journal import JOURNAL_NAME, encode_line
from twin_master.mission.preparation import KNOWLEDGE_NAME
from twin_master.viewer.flight import Flight, StepBeliefs
from twin_master.viewer.flight_page import LATEST, FlightPage, Request
from uav_twin import fly, load_scenario, open_run

STEPS = 50


@pytest.fixture(scope="module")
def run(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("view") / "run"
    fly(load_scenario("level_turns"), folder, {"strain_library": library_file}, report=False)
    # The gauges of the library are those of the shipped wing: with its design the page shows them from above.
    shutil.copy(SHIPPED_DESIGN, folder / DESIGN_COPY)
    return folder


@pytest.fixture
def lines(run: Path) -> list[bytes]:
    return (run / JOURNAL_NAME).read_bytes().splitlines(keepends=True)


@pytest.fixture
def begun(run: Path, tmp_path: Path) -> Path:
    """The run before its first step."""
    folder = Path(shutil.copytree(run, tmp_path / "begun"))
    (folder / JOURNAL_NAME).unlink()
    (folder / "run.nc").unlink()
    return folder


def add(folder: Path, *content: bytes) -> None:
    with (folder / JOURNAL_NAME).open("ab") as file:
        file.writelines(content)


def of_steps(flight: Flight, first: int, end: int) -> StepBeliefs:
    """Return what the twin believed of steps when they were flown."""
    return flight.beliefs_in(flight.records_of_steps(first, end))


def asked(first: int = 0, end: int = 0, step: int = LATEST, **changed: int) -> Request:
    given = {"number": 1, "flight": -1, "shown": -1, "count": -1} | changed
    return Request(first=first, end=end, step=step, **given)


def test_every_number_is_that_of_the_run(run):
    flight, stored = viewed(run), open_run(run)
    assert flight.steps == STEPS
    believed, expected = (
        of_steps(flight, 0, STEPS),
        flight.prediction_after(flight.records_of_steps(28, 29)[0]),
    )
    for belief, group, part, control in (
        (believed, "filtered", slice(None), "decision_probability"),
        (expected, "predicted", 28, "control_probability"),
    ):
        values = {name: stored[group][name].values[part] for name in stored[group].data_vars}
        np.testing.assert_array_equal(belief.probability, values["probability"])
        np.testing.assert_array_equal(belief.control_probability, values[control])
        for name in ("reward_mean", "reward_standard_deviation", "quantity_mean"):
            found = getattr(belief.expected, name.removeprefix("quantity_"))
            np.testing.assert_array_equal(found, values[name], err_msg=name)
    deviation = stored["filtered"]["quantity_standard_deviation"].values
    np.testing.assert_allclose(believed.expected.standard_deviation, deviation, rtol=1e-9)
    noise = stored["filtered"]["noise_standard_deviation"].values
    np.testing.assert_allclose(believed.expected.noise, noise, rtol=1e-9)
    np.testing.assert_array_equal(
        flight.true_states_in(flight.records_of_steps(0, STEPS)), stored["truth"]["state"].values
    )


def test_steps_are_seen_as_soon_as_their_lines_are_whole_and_forgotten_where_they_are_taken_back(
    begun, lines
):
    """A line that was changed ends the view with its number."""
    flight = Flight(begun)
    assert not flight.update()
    for content, steps in (([*lines[:20], lines[20][:40]], 19), ([lines[20][40:]], 20)):
        add(begun, *content)
        assert [flight.update(), flight.steps, flight.update()] == [True, steps, False]
    number = flight.number
    (begun / JOURNAL_NAME).write_bytes(b"".join(lines[:11]))  # as a resumed run does
    flight.update()
    assert (flight.steps, flight.number) == (10, number + 1)
    # A viewer that holds the twenty steps is told all ten again.
    answer = told(FlightPage(flight), 0, 20, flight=number, shown=19, count=20)
    assert (answer["first"], answer["count"], len(answer["past"]["control"])) == (0, 10, 10)
    add(begun, lines[11].replace(b'"step": 10', b'"step": 11'), *lines[12:])
    with pytest.raises(RunFolderError, match=r"line 12 of the journal .* was changed or is damaged"):
        flight.update()


def test_an_observation_that_came_late_stands_in_its_step(begun, lines):
    steps = [json.loads(line[65:]) for line in lines[1:]]
    missed = steps[6] | {"observed": [None] * 24}
    late = steps[9] | {"observation_step": 6, "observed": steps[6]["observed"]}
    add(begun, lines[0], *map(encode_line, [*steps[:6], missed, *steps[7:10]]))
    flight = viewed(begun)
    number = flight.number
    add(begun, encode_line(late | {"filtered": steps[20]["filtered"]}))
    assert flight.update()
    assert (flight.steps, flight.number) == (10, number + 1)
    expected = [step["observed"] for step in steps[:10]]
    np.testing.assert_array_equal(
        flight.observations_in(flight.records_of_steps(0, 10)), np.array(expected, dtype=float)
    )
    last = [step["filtered"] for step in flight.records_of_steps(8, 10)]
    assert last == [steps[8]["filtered"], steps[20]["filtered"]]
    add(begun, *map(encode_line, [{"model": {}}, *steps[10:20]]))
    assert viewed(begun).steps == 20
    flight.update()
    add(begun, encode_line(steps[30]))
    with pytest.raises(RunFolderError, match="tells step 30 where 20 was expected"):
        flight.update()
    journal = begun / JOURNAL_NAME
    journal.rename(begun / "before")
    journal.write_bytes(b"".join(lines[:4]))  # another flight
    assert FlightPage(flight).answer(asked()) is None  # until it is seen
    assert flight.update()
    assert flight.steps == 3


@pytest.mark.parametrize("content", [None, b"", b"PK\x05\x06" + bytes(18), b"no archive"])
def test_without_what_the_twin_knew_nothing_is_shown(begun, content):
    (begun / KNOWLEDGE_NAME).unlink()
    if content is not None:
        (begun / KNOWLEDGE_NAME).write_bytes(content)
    with pytest.raises(RunFolderError, match=r"twin\.npz is missing, damaged or of another scenario"):
        Flight(begun)


def told(teller: FlightPage, *words: int, **changed: int) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(str(teller.answer(asked(*words, **changed))))
    return answer


def test_a_viewer_is_told_what_it_misses_and_nothing_else(run):
    flight = viewed(run)
    teller = FlightPage(flight)
    everything = told(teller)
    assert (everything["step"], everything["first"], everything["count"]) == (STEPS - 1, 0, STEPS)
    number = everything["flight"]
    missed = told(teller, 0, 30, flight=number, shown=29, count=30)
    assert missed["first"] == 30
    np.testing.assert_allclose(missed["past"]["state"], everything["past"]["state"][30:], rtol=1e-12)
    assert teller.answer(asked(0, STEPS, flight=number, shown=STEPS - 1, count=STEPS)) is None
    back = told(teller, 0, STEPS, 7, flight=number, shown=8, count=STEPS)
    assert (back["step"], back["past"]) == (7, None)
    assert len(back["ahead"]["state"]) == 10
    # In printed units, with their bands.
    answer = told(teller, step=28)
    past, believed = answer["past"], of_steps(flight, 0, 29)
    mean = flight.knowledge.model.states.mean(believed.probability)
    wide = np.hypot(believed.expected.standard_deviation, believed.expected.noise)
    np.testing.assert_allclose(past["state"], 100.0 * mean)
    np.testing.assert_allclose(past["observed"], 1e6 * flight.observations_in(flight.records_of_steps(0, 29)))
    width = np.subtract(past["sensor_upper"], past["sensor_lower"])
    np.testing.assert_allclose(width, 2 * 1.959963984540054e6 * wide)
    assert np.min(past["state_lower"]) >= 0.0
    assert np.max(past["state_upper"]) <= 80.0
    assert answer["ahead"]["reward"][0][2] is None  # no error reward of a step to come
    with pytest.raises(ValueError, match=r"for Request"):
        Request.model_validate_json(json.dumps(asked().__dict__ | {"step": 1.5}))


@contextmanager
def opened(folder: Path) -> Iterator[str]:
    """Run `uav-twin view` as a user does, and end it with Ctrl-C."""
    process = subprocess.Popen(
        [sys.executable, "-m", "uav_twin", "view", str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert select.select([process.stdout], [], [], 300.0)[0]
        found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
        assert found
        yield found.group()
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(300.0) == 130
        process.stdout.close()


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_the_page_in_a_browser(begun, lines, tmp_path):
    add(begun, *lines[:31])
    with open_browser() as browser, opened(begun) as address:
        port = int(address.rstrip("/").rpartition(":")[2])
        for host, status in ((f"127.0.0.1:{port}", 200), (f"localhost:{port}", 200), ("evil.example", 404)):
            assert served(port, host=host)[0] == status
        own = socket.gethostbyname(socket.gethostname())
        if not own.startswith("127."):  # only this machine is served
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((own, port), timeout=5.0)
        tabs = [browser.tab() for _ in range(3)]
        for tab, width in zip(tabs, (1300, 400, 400), strict=True):
            tab.go(address, width)
        for tab in tabs:
            tab.wait("window.painted.at(-1)[0] === 29")
            assert tab.value("document.documentElement.scrollWidth <= innerWidth")
            edges = tab.value("Object.values(views).map((view) => view.el.getBoundingClientRect().right)")
            assert max(edges) <= tab.value("innerWidth")
        first = tabs[0]
        said = first.value("element('said').textContent")
        assert re.fullmatch(
            r"step 29: z₁ \d+ ± \d+ %, z₂ \d+ ± \d+ %\. Flown 3g; next [23]g with probability [01]\.\d{3}\.",
            said,
        )
        # Keyboard: back by one and by ten, to the start; the others stay where they are.
        for key, step in (("ArrowLeft", 28), ("PageUp", 18), ("Home", 0), ("ArrowLeft", 0), ("PageDown", 10)):
            first.press(key)
            first.wait(
                f"state.shown === {step} && state.wanted === {step} && window.painted.at(-1)[0] === {step}"
            )
        assert first.value("drawn.past.length") == 11
        assert first.value("drawn.ahead") == list(range(11, 21))
        assert first.value("document.querySelectorAll('#wing circle').length") == 24
        assert first.value("document.querySelectorAll('#wing .lost').length") == 0
        assert tabs[1].value("state.shown") == 29
        before = first.picture(tmp_path / "step_10.png")
        # A verdict on motion came behind step 29.
        (begun / "teaching" / "figures").mkdir(parents=True)
        drawing = to_svg(new_figure(2.0))
        (begun / "teaching" / "figures" / "missing_force.svg").write_bytes(drawing)
        said = json.dumps({"verdict": {"sentence": "A spring is <missing>."}})
        (begun / "teaching" / "verdict.json").write_text(said)
        add(begun, encode_line({"verdict": {"folder": "teaching", "notice": {}}}))
        tabs[1].wait("!element('force').hidden && element('picture').naturalWidth > 0")
        assert tabs[1].value("element('verdict').textContent") == "A spring is <missing>."
        assert tabs[1].value("document.documentElement.scrollWidth <= innerWidth")
        assert first.value("element('force').hidden")  # nothing was known at step 10
        # A viewer that was away gets what it missed; one that looks back stays there, and knows of the rest.
        tabs[2].value("socket.onclose = null; socket.close()")
        add(
            begun,
            *lines[31:-1],
            encode_line(json.loads(lines[-1][65:]) | Inputs(__file__).table("told.toml")),
        )
        tabs[1].wait("window.painted.at(-1)[0] === 49")
        first.wait("state.count === 50")
        assert first.value("state.shown") == 10
        tabs[2].value("connect()")
        tabs[2].wait("window.painted.at(-1)[0] === 49 && held.rows.length === 50")
        flown = viewed(begun)
        expected = 100.0 * flown.knowledge.model.states.mean(of_steps(flown, 0, STEPS).probability)
        for tab in tabs[1:]:
            np.testing.assert_allclose(tab.value("held.rows.map((row) => row.state)"), expected)
        assert first.value("element('told').hidden && element('learning').hidden")
        first.press("End")
        first.wait("window.painted.at(-1)[0] === 49")
        assert first.value("element('latest').getAttribute('aria-pressed')") == "true"
        assert first.picture(tmp_path / "step_49.png") != before
        said = first.value("[...element('notices').children].map((item) => item.textContent)")
        assert said == ["Step 49: gauge 4 is off.", "step 49: Look at <b>gauge 3</b>."]
        learnt = "".join(f"{name}0.9512 (0.9400 to 0.9600)" for name in ("e", "a[9]", "a[10]"))
        assert first.value("element('learnt').textContent") == learnt
        # Everything came from this server, and nothing went wrong.
        for tab in tabs:
            tab.value("1")
            assert tab.errors == []
            assert all(url.startswith((address, "data:", "about:")) for url in tab.requests)


def test_a_mission_with_a_view_is_the_same_to_the_bit(library_file, run, tmp_path):
    words = ["run", "level_turns", "--out", tmp_path / "run", "--strain-library", library_file, "--no-report"]
    line = [sys.executable, "-m", "uav_twin", *map(str, words), "--view"]
    null, pipe = subprocess.DEVNULL, subprocess.PIPE
    said = ""
    with subprocess.Popen(line, stdout=null, stderr=pipe, text=True, start_new_session=True) as process:
        try:
            while "http://127.0.0.1" not in said or "stays until Ctrl-C" not in said:
                told = process.stderr.readline()
                assert told, f"ended with exit code {process.wait(60.0)}: {said}"
                said += told
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(300.0) == 0, process.stderr.read()
        finally:
            process.kill()
    check_same(tmp_path / "run", run, "run.nc", JOURNAL_NAME, KNOWLEDGE_NAME, "config.json")
