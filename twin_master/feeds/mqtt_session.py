"""The session of the twin at an MQTT broker (extra `uav-twin[mqtt]`, paho-mqtt).

The twin is a client; it opens no port. The broker is asked to send no larger messages than are
read, and no more messages than can wait here. Further ones wait at the broker, or are dropped
there.
"""

import json
import os
import selectors
import socket
import ssl
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING, Protocol

from reporting.files import atomic_write_text
from reporting.json_file import JsonObject
from twin_master.errors import MissionInputError
from twin_master.feeds.broker_address import PASSWORD_VARIABLE, Broker
from twin_master.feeds.feed import Decision
from twin_master.feeds.message import LARGEST_MESSAGE

if TYPE_CHECKING:
    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage
    from paho.mqtt.enums import MQTTErrorCode
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

CLIENT_SUFFIX = ".mqtt"
"""The suffix of the file with the client name."""
DISCARD_SESSION = "begin anew"
"""The second line of this file while the former session at the broker is still to be discarded."""
FIRST_RETRY_SECONDS = 1.0
LONGEST_RETRY_SECONDS = 30.0
"""The pause between two attempts is doubled from the first to the longest one [s]."""
HEARTBEAT_SECONDS = 10.0
EXCHANGE_SECONDS = 0.5
"""Longest time between two exchanges with the broker while messages wait here [s].

Without them, heartbeats and decisions would wait until all messages are processed.
"""
_UNREAD_MESSAGES = 200
"""Largest number of messages that the broker sends before they are acknowledged."""
_UNREAD_BYTES = 50_000_000
"""Size from which on no more messages are read, if more than `_UNREAD_MESSAGES` wait [bytes]."""
_UNACKNOWLEDGED_DECISIONS = 1000
"""Largest number of decisions sent and not acknowledged; further ones wait in the journal."""
_SESSION_SECONDS = 7 * 86_400
"""How long the broker keeps messages while the watch is away [s]."""
_KEEPALIVE_SECONDS = 30
_GOODBYE_SECONDS = 5.0
"""Longest time that the end of a watch waits for the broker to take the last decisions [s]."""
_PROPERTIES_BYTES = 10_000
"""Room for the topic and the properties of a message in its packet [bytes]."""


class DecisionPublisher(Protocol):
    """Publishes the decisions of an asset through a session."""

    def publish(self) -> None:
        """Send as many decisions as the session accepts."""

    def note_answer(self, message_id: int, refusal: str | None) -> None:
        """Record the broker's answer to a decision.

        Parameters
        ----------
        message_id : int
            The number that `Session.send` has returned.
        refusal : str or None
            Why the broker refuses the decision; None if it has accepted it.
        """

    def resend_unacknowledged(self) -> None:
        """Mark decisions without an answer to be sent again."""

    def end_pause(self) -> None:
        """Send decisions again at once, even if the broker has just refused one."""


