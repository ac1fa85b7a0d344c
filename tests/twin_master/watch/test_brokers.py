"""A watch over a real broker."""

import json
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.command_line import command
from tests.refusals import Inputs, refused
from tests.twin_master.runs import journal
from tests.twin_master.watch.conftest import (
    HANGS,
    PASSWORD,
    Mosquitto,
    before_begin,
    begun,
    killed_at,
    mosquitto,
    ran,
    wait_until,
)
from twin_master.errors import MissionInputError
from twin_master.feeds.broker_address import PASSWORD_VARIABLE, Broker, parse_broker
from twin_master.feeds.csv_feed import CsvFeed
from twin_master.feeds.intake import Counts
from twin_master.mission.journal import JOURNAL_NAME, records
from twin_master.watch.folder import Watch
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


def run_over(broker: Broker, watch: Watch, steps: int, note: Callable[[str], object] = str) -> None:
    """Run a watch over a broker up to a number of steps."""
    feed = MqttFeed(broker, watch, note)
    watch.run(feed, str, step_limit=steps)
    feed.close()


def message(step: int, **others: object) -> str:
    return json.dumps({"step": step, "control": "2g", "strain_1": 1e-3, **others})


def publish(client: Any, *steps: int) -> None:
    for step in steps:
        client.publish(TOPIC, message(step), qos=1).wait_for_publish(HANGS)


@contextmanager
def watching(where: Broker, watch: Watch, steps: int) -> Iterator[list[str]]:
    """Watch so many steps in a thread, from when the twin is connected on; yields what it notes.

    A watch that goes on may be at its end before it notes that it is connected: a broker that has
    kept the session sends the messages it has kept before it answers the subscription.
    """
    notes = list[str]()
    feed = MqttFeed(where, watch, notes.append)
    thread = threading.Thread(target=watch.run, args=(feed, str), kwargs={"step_limit": steps}, daemon=True)
    thread.start()
    wait_until(lambda: notes or not thread.is_alive())
    yield notes
    thread.join(HANGS)
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


class Hostilities:
    """A mission that is watched over a broker which stops once, with a publisher that sends garbage, too."""

    def __init__(self, mission: Any, watch: Watch, broker: Mosquitto) -> None:
        self.mission, self.watch, self.broker = mission, watch, broker
        self.steps = len(mission.observed)
        secure = f"mqtts://wing@localhost:{broker.port}/{TOPIC}"
        self.where = parse_broker(secure, broker.authority) if broker.tls else where_of(broker)

    def run(self) -> None:
        """Watch the whole mission, and wait for its last decision."""
        with watching(self.where, self.watch, self.steps):
            listener, self.heard = heard_at(self.broker, "listener")
            self.publisher = self.broker.client("publisher")
            self.send(0, 20)
            self.send_garbage()
            self.send(15, 19)
            if not self.broker.tls:
                self.broker.again()
                wait_until(self.publisher.is_connected)
            self.send(20, self.steps)
        wait_until(lambda: self.heard and self.heard[-1]["step"] == self.steps - 1)
        self.publisher.disconnect()
        listener.disconnect()

    def send(self, first: int, end: int) -> None:
        for step in range(first, end):
            control = ("2g", "3g")[self.mission.control_index[step]]
            record = {"step": step, "control": control, "strain": self.mission.observed[step].tolist()}
            self.publisher.publish(TOPIC, json.dumps(record), qos=1).wait_for_publish(HANGS)

    def send_garbage(self) -> None:
        for number in range(1000):
            self.publisher.publish(TOPIC, b"garbage %d" % number, qos=0)
        self.publisher.publish(TOPIC, b"x" * 3_000_000, qos=0)
        self.publisher.publish(TOPIC, json.dumps({"strain": [1e-4] * 24}), qos=1)  # of which step?


@pytest.mark.parametrize("broker", [False, True], ids=["plain", "tls"], indirect=True)
def test_over_a_broker_that_stops_and_a_hostile_publisher(watch, mission, whole, broker):
    hostilities = Hostilities(mission, watch, broker)
    hostilities.run()
    last, last_of_file = (journal(folder)[-1] for folder in (watch.folder, whole))
    assert last["filtered"] == last_of_file["filtered"]
    check_counts_of_garbage(last["intake"]["counts"])
    check_decisions(hostilities.heard, hostilities.steps)


def check_counts_of_garbage(counts: dict[str, int]) -> None:
    """Check that four steps came twice, and that garbage was refused; a broker may lose or repeat some."""
    assert counts["late"] == 0
    assert counts["duplicates"] >= 4
    assert 1 <= counts["rejected"] < 1010


def check_decisions(heard: list[Told], steps: int) -> None:
    """Check that the decision of each step was heard."""
    assert {decision["step"] for decision in heard} == set(range(steps))
    assert all(decision["probability"] >= 0.5 for decision in heard)


@pytest.mark.parametrize("broker", [False, True], ids=["plain", "tls"], indirect=True)
def test_a_twin_that_the_broker_does_not_know_is_refused(watch, mission, broker, monkeypatch):
    """A client that never was in is no client that was forgotten."""
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")
    where = Hostilities(mission, watch, broker).where
    with pytest.raises(MissionInputError, match=r"refuses the twin.*[Nn]ot authorized"):
        watch.run(MqttFeed(where, watch, str), str)
    assert not [*watch.folder.glob("*.mqtt")]


