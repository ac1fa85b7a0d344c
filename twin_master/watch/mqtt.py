"""Messages from an MQTT broker, and decisions back to it (extra `uav-twin[mqtt]`, paho-mqtt).

Nothing listens here: the twin is a client. The broker is asked to send no larger message than is read, and no
more of them than can wait; further ones wait at the broker, or are dropped there.
"""

import json
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from secrets import token_hex
from typing import Any

from reporting.files import atomic_write_text, explained_write_errors
from twin_master.errors import MissionInputError, said
from twin_master.mission.journal import JOURNAL_NAME, last_step, records
from twin_master.scenario.schema import Scenario
from twin_master.watch.feeds import PASSWORD_VARIABLE, Broker, shown
from twin_master.watch.folder import Watch
from twin_master.watch.intake import Feed
from twin_master.watch.lines import Place
from twin_master.watch.message import LARGEST_MESSAGE, Fed, Message, MessageReader, Refused

CLIENT_SUFFIX, PUBLISHED_NAME = ".mqtt", "published"
"""Of the file with the name of the client, and of that which says how far decisions were published."""
BEGIN_ANEW = "begin anew"
"""Behind the name of the client, until what the broker kept for it is thrown away."""
_WAITING = 200
"""Messages that the broker may send before they are acknowledged."""
_DECISIONS_WAITING = 1000
"""Decisions that wait in memory for the broker to acknowledge them; further ones wait in the journal."""
_SESSION_SECONDS = 7 * 86_400
"""How long the broker keeps what comes while the watch is away."""
_RETRY_SECONDS = (1.0, 30.0)
HEARTBEAT_SECONDS = 10.0
HELD = 200
"""Messages of an asset that is lost, the last ones, that wait for it here."""
_GOODBYE_SECONDS = 5.0
"""How long the end waits for the broker to take the last decisions."""


