"""Many real assets under watch: files that grow, topics of a broker, kills, and what is lost alone."""

import json
import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from queue import Queue
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest

from tests.command_line import command, said, seen
from tests.twin_master.runs import journal, text_of, written
from tests.twin_master.watch.conftest import Mosquitto, mosquitto, served, wait_until, write_csv
from twin_master.errors import FleetError, RunFolderError
from twin_master.fleet.engine import Engine
from twin_master.fleet.plan import load_fleet
from twin_master.fleet.reading import group_figures, leaving_probabilities
from twin_master.fleet.report import fleet_page, write_fleet_report
from twin_master.fleet.view import ATTENTION_ROWS, serve_fleet
from twin_master.fleet.watched_asset import WatchedAsset
from twin_master.fleet.watching import FleetWatch
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.watch.folder import Watch
from uav_twin import fly_fleet, learn_from_fleet, open_fleet

STEPS = 6
FLOWN = [1, 1, 1, 1, 1, 0]
"""Control of each step: what the last one does to the wing nobody sees."""
LOGS = 'observations = "logs/*.csv"'
Decision = Mapping[str, Any]


@pytest.fixture
def fleet_file(library_file: Path, tmp_path: Path) -> Path:
    """A fleet of three wings with a recording each.

    Of one a line is garbage and a gauge unreadable for a step, of another a step is late.
    """
    text = text_of("growing_damage")
    flown = text[text.index("[asset]") : text.index("[calibration]")]
    library = f'[asset]\nkind = "strain_library"\nfile = "{library_file}"\n\n[belief]\nkind = "asset"\n\n'
    written(tmp_path, text, (flown, library), name="wing.toml")
    (tmp_path / "logs").mkdir()
    noise = np.random.default_rng(3).normal(1e-3, 1e-4, (3, STEPS, 24))
    for number, rows in enumerate(noise):
        write_csv(log_of(tmp_path, number), rows, np.array(FLOWN), number == 1)
    unread, late = (log_of(tmp_path, number).read_text().splitlines() for number in (1, 2))
    unread[3] = ",".join([*unread[3].split(",")[:-1], "OL"])
    late[3], late[4] = late[4], late[3]
    for number, lines in ((1, unread), (2, late)):
        log_of(tmp_path, number).write_text("\n".join(lines) + "\n")
    return fleet_of(tmp_path, LOGS)


def log_of(folder: Path, number: int) -> Path:
    return folder / "logs" / f"wing-{number}.csv"


def fleet_of(folder: Path, *lines: str) -> Path:
    head = (
        'format = 1\nfleet = { name = "real", seed = 7 }\n[[group]]\nname = "north"\nscenario = "wing.toml"'
    )
    return written(folder, "\n".join([head, *lines, ""]), name="fleet.toml")


@pytest.fixture
def alone(fleet_file: Path, tmp_path: Path) -> list[bytes]:
    """The journals of watches of one asset alone."""
    for number in range(3):
        given = "--observations", log_of(tmp_path, number), "--out", tmp_path / "alone" / f"wing-{number}"
        said("watch", tmp_path / "wing.toml", *given, "--seed", 7, "--no-report")
    return [path.read_bytes() for path in sorted((tmp_path / "alone").glob(f"*/{JOURNAL_NAME}"))]


def journals(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((folder / "north").glob(f"*/{JOURNAL_NAME}"))]


def watched(fleet_file: Path, out: Path, stop_after: int | None = None) -> FleetWatch:
    """Return a fleet that was watched; where it is to stop, in the middle of it."""
    told: list[str] = []

    def tell(asset: WatchedAsset, _decision: Decision) -> None:
        told.append(asset.name)
        fleet.is_end_requested = len(told) == stop_after

    fleet = FleetWatch(load_fleet(fleet_file), out, tell, told.append)
    fleet.run()
    return fleet