class KilledWatch:
    """A watch over a broker with a backlog of messages, which is killed at random moments of its journal.

    Of each kill the broker tells that the watch was lost.
    """

    def __init__(self, watch: Watch, broker: Mosquitto, kills: int) -> None:
        self.watch, self.broker, self.kills = watch, broker, kills
        self.steps = 60 * kills
        self.chance = random.Random(kills)
        self.killed = 0
        listener, self.heard = heard_at(broker, "listener")
        where, steps = where_of(broker), self.steps
        # All messages but the first wait at the broker.
        run_over(where, watch, 1, lambda _note: publish(listener, *range(steps)))
        listener.disconnect()
        listener.loop_stop()  # the broker keeps what it is to hear
        while killed_at(watch, self.next_end(), partial(run_over, where, before_begin(watch), steps)):
            self.killed += 1
            self.wait_for_loss()
        listener = broker.client("listener", self.heard)
        wait_until(lambda: self.heard and self.heard[-1]["step"] == self.steps - 1)
        listener.disconnect()

    def next_end(self) -> int:
        """Return the size of the journal at which the watch is killed, or more than it will have."""
        lines = self.chance.randrange(40) if self.killed < self.kills else 2 * self.steps
        return (self.watch.folder / JOURNAL_NAME).stat().st_size + 2000 * lines

    def wait_for_loss(self) -> None:
        asker, states = heard_at(self.broker, "asker", f"{TOPIC}/heartbeat")
        wait_until(lambda: states and states[-1]["state"] == "lost")
        asker.disconnect()
        asker.loop_stop()


@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.long)])
def test_every_decision_of_a_backlog_is_published_however_often_the_watch_is_killed(watch, broker, kills):
    killed = KilledWatch(watch, broker, kills)
    steps = list(range(killed.steps))
    assert killed.killed == kills
    # Other lines say that messages which the broker repeats are refused
    assert [line["step"] for line in journal(watch.folder) if "observed" in line] == steps
    check_published_decisions(killed.heard, steps, kills)


def check_published_decisions(heard: list[Told], steps: list[int], kills: int) -> None:
    """Check that each decision was heard, and those around each kill again."""
    told_again = [decision for decision in heard if decision.get("told_again")]
    assert {decision["step"] for decision in heard} == set(steps)
    assert len(told_again) >= kills
    assert len(heard) < len(steps) + 100 * kills


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


class Station:
    """A publisher that sends steps once a watch is connected."""

    def __init__(self, broker: Mosquitto) -> None:
        self.broker = broker
        self.publisher = broker.client("publisher")
        self.notes = list[str]()

    def watch(self, watch: Watch, limit: int, *steps: int) -> Counts:
        """Watch up to a number of steps, of which some are sent once the twin is connected."""

        def note(text: str) -> None:
            self.notes.append(text)
            publish(self.publisher, *steps)

        feed = MqttFeed(where_of(self.broker), watch, note)
        counts = watch.run(feed, str, step_limit=limit)
        feed.close()
        return counts

    def hear(self) -> list[Told]:
        """Return what is heard of decisions and heartbeats from now on."""
        heard = list[Told]()
        self.publisher.on_message = lambda _client, _data, told: heard.append(json.loads(told.payload))
        self.publisher.subscribe([(DECISION, 1), (f"{TOPIC}/heartbeat", 1)])
        return heard


@pytest.fixture
def station(broker: Mosquitto) -> Iterator[Station]:
    station = Station(broker)
    yield station
    station.publisher.disconnect()


def test_what_was_acknowledged_before_an_orderly_end_does_not_come_again(station, watch):
    counts_at_first_end = station.watch(watch, 3, 0, 1, 2)
    counts_at_second_end = station.watch(watch, 4, 3)
    assert counts_at_first_end.received == 3
    assert counts_at_second_end == Counts(received=4)
    assert all(note.startswith("Connected") for note in station.notes)


def test_the_step_behind_a_gap_comes_again_if_the_end_is_asked_for_within_the_gap(station, watch):
    station.watch(watch, 4, 0, 1, 2, 3)
    counts_within_gap = station.watch(watch, 5, 5)
    counts_behind_gap = station.watch(watch, 7, 6)
    assert counts_within_gap.missing == 1
    assert counts_behind_gap == Counts(received=6, missing=1)


def test_what_was_not_published_before_an_end_is_published_by_the_next_watch(station, watch):
    """Nothing more is wanted of it, and it ends."""
    station.watch(watch, 7, *range(7))
    heard = station.hear()
    (watch.folder / "published").write_text("0" * 20)
    station.watch(watch, 7)
    wait_until(lambda: len([told for told in heard if "control" in told]) >= 7)
    wait_until(lambda: heard[-1].get("state") == "ended")
    assert {told["step"] for told in heard if told.get("told_again")} == {*range(7)}
    assert [heard[-1][key] for key in ("step", "lag", "received", "refused")] == [6, 0, 7, 0]


