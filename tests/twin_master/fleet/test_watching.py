"""Many real assets under watch: files that grow, topics of a broker, kills, and what is lost alone."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from queue import Queue
from subprocess import CompletedProcess
from threading import Event, Thread
from typing import Any

import numpy as np
import psutil
import pytest

from reporting.folders import closing_lock
from tests.command_line import command, refused, said, seen
from tests.twin_master.fleet.recordings import (
    LOGS,
    STEPS,
    Decision,
    fleet_of,
    log_of,
    watch_alone,
    watched,
    write_fleet,
)
from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import HANGS, Mosquitto, mosquitto, served, wait_until
from twin_master.errors import FleetError, RunFolderError
from twin_master.fleet.engine import Engine
from twin_master.fleet.page.report import fleet_page, write_fleet_report
from twin_master.fleet.page.view import ATTENTION_ROWS, serve_fleet
from twin_master.fleet.plan import load_fleet
from twin_master.fleet.reading import ControlForecast
from twin_master.fleet.storage.store_layout import ALL_ROWS
from twin_master.fleet.watched.watched_asset import WatchedAsset, read_watched_state
from twin_master.fleet.watched.watching import FleetWatch
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.run_folder import lock_run_folder
from twin_master.watch.folder import Watch
from twin_master.watch.metrics import MetricsServer
from uav_twin import fly_fleet, open_fleet


@pytest.fixture
def alone(fleet_file: Path, tmp_path: Path) -> list[bytes]:
    """The journals of watches of one asset alone."""
    return watch_alone(tmp_path)


def journals(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((folder / "north").glob(f"*/{JOURNAL_NAME}"))]


WINGS = ["north/wing-0", "north/wing-1", "north/wing-2"]


def test_each_asset_has_the_journal_of_a_watch_alone(fleet_file, alone, tmp_path):
    """The watch of the fleet is stopped twice in the middle of assets."""
    out = tmp_path / "again"
    for stop in (2, 9, None):
        watched(fleet_file, out, stop)
    assets = json.loads((out / "watched.json").read_text())["assets"]
    assert journals(out) == alone
    assert [assets[name]["last"]["step"] for name in WINGS] == [STEPS - 1] * 3


def beliefs(folder: Path) -> list[Any]:
    return [line["filtered"] for line in journal(folder) if "filtered" in line]


def test_an_asset_of_a_fleet_may_pause_and_another_may_count_from_anywhere(fleet_file, alone, tmp_path):
    """The first wing rests for an hour, and the numbers of the second begin at 5000."""
    scenario = tmp_path / "wing.toml"
    scenario.write_text(scenario.read_text() + "\n[watch]\nseconds_per_step = 1.0\n")
    header, *rows = log_of(tmp_path, 0).read_text().splitlines()
    times = ["0", "1", "2", "3603", "3604", "3605"]
    lines = [header.replace("step", "time", 1)]
    lines += [row.replace(row[0], time, 1) for time, row in zip(times, rows, strict=True)]
    log_of(tmp_path, 0).write_text("\n".join(lines) + "\n")
    offset = re.sub(r"(?m)^(?=\d,)", "500", log_of(tmp_path, 1).read_text())
    log_of(tmp_path, 1).write_text(offset)
    for stop in (2, 9, None):
        watched(fleet_file, tmp_path / "fleet", stop)
    for name in ("wing-0", "wing-1"):
        assert beliefs(tmp_path / "fleet" / "north" / name) == beliefs(tmp_path / "alone" / name)


@pytest.fixture(scope="module")
def watched_fleet(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The file of a fleet, and the folder in which it was watched to its end."""
    folder = tmp_path_factory.mktemp("watched_fleet")
    file = write_fleet(library_file, folder)
    watched(file, folder / "out")
    return file, folder / "out"


def test_after_a_kill_each_asset_tells_its_last_decision_again(watched_fleet, tmp_path):
    """Nobody knows whether it was told."""
    file, watched_folder = watched_fleet
    out = shutil.copytree(watched_folder, tmp_path / "out")
    (out / "watched.json").unlink()
    told = list[tuple[str, bool]]()

    def tell(asset: WatchedAsset, decision: Decision) -> None:
        told.append((asset.name, decision["told_again"]))

    FleetWatch(load_fleet(file), out, tell, print).run()
    assert sorted(told) == [(name, True) for name in WINGS]


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="open files are those of /proc")
def test_a_watch_that_ends_before_its_files_closes_them(watched_fleet, tmp_path):
    file, _ = watched_fleet
    watch = FleetWatch(load_fleet(file), tmp_path / "out", lambda *_: None, print, steps=1)
    watch.run()
    open_files = {os.path.realpath(entry) for entry in Path("/proc/self/fd").iterdir()}
    assert len(watch.assets) == len(WINGS)
    assert not [name for name in open_files if name.startswith(str(file.parent / "logs"))]


