"""A watch over a real broker."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from tests.twin_master.watch.watches import PASSWORD, Mosquitto, begun
from twin_master.errors import MissionInputError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.mission.loop import Flight
from twin_master.watch.folder import Watch
from twin_master.watch.mqtt import PASSWORD_VARIABLE, MqttFeed, broker_of

pytestmark = pytest.mark.xdist_group("watches")  # one worker makes the wing and its watches


@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="no mosquitto")
@pytest.mark.parametrize("tls", [False, True])
def test_over_a_broker_that_stops_and_a_hostile_publisher(
    base: Watch, mission: Flight, whole: Path, tmp_path: Path, tls: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    broker = Mosquitto(tmp_path, tls=tls)
    scheme, host = ("mqtts", "localhost") if tls else ("mqtt", "127.0.0.1")
    where = broker_of(f"{scheme}://wing@{host}:{broker.port}/wing/7", broker.authority if tls else None)
    watch = begun(base, tmp_path / "watch")
    monkeypatch.setenv(PASSWORD_VARIABLE, "another")
    with pytest.raises(MissionInputError, match=r"refuses the twin.*[Nn]ot authorized"):
        watch.run(MqttFeed(where, watch.scenario, watch.folder, str), lambda _decision: None)
    monkeypatch.setenv(PASSWORD_VARIABLE, PASSWORD)
    notes: list[str] = []
    feed = MqttFeed(where, watch.scenario, watch.folder, notes.append)
    turns = len(mission.observed)
    watching = threading.Thread(target=watch.run, args=(feed, feed.decide), kwargs={"turns": turns})
    watching.start()
    limit = time.monotonic() + 60.0
    heard: list[dict[str, Any]] = []
    listener = broker.client("listener")
    listener.on_message = lambda _client, _data, message: heard.append(json.loads(message.payload))
    listener.subscribe("wing/7/decision", qos=1)
    while not any("Connected" in note for note in notes) and time.monotonic() < limit:
        time.sleep(0.02)
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
        while not publisher.is_connected() and time.monotonic() < limit:
            time.sleep(0.02)
    publish(20, turns)
    watching.join(60)
    assert not watching.is_alive()
    feed.close()
    while (not heard or heard[-1]["turn"] < turns - 1) and time.monotonic() < limit:
        time.sleep(0.02)
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


def test_addresses_of_brokers(base: Watch, tmp_path: Path) -> None:
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
        MqttFeed(broker_of("mqtts://host/a", tmp_path / "authority.pem"), base.scenario, tmp_path, print)
