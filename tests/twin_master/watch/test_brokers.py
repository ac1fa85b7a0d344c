"""A watch over a real broker."""

import json
import random
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.command_line import command
from tests.refusals import Inputs, refused
from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import PASSWORD, Mosquitto, begun, killed_at, mosquitto, ran, wait_until
from twin_master.errors import MissionInputError
from twin_master.mission.journal import JOURNAL_NAME, records
from twin_master.watch.broker_address import PASSWORD_VARIABLE, Broker, parse_broker
from twin_master.watch.csv_feed import CsvFeed
from twin_master.watch.folder import Watch
from twin_master.watch.intake import Counts
from twin_master.watch.mqtt import MqttFeed, Topic

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches
TOPIC, DECISION = "wing/7", "wing/7/decision"
Told = dict[str, Any]


@pytest.fixture
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Mosquitto]:
    with mosquitto(tmp_path, tls=getattr(request, "param", False)) as broker:
        yield broker


def address(broker: Mosquitto) -> str:
    return f"mqtt://wing@127.0.0.1:{broker.port}/{TOPIC}"


def where_of(broker: Mosquitto) -> Broker:
    return parse_broker(address(broker))


def message(step: int, **others: object) -> str:
    return json.dumps({"step": step, "control": "2g", "strain_1": 1e-3, **others})


def publish(client: Any, *steps: int) -> None:
    for step in steps:
        client.publish(TOPIC, message(step), qos=1).wait_for_publish(60)


@contextmanager
def watching(where: Broker, watch: Watch, steps: int) -> Iterator[list[str]]:
    """Watch so many steps in a thread, from when the twin is connected on; yields what it notes."""
    notes = list[str]()
    feed = MqttFeed(where, watch, notes.append)
    thread = threading.Thread(target=watch.run, args=(feed, str), kwargs={"step_limit": steps})
    thread.start()
    wait_until(lambda: notes)
    yield notes
    thread.join(60)
    assert not thread.is_alive()
    feed.close()


def heard_at(broker: Mosquitto, name: str, topic: str = DECISION) -> tuple[Any, list[Told]]:
    """Return a client and what it hears of a topic, once the broker has let it."""
    heard, let = list[Told](), list[object]()
    client = broker.client(name, heard)
    client.on_subscribe = lambda *told: let.append(told)
    client.subscribe(topic, qos=1)
    wait_until(lambda: let)
    return client, heard


@pytest.mark.parametrize("broker", [False, True], ids=["plain", "tls"], indirect=True)
def test_over_a_broker_that_stops_and_a_hostile_publisher(watch, mission, whole, broker, monkeypatch):
    secure, steps = f"mqtts://wing@localhost:{broker.port}/{TOPIC}", len(mission.observed)
    where = parse_broker(secure, broker.authority) if broker.tls else where_of(broker)
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")
    with pytest.raises(MissionInputError, match=r"refuses the twin.*[Nn]ot authorized"):
        watch.run(MqttFeed(where, watch, str), str)
    assert not [*watch.folder.glob("*.mqtt")]  # a client that never was in is not a client that was forgotten
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    with watching(where, watch, steps):
        listener, heard = heard_at(broker, "listener")
        publisher = broker.client("publisher")

        def send(first: int, last: int) -> None:
            for step in range(first, last):
                control = ("2g", "3g")[mission.control_index[step]]
                record = {"step": step, "control": control, "strain": mission.observed[step].tolist()}
                publisher.publish(TOPIC, json.dumps(record), qos=1).wait_for_publish(20)

        send(0, 20)
        for number in range(1000):
            publisher.publish(TOPIC, b"garbage %d" % number, qos=0)
        publisher.publish(TOPIC, b"x" * 3_000_000, qos=0)
        publisher.publish(TOPIC, json.dumps({"strain": [1e-4] * 24}), qos=1)  # of which step?
        send(15, 19)
        if not broker.tls:
            broker.again()
            wait_until(publisher.is_connected)
        send(20, steps)
    wait_until(lambda: heard and heard[-1]["step"] == steps - 1)
    publisher.disconnect()
    listener.disconnect()
    last, expected = (journal(folder)[-1] for folder in (watch.folder, whole))
    assert last["filtered"] == expected["filtered"]
    counts = last["intake"]["counts"]
    assert counts["late"] == 0
    assert counts["duplicates"] >= 4
    assert 1 <= counts["rejected"] < 1010  # a broker may lose or repeat some
    assert {decision["step"] for decision in heard} == set(range(steps))
    assert all(decision["probability"] >= 0.5 for decision in heard)


