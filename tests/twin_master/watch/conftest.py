"""Watches without a calibration of their own, recordings, and a broker; a wing and its watches, made once."""

import copy
import json
import re
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from paho.mqtt import client as paho

from reporting.progress import SilentProgress
from tests.own_process import HANGS, started
from tests.twin_master.runs import flight_of, journal, text_of
from twin_master.feeds.broker_address import PASSWORD_VARIABLE
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.feed import Feed
from twin_master.feeds.intake import Counts
from twin_master.mission.decision_record import decision_from_line
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.replay import BelievedModel
from twin_master.mission.steps import History
from twin_master.scenario.reading import LoadedScenario, load_scenario
from twin_master.scenario.tables import Noticing
from twin_master.viewer.flight import Flight
from twin_master.watch.folder import Watch
from twin_master.watch.result import store_watch
from twin_master.watch.workflow import begin_watch


def write_csv(path: Path, observed: np.ndarray, controls: np.ndarray, garbage: bool = False) -> Path:
    lines = ["step,control," + ",".join(f"strain_{number}" for number in range(1, 25))]
    for step, row in enumerate(observed):
        cells = ",".join("" if np.isnan(value) else repr(value) for value in row.tolist())
        lines.append(f"{step},{('2g', '3g')[controls[step]]},{cells}")
        if garbage and step % 7 == 3:
            lines.append(f"{step},4g,what")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def before_begin(watch: Watch) -> Watch:
    """Return a copy of a watch without what it makes when it begins."""
    watch = copy.copy(watch)
    for name in ("journal", "intake", "twin"):
        vars(watch).pop(name, None)
    return watch


def begun(base: Watch, folder: Path) -> Watch:
    """Return a watch of the same configuration in a folder of its own, without calibrating again."""
    shutil.copytree(base.folder, folder)
    watch = before_begin(base)
    watch.folder, watch.journal_path, watch.models = folder, folder / JOURNAL_NAME, list(base.models)
    return watch


def watchful(base: Watch, folder: Path) -> Watch:
    watch = begun(base, folder)
    watch.scenario = watch.scenario.model_copy(update={"notice": Noticing()})
    watch.models = [BelievedModel(0, replace(base.models[0].knowledge, scenario=watch.scenario))]
    watch.update_from_journal()
    return watch


def ran(watch: Watch, feed: Feed, *stops: int | None, pause: float = 0.0) -> Counts:
    """Run a watch up to each number of steps (None: to the end); return the last counts."""
    for steps in stops or (None,):
        counts = watch.run(feed, lambda _decision: time.sleep(pause), step_limit=steps)
    return counts


def last_line(folder: Path) -> str:
    """The last record of a journal, as text."""
    return json.dumps(journal(folder)[-1])


def journalled(watch: Watch, folder: Path | None = None) -> list[Any]:
    """The decisions that the journal of a watch, or of one like it, holds."""
    model, lines = watch.models[0].knowledge.model, journal(folder or watch.folder)
    return [decision_from_line(line, watch.scenario, model) for line in lines]


def belief_of(watch: Watch) -> object:
    return [line["filtered"] for line in journal(watch.folder) if "filtered" in line][-1]


def killed_at(watch: Watch, size: int, run: Callable[[], object]) -> bool:
    """Run in a process of its own, killed once the journal has a size; return whether it was killed."""
    journal, process = watch.folder / JOURNAL_NAME, started(run)
    while process.is_alive():
        if journal.exists() and journal.stat().st_size >= size:
            process.kill()
            process.join()
        time.sleep(0.0005)
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode == -signal.SIGKILL


def viewed(folder: Path) -> Flight:
    """Return a run or watch as viewers see it."""
    flight = Flight(folder)
    while flight.update():
        pass
    return flight


def wait_until(found: Callable[[], object]) -> None:
    limit = time.monotonic() + HANGS
    while not found():
        assert time.monotonic() < limit
        time.sleep(0.02)


def served(port: int, path: str = "/", host: str = "localhost") -> tuple[int, str]:
    """Return what a page of this machine answers to who calls it by a name."""
    connection = HTTPConnection("127.0.0.1", port, timeout=HANGS)
    connection.request("GET", path, headers={"Host": host})
    with closing(connection), connection.getresponse() as answer:
        return answer.status, answer.read().decode()


PASSWORD = "a password"


@contextmanager
def mosquitto(folder: Path, *, tls: bool = False) -> Iterator["Mosquitto"]:
    """Run a broker whose password the twin knows."""
    if shutil.which("mosquitto") is None:
        pytest.skip("no mosquitto")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(PASSWORD_VARIABLE, PASSWORD)
        broker = Mosquitto(folder, tls=tls)
        try:
            yield broker
        finally:
            broker.stop()


