"""Messages from an MQTT broker, and decisions back to it (extra `uav-twin[mqtt]`, paho-mqtt).

Nothing listens here: the twin is a client. The broker is asked to send no larger message than is read, and no
more of them than can wait; further ones wait at the broker, or are dropped there.
"""

import json
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from twin_master.errors import MissionInputError
from twin_master.scenario.schema import Scenario
from twin_master.watch.feeds import Fed, parsed, shown
from twin_master.watch.growing import Place
from twin_master.watch.intake import LiveFeed
from twin_master.watch.message import LARGEST_MESSAGE, Message, MessageReader, Refused

PASSWORD_VARIABLE = "UAV_TWIN_MQTT_PASSWORD"
_WAITING = 200
"""Messages that the broker may send before they are acknowledged."""
_DECISIONS_WAITING = 1000
"""Decisions that are kept while the broker is away; further ones are in the journal only."""
_SESSION_SECONDS = 7 * 86_400
"""How long the broker keeps what comes while the watch is away."""
_RETRY_SECONDS = (1.0, 30.0)
_GOODBYE_SECONDS = 5.0
"""How long the end waits for the broker to take the last decisions."""


@dataclass(frozen=True)
class Broker:
    """Where observations come from.

    Attributes
    ----------
    host, port, topic : str, int, str
        Of the broker, and of the observations; decisions go to `TOPIC/decision`.
    user : str or None
        Who the twin is; the password is in the environment, `UAV_TWIN_MQTT_PASSWORD`.
    tls : bool
        `mqtts://`: encrypted, the broker known by its certificate.
    authority : Path or None
        Certificate of the authority, where the system does not know it.
    """

    host: str
    port: int
    topic: str
    user: str | None = None
    tls: bool = False
    authority: Path | None = None


def is_broker(observations: str) -> bool:
    """Return whether observations come from a broker, and not from a file."""
    return observations.startswith(("mqtt://", "mqtts://"))


def broker_of(address: str, authority: Path | None = None, *, many: bool = False) -> Broker:
    """Return the broker of `mqtt://[USER@]HOST[:PORT]/TOPIC`, or `mqtts://` with TLS.

    Of many assets the topic ends with `/+`, which stands for the name of each.

    Raises
    ------
    MissionInputError
        paho-mqtt is not installed, or it is no such address, has a password in it, or a topic of many assets.
    """
    if find_spec("paho") is None:
        raise MissionInputError("observations over MQTT need paho-mqtt: pip install 'uav-twin[mqtt]'.")
    try:
        parts = urlsplit(address)
        port, topic = parts.port, unquote(parts.path.lstrip("/"))
    except ValueError:
        parts, port, topic = urlsplit("mqtt:"), None, ""
    if not parts.hostname or not topic:
        raise MissionInputError(f"{address}: `mqtt://[USER@]HOST[:PORT]/TOPIC` is expected, or `mqtts://`.")
    if parts.password is not None:
        raise MissionInputError(
            f"every user of this machine sees a password in an address: put it into {PASSWORD_VARIABLE}."
        )
    if many and (not topic.endswith("/+") or "+" in topic[:-1] or "#" in address):
        raise MissionInputError(f"{address}: a topic of many assets is expected, such as wings/+.")
    if not many and ("#" in address or "+" in topic):
        raise MissionInputError(f"{address}: a topic of one asset is expected, without `#` and `+`.")
    tls, user = parts.scheme == "mqtts", None if parts.username is None else unquote(parts.username)
    if authority is not None and not (tls and authority.is_file()):
        raise MissionInputError(f"the certificate {authority} is a file, and belongs to mqtts://.")
    return Broker(parts.hostname, port or (8883 if tls else 1883), topic, user, tls, authority)