class Session:
    """A session at a broker, which keeps messages while the watch is away.

    Parameters
    ----------
    name : str
        The name of the mission or of the group of assets.
    folder : Path
        The folder of the file with the client name, which nobody else can guess.
    note : callable
        Called with a sentence when the connection is lost or made, and when messages come faster
        than they are processed. Publishers call it when the broker refuses a decision.
    heartbeat : callable
        Returns the state of the twin, which is published at regular intervals.

    Attributes
    ----------
    unread : deque of MQTTMessage
        Messages that `receive` has not returned yet.
    publishers : dict of DecisionPublisher to None
        Publishers with decisions to send, in order.
    """

    def __init__(
        self,
        broker: Broker,
        name: str,
        folder: Path,
        note: Callable[[str], None],
        heartbeat: Callable[[], JsonObject],
    ) -> None:
        self._broker = broker
        self.note = note
        self._heartbeat = heartbeat
        self._heartbeat_topic = broker.topic.replace("+", "fleet") + "/heartbeat"
        self._where = f"broker at {broker.host}:{broker.port}"

        # The client name, by which the broker knows the session
        self._path = folder / f"{name}{CLIENT_SUFFIX}"
        lines = []
        if self._path.is_file():
            lines = self._path.read_text(encoding="utf-8").splitlines()
        self._client_name = lines[0] if lines else ""
        if not self._client_name:
            self._client_name = f"uav-twin-{name}-{token_hex(8)}"
        self._discards_session = lines[1:] == [DISCARD_SESSION]
        self._has_session_at_broker = len(lines) == 1

        # The connection
        self._client: Client | None = None
        self._was_subscribed = False
        self._failure = ""  # why the connection is about to be dropped
        self._reported_failure = ""
        self._next_attempt = 0.0
        self._retry_seconds = FIRST_RETRY_SECONDS
        self._next_heartbeat = 0.0
        self._next_exchange = 0.0

        # The pace since the last heartbeat
        self._pace_begin = time.monotonic()
        self._processing_seconds = 0.0
        self._was_idle = True
        self._kept_up = True

        # Messages and decisions
        self.unread: deque[MQTTMessage] = deque()
        self._last_message: MQTTMessage | None = None
        self._publisher_of_message: dict[
            int, DecisionPublisher
        ] = {}  # those sent and not acknowledged
        self.publishers: dict[DecisionPublisher, None] = {}

    @property
    def can_send(self) -> bool:
        """Whether a decision can be sent at once."""
        is_full = len(self._publisher_of_message) >= _UNACKNOWLEDGED_DECISIONS
        return self._is_connected and not is_full

    @property
    def _is_connected(self) -> bool:
        """Whether the broker has accepted the connection, and it is not lost."""
        return self._client is not None and self._client.is_connected()

    def _connect(self) -> None:
        """Connect with a new client.

        Nothing of a former client is needed: publishers and broker know what was not acknowledged.
        """
        from paho.mqtt import client as paho
        from paho.mqtt.enums import CallbackAPIVersion
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=self._client_name,
            protocol=paho.MQTTv5,
            manual_ack=True,
        )
        # Limits of the session
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.SessionExpiryInterval = _SESSION_SECONDS
        properties.ReceiveMaximum = _UNREAD_MESSAGES
        properties.MaximumPacketSize = LARGEST_MESSAGE + _PROPERTIES_BYTES
        # User and encryption
        broker = self._broker
        if broker.user is not None:
            client.username_pw_set(broker.user, os.environ.get(PASSWORD_VARIABLE))
        if broker.tls:
            client.tls_set(ca_certs=None if broker.authority is None else str(broker.authority))
        # The heartbeat that the broker publishes if the connection breaks
        last_will = json.dumps({"state": "lost"})
        client.will_set(self._heartbeat_topic, last_will, qos=1, retain=True)
        client.on_message = lambda _client, _data, message: self.unread.append(message)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_publish = self._on_publish
        client.connect(
            broker.host,
            broker.port,
            _KEEPALIVE_SECONDS,
            clean_start=self._discards_session,
            properties=properties,
        )
        self._client = client

    def _on_connect(
        self,
        client: "Client",
        _data: object,
        flags: "ConnectFlags",
        reason: "ReasonCode",
        _properties: "Properties | None",
    ) -> None:
        """Subscribe to the observations once the broker has accepted the connection.

        If the broker refuses it, the connection is dropped later, with this cause. A connection
        that only discards the former session does not subscribe.
        """
        from paho.mqtt.subscribeoptions import SubscribeOptions

        if reason.is_failure:
            self._failure = (
                f"the {self._where} refuses the twin: {reason}; give a user in the address and the "
                f"password in {PASSWORD_VARIABLE}"
            )
            return
        if self._discards_session:
            return
        if self._has_session_at_broker and not flags.session_present:
            self.note(
                f"The {self._where} has forgotten this watch: messages that were sent meanwhile "
                "are lost."
            )
        # A retained message was published before the watch, at a time that nobody knows
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_DO_NOT_SEND)
        client.subscribe(self._broker.topic, options=options)

    def _on_subscribe(
        self,
        _client: "Client",
        _data: object,
        _message_id: int,
        reasons: "list[ReasonCode]",
        _properties: "Properties | None",
    ) -> None:
        """Record that observations will come from now on, and let all publishers send.

        If the broker refuses the subscription, the connection is dropped later, with this cause.
        """
        reason = reasons[0]
        if reason.is_failure:
            self._failure = (
                f"the {self._where} does not let the twin read {self._broker.topic}: {reason}; "
                "grant its user that right"
            )
            return
        # Without the second line, because the former session is discarded already
        atomic_write_text(self._path, self._client_name + "\n")
        self._was_subscribed = True
        self._has_session_at_broker = True
        self._reported_failure = ""
        self._retry_seconds = FIRST_RETRY_SECONDS
        self._next_heartbeat = 0.0
        for publisher in self.publishers:
            publisher.end_pause()
        self.note(f"Connected to {self._broker.host}:{self._broker.port}.")

    def _on_disconnect(
        self,
        _client: "Client",
        _data: object,
        _flags: "DisconnectFlags",
        reason: "ReasonCode",
        _properties: "Properties | None",
    ) -> None:
        """Record why the connection was lost, unless a cause is known already."""
        self._failure = self._failure or f"the {self._where} is away ({reason})"

    def _on_publish(
        self,
        _client: "Client",
        _data: object,
        message_id: int,
        reason: "ReasonCode",
        _properties: "Properties",
    ) -> None:
        """Pass the broker's answer to the publisher that sent the message."""
        publisher = self._publisher_of_message.pop(message_id, None)
        if publisher is not None:
            publisher.note_answer(message_id, str(reason) if reason.is_failure else None)

    def _drop_connection(self, failure: str) -> None:
        """Drop the connection, and schedule the next attempt.

        A failure before the first subscription ends the watch with an error. `failure` is the cause
        if no callback has recorded one. Messages that wait here are forgotten: they were not
        acknowledged, so that the broker sends them again.
        """
        failure = self._failure or failure
        self._failure = ""
        self._client = None
        if not self._was_subscribed:
            raise MissionInputError(f"{failure}.")
        if failure != self._reported_failure:
            self.note(f"Waiting: {failure}.")
        self._reported_failure = failure
        self._next_attempt = time.monotonic() + self._retry_seconds
        self._retry_seconds = min(2.0 * self._retry_seconds, LONGEST_RETRY_SECONDS)
        self.unread.clear()
        self._last_message = None
        for publisher in set(self._publisher_of_message.values()):
            publisher.resend_unacknowledged()
        self._publisher_of_message.clear()

    def _exchange(self, wait: float) -> None:
        """Exchange packets with the broker, waiting a limited time [s]; connect first if necessary.

        Afterwards waiting decisions are sent, and the heartbeat if it is due.
        """
        self._next_exchange = time.monotonic() + EXCHANGE_SECONDS
        client = self._client
        if client is None:
            client = self._try_to_connect(wait)
        if client is None:
            return
        error = self._read_and_write(client, wait)
        if error or self._failure or client.socket() is None:
            self._drop_connection(f"the {self._where} is away ({error.name})")
            return
        if self._discards_session and self._is_connected:
            # The former session has ended. The new one is begun by a further connection, because
            # brokers that restart forget a session that was begun by discarding another one.
            client.disconnect()
            self._client = None
            self._discards_session = False
            self._failure = ""
            return
        for publisher in list(self.publishers):
            publisher.publish()
        if self._is_connected and time.monotonic() >= self._next_heartbeat:
            self._next_heartbeat = time.monotonic() + HEARTBEAT_SECONDS
            heartbeat = self._heartbeat() | self._pace()
            client.publish(self._heartbeat_topic, json.dumps(heartbeat), retain=True)

    def _read_and_write(self, client: "Client", wait: float) -> "MQTTErrorCode":
        """Read all packets that have come, and write those that wait; return paho's error code.

        The loop of paho itself waits by `select`, which is limited to the first 1,024 files of a
        process; the watch of a fleet may follow thousands of files. Some brokers send more than
        they were asked for, so nothing is read while `_UNREAD_BYTES` wait here.
        """
        error = client.loop_misc()
        if not error and client.want_write():
            error = client.loop_write()
        while not error and self._has_room and _can_read(client, wait):
            error = client.loop_read()
            wait = 0.0
        if not error and client.want_write():
            error = client.loop_write()
        return error

    @property
    def _has_room(self) -> bool:
        """Whether further messages may be read into memory."""
        if len(self.unread) <= _UNREAD_MESSAGES:
            return True
        return sum(len(message.payload) for message in self.unread) < _UNREAD_BYTES

    def _pace(self) -> JsonObject:
        """Return how busy the watch is, and whether it keeps up with the messages.

        It keeps up if all messages were processed at some time since the last heartbeat: a broker
        sends only so many messages before the first is acknowledged, so the number that waits here
        does not show how many wait there. The operator is notified once. A heartbeat that is sent
        early, because the connection was just made, repeats the last result.
        """
        now = time.monotonic()
        elapsed = max(now - self._pace_begin, 1e-3)
        pace: JsonObject = {
            "busy": round(min(1.0, self._processing_seconds / elapsed), 2),
            "keeps_up": self._was_idle,
        }
        if elapsed < HEARTBEAT_SECONDS / 2.0:
            return pace | {"keeps_up": self._kept_up}
        if not self._was_idle and self._kept_up:
            self.note(
                f"Messages come faster than they are processed: for {elapsed:.0f} s some have "
                "always been waiting, and the broker drops what it cannot keep."
            )
        elif self._was_idle and not self._kept_up:
            self.note("All messages that waited are processed.")
        self._kept_up = self._was_idle
        self._pace_begin = now
        self._processing_seconds = 0.0
        self._was_idle = not self.unread
        return pace

    def _try_to_connect(self, wait: float) -> "Client | None":
        """Return a new client; None if it is too early for an attempt, or the attempt fails."""
        pause = self._next_attempt - time.monotonic()
        if pause > 0.0:
            time.sleep(min(pause, wait))
            return None
        try:
            self._connect()
        except OSError as error:
            address = f"{self._broker.host}:{self._broker.port}"
            self._drop_connection(f"no broker answers at {address} ({error})")
        return self._client

    def receive(self, wait: float) -> "Iterator[MQTTMessage | None]":
        """Yield the messages as they come, without end; None after a time without any.

        A message is acknowledged when the next one is asked for, or earlier by `acknowledge`.

        Parameters
        ----------
        wait : float
            This time [s].
        """
        while True:
            while self.unread:
                self._last_message = self.unread.popleft()
                begin = time.monotonic()
                yield self._last_message
                now = time.monotonic()
                self._processing_seconds += now - begin
                self.acknowledge()
                if now >= self._next_exchange:
                    self._exchange(0.0)
            end = time.monotonic() + wait
            self._exchange(wait)
            while not self.unread and time.monotonic() < end:
                self._exchange(wait)
            if not self.unread:
                self._was_idle = True
                yield None

    def acknowledge(self) -> None:
        """Acknowledge the last message, whose content is in the journal."""
        message = self._last_message
        if message is not None and self._client is not None:
            self._client.ack(message.mid, message.qos)
        self._last_message = None

    def send(self, topic: str, decision: Decision, publisher: DecisionPublisher) -> int:
        """Send a decision on the topic of an asset, without waiting for the broker's answer.

        Returns
        -------
        int
            The number of the message; the publisher receives it with the answer.
        """
        assert self._client is not None, "`can_send` says whether there is a connection"
        message = self._client.publish(f"{topic}/decision", json.dumps(decision), qos=1)
        self._publisher_of_message[message.mid] = publisher
        return message.mid

    def close(self) -> None:
        """Send the last decisions, and disconnect; the broker keeps the session.

        This waits at most `_GOODBYE_SECONDS` for the broker to accept the decisions.
        """
        has_crashed = sys.exc_info()[0] is not None
        end = time.monotonic() + _GOODBYE_SECONDS
        while self._has_decisions_to_send and time.monotonic() < end:
            if self._client is None and (self._was_subscribed or has_crashed):
                break
            self._exchange(0.1)
        if self._has_decisions_to_send:
            self.note(
                "The broker has not taken all decisions: the rest is published when the watch goes "
                "on."
            )
        if self._client is not None:
            self._say_goodbye(self._client, "lost" if has_crashed else "ended")

    @property
    def _has_decisions_to_send(self) -> bool:
        """Whether a decision is not sent yet, or sent and not acknowledged."""
        return bool(self.publishers) or bool(self._publisher_of_message)

    def _say_goodbye(self, client: "Client", state: str) -> None:
        """Publish the last heartbeat, with the state "ended" or "lost", and disconnect properly.

        The broker receives a message of disconnection, so that it does not take the connection for
        broken.
        """
        connection = client.socket()
        if connection is None:
            return
        last_heartbeat = json.dumps(self._heartbeat() | {"state": state})
        client.publish(self._heartbeat_topic, last_heartbeat, retain=True)
        # `disconnect` closes the socket at once. If data from the broker are still unread then, the
        # system resets the connection, and the broker may see the reset before the messages. So a
        # copy of the socket stays open, and is read until the broker closes the connection.
        with suppress(OSError), socket.socket(fileno=os.dup(connection.fileno())) as copy:
            copy.settimeout(_GOODBYE_SECONDS)
            client.disconnect()
            while copy.recv(65536):
                pass


def _can_read(client: "Client", wait: float) -> bool:
    """Return whether a packet has come, or comes within a time [s]."""
    connection = client.socket()
    if connection is None:
        return False
    if isinstance(connection, ssl.SSLSocket) and connection.pending():
        return True  # decrypted already, so that the system knows nothing of it
    with selectors.DefaultSelector() as selector:
        selector.register(connection, selectors.EVENT_READ)
        return bool(selector.select(wait))
