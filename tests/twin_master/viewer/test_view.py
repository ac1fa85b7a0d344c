"""The view of a flight: its numbers against those of the run, its protocol, its page in a real browser."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.browser import CHROMIUM, open_browser
from fe.wing.design import SHIPPED_DESIGN
from reporting.pages.figures import new_figure, to_svg
from tests.refusals import Inputs
from tests.twin_master.runs import check_same
from tests.twin_master.watch.conftest import HANGS, served, viewed
from twin_master.assets.design_source import DESIGN_COPY
from twin_master.errors import RunFolderError
from twin_master.mission.journal import JOURNAL_NAME, encode_line, record_of_line
from twin_master.mission.knowledge_file import KNOWLEDGE_NAME
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


def record_of(line: bytes) -> dict[str, Any]:
    """Return the record of a line of the journal."""
    record = record_of_line(line, Path(JOURNAL_NAME))
    assert record is not None
    return record


def of_steps(flight: Flight, first: int, end: int) -> StepBeliefs:
    """Return what the twin believed of steps when they were flown."""
    return flight.beliefs_in(flight.records_of_steps(first, end))


def asked(first: int = 0, end: int = 0, step: int = LATEST, **changed: int) -> Request:
    given = {"number": 1, "flight": -1, "shown": -1, "count": -1} | changed
    return Request(first=first, end=end, step=step, **given)


def test_every_number_is_that_of_the_run(run):
    """The belief of the journal has ten decimals, which a small standard deviation shows most."""
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
        np.testing.assert_allclose(belief.probability, values["probability"], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(belief.control_probability, values[control], rtol=0.0, atol=1e-9)
        for name in ("reward_mean", "reward_standard_deviation", "quantity_mean"):
            found = getattr(belief.expected, name.removeprefix("quantity_"))
            largest = np.nanmax(np.abs(values[name]))
            np.testing.assert_allclose(found, values[name], rtol=0.0, atol=2e-8 * largest, err_msg=name)
    deviation = stored["filtered"]["quantity_standard_deviation"].values
    np.testing.assert_allclose(believed.expected.standard_deviation, deviation, rtol=2e-7)
    noise = stored["filtered"]["noise_standard_deviation"].values
    np.testing.assert_allclose(believed.expected.noise_standard_deviation, noise, rtol=1e-9)
    np.testing.assert_array_equal(
        flight.true_states_in(flight.records_of_steps(0, STEPS)), stored["truth"]["state"].values
    )


def test_steps_are_seen_as_soon_as_their_lines_are_whole(begun, lines):
    flight = Flight(begun)
    assert not flight.update()
    add(begun, *lines[:20], lines[20][:40])
    assert [flight.update(), flight.steps, flight.update()] == [True, 19, False]
    add(begun, lines[20][40:])
    assert [flight.update(), flight.steps, flight.update()] == [True, 20, False]


@pytest.fixture
def taken_back(begun: Path, lines: list[bytes]) -> tuple[Flight, int]:
    """The view of twenty steps of which a resumed run took back ten, and the number that it had before."""
    add(begun, *lines[:21])
    flight = viewed(begun)
    number = flight.number
    (begun / JOURNAL_NAME).write_bytes(b"".join(lines[:11]))
    flight.update()
    return flight, number


def test_steps_are_forgotten_where_they_are_taken_back(taken_back):
    flight, number_before = taken_back
    assert (flight.steps, flight.number) == (10, number_before + 1)


def test_a_viewer_that_holds_steps_that_were_taken_back_is_told_all_again(taken_back):
    flight, number_before = taken_back
    answer = told(FlightPage(flight), 0, 20, flight=number_before, shown=19, count=20)
    assert (answer["first"], answer["count"], len(answer["past"]["control"])) == (0, 10, 10)


def test_a_line_that_was_changed_ends_the_view_with_its_number(taken_back, begun, lines):
    flight, _ = taken_back
    add(begun, lines[11].replace(b'"step":10', b'"step":11'), *lines[12:])
    with pytest.raises(RunFolderError, match=r"line 12 of the journal .* was changed or is damaged"):
        flight.update()


class LateObservation:
    """A view of ten steps of which the observation of step 6 came late, with the last one."""

    def __init__(self, folder: Path, lines: list[bytes]) -> None:
        self.folder = folder
        self.records = [record_of(line) for line in lines[1:]]
        missed = self.records[6] | {"observed": [None] * 24}
        late = self.records[9] | {"observation_step": 6, "observed": self.records[6]["observed"]}
        revised = late | {"filtered": self.records[20]["filtered"]}
        self.add_header(lines[0], [*self.records[:6], missed, *self.records[7:10]])
        self.flight = viewed(folder)
        self.number_before = self.flight.number
        self.add(revised)
        self.has_changed = self.flight.update()

    def add_header(self, header: bytes, records: list[dict[str, Any]]) -> None:
        add(self.folder, header, *map(encode_line, records))

    def add(self, *records: dict[str, Any]) -> None:
        add(self.folder, *map(encode_line, records))


@pytest.fixture
def late_observation(begun: Path, lines: list[bytes]) -> LateObservation:
    return LateObservation(begun, lines)


def test_an_observation_that_came_late_is_told_anew(late_observation):
    flight = late_observation.flight
    assert late_observation.has_changed
    assert (flight.steps, flight.number) == (10, late_observation.number_before + 1)


def test_an_observation_that_came_late_stands_in_its_step(late_observation):
    flight, records = late_observation.flight, late_observation.records
    observations = flight.observations_in(flight.records_of_steps(0, 10))
    expected = np.array([record["observed"] for record in records[:10]], dtype=float)
    last_beliefs = [record["filtered"] for record in flight.records_of_steps(8, 10)]
    np.testing.assert_array_equal(observations, expected)
    assert last_beliefs == [records[8]["filtered"], records[20]["filtered"]]


def test_records_that_are_no_steps_are_passed_over(late_observation):
    late_observation.add({"model": {}}, *late_observation.records[10:20])
    assert viewed(late_observation.folder).steps == 20


def test_a_step_that_is_missing_ends_the_view(late_observation):
    late_observation.add(late_observation.records[30])
    with pytest.raises(RunFolderError, match="has a line of step 30 where step 10 is expected"):
        late_observation.flight.update()


def test_another_flight_in_the_same_folder_is_shown_once_it_is_seen(late_observation, lines):
    flight, journal = late_observation.flight, late_observation.folder / JOURNAL_NAME
    journal.rename(late_observation.folder / "before")
    journal.write_bytes(b"".join(lines[:4]))
    assert FlightPage(flight).answer(asked()) is None
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


@pytest.fixture(scope="module")
def flight(run: Path) -> Flight:
    return viewed(run)


def test_a_new_viewer_is_told_everything(flight):
    everything = told(FlightPage(flight))
    assert (everything["step"], everything["first"], everything["count"]) == (STEPS - 1, 0, STEPS)


def test_a_viewer_is_told_what_it_misses_and_nothing_else(flight):
    page = FlightPage(flight)
    everything = told(page)
    number = everything["flight"]
    missed = told(page, 0, 30, flight=number, shown=29, count=30)
    expected = everything["past"]["state"][30:]
    assert missed["first"] == 30
    np.testing.assert_allclose(missed["past"]["state"], expected, rtol=1e-12)
    assert page.answer(asked(0, STEPS, flight=number, shown=STEPS - 1, count=STEPS)) is None


def test_a_viewer_that_looks_back_is_told_what_is_ahead_of_its_step(flight):
    page = FlightPage(flight)
    number = told(page)["flight"]
    back = told(page, 0, STEPS, 7, flight=number, shown=8, count=STEPS)
    assert (back["step"], back["past"]) == (7, None)
    assert len(back["ahead"]["state"]) == 10


def test_a_viewer_is_told_means_and_readings_in_printed_units(flight):
    past = told(FlightPage(flight), step=28)["past"]
    beliefs = of_steps(flight, 0, 29)
    mean = flight.knowledge.model.states.mean(beliefs.probability)
    observations = flight.observations_in(flight.records_of_steps(0, 29))
    np.testing.assert_allclose(past["state"], 100.0 * mean)
    np.testing.assert_allclose(past["observed"], 1e6 * observations)


def test_a_viewer_is_told_bands_in_printed_units(flight):
    past = told(FlightPage(flight), step=28)["past"]
    expected = of_steps(flight, 0, 29).expected
    deviation = np.hypot(expected.standard_deviation, expected.noise_standard_deviation)
    width = np.subtract(past["sensor_upper"], past["sensor_lower"])
    np.testing.assert_allclose(width, 2 * 1.959963984540054e6 * deviation)
    assert np.min(past["state_lower"]) >= 0.0
    assert np.max(past["state_upper"]) <= 80.0


def test_a_step_to_come_has_no_error_reward(flight):
    answer = told(FlightPage(flight), step=28)
    assert answer["ahead"]["reward"][0][2] is None


def test_a_request_for_half_a_step_is_refused():
    with pytest.raises(ValueError, match=r"for Request"):
        Request.model_validate_json(json.dumps(asked().__dict__ | {"step": 1.5}))


@contextmanager
def opened(folder: Path) -> Iterator[str]:
    """Run `uav-twin view` as a user does, and end it with Ctrl-C."""
    words = [sys.executable, "-m", "uav_twin", "view", str(folder)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
            assert found
            yield found.group()
            process.send_signal(signal.SIGINT)
            assert process.wait(HANGS) == 130
        finally:
            process.kill()


def check_served_to_this_machine_alone(address: str) -> None:
    port = int(address.rstrip("/").rpartition(":")[2])
    for host, status in ((f"127.0.0.1:{port}", 200), (f"localhost:{port}", 200), ("evil.example", 404)):
        assert served(port, host=host)[0] == status
    own = socket.gethostbyname(socket.gethostname())
    if not own.startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((own, port), timeout=HANGS)


def check_nothing_wider_than_the_window(tab: Any) -> None:
    edges = tab.value("Object.values(views).map((view) => view.el.getBoundingClientRect().right)")
    assert tab.value("document.documentElement.scrollWidth <= innerWidth")
    assert max(edges) <= tab.value("innerWidth")


def check_sentence_of_step_29(tab: Any) -> None:
    sentence = tab.value("element('said').textContent")
    state = r"step 29: z₁ \d+ ± \d+ %, z₂ \d+ ± \d+ %\."
    assert re.fullmatch(rf"{state} Flown 3g; next [23]g with probability [01]\.\d{{3}}\.", sentence)


def go_back_by_keyboard(tab: Any) -> None:
    """Go back by one and by ten steps, to the start, and on to step 10."""
    keys = (("ArrowLeft", 28), ("PageUp", 18), ("Home", 0), ("ArrowLeft", 0), ("PageDown", 10))
    for key, step in keys:
        tab.press(key)
        tab.wait(f"state.shown === {step} && state.wanted === {step} && window.painted.at(-1)[0] === {step}")


def check_drawing_of_step_10(tab: Any) -> None:
    assert tab.value("drawn.past.length") == 11
    assert tab.value("drawn.ahead") == list(range(11, 21))
    gauges = [
        tab.value(f"document.querySelectorAll('#structure {kind}').length") for kind in ("circle", ".lost")
    ]
    assert gauges == [24, 0]


def add_verdict_on_motion(folder: Path) -> None:
    """Add a verdict with the picture of a missing force behind the last step."""
    (folder / "teaching" / "figures").mkdir(parents=True)
    (folder / "teaching" / "figures" / "missing_force.svg").write_bytes(to_svg(new_figure(2.0)))
    verdict = json.dumps({"verdict": {"sentence": "A spring is <missing>."}})
    (folder / "teaching" / "verdict.json").write_text(verdict)
    add(folder, encode_line({"verdict": {"folder": "teaching", "notice": {}}}))


def check_missing_force(tab: Any, tab_at_step_10: Any) -> None:
    """Check that the latest step shows it, and that nothing was known of it at step 10."""
    tab.wait("!element('force').hidden && element('picture').naturalWidth > 0")
    assert tab.value("element('verdict').textContent") == "A spring is <missing>."
    assert tab.value("document.documentElement.scrollWidth <= innerWidth")
    assert tab_at_step_10.value("element('force').hidden")


def check_all_steps_after_an_absence(folder: Path, lines: list[bytes], tabs: list[Any]) -> None:
    """Check that a viewer that was away gets what it missed; one that looks back stays there.

    It knows of the further steps.
    """
    looking_back, following, away = tabs
    away.value("socket.onclose = null; socket.close()")
    last = record_of(lines[-1]) | Inputs(__file__).table("told.toml")
    add(folder, *lines[31:-1], encode_line(last))
    following.wait("window.painted.at(-1)[0] === 49")
    looking_back.wait("state.count === 50")
    assert looking_back.value("state.shown") == 10
    away.value("connect()")
    away.wait("window.painted.at(-1)[0] === 49 && held.rows.length === 50")
    flown = viewed(folder)
    expected = 100.0 * flown.knowledge.model.states.mean(of_steps(flown, 0, STEPS).probability)
    for tab in (following, away):
        np.testing.assert_allclose(tab.value("held.rows.map((row) => row.state)"), expected)
    assert looking_back.value("element('told').hidden && element('learning').hidden")


def check_notices_and_learning_of_the_last_step(tab: Any) -> None:
    tab.press("End")
    tab.wait("window.painted.at(-1)[0] === 49")
    notices = tab.value("[...element('notices').children].map((item) => item.textContent)")
    learnt = "".join(f"{name}0.9512 (0.9400 to 0.9600)" for name in ("e", "a, gauge 9", "a, gauge 10"))
    assert tab.value("element('latest').getAttribute('aria-pressed')") == "true"
    assert notices == ["Step 49: gauge 4 is off.", "step 49: Look at <b>gauge 3</b>."]
    assert tab.value("element('learnt').textContent") == learnt


def check_nothing_went_wrong(tab: Any, address: str) -> None:
    """Check that everything came from the server of the page."""
    tab.value("1")
    assert tab.errors == []
    assert all(url.startswith((address, "data:", "about:")) for url in tab.requests)


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_the_page_in_a_browser(begun, lines, tmp_path):
    """Three tabs: one goes back to step 10, one follows, and one is away for a while."""
    add(begun, *lines[:31])
    with open_browser() as browser, opened(begun) as address:
        check_served_to_this_machine_alone(address)
        tabs = [browser.tab() for _ in range(3)]
        looking_back, following, _ = tabs
        for tab, width in zip(tabs, (1300, 400, 400), strict=True):
            tab.go(address, width)
        for tab in tabs:
            tab.wait("window.painted.at(-1)[0] === 29")
            check_nothing_wider_than_the_window(tab)
        check_sentence_of_step_29(looking_back)
        go_back_by_keyboard(looking_back)
        check_drawing_of_step_10(looking_back)
        assert following.value("state.shown") == 29
        picture_of_step_10 = looking_back.picture(tmp_path / "step_10.png")
        add_verdict_on_motion(begun)
        check_missing_force(following, looking_back)
        check_all_steps_after_an_absence(begun, lines, tabs)
        check_notices_and_learning_of_the_last_step(looking_back)
        assert looking_back.picture(tmp_path / "step_49.png") != picture_of_step_10
        for tab in tabs:
            check_nothing_went_wrong(tab, address)


def test_a_mission_with_a_view_is_the_same_to_the_bit(library_file, run, tmp_path):
    words = ["run", "level_turns", "--out", tmp_path / "run", "--strain-library", library_file, "--no-report"]
    line = [sys.executable, "-m", "uav_twin", *map(str, words), "--view"]
    null, pipe = subprocess.DEVNULL, subprocess.PIPE
    said = ""
    with subprocess.Popen(line, stdout=null, stderr=pipe, text=True, start_new_session=True) as process:
        try:
            while "http://127.0.0.1" not in said or "stays until Ctrl-C" not in said:
                told = process.stderr.readline()
                assert told, f"ended with exit code {process.wait()}: {said}"
                said += told
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(HANGS) == 0, process.stderr.read()
        finally:
            with suppress(ProcessLookupError):  # all of them have ended
                os.killpg(process.pid, signal.SIGKILL)
    check_same(tmp_path / "run", run, "run.nc", JOURNAL_NAME, KNOWLEDGE_NAME, "config.json")