class Session:
    """What comes from a topic, and what goes out; the broker keeps it while the watch is away.

    Parameters
    ----------
    broker : Broker
    name : str
        Of the mission or group.
    folder : Path
        Keeps the name of this client, which nobody else can guess.
    note : callable
        Told when the broker is lost and found, and what it refuses.
    pulse : callable
        What the heartbeat says.

    Attributes
    ----------
    came : deque
        Messages that have come and are not worked off yet.
    behind : dict
        Topics with decisions to publish, as keys.
    """

    def __init__(
        self, broker: Broker, name: str, folder: Path, note: Callable[[str], None],
        pulse: Callable[[], dict[str, Any]],
    ) -> None:  # fmt: skip
        self._broker, self.note, self._pulse = broker, note, pulse
        self._path = folder / f"{name}{CLIENT_SUFFIX}"
        known = self._path.read_text(encoding="utf-8").splitlines() if self._path.is_file() else []
        self._name = (known or [""])[0] or f"uav-twin-{name}-{token_hex(8)}"
        self._clean, self._kept = known[1:] == [BEGIN_ANEW], len(known) == 1
        self._where = f"broker at {broker.host}:{broker.port}"
        self._heartbeat = broker.topic.replace("+", "fleet") + "/heartbeat"
        self._client: Any = None
        self.came: deque[Any] = deque()
        self._last: Any = None
        self._flying: dict[int, Topic] = {}
        self.behind: dict[Topic, None] = {}
        self._begun = False
        self._failure = self._told = ""
        self._retry, self._pause, self._beat = 0.0, _RETRY_SECONDS[0], 0.0

    @property
    def room(self) -> bool:
        """Whether a decision can be sent at once."""
        return self._connected and len(self._flying) < _DECISIONS_WAITING

    @property
    def _connected(self) -> bool:
        return self._client is not None and self._client.is_connected()

    def _connect(self) -> None:
        """Connect with nothing of the connection before: it is in the topices, and at the broker."""
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        client = paho.Client(
            CallbackAPIVersion.VERSION2, client_id=self._name, protocol=paho.MQTTv5, manual_ack=True
        )
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = _SESSION_SECONDS
        properties.ReceiveMaximum = _WAITING
        properties.MaximumPacketSize = LARGEST_MESSAGE + 10_000
        broker = self._broker
        if broker.user is not None:
            client.username_pw_set(broker.user, os.environ.get(PASSWORD_VARIABLE))
        if broker.tls:
            client.tls_set(ca_certs=None if broker.authority is None else str(broker.authority))
        client.will_set(self._heartbeat, json.dumps({"state": "lost"}), qos=1, retain=True)
        client.on_message = lambda _client, _data, message: self.came.append(message)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_subscribe, client.on_publish = self._on_subscribe, self._on_publish
        client.connect(broker.host, broker.port, 30, clean_start=self._clean, properties=properties)
        self._client = client

    def _on_connect(self, client: Any, _data: Any, flags: Any, reason: Any, _properties: Any) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        if reason.is_failure:
            self._failure = said("watch.user", where=self._where, why=reason, variable=PASSWORD_VARIABLE)
            return
        if self._clean:
            return
        if self._kept and not flags.session_present:
            self.note(f"The {self._where} has forgotten this watch: what came meanwhile is lost.")
        # What is retained was published before the watch, nobody knows when.
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_DO_NOT_SEND)
        client.subscribe(self._broker.topic, options=options)

    def _on_subscribe(self, _client: Any, _data: Any, _mid: Any, reasons: Any, _properties: Any) -> None:
        if reasons[0].is_failure:
            told = {"topic": self._broker.topic, "why": reasons[0]}
            self._failure = said("watch.topic", where=self._where, **told)
            return
        atomic_write_text(self._path, self._name + "\n")  # which also ends the wish to begin anew
        self._begun = self._kept = True
        self._told, self._pause, self._beat = "", _RETRY_SECONDS[0], 0.0
        for topic in self.behind:
            topic.not_before = 0.0
        self.note(f"Connected to {self._broker.host}:{self._broker.port}.")

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._failure = self._failure or f"the {self._where} is away ({reason})"

    def _on_publish(self, _client: Any, _data: Any, mid: int, reason: Any, _properties: Any) -> None:
        if (topic := self._flying.pop(mid, None)) is not None:
            topic.answered(mid, str(reason) if reason.is_failure else None)

    def _lost(self, failure: str) -> None:
        """Let go of a connection, to try again later; the first time it ends the watch."""
        failure, self._failure, self._client = self._failure or failure, "", None
        if not self._begun:
            raise MissionInputError(f"{failure}.")
        if failure != self._told:
            self.note(f"Waiting: {failure}.")
        self._told = failure
        self._retry = time.monotonic() + self._pause
        self._pause = min(2.0 * self._pause, _RETRY_SECONDS[1])
        self.came.clear()  # not acknowledged, so the broker sends them again
        self._last = None
        for topic in {*self._flying.values()}:
            topic.go_back()
        self._flying.clear()

    def _exchange(self, wait: float) -> None:
        """Exchange packets, at most so many seconds where nothing comes; or try to reach the broker again."""
        if self._client is None:
            pause = self._retry - time.monotonic()
            if pause > 0.0:
                time.sleep(min(pause, wait))
                return
            try:
                self._connect()
            except OSError as error:
                self._lost(f"no broker answers at {self._broker.host}:{self._broker.port} ({error})")
                return
        count, failed = len(self.came), self._client.loop(wait)
        while not failed and len(self.came) > count:  # all that is here already
            count, failed = len(self.came), self._client.loop(0.0)
        if failed or self._failure or self._client.socket() is None:
            self._lost(f"the {self._where} is away ({failed.name})")
            return
        if self._clean and self._connected:
            # The old session has ended. One that begins so is forgotten by brokers that start again.
            self._client.disconnect()
            self._client, self._clean, self._failure = None, False, ""
            return
        for topic in [*self.behind]:
            topic.publish()
        if self._connected and time.monotonic() >= self._beat:
            self._beat = time.monotonic() + HEARTBEAT_SECONDS
            self._client.publish(self._heartbeat, json.dumps(self._pulse()), retain=True)

    def messages(self, wait: float) -> Iterator[Any | None]:
        """Return what comes, without end, as paho-mqtt has it; None when nothing came for so many seconds.

        A message is acknowledged when the next one is asked for, or before by `acknowledge`.
        """
        while True:
            while self.came:
                self._last = self.came.popleft()
                yield self._last
                self.acknowledge()
            end = time.monotonic() + wait
            self._exchange(wait)
            while not self.came and time.monotonic() < end:
                self._exchange(wait)
            if not self.came:
                yield None

    def acknowledge(self) -> None:
        """Let the broker forget the last message: what it said is written down."""
        if self._last is not None and self._client is not None:
            self._client.ack(self._last.mid, self._last.qos)
        self._last = None

    def send(self, topic: str, decision: Mapping[str, Any], by: "Topic") -> int:
        """Send a decision; return the number by which the topic is told of the answer."""
        mid: int = self._client.publish(f"{topic}/decision", json.dumps(decision), qos=1).mid
        self._flying[mid] = by
        return mid

    def close(self) -> None:
        """Say goodbye once the broker has the last decisions; it keeps the session."""
        crashed, end = sys.exc_info()[0] is not None, time.monotonic() + _GOODBYE_SECONDS
        while (self.behind or self._flying) and time.monotonic() < end:
            if self._client is None and (self._begun or crashed):
                break
            self._exchange(0.1)
        if self.behind or self._flying:
            self.note("The broker has not taken all decisions: the rest is published when the watch goes on.")
        if self._client is not None and (connection := self._client.socket()) is not None:
            said = json.dumps(self._pulse() | {"state": "lost" if crashed else "ended"})
            self._client.publish(self._heartbeat, said, retain=True)
            # The client closes its socket at once. Where something came meanwhile that nobody read, the
            # system resets the connection, and a broker may hear that before the goodbye.
            with suppress(OSError), socket.socket(fileno=os.dup(connection.fileno())) as line:
                line.settimeout(_GOODBYE_SECONDS)
                self._client.disconnect()
                while line.recv(65536):
                    pass