def test_each_asset_has_the_journal_of_a_watch_alone(fleet_file, alone, tmp_path):
    again = tmp_path / "again"
    for stop in (2, 9, None):  # in the middle of assets; the last time to the end
        watched(fleet_file, again, stop)
    assert journals(again) == alone
    state = json.loads((again / "watched.json").read_text())["assets"]
    assert [state[f"north/wing-{number}"]["last"]["step"] for number in range(3)] == [STEPS - 1] * 3
    (again / "watched.json").unlink()  # as if a kill had come: nobody knows whether the last ones were told
    told = list[tuple[str, bool]]()

    def tell(one: WatchedAsset, decision: Decision) -> None:
        told.append((one.name, decision["told_again"]))

    FleetWatch(load_fleet(fleet_file), again, tell, print).run()
    assert sorted(told) == [(f"north/wing-{number}", True) for number in range(3)]
    with pytest.raises(RunFolderError, match="another fleet"):
        FleetWatch(load_fleet(fleet_file, seed=8), again, print, print)
    done = command("fleet", "watch", fleet_file, "--out", tmp_path / "out", "--steps", 3)
    assert done.returncode == 0, done.stderr
    decisions = [json.loads(line) for line in done.stdout.splitlines()]
    last = {decision["asset"]: decision["step"] for decision in decisions}
    assert last == {f"north/wing-{number}": 2 for number in range(3)}
    assert "3 assets, 9 steps, 3 alarms" in done.stderr
    former = command("fleet", "watch", fleet_file, "--out", tmp_path / "former", "--turns", 3)
    assert former.stdout == done.stdout
    assert "The option --turns: `--turns` is now called `--steps`. The former name" in former.stderr
    assert "--turns" not in said("fleet", "watch", "--help")
    screen = seen("fleet", "watch", fleet_file, "--out", tmp_path / "seen")  # people see a table
    rows = re.findall(r"(north/wing-\d) +5 +2g +.* 2g +1 ", screen)
    assert rows[-3:] == ["north/wing-0", "north/wing-1", "north/wing-2"]
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


def test_an_asset_that_was_lost_is_taken_up_again(fleet_file, alone, tmp_path, monkeypatch):
    """One whose file was wrong, and one that met an error of ours; a log that is gone is awaited."""
    for name in ("SEARCH_SECONDS", "AGAIN_SECONDS"):
        monkeypatch.setattr(f"twin_master.fleet.watching.{name}", 0.0)
    logs = [log_of(tmp_path, number) for number in range(3)]
    (tmp_path / "logs" / "wing-1.txt").write_text("step,strain_1\n")  # another of that name
    contents, at, notes = [log.read_bytes() for log in logs], 0, list[str]()
    logs[1].write_text("step,strian_1\n")
    logs[2].write_bytes(contents[2][:9])  # its header is not whole yet
    make_unwell(monkeypatch, "wing-2")

    def tell(asset: WatchedAsset, decision: Decision) -> None:
        if asset.name == "north/wing-0" and decision["step"] == 2 and "told_again" not in decision:
            logs[0].unlink()

    def mend() -> None:
        nonlocal at
        at += 1
        for log, content in zip(logs, contents, strict=True) if at == 3 else ():
            log.write_bytes(content)
        fleet.is_end_requested = at == 6

    planned = load_fleet(fleet_of(tmp_path, LOGS.replace(".csv", "")))
    fleet = FleetWatch(planned, tmp_path / "out", tell, notes.append, follow=True)
    fleet.run(mend)
    assert journals(tmp_path / "out") == alone
    assert fleet.failures == {"north/wing-1 of wing-1.txt": "another file has the same name."}
    lost = [note for note in notes if "is not watched" in note]
    assert sum(note.startswith("north/wing-2 is not watched: ZeroDivisionError") for note in lost) == 1
    assert sum("strian_1" in note for note in lost) == 1
    again = [note for note in notes if note.endswith("is watched again.")]
    assert sorted(again) == ["north/wing-1 is watched again.", "north/wing-2 is watched again."]