def test_a_watch_that_fails_is_told_to_be_lost(station, watch, broker):
    station.watch(watch, 1, 0)
    heard = station.hear()
    feed = MqttFeed(where_of(broker), watch, lambda _note: publish(station.publisher, 1))
    with pytest.raises(ZeroDivisionError), closing(feed):
        watch.run(feed, lambda decision: decision["step"] // 0)
    wait_until(lambda: heard[-1].get("state") == "lost")
    assert heard[-1]["state"] == "lost"


def client_names(watch: Watch) -> list[str]:
    return [path.read_text() for path in watch.folder.glob("*.mqtt")]


def test_each_watch_has_a_client_name_that_nobody_can_guess(station, base, watch, tmp_path):
    """Nobody who knows the folder can."""
    other = begun(base, tmp_path / "other")
    station.watch(watch, 1, 0)
    station.watch(other, 1, 0)
    names = client_names(watch) + client_names(other)
    assert len({*names}) == len(names) == 2


class Replacement:
    """The command that replaces a watch: at first the broker refuses it, and then it is resumed.

    Messages to the former watch, and a message that the broker retains, are none of the new one.
    """

    def __init__(self, station: Station, scenario: Any, watch: Watch) -> None:
        station.watch(watch, 1, 0)
        self.name_before = client_names(watch)
        self.publisher = station.publisher
        publish(self.publisher, 599)
        retained = self.publisher.publish(TOPIC, message(598), qos=1, retain=True)
        retained.wait_for_publish(HANGS)
        listener, self.states = heard_at(station.broker, "listener", f"{TOPIC}/heartbeat")
        wait_until(lambda: self.states)
        beginning = threading.Thread(target=self.begin, daemon=True)
        beginning.start()
        where = ("--observations", address(station.broker), "--out", watch.folder)
        words = ("watch", scenario.path, *where, "--steps", 1, "--no-report")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv(PASSWORD_VARIABLE, "another")
            self.refusal = command(*words, "--replace").stderr
        self.resumed = command(*words, "--resume")
        beginning.join()
        self.name = client_names(watch)
        listener.disconnect()

    def begin(self) -> None:
        """Publish the first step once the new watch is there."""
        wait_until(lambda: self.states[-1]["state"] == "watching")
        publish(self.publisher, 0)


def test_a_watch_that_takes_the_place_of_another_takes_up_nothing_of_it(station, scenario, watch):
    """It keeps the name of its client. The first attempt fails, and the wish to replace is kept."""
    replacement = Replacement(station, scenario, watch)
    steps = [json.loads(line)["step"] for line in replacement.resumed.stdout.splitlines()]
    assert (steps, "1 message." in replacement.resumed.stderr) == ([0], True)
    assert replacement.name == replacement.name_before
    check_refusal_before_the_first_step(replacement.refusal)


def check_refusal_before_the_first_step(sentence: str) -> None:
    """Check that a refused watch says how to begin once its cause is mended."""
    assert "refuses the twin" in sentence
    assert "Nothing was observed yet: correct the cause" in sentence


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


def metric(step: int, **fields: float) -> dict[str, Any]:
    """A metric as Telegraf publishes it, a second after that of the step before."""
    tags = {"host": "logger", "control": "2g"}
    return {
        "fields": fields or {"strain_1": 1e-3},
        "name": "wing",
        "tags": tags,
        "timestamp": 1_714_557_600 + step,
    }


def timed(watch: Watch) -> Watch:
    watch.scenario = watch.scenario.with_changes("watch", seconds_per_step=1.0)
    return watch


def test_batches_and_lines_of_telegraf_over_a_broker(watch, broker):
    """Alone, as a batch, and as line protocol, which has no step and no field `time`."""
    with watching(where_of(broker), timed(watch), 6):
        client, heard = heard_at(broker, "listener")
        batch = {"metrics": [metric(1), metric(2), metric(3)]}
        lines = "\n".join(f"wing,control=2g strain_1=1e-3 {1_714_557_600 + step}000000000" for step in (4, 5))
        for payload in (json.dumps(metric(0)), json.dumps(batch), lines):
            client.publish(TOPIC, payload, qos=1).wait_for_publish(HANGS)
    wait_until(lambda: len(heard) >= 6)
    client.disconnect()
    assert [decision["step"] for decision in heard] == [0, 1, 2, 3, 4, 5]
    assert watch.intake.counts == Counts(received=6)


def test_a_batch_is_acknowledged_once_all_of_it_is_in_the_journal(watch, broker):
    """A watch that ends in the middle of a batch gets it again, and loses none of its steps."""
    with watching(where_of(broker), timed(watch), 2):
        client = broker.client("publisher")
        batch = {"metrics": [metric(step) for step in range(4)]}
        client.publish(TOPIC, json.dumps(batch), qos=1).wait_for_publish(HANGS)
    with watching(where_of(broker), watch, 4):
        pass
    client.disconnect()
    assert [line["step"] for line in journal(watch.folder) if "filtered" in line] == [0, 1, 2, 3]
    assert watch.intake.counts.missing == 0
