"""A session at a real broker that sends faster than the twin reads, or that is found again."""

import json
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.twin_master.watch.conftest import HANGS, Mosquitto, mosquitto, wait_until
from twin_master.feeds.broker_address import parse_broker
from twin_master.feeds.mqtt_session import Session

TOPIC = "wings/+"


@pytest.fixture
def broker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Mosquitto]:
    """A broker, with TLS if the test asks for it."""
    with mosquitto(tmp_path, tls=getattr(request, "param", False)) as broker:
        yield broker


class Reader:
    """A session that reads the messages of many assets; it is connected already."""

    def __init__(self, broker: Mosquitto, folder: Path) -> None:
        host, scheme = ("localhost", "mqtts") if broker.tls else ("127.0.0.1", "mqtt")
        address = f"{scheme}://wing@{host}:{broker.port}/{TOPIC}"
        authority = broker.authority if broker.tls else None
        self.notes: list[str] = []
        self.session = Session(
            parse_broker(address, authority, has_many_assets=True),
            "north",
            folder,
            self.notes.append,
            lambda: {"state": "watching", "lag": len(self.session.unread)},
        )
        self.messages = self.session.receive(0.05)
        while not self.notes:
            next(self.messages)

    def read(self, count: int, pause: float = 0.0) -> list[int]:
        """Return the numbers in so many messages, with a pause after each [s]."""
        numbers: list[int] = []
        while len(numbers) < count:
            message = next(self.messages)
            if message is not None:
                numbers.append(json.loads(message.payload)["number"])
                time.sleep(pause)
        return numbers


def publish(broker: Mosquitto, count: int, text: str = "") -> Any:
    """Publish so many numbered messages, and wait until the broker has them."""
    client = broker.client("publisher")
    sent = [
        client.publish(f"wings/{number % 7}", json.dumps({"number": number, "text": text}), qos=1)
        for number in range(count)
    ]
    for message in sent:
        message.wait_for_publish(HANGS)
    return client


def test_heartbeats_come_while_messages_wait_and_say_that_the_twin_does_not_keep_up(
    broker, tmp_path, monkeypatch
):
    monkeypatch.setattr("twin_master.feeds.mqtt_session.HEARTBEAT_SECONDS", 0.3)
    monkeypatch.setattr("twin_master.feeds.mqtt_session.EXCHANGE_SECONDS", 0.1)
    heard: list[dict[str, Any]] = []
    broker.client("listener", heard).subscribe("wings/fleet/heartbeat")
    reader = Reader(broker, tmp_path)
    publish(broker, 150)
    reader.read(150, pause=0.01)
    slow = [beat for beat in heard if not beat.get("keeps_up", True)]
    assert slow
    assert max(beat["lag"] for beat in slow) > 0
    assert max(beat["busy"] for beat in slow) > 0.8


def test_the_operator_is_told_once_that_messages_come_too_fast_and_that_it_is_over(
    broker, tmp_path, monkeypatch
):
    monkeypatch.setattr("twin_master.feeds.mqtt_session.HEARTBEAT_SECONDS", 0.3)
    monkeypatch.setattr("twin_master.feeds.mqtt_session.EXCHANGE_SECONDS", 0.1)
    reader = Reader(broker, tmp_path)
    publish(broker, 150)
    reader.read(150, pause=0.01)
    wait_until(lambda: next(reader.messages) is None and len(reader.notes) == 3)
    assert "Messages come faster than they are processed" in reader.notes[1]
    assert reader.notes[2] == "All messages that waited are processed."


def test_a_heartbeat_that_follows_a_connection_at_once_does_not_tell_of_too_many_messages(
    broker, tmp_path, monkeypatch
):
    """When a broker comes back, messages wait, and heartbeats are sent without a pause."""
    monkeypatch.setattr("twin_master.feeds.mqtt_session.HEARTBEAT_SECONDS", 1000.0)
    monkeypatch.setattr("twin_master.feeds.mqtt_session.EXCHANGE_SECONDS", 0.0)
    heard: list[dict[str, Any]] = []
    broker.client("listener", heard).subscribe("wings/fleet/heartbeat")
    reader = Reader(broker, tmp_path)
    publish(broker, 150)
    for _ in range(3):
        reader.session._next_heartbeat = 0.0  # as after a connection
        reader.read(5, pause=0.01)
    wait_until(lambda: sum("keeps_up" in beat for beat in heard) >= 3)
    assert [note for note in reader.notes if "faster" in note] == []


def test_what_waits_in_memory_is_limited_whatever_a_broker_sends(broker, tmp_path, monkeypatch):
    """Mosquitto 2.0.11 sends all that it has, once a message is acknowledged, whatever was agreed."""
    monkeypatch.setattr("twin_master.feeds.mqtt_session._UNREAD_BYTES", 300_000)
    monkeypatch.setattr("twin_master.feeds.mqtt_session.EXCHANGE_SECONDS", 0.0)
    reader = Reader(broker, tmp_path)
    publish(broker, 3000, text="x" * 1000)
    most = 0
    numbers: list[int] = []
    while len(numbers) < 3000:
        numbers += reader.read(1)
        most = max(most, len(reader.session.unread))
    assert sorted(numbers) == list(range(3000))
    assert most < 600


@pytest.mark.parametrize("broker", [False, True], ids=["plain", "by TLS"], indirect=True)
def test_a_broker_is_found_again_by_a_process_with_many_open_files(broker, tmp_path):
    """Waiting by `select` fails from the 1,024th file on."""
    reader = Reader(broker, tmp_path)
    broker.stop()
    while len(reader.notes) < 2:  # that the broker is away
        next(reader.messages)
    with ExitStack() as files:
        for _ in range(1100):
            files.callback(os.close, os.open(os.devnull, os.O_RDONLY))
        broker.start()
        while len(reader.notes) < 3:  # that it is connected again
            next(reader.messages)
    # The publisher itself waits by `select`, so that it begins once the files are closed.
    publish(broker, 20)
    assert sorted(reader.read(20)) == list(range(20))
    connection = reader.session._client.socket()
    assert connection.fileno() > 1024