def test_a_topic_for_each_asset(broker, alone, tmp_path, monkeypatch):
    """Asked to end within; then one cannot be taken up, and one is lost: what came meanwhile waits."""
    monkeypatch.setattr("twin_master.fleet.watching.SEARCH_SECONDS", 0.0)
    make_unwell(monkeypatch, "wing-0")
    heard, sent, told, north = list[str](), list[int](), list[int](), tmp_path / "out" / "north"
    listener, publisher = broker.client("listener"), broker.client("publisher")
    listener.on_message = lambda _client, _data, message: heard.append(message.topic)
    listener.subscribe("wings/+/decision", qos=1)

    def send() -> None:
        """Publish once the twin is connected; mend what is wrong once all that came meanwhile is here."""
        if notes and not sent:
            sent.append(1)
            for number in (0, 2):
                for row in log_of(tmp_path, number).read_text().splitlines()[1:]:
                    step, control, *cells = row.split(",")
                    publish(publisher, f"wing-{number}", int(step), control, map(float, cells))
        topics = fleet._sources[0]._topics  # type: ignore[union-attr]
        if [len(topic.payloads) for _, topic in sorted(topics.items())] == [STEPS - 3, STEPS]:
            (north / "wing-2").unlink(missing_ok=True)
            (north / "wing-0" / "published").write_text("")
            for lost in fleet._lost.values():
                lost.again = 0.0

    def tell(_asset: WatchedAsset, decision: Decision) -> None:
        told.append(decision["step"])
        fleet.is_end_requested = len(told) in (2, 2 * STEPS + 1)  # one more decision for the late message

    for wrong in (False, True):
        notes: list[str] = []
        fleet = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append)
        if wrong:
            (north / "wing-2").write_text("no folder")
        fleet.run(send)
    for number in (0, 2):
        name = f"wing-{number}"
        ours, theirs = (journal(folder / name) for folder in (north, tmp_path / "alone"))
        for record in [*ours, *theirs]:  # the broker sent again what the end left unacknowledged
            del record["intake"], record["standing"]  # which has its place in the file
        assert ours == theirs
    assert {*heard} == {"wings/wing-0/decision", "wings/wing-2/decision"}
    lost = [note.partition(": ")[0] for note in notes if "is not watched" in note]
    assert sorted(lost) == ["north/wing-0 is not watched", "north/wing-2 is not watched"]
    assert "north/wing-0 is not watched: ZeroDivisionError: division by zero" in notes
    assert sorted(notes[-2:]) == ["north/wing-0 is watched again.", "north/wing-2 is watched again."]


def test_an_asset_that_falls_silent_while_another_is_heard(broker, tmp_path, monkeypatch):
    """Also one that was watched before; and what was decided of it and never published is."""
    monkeypatch.setattr("twin_master.fleet.watching.SEARCH_SECONDS", 0.0)
    monkeypatch.setattr("twin_master.watch.mqtt_session.HEARTBEAT_SECONDS", 0.0)
    with (tmp_path / "wing.toml").open("a") as file:
        file.write("\n[watch]\nquiet_after_seconds = 0.5\n")
    heard, notes, told = list[dict[str, Any]](), list[str](), list[tuple[str, int, bool]]()

    def silence(watch: Watch) -> float:
        """Return seconds that pass with the decisions, and not with the clock of a machine that is busy."""
        return 1.0 if watch.folder.name == "two" and len(told) > 5 else 0.0

    monkeypatch.setattr(Watch, "seconds_since_step", property(silence))
    client, steps, further = broker.client("client", heard), iter(range(1000)), list[int]()
    client.subscribe([("wings/+/decision", 1), ("wings/fleet/heartbeat", 1)])

    def send() -> None:
        step = next(steps)
        for name in ("one", "two") if step == 0 else ("one",):
            publish(client, name, step)

    def tell(asset: WatchedAsset, decision: Decision) -> None:
        quiet = any(notice["kind"] == "quiet" for notice in decision["notices"])
        told.append((asset.name, decision["step"], quiet))
        fleet.is_end_requested = told[-1] == ("north/two", 0, True)

    def end() -> None:
        """Ask for it once the silence was published again, which a kill could have kept from the broker."""
        if not further:
            publish(client, "one", 999)  # who has all steps is left alone
            further.append(len(states()))
        kinds = [notice["kind"] for one in heard if one.get("step") == 0 for notice in one["notices"]]
        again.is_end_requested = kinds.count("quiet") >= 2 and len(states()) > further[0] + 5

    def states() -> list[str]:
        return [one["state"] for one in heard if "state" in one]

    fleet = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append)
    fleet.run(lambda: send() if notes else None)
    assert fleet.is_end_requested
    assert fleet.failures == {}
    (tmp_path / "out" / "north" / "two" / "published").write_text("?")
    planned = load_fleet(tmp_path / "fleet.toml")
    again = FleetWatch(planned, tmp_path / "out", lambda *_: None, notes.append, steps=1)
    again.run(end)
    topics = again._sources[0]._topics  # type: ignore[union-attr]
    assert [len(topic.payloads) for topic in topics.values()] == [0, 0]
    wait_until(lambda: states()[-1] == "ended")
    client.disconnect()
    silent = [said for said in told if said[0] == "north/two"]
    assert silent == [("north/two", 0, False), ("north/two", 0, True)]
    assert not any(quiet for name, _, quiet in told if name == "north/one")
    assert states()[-1] == "ended"
    assert max(one["quiet"] for one in heard if "quiet" in one) == 1


