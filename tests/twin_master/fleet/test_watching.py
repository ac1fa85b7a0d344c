"""Many real assets under watch: files that grow, topics of a broker, kills, and what is lost alone."""

from __future__ import annotations

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import closing
from functools import partial
from http.client import HTTPConnection
from pathlib import Path
from queue import Queue
from threading import Event, Thread
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from reporting.progress import SilentProgress
from scenarios import scenario_files
from tests.twin_master.watch.watches import PASSWORD, Mosquitto, wait_until, write_csv
from twin_master.assets.resolution import Overrides
from twin_master.errors import FleetError, RunFolderExistsError
from twin_master.fleet.engine import Engine
from twin_master.fleet.flight import fly_fleet
from twin_master.fleet.learn import learn_fleet
from twin_master.fleet.lessons import lessons_record, write_learnt
from twin_master.fleet.plan import ensemble, load_fleet
from twin_master.fleet.reading import attention, group_figures, leaving
from twin_master.fleet.reading import open_fleet as fleet_groups
from twin_master.fleet.report import write_fleet_report
from twin_master.fleet.standing import WatchedAsset
from twin_master.fleet.view import fleet_view, serve_fleet
from twin_master.fleet.watching import TURNS_AT_ONCE, FleetWatch
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.preparation import kept_knowledge
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.watch.feeds import file_feed
from twin_master.watch.folder import Watch
from twin_master.watch.opening import begin_watch
from uav_twin.cli import app

TURNS = 6


@pytest.fixture
def fleet_file(library_file: Path, tmp_path: Path) -> Path:
    """A fleet of three wings with a recording each; one line of one of them is garbage, one turn is late."""
    library = f'kind = "strain_library"\nfile = "{library_file}"\n'
    scenario = "notice = false\n" + scenario_files()["growing_damage"].read_text()
    begin, end = scenario.index("[asset]"), scenario.index("[calibration]")
    (tmp_path / "wing.toml").write_text(
        scenario[:begin] + f'[asset]\n{library}\n[belief]\nkind = "asset"\n\n' + scenario[end:]
    )
    (tmp_path / "logs").mkdir()
    noise = np.random.default_rng(3).normal(1e-3, 1e-4, (3, TURNS, 24))
    for number, rows in enumerate(noise):
        path = write_csv(
            tmp_path / "logs" / f"wing-{number}.csv", rows, np.ones(TURNS, dtype=int), number == 1
        )
        if number == 2:
            lines = path.read_text().splitlines()
            lines[3], lines[4] = lines[4], lines[3]
            path.write_text("\n".join(lines) + "\n")
    return fleet_of(tmp_path, "logs/*.csv")


def fleet_of(folder: Path, observations: str) -> Path:
    path = folder / "fleet.toml"
    group = f'[[group]]\nname = "north"\nscenario = "wing.toml"\nobservations = "{observations}"\n'
    path.write_text(f'format = 1\n[fleet]\nname = "real"\nseed = 7\n{group}')
    return path


def single(fleet_file: Path, log: Path, folder: Path) -> bytes:
    """Return the journal of a watch of one asset alone."""
    loaded = load_scenario(fleet_file.parent / "wing.toml")
    watch, lock = begin_watch(loaded, folder, Overrides(seed=7), SilentProgress(), replace_run=False)
    watch.run(file_feed(log, watch.scenario), lambda _decision: None)
    os.close(lock)
    return (folder / JOURNAL_NAME).read_bytes()


def journals(folder: Path) -> list[bytes]:
    return [path.read_bytes() for path in sorted((folder / "north").glob(f"*/{JOURNAL_NAME}"))]


@pytest.fixture
def alone(fleet_file: Path, tmp_path: Path) -> list[bytes]:
    logs = sorted((tmp_path / "logs").glob("*.csv"))
    return [single(fleet_file, log, tmp_path / "alone" / log.stem) for log in logs]


def watched(fleet_file: Path, out: Path, stop_after: int | None = None, **given: Any) -> FleetWatch:
    """Return a fleet that was watched; where it is to stop, in the middle of it."""
    told: list[str] = []

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        told.append(asset.name)
        fleet.asked = len(told) == stop_after

    fleet = FleetWatch(load_fleet(fleet_file), out, tell, told.append, **given)
    fleet.run()
    return fleet


