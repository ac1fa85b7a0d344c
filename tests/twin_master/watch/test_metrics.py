"""The figures of a watch that Prometheus reads, and the board of Grafana that asks for them."""

import json
import re
import threading
from collections import defaultdict
from http.client import HTTPConnection
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from reporting.progress import SilentProgress
from tests.command_line import command
from tests.refusals import refused
from tests.twin_master.watch.conftest import HANGS, served, wait_until
from twin_master.errors import MissionInputError
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.watch.folder import Watch
from twin_master.watch.metrics import WatchMetrics, serve_metrics
from uav_twin import watch as watch_asset

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches
BOARD = Path(__file__).parents[3] / "docs/how_to/boards/watch.json"
Labels = tuple[tuple[str, str], ...]
_SAMPLE = re.compile(r'(\w+)\{((?:\w+="(?:\\.|[^"\\])*",?)+)\} (\S+)')
_LABEL = re.compile(r'(\w+)="((?:\\.|[^"\\])*)"')


def parsed(text: str) -> dict[str, dict[Labels, float]]:
    """Return the values of an exposition; every line of it must be a comment or a sample."""
    values: dict[str, dict[Labels, float]] = defaultdict(dict)
    for line in text.splitlines():
        if line.startswith("#"):
            assert re.fullmatch(r"# (HELP \w+ .+|TYPE \w+ (gauge|counter))", line)
            continue
        match = _SAMPLE.fullmatch(line)
        assert match, line
        values[match[1]][tuple(_LABEL.findall(match[2]))] = float(match[3])
    return values


def value(values: dict[str, dict[Labels, float]], name: str, **labels: str) -> float:
    """Return the only value of a metric that has some labels."""
    wanted = set(labels.items())
    (number,) = [number for found, number in values[f"uav_twin_{name}"].items() if wanted <= set(found)]
    return number


class ServedMission:
    """A mission with garbage between its steps, and what is served after the last of some steps."""

    def __init__(self, watch: Watch, recorded: Path, steps: int) -> None:
        self.decisions: list[dict[str, Any]] = []
        with serve_metrics("127.0.0.1:0") as server:
            assert server is not None
            metrics = server.attach("wing", watch)
            self.before = server.text()
            watch.run(CsvFeed(recorded, watch.scenario), self._decide(metrics), step_limit=steps)
            port = int(server.address.split(":")[2].partition("/")[0])
            self.status, self.text = served(port, "/metrics")
        self.values = parsed(self.text)

    def _decide(self, metrics: WatchMetrics) -> Any:
        def decide(decision: dict[str, Any]) -> None:
            metrics.note_decision(decision)
            self.decisions.append(decision)

        return decide


@pytest.fixture
def served_mission(noticing: Watch, loose: Path) -> ServedMission:
    return ServedMission(noticing, loose, 30)


def test_the_figures_are_those_of_the_last_decision(served_mission):
    last, values = served_mission.decisions[-1], served_mission.values
    assert value(values, "step") == last["step"] == 29
    means = [value(values, "state_mean", state=name) for name in last["health"]]
    assert means == [health["mean"] for health in last["health"].values()]
    assert value(values, "next_control", control=last["next_control"]) == 1.0


def test_notices_are_counted_by_kind(served_mission):
    kinds = [notice["kind"] for decision in served_mission.decisions for notice in decision["notices"]]
    assert "alarm" in kinds
    for kind in set(kinds):
        assert value(served_mission.values, "notices_total", kind=kind) == kinds.count(kind)


def test_the_residual_is_that_of_the_last_step(noticing, served_mission):
    """In standard deviations of the noise that the twin assumes."""
    rms = value(served_mission.values, "residual_rms")
    knowledge, step = noticing.models[-1].knowledge, noticing.last_step
    model = knowledge.sensor_model
    expected = step.twin_step.filtered @ model.mean[:, step.twin_step.control_index]
    residual = (step.reading.observed[:24] - expected) / model.standard_deviation
    assert rms == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-9)


def test_nothing_is_served_before_a_watch_reads_messages(served_mission):
    assert served_mission.status == 200
    assert served_mission.before == ""
    assert served_mission.text.endswith("\n")


def test_messages_are_counted_by_what_became_of_them(watch, recorded):
    """The recording has a refused line after each seventh step."""
    values = ServedMission(watch, recorded, 20).values
    assert value(values, "messages_received_total") == watch.intake.counts.received
    assert value(values, "messages_refused_total") == watch.intake.counts.rejected == 3
    assert value(values, "notices_total", kind="alarm") == 0.0


def test_a_figure_that_has_no_value_yet_is_left_out(watch, plain):
    values = ServedMission(watch, plain, 0).values
    assert "uav_twin_step" not in values
    assert value(values, "messages_received_total") == 0.0


def test_the_media_type_is_that_of_the_text_format(watch, plain):
    with serve_metrics(0) as server:
        server.attach("wing", watch)
        connection = HTTPConnection(
            "127.0.0.1", int(server.address.split(":")[2].partition("/")[0]), timeout=HANGS
        )
        connection.request("GET", "/metrics?name=step")
        answer = connection.getresponse()
        assert answer.status == 200
        assert answer.getheader("Content-Type") == "text/plain; version=0.0.4; charset=utf-8"
        connection.close()


