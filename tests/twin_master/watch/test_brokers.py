"""A watch over a real broker."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from reporting.progress import SilentProgress
from tests.twin_master.watch.watches import PASSWORD, Mosquitto, begun, lines, soon_quiet, wait_until
from twin_master.errors import MissionInputError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.turns import History
from twin_master.scenario.reading import LoadedScenario
from twin_master.watch.broker import PASSWORD_VARIABLE, Broker, broker_of
from twin_master.watch.folder import Watch
from twin_master.watch.intake import Counts
from twin_master.watch.mqtt import MqttFeed
from twin_master.watch.opening import flown
from uav_twin.cli import app

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches
needs_mosquitto = pytest.mark.skipif(shutil.which("mosquitto") is None, reason="no mosquitto")


@needs_mosquitto
@pytest.mark.parametrize("tls", [False, True])
def test_over_a_broker_that_stops_and_a_hostile_publisher(
    base: Watch, mission: History, whole: Path, tmp_path: Path, tls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker = Mosquitto(tmp_path, tls=tls)
    scheme, host = ("mqtts", "localhost") if tls else ("mqtt", "127.0.0.1")
    where = broker_of(f"{scheme}://wing@{host}:{broker.port}/wing/7", broker.authority if tls else None)
    watch = begun(base, tmp_path / "watch")
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")
    with pytest.raises(MissionInputError, match=r"refuses the twin.*[Nn]ot authorized"):
        watch.run(MqttFeed(where, watch, str), lambda _decision: None)
    assert not [*watch.folder.glob("*.mqtt")]  # a client that never was in is no client that was forgotten
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    notes: list[str] = []
    feed = MqttFeed(where, watch, notes.append)
    turns = len(mission.observed)
    watching = threading.Thread(target=watch.run, args=(feed, feed.decide), kwargs={"turns": turns})
    watching.start()
    heard: list[dict[str, Any]] = []
    listener = broker.client("listener", heard)
    listener.subscribe("wing/7/decision", qos=1)
    wait_until(lambda: notes)
    publisher = broker.client("publisher")

    def publish(first: int, last: int) -> None:
        for turn in range(first, last):
            row, control = mission.observed[turn], ("2g", "3g")[mission.control_index[turn]]
            record = {"turn": turn, "control": control, "strain": row.tolist()}
            publisher.publish("wing/7", json.dumps(record), qos=1).wait_for_publish(20)

    publish(0, 20)
    for number in range(1000):
        publisher.publish("wing/7", b"garbage %d" % number, qos=0)
    publisher.publish("wing/7", b"x" * 3_000_000, qos=0)
    publisher.publish("wing/7", json.dumps({"strain": [1e-4] * 24}), qos=1)  # of which turn?
    publish(15, 19)
    if not tls:
        broker.stop()
        broker.start()
        wait_until(publisher.is_connected)
    publish(20, turns)
    watching.join(60)
    assert not watching.is_alive()
    feed.close()
    wait_until(lambda: heard and heard[-1]["turn"] == turns - 1)
    publisher.disconnect()
    listener.disconnect()
    broker.stop()
    last, expected = (
        json.loads((folder / JOURNAL_NAME).read_text().splitlines()[-1][65:])
        for folder in (watch.folder, whole)
    )
    assert last["filtered"] == expected["filtered"]
    assert last["intake"]["counts"]["late"] == 0
    assert last["intake"]["counts"]["duplicates"] >= 4
    assert 1 <= last["intake"]["counts"]["rejected"] < 1010  # a broker may lose or repeat some
    assert {decision["turn"] for decision in heard} == set(range(turns))
    assert all(decision["probability"] >= 0.5 for decision in heard)


@pytest.fixture
def broker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Mosquitto]:
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    broker = Mosquitto(tmp_path)
    yield broker
    broker.stop()


def where_of(broker: Mosquitto) -> Broker:
    return broker_of(f"mqtt://wing@127.0.0.1:{broker.port}/wing/7")


def killed(where: Broker, watch: Watch, lines: int, turns: int) -> bool:
    """Watch in a process of its own, killed once its journal has grown; return whether it was killed."""
    journal = watch.folder / JOURNAL_NAME
    size = journal.stat().st_size + 2000 * lines
    child = os.fork()
    if not child:
        try:
            feed = MqttFeed(where, watch, str)
            watch.run(feed, feed.decide, turns=turns)
            feed.close()
            os._exit(0)
        finally:
            os._exit(1)
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if journal.stat().st_size >= size:
            os.kill(child, signal.SIGKILL)
            ended = os.waitpid(child, 0)
            break
        time.sleep(0.001)
    assert ended[1] in (0, signal.SIGKILL)
    return ended[1] == signal.SIGKILL


@needs_mosquitto
@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.long)])
def test_every_decision_of_a_backlog_is_published_however_often_the_watch_is_killed(
    base: Watch, broker: Mosquitto, tmp_path: Path, kills: int
) -> None:
    turns, chance, where = 60 * kills, random.Random(kills), where_of(broker)
    watch = begun(base, tmp_path / "watch")
    heard: list[dict[str, Any]] = []
    listener = broker.client("listener", heard)
    listener.subscribe("wing/7/decision", qos=1)

    def publish(_note: str) -> None:
        for turn in range(turns):
            record = {"turn": turn, "control": "2g", "strain_1": 1e-3}
            listener.publish("wing/7", json.dumps(record), qos=1).wait_for_publish(60)

    feed = MqttFeed(where, watch, publish)
    watch.run(feed, feed.decide, turns=1)  # the other messages wait at the broker
    feed.close()
    listener.disconnect()
    listener.loop_stop()  # no thread while processes are forked; the broker keeps what it is to hear
    met = 0
    while killed(where, watch, chance.randrange(40) if met < kills else 2 * turns, turns):
        met += 1
    assert met == kills
    listener = broker.client("listener", heard)
    wait_until(lambda: heard and heard[-1]["turn"] == turns - 1)
    listener.disconnect()
    journalled = [line["turn"] for line in lines(watch)]
    assert journalled == list(range(turns))
    assert {decision["turn"] for decision in heard} == {*journalled}
    again = [decision for decision in heard if decision.get("told_again")]
    assert len(again) >= kills
    assert len(heard) < turns + 100 * kills


def message(turn: int) -> str:
    return json.dumps({"turn": turn, "control": "2g", "strain_1": 1e-3})


@needs_mosquitto
def test_an_orderly_end_and_a_watch_that_takes_the_place_of_another(
    scenario: LoadedScenario, base: Watch, broker: Mosquitto, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    publisher, notes = broker.client("publisher"), list[str]()

    def publish(*turns: int) -> None:
        for turn in turns:
            publisher.publish("wing/7", message(turn), qos=1).wait_for_publish(20)

    def watched(watch: Watch, turns: int, *sent: int) -> Counts:
        def note(text: str) -> None:
            notes.append(text)
            publish(*sent)

        feed = MqttFeed(where_of(broker), watch, note)
        counts = watch.run(feed, feed.decide, turns=turns)
        feed.close()
        return counts

    watch = begun(base, tmp_path / "watch")
    assert watched(watch, 3, 0, 1, 2).received == 3
    assert watched(watch, 4, 3) == Counts(received=4)  # the third does not come again
    heard: list[dict[str, Any]] = []
    publisher.on_message = lambda _client, _data, one: heard.append(json.loads(one.payload))
    publisher.subscribe([("wing/7/decision", 1), ("wing/7/heartbeat", 1)])
    (watch.folder / "published").write_text("0" * 20)
    watched(watch, 4)  # nothing more is wanted, and what was not published is
    wait_until(lambda: {one["turn"] for one in heard if "control" in one} == {0, 1, 2, 3})
    feed = MqttFeed(where_of(broker), watch, lambda _note: publish(4))
    with pytest.raises(ZeroDivisionError), closing(feed):
        watch.run(feed, lambda decision: decision["turn"] // 0)
    wait_until(lambda: heard[-1].get("state") == "lost")
    names = [path.read_text() for path in watch.folder.glob("*.mqtt")]
    other = begun(base, tmp_path / "other")
    watched(other, 1, 0)
    names += [path.read_text() for path in other.folder.glob("*.mqtt")]
    assert len({*names}) == len(names) == 2  # nobody who knows the folder can guess it
    publish(599)  # to a watch that is no more
    publisher.publish("wing/7", message(598), qos=1, retain=True).wait_for_publish(20)
    states: list[dict[str, Any]] = []
    listener = broker.client("listener", states)
    listener.subscribe("wing/7/heartbeat")
    wait_until(lambda: states)

    def begin() -> None:
        wait_until(lambda: states[-1]["state"] == "watching")
        publish(0)

    beginning = threading.Thread(target=begin)
    beginning.start()
    words = ["watch", str(scenario.path), "--observations", f"mqtt://wing@127.0.0.1:{broker.port}/wing/7"]
    words += ["--out", str(watch.folder), "--turns", "1", "--no-report"]
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")  # the first attempt fails, and the wish is kept
    assert "refuses the twin" in str(CliRunner().invoke(app, [*words, "--replace"]).exception)
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    result = CliRunner().invoke(app, [*words, "--resume"])
    beginning.join()
    assert [json.loads(line)["turn"] for line in result.stdout.splitlines()] == [0]
    assert "1 messages." in result.stderr
    assert [path.read_text() for path in watch.folder.glob("*.mqtt")] == names[:1]
    assert all(note.startswith("Connected") for note in notes)
    listener.disconnect()
    publisher.disconnect()


@needs_mosquitto
def test_a_broker_that_refuses_the_twin_when_it_comes_back(
    base: Watch, broker: Mosquitto, tmp_path: Path
) -> None:
    watch, notes = begun(base, tmp_path / "watch"), list[str]()
    feed = MqttFeed(where_of(broker), watch, notes.append)
    watching = threading.Thread(target=watch.run, args=(feed, feed.decide), kwargs={"turns": 2})
    watching.start()
    wait_until(lambda: notes)
    publisher = broker.client("publisher")
    publisher.publish("wing/7", message(0), qos=1).wait_for_publish(20)
    broker.stop()
    broker.let_in("another")
    broker.start()
    wait_until(lambda: any("refuses the twin" in note for note in notes))
    broker.stop()
    broker.let_in(PASSWORD)
    broker.start()
    wait_until(lambda: notes[-1].startswith("Connected") and publisher.is_connected())
    publisher.publish("wing/7", message(1), qos=1).wait_for_publish(60)
    watching.join(60)
    assert not watching.is_alive()
    feed.close()
    publisher.disconnect()
    assert any(note.startswith("Waiting: the broker at 127.0.0.1") and "authorized" in note for note in notes)


@needs_mosquitto
def test_a_right_that_the_twin_has_not(base: Watch, broker: Mosquitto, tmp_path: Path) -> None:
    watch, notes, heard = begun(base, tmp_path / "watch"), list[str](), list[dict[str, Any]]()
    feed = MqttFeed(where_of(broker), watch, notes.append)
    watching = threading.Thread(target=watch.run, args=(feed, feed.decide), kwargs={"turns": 3})
    watching.start()
    wait_until(lambda: notes)
    (tmp_path / "rights").write_text("user wing\ntopic readwrite wing/7\n")
    broker.further.append(f"acl_file {tmp_path / 'rights'}")
    publisher = broker.client("publisher", heard)
    publisher.subscribe("wing/7/decision", qos=1)
    publisher.publish("wing/7", message(0), qos=1).wait_for_publish(20)
    wait_until(lambda: heard)
    broker.stop()
    broker.start()
    publisher.publish("wing/7", message(1), qos=1)
    wait_until(lambda: "does not take" in notes[-1])
    broker.further.pop()
    broker.stop()
    broker.start()
    publisher.publish("wing/7", message(2), qos=1)
    watching.join(60)
    assert not watching.is_alive()
    feed.close()
    wait_until(lambda: heard[-1]["turn"] == 2)
    publisher.disconnect()

    assert "The broker does not take wing/7/decision: Not authorized." in notes
    assert [decision["turn"] for decision in heard] == [0, 1, 2]


RIGHTS_PLUGIN = Path("/usr/lib/x86_64-linux-gnu/mosquitto_dynamic_security.so")


@needs_mosquitto
@pytest.mark.skipif(not RIGHTS_PLUGIN.is_file(), reason="no plugin of mosquitto for rights")
def test_a_subscription_that_is_refused(base: Watch, broker: Mosquitto, tmp_path: Path) -> None:
    given = {"publishClientSend": True, "publishClientReceive": True, "subscribe": False}
    (tmp_path / "rights.json").write_text(json.dumps({"defaultACLAccess": given}))
    broker.further += ["allow_anonymous true", f"plugin {RIGHTS_PLUGIN}"]
    broker.further += [f"plugin_opt_config_file {tmp_path / 'rights.json'}"]
    broker.stop()
    broker.start()
    watch = begun(base, tmp_path / "watch")
    feed = MqttFeed(broker_of(f"mqtt://127.0.0.1:{broker.port}/wing/7"), watch, str)
    with pytest.raises(MissionInputError, match=r"does not let the twin read wing/7: Not authorized"):
        watch.run(feed, feed.decide)


@needs_mosquitto
def test_a_watch_that_hears_nothing_says_so(
    base: Watch, broker: Mosquitto, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin_master.watch.mqtt.HEARTBEAT_SECONDS", 0.1)
    watch = soon_quiet(begun(base, tmp_path / "watch"))

    def watching() -> int:
        child = os.fork()
        if child:
            return child
        try:
            feed = MqttFeed(where_of(broker), watch, str)
            watch.run(feed, feed.decide)
            feed.close()
        finally:
            os._exit(1)

    def has(turn: int, kind: str) -> bool:
        told = [one for one in heard if one.get("turn") == turn]
        return any(notice["kind"] == kind for one in told for notice in one.get("notices", ()))

    def states(count: int = 1) -> list[str]:
        return [one["state"] for one in heard if "state" in one][-count:]

    child, heard = watching(), list[dict[str, Any]]()
    client = broker.client("client", heard)
    client.subscribe("wing/7/+", qos=1)
    wait_until(lambda: has(-1, "quiet"))
    wait_until(lambda: states() == ["quiet"])
    client.publish("wing/7", b"garbage", qos=1)
    client.publish("wing/7", message(0), qos=1)
    wait_until(lambda: has(0, "heard") and has(0, "quiet"))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    wait_until(lambda: states() == ["lost"])
    client.disconnect()
    client.loop_stop()
    child = watching()
    client = broker.client("client", heard)
    wait_until(lambda: states() == ["quiet"])
    os.kill(child, signal.SIGTERM)
    os.waitpid(child, 0)
    wait_until(lambda: states() == ["ended"])
    client.disconnect()
    beat = [one for one in heard if one.get("state") == "quiet"][-1]
    assert {key: beat[key] for key in ("turn", "lag", "received", "refused")} == {
        "turn": 0, "lag": 0, "received": 2, "refused": 1
    }  # fmt: skip
    assert (has(-1, "quiet"), has(0, "heard"), has(0, "quiet"), states()) == (True, True, True, ["ended"])
    kinds = [notice.kind for _, notice in watch.told(-1)]
    assert kinds[:3] == ["quiet", "heard", "quiet"]
    with flown(watch.folder, None, None, SilentProgress()) as copy:
        assert "see whether logger and broker are there" in (copy / "summary.json").read_text()


def test_addresses_of_brokers(tmp_path: Path) -> None:
    assert broker_of("mqtt://host/a/b").port == 1883
    assert broker_of("mqtts://me@host:1/a").user == "me"
    assert broker_of("mqtts://me%40work@host:1/a").user == "me@work"
    for wrong, match in (
        ("mqtt://me:secret@host/a", "every user of this machine"),
        ("mqtt://host/a/#", "one asset"),
        ("mqtt://host/+/a", "one asset"),
        ("mqtt://host", "is expected"),
        ("mqtt://host:x/a", "is expected"),
    ):
        with pytest.raises(MissionInputError, match=match):
            broker_of(wrong)
    (tmp_path / "authority.pem").write_text("no certificate")
    with pytest.raises(MissionInputError, match=r"authority.pem holds no certificate"):
        broker_of("mqtts://host/a", tmp_path / "authority.pem")