class Topic(Feed):
    """The observations of an asset that a session hands on, and its decisions, on their way to the broker.

    How far the broker has the decisions is on the disk, `published`: in bytes of the journal. After a kill
    they are published again from there; each one at least once.

    Parameters
    ----------
    session : Session
    topic : str
        Of the observations.
    scenario : Scenario
        By which they are read.
    failed : callable
        Told what keeps the decisions from being published; they are then left until the watch is begun again.

    Attributes
    ----------
    came : deque of bytes
        Messages that the session has handed on.
    watch : Watch or None
        Of the asset; None before it is begun.
    """

    def __init__(
        self, session: Session, topic: str, scenario: Scenario, failed: Callable[[Exception], None]
    ) -> None:
        super().__init__()
        self._session, self._topic, self._failed = session, topic, failed
        self._reader = MessageReader(scenario)
        self.came: deque[bytes] = deque(maxlen=HELD)
        self.watch: Watch | None = None
        self._waiting: dict[int, int] = {}
        self.not_before, self._before = 0.0, 0

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return what has come, without end."""
        while True:
            yield self._read_message(self.came.popleft() if self.came else None)

    def _read_message(self, payload: bytes | None) -> Fed:
        """Return the observation in a message, which must name its step or time."""
        if payload is None:
            return None, ""
        message = self._reader.message(payload)
        if isinstance(message, Message) and message.step is None and message.time is None:
            message = Refused("a broker may deliver it twice: `step` or `time` is needed over MQTT")
        return message, shown(payload)

    def begun(self, watch: Watch) -> None:
        """Publish what the journal of a watch has, which is begun or taken up again."""
        self.watch = watch
        self._path, self._journal = watch.folder / PUBLISHED_NAME, watch.folder / JOURNAL_NAME
        _, size = last_step(self._journal)  # decisions before may have been published
        if not self._path.is_file():
            atomic_write_text(self._path, f"{size:020d}\n")
        text = self._path.read_text(encoding="utf-8", errors="replace").strip()
        self._done, self._at = min(int(text) if text.isdecimal() else 0, size), size
        self.go_back()
        if self._done == size:
            self._session.behind.pop(self)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let what goes wrong end nothing but this."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - whatever it is
            self._waiting.clear()
            self._session.behind.pop(self, None)
            self._failed(error)

    def decide(self, decision: Mapping[str, Any]) -> None:
        """Publish what was written down."""
        if self.watch is not None and self.watch.intake.settled:
            self._session.acknowledge()
        self._session.behind[self] = None
        self.publish()

    def publish(self) -> None:
        """Publish what is in the journal, as far as the broker takes it."""
        if time.monotonic() < self.not_before or self.watch is None:
            return
        with self._alone():
            for line, _, end in records(self._journal, self._at):
                if not self._session.room:
                    return
                decision = self.watch.decision_of(line)
                if decision:
                    decision |= {"told_again": True} if end <= self._before else {}
                    self._waiting[self._session.send(self._topic, decision, self)] = self._at
                self._at = end
            self._session.behind.pop(self, None)

    def answered(self, mid: int, refusal: str | None) -> None:
        """Take in that the broker has a decision, or refuses it."""
        if refusal is not None and mid in self._waiting:
            if not self.not_before:
                self._session.note(f"The broker does not take {self._topic}/decision: {refusal}.")
            self.not_before = time.monotonic() + _RETRY_SECONDS[1]
            self.go_back()
        if self._waiting.pop(mid, None) is not None:
            with self._alone(), explained_write_errors(self._path), self._path.open("r+b") as file:
                self._done = next(iter(self._waiting.values()), self._at)
                file.write(b"%020d\n" % self._done)  # in place: whole, or as it was

    def go_back(self) -> None:
        """Publish again what the broker has not acknowledged."""
        self._before = max(self._before, self._at)
        self._at = self._done
        self._waiting.clear()
        self._session.behind[self] = None


class MqttFeed(Topic):
    """The topic of one asset with a session of its own; see `Session` for the errors.

    Parameters
    ----------
    broker : Broker
    watch : Watch
        Of the asset; one that was begun before goes on where the broker left off.
    note : callable
        Told when the broker is lost and found.
    scenario : Scenario, optional
        By which messages are read; that of the watch if left out.
    """

    def __init__(
        self, broker: Broker, watch: Watch, note: Callable[[str], None], scenario: Scenario | None = None
    ) -> None:
        session = Session(broker, watch.scenario.mission.name, watch.folder, note, self._pulse)
        super().__init__(session, broker.topic, scenario or watch.scenario, _raised)
        self.begun(watch)

    def _pulse(self) -> dict[str, Any]:
        assert self.watch is not None
        watch, counts = self.watch, self.watch.intake.counts
        return {
            "state": "quiet" if watch.is_quiet else "watching", "step": watch.twin.steps - 1,
            "seconds_since_step": round(watch.silence, 1), "lag": len(self._session.came),
            "received": counts.received, "refused": counts.rejected,
        }  # fmt: skip

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return what comes, without end; a message is acknowledged when it is written down."""
        for message in self._session.messages(0.1):
            yield self._read_message(None if message is None else message.payload)

    def close(self) -> None:
        """Say goodbye, see `Session.close`."""
        self._session.close()


def _raised(error: Exception) -> None:
    raise error