@pytest.mark.parametrize("address", ["", "nine", "host", "70000", "host:70000", "http://host:9100", -1])
def test_an_address_of_another_form_is_refused(address):
    with refused(MissionInputError, "at a port such as 9100, or at HOST:PORT"), serve_metrics(address):
        pass


def test_a_port_that_is_taken_is_refused_before_anything_is_made(tmp_path):
    with serve_metrics(0) as server:
        port = server.address.split(":")[2].partition("/")[0]
        process = command("watch", "watched_wing", "--out", tmp_path / "w", "--metrics", port)
    assert process.returncode != 0
    assert f"the metrics cannot be served at 127.0.0.1:{port}" in " ".join(process.stderr.split())
    assert not (tmp_path / "w").exists()


def queries(panel: dict[str, Any]) -> list[str]:
    """Return the queries of a panel of a board, and of the panels in it."""
    found = [target["expr"] for target in panel.get("targets", ())]
    for inner in panel.get("panels", ()):
        found += queries(inner)
    return found


@pytest.fixture(scope="module")
def board() -> dict[str, Any]:
    return json.loads(BOARD.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def served_by_a_watch(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[Labels, float]]:
    """What `uav_twin.watch` of the shipped recording serves while it goes on, after its alarm."""
    texts: list[str] = []
    folder = tmp_path_factory.mktemp("served") / "watch"
    addresses: list[str] = []

    def decide(decision: dict[str, Any]) -> None:
        if decision["step"] == 20:
            port = int(re.search(r":(\d+)/", addresses[0])[1])
            texts.append(served(port, "/metrics")[1])

    class Notes(SilentProgress):
        def note(self, text: str) -> None:
            addresses.extend(re.findall(r"^Metrics: (\S+)", text))

    watch_asset(
        "watched_wing", None, folder, decide=decide, steps=22, report=False, metrics=0, progress=Notes()
    )
    return parsed(texts[0])


def test_every_metric_of_the_board_is_served(board, served_by_a_watch):
    asked = {
        name
        for panel in board["panels"]
        for query in queries(panel)
        for name in re.findall(r"uav_twin_\w+", query)
    }
    assert len(asked) >= 10
    assert asked <= set(served_by_a_watch)


def test_every_label_of_the_board_is_served(board, served_by_a_watch):
    """A selector or a legend with a label that no value has would show an empty panel."""
    for panel in board["panels"]:
        for target in panel.get("targets", ()):
            (name, *_) = re.findall(r"uav_twin_\w+", target["expr"])
            labels = {label for found in served_by_a_watch[name] for label, _ in found}
            wanted = re.findall(r"(\w+)=~?\"", target["expr"]) + re.findall(
                r"\{\{(\w+)\}\}", target["legendFormat"]
            )
            assert set(wanted) <= labels, (panel["title"], name)


def test_the_panels_of_the_board_do_not_overlap(board):
    cells = set()
    for panel in board["panels"]:
        place = panel["gridPos"]
        for x in range(place["x"], place["x"] + place["w"]):
            for y in range(place["y"], place["y"] + place["h"]):
                assert (x, y) not in cells
                cells.add((x, y))
    assert max(x for x, _ in cells) < 24


def test_the_figures_can_be_read_while_the_watch_goes_on(watch, plain):
    """A monitoring system reads from another thread, again and again."""
    with serve_metrics(0) as server:
        metrics = server.attach("wing", watch)
        port = int(server.address.split(":")[2].partition("/")[0])
        texts: list[str] = []
        is_over = threading.Event()

        def read() -> None:
            while not is_over.is_set():
                texts.append(served(port, "/metrics")[1])

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        watch.run(CsvFeed(plain, watch.scenario), metrics.note_decision)
        wait_until(lambda: f"{watch.twin.steps - 1}.0" in texts[-1])
        is_over.set()
        thread.join(HANGS)
    steps = [value(parsed(text), "step") for text in texts if "uav_twin_step" in text]
    assert steps == sorted(steps)
    assert steps[-1] == watch.twin.steps - 1


def test_a_state_that_is_not_believed_has_no_number(watch, plain):
    with serve_metrics(0) as server:
        metrics = server.attach("wing", watch)
        watch.run(CsvFeed(plain, watch.scenario), metrics.note_decision, step_limit=1)
        decision = watch.last_decision()
        for health in decision["health"].values():
            health["mean"] = None
        metrics.note_decision(decision | {"state_believed": False})
        values = parsed(server.text())
    assert np.isnan(list(values["uav_twin_state_mean"].values())).all()
    assert value(values, "state_believed") == 0.0


def test_the_values_of_a_metric_stand_together_whatever_asset_they_are_of(watch, plain):
    """Prometheus reads one group of lines for each metric; labels may hold any text."""
    with serve_metrics(0) as server:
        metrics = server.attach("a", watch)
        others = server.attach('b "c"\\\n', watch)
        watch.run(CsvFeed(plain, watch.scenario), metrics.note_decision, step_limit=2)
        others.note_decision(watch.last_decision() | {"step": 7})
        lines = server.text().splitlines()
    assert lines[:4] == [
        "# HELP uav_twin_step Number of the last step.",
        "# TYPE uav_twin_step gauge",
        'uav_twin_step{asset="a"} 1.0',
        r'uav_twin_step{asset="b \"c\"\\\n"} 7.0',
    ]
    names = [line.partition("{")[0] for line in lines if line[0] != "#"]
    assert len(set(names)) == len([*groupby(names)])