class Mosquitto:
    """A broker on the loopback that wants a user, or TLS, and keeps its sessions when it stops."""

    def __init__(self, folder: Path, *, tls: bool = False) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.folder, self.tls = folder, tls
        self.authority = folder / "certificate.pem"
        self.let_in(PASSWORD)
        self.further: list[str] = []
        self.lines = [
            f"listener {self.port} 127.0.0.1", "allow_anonymous false", f"password_file {folder / 'users'}",
            "persistence true", f"persistence_location {folder}/", "max_queued_messages 10000", "user root",
        ]  # fmt: skip
        if tls:
            words = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2"
            words += " -addext subjectAltName=DNS:localhost,IP:127.0.0.1 -subj /CN=localhost"
            files = ["-keyout", str(folder / "key.pem"), "-out", str(self.authority)]
            subprocess.run([*words.split(), *files], check=True, capture_output=True)
            self.lines += [f"certfile {self.authority}", f"keyfile {folder / 'key.pem'}"]
        self.start()

    def let_in(self, password: str) -> None:
        """Let in who knows a password, from the next start on."""
        users = ["mosquitto_passwd", "-b", "-c", str(self.folder / "users"), "wing", password]
        subprocess.run(users, check=True, capture_output=True)

    def start(self) -> None:
        config = self.folder / "mosquitto.conf"
        config.write_text("\n".join([*self.lines, *self.further, ""]))
        self.process = subprocess.Popen(["mosquitto", "-c", str(config)], stderr=subprocess.DEVNULL)
        try:
            wait_until(self.answers)
        except AssertionError:
            self.process.kill()
            self.process.wait()
            raise

    def answers(self) -> bool:
        """Return whether the broker takes connections; it must not have ended."""
        assert self.process.poll() is None
        try:
            socket.create_connection(("127.0.0.1", self.port), HANGS).close()
        except OSError:
            return False
        return True

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(HANGS)
        finally:
            self.process.kill()
            self.process.wait()

    def again(self) -> None:
        self.stop()
        self.start()

    def client(self, name: str, heard: list[Any] | None = None) -> Any:
        """Return a client whose session lasts, and that hears what its topics say."""
        client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=name, clean_session=False)
        client.username_pw_set("wing", PASSWORD)
        if heard is not None:
            client.on_message = lambda _client, _data, told: heard.append(json.loads(told.payload))
        if self.tls:
            client.tls_set(ca_certs=str(self.authority))
        client.connect("localhost" if self.tls else "127.0.0.1", self.port)
        client.loop_start()
        return client


@pytest.fixture(scope="session")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> LoadedScenario:
    """`paper_level_turns` of a real wing: without what flies and what really happens; with fewer draws."""
    text = text_of("paper_level_turns", ("draws = 100", "draws = 20"))
    tables = re.compile(r"^\[+(asset|truth|reference)\b.*?(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
    path = tmp_path_factory.mktemp("scenario") / "my_wing.toml"
    path.write_text(f"{tables.sub('', text)}\n[watch]\nlag = 12\n", encoding="utf-8")
    return load_scenario(path)


@pytest.fixture(scope="session")
def mission(base: Watch) -> History:
    """The paper's mission, flown by the model that the watch believes."""
    knowledge = replace(base.models[0].knowledge, scenario=load_scenario("paper_level_turns").scenario)
    return flight_of(knowledge, base.source, seed=knowledge.scenario.mission.seed)


@pytest.fixture(scope="session")
def recorded(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission as a CSV file with some garbage between its steps."""
    path = tmp_path_factory.mktemp("recorded") / "mission.csv"
    return write_csv(path, mission.observed, mission.control_index, garbage=True)


@pytest.fixture(scope="session")
def plain(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission as a CSV file without it."""
    path = tmp_path_factory.mktemp("plain") / "m.csv"
    return write_csv(path, mission.observed, mission.control_index)


@pytest.fixture(scope="session")
def base(scenario: LoadedScenario, tmp_path_factory: pytest.TempPathFactory) -> Watch:
    """A watch that has seen nothing."""
    folder = tmp_path_factory.mktemp("base") / "watch"
    with begin_watch(scenario.scenario, scenario.file, folder, SilentProgress()) as watch:
        return watch


@pytest.fixture
def watch(base: Watch, tmp_path: Path) -> Watch:
    """One like it in a folder of its own."""
    return begun(base, tmp_path / "watch")


@pytest.fixture
def noticing(base: Watch, tmp_path: Path) -> Watch:
    """A watch that gives notice."""
    return watchful(base, tmp_path / "watch")


@pytest.fixture(scope="session")
def whole(base: Watch, recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the watch of the whole mission."""
    folder = tmp_path_factory.mktemp("whole") / "watch"
    watch = begun(base, folder)
    store_watch(watch, ran(watch, CsvFeed(recorded, watch.scenario)))
    return folder


@pytest.fixture(scope="session")
def loose(mission: History, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The mission with a gauge that shows 30 % too little from step 15 on."""
    observed = mission.observed.copy()
    observed[15:, 4] *= 0.7
    return write_csv(tmp_path_factory.mktemp("loose") / "m.csv", observed, mission.control_index)