@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.long)])
def test_every_decision_of_a_backlog_is_published_however_often_the_watch_is_killed(watch, broker, kills):
    """Of each kill the broker tells that the watch was lost."""
    steps, chance, where = 60 * kills, random.Random(kills), where_of(broker)
    listener, heard = heard_at(broker, "listener")

    def run(steps: int, note: Any = str) -> None:
        feed = MqttFeed(where, watch, note)
        watch.run(feed, str, step_limit=steps)
        feed.close()

    run(1, lambda _note: publish(listener, *range(steps)))  # all but the first wait at the broker
    listener.disconnect()
    listener.loop_stop()  # no thread while processes are forked; the broker keeps what it is to hear
    met = 0

    def next_end() -> int:
        lines = chance.randrange(40) if met < kills else 2 * steps
        return (watch.folder / JOURNAL_NAME).stat().st_size + 2000 * lines

    while killed_at(watch, next_end(), lambda: run(steps)):
        met += 1
        asker, states = heard_at(broker, "asker", f"{TOPIC}/heartbeat")
        wait_until(lambda states=states: states and states[-1]["state"] == "lost")
        asker.disconnect()
        asker.loop_stop()
    assert met == kills
    listener = broker.client("listener", heard)
    wait_until(lambda: heard and heard[-1]["step"] == steps - 1)
    listener.disconnect()
    assert [line["step"] for line in journal(watch.folder)] == list(range(steps))
    assert {decision["step"] for decision in heard} == set(range(steps))
    assert len([decision for decision in heard if decision.get("told_again")]) >= kills
    assert len(heard) < steps + 100 * kills


def test_decisions_that_the_broker_has_not_acknowledged_are_published_again(watch, plain):
    ran(watch, CsvFeed(plain, watch.scenario), 3)
    published, sent = watch.folder / "published", list[Told]()
    published.write_text("0" * 20)

    def send(_topic: str, decision: Told, _by: Topic) -> int:
        sent.append(decision)
        return len(sent)

    topic = Topic(SimpleNamespace(publishers={}, can_send=True, send=send), TOPIC, watch.scenario, str)
    topic.attach(watch)
    topic.publish()
    topic.note_answer(1, None)
    first, *_ = records(watch.folder / JOURNAL_NAME)
    assert int(published.read_text()) == first[2]
    topic.resend_unacknowledged()  # as where the broker is lost
    topic.publish()
    assert [decision["step"] for decision in sent] == [0, 1, 2, 1, 2]