def test_recordings_are_flown_as_a_fleet(fleet_file, alone, tmp_path):
    """The store has what watches have and counts the notices that they gave."""
    short = log_of(tmp_path, 0)
    short.write_text("".join(short.read_text().splitlines(keepends=True)[:4]))
    fleet_of(tmp_path, LOGS, f"steps = {STEPS}")
    outcome = fly_fleet(load_fleet(fleet_file), tmp_path / "flown", Engine(0))
    group, alarmed = open_fleet(outcome.folder)["north"], 0
    for row, steps in enumerate((3, STEPS, STEPS)):
        lines = journal(tmp_path / "alone" / f"wing-{row}")
        last = {record["step"]: record for record in lines}
        assert group["observed/control_index"].values[row].tolist() == FLOWN[:steps] + [-1] * (STEPS - steps)
        assert np.isnan(group["filtered/log_evidence"].values[row, steps:]).all()
        assert np.array_equal(
            group["filtered/last_probability"].values[row], np.array(last[steps - 1]["filtered"], np.float32)
        )
        for step in range(steps):
            evidence = group["filtered/log_evidence"].values[row, step]
            late = row == 2 and step in (2, 3)  # written down before the late message came
            assert late or evidence == np.float32(last[step]["log_evidence"])
            seen = np.array(last[step]["observed"], np.float32)
            assert late or np.array_equal(group["observed/strain"].values[row, step], seen, equal_nan=True)
        told = [(line["step"], notice["kind"]) for line in lines for notice in line.get("notices", ())]
        for place, kind in enumerate(("alarm", "gauge_left_out")):
            noticed = [step for step, one in told if one == kind and step < steps]
            if row != 2:  # whose late message tells of steps before it
                assert group["notice/count"].values[row, place] == len(noticed)
                assert group["notice/first_step"].values[row, place] == min(noticed, default=-1)
        alarmed += bool(group["notice/count"].values[row, 0])
    assert group["notice/count"].values[1, 1] >= 1
    assert alarmed >= 1
    figures = group_figures(group)
    assert (figures["flown"], figures["raised an alarm"]) == (3, alarmed)
    assert "early fallback" not in figures
    learnt = learn_from_fleet(outcome.folder, tmp_path / "learnt.toml")["groups"]["north"]
    assert learnt["probability"]["2g"]["flown"] is False
    assert learnt["alarmed"] == alarmed
    probability = tomllib.loads((tmp_path / "learnt.toml").read_text())["transition"]["probability"]
    assert probability["2g"] == 0.05  # as it was assumed
    assert probability["3g"] != 0.10
    assert "raised an alarm, first in" in write_fleet_report(outcome.folder).read_text()
    records = [asset.record() for asset in watched(fleet_file, tmp_path / "out").assets.values()]
    assert sum(record["alarms"] > 0 for record in records) == alarmed
    (tmp_path / "logs" / "wing-9.csv").write_text("step,control\n")
    few = fly_fleet(load_fleet(fleet_of(tmp_path, LOGS, "steps = 5")), tmp_path / "few", Engine(0)).failures
    none = "its recording has no step yet."
    long = "it has 6 steps, and 5 at most are flown: set `steps` of the group."
    assert few == {"north/wing-1": long, "north/wing-2": long, "north/wing-9": none}