def test_each_asset_has_the_journal_of_a_watch_alone(
    fleet_file: Path, alone: list[bytes], tmp_path: Path
) -> None:
    assert watched(fleet_file, tmp_path / "once").failures == {}
    assert journals(tmp_path / "once") == alone
    for stop in (2, 9, None):  # in the middle of assets; the last time to the end
        watched(fleet_file, tmp_path / "again", stop)
    assert journals(tmp_path / "again") == alone
    state = json.loads((tmp_path / "again" / "watched.json").read_text())["assets"]
    assert [state[f"north/wing-{number}"]["last"]["turn"] for number in range(3)] == [TURNS - 1] * 3
    with pytest.raises(RunFolderExistsError, match="another fleet"):
        FleetWatch(load_fleet(fleet_file, seed=8), tmp_path / "again", print, print)


def test_files_that_grow(
    fleet_file: Path, alone: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.fleet.watching.SEARCH_SECONDS", 0.0)
    (tmp_path / "growing").mkdir()
    pieces = [(path.name, path.read_bytes()) for path in sorted((tmp_path / "logs").glob("*.csv"))]
    cuts = [0.0, 0.02, 0.4, 0.77, 1.0]  # within the header, and within lines

    def grow() -> None:
        step = len(looks)
        looks.append(step)
        for name, content in pieces[: step + 1]:  # they come one after the other
            (tmp_path / "growing" / name).write_bytes(content[: int(cuts[min(step, 4)] * len(content))])
        fleet.asked = step == 8

    looks: list[int] = []
    fleet = FleetWatch(
        load_fleet(fleet_of(tmp_path, "growing/*.csv")), tmp_path / "out", lambda *_: None, print, follow=True
    )
    fleet.run(grow)
    assert journals(tmp_path / "out") == alone


def test_an_asset_is_lost_alone(fleet_file: Path, alone: list[bytes], tmp_path: Path) -> None:
    (tmp_path / "logs" / "wing-0.csv").write_text("turn,colour\n0,red\n")
    (tmp_path / "logs" / "not a name!.csv").write_text("turn\n")
    (tmp_path / "logs" / "void.csv").write_text("")
    fleet = watched(fleet_file, tmp_path / "out")
    assert set(fleet.failures) == {"north/wing-0", "north/not a name!", "north/void"}
    assert "colour" in fleet.failures["north/wing-0"]
    assert "void.csv is empty" in fleet.failures["north/void"]
    assert journals(tmp_path / "out") == alone[1:]
    with pytest.raises(FleetError, match="no recording fits"):
        FleetWatch(load_fleet(fleet_of(tmp_path, "none/*.csv")), tmp_path / "none", print, print)
    fleet_of(tmp_path, "logs/*.csv")
    fleet_file.write_text(fleet_file.read_text().replace('observations = "logs/*.csv"', "count = 2"))
    with pytest.raises(FleetError, match="north has none"):
        FleetWatch(load_fleet(fleet_file), tmp_path / "flown", print, print)


@pytest.fixture
def broker(fleet_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mosquitto]:
    """A broker that has a topic for each asset of the fleet."""
    if shutil.which("mosquitto") is None:
        pytest.skip("no mosquitto")
    monkeypatch.setenv("UAV_TWIN_MQTT_PASSWORD", PASSWORD)
    broker = Mosquitto(tmp_path)
    fleet_of(tmp_path, f"mqtt://wing@127.0.0.1:{broker.port}/wings/+")
    yield broker
    broker.stop()


def make_unwell(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Let the watch of an asset meet an error of ours once, behind its third turn."""
    decisions, unwell = Watch.decisions, iter([True])

    def once_unwell(watch: Watch, *given: Any) -> Iterator[dict[str, Any]]:
        for decision in decisions(watch, *given):
            yield decision
            if watch.folder.name == name and decision["turn"] >= 2 and next(unwell, False):
                raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(Watch, "decisions", once_unwell)


def test_an_asset_that_was_lost_is_taken_up_again(
    fleet_file: Path, alone: list[bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One whose file was wrong, and one that met an error of ours; a log that is gone is awaited."""
    for name in ("SEARCH_SECONDS", "AGAIN_SECONDS"):
        monkeypatch.setattr(f"twin_master.fleet.watching.{name}", 0.0)
    logs = [tmp_path / "logs" / f"wing-{number}.csv" for number in range(3)]
    (tmp_path / "logs" / "wing-1.txt").write_text("turn,strain_1\n")  # another of that name
    contents, at = [log.read_bytes() for log in logs], 0
    logs[1].write_text("turn,strian_1\n")
    make_unwell(monkeypatch, "wing-2")

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        if asset.name == "north/wing-0" and decision["turn"] == 2 and "told_again" not in decision:
            logs[0].unlink()

    def mend() -> None:
        nonlocal at
        at += 1
        if at == 3:
            for log, content in zip(logs, contents, strict=True):
                log.write_bytes(content)
        fleet.asked = at == 6

    notes: list[str] = []
    file = fleet_of(tmp_path, "logs/*")
    fleet = FleetWatch(load_fleet(file), tmp_path / "out", tell, notes.append, follow=True)
    fleet.run(mend)
    assert journals(tmp_path / "out") == alone
    assert fleet.failures == {"north/wing-1 of wing-1.txt": "another file has the same name."}
    said = [note for note in notes if "is not watched" in note]
    assert sum(note.startswith("north/wing-2 is not watched: ZeroDivisionError") for note in said) == 1
    assert sum("strian_1" in note for note in said) == 1
    again = [note for note in notes if note.endswith("is watched again.")]
    assert sorted(again) == ["north/wing-1 is watched again.", "north/wing-2 is watched again."]


def test_a_topic_for_each_asset(broker: Mosquitto, alone: list[bytes], tmp_path: Path) -> None:
    heard: list[tuple[str, int]] = []
    listener = broker.client("listener")
    listener.on_message = lambda _client, _data, message: heard.append(
        (message.topic, json.loads(message.payload)["turn"])
    )
    listener.subscribe("wings/+/decision", qos=1)
    sent: list[int] = []

    def send() -> None:
        """Publish once the twin is connected: a kill in between, whose messages the broker keeps."""
        if notes and not sent:
            sent.append(1)
            for number in range(2):
                rows = (tmp_path / "logs" / f"wing-{2 * number}.csv").read_text().splitlines()[1:]
                for row in rows:
                    turn, control, *cells = row.split(",")
                    record = {"turn": int(turn), "control": control, "strain": [float(c) for c in cells]}
                    publisher.publish(f"wings/wing-{2 * number}", json.dumps(record), qos=1)

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        told.append(decision["turn"])
        fleet.asked = len(told) in (4, 2 * TURNS + 1)

    publisher = broker.client("publisher")
    told: list[int] = []
    for _ in range(2):  # asked to end after four turns; one more decision for the late message
        notes: list[str] = []
        fleet = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append)
        fleet.run(send)
    kept = [[line[65:] for line in own.splitlines()[1:]] for own in journals(tmp_path / "out")]
    for ours, theirs in zip(kept, (alone[0], alone[2]), strict=True):
        wanted = [json.loads(line[65:]) for line in theirs.splitlines()[1:]]
        found = [json.loads(line) for line in ours]
        for records in (wanted, found):
            for record in records:  # the broker sent again what the end left unacknowledged
                del record["intake"]
        assert found == wanted
    assert {topic for topic, _ in heard} == {"wings/wing-0/decision", "wings/wing-2/decision"}


def test_a_topic_that_was_lost_is_taken_up_again_with_what_came_meanwhile(
    broker: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.fleet.watching.SEARCH_SECONDS", 0.0)
    make_unwell(monkeypatch, "wing-0")
    publisher, notes, told, sent = broker.client("publisher"), list[str](), list[int](), list[int]()

    def send() -> None:
        if notes and not sent:
            sent.append(1)
            for turn in range(TURNS):
                record = {"turn": turn, "control": "2g", "strain": [1e-3] * 24}
                for name in ("late", "wing-0"):
                    publisher.publish(f"wings/{name}", json.dumps(record), qos=1)
        boxes = fleet._sources[0]._inboxes  # type: ignore[union-attr]
        if [len(box.came) for box in boxes.values()] == [TURNS, TURNS - 3]:  # all that came meanwhile
            (north / "late").unlink(missing_ok=True)
            (north / "wing-0" / "published").write_text("")
            fleet._again = dict.fromkeys(fleet._again, 0.0)

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        told.append(decision["turn"])
        fleet.asked = len(told) == 2 * TURNS

    fleet = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append)
    north = tmp_path / "out" / "north"
    north.mkdir()
    (north / "late").write_text("no folder")  # an asset whose first taking up fails
    fleet.run(send)
    assert sorted(told) == sorted([*range(TURNS)] * 2)
    assert notes[1].startswith("north/late is not watched: ")
    assert notes[2:5] == [
        "north/wing-0 is not watched: ZeroDivisionError: division by zero",
        "north/late is watched again.",
        "north/wing-0 is watched again.",
    ]
    assert fleet.assets["north/wing-0"].keep.intake.counts.missing == 0


def test_a_topic_that_jumps_ahead_and_is_left_alone(broker: Mosquitto, tmp_path: Path) -> None:
    publisher, notes, told = broker.client("publisher"), list[str](), list[tuple[str, int, int]]()
    last = 2 * TURNS_AT_ONCE  # a single message that brings more turns than a file is read at once

    def send() -> None:
        if notes:
            for turn in (0, *range(last, last + 20)):
                record = {"turn": turn, "control": "2g", "strain": [1e-3] * 24}
                publisher.publish("wings/wing-0", json.dumps(record), qos=1)
            publisher.publish("wings/last", json.dumps({"turn": 0, "control": "2g"}), qos=1)
            notes.clear()

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        told.append((asset.name, decision["turn"], decision["lost_sensors"]))
        fleet.asked = asset.name == "north/last"

    fleet = FleetWatch(
        load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append, turns=last + 1
    )
    fleet.run(send)
    lost = [0, *[24] * (last - 1), 0]
    assert told == [*(("north/wing-0", turn, lost[turn]) for turn in range(last + 1)), ("north/last", 0, 24)]
    inboxes = fleet._sources[0]._inboxes  # type: ignore[union-attr]
    assert [len(inbox.came) for inbox in inboxes.values() if inbox] == [0, 0]  # nineteen came too late


def test_an_asset_that_falls_silent_while_another_is_heard(
    broker: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one that was watched before; and what was decided of it and never published is."""
    monkeypatch.setattr("twin_master.fleet.watching.SEARCH_SECONDS", 0.0)
    monkeypatch.setattr("twin_master.watch.mqtt.HEARTBEAT_SECONDS", 0.0)
    with (tmp_path / "wing.toml").open("a") as file:
        file.write("\n[watch]\nquiet_after_seconds = 0.5\n")
    heard = list[dict[str, Any]]()
    client, notes, told = broker.client("client", heard), list[str](), list[tuple[str, int, list[str]]]()
    client.subscribe([("wings/+/decision", 1), ("wings/fleet/heartbeat", 1)])
    turns = iter(range(1000))

    def send() -> None:
        record = {"turn": next(turns), "control": "2g", "strain": [1e-3] * 24}
        for name in ("one", "two") if record["turn"] == 0 else ("one",):
            client.publish(f"wings/{name}", json.dumps(record), qos=1)

    def tell(asset: WatchedAsset, decision: Mapping[str, Any]) -> None:
        told.append((asset.name, decision["turn"], [notice["kind"] for notice in decision["notices"]]))
        fleet.asked = told[-1] == ("north/two", 0, ["quiet"])

    fleet = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", tell, notes.append)
    fleet.run(lambda: send() if notes else None)
    assert fleet.asked
    assert fleet.failures == {}
    published = tmp_path / "out" / "north" / "two" / "published"
    published.write_text("?")  # as if a kill had come before the broker had it
    client.publish("wings/one", "no observation", qos=1).wait_for_publish(20)
    again = FleetWatch(load_fleet(tmp_path / "fleet.toml"), tmp_path / "out", lambda *_: None, notes.append)

    def end() -> None:
        again.asked = [one["notices"] for one in heard if one.get("turn") == 0][-1:] != [[]]

    again.run(end)
    wait_until(lambda: [one["state"] for one in heard if "state" in one][-1] == "ended")
    client.disconnect()
    assert [said for said in told if said[0] == "north/two"] == [
        ("north/two", 0, []), ("north/two", 0, ["quiet"]),
    ]  # fmt: skip
    assert all(kinds == [] for name, _, kinds in told if name == "north/one")
    assert [one["state"] for one in heard if "state" in one][-1] == "ended"
    assert max(one["quiet"] for one in heard if "quiet" in one) == 1


def test_the_command(fleet_file: Path, tmp_path: Path) -> None:
    words = ["fleet", "watch", str(fleet_file), "--out", str(tmp_path / "out"), "--turns", "3"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    decisions = [json.loads(line) for line in result.stdout.splitlines()]
    last = {decision["asset"]: decision["turn"] for decision in decisions}
    assert last == {f"north/wing-{number}": 2 for number in range(3)}
    assert "3 assets, 9 turns, 0 alarms" in result.stderr


def test_recordings_are_flown_as_a_fleet(fleet_file: Path, alone: list[bytes], tmp_path: Path) -> None:
    (tmp_path / "logs" / "wing-0.csv").write_text(
        "".join((tmp_path / "logs" / "wing-0.csv").read_text().splitlines(keepends=True)[:4])
    )
    with fleet_file.open("a") as file:
        file.write(f"steps = {TURNS}\n")
    outcome = fly_fleet(load_fleet(fleet_file), tmp_path / "flown", Engine(0))
    group = fleet_groups(outcome.folder)["north"]
    for row, (journal, turns) in enumerate(zip(alone, (3, TURNS, TURNS), strict=True)):
        last: dict[int, dict[str, Any]] = {}
        for line in journal.splitlines()[1:]:
            record = json.loads(line[65:])
            last[record["turn"]] = record
        assert group["control_index"].values[row].tolist() == [1] * turns + [-1] * (TURNS - turns)
        assert np.isnan(group["log_evidence"].values[row, turns:]).all()
        wanted = np.array(last[turns - 1]["filtered"], np.float32)
        assert np.array_equal(group["belief"].values[row], wanted)
        for turn in range(turns):
            evidence = group["log_evidence"].values[row, turn]
            late = row == 2 and turn in (2, 3)  # written down before the late message came
            assert late or evidence == np.float32(last[turn]["log_evidence"])
    assert group_figures(group)["flown"] == 3
    assert "early fallback" not in group_figures(group)
    lessons = learn_fleet(outcome.folder)
    assert lessons_record(lessons)["groups"]["north"]["probability"]["2g"]["flown"] is False
    write_learnt(tmp_path / "learnt.toml", lessons)
    probability = tomllib.loads((tmp_path / "learnt.toml").read_text())["transition"]["probability"]
    assert probability["2g"] == 0.05  # as it was assumed
    assert probability["3g"] != 0.10
    write_fleet_report(outcome.folder)
    with fleet_file.open("a") as file:
        file.write('[[group]]\nname = "south"\nscenario = "wing.toml"\nobservations = "none/*.csv"\n')
    with pytest.raises(FleetError, match="no recording fits"):
        fly_fleet(load_fleet(fleet_file), tmp_path / "other", Engine(0))


def test_recordings_teach_what_the_flights_taught(fleet_file: Path, tmp_path: Path) -> None:
    flown = ensemble(str(tmp_path / "wing.toml"), range(4))
    fly_fleet(flown, tmp_path / "flown", Engine(0))
    group = fleet_groups(tmp_path / "flown")["growing_damage"]
    for row in range(4):
        observed = group["observed"].values[row].astype(np.float64)
        write_csv(tmp_path / "logs" / f"wing-{row}.csv", observed, group["control_index"].values[row])
    fly_fleet(load_fleet(fleet_file), tmp_path / "recorded", Engine(0))
    again = fleet_groups(tmp_path / "recorded")["north"]
    assert np.array_equal(again["observed"].values, group["observed"].values)
    np.testing.assert_allclose(again["mean"].values, group["mean"].values, atol=1e-4)
    first, second = (learn_fleet(tmp_path / name).groups[0].grid.marginals for name in ("flown", "recorded"))
    assert [m.mean for m in first] == [m.mean for m in second]


def ensemble_scenario(folder: Path) -> Scenario:
    return ensemble(str(folder / "wing.toml"), range(60)).groups[0].scenarios[0]


def test_the_store_counts_the_notices_that_watches_gave(fleet_file: Path, tmp_path: Path) -> None:
    """And a watched asset says how probably it leaves its control, as the store does."""
    wing, log = tmp_path / "wing.toml", tmp_path / "logs" / "wing-1.csv"
    wing.write_text(wing.read_text().removeprefix("notice = false\n"))
    header, *rows = log.read_text().splitlines()
    rows[2] = ",".join([*rows[2].split(",")[:-1], "OL"])
    log.write_text("\n".join([header, *rows]) + "\n")
    with fleet_file.open("a") as file:
        file.write(f"steps = {TURNS}\n")
    fleet = watched(fleet_file, tmp_path / "out")
    fly_fleet(load_fleet(fleet_file), tmp_path / "flown", Engine(0))
    group = fleet_groups(tmp_path / "flown")["north"]
    alarmed = 0
    for row in range(3):
        told = [n for n in fleet.assets[f"north/wing-{row}"].watch.told(0) if n[1].kind != "gauge_back"]
        for place, kind in enumerate(("alarm", "gauge_left_out")):
            turns = [turn for turn, notice in told if notice.kind == kind]
            if row != 2:  # whose late message tells of turns before it
                assert group["notices"].values[row, place] == len(turns)
                assert group["first_notice"].values[row, place] == min(turns, default=-1)
        alarmed += any(notice.kind == "alarm" for _, notice in told)
        assert fleet.assets[f"north/wing-{row}"].record().alarms == sum(n.kind == "alarm" for _, n in told)
    assert group["notices"].values[1, 1] >= 1
    assert alarmed >= 1
    assert group_figures(group)["raised an alarm"] == alarmed
    assert learn_fleet(tmp_path / "flown").groups[0].alarmed == alarmed
    assert "raised an alarm, first in" in write_fleet_report(tmp_path / "flown").read_text()
    config = json.loads((tmp_path / "flown" / "config.json").read_text())
    soon = leaving(tmp_path / "flown", config["fleet"]["groups"][0], group)
    state = json.loads((tmp_path / "out" / "watched.json").read_text())["assets"]
    found = [state[f"north/wing-{row}"]["leaving"] for row in range(3)]
    np.testing.assert_allclose(found, soon, atol=1e-6)
    again = watched(fleet_file, tmp_path / "out")  # of which nothing is left to read
    assert [again.assets[f"north/wing-{row}"].record().leaving for row in range(3)] == pytest.approx(found)


def test_the_page_of_a_fleet(fleet_file: Path, tmp_path: Path) -> None:
    (tmp_path / "logs" / "wing-0.csv").write_text("turn,colour\n0,red\n")
    (tmp_path / "logs" / "wing-9.csv").write_text("turn,control\n")
    out = tmp_path / "out"
    watched(fleet_file, out)
    fly_fleet(ensemble(str(tmp_path / "wing.toml"), range(60)), tmp_path / "flown", Engine(0))
    flown = fleet_view(tmp_path / "flown")
    group = fleet_groups(tmp_path / "flown")["growing_damage"]
    knowledge = kept_knowledge(tmp_path / "flown" / "groups" / "growing_damage", ensemble_scenario(tmp_path))
    belief, control = group["belief"].values.astype(float), group["control_index"].values[:, -1]
    soon = [attention(knowledge, own[None], int(u))[0] for own, u in zip(belief, control, strict=True)]
    # Who leaves with the same percentage comes by its state.
    printed = np.rint(100.0 * np.maximum(soon, 0.0))
    worst = np.lexsort((-group["mean"].values[:, -1].sum(axis=1), -printed))
    assert max(soon) > min(soon) + 0.1
    assert len(set(printed)) < len(set(soon))
    table = flown.partition("Who needs attention next")[2]
    assert re.findall(r"seed-\d+", table) == [f"seed-{row}" for row in worst[:50]]
    with pytest.raises(FleetError, match="holds no fleet"):
        fleet_view(tmp_path)
    address, ended = Queue[str](), Event()
    serving = Thread(target=serve_fleet, args=(out, 0, address.put, lambda: not ended.is_set()))
    serving.start()
    try:
        port = int(address.get(timeout=20).rstrip("/").rpartition(":")[2])

        def asked(path: str, host: str = "localhost") -> tuple[int, str]:
            connection = HTTPConnection("127.0.0.1", port, timeout=20)
            connection.request("GET", path, headers={"Host": host})
            with closing(connection), connection.getresponse() as answer:
                return answer.status, answer.read().decode()

        status, page = asked("/")
        assert status == 200
        assert "wing-1" in page
        assert "colour" in page  # why the other one is not watched
        assert "1 of 4 assets are not watched" in page
        assert "Without a turn yet: 1 asset (north/wing-9)" in page
        assert "<strong>1</strong><span>messages refused" in page
        assert asked("/version") == (200, "0")
        assert asked("/", "evil.example")[0] == 404
        state = json.loads((out / "watched.json").read_text())
        state["assets"]["north/wing-1"]["alarms"] = 1234
        (out / "watched.json").write_text(json.dumps(state))
        for _ in range(100):
            if asked("/version") == (200, "1"):
                break
            ended.wait(0.05)
        assert "1234" in asked("/")[1]
        last = state["assets"]["north/wing-1"]["last"]
        for change, sentence in (
            (last["health"].popitem, "watched.json: the health of an asset of north"),
            (partial(last.pop, "health"), "watched.json: 'assets.last.health' is missing"),
        ):
            change()
            (out / "watched.json").write_text(json.dumps(state))
            with pytest.raises(FleetError, match=sentence):
                fleet_view(out)
    finally:
        ended.set()
        serving.join()
