"""The observations of an asset from an MQTT broker, and its decisions for the broker."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from reporting.files import atomic_write_text, explained_write_errors
from reporting.json_file import JsonObject
from twin_master.feeds.broker_address import Broker
from twin_master.feeds.feed import Decision, Feed, beginning_of
from twin_master.feeds.lines import Position
from twin_master.feeds.message import FeedItem, Message, Refused
from twin_master.feeds.mqtt_session import LONGEST_RETRY_SECONDS, Session
from twin_master.feeds.payload import PayloadReader
from twin_master.mission.journal import JOURNAL_NAME, last_step, records
from twin_master.mission.recent_parts import RecentParts
from twin_master.scenario.schema import Scenario
from twin_master.watch.folder import Watch

PUBLISHED_NAME = "published"
"""The file of a watch with the size of that part of the journal whose decisions the broker has."""
MOST_WAITING = 200
"""Largest number of messages that wait here for an asset that is not watched: the last ones."""


class Topic(Feed):
    """The observations of one asset, which a session passes on, and its decisions.

    The file `published` has the size of the part of the journal whose decisions the broker has
    acknowledged. After a kill the later decisions are published again, so that each arrives at
    least once.

    Parameters
    ----------
    topic : str
        The topic of the observations.
    on_error : callable
        Called with an error that prevents publishing. Decisions then wait until the watch is
        resumed.

    Attributes
    ----------
    payloads : deque of bytes
        The messages that the session has passed on.
    watch : Watch or None
        The watch of the asset; None before it is attached.
    """

    def __init__(
        self,
        session: Session,
        topic: str,
        scenario: Scenario,
        on_error: Callable[[Exception], None],
    ) -> None:
        super().__init__()
        self._session = session
        self._topic = topic
        self._on_error = on_error
        self._payload_reader = PayloadReader(scenario)
        self._unread_items: deque[FeedItem] = deque()  # of the last payload
        self.payloads: deque[bytes] = deque(maxlen=MOST_WAITING)
        self.watch: Watch | None = None
        # Sizes of the journal [bytes]
        self._acknowledged_size = 0  # the broker has the decisions up to here
        self._sent_size = 0  # the decisions up to here are sent over this connection
        self._formerly_sent_size = 0  # they were sent over a former connection
        # Where the line of each decision begins that is sent and not acknowledged
        self._line_of_message: dict[int, int] = {}
        self._end_of_pause = 0.0  # on the monotonic clock [s]

    def messages(self, position: Position | None) -> Iterator[FeedItem]:
        """Yield the messages that the session has passed on, without end.

        While there is none, (None, "") is yielded. The position is not used: a broker cannot go
        back.
        """
        while True:
            yield from self._items_of(self.payloads.popleft() if self.payloads else None)

    def _items_of(self, payload: bytes | None) -> Iterator[FeedItem]:
        """Yield the messages of a payload, with the beginning of its text; None if none came.

        A message that names neither its step nor its time is refused: a broker may deliver it
        twice, and the second one would count as another step.
        """
        if payload is None:
            yield None, ""
            return
        for message in self._payload_reader.read(payload):
            if isinstance(message, Message) and message.step is None and message.time is None:
                message = Refused(
                    "a broker may deliver it twice: `step` or `time` is needed over MQTT"
                )
            self._unread_items.append((message, beginning_of(payload)))
        while self._unread_items:
            yield self._unread_items.popleft()

    def attach(self, watch: Watch) -> None:
        """Attach a watch, whose decisions are published from now on.

        Decisions in its journal that the broker has not acknowledged are published again.
        """
        self.watch = watch
        self._path = watch.folder / PUBLISHED_NAME
        self._journal = watch.folder / JOURNAL_NAME
        _, journal_size = last_step(self._journal)
        if not self._path.is_file():  # then the decisions so far count as published
            # 20 digits are enough for any size, so that `_overwrite_size` never changes the length.
            atomic_write_text(self._path, f"{journal_size:020d}\n")
        text = self._path.read_text(encoding="utf-8", errors="replace").strip()
        size = int(text) if text.isdecimal() else 0  # the file may be damaged
        self._acknowledged_size = min(size, journal_size)
        self._sent_size = journal_size
        self.resend_unacknowledged()
        if self._acknowledged_size == journal_size:
            self._session.publishers.pop(self)

    @contextmanager
    def _contained_errors(self) -> Iterator[None]:
        """Let an error stop the publishing of this asset's decisions; pass it to `on_error`."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - whatever it is
            self._line_of_message.clear()
            self._session.publishers.pop(self, None)
            self._on_error(error)

    def send_decision(self, decision: Decision) -> None:
        """Publish all unsent decisions in the journal, of which the given one is the last.

        The payload of the step is acknowledged, unless readings or messages in it still wait.
        """
        has_unread = bool(self._unread_items)
        if self.watch is not None and not self.watch.intake.has_queued_readings and not has_unread:
            self._session.acknowledge()
        self._session.publishers[self] = None
        self.publish()

    def publish(self) -> None:
        """Send the unsent decisions in the journal, up to the limit of the session.

        A decision that was already sent over a former connection is marked with `told_again`.
        Nothing is sent during the pause after a refusal.
        """
        if time.monotonic() < self._end_of_pause or self.watch is None:
            return
        with self._contained_errors():
            has_begun = self.watch.has_begun
            recent = self.watch.journal.recent if has_begun else RecentParts(self.watch.folder)
            for line, _, end in records(self._journal, self._sent_size, recent):
                if not self._session.can_send:
                    return
                decision = self.watch.decision_of(line)
                if decision:
                    if end <= self._formerly_sent_size:
                        decision["told_again"] = True
                    message_id = self._session.send(self._topic, decision, self)
                    self._line_of_message[message_id] = self._sent_size
                self._sent_size = end
            self._session.publishers.pop(self, None)

    def note_answer(self, message_id: int, refusal: str | None) -> None:
        """Record the broker's answer to a decision.

        If the broker has accepted it, the size of the acknowledged part of the journal is written
        to the disk. If it refuses it, all decisions without an answer are sent again after a pause;
        the operator is notified of the first refusal only.

        Parameters
        ----------
        message_id : int
            The number of the message with the decision.
        refusal : str or None
            Why the broker refuses the decision; None if it has accepted it.
        """
        if refusal is not None and message_id in self._line_of_message:
            is_first_refusal = self._end_of_pause == 0.0
            if is_first_refusal:
                self._session.note(f"The broker does not take {self._topic}/decision: {refusal}.")
            self._end_of_pause = time.monotonic() + LONGEST_RETRY_SECONDS
            self.resend_unacknowledged()
        if self._line_of_message.pop(message_id, None) is None:
            return
        with self._contained_errors():
            # The broker has all decisions before the first one that is still unanswered
            unanswered_lines = iter(self._line_of_message.values())
            self._acknowledged_size = next(unanswered_lines, self._sent_size)
            _overwrite_size(self._path, self._acknowledged_size)

    def resend_unacknowledged(self) -> None:
        """Mark the decisions without an answer as not sent, so that they are sent again."""
        self._formerly_sent_size = max(self._formerly_sent_size, self._sent_size)
        self._sent_size = self._acknowledged_size
        self._line_of_message.clear()
        self._session.publishers[self] = None

    def end_pause(self) -> None:
        """Send decisions again at once, even if the broker has just refused one."""
        self._end_of_pause = 0.0