def test_an_orderly_end_and_a_watch_that_takes_the_place_of_another(
    scenario, base, watch, broker, tmp_path, monkeypatch
):
    publisher, notes = broker.client("publisher"), list[str]()

    def watched(watch: Watch, steps: int, *sent: int) -> Counts:
        def note(text: str) -> None:
            notes.append(text)
            publish(publisher, *sent)

        feed = MqttFeed(where_of(broker), watch, note)
        counts = watch.run(feed, str, step_limit=steps)
        feed.close()
        return counts

    assert watched(watch, 3, 0, 1, 2).received == 3
    assert watched(watch, 4, 3) == Counts(received=4)  # the third does not come again
    assert watched(watch, 5, 5).missing == 1  # the end is asked for within the gap before it: it comes again
    assert watched(watch, 7, 6) == Counts(received=6, missing=1)
    heard = list[Told]()
    publisher.on_message = lambda _client, _data, one: heard.append(json.loads(one.payload))
    publisher.subscribe([(DECISION, 1), (f"{TOPIC}/heartbeat", 1)])
    (watch.folder / "published").write_text("0" * 20)
    watched(watch, 7)  # nothing more is wanted, and what was not published is
    wait_until(lambda: len([one for one in heard if "control" in one]) >= 7)
    assert {one["step"] for one in heard if one.get("told_again")} == {*range(7)}
    wait_until(lambda: heard[-1].get("state") == "ended")
    assert [heard[-1][key] for key in ("step", "lag", "received", "refused")] == [6, 0, 6, 0]
    feed = MqttFeed(where_of(broker), watch, lambda _note: publish(publisher, 7))
    with pytest.raises(ZeroDivisionError), closing(feed):
        watch.run(feed, lambda decision: decision["step"] // 0)
    wait_until(lambda: heard[-1].get("state") == "lost")
    other = begun(base, tmp_path / "other")
    watched(other, 1, 0)
    files = [[*one.folder.glob("*.mqtt")] for one in (watch, other)]
    names = [path.read_text() for own in files for path in own]
    assert len({*names}) == len(names) == 2  # nobody who knows the folder can guess it
    publish(publisher, 599)  # to a watch that is no more
    publisher.publish(TOPIC, message(598), qos=1, retain=True).wait_for_publish(20)
    listener, states = heard_at(broker, "listener", f"{TOPIC}/heartbeat")
    wait_until(lambda: states)

    def begin() -> None:
        wait_until(lambda: states[-1]["state"] == "watching")
        publish(publisher, 0)

    beginning = threading.Thread(target=begin)
    beginning.start()
    words = ("watch", scenario.path, "--observations", address(broker), "--out", watch.folder, "--steps", 1)
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")  # the first attempt fails, and the wish is kept
    failed = command(*words, "--no-report", "--replace").stderr
    assert "refuses the twin" in failed
    assert "Nothing was observed yet: correct the cause" in failed
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    done = command(*words, "--no-report", "--resume")
    beginning.join()
    assert [json.loads(line)["step"] for line in done.stdout.splitlines()] == [0]
    assert "1 message." in done.stderr
    assert [path.read_text() for path in watch.folder.glob("*.mqtt")] == names[:1]
    assert all(note.startswith("Connected") for note in notes)
    listener.disconnect()
    publisher.disconnect()


def test_a_broker_that_refuses_what_it_allowed_before(watch, broker, tmp_path):
    """The twin itself when it comes back, and then what it decides."""
    publisher, heard = heard_at(broker, "publisher")
    with watching(where_of(broker), watch, 4) as notes:
        publish(publisher, 0)
        wait_until(lambda: heard)
        broker.let_in("another")
        broker.again()
        wait_until(lambda: any("refuses the twin" in note for note in notes))
        broker.let_in(PASSWORD)
        broker.again()
        wait_until(lambda: notes[-1].startswith("Connected") and publisher.is_connected())
        publish(publisher, 1)
        wait_until(lambda: heard[-1]["step"] == 1)
        (tmp_path / "rights").write_text(f"user wing\ntopic readwrite {TOPIC}\n")
        broker.further.append(f"acl_file {tmp_path / 'rights'}")
        broker.again()
        publisher.publish(TOPIC, message(2), qos=1)
        wait_until(lambda: "does not take" in notes[-1])
        broker.further.pop()
        broker.again()
        publisher.publish(TOPIC, message(3), qos=1)
    wait_until(lambda: heard[-1]["step"] == 3)
    publisher.disconnect()
    assert any(note.startswith("Waiting: the broker at 127.0.0.1") and "authorized" in note for note in notes)
    assert f"The broker does not take {DECISION}: Not authorized." in notes
    assert [decision["step"] for decision in heard] == [0, 1, 2, 3]


RIGHTS_PLUGIN = Path("/usr/lib/x86_64-linux-gnu/mosquitto_dynamic_security.so")


@pytest.mark.skipif(not RIGHTS_PLUGIN.is_file(), reason="no plugin of mosquitto for rights")
def test_a_subscription_that_is_refused(watch, broker, tmp_path):
    given = {"publishClientSend": True, "publishClientReceive": True, "subscribe": False}
    (tmp_path / "rights.json").write_text(json.dumps({"defaultACLAccess": given}))
    broker.further += ["allow_anonymous true", f"plugin {RIGHTS_PLUGIN}"]
    broker.further += [f"plugin_opt_config_file {tmp_path / 'rights.json'}"]
    broker.again()
    feed = MqttFeed(parse_broker(f"mqtt://127.0.0.1:{broker.port}/{TOPIC}"), watch, str)
    with pytest.raises(MissionInputError, match=r"does not let the twin read wing/7: Not authorized"):
        watch.run(feed, str)


@pytest.mark.parametrize(("wrong", "sentence"), Inputs(__file__).refused("addresses"))
def test_addresses_of_brokers(tmp_path, wrong, sentence):
    assert parse_broker("mqtt://host/a/b").port == 1883
    assert parse_broker("mqtts://me%40work@host:1/a").user == "me@work"
    (tmp_path / "authority.pem").write_text("no certificate")
    with refused(MissionInputError, sentence):
        parse_broker(wrong, tmp_path / "authority.pem" if sentence.startswith("authority") else None)