def test_the_folder_of_another_fleet_is_refused(watched_fleet):
    file, out = watched_fleet
    with pytest.raises(RunFolderError, match="another fleet"):
        FleetWatch(load_fleet(file, seed=8), out, print, print)


@pytest.fixture(scope="module")
def fleet_of_three_steps(
    watched_fleet: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory
) -> CompletedProcess[str]:
    """What the command prints that watches a fleet for three steps."""
    out = tmp_path_factory.mktemp("three_steps") / "out"
    return command("fleet", "watch", watched_fleet[0], "--out", out, "--steps", 3)


def test_the_command_watches_a_fleet_up_to_a_number_of_steps(fleet_of_three_steps):
    done = fleet_of_three_steps
    decisions = [json.loads(line) for line in done.stdout.splitlines()]
    last_steps = {decision["asset"]: decision["step"] for decision in decisions}
    assert done.returncode == 0, done.stderr
    assert last_steps == dict.fromkeys(WINGS, 2)
    assert "3 assets, 9 steps, 3 alarms" in done.stderr


def test_the_former_name_of_the_option_of_steps_is_read_with_a_sentence(
    watched_fleet, fleet_of_three_steps, tmp_path
):
    file, _ = watched_fleet
    former = command("fleet", "watch", file, "--out", tmp_path / "former", "--turns", 3)
    sentence = "The option --turns: `--turns` is now called `--steps`. The former name"
    assert former.stdout == fleet_of_three_steps.stdout
    assert sentence in former.stderr
    assert "--turns" not in said("fleet", "watch", "--help")


def test_people_see_the_decisions_of_a_fleet_as_a_table(fleet_file, tmp_path):
    screen = seen("fleet", "watch", fleet_file, "--out", tmp_path / "seen")
    rows = re.findall(r"(north/wing-\d) +5 +2g +.* 2g +1 ", screen)
    assert rows[-3:] == WINGS
    assert '"asset"' not in screen