def leaving_soon(fleet_file: Path, folder: Path) -> Any:
    """Fly the recordings of a fleet; return the folder, and how probably each asset leaves its control."""
    outcome = fly_fleet(load_fleet(fleet_file), folder, Engine(0))
    config = json.loads((outcome.folder / "config.json").read_text())
    return outcome.folder, leaving_probabilities(
        outcome.folder, config["fleet"]["groups"][0], open_fleet(folder)["north"]
    )


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


def test_of_an_asset_in_no_state_that_is_believed_a_fleet_tells_no_state(fleet_file, tmp_path):
    """The recordings are noise, which no state explains."""
    folder, soon = leaving_soon(fleet_of(tmp_path, LOGS, f"steps = {STEPS}"), tmp_path / "flown")
    assert np.isnan(soon).all()
    records = watched_records(fleet_file, tmp_path / "out")
    assert [(record["leaving"], record["severity"]) for record in records] == [(None, None)] * 3
    for fleet in (folder, tmp_path / "out"):
        page = write_fleet_report(fleet).read_text()
        assert page.count("not believed") >= 3
        assert "with the most damage" not in page


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


def test_an_asset_is_lost_alone_and_the_page_of_the_fleet_says_so(fleet_file, alone, tmp_path):
    for name, text in {
        "wing-0": "step,colour\n0,red\n", "not a name!": "step\n", "void": "", "wing-9": "step,control\n"
    }.items():  # fmt: skip
        (tmp_path / "logs" / f"{name}.csv").write_text(text)
    failures = watched(fleet_file, tmp_path / "out").failures
    assert set(failures) == {"north/wing-0", "north/not a name!", "north/void"}
    assert "colour" in failures["north/wing-0"]
    assert "void.csv is empty" in failures["north/void"]
    assert journals(tmp_path / "out")[:2] == alone[1:]
    for line, words in (
        (LOGS.replace("logs", "none"), "no recording matches"),
        ("count = 2", "north has none"),
    ):
        with pytest.raises(FleetError, match=words):
            FleetWatch(load_fleet(fleet_of(tmp_path, line)), tmp_path / "none", print, print)

    address, ended, file = Queue[str](), Event(), tmp_path / "out" / "watched.json"
    given = (tmp_path / "out", 0, address.put, lambda: not ended.is_set())
    serving = Thread(target=serve_fleet, args=given)
    serving.start()
    port = int(address.get(timeout=300).rstrip("/").rpartition(":")[2])

    try:
        status, page = served(port)
        assert status == 200
        for words in (
            "wing-1",
            "colour",  # why that one is not watched
            "3 of 6 assets are not watched",
            "Without a step yet: 1 asset (north/wing-9)",
            "<strong>1</strong><span>messages refused",
        ):
            assert words in page
        assert served(port, "/version") == (200, "0")
        assert served(port, host="evil.example")[0] == 404
        state = json.loads(file.read_text())
        asset = state["assets"]["north/wing-1"]
        asset["alarms"] = 1234
        file.write_text(json.dumps(state))
        wait_until(lambda: served(port, "/version") == (200, "1"))
        assert "1234" in served(port)[1]
    finally:
        ended.set()
        serving.join()
    del asset["last"]["health"]
    file.write_text(json.dumps(state))
    with pytest.raises(FleetError, match="out is damaged or of another version"):
        fleet_page(tmp_path / "out", ATTENTION_ROWS)