class Session:
    """What comes from a topic; the broker keeps it while the watch is away.

    Parameters
    ----------
    broker : Broker
    name : str
        Of the mission.
    folder : Path
        Of the watch: with the name of the mission it makes the session its own.
    note : callable
        Told when the broker is lost and found.

    Raises
    ------
    MissionInputError
        The authority's file holds no certificate.
    """

    def __init__(self, broker: Broker, name: str, folder: Path, note: Callable[[str], None]) -> None:
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        self._broker = broker
        self._note = note
        self._came: deque[Any] = deque()
        self._untold: set[int] = set()
        self._refusal: str | None = None
        own = f"uav-twin-{name}-{sha256(str(folder.resolve()).encode()).hexdigest()[:12]}"
        self._client = paho.Client(
            CallbackAPIVersion.VERSION2, client_id=own, protocol=paho.MQTTv5, manual_ack=True
        )
        self._properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        self._properties.SessionExpiryInterval = _SESSION_SECONDS
        self._properties.ReceiveMaximum = _WAITING
        self._properties.MaximumPacketSize = LARGEST_MESSAGE + 10_000
        if broker.user is not None:
            self._client.username_pw_set(broker.user, os.environ.get(PASSWORD_VARIABLE))
        if broker.tls:
            try:
                self._client.tls_set(ca_certs=None if broker.authority is None else str(broker.authority))
            except OSError as error:
                raise MissionInputError(f"{broker.authority} holds no certificate: {error}.") from None
        self._client.max_queued_messages_set(_DECISIONS_WAITING)
        self._client.on_message = self._on_message
        self._client.on_connect = self._on_connect
        self._client.on_subscribe = self._on_subscribe
        self._client.on_publish = self._on_publish

    def _on_message(self, _client: Any, _data: Any, message: Any) -> None:
        self._came.append(message)

    def _on_publish(self, _client: Any, _data: Any, number: int, _reason: Any, _properties: Any) -> None:
        self._untold.discard(number)

    def _on_connect(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._refusal = str(reason)
            return
        client.subscribe(self._broker.topic, qos=1)

    def _on_subscribe(self, _client: Any, _data: Any, _number: int, _reasons: Any, _properties: Any) -> None:
        self._note(f"Connected to {self._broker.host}:{self._broker.port}.")

    def _connect(self, *, first: bool) -> None:
        """Connect, and again until it works; the first time a broker that refuses the user ends the watch."""
        wait, longest = _RETRY_SECONDS
        told = False
        while True:
            try:
                self._client.connect(
                    self._broker.host, self._broker.port, keepalive=30, clean_start=False,
                    properties=self._properties,
                )  # fmt: skip
                return
            except OSError as error:
                if first:
                    raise MissionInputError(
                        f"no broker answers at {self._broker.host}:{self._broker.port}: {error}."
                    ) from None
                if not told:
                    self._note(f"The broker at {self._broker.host} is away ({error}); waiting for it.")
                told = True
                time.sleep(wait)
                wait = min(2.0 * wait, longest)

    def messages(self, wait: float) -> Iterator[Any | None]:
        """Return what comes, without end, as paho-mqtt has it; None when nothing came for so many seconds.

        A message is acknowledged when the next one is asked for.
        """
        self._connect(first=True)
        while True:
            while self._came:
                message = self._came.popleft()
                yield message
                self._client.ack(message.mid, message.qos)
            failed = self._client.loop(wait)
            if self._refusal is not None:
                raise MissionInputError(
                    f"the broker at {self._broker.host}:{self._broker.port} refuses the twin: "
                    f"{self._refusal}; give a user in the address and the password in {PASSWORD_VARIABLE}."
                )
            if failed:
                self._came.clear()  # not acknowledged, so the broker sends them again
                self._connect(first=False)
            elif not self._came:
                yield None

    def publish(self, topic: str, decision: Mapping[str, Any]) -> None:
        """Publish a decision about the asset of a topic."""
        told = self._client.publish(f"{topic}/decision", json.dumps(decision), qos=1)
        if len(self._untold) < _DECISIONS_WAITING:
            self._untold.add(told.mid)
        self._client.loop_write()

    def close(self) -> None:
        """Say goodbye once the broker has the last decisions; it keeps the session."""
        end = time.monotonic() + _GOODBYE_SECONDS
        while self._untold and time.monotonic() < end and not self._client.loop(0.1):
            pass
        self._client.disconnect()


class MqttFeed(LiveFeed):
    """The observations of the topic of one asset; see `Session` for the parameters, and for errors."""

    def __init__(self, broker: Broker, scenario: Scenario, folder: Path, note: Callable[[str], None]) -> None:
        self._topic = broker.topic
        self._reader = MessageReader(scenario)
        self._session = Session(broker, scenario.mission.name, folder, note)
        self.close = self._session.close

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return what comes, without end; a message is acknowledged when the next one is asked for."""
        for message in self._session.messages(0.1):
            if message is not None:
                yield placed(self._reader, message.payload)

    def decide(self, decision: Mapping[str, Any]) -> None:
        """Publish a decision."""
        self._session.publish(self._topic, decision)


def placed(reader: MessageReader, payload: bytes) -> Fed:
    """Return the observation in the payload of a message, which must name its turn or time."""
    message = parsed(reader, payload)
    if isinstance(message, Message) and message.turn is None and message.time is None:
        message = Refused("a broker may deliver it twice: `turn` or `time` is needed over MQTT")
    return message, shown(payload)