@pytest.fixture
def broker(fleet_file: Path, tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker that has a topic for each asset of the fleet."""
    with mosquitto(tmp_path) as broker:
        fleet_of(tmp_path, f'observations = "mqtt://wing@127.0.0.1:{broker.port}/wings/+"')
        yield broker


def publish(client: Any, name: str, step: int, control: str = "2g", strain: Any = (1e-3,) * 24) -> None:
    record = {"step": step, "control": control, "strain": [*strain]}
    client.publish(f"wings/{name}", json.dumps(record), qos=1)


def make_unwell(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Let the watch of an asset meet an error of ours once, behind its third step."""
    decisions, unwell = Watch.decisions, iter([True])

    def once_unwell(watch: Watch, *given: Any) -> Iterator[dict[str, Any]]:
        for decision in decisions(watch, *given):
            yield decision
            if watch.folder.name == name and decision["step"] >= 2 and next(unwell, False):
                raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(Watch, "decisions", once_unwell)


class LostAssets:
    """A fleet that loses an asset with a wrong file, and one that meets an error of ours.

    Of the third the log is gone for a while. All files are mended at the third look for files.
    """

    def __init__(self, folder: Path, alone: list[bytes]) -> None:
        self.alone, self.out = alone, folder / "out"
        logs = [log_of(folder, number) for number in range(3)]
        self.whole = {log: log.read_bytes() for log in logs}
        self.log_that_goes, misspelt, without_header = logs
        (folder / "logs" / "wing-1.txt").write_text("step,strain_1\n")  # another of that name
        misspelt.write_text("step,strian_1\n")
        without_header.write_bytes(self.whole[without_header][:9])
        self.notes = list[str]()
        self.looks = 0
        planned = load_fleet(fleet_of(folder, LOGS.replace(".csv", "")))
        self.fleet = FleetWatch(planned, self.out, self.tell, self.notes.append, follow=True)
        self.fleet.run(self.mend)

    def tell(self, asset: WatchedAsset, decision: Decision) -> None:
        is_third_step = asset.name == "north/wing-0" and decision["step"] == 2
        if is_third_step and "told_again" not in decision:
            self.log_that_goes.unlink()

    def mend(self) -> None:
        """Write all files as they were at the third look, and ask for the end at the sixth."""
        self.looks += 1
        if self.looks == 3:
            for log, content in self.whole.items():
                log.write_bytes(content)
        self.fleet.is_end_requested = self.looks == 6


@pytest.fixture(scope="module")
def lost_assets(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> LostAssets:
    folder = tmp_path_factory.mktemp("lost_assets")
    write_fleet(library_file, folder)
    alone = watch_alone(folder)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("SEARCH_SECONDS", "FIRST_WAIT_SECONDS"):
            patch.setattr(f"twin_master.fleet.watched.watching.{name}", 0.0)
        make_unwell(patch, "wing-2")
        return LostAssets(folder, alone)


def test_an_asset_that_was_lost_is_taken_up_again(lost_assets):
    again = [note for note in lost_assets.notes if note.endswith("is watched again.")]
    assert journals(lost_assets.out) == lost_assets.alone
    assert sorted(again) == ["north/wing-1 is watched again.", "north/wing-2 is watched again."]


def test_a_lost_asset_is_told_once_with_its_reason(lost_assets):
    lost = [note for note in lost_assets.notes if "is not watched" in note]
    error_of_ours = "north/wing-2 is not watched: ZeroDivisionError"
    assert lost_assets.fleet.failures == {"north/wing-1 of wing-1.txt": "another file has the same name."}
    assert sum(note.startswith(error_of_ours) for note in lost) == 1
    assert sum("strian_1" in note for note in lost) == 1


class WatchedTopics:
    """A fleet whose assets have a topic each; it is asked to end within, and goes on.

    Then one asset cannot be taken up, and one is lost: what came meanwhile waits.
    """

    def __init__(self, broker: Mosquitto, folder: Path) -> None:
        self.folder = folder
        self.out = folder / "out"
        self.north = self.out / "north"
        self.publisher = broker.client("publisher")
        self.heard, self.told = list[str](), list[int]()
        listener = broker.client("listener")
        listener.on_message = lambda _client, _data, message: self.heard.append(message.topic)
        listener.subscribe("wings/+/decision", qos=1)
        self.is_published = False
        self.run()
        (self.north / "wing-2").write_text("no folder")
        self.run()

    def run(self) -> None:
        """Watch the fleet until its end is asked for."""
        self.notes = list[str]()
        planned = load_fleet(self.folder / "fleet.toml")
        self.fleet = FleetWatch(planned, self.out, self.tell, self.notes.append)
        self.fleet.run(self.send)

    def tell(self, _asset: WatchedAsset, decision: Decision) -> None:
        self.told.append(decision["step"])
        revised = 1  # by the late message
        self.fleet.is_end_requested = len(self.told) in (2, 2 * STEPS + revised)

    def send(self) -> None:
        """Publish once the twin is connected; mend what is wrong once all that came meanwhile is here."""
        if self.notes and not self.is_published:
            self.is_published = True
            self.publish_logs()
        topics = self.fleet._sources[0]._topics  # type: ignore[union-attr]
        waiting = [len(topic.payloads) for _, topic in sorted(topics.items())]
        if waiting == [STEPS - 3, STEPS]:
            (self.north / "wing-2").unlink(missing_ok=True)
            (self.north / "wing-0" / "published").write_text("")
            for interruption in self.fleet._interruptions.values():
                interruption.resume_time = 0.0

    def publish_logs(self) -> None:
        for number in (0, 2):
            for row in log_of(self.folder, number).read_text().splitlines()[1:]:
                step, control, *cells = row.split(",")
                publish(self.publisher, f"wing-{number}", int(step), control, map(float, cells))


def records_without_place(folder: Path) -> list[dict[str, Any]]:
    """Return the records of a journal without what differs if the broker sends a message again."""
    records = journal(folder)
    for record in records:
        del record["intake"]
        del record["standing"]  # the place of the record in its file
    return records


def test_a_topic_for_each_asset(broker, alone, tmp_path, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.watched.watching.SEARCH_SECONDS", 0.0)
    make_unwell(monkeypatch, "wing-0")
    watched_topics = WatchedTopics(broker, tmp_path)
    for name in ("wing-0", "wing-2"):
        journal_of_fleet = records_without_place(watched_topics.north / name)
        assert journal_of_fleet == records_without_place(tmp_path / "alone" / name)
    assert {*watched_topics.heard} == {"wings/wing-0/decision", "wings/wing-2/decision"}
    check_lost_and_taken_up(watched_topics.notes)


def check_lost_and_taken_up(notes: list[str]) -> None:
    """Check that both assets were told to be lost, and then to be watched again."""
    lost = [note.partition(": ")[0] for note in notes if "is not watched" in note]
    assert sorted(lost) == ["north/wing-0 is not watched", "north/wing-2 is not watched"]
    assert "north/wing-0 is not watched: ZeroDivisionError: division by zero" in notes
    assert sorted(notes[-2:]) == ["north/wing-0 is watched again.", "north/wing-2 is watched again."]


class SilentAsset:
    """A fleet of two assets, of which one is not heard after its first step.

    The fleet is watched again, so that a decision that was never published is published then.
    """

    def __init__(self, broker: Mosquitto, folder: Path) -> None:
        self.heard, self.notes = list[dict[str, Any]](), list[str]()
        self.told = list[tuple[str, int, bool]]()
        self.client = broker.client("client", self.heard)
        self.client.subscribe([("wings/+/decision", 1), ("wings/fleet/heartbeat", 1)])
        self.next_step = 0
        self.states_at_extra_message: int | None = None
        self.file, self.out = folder / "fleet.toml", folder / "out"

    def run(self) -> None:
        """Watch both assets until the silence of one is told."""
        self.fleet = FleetWatch(load_fleet(self.file), self.out, self.tell, self.notes.append)
        self.fleet.run(lambda: self.send() if self.notes else None)

    def run_again(self) -> None:
        """Watch them once more, as after a kill that kept the last decision from the broker."""
        (self.out / "north" / "two" / "published").write_text("?")
        planned = load_fleet(self.file)
        self.again = FleetWatch(planned, self.out, lambda *_: None, self.notes.append, steps=1)
        self.again.run(self.end)
        topics = self.again._sources[0]._topics  # type: ignore[union-attr]
        self.waiting = [len(topic.payloads) for topic in topics.values()]
        wait_until(lambda: self.states()[-1] == "ended")
        self.client.disconnect()

    def seconds_of_silence(self, watch: Watch) -> float:
        """Return seconds that pass with the decisions, and not with the clock of a machine that is busy."""
        return 1.0 if watch.folder.name == "two" and len(self.told) > 5 else 0.0

    def send(self) -> None:
        """Publish a step of the first asset, and only the very first one of the second."""
        names = ("one", "two") if self.next_step == 0 else ("one",)
        for name in names:
            publish(self.client, name, self.next_step)
        self.next_step += 1

    def tell(self, asset: WatchedAsset, decision: Decision) -> None:
        is_quiet = any(notice["kind"] == "quiet" for notice in decision["notices"])
        self.told.append((asset.name, decision["step"], is_quiet))
        self.fleet.is_end_requested = self.told[-1] == ("north/two", 0, True)

    def end(self) -> None:
        """Ask for the end once the silence was published again, some heartbeats after a further message."""
        if self.states_at_extra_message is None:
            publish(self.client, "one", 999)  # an asset that has all steps is left alone
            self.states_at_extra_message = len(self.states())
        decisions = [record for record in self.heard if record.get("step") == 0]
        kinds = [notice["kind"] for decision in decisions for notice in decision["notices"]]
        has_waited = len(self.states()) > self.states_at_extra_message + 5
        self.again.is_end_requested = kinds.count("quiet") >= 2 and has_waited

    def states(self) -> list[str]:
        return [record["state"] for record in self.heard if "state" in record]


def test_an_asset_that_falls_silent_while_another_is_heard(broker, tmp_path, monkeypatch):
    monkeypatch.setattr("twin_master.fleet.watched.watching.SEARCH_SECONDS", 0.0)
    monkeypatch.setattr("twin_master.feeds.mqtt_session.HEARTBEAT_SECONDS", 0.0)
    with (tmp_path / "wing.toml").open("a") as file:
        file.write("\n[watch]\nquiet_after_seconds = 0.5\n")
    assets = SilentAsset(broker, tmp_path)
    monkeypatch.setattr(Watch, "seconds_since_step", property(assets.seconds_of_silence))
    assets.run()
    check_silence_of_second_asset(assets)
    assets.run_again()
    check_heartbeats(assets)


def check_silence_of_second_asset(assets: SilentAsset) -> None:
    """Check that the silence of the second asset alone was told, and that no asset failed."""
    of_second_asset = [decision for decision in assets.told if decision[0] == "north/two"]
    assert assets.fleet.is_end_requested
    assert assets.fleet.failures == {}
    assert of_second_asset == [("north/two", 0, False), ("north/two", 0, True)]
    assert not any(is_quiet for name, _, is_quiet in assets.told if name == "north/one")


def check_heartbeats(assets: SilentAsset) -> None:
    """Check that nothing waits at the end, and that the heartbeats counted one silent asset."""
    assert assets.waiting == [0, 0]
    assert assets.states()[-1] == "ended"
    assert max(record["quiet"] for record in assets.heard if "quiet" in record) == 1


def leaving_soon(fleet_file: Path, folder: Path) -> Any:
    """Fly the recordings of a fleet; return the folder, and how probably each asset leaves its control."""
    outcome = fly_fleet(load_fleet(fleet_file), folder, Engine(0))
    config = json.loads((outcome.folder / "config.json").read_text())
    forecast = ControlForecast(outcome.folder, config["fleet"]["groups"][0])
    return outcome.folder, forecast.probabilities(open_fleet(folder)["north"], ALL_ROWS)


def watched_records(fleet_file: Path, folder: Path) -> list[dict[str, Any]]:
    return [asset.record() for _, asset in sorted(watched(fleet_file, folder).assets.items())]


def test_a_watched_asset_says_how_probably_it_leaves_its_control_as_the_store_does(fleet_file, tmp_path):
    """Also one that is taken up again, of which nothing is left to read."""
    path = tmp_path / "wing.toml"
    path.write_text("notice = false\n" + path.read_text())  # so that a state is believed whatever comes
    _, soon = leaving_soon(fleet_of(tmp_path, LOGS, f"steps = {STEPS}"), tmp_path / "flown")
    for _ in range(2):
        records = watched_records(fleet_file, tmp_path / "out")
        assert [record["leaving"] for record in records] == pytest.approx(soon, abs=1e-6)


@pytest.fixture
def fleet_of_noise(fleet_file: Path, tmp_path: Path) -> Path:
    """The fleet with recordings of noise, which no state explains."""
    return fleet_of(tmp_path, LOGS, f"steps = {STEPS}")


def test_a_flown_asset_in_no_state_that_is_believed_has_no_state(fleet_of_noise, tmp_path):
    folder, leaving = leaving_soon(fleet_of_noise, tmp_path / "flown")
    page = write_fleet_report(folder).read_text()
    assert np.isnan(leaving).all()
    assert page.count("not believed") >= 3
    assert "The asset with the most damage is" not in page


def test_a_watched_asset_in_no_state_that_is_believed_has_no_state(fleet_of_noise, tmp_path):
    records = watched_records(fleet_of_noise, tmp_path / "out")
    page = write_fleet_report(tmp_path / "out").read_text()
    assert [(record["leaving"], record["severity"]) for record in records] == [(None, None)] * 3
    assert page.count("not believed") >= 3
    assert "The asset with the most damage is" not in page


def test_a_fleet_with_an_asset_that_cannot_be_read_ends_with_exit_code_1(fleet_file, tmp_path):
    log_of(tmp_path, 0).write_text("step,colour\n0,red\n")
    done = command("fleet", "watch", fleet_file, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "north/wing-0 is not watched: " in done.stderr
    assert "`colour` is not a sensor" in done.stderr


def test_a_fleet_with_an_asset_whose_messages_are_refused_ends_with_exit_code_1(fleet_file, tmp_path):
    header = log_of(tmp_path, 0).read_text().splitlines()[0]
    log_of(tmp_path, 0).write_text(f"{header}\n" + "what\n" * 4)
    done = command("fleet", "watch", fleet_file, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "north/wing-0: The watch ended while messages were refused: the last 4 of 4" in done.stderr


class PartlyLostFleet:
    """A fleet that was watched, in which three of six assets cannot be, and one has no step yet."""

    def __init__(self, library: Path, folder: Path) -> None:
        fleet = write_fleet(library, folder)
        self.alone = watch_alone(folder)
        contents = {
            "wing-0": "step,colour\n0,red\n",
            "not a name!": "step\n",
            "void": "",
            "wing-9": "step,control\n",
        }
        for name, text in contents.items():
            (folder / "logs" / f"{name}.csv").write_text(text)
        self.out = folder / "out"
        self.failures = watched(fleet, self.out).failures


@pytest.fixture(scope="module")
def partly_lost(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> PartlyLostFleet:
    return PartlyLostFleet(library_file, tmp_path_factory.mktemp("lost"))


@pytest.fixture
def lost_folder(partly_lost: PartlyLostFleet, tmp_path: Path) -> Path:
    """A copy of what was watched."""
    return shutil.copytree(partly_lost.out, tmp_path / "out")


def test_an_asset_is_lost_alone(partly_lost):
    assert journals(partly_lost.out)[:2] == partly_lost.alone[1:]


def test_a_lost_asset_has_its_reason(partly_lost):
    failures = partly_lost.failures
    assert set(failures) == {"north/wing-0", "north/not a name!", "north/void"}
    assert "colour" in failures["north/wing-0"]
    assert "void.csv is empty" in failures["north/void"]


@pytest.mark.parametrize(
    ("line", "sentence"),
    [(LOGS.replace("logs", "none"), "no recording matches"), ("count = 2", "north has none")],
)
def test_a_fleet_without_recordings_is_refused(fleet_file, tmp_path, line, sentence):
    with pytest.raises(FleetError, match=sentence):
        FleetWatch(load_fleet(fleet_of(tmp_path, line)), tmp_path / "none", print, print)


@pytest.fixture
def port_of_page(lost_folder: Path) -> Iterator[int]:
    """The port at which the page of that fleet is served."""
    address, ended = Queue[str](), Event()
    arguments = (lost_folder, 0, address.put, lambda: not ended.is_set())
    serving = Thread(target=serve_fleet, args=arguments)
    serving.start()
    try:
        yield int(address.get(timeout=HANGS).rstrip("/").rpartition(":")[2])
    finally:
        ended.set()
        serving.join()


def test_the_page_of_a_fleet_says_which_assets_are_lost(port_of_page):
    status, page = served(port_of_page)
    assert status == 200
    for words in (
        "wing-1",
        "colour",  # why that one is not watched
        "3 of 6 assets are not watched",
        "Without a step yet: 1 asset (north/wing-9)",
        "<strong>1</strong><span>messages refused",
    ):
        assert words in page


def test_the_page_of_a_fleet_is_served_to_this_machine_alone(port_of_page):
    assert served(port_of_page, host="evil.example")[0] == 404


def test_the_page_of_a_fleet_follows_its_record(port_of_page, lost_folder):
    file = lost_folder / "watched.json"
    record = json.loads(file.read_text())
    assert served(port_of_page, "/version") == (200, "0")
    record["assets"]["north/wing-1"]["alarms"] = 1234
    file.write_text(json.dumps(record))
    wait_until(lambda: served(port_of_page, "/version") == (200, "1"))
    assert "1234" in served(port_of_page)[1]


def test_a_damaged_record_of_a_fleet_is_refused(lost_folder):
    file = lost_folder / "watched.json"
    record = json.loads(file.read_text())
    del record["assets"]["north/wing-1"]["last"]["health"]
    file.write_text(json.dumps(record))
    with pytest.raises(FleetError, match="out is damaged or of another version"):
        fleet_page(lost_folder, ATTENTION_ROWS)


def test_the_figures_of_all_assets_are_served_for_prometheus(fleet_file, tmp_path, monkeypatch):
    """They are read a last time when the watch of the fleet has come to its end."""
    texts: list[str] = []
    close = MetricsServer.close

    def read_and_close(server: MetricsServer) -> None:
        texts.append(served(int(re.search(r":(\d+)/", server.address)[1]), "/metrics")[1])
        close(server)

    monkeypatch.setattr(MetricsServer, "close", read_and_close)
    done = command("fleet", "watch", fleet_file, "--out", tmp_path / "out", "--metrics", 0)
    assert done.returncode == 0, done.stderr
    steps = re.findall(r'^uav_twin_step\{asset="(.*)"\} (\S+)$', texts[0], re.MULTILINE)
    assert steps == [(name, f"{STEPS - 1}.0") for name in WINGS]
    assert "Metrics: http://127.0.0.1:" in done.stderr


WIDE = 40
"""More wings than a process with `MOST_FILES` open files has room for."""
MOST_FILES = 50
WITH_FEW_FILES = (
    "import resource; "
    f"resource.setrlimit(resource.RLIMIT_NOFILE, ({MOST_FILES}, {MOST_FILES})); "
    "from uav_twin.cli import main; main()"
)


@pytest.fixture(scope="module")
def wide_fleet(library_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a fleet of many wings."""
    file = write_fleet(library_file, tmp_path_factory.mktemp("wide_fleet"))
    for number in range(3, WIDE):
        shutil.copy(log_of(file.parent, number % 3), log_of(file.parent, number))
    return file


def with_few_files(*words: object) -> list[str]:
    """Return the command line of `uav-twin` in a process that may have few open files."""
    return [sys.executable, "-c", WITH_FEW_FILES, *map(str, words)]


def test_more_assets_are_watched_than_a_process_may_have_open_files(wide_fleet, tmp_path):
    words = with_few_files("fleet", "watch", wide_fleet, "--out", tmp_path / "out")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    alone = watch_alone(wide_fleet.parent)
    assert done.returncode == 0, done.stderr
    assert f"{WIDE} assets, {WIDE * STEPS} steps" in done.stderr
    assert set(journals(tmp_path / "out")) == set(alone)


class FollowedLogs:
    """A wide fleet whose logs are followed by the command, and get a row more while they are."""

    def __init__(self, fleet_file: Path, out: Path) -> None:
        self.out = out
        words = with_few_files("fleet", "watch", fleet_file, "--follow", "--out", out)
        messages = fleet_file.with_name("messages.txt")
        with messages.open("w") as file:
            process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=file)
        try:
            wait_until(lambda: self.last_steps() == [STEPS - 1] * WIDE)
            # A watch of one asset of the fleet, by another process
            asset = out / "north" / "wing-7"
            self.refusal = refused("watch", "--resume", "--steps", 0, "--out", asset)
            for number in range(WIDE):
                log = log_of(fleet_file.parent, number)
                row = log.read_text().splitlines()[1].partition(",")[2]
                with log.open("a") as file:
                    file.write(f"{STEPS},{row}\n")
            wait_until(lambda: self.last_steps() == [STEPS] * WIDE)
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(HANGS)
            finally:
                process.kill()
                process.wait()
        self.said = messages.read_text()

    def last_steps(self) -> list[int]:
        """Return the last step of each asset that has one."""
        assets = read_watched_state(self.out)["assets"].values()
        return [asset["last"]["step"] for asset in assets if asset["last"] is not None]


@pytest.fixture(scope="module")
def followed_logs(wide_fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> FollowedLogs:
    folder = shutil.copytree(wide_fleet.parent, tmp_path_factory.mktemp("followed") / "fleet")
    return FollowedLogs(folder / wide_fleet.name, folder / "out")


def test_more_logs_are_followed_than_a_process_may_have_open_files(followed_logs):
    assert f"{WIDE} assets, {WIDE * (STEPS + 1)} steps" in followed_logs.said
    assert "not watched" not in followed_logs.said
    rejected = followed_logs.out.glob("north/*/rejected.jsonl")
    assert "removed" not in "".join(file.read_text() for file in rejected)


def test_an_asset_of_a_watched_fleet_is_not_watched_by_another_process(followed_logs):
    sentence = f"another process watches the fleet in {followed_logs.out}, to which"
    assert sentence in followed_logs.refusal


def test_an_asset_that_another_process_watches_is_left_to_it(watched_fleet, tmp_path):
    file, watched_folder = watched_fleet
    out = shutil.copytree(watched_folder, tmp_path / "out")
    with closing_lock(lock_run_folder(out / "north" / "wing-1")):
        fleet = watched(file, out)
    assert set(fleet.assets) == {"north/wing-0", "north/wing-2"}
    assert "another process is flying" in fleet.failures["north/wing-1"]


def test_assets_keep_no_file_open(fleet_file, tmp_path):
    numbers: list[int] = []

    def count(_asset: WatchedAsset, _decision: Decision) -> None:
        numbers.append(psutil.Process().num_fds())

    FleetWatch(load_fleet(fleet_file), tmp_path / "out", count, str).run()
    assert max(numbers) == numbers[0]  # the log of the asset whose turn it is
