"""From messages to readings: steps in order, gaps predicted through, late ones in their place."""

import json
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from reporting.arrays import Float
from reporting.files import atomic_write_text, explained_write_errors
from reporting.words import counted, one_line
from twin_master.errors import TwinMasterError, said
from twin_master.mission.journal import encode_state, step_record
from twin_master.mission.steps import MissionStep, Reading
from twin_master.network.estimator import Notice, Words
from twin_master.network.twin import Twin
from twin_master.scenario.schema import Scenario
from twin_master.watch.clock import Clock
from twin_master.watch.lines import Place
from twin_master.watch.message import Fed, Message, Refused
from twin_master.watch.stream import REFUSALS_IN_A_ROW, StreamNotices, unit_advice

POLL_SECONDS = 0.05
"""Between two looks at a feed that may go on."""
REJECTED_NAME = "rejected.jsonl"
REJECTED_KEPT = 10_000
"""Refused messages that are written down; further ones are counted only, so that a flood fills no disk."""
_TEXT_KEPT = 200
SNAPSHOT_STEPS = 32
"""Steps between two lines of the journal that also hold the state of the twin."""
MISSING, _ASSUMED, GIVEN = 0, 1, 2
"""Of a step: not received; received with a control that was assumed and may be corrected; with its own."""


class Feed:
    """Where messages come from; of itself one that is not read twice: it goes on where it is.

    Parameters
    ----------
    fed : iterable of Fed
        Its messages.
    """

    replayable = False
    """Whether it begins anew with every process, so that what was read before is read again."""
    place: Place | None = None
    """Where it stands behind the message that it gave last."""

    def __init__(self, fed: Iterable[Fed] = ()) -> None:
        self._fed = fed

    def holds(self, place: Place) -> bool:
        """Return whether a place is one of it, and not of another source."""
        return False

    def messages(self, place: Place | None) -> Iterator[Fed]:
        """Return the messages behind a place, or all of them."""
        return iter(self._fed)

    def decide(self, decision: Mapping[str, Any]) -> None:
        """Tell whoever sends the messages what was decided, where they listen."""

    def close(self) -> None:
        """Let go of whoever sends the messages."""


@dataclass
class Counts:
    """What came, and what became of it.

    Attributes
    ----------
    received : int
        Messages read.
    missing : int
        Steps that were predicted through because nothing came, less those that came late.
    late, duplicates, rejected : int
        Messages that were put in their place later, that said nothing new, and that were refused.
    """

    received: int = 0
    missing: int = 0
    late: int = 0
    duplicates: int = 0
    rejected: int = 0


