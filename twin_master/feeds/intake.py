"""From messages to readings: order of the steps, missing steps, and late messages."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from reporting.arrays import Float
from reporting.json_file import JsonObject, JsonRecord
from reporting.words import counted, one_line
from twin_master.errors import TwinMasterError
from twin_master.feeds.clock import Clock
from twin_master.feeds.feed import Feed, StepStatus
from twin_master.feeds.lines import Position
from twin_master.feeds.message import FeedItem, Message, Refused
from twin_master.feeds.rejected import RejectedFile
from twin_master.feeds.stream import REFUSALS_IN_A_ROW, StreamNotices
from twin_master.mission.journal import encode_state, step_record
from twin_master.mission.steps import MissionStep, Reading
from twin_master.network.estimator import Notice, NoticeWording
from twin_master.network.twin import Twin
from twin_master.scenario.schema import Scenario

POLL_SECONDS = 0.05
"""Seconds between two looks at a feed that may go on."""
SNAPSHOT_STEPS = 32
"""Number of steps between two lines with which the state of the twin is kept for the last steps."""
KEPT_SNAPSHOT_STEPS = 2_048
"""Number of steps between two lines of the journal that also have the state of the twin.

This is a multiple of `SNAPSHOT_STEPS`. The steps since such a line are filtered again, at 1 to 4 ms
each, to store or try again what is older than the last steps.
"""

_KINDS_OF_TIMES = ("begin", "pause", "clock", "rate")
"""The notices about the times of messages, which hold also if a message is refused later."""


@dataclass
class Counts:
    """How many messages and steps of a watch were received, missing, late or refused.

    Attributes
    ----------
    received : int
        Messages that were read.
    missing : int
        Steps that were predicted through without a message, minus those whose message came late.
    late : int
        Late messages that were assimilated in their step.
    duplicates : int
        Messages about an earlier step that added nothing to it.
    rejected : int
        Messages that were refused.
    """

    received: int = 0
    missing: int = 0
    late: int = 0
    duplicates: int = 0
    rejected: int = 0


@dataclass(frozen=True)
class _QueuedReading:
    """A reading that waits for its assimilation.

    Attributes
    ----------
    status : StepStatus
        Whether the step has a message, and one with its control.
    """

    step: int
    reading: Reading
    status: StepStatus


class _EndRequested(BaseException):
    """The end of the watch was requested while it waited for a message."""


class Intake:
    """Turns the messages of a feed into the readings of a twin.

    A message belongs to the step that it names, or to that of its time, or to the next one; both
    are counted from the first message. A message about a step that was received before must agree
    with it: readings that the step lacks are added, and a contradiction is refused. Received
    readings can never be changed.

    Parameters
    ----------
    scenario : Scenario
        The sensors, and how late and how far ahead a message may be.
    feed : Feed
        The source of the messages.
    rejected : Path or None
        The file `rejected.jsonl` for refused messages; None writes none.

    Attributes
    ----------
    counts : Counts
        The counts up to the last reading.
    observation_step : int
        The step of the last reading.
    notices : list of Notice
        The notices of the last reading: sensors that give no number any more, or again, and those
        of `StreamNotices`.
    stream : StreamNotices
        The notices about the stream of messages.
    stops_at_refusals : bool
        Whether `read` returns None once when the operator must learn that messages are refused.
    has_ended : bool
        Whether the feed has ended. If not, more may come after `read` has returned None.
    on_poll : callable or None
        Called repeatedly while no reading comes. If it is None, `read` does not wait for messages.
    step_limit : int or None
        The number of steps after which the watch ends.
    end_is_requested : bool
        Whether the end of the watch was requested.
    """

    def __init__(self, scenario: Scenario, feed: Feed, rejected: Path | None = None) -> None:
        self._section = scenario.watch
        self._words = NoticeWording.of(scenario)
        self._width = scenario.row_width
        section = scenario.watch
        self._clock = Clock(section, section.seconds_per_step, section.between or "rest")
        self._counter = Clock(section, section.every, section.between or "steps", counts_steps=True)

        # The feed, and the positions after the last message and after the one before it
        self._feed = feed
        self._messages: Iterator[FeedItem] | None = None
        self._position: Position | None = None
        self._previous_position: Position | None = None
        self._text = ""  # the beginning of the last message
        self._is_waiting = False  # for the next message

        # Readings to come, and the status of the steps that may still be revised
        self._queue: deque[_QueuedReading] = deque()
        self._statuses: deque[StepStatus] = deque(maxlen=scenario.watch.lag + 1)
        self._row_before_revision: Float = np.empty(0)

        # The messages to the operator
        self.notices: list[Notice] = []
        self.stream = StreamNotices(self._words)
        self.stops_at_refusals = False
        self._unreadable: set[int] = set()  # sensors, after the last reading
        self._previous_unreadable: set[int] = set()  # sensors, before the last reading
        self._previous_stream_state: JsonObject = {}

        # Counts: of the watch, and of the messages of this process, without those of earlier ones
        self.counts = Counts()
        self._rejected = RejectedFile(rejected)
        self._messages_received = 0
        self._messages_with_readings = 0

        # Progress and end
        self.observation_step = -1
        self.has_ended = False
        self.end_is_requested = False
        self.on_poll: Callable[[], None] | None = None
        self.step_limit: int | None = None

    @property
    def has_queued_readings(self) -> bool:
        """Whether the queue still contains readings of the last message or of a gap before it."""
        return bool(self._queue)

    @property
    def waiting_messages(self) -> int:
        """The number of messages that wait to be read, if the feed knows it."""
        return self._feed.waiting_messages

    def state(self) -> JsonObject:
        """Return the state for the journal, with which a resumed watch continues."""
        # After a gap the queue holds missing steps, then the message itself. A watch that is
        # resumed meanwhile reads this message again, so that it is not counted yet.
        is_read_again = self.has_queued_readings
        received_count = self.counts.received - 1 if is_read_again else self.counts.received
        state: JsonObject = {
            "counts": vars(self.counts) | {"received": received_count},
            "given": "".join(str(int(status)) for status in self._statuses),
            "clock": self._clock.state(),
            "counter": self._counter.state(),
            "source": self._previous_position if is_read_again else self._position,
        }
        if self._unreadable:
            state["unreadable"] = sorted(self._unreadable)
        stream_state = self.stream.state(waiting=is_read_again)
        if stream_state:
            state["stream"] = stream_state
        return state

    def journal_line(self, step: MissionStep, twin: Twin) -> JsonObject:
        """Return the line of the journal for the last reading and what the twin concluded from it.

        Every `SNAPSHOT_STEPS` steps the line also contains the state of the twin, from which a
        resumed watch goes on. Notices that the twin itself gives are not added a second time.
        """
        twin_step = step.twin_step
        record = step_record(step) | {
            "observation_step": self.observation_step,
            "control_index": twin.control_of(self.observation_step),
            "intake": self.state(),
        }
        if step.reading.revises is not None:
            record["control_in_force"] = twin_step.control_index
        elif (twin_step.step + 1) % SNAPSHOT_STEPS == 0:
            settled = twin.settled()
            if settled:
                settled_step, settled_state = settled
                record["settled"] = {"step": settled_step, "state": encode_state(settled_state)}
        notices_of_twin = {(notice.kind, notice.sensors) for notice in twin_step.notices}
        new_notices = []
        for notice in self.notices:
            if (notice.kind, notice.sensors) not in notices_of_twin:
                new_notices.append(notice.as_record())
        if new_notices:
            record["notices"] = record.get("notices", []) + new_notices
        return record

    def restore(self, state: JsonRecord | None) -> None:
        """Restore the state of an earlier process of the watch.

        Where reading continues depends on the feed:

        - the file that was read before: at the recorded position;
        - another file: at its first message;
        - a feed that cannot be read twice, such as a pipe: at what comes next.

        Messages may have been written to `rejected.jsonl` after the state was recorded. If reading
        continues at the recorded position, they are read again; otherwise they are counted here.
        The state is None at the beginning of a watch.
        """
        feed_is_read_again = self._feed.replayable
        if state is not None:
            self.counts = Counts(**state["counts"])
            self._clock.restore(state.get("clock"))
            self._counter.restore(state.get("counter"))
            self._statuses.extend(StepStatus(int(digit)) for digit in state["given"])
            self._unreadable = set(state.get("unreadable", ()))
            self.stream.restore(state.get("stream", {}))
            position = state["source"]
            if position is None or not self._feed.contains_position(position):
                feed_is_read_again = False
            self._position = position if feed_is_read_again else None
        rejected_later = self._rejected.resume(
            self.counts.rejected, feed_is_read_again=feed_is_read_again
        )
        self.counts.rejected += rejected_later
        self.counts.received += rejected_later

    def request_end(self) -> None:
        """Request the end of the watch, which comes between two steps, never within one.

        If the watch is waiting for a message, an exception interrupts it, which `read` catches.
        """
        self.end_is_requested = True
        if self._is_waiting:
            raise _EndRequested

    def read(self, twin: Twin) -> Reading | None:
        """Return the next reading for the twin; wait for messages until there is one.

        None is returned if the feed has ended, if the end of the watch was requested, if the twin
        has all its steps, if the operator must be told of refusals (`stops_at_refusals`), or if
        there is no message and no `on_poll`.
        """
        with suppress(_EndRequested):
            while not self.end_is_requested:
                if self.step_limit is not None and twin.steps >= self.step_limit:
                    return None
                # Checked again each time, because `replace_impossible` refuses messages, too
                if self.stops_at_refusals and self.stream.has_refusals_to_report:
                    return None
                begin = time.monotonic()
                has_message = self.has_queued_readings or self._receive_message(twin)
                if self._queue:
                    return self._next_reading(twin)
                if self.has_ended or not (has_message or self.on_poll):
                    return None
                # Also after a message without a reading: no step may come for a long time
                if self.on_poll is not None:
                    self.on_poll()
                if not has_message:
                    time.sleep(max(0.0, begin + POLL_SECONDS - time.monotonic()))
        return None

    def _receive_message(self, twin: Twin) -> bool:
        """Queue the readings of the next message, or refuse it; return whether there was one."""
        if self._messages is None:
            self._messages = self._feed.messages(self._position)
        self._is_waiting = self.on_poll is not None
        try:
            item = next(self._messages, None)  # without a message if nothing has come yet
        finally:
            self._is_waiting = False
        self.has_ended = item is None
        message, self._text = item or (None, "")
        if message is None:
            return False
        self.counts.received += 1
        self._messages_received += 1
        self._previous_position = self._position
        self._position = self._feed.position
        if self._feed.has_every_message and (self.counts.received - 1) % self._section.every:
            return True
        step: int | None = None
        try:
            if isinstance(message, Refused):
                raise message
            step = self._step_of(twin, message)
            self._enqueue(twin, message, step)
        except Refused as refusal:
            if isinstance(message, Message):
                self._note_time(message, is_assimilated=False)
            self._refuse(str(refusal), step)
        return True

    def _next_reading(self, twin: Twin) -> Reading:
        """Take the first reading from the queue, record it, and return it.

        This updates the notices, the counts and the status of its step. The previous state is kept
        for the case that the twin finds the reading impossible.
        """
        queued = self._queue.popleft()
        reading = queued.reading
        self.observation_step = queued.step
        self._previous_unreadable = self._unreadable
        self._previous_stream_state = self.stream.state(waiting=False)
        self.notices = self._note_unreadable_sensors(reading)
        if isinstance(reading, Message):
            self._note_time(reading, is_assimilated=True)
        if queued.status is StepStatus.MISSING:
            self.notices += self.stream.pop_pending()
        else:
            # The reading may still be refused later, see `replace_impossible`.
            is_blind = bool(np.isnan(reading.observed).all())
            if not is_blind:
                self._messages_with_readings += 1
            ignored = reading.ignored if isinstance(reading, Message) else {}
            if reading.revises is not None:  # a late message does not show how the sensors are now
                is_blind = self.stream.is_blind
            self.notices += self.stream.accept(queued.step, is_blind=is_blind, ignored=ignored)

        if reading.revises is None:
            self._statuses.append(queued.status)
            if queued.status is StepStatus.MISSING:
                self.counts.missing += 1
            return reading
        index = queued.step - twin.steps  # -1 is the last step
        self.counts.late += 1
        if self._statuses[index] is StepStatus.MISSING:
            self.counts.missing -= 1
        # A status grows from MISSING over ASSUMED_CONTROL to WITH_CONTROL: nothing known is lost
        self._statuses[index] = max(queued.status, self._statuses[index])
        return reading

    def complaint(self) -> str:
        """Return a sentence that says why the messages of this process were of no use, or "".

        The first of these cases that holds decides:

        - If no message came, the sentence is empty.
        - If the last messages were refused, and these are `REFUSALS_IN_A_ROW` or more or no other
          message had a reading, it gives the last reason.
        - If no message had a reading of a sensor, it says so.
        - Otherwise it is empty.
        """
        if self._messages_received == 0:
            return ""
        received_phrase = counted(self._messages_received, "message")  # "5 messages"
        has_no_readings = self._messages_with_readings == 0
        refused_at_end = self.stream.refused_in_a_row
        are_too_many_refused = refused_at_end >= REFUSALS_IN_A_ROW
        if refused_at_end > 0 and (are_too_many_refused or has_no_readings):
            return (
                f"The watch ended while messages were refused: the last {refused_at_end} of "
                f"{received_phrase}, the last one because {self.stream.last_reason}."
            )
        if has_no_readings:
            return (
                f"None of {received_phrase} has a reading of any {self._words.sensor}: the "
                "belief follows the transitions alone."
            )
        return ""

    def _note_unreadable_sensors(self, reading: Reading) -> list[Notice]:
        """Return a notice for each sensor that becomes unreadable, or is readable again.

        A sensor counts as unreadable until a reading of it comes.
        """
        if reading.revises is not None:  # a late message does not show how the sensors are now
            return []
        notices = []
        words = self._words
        step = self.observation_step
        unreadable = reading.unreadable
        for sensor in sorted(unreadable.keys() - self._unreadable):
            sentence = (
                f"{words.name_step(step)}: {words.name_sensors([sensor])} shows no reading, and is "
                f"left out until readings of it come back: {unreadable[sensor]}."
            )
            notices.append(Notice("gauge_left_out", sentence, (sensor + 1,)))
        readable_again = set()
        for sensor in sorted(self._unreadable - unreadable.keys()):
            if not np.isnan(reading.observed[sensor]):
                readable_again.add(sensor)
                notices.append(words.notice_of_return(step, sensor))
        self._unreadable = (self._unreadable | unreadable.keys()) - readable_again
        return notices

    def replace_impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Refuse an observation that has probability zero in every state of the model.

        What was recorded when its message was accepted is undone.

        Parameters
        ----------
        error : TwinMasterError
            The error of the twin, which becomes the reason of the refusal.

        Returns
        -------
        Reading
            The reading that replaces it. For the next step it has no value (NaN), so that the
            belief is predicted through the step; for an earlier step it is the row that was
            received before.
        """
        # Undo what was noted when the message was accepted
        self.stream.restore(self._previous_stream_state)
        self._unreadable = self._previous_unreadable
        self._messages_with_readings -= 1
        self._refuse(str(error), self.observation_step)
        # Only the notices about the times of messages still hold
        self.notices = [notice for notice in self.notices if notice.kind in _KINDS_OF_TIMES]
        if reading.revises is not None:
            return Reading(self._row_before_revision, None, reading.revises)
        return Reading(np.full(self._width, np.nan), reading.control)

    def _refuse(self, reason: str, step: int | None) -> None:
        """Count the last message as refused, and write it to `rejected.jsonl` with the reason."""
        self.counts.rejected += 1
        self.stream.note_refusal(step, one_line(reason))
        self._rejected.append(self.counts.received, reason, self._text)

    def _step_of(self, twin: Twin, message: Message) -> int:
        """Return the step of a message.

        It is the step that the message names, or else the step at its time, or else the next step
        of the twin. A late message belongs to the nearest of several possible steps whose earlier
        message it does not contradict.
        """
        clock, time = self._time_of(message)
        if time is None:
            return twin.steps
        steps = clock.steps_at(time, twin.steps, self.stream)
        for step in steps:
            is_kept = twin.first_kept <= step < twin.steps
            if is_kept and not self._contradiction(twin, message, step):
                return step
        return steps[0]

    def _time_of(self, message: Message) -> tuple[Clock, float | None]:
        """Return the clock that locates a message, and its time by this clock."""
        if message.step is not None:
            return self._counter, message.step
        return self._clock, message.time

    def _note_time(self, message: Message, *, is_assimilated: bool) -> None:
        """Record the time of a message; see `Clock.note_time`."""
        clock, time = self._time_of(message)
        if time is not None:
            clock.note_time(time, is_assimilated=is_assimilated, stream=self.stream)

    def _enqueue(self, twin: Twin, message: Message, step: int) -> None:
        """Queue a message; refuse it if its step is too late or an earlier message contradicts it.

        If its step lies after the next step of the twin, an empty reading is queued for each step
        between them. If its step was received before, the message revises it.
        """
        steps_ahead = step - twin.steps
        if step < twin.first_kept and steps_ahead < 0:
            raise Refused(
                f"step {step} is {-1 - steps_ahead} steps late, and `watch.lag` is "
                f"{self._section.lag}"
            )
        status = StepStatus.WITH_CONTROL
        if message.control is None or message.assumed:
            status = StepStatus.ASSUMED_CONTROL
        if steps_ahead < 0:
            self._enqueue_revision(twin, message, step, status)
            return
        if steps_ahead > 0:
            likely_unit = ""  # of the time of the message
            if message.step is None and message.time is not None:
                likely_unit = self._clock.likely_unit(message.time, twin.steps)
            self.stream.note_gap(twin.steps, step, likely_unit)
        for missing_step in range(twin.steps, step):
            no_reading = Reading(np.full(self._width, np.nan))
            self._queue.append(_QueuedReading(missing_step, no_reading, StepStatus.MISSING))
        self._queue.append(_QueuedReading(step, message, status))

    def _enqueue_revision(
        self, twin: Twin, message: Message, step: int, status: StepStatus
    ) -> None:
        """Queue a message about an earlier step if it adds something; refuse a contradiction.

        It adds something if it has readings that the step lacks, or another control than the
        assumed one. Otherwise it is counted as a duplicate.
        """
        contradiction = self._contradiction(twin, message, step)
        if contradiction:
            raise Refused(contradiction)
        row = twin.observed(step)
        has_other_control = message.control not in (None, twin.control_of(step))
        merged_row = np.where(np.isnan(row), message.observed, row)
        if not has_other_control and np.array_equal(merged_row, row, equal_nan=True):
            self.counts.duplicates += 1
            self._messages_with_readings += 1  # a duplicate has readings, too
            return
        self._row_before_revision = row
        revision = replace(message, observed=merged_row, revises=step)
        self._queue.append(_QueuedReading(step, revision, status))

    def _contradiction(self, twin: Twin, message: Message, step: int) -> str:
        """Return how a message contradicts what was received of a step; empty if it does not."""
        row = twin.observed(step)
        is_in_both = ~np.isnan(row) & ~np.isnan(message.observed)
        if not np.array_equal(row[is_in_both], message.observed[is_in_both]):
            return f"it contradicts what was received of step {step} before"
        has_other_control = message.control not in (None, twin.control_of(step))
        # Negative index: the last status belongs to the last step of the twin
        has_control = self._statuses[step - twin.steps] is StepStatus.WITH_CONTROL
        if has_other_control and has_control:
            return f"it contradicts the control of step {step}"
        return ""