def _overwrite_size(path: Path, size: int) -> None:
    """Overwrite the size in the file `published`; a kill leaves the old or the new one."""
    with explained_write_errors(path), path.open("r+b") as file:
        file.write(b"%020d\n" % size)


class MqttFeed(Topic):
    """The topic of one asset, with its own session at the broker; see `Session` for errors.

    Parameters
    ----------
    watch : Watch
        The watch of the asset; a resumed one continues with what the broker has kept.
    note : callable
        Called with a sentence when the connection is lost or made.
    scenario : Scenario, optional
        The scenario by which messages are read; that of the watch if left out.
    """

    def __init__(
        self,
        broker: Broker,
        watch: Watch,
        note: Callable[[str], None],
        scenario: Scenario | None = None,
    ) -> None:
        name = watch.scenario.mission.name
        session = Session(broker, name, watch.folder, note, self._heartbeat)
        super().__init__(session, broker.topic, scenario or watch.scenario, _raise_error)
        self.attach(watch)

    def _heartbeat(self) -> JsonObject:
        """Return the state of the watch, which is published at regular intervals."""
        watch = self.watch
        assert watch is not None
        counts = watch.intake.counts
        return {
            "state": "quiet" if watch.is_quiet else "watching",
            "step": watch.twin.steps - 1,
            "seconds_since_step": round(watch.seconds_since_step, 1),
            "lag": len(self._session.unread),
            "received": counts.received,
            "refused": counts.rejected,
        }

    @property
    def waiting_messages(self) -> int:
        """The number of messages that have come from the broker and are not read yet."""
        return len(self._session.unread)

    def messages(self, position: Position | None) -> Iterator[FeedItem]:
        """Yield the messages as they come, without end; (None, "") while nothing comes.

        A message is acknowledged once its step is in the journal. The position is not used.
        """
        for message in self._session.receive(0.1):
            yield from self._items_of(None if message is None else bytes(message.payload))

    def close(self) -> None:
        """Publish the last decisions and disconnect; see `Session.close`."""
        self._session.close()


def _raise_error(error: Exception) -> None:
    """Raise an error that prevents publishing, so that the watch ends."""
    raise error