class Intake:
    """The messages of a feed as the source of a twin.

    A message belongs to the step that it names, or to that of its time, or to the next one. One about a step
    that was received before must agree with it: what it has beyond is taken in, a contradiction is refused.
    Nothing that was received can be changed afterwards.

    Parameters
    ----------
    scenario : Scenario
        Sensors, and how late and how far ahead a message may be.
    feed : Feed
        Of the messages.
    rejected : Path or None
        `rejected.jsonl`, where refused ones are written down; None keeps none.

    Attributes
    ----------
    counts : Counts
        What came so far, up to the last reading.
    observation_step : int
        The step of the last reading.
    notices : list of Notice
        Of the last reading: sensors of which no number came any more, or came again; what is wrong with the
        stream of messages, see `StreamNotices`.
    stream : StreamNotices
        What the operator was told of the stream.
    stops_at_refusals : bool
        Whether `read` returns None once where the operator is to be told that messages are refused.
    ended : bool
        Whether the feed has ended; if not, more may come after `read` has returned None.
    look : callable or None
        Called now and then while nothing comes; without it nothing is waited for.
    steps : int or None
        In all, after which it ends.
    asked : bool
        Whether the end was asked for.
    """

    def __init__(self, scenario: Scenario, feed: Feed, rejected: Path | None = None) -> None:
        self._section, self._words = scenario.watch, Words.of(scenario)
        self._width = scenario.row_width
        self._feed = feed
        self._rejected, self._kept = rejected, 0
        self._messages: Iterator[Fed] | None = None
        self._place: Place | None = None  # behind the last message, and behind the one before it
        self._before_last: Place | None = None
        self._pending: deque[tuple[int, Reading, int]] = deque()
        self._given: deque[int] = deque(maxlen=scenario.watch.lag + 1)
        self._clock = Clock(scenario.watch)
        self._text = ""
        self._unreadable = self._known = set[int]()  # after the last reading, and before it
        self.notices: list[Notice] = []
        self.stream = StreamNotices(self._words)
        self._stream_before: dict[str, Any] = {}  # its state before the last reading
        self.stops_at_refusals = False
        self._came = self._useful = 0  # messages in this process, and those that told something of a sensor
        self._before: Float = np.empty(0)
        self.counts = Counts()
        self.observation_step = -1
        self.ended = self.asked = self._waiting = False
        self.look: Callable[[], None] | None = None
        self.steps: int | None = None

    @property
    def settled(self) -> bool:
        """Whether no reading of the last message is still to come."""
        return not self._pending

    def state(self) -> dict[str, Any]:
        """Return what is needed to go on, as JSON."""
        # The message behind a gap is read again, until its own step is written down.
        waiting = bool(self._pending)
        counts = vars(self.counts) | {"received": self.counts.received - waiting}
        stream = self.stream.state(waiting=waiting)
        return {
            "counts": counts,
            "given": "".join(map(str, self._given)),
            "origin": self._clock.origin,
            "source": self._before_last if waiting else self._place,
            **({} if self._clock.only_step is None else {"first_timed": self._clock.only_step}),
            **({"unreadable": sorted(self._unreadable)} if self._unreadable else {}),
            **({"stream": stream} if stream else {}),
        }

    def line(self, step: MissionStep, twin: Twin) -> dict[str, Any]:
        """Return what a line of the journal says of the last reading and what became of it."""
        concluded = step.twin_step
        record = step_record(step) | {
            "observation_step": self.observation_step,
            "control_index": twin.control_of(self.observation_step),
            "intake": self.state(),
        }
        if step.reading.revises is not None:
            record["control_in_force"] = concluded.control_index
        elif (concluded.step + 1) % SNAPSHOT_STEPS == 0 and (settled := twin.settled()):
            record["settled"] = {"step": settled[0], "state": encode_state(settled[1])}
        known = {(notice.kind, notice.sensors) for notice in concluded.notices}
        if told := [n.as_record() for n in self.notices if (n.kind, n.sensors) not in known]:
            record["notices"] = record.get("notices", []) + told
        return record

    def restore(self, state: Mapping[str, Any] | None) -> None:
        """Go on from a state; None is the begin.

        A file that was read before is read on; another one is read from its first message.
        """
        again = self._feed.replayable
        if state is not None:
            self.counts = Counts(**state["counts"])
            self._clock.origin = state["origin"]
            self._clock.only_step = state.get("first_timed")
            self._given.extend(map(int, state["given"]))
            self._unreadable = set(state.get("unreadable", ()))
            self.stream.restore(state.get("stream", {}))
            again &= state["source"] is not None and self._feed.holds(state["source"])
            self._place = state["source"] if again else None
        if self._rejected is not None and self._rejected.exists():
            lines = self._rejected.read_text(encoding="utf-8").splitlines(keepends=True)
            kept = lines[: self.counts.rejected] if again else lines  # those behind are read again
            kept = [line for line in kept if line.endswith("\n")]  # not cut off by a kill
            self._kept = len(kept)
            untold = max(len(kept) - self.counts.rejected, 0)  # behind the last step
            self.counts.rejected += untold
            self.counts.received += untold
            if kept != lines:
                atomic_write_text(self._rejected, "".join(kept))

    def ask(self) -> None:
        """Ask for the end: between two steps, never within one."""
        self.asked = True
        if self._waiting:
            raise _Asked

    def read(self, twin: Twin) -> Reading | None:
        """Return the next reading, see `Source.read`; None also where the end was asked for."""
        with suppress(_Asked):
            while not self.asked and (self.steps is None or twin.steps < self.steps):
                if self.stops_at_refusals and self.stream.refusals_are_untold:  # also as no state could show
                    return None
                begin = time.monotonic()
                came = bool(self._pending) or self._took(twin)
                if self._pending:
                    return self._next(twin)
                if self.ended or not (came or self.look):
                    return None
                if self.look is not None:  # there may be silence among messages that are not taken, too
                    self.look()
                if not came:
                    time.sleep(max(0.0, begin + POLL_SECONDS - time.monotonic()))
        return None

    def _took(self, twin: Twin) -> bool:
        """Take in the next message; return whether one has come."""
        if self._messages is None:
            self._messages = self._feed.messages(self._place)
        self._waiting = self.look is not None
        try:
            came = next(self._messages, None)
        finally:
            self._waiting = False
        self.ended = came is None
        message, self._text = came or (None, "")
        if message is None:
            return False
        self.counts.received += 1
        self._came += 1
        self._before_last, self._place = self._place, self._feed.place
        step: int | None = None
        try:
            if isinstance(message, Refused):
                raise message
            step = self._step_of(twin, message)
            self._sort(twin, message, step)
        except Refused as refusal:
            self._refuse(str(refusal), step)
        return True

    def _next(self, twin: Twin) -> Reading:
        """Return the next of the readings that have come."""
        step, reading, given = self._pending.popleft()
        self.observation_step = step
        self._known = self._unreadable
        self._stream_before = self.stream.state(waiting=False)
        self.notices = [*self._noticed(reading)]
        if given == MISSING:
            self.notices += self.stream.coming()
        else:
            self.notices += self._taken(step, reading)
        if reading.revises is None:
            self._given.append(given)
            self.counts.missing += given == MISSING
        else:
            place = step - twin.steps
            self.counts.missing -= self._given[place] == MISSING
            self.counts.late += 1
            self._given[place] = max(given, self._given[place])
        return reading

    def _taken(self, step: int, reading: Reading) -> list[Notice]:
        """Take in that a message is assimilated; return what is to be told of the stream of messages."""
        is_blind = bool(np.isnan(reading.observed).all())
        self._useful += not is_blind
        passed_over = reading.passed_over if isinstance(reading, Message) else {}
        if reading.revises is not None:  # it says nothing of how the sensors are now
            is_blind = self.stream.is_blind
        return self.stream.take(step, is_blind=is_blind, passed_over=passed_over)

    def complaint(self) -> str:
        """Return why the messages of this process were of no use, in a sentence; empty where they were.

        That is so where no message told the reading of a sensor, or those at the end were all refused.
        """
        refused = self.stream.refused_in_a_row
        if self._came and refused and (refused >= REFUSALS_IN_A_ROW or not self._useful):
            return (
                f"The watch ended while messages were refused: the last {refused} of "
                f"{counted(self._came, 'message')}, the last one because {self.stream.last_reason}."
            )
        if self._came and not self._useful:
            return (
                f"None of {counted(self._came, 'message')} has a reading of any {self._words.sensor}: what "
                "is told rests on the transitions alone."
            )
        return ""

    def _noticed(self, reading: Reading) -> Iterator[Notice]:
        """Say of each sensor once that it is unreadable, and once that it is back."""
        if reading.revises is not None:
            return  # it says nothing of how the sensors are now
        came, words = reading.unreadable, self._words
        when = f"{words.step.capitalize()} {self.observation_step}"
        for g in sorted(came.keys() - self._unreadable):
            sentence = said("watch.left_out", when=when, sensor=words.sensors([g]), came=came[g])
            yield Notice("gauge_left_out", sentence, (g + 1,))
        back = {g for g in self._unreadable - came.keys() if not np.isnan(reading.observed[g])}
        for g in sorted(back):
            sentence = f"{when}: the readings of {words.sensors([g])} are back, and used again."
            yield Notice("gauge_back", sentence, (g + 1,))
        self._unreadable = (self._unreadable | came.keys()) - back

    def replace_impossible(self, reading: Reading, error: TwinMasterError) -> Reading:
        """Refuse an observation that no state allows; its step is predicted through, or stays as it was."""
        self.stream.restore(self._stream_before)
        self._useful -= 1
        self._refuse(str(error), self.observation_step)
        self.notices = [notice for notice in self.notices if notice.kind == "clock"]
        self._unreadable = self._known
        if reading.revises is not None:
            return Reading(self._before, None, reading.revises)
        return Reading(np.full(self._width, np.nan), reading.control)

    def _refuse(self, reason: str, step: int | None) -> None:
        self.counts.rejected += 1
        self.stream.refuse(step, one_line(reason))
        if self._rejected is None or self._kept >= REJECTED_KEPT:
            return
        self._kept += 1
        record = {"message": self.counts.received, "reason": reason, "text": self._text[:_TEXT_KEPT]}
        with explained_write_errors(self._rejected), self._rejected.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record, ensure_ascii=True) + "\n")

    def _step_of(self, twin: Twin, message: Message) -> int:
        """Return the step that a message names, or that of its time, or the next one."""
        if message.step is not None:
            return message.step
        if message.time is None:
            return twin.steps
        return self._clock.step_of(message.time, twin.steps, self.stream)

    def _sort(self, twin: Twin, message: Message, step: int) -> None:
        """Take in a message: the next step, one ahead with the gap before it, or one that was before."""
        most = self._section.longest_gap
        ahead, told = step - twin.steps, message.control is not None and not message.assumed
        given = GIVEN if told else _ASSUMED
        unit = ""
        if message.step is None and message.time is not None:
            unit = self._clock.slipped_unit(message.time, twin.steps)
        if ahead > most:
            far = f"step {step} is {ahead} steps ahead of the next one, {twin.steps}"
            raise Refused(f"{far}, and `watch.longest_gap` is {most}{unit_advice(unit)}")
        if step < twin.first_kept and ahead < 0:
            raise Refused(said("watch.late", step=step, late=-1 - ahead, lag=self._section.lag))
        if ahead > 0:
            self.stream.gap(twin.steps, step, unit)
        if ahead >= 0:
            lost = Reading(np.full(self._width, np.nan))
            self._pending += [(twin.steps + gap, lost, MISSING) for gap in range(ahead)]
            self._pending.append((step, message, given))
            return
        before = twin.observed(step)
        both = ~np.isnan(before) & ~np.isnan(message.observed)
        if not np.array_equal(before[both], message.observed[both]):
            raise Refused(f"it contradicts what was received of step {step} before")
        another = message.control not in (None, twin.control_of(step))
        if another and self._given[ahead] == GIVEN:
            raise Refused(f"it contradicts the control of step {step}")
        merged = np.where(np.isnan(before), message.observed, before)
        if not another and np.array_equal(merged, before, equal_nan=True):
            self.counts.duplicates += 1
            self._useful += 1
            return
        self._before = before
        self._pending.append((step, replace(message, observed=merged, revises=step), given))


class _Asked(BaseException):
    """Somebody asked the watch to end while it waited."""


@contextmanager
def listening(ask: Callable[[], None]) -> Iterator[None]:
    """Call `ask` where SIGINT or SIGTERM ask for an end, in the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = signal.SIGINT, signal.SIGTERM
    before = {number: signal.signal(number, lambda *_: ask()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
